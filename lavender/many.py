"""Many problems in one call: the results of `solve` on each, with the same bits.

Problems in generalised coordinates are solved in one compiled loop without the interpreter, small problems by one
compiled call each. Problems that these do not solve, and all others, are solved one by one. The descriptive fields of
a solution (claim, counts, names) are made when they are first read.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from threading import Timer
from time import perf_counter
from typing import Any

import numpy as np

from lavender._arrays import whole_number
from lavender.deadline import NEVER, Deadline
from lavender.errors import InputError
from lavender.loop import LEAST
from lavender.problem import Problem
from lavender.registry import SolverSpec, get
from lavender.solution import Solution, Status, uninterrupted
from lavender.solve import check_budget, check_taken, rest_of, seconds_of, solve, unjudged
from lavender_ext.small.many import Batch

__all__ = ["solve_many"]

LATE = 4e-5  # s, of a problem whose turn comes too late
BATCHED = 0.1  # s left of a limit from which one compiled loop is asked: a problem in it takes a tenth of that at most
NO_TURN = "the time limit was over before its turn: the start, unjudged"


def solve_many(
    problems: Iterable[Problem],
    solver: str = "auto",
    *,
    impulses: Sequence[Any] | None = None,
    threads: int = 1,
    tol: float = 1e-6,
    max_iter: int | None = None,
    time_limit: float | None = None,
    **options: Any,
) -> list[Solution]:
    """Solve many problems, with the bits of `solve` on each for any number of threads.

    Parameters
    ----------
    problems : iterable of Problem
    solver : str
    impulses : sequence of (m,) N s, optional
        Warm start of each problem, None for a problem without one; default: as `solve`.
    threads : int
        Problems solved at the same time.
    tol, max_iter, **options
        As `solve`.
    time_limit : float, optional, s
        Limit of the whole call on the wall clock. Problems take their turns in order, each with all of the time left;
        those whose turn comes too late keep their start, unjudged until their residual is read. Below 0.1 s all are
        solved one by one, without the compiled loop.

    Returns
    -------
    list of Solution
        In the order of the problems.

    Raises
    ------
    InputError
        `threads` is not a whole number from 1, `impulses` has another length than `problems`, `impulse` was given, or
        as `solve`.
    UnknownName, CapabilityError, SolverUnavailable
        As `solve`, for the first problem that is refused.
    KeyboardInterrupt
        Ctrl-C; a thread ends the problem that it has in hand.
    """
    if isinstance(problems, Problem):
        raise InputError("problems is one Problem; a list of them is needed, or `solve`")
    given = list(problems)
    threads = whole_number("threads", threads, 1, None)
    if "impulse" in options:
        raise InputError("impulse is of one problem; give impulses=, one for each (None where there is none)")
    if impulses is not None and len(impulses) != len(given):
        raise InputError(f"{len(impulses)} impulses for {len(given)} problems; one for each is needed")
    starts = [None] * len(given) if impulses is None else list(impulses)
    made: list[Solution | None] = [None] * len(given)
    spec = get(solver)
    limit = seconds_of(time_limit)
    deadline = NEVER if limit == np.inf else Deadline(limit)
    check_budget(spec, tol, max_iter)
    deadline.keep(LATE * len(given))  # for those whose turn comes too late
    more = {"tol": tol, "max_iter": max_iter, **options}
    # What `solve` would ask of one compiled call.
    together = spec.own and spec.small is not None and spec.small.limits is not None and not options
    together = together and max_iter is None and isinstance(tol, float) and 0.0 < tol < np.inf
    together = together and (not deadline.is_set or not deadline.passed(BATCHED))
    at = [
        i
        for i, p in enumerate(given)
        if type(p) is Problem and p.generalized is not None and not p.cones.has_ellipse
    ]

    stop, full = bytearray(1), bytearray(1)  # not 0: nothing more is begun, or nothing more in a batch
    left = deadline.left(LEAST)
    alarm = Timer(left, full.__setitem__, (0, 1)) if together and at and left is not None else None

    def batch(part: list[int]) -> None:
        _batch(given, starts, part, tol, spec, made, full)

    def alone(i: int) -> None:
        if stop[0]:
            return
        deadline.keep(-LATE)
        if deadline.passed():
            check_taken(given[i], spec)
            made[i] = unjudged(given[i], spec, options, starts[i], tol, NO_TURN)
            return
        found = solve(given[i], solver, impulse=starts[i], time_limit=deadline.left(LEAST), **more)
        made[i] = found if "callback" in options else uninterrupted(found)

    if alarm is not None:
        alarm.daemon = True
        alarm.start()
    parts = [at[k::threads] for k in range(min(threads, len(at)))] if together else []
    try:
        if threads == 1:
            for part in parts:
                batch(part)
            for i, solution in enumerate(made):
                if solution is None:
                    alone(i)
        else:
            with ThreadPoolExecutor(threads) as pool:
                try:
                    list(pool.map(batch, parts))
                    list(pool.map(alone, [i for i, solution in enumerate(made) if solution is None]))
                finally:
                    stop[0] = full[0] = 1  # of Ctrl-C the other threads hear nothing
    finally:
        if alarm is not None:
            alarm.cancel()
    return [solution for solution in made if solution is not None]


def _batch(
    problems: list[Problem],
    starts: list[Any],
    at: list[int],
    tol: float,
    spec: SolverSpec,
    made: list[Solution | None],
    stop: bytearray,
) -> None:
    """Into `made` the solutions of those of the problems `at` that the compiled loop ends, with their share of time."""
    begin = perf_counter()
    views, given = [], []
    for i in at:
        if stop[0]:
            return
        p, start = problems[i], starts[i]
        views.append(p.derived.view)
        given.append(p.guess if start is None else p.impulse_array(start))
    assert spec.small is not None
    work = Batch(views, given, tol, spec.small.limits, stop)
    seconds = (perf_counter() - begin) / max(1, len(at))
    common = _Solved(
        batch=work, problems=[problems[i] for i in at], spec=spec, tol=tol, seconds=seconds, given=given
    )
    work.hand_out(Solution, _solution, common, at, made)


@dataclass(frozen=True)
class _Solved:
    """What the solutions of a batch are made of."""

    batch: Batch
    problems: list[Problem]
    spec: SolverSpec
    tol: float
    seconds: float  # share of each
    given: list[Any]  # starts


def _solution(common: _Solved, i: int) -> dict[str, Any]:
    """All fields of the solution of problem i, which converged."""
    judged, counts = common.batch.judged(i)
    made = {"impulse": judged.impulse, "status": Status.CONVERGED, "tol": common.tol, "setup_time": 0.0}
    rest = rest_of(common.problems[i], common.spec, judged, counts, common.given[i])
    return made | {"solve_time": common.seconds} | rest
