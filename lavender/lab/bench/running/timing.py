"""The one place that times a solve.

What is timed is the line that a report prints: `lv.solve(problem, "name", tol=...)`, judge and all, on a problem whose
numbers were written just before, as a simulator leaves them, after other work that takes its part of the caches. A
guarded solve comes first, prepared and under the time limit; what it does not end is timed as far as it went. Where no
line is asked for (`Task.way` is empty) preparing and solving are timed, on a problem of which nothing is computed yet,
without the judge. BLAS and OpenMP have one thread and the garbage collector waits.
"""

from __future__ import annotations

import gc
import statistics
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, replace
from functools import cache
from time import perf_counter
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.lazy_import import import_numerics
from lavender.judge.residuals import reference
from lavender.judge.solution import Claim, Solution, Status, uninterrupted
from lavender.lab.bench import machine
from lavender.lab.bench.record import ERROR, CaseInfo, Record, measurement_key
from lavender.lab.bench.stopwatch import measure_backend_time
from lavender.lab.bench.timed_call import make_call_arguments
from lavender.problem import Problem
from lavender.solvers import registry
from lavender.solving.outcome import finish
from lavender.solving.solve import prepare, solve

SHORT = 5e-3  # s: what took longer is not called once more for warmth
CLAIMS = (Status.CONVERGED, Status.FLOOR, Status.INFEASIBLE)


@dataclass(frozen=True)
class Ask:
    """A line to time, on whatever case the solver takes."""

    solver: str
    mode: str  # "tol" | "budget" | "time"
    tol: float
    max_iter: int = 0  # 0: the solver's own default
    time_limit: float = 0.0  # s, of one solve; 0: that of the plan
    way: str = "call"  # as `Record.way`
    start: str = "cold"


@dataclass(frozen=True)
class Task:
    """One measurement to make: what an `Ask` says, on a case."""

    run: str
    case: str
    sha: str
    solver: str
    mode: str
    tol: float
    max_iter: int
    time_limit: float
    start: str = "cold"
    options: Mapping[str, Any] = field(default_factory=dict)
    repeats: int = 1
    step: int = -1
    way: str = ""
    turns: str = ""
    guarded: bool = True  # a solve under the time limit comes first
    lead: float = 0.0  # s, that the line takes before its call: carrying impulses

    @property
    def key(self) -> tuple[Any, ...]:
        """As `Record.key` of what comes out."""
        return measurement_key(self)

    @classmethod
    def of(cls, info: CaseInfo, ask: Ask, **more: Any) -> Task:
        """What is asked for, on a case."""
        return cls(run=info.run, case=info.case, sha=info.sha, step=info.step, **{**vars(ask), **more})

    def record(self, **what: Any) -> Record:
        """A record of this task."""
        order, seed = str(self.options.get("order", "given")), int(self.options.get("seed", 0))
        same = {name: getattr(self, name) for name in _SHARED}
        return Record(**{**same, "options": dict(self.options)}, order=order, seed=seed, **what)


#: Fields of a task that its record has, too; `repeats` of a record are those that were made.
_SHARED = {f.name for f in fields(Task)} & {f.name for f in fields(Record)} - {"repeats"}


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
    # Looking for the libraries reads /proc, a few milliseconds: once a solver, when its own are loaded, and SciPy's.
    from threadpoolctl import ThreadpoolController

    import_numerics()
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
    certificate: FloatArray | None  # (m,), with INFEASIBLE
    status: str  # name of a Status
    iterations: int
    work: Mapping[str, int]
    message: str
    form: str
    setups: tuple[float, ...]  # s, of each repeat
    solves: tuple[float, ...]  # s
    times: tuple[float, ...]  # s, of the line of each repeat; none where the guard did not end
    pace: float | None  # s
    own: float | None = None  # s, in the backend's own solve
    reached: tuple[float, ...] = ()  # relative residual of each repeat, in mode "time"
    status_conflict: str = ""  # as in a Solution


def measure(problem: Problem, task: Task, impulse: Any = None) -> tuple[Record, FloatArray | None]:
    """Make one measurement; what the solver raises becomes a record of status ERROR.

    Parameters
    ----------
    problem : Problem
    task : Task
    impulse : (m,) N s, optional
        Start, for `start="carried"`. "cold" starts from Pi(0), "warm" from the problem's guess.

    Returns
    -------
    Record, and the impulses (m,) [N s] that came out, or None

    Raises
    ------
    KeyboardInterrupt
        Ctrl-C; nothing is recorded.
    """
    return judged(problem, task, attempt(problem, task, impulse))


def attempt(problem: Problem, task: Task, impulse: Any = None) -> Outcome | str:
    """Run the solver as the task asks, in this process; what it raised, as text."""
    runs: list[tuple[Solution, float]] = []  # with the time of the line
    paces: list[float] = []
    owns: list[float] = []
    guard: Solution | None = None
    try:
        _warm_up(task.solver)
        with _undisturbed(task.solver):
            begun = perf_counter()
            if task.way and task.guarded:
                # A plug-in may test nothing: then its own budget ends its line, and a larger one never would.
                tests = registry.get(task.solver).own or task.mode != "tol"
                guard = uninterrupted(_parts(problem, task if tests else replace(task, max_iter=0), impulse))
                if not tests and _cut_short(guard, task):
                    guard = uninterrupted(_parts(problem, task, impulse))
            left = max(1, task.repeats - (guard is not None))
            while left and (guard is None or guard.status is not Status.TIME_LIMIT):
                paces.append(pace())
                if not task.way:
                    parts = uninterrupted(_parts(problem, task, impulse))
                    runs.append((parts, parts.setup_time + parts.solve_time))
                else:
                    with measure_backend_time(task.solver) as spent:
                        runs.append(_line(problem, task, impulse, guard))
                    owns += [sum(spent)] if spent else []
                if task.turns:  # in turns with others: as a simulator that calls the same line at every step
                    left, runs = left if perf_counter() - begun < SHORT else 1, runs[-1:]
                left -= 1
                if runs[-1][0].status is Status.TIME_LIMIT or perf_counter() - begun > task.time_limit:
                    left = 0 if task.mode != "time" else left
            solution = runs[-1][0] if runs else guard
            if guard is None and task.way and _cut_short(solution, task):
                # More iterations than the solver's own limit: they are asked for, under the guard.
                return attempt(problem, replace(task, guarded=True), impulse)
    except Exception as error:
        # A backend may raise anything; it costs its own record, never the run.
        return f"{type(error).__name__}: {error}".strip()
    assert solution is not None  # there is at least one repeat
    made = [s for s, _ in runs] or [solution]
    found = outcome_of(solution, made, [t for _, t in runs], min(paces, default=None), task.mode == "time")
    return replace(found, own=min(owns, default=None))


def outcome_of(
    solution: Solution, made: list[Solution], times: list[float], paced: float | None, reached: bool = False
) -> Outcome:
    """What the repeats `made` brought, the last of them `solution`."""
    return Outcome(
        impulse=solution.impulse,
        certificate=solution.certificate,
        status=solution.status.name,
        iterations=solution.iterations,
        work=solution.work,
        message=solution.message,
        form=solution.solver.form,
        status_conflict=solution.status_conflict[:500],
        setups=tuple(s.setup_time for s in made),
        solves=tuple(s.solve_time for s in made),
        times=tuple(times),
        pace=paced,
        reached=tuple(float(s.residual.relative) for s in made) if reached else (),
    )


def _cut_short(solution: Solution | None, task: Task) -> bool:
    assert solution is not None
    return (
        task.mode == "tol"
        and not task.turns
        and task.max_iter > 0
        and solution.status is Status.MAX_ITERATIONS
    )


_NUMBERS = np.arange(2.0**15)  # 256 KiB: more than a first cache holds


def pace() -> float:
    """Time [s] of a loop of fixed work: what the machine is worth now. It takes its part of the caches, too."""
    begun = perf_counter()
    total = 0.0
    for i in range(500):
        total += 0.5 * i
    for _ in range(4):
        total += float(_NUMBERS.sum())
    return perf_counter() - begun


def just_written(problem: Problem, start: str) -> Problem:
    """The problem in arrays of its own, written now, nothing derived from them: what a simulator hands over.

    With `start` "cold" without the guess that came with it, as the line that is printed says.
    """
    rows = None if problem.rows is None else replace(problem.rows, copy=True)
    return replace(problem, rows=rows, guess=None if start == "cold" else problem.guess, copy=True)


def _line(problem: Problem, task: Task, impulse: Any, guard: Solution | None) -> tuple[Solution, float]:
    """One call of the line, and its time."""
    more = {**task.options, **make_call_arguments(task, 0 if guard is None else guard.iterations)}
    fresh = just_written(problem, task.start)
    if task.start == "carried":
        more["impulse"] = problem.start() if impulse is None else impulse
    begun = perf_counter()
    solution = solve(fresh, task.solver, **more)
    return uninterrupted(solution), perf_counter() - begun + task.lead


def judged(problem: Problem, task: Task, found: Outcome | str) -> tuple[Record, FloatArray | None]:
    """The record of an outcome, judged here on `problem`, and the impulses (m,) [N s] if they are numbers."""
    if isinstance(found, str):
        return task.record(status=ERROR, message=found[:500]), None
    solution = solution_of(problem, task, found)
    impulse = solution.impulse if np.isfinite(solution.impulse).all() else None
    return record_of(task, solution, found), impulse


def solution_of(problem: Problem, task: Task, found: Outcome) -> Solution:
    """What an outcome says, judged here on `problem`."""
    claim = Claim(
        Status[found.status],
        found.iterations,
        found.work,
        found.message,
        found.form,
        certificate=found.certificate,
    )
    return finish(
        problem,
        registry.get(task.solver),
        dict(task.options),
        np.array(found.impulse),
        claim,
        task.tol,
        found.setups[-1],
        found.solves[-1],
        None,
        refutation=found.status_conflict.removeprefix("says INFEASIBLE, "),
    )


def _parts(problem: Problem, task: Task, impulse: Any) -> Solution:
    """Prepare and solve under the time limit."""
    fresh = replace(problem, copy=False)  # nothing derived yet: forming A is set-up
    more = {"isolate": False} if "isolate" in registry.get(task.solver).accepts else {}
    # a run has processes of its own for these
    prepared = prepare(fresh, task.solver, **{**more, **task.options})
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


def record_of(task: Task, s: Solution, found: Outcome) -> Record:
    """The record of repeats that ended in the solution `s`."""
    setups, solves = found.setups, found.solves
    both = found.times or [a + b for a, b in zip(setups, solves, strict=True)]
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
        claim_check=s.claim_check,
        status_conflict=s.status_conflict,
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
        times=found.times if task.way else (),
        reached=found.reached,
        pace=found.pace,
        load=machine.running(),
        own_min=found.own,
    )
