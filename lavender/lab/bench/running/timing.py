"""Time a solve: the only module that does.

The timed call is the line that a report prints, `lv.solve(problem, "name", tol=...)`, with the judge. The arrays of its
problem were written just before, as a simulator leaves them, and other work has used the caches since. A guarded solve
under the time limit runs first; if it does not end, its own time is recorded. If `Task.timing_mode` is empty,
only `prepare` and `solve` are timed, without the judge, on a problem of which nothing is computed yet. BLAS and OpenMP
use one thread, and the garbage collector is off.
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
from lavender.judge.residuals import get_reference
from lavender.judge.solution import Claim, Solution, Status, uninterrupted
from lavender.lab.bench import machine
from lavender.lab.bench.record import ERROR, CaseInfo, Record, measurement_key
from lavender.lab.bench.stopwatch import measure_backend_time
from lavender.lab.bench.timed_call import make_call_arguments
from lavender.problem import Problem
from lavender.solvers import registry
from lavender.solving.outcome import finish
from lavender.solving.solve import prepare, solve

MAX_WARM_UP_TIME = 5e-3  # s; a line that took longer is not called once more to warm the caches.
CLAIMS = (Status.CONVERGED, Status.ROUNDOFF_LIMIT, Status.INFEASIBLE)


@dataclass(frozen=True)
class Ask:
    """A line to time on all cases that the solver accepts."""

    solver: str
    mode: str  # "tol" | "budget" | "time"
    tol: float
    max_iter: int = 0  # 0: the solver's own default
    time_limit: float = 0.0  # s, of one solve; 0: that of the plan
    timing_mode: str = "call"  # as `Record.timing_mode`
    start: str = "cold"


@dataclass(frozen=True)
class Task:
    """One measurement: an `Ask` on a case."""

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
    timing_mode: str = ""
    interleave_group: str = ""
    guarded: bool = True  # a solve under the time limit comes first
    lead: float = 0.0  # s, that the line takes before its call: carrying impulses

    @property
    def key(self) -> tuple[Any, ...]:
        """The `Record.key` of the measurement."""
        return measurement_key(self)

    @classmethod
    def of(cls, info: CaseInfo, ask: Ask, **more: Any) -> Task:
        """Return the task of an `Ask` on a case."""
        return cls(run=info.run, case=info.case, sha=info.sha, step=info.step, **{**vars(ask), **more})

    def record(self, **what: Any) -> Record:
        """Return a record of this task."""
        order, seed = str(self.options.get("order", "given")), int(self.options.get("seed", 0))
        same = {name: getattr(self, name) for name in _SHARED}
        return Record(**{**same, "options": dict(self.options)}, order=order, seed=seed, **what)


#: Fields of a task that its record has, too; `repeats` of a record are those that were made.
_SHARED = {f.name for f in fields(Task)} & {f.name for f in fields(Record)} - {"repeats"}


@cache
def _warm_up(solver: str) -> None:
    """Import the code that a solver needs, so that no measurement includes it."""
    spec = registry.get(solver)
    spec.load()
    if spec.requires:
        # Backends import their own code when they first solve: solve one row before any clock starts.
        with suppress(Exception):
            tiny = (
                Problem.lcp(np.eye(1), np.ones(1))
                if "lcp" in spec.laws
                else Problem.linear(np.eye(1), np.ones(1))
            )
            prepare(tiny, solver).solve()


@cache
def _thread_pools(solver: str) -> Any:
    # Searching for the libraries takes a few milliseconds: once for each solver, after its own and SciPy's are loaded.
    from threadpoolctl import ThreadpoolController

    import_numerics()
    return ThreadpoolController()


@contextmanager
def one_thread(solver: str = "") -> Iterator[None]:
    """Limit BLAS and OpenMP to one thread, also the libraries that `solver` brings once it is imported."""
    with _thread_pools(solver).limit(limits=1):
        yield


@contextmanager
def _undisturbed(solver: str) -> Iterator[None]:
    """Limit BLAS and OpenMP to one thread and turn the garbage collector off."""
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
    """Result of the repeats of one measurement, before it is judged."""

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
    calibration_time: float | None  # s
    backend_time: float | None = None  # s, in the backend's own solve
    residual_per_repeat: tuple[float, ...] = ()  # relative residual of each repeat, in mode "time"
    status_conflict: str = ""  # as in a Solution


def measure(problem: Problem, task: Task, impulse: Any = None) -> tuple[Record, FloatArray | None]:
    """Make one measurement. An exception of the solver becomes a record of status ERROR.

    Parameters
    ----------
    problem : Problem
    task : Task
    impulse : (m,) N s, optional
        Start, for `start="carried"`. "cold" starts from Pi(0), "warm" from the problem's guess.

    Returns
    -------
    Record, and the final impulses (m,) [N s], or None

    Raises
    ------
    KeyboardInterrupt
        By Ctrl-C; nothing is recorded.
    """
    return judged(problem, task, attempt(problem, task, impulse))


def attempt(problem: Problem, task: Task, impulse: Any = None) -> Outcome | str:
    """Run the solver of a task in this process. Return an exception as text."""
    runs: list[tuple[Solution, float]] = []  # with the time of the line
    calibration_times: list[float] = []
    backend_times: list[float] = []
    guard: Solution | None = None
    try:
        _warm_up(task.solver)
        with _undisturbed(task.solver):
            begun = perf_counter()
            if task.timing_mode and task.guarded:
                # A plug-in may test nothing: then its own budget ends its line, and a larger one never would.
                tests = registry.get(task.solver).builtin or task.mode != "tol"
                guard = uninterrupted(
                    _prepare_and_solve(problem, task if tests else replace(task, max_iter=0), impulse)
                )
                if not tests and _ended_by_budget(guard, task):
                    guard = uninterrupted(_prepare_and_solve(problem, task, impulse))
            left = max(1, task.repeats - (guard is not None))
            while left and (guard is None or guard.status is not Status.TIME_LIMIT):
                calibration_times.append(measure_calibration_time())
                if not task.timing_mode:
                    parts = uninterrupted(_prepare_and_solve(problem, task, impulse))
                    runs.append((parts, parts.setup_time + parts.solve_time))
                else:
                    with measure_backend_time(task.solver) as spent:
                        runs.append(_time_call(problem, task, impulse, guard))
                    backend_times += [sum(spent)] if spent else []
                if task.interleave_group:  # Keep the last call only: a simulator also repeats one call.
                    left, runs = left if perf_counter() - begun < MAX_WARM_UP_TIME else 1, runs[-1:]
                left -= 1
                if runs[-1][0].status is Status.TIME_LIMIT or perf_counter() - begun > task.time_limit:
                    left = 0 if task.mode != "time" else left
            solution = runs[-1][0] if runs else guard
            if guard is None and task.timing_mode and _ended_by_budget(solution, task):
                # More iterations than the solver's own limit: they are asked for, under the guard.
                return attempt(problem, replace(task, guarded=True), impulse)
    except Exception as error:
        # A backend may raise anything; it costs its own record, never the run.
        return f"{type(error).__name__}: {error}".strip()
    assert solution is not None  # there is at least one repeat
    made = [s for s, _ in runs] or [solution]
    found = outcome_of(
        solution, made, [t for _, t in runs], min(calibration_times, default=None), task.mode == "time"
    )
    return replace(found, backend_time=min(backend_times, default=None))


def outcome_of(
    solution: Solution,
    made: list[Solution],
    times: list[float],
    calibration_time: float | None,
    keeps_residuals: bool = False,
) -> Outcome:
    """Return the outcome of the repeats `made`, the last of which is `solution`."""
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
        calibration_time=calibration_time,
        residual_per_repeat=tuple(float(s.residual.relative) for s in made) if keeps_residuals else (),
    )


def _ended_by_budget(solution: Solution | None, task: Task) -> bool:
    assert solution is not None
    return (
        task.mode == "tol"
        and not task.interleave_group
        and task.max_iter > 0
        and solution.status is Status.MAX_ITERATIONS
    )


_NUMBERS = np.arange(2.0**15)  # 256 KiB: more than a first cache holds


def measure_calibration_time() -> float:
    """Return the time [s] of a loop of fixed work, which measures the machine's current speed and uses the caches."""
    begun = perf_counter()
    total = 0.0
    for i in range(500):
        total += 0.5 * i
    for _ in range(4):
        total += float(_NUMBERS.sum())
    return perf_counter() - begun


def just_written(problem: Problem, start: str) -> Problem:
    """Return the problem in newly written arrays, with nothing derived from them, as a simulator leaves it.

    With `start` "cold" the guess that came with it is removed, as in the printed line.
    """
    rows = None if problem.rows is None else replace(problem.rows, copy=True)
    return replace(problem, rows=rows, guess=None if start == "cold" else problem.guess, copy=True)


def _time_call(problem: Problem, task: Task, impulse: Any, guard: Solution | None) -> tuple[Solution, float]:
    """Run the line once and return its solution and time [s]."""
    more = {**task.options, **make_call_arguments(task, 0 if guard is None else guard.iterations)}
    fresh = just_written(problem, task.start)
    if task.start == "carried":
        more["impulse"] = problem.start() if impulse is None else impulse
    begun = perf_counter()
    solution = solve(fresh, task.solver, **more)
    return uninterrupted(solution), perf_counter() - begun + task.lead


def judged(problem: Problem, task: Task, found: Outcome | str) -> tuple[Record, FloatArray | None]:
    """Judge an outcome on `problem`; return its record, and its impulses (m,) [N s] if they are finite."""
    if isinstance(found, str):
        return task.record(status=ERROR, message=found[:500]), None
    solution = solution_of(problem, task, found)
    impulse = solution.impulse if np.isfinite(solution.impulse).all() else None
    return record_of(task, solution, found), impulse


def solution_of(problem: Problem, task: Task, found: Outcome) -> Solution:
    """Return the solution of an outcome, judged on `problem`."""
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


def _prepare_and_solve(problem: Problem, task: Task, impulse: Any) -> Solution:
    """Prepare and solve under the time limit."""
    fresh = replace(problem, copy=False)  # nothing is derived yet: forming A is set-up
    more = {"isolate": False} if "isolate" in registry.get(task.solver).accepts else {}
    # a run has processes of its own for these
    prepared = prepare(fresh, task.solver, **{**more, **task.options})
    get_reference(fresh)  # E0, V0: the judge's, outside the clocks
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
    """Return the record of repeats that ended in the solution `s`."""
    setups, solves = found.setups, found.solves
    both = found.times or [a + b for a, b in zip(setups, solves, strict=True)]
    r = s.residual
    return task.record(
        status=s.status.name,
        relative=float(r.relative),
        energy=float(r.energy),
        velocity=float(r.velocity),
        roundoff_floor=float(r.roundoff_floor),
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
        times=found.times if task.timing_mode else (),
        residual_per_repeat=found.residual_per_repeat,
        calibration_time=found.calibration_time,
        load=machine.running(),
        backend_time_min=found.backend_time,
    )
