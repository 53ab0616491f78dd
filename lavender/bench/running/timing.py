"""The one place that times a solve.

A measurement takes a fresh problem (nothing computed yet) for every repeat, prepares the solver
(set-up: form A, factor, colour, allocate) and solves (solve). Judging is outside both clocks. BLAS and
OpenMP have one thread and the garbage collector waits.
"""

from __future__ import annotations

import gc
import statistics
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cache
from time import perf_counter
from typing import Any

import numpy as np

from lavender import registry
from lavender._arrays import FloatArray
from lavender.bench.record import ERROR, Record, measurement_key
from lavender.problem import Problem
from lavender.residuals import reference
from lavender.solution import Claim, Solution, Status
from lavender.solve import finish, prepare

__all__ = ["Outcome", "Task", "attempt", "judged", "measure", "one_thread"]

CLAIMS = (Status.CONVERGED, Status.FLOOR, Status.INFEASIBLE)


@dataclass(frozen=True)
class Task:
    """One measurement to make."""

    run: str
    case: str
    sha: str
    solver: str
    mode: str  # "tol" | "budget"
    tol: float
    max_iter: int  # 0: the solver's own default
    time_limit: float  # s, of one solve
    start: str = "cold"
    options: Mapping[str, Any] = field(default_factory=dict)
    repeats: int = 1
    step: int = -1

    @property
    def key(self) -> tuple[Any, ...]:
        """As `Record.key` of what comes out."""
        return measurement_key(self)

    def record(self, **what: Any) -> Record:
        """A record of this task."""
        return Record(
            run=self.run,
            case=self.case,
            sha=self.sha,
            solver=self.solver,
            options=dict(self.options),
            start=self.start,
            mode=self.mode,
            tol=self.tol,
            max_iter=self.max_iter,
            time_limit=self.time_limit,
            order=str(self.options.get("order", "given")),
            seed=int(self.options.get("seed", 0)),
            step=self.step,
            **what,
        )


@cache
def _warm_up(solver: str) -> None:
    """Import what a solver needs, so that the first measurement does not time it."""
    spec = registry.get(solver)
    spec.load()
    if spec.requires:
        # Backends import their own code when they first solve: one row, outside every clock.
        with suppress(Exception):
            tiny = (
                Problem.lcp(np.eye(1), np.ones(1))
                if "lcp" in spec.laws
                else Problem.linear(np.eye(1), np.ones(1))
            )
            prepare(tiny, solver).solve()


@cache
def _thread_pools(solver: str) -> Any:
    # Looking for the libraries reads /proc, a few milliseconds: once a solver, when its own are loaded.
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


@contextmanager
def one_thread(solver: str = "") -> Iterator[None]:
    """BLAS and OpenMP limited to one thread; those that `solver` brought too, once it was imported."""
    with _thread_pools(solver).limit(limits=1):
        yield


@contextmanager
def _undisturbed(solver: str) -> Iterator[None]:
    # One thread, the garbage collector off.
    collects = gc.isenabled()
    gc.disable()
    try:
        with one_thread(solver):
            yield
    finally:
        if collects:
            gc.enable()


@dataclass(frozen=True, eq=False)
class Outcome:
    """What the repeats of one measurement brought, before it is judged."""

    impulse: FloatArray  # (m,) N s
    status: Status
    iterations: int
    work: Mapping[str, int]
    message: str
    form: str
    certificate: FloatArray | None  # (m,), with INFEASIBLE
    setups: list[float]  # s, of each repeat
    solves: list[float]  # s


def measure(problem: Problem, task: Task) -> Record:
    """Make one measurement; what the solver raises becomes a record of status ERROR.

    Raises
    ------
    KeyboardInterrupt
        Ctrl-C; nothing is recorded.
    """
    return measure_impulse(problem, task)[0]


def measure_impulse(problem: Problem, task: Task, impulse: Any = None) -> tuple[Record, FloatArray | None]:
    """As `measure`, with the impulses (m,) [N s] that came out, or None.

    Parameters
    ----------
    impulse : (m,) N s, optional
        Start, for `start="carried"`. "cold" starts from Pi(0), "warm" from the problem's guess.
    """
    return judged(problem, task, attempt(problem, task, impulse))


def attempt(problem: Problem, task: Task, impulse: Any = None) -> Outcome | str:
    """Run the solver as the task asks, in this process; what it raised, as text."""
    setups: list[float] = []
    solves: list[float] = []
    solution = None
    try:
        _warm_up(task.solver)
        with _undisturbed(task.solver):
            begun = perf_counter()
            for _ in range(max(1, task.repeats)):
                solution = _once(problem, task, impulse)
                setups.append(solution.setup_time)
                solves.append(solution.solve_time)
                if solution.status is Status.INTERRUPTED:
                    raise KeyboardInterrupt
                if solution.status is Status.TIME_LIMIT or perf_counter() - begun > task.time_limit:
                    break
    except Exception as error:
        # A backend may raise anything; it costs its own record, never the run.
        return f"{type(error).__name__}: {error}".strip()
    assert solution is not None  # there is at least one repeat
    return Outcome(
        impulse=solution.impulse,
        status=solution.status,
        iterations=solution.iterations,
        work=solution.work,
        message=solution.message,
        form=solution.solver.form,
        certificate=solution.certificate,
        setups=setups,
        solves=solves,
    )


def judged(problem: Problem, task: Task, found: Outcome | str) -> tuple[Record, FloatArray | None]:
    """The record of an outcome, judged here on `problem`, and the impulses (m,) [N s] if they are numbers."""
    if isinstance(found, str):
        return task.record(status=ERROR, message=found[:500]), None
    claim = Claim(
        found.status,
        found.iterations,
        found.work,
        found.message,
        found.form,
        certificate=found.certificate,
    )
    solution = finish(
        problem,
        registry.get(task.solver),
        dict(task.options),
        np.array(found.impulse),
        claim,
        task.tol,
        found.setups[-1],
        found.solves[-1],
        None,
    )
    impulse = solution.impulse if np.isfinite(solution.impulse).all() else None
    return record_of(task, solution, found.setups, found.solves), impulse


def _once(problem: Problem, task: Task, impulse: Any) -> Solution:
    fresh = replace(problem, copy=False)  # nothing derived yet: forming A is set-up
    more = {"isolate": False} if "isolate" in registry.get(task.solver).accepts else {}
    prepared = prepare(
        fresh, task.solver, **{**more, **task.options}
    )  # a run has processes of its own for these
    reference(fresh)  # E0, V0: the judge's, outside the clocks
    if task.start == "cold":
        impulse = fresh.start()
    elif task.start == "warm":
        impulse = fresh.guess
    return prepared.solve(
        impulse=impulse,
        tol=task.tol,
        max_iter=task.max_iter or None,
        time_limit=task.time_limit,
    )


def record_of(task: Task, s: Solution, setups: list[float], solves: list[float]) -> Record:
    """The record of repeats that ended in the solution `s`."""
    both = [a + b for a, b in zip(setups, solves, strict=True)]
    r = s.residual
    return task.record(
        status=s.status.name,
        relative=float(r.relative),
        energy=float(r.energy),
        velocity=float(r.velocity),
        floor=float(r.floor),
        worst_row=int(r.worst_row),
        worst_name=r.worst_name,
        success=bool(s.success) and task.mode == "tol",
        contradicted=s.contradicted,
        claims=s.status in CLAIMS,
        iterations=int(s.iterations),
        work={k: int(v) for k, v in s.work.items()},
        form=s.solver.form,
        message=s.message[:500],
        repeats=len(both),
        setup_min=min(setups),
        setup_median=statistics.median(setups),
        solve_min=min(solves),
        solve_median=statistics.median(solves),
        time_min=min(both),
        time_median=statistics.median(both),
    )
