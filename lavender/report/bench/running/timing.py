"""Time solves. No other module does.

The timed call is the one that a report prints, `lv.solve(problem, "name", tol=...)`, including the judge. The arrays
of its problem are newly written, as by a simulator, and other work has used the processor's caches since. A guarded
solve, which is the same solve under the time limit, runs before the timed repetitions; if it does not end, its own
time is recorded. If `Task.timing_mode` is empty, only `prepare` and `solve` are timed, without the judge, on a problem
that has no derived arrays yet. BLAS and OpenMP use one thread, and the garbage collector is off.
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
from lavender.base.errors import require_packages
from lavender.base.lazy_import import import_numerical_modules
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.judge.solution import Claim, Solution, Status, raise_if_interrupted
from lavender.problem import Problem
from lavender.report.bench import machine
from lavender.report.bench.record import ERROR, CaseInfo, Record, make_measurement_key
from lavender.report.bench.stopwatch import measure_backend_time
from lavender.report.bench.timed_call import make_call_arguments
from lavender.solvers import registry
from lavender.solving.finish import FinishedRun, finish
from lavender.solving.prepared import prepare
from lavender.solving.solve import solve

MAX_WARM_UP_TIME = 5e-3  # [s] A call that took longer is not repeated to warm the caches.
CLAIM_STATUSES = (Status.CONVERGED, Status.ROUNDOFF_LIMIT, Status.INFEASIBLE)


@dataclass(frozen=True)
class CallSpec:
    """A call to time on all cases that the solver accepts.

    Parameters
    ----------
    solver : str
    mode : {"tol", "budget", "time"}
    tol : float
    max_iter : int
        0 means the solver's default.
    time_limit : float, s
        Limit of one solve; 0 means the plan's limit.
    timing_mode : str
        See `Record.timing_mode`.
    start : {"cold", "warm", "carried"}
    """

    solver: str
    mode: str
    tol: float
    max_iter: int = 0
    time_limit: float = 0.0
    timing_mode: str = "call"
    start: str = "cold"


@dataclass(frozen=True)
class Task:
    """One measurement: a `CallSpec` on a case.

    If `guarded` is true, a solve under the time limit precedes the timed repetitions. `lead` [s] is the time that was
    spent before the call to map the impulses of the previous step; it is added to the call's time. For the other
    fields see `Record`.
    """

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
    guarded: bool = True
    lead: float = 0.0

    @property
    def key(self) -> tuple[Any, ...]:
        """The `Record.key` of the measurement."""
        return make_measurement_key(self)

    @classmethod
    def from_call_spec(cls, info: CaseInfo, call: CallSpec, **arguments: Any) -> Task:
        """Create the task of a `CallSpec` on a case."""
        return cls(run=info.run, case=info.case, sha=info.sha, step=info.step, **{**vars(call), **arguments})

    def make_record(self, **results: Any) -> Record:
        """Create a record of this task with `results`."""
        order, seed = str(self.options.get("order", "given")), int(self.options.get("seed", 0))
        shared = {name: getattr(self, name) for name in _SHARED}
        return Record(**{**shared, "options": dict(self.options)}, order=order, seed=seed, **results)


#: Fields that are copied from a task to its record. `repeats` is not: a record holds the number of repeats made.
_SHARED = {f.name for f in fields(Task)} & {f.name for f in fields(Record)} - {"repeats"}


@cache
def _import_solver_code(solver: str) -> None:
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
def _get_thread_pools(solver: str) -> Any:
    """Return the controller of the BLAS and OpenMP libraries that are loaded with a solver."""
    # The search takes some milliseconds: do it once per solver, after its own libraries and SciPy's are loaded.
    require_packages("a timed measurement", "threadpoolctl")
    from threadpoolctl import ThreadpoolController

    import_numerical_modules()
    return ThreadpoolController()


@contextmanager
def limit_to_one_thread(solver: str = "") -> Iterator[None]:
    """Limit BLAS and OpenMP to one thread, including the libraries that are loaded when `solver` is imported."""
    with _get_thread_pools(solver).limit(limits=1):
        yield


@contextmanager
def _stabilise_timing(solver: str) -> Iterator[None]:
    """Limit BLAS and OpenMP to one thread and turn the garbage collector off."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        with limit_to_one_thread(solver):
            yield
    finally:
        if was_enabled:
            gc.enable()


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of the repeats of one measurement, before it is judged.

    Parameters
    ----------
    impulse : (m,) N s
    certificate : (m,) or None
        Certificate of infeasibility, if the status is INFEASIBLE.
    status : str
        Name of a Status.
    iterations : int
    work : mapping
    message, form : str
    setups, solves : tuple of float, s
        Times of each repeat.
    times : tuple of float, s
        Time of the call of each repeat; empty if the guarded solve did not end.
    calibration_time : float or None, s
        See `Record.calibration_time`.
    backend_time : float or None, s
        Time in the backend's own solve.
    residual_per_repeat : tuple of float
        Relative residual of each repeat, in mode "time".
    status_conflict : str
        As in a Solution.
    """

    impulse: FloatArray
    certificate: FloatArray | None
    status: str
    iterations: int
    work: Mapping[str, int]
    message: str
    form: str
    setups: tuple[float, ...]
    solves: tuple[float, ...]
    times: tuple[float, ...]
    calibration_time: float | None
    backend_time: float | None = None
    residual_per_repeat: tuple[float, ...] = ()
    status_conflict: str = ""


def measure_task(problem: Problem, task: Task, impulse: Any = None) -> tuple[Record, FloatArray | None]:
    """Make one measurement. An exception of the solver becomes a record of status ERROR.

    Parameters
    ----------
    problem : Problem
    task : Task
    impulse : (m,) N s, optional
        Start, for `start="carried"`. "cold" starts from Pi(0), "warm" from the problem's guess.

    Returns
    -------
    Record, and the final impulses (m,) [N s] or None

    Raises
    ------
    KeyboardInterrupt
        Ctrl-C was pressed; nothing is recorded.
    """
    return judge_outcome(problem, task, run_task_or_return_error(problem, task, impulse))


def run_task_or_return_error(problem: Problem, task: Task, impulse: Any = None) -> Outcome | str:
    """Run the solver of a task in this process. Return an exception as text."""
    runs: list[tuple[Solution, float]] = []  # Solution and time of each call.
    calibration_times: list[float] = []
    backend_times: list[float] = []
    guard: Solution | None = None
    try:
        _import_solver_code(task.solver)
        with _stabilise_timing(task.solver):
            start_time = perf_counter()
            if task.timing_mode and task.guarded:
                # A plug-in may not test convergence and would then use all iterations: run it with its default limit
                # first.
                tests = registry.get(task.solver).builtin or task.mode != "tol"
                guard = raise_if_interrupted(
                    _prepare_and_solve(problem, task if tests else replace(task, max_iter=0), impulse)
                )
                if not tests and _ended_by_budget(guard, task):
                    guard = raise_if_interrupted(_prepare_and_solve(problem, task, impulse))
            remaining = max(1, task.repeats - (guard is not None))
            while remaining and (guard is None or guard.status is not Status.TIME_LIMIT):
                calibration_times.append(measure_calibration_time())
                if not task.timing_mode:
                    parts = raise_if_interrupted(_prepare_and_solve(problem, task, impulse))
                    runs.append((parts, parts.setup_time + parts.solve_time))
                else:
                    with measure_backend_time(task.solver) as time_in_backend:
                        runs.append(_time_call(problem, task, impulse, guard))
                    backend_times += [sum(time_in_backend)] if time_in_backend else []
                # A quick call that alternates with others is made twice: the first fills the caches, as in a
                # simulator.
                if task.interleave_group:
                    remaining, runs = (
                        remaining if perf_counter() - start_time < MAX_WARM_UP_TIME else 1,
                        runs[-1:],
                    )
                remaining -= 1
                if runs[-1][0].status is Status.TIME_LIMIT or perf_counter() - start_time > task.time_limit:
                    remaining = 0 if task.mode != "time" else remaining
            solution = runs[-1][0] if runs else guard
            if guard is None and task.timing_mode and _ended_by_budget(solution, task):
                # The solve needs more iterations than the solver's default limit: repeat it with a guarded solve.
                return run_task_or_return_error(problem, replace(task, guarded=True), impulse)
    except Exception as error:
        # A backend may raise any exception; only its own record is lost.
        return f"{type(error).__name__}: {error}".strip()
    assert solution is not None  # At least one repeat was made.
    repeats = [s for s, _ in runs] or [solution]
    outcome = make_outcome(
        solution, repeats, [t for _, t in runs], min(calibration_times, default=None), task.mode == "time"
    )
    return replace(outcome, backend_time=min(backend_times, default=None))


def make_outcome(
    solution: Solution,
    repeats: list[Solution],
    times: list[float],
    calibration_time: float | None,
    keeps_residuals: bool = False,
) -> Outcome:
    """Create the outcome of the repeats, the last of which is `solution`."""
    return Outcome(
        impulse=solution.impulse,
        certificate=solution.certificate,
        status=solution.status.name,
        iterations=solution.iterations,
        work=solution.work,
        message=solution.message,
        form=solution.solver.form,
        status_conflict=solution.status_conflict[:500],
        setups=tuple(s.setup_time for s in repeats),
        solves=tuple(s.solve_time for s in repeats),
        times=tuple(times),
        calibration_time=calibration_time,
        residual_per_repeat=tuple(float(s.residual.relative) for s in repeats) if keeps_residuals else (),
    )


def _ended_by_budget(solution: Solution | None, task: Task) -> bool:
    """Whether a run to a tolerance ended at the iteration limit of its task."""
    assert solution is not None
    return (
        task.mode == "tol"
        and not task.interleave_group
        and task.max_iter > 0
        and solution.status is Status.MAX_ITERATIONS
    )


_LOOP_NUMBERS = np.arange(2.0**15)  # 256 KiB: more than a first-level cache holds


def measure_calibration_time() -> float:
    """Return the time [s] of a loop of fixed work, which measures the machine's current speed and fills the caches."""
    start_time = perf_counter()
    total = 0.0
    for i in range(500):
        total += 0.5 * i
    for _ in range(4):
        total += float(_LOOP_NUMBERS.sum())
    return perf_counter() - start_time


def copy_problem_into_new_arrays(problem: Problem, start: str) -> Problem:
    """Copy the problem into newly written arrays, with nothing derived from them, as a simulator leaves it.

    With `start` "cold", the copy has no guess, as in the printed call.
    """
    rows = None if problem.rows is None else replace(problem.rows, copy=True)
    return replace(problem, rows=rows, guess=None if start == "cold" else problem.guess, copy=True)


def _time_call(problem: Problem, task: Task, impulse: Any, guard: Solution | None) -> tuple[Solution, float]:
    """Make the call once and return its solution and time [s]."""
    arguments = {**task.options, **make_call_arguments(task, 0 if guard is None else guard.iterations)}
    fresh = copy_problem_into_new_arrays(problem, task.start)
    if task.start == "carried":
        arguments["impulse"] = problem.start() if impulse is None else impulse
    start_time = perf_counter()
    solution = solve(fresh, task.solver, **arguments)
    return raise_if_interrupted(solution), perf_counter() - start_time + task.lead


def judge_outcome(problem: Problem, task: Task, outcome: Outcome | str) -> tuple[Record, FloatArray | None]:
    """Judge an outcome on `problem`; return its record, and its impulses (m,) [N s] if they are finite."""
    if isinstance(outcome, str):
        return task.make_record(status=ERROR, message=outcome[:500]), None
    solution = make_solution(problem, task, outcome)
    impulse = solution.impulse if np.isfinite(solution.impulse).all() else None
    return make_record(task, solution, outcome), impulse


def make_solution(problem: Problem, task: Task, outcome: Outcome) -> Solution:
    """Judge an outcome on `problem` and return its solution."""
    claim = Claim(
        Status[outcome.status],
        outcome.iterations,
        outcome.work,
        outcome.message,
        outcome.form,
        certificate=outcome.certificate,
    )
    return finish(
        FinishedRun(
            problem,
            registry.get(task.solver),
            dict(task.options),
            np.array(outcome.impulse),
            claim,
            tol=task.tol,
            setup_time=outcome.setups[-1],
            solve_time=outcome.solves[-1],
            refutation=outcome.status_conflict.removeprefix("says INFEASIBLE, "),
        )
    )


def _prepare_and_solve(problem: Problem, task: Task, impulse: Any) -> Solution:
    """Prepare and solve a task under its time limit."""
    fresh = replace(problem, copy=False)  # Nothing is derived yet: forming A is part of the set-up.
    arguments: dict[str, Any] = {"isolate": False} if "isolate" in registry.get(task.solver).accepts else {}
    # The runner has placed third-party solvers in a separate process already.
    prepared = prepare(fresh, task.solver, **{**arguments, **task.options})
    get_zero_impulse_reference(fresh)  # The judge's reference energies are computed before the clocks start.
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


def make_record(task: Task, s: Solution, outcome: Outcome) -> Record:
    """Return the record of a measurement; its last repeat returned the solution `s`."""
    setups, solves = outcome.setups, outcome.solves
    times = outcome.times or [a + b for a, b in zip(setups, solves, strict=True)]
    r = s.residual
    return task.make_record(
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
        claims=s.status in CLAIM_STATUSES,
        iterations=int(s.iterations),
        work={k: int(v) for k, v in s.work.items()},
        form=s.solver.form,
        message=s.message[:500],
        repeats=len(times),
        setup_min=min(setups),
        setup_median=statistics.median(setups),
        solve_min=min(solves),
        solve_median=statistics.median(solves),
        time_min=min(times),
        time_median=statistics.median(times),
        times=outcome.times if task.timing_mode else (),
        residual_per_repeat=outcome.residual_per_repeat,
        calibration_time=outcome.calibration_time,
        load=machine.count_runnable_processes(),
        backend_time_min=outcome.backend_time,
    )
