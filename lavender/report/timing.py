"""Time solves. No other module does.

The timed call is the one that a report prints, `lv.solve(problem, "name", tol=...)`, including the judge. The arrays
of its problem are newly written, as by a simulator, and other work has used the processor's caches since. The first
call has the time limit; if it ends and is quick, it is repeated. BLAS and OpenMP use one thread, and the garbage
collector is off.
"""

from __future__ import annotations

import gc
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
from lavender.external.backends import explain_contradicted_claim
from lavender.judge.solution import CONTRADICTED, Claim, Solution, Status, raise_if_interrupted
from lavender.problem import Problem
from lavender.report import machine
from lavender.report.records import ERROR, CaseInfo, Record, format_tolerance, make_measurement_key
from lavender.solvers import registry
from lavender.solving.finish import FinishedRun, finish
from lavender.solving.prepared import prepare
from lavender.solving.solve import solve

LONG_TIME = 0.05  # [s] A call that took longer is not repeated: caches and the clock hardly affect its time.
CLAIM_STATUSES = (Status.CONVERGED, Status.ROUNDOFF_LIMIT, Status.INFEASIBLE)
# Line that removes a guess from a problem.
COLD_PROBLEM = "problem = dataclasses.replace(problem, guess=None)"
CARRIED_START = (
    "before, impulse = problems[0], problems[0].start()",
    "for problem in problems:",
    "    start = lv.report.carry_impulses(before, impulse, problem)",
)


@dataclass(frozen=True)
class Task:
    """One measurement of a solver on a case.

    If `guarded` is true, the first call has the time limit; without it no call has. `lead` [s] is the time that was
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
    order: str = "given"
    options: Mapping[str, Any] = field(default_factory=dict)
    repeats: int = 1
    step: int = -1
    guarded: bool = True
    lead: float = 0.0

    @property
    def key(self) -> tuple[Any, ...]:
        """The `Record.key` of the measurement."""
        return make_measurement_key(self)

    @classmethod
    def of_case(
        cls, info: CaseInfo, solver: str, mode: str, tol: float, max_iter: int, start: str, limit: float,
        repeats: int = 1, order: str = "given",
    ) -> Task:  # fmt: skip
        """Create the task of a solver on a case."""
        return cls(
            info.run, info.case, info.sha, solver, mode, tol, max_iter, limit, start, order, repeats=repeats,
            step=info.step,
        )  # fmt: skip

    @classmethod
    def of_record(cls, record: Record, time_limit: float) -> Task:
        """Create the task that measures the run of a record once more."""
        shared = {name: getattr(record, name) for name in _SHARED}
        return cls(**{**shared, "time_limit": time_limit})

    @property
    def arguments(self) -> dict[str, Any]:
        """Keyword arguments of the call: options, sweep order, tolerance, and largest number of iterations."""
        name, _, seed = self.order.partition(":")
        order: dict[str, Any] = {} if name == "given" else {"order": name}
        order |= {"seed": int(seed)} if seed else {}
        return {**self.options, **order, "tol": self.tol, "max_iter": self.max_iter or None}

    def make_record(self, **results: Any) -> Record:
        """Create a record of this task with `results`."""
        return Record(**{name: getattr(self, name) for name in _SHARED}, **results)


_SHARED = {f.name for f in fields(Task)} & {f.name for f in fields(Record)}


def format_call(record: Any, guessed: bool = False) -> tuple[str, ...]:
    """Return the lines of Python with which a record, or a row of a frame, was measured.

    If `guessed` is true, some problems have a guess, and a line before a cold start removes it.
    """
    short = format_tolerance(record.tol)
    text = f"tol={short if float(short) == record.tol else repr(record.tol)}"
    spec = registry.specs().get(record.solver)
    if record.mode == "budget" or (spec is not None and record.iterations > spec.max_iter):
        text += f", max_iter={record.max_iter}"
    if record.start != "carried":
        cold = (COLD_PROBLEM,) if guessed and record.start == "cold" else ()
        return (*cold, f'lv.solve(problem, "{record.solver}", {text})')
    call = f'    solution = lv.solve(problem, "{record.solver}", impulse=start, {text})'
    return (*CARRIED_START, call, "    before, impulse = problem, solution.impulse")


@cache
def _import_solver_code(solver: str) -> None:
    """Import the code that a solver needs and solve one row, so that no measurement includes imports."""
    spec = registry.get(solver)
    spec.load()
    if spec.builtin or spec.requires:
        with suppress(Exception):
            make = Problem.lcp if "lcp" in spec.laws else Problem.linear
            prepare(make(np.eye(1), np.ones(1)), solver).solve()


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
    """Result of the repeats of one measurement, before it is judged."""

    impulse: FloatArray  # (m,) [N s]
    certificate: FloatArray | None  # (m,) Certificate of infeasibility, if the status is INFEASIBLE.
    status: str
    iterations: int
    work: Mapping[str, int]
    message: str
    form: str
    setup_time: float  # [s] Of the last repeat.
    solve_time: float
    times: tuple[float, ...]  # [s] Time of the call of each repeat.
    calibration_time: float | None
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
    times: list[float] = []
    calibration_times: list[float] = []
    try:
        _import_solver_code(task.solver)
        with _stabilise_timing(task.solver):
            begun = perf_counter()
            while not times or len(times) < task.repeats:
                calibration_times.append(measure_calibration_time())
                solution, elapsed = _time_call(problem, task, impulse, limited=task.guarded and not times)
                times.append(elapsed)
                if (
                    solution.status is Status.TIME_LIMIT
                    or elapsed > LONG_TIME
                    or perf_counter() - begun > task.time_limit
                ):
                    break
    except Exception as error:
        # A backend may raise any exception; only its own record is lost.
        return f"{type(error).__name__}: {error}".strip()
    shared = {name: getattr(solution, name) for name in _OF_SOLUTION}
    return Outcome(
        **shared, status=solution.status.name, form=solution.solver.form, times=tuple(times),
        calibration_time=min(calibration_times), status_conflict=solution.status_conflict[:500],
    )  # fmt: skip


#: Fields of an outcome that are attributes of a solution.
_OF_SOLUTION = ("impulse", "certificate", "iterations", "work", "message", "setup_time", "solve_time")

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


def _time_call(problem: Problem, task: Task, impulse: Any, limited: bool) -> tuple[Solution, float]:
    """Make the call once, with the time limit if `limited`, and return its solution and time [s].

    A plug-in may not test convergence and would then use all iterations: it runs with its default limit first.
    """
    spec, arguments = registry.get(task.solver), task.arguments
    if limited:
        arguments["time_limit"] = task.time_limit
        if (
            "isolate" in spec.accepts
        ):  # The runner has placed third-party solvers in a separate process already.
            arguments.setdefault("isolate", False)
    if task.start == "carried":
        arguments["impulse"] = problem.start() if impulse is None else impulse
    limits = [None] if task.mode == "tol" and not spec.builtin and task.max_iter else []
    for max_iter in (*limits, task.max_iter or None):
        fresh = copy_problem_into_new_arrays(problem, task.start)
        start_time = perf_counter()
        solution = solve(fresh, task.solver, **{**arguments, "max_iter": max_iter})
        elapsed = perf_counter() - start_time + task.lead
        if raise_if_interrupted(solution).status is not Status.MAX_ITERATIONS:
            break
    return solution, elapsed


def judge_outcome(problem: Problem, task: Task, outcome: Outcome | str) -> tuple[Record, FloatArray | None]:
    """Judge an outcome on `problem`; return its record, and its impulses (m,) [N s] if they are finite."""
    if isinstance(outcome, str):
        return task.make_record(status=ERROR, message=outcome[:500]), None
    solution = make_solution(problem, task, outcome)
    impulse = solution.impulse if np.isfinite(solution.impulse).all() else None
    return make_record(problem, task, solution, outcome), impulse


def make_solution(problem: Problem, task: Task, outcome: Outcome) -> Solution:
    """Judge an outcome on `problem` and return its solution."""
    claim = Claim(
        Status[outcome.status], outcome.iterations, outcome.work, outcome.message, outcome.form,
        certificate=outcome.certificate,
    )  # fmt: skip
    run = FinishedRun(
        problem, registry.get(task.solver), dict(task.options), np.array(outcome.impulse), claim, tol=task.tol,
        setup_time=outcome.setup_time, solve_time=outcome.solve_time,
        refutation=outcome.status_conflict.removeprefix("says INFEASIBLE, "),
    )  # fmt: skip
    return finish(run)


def make_record(problem: Problem, task: Task, s: Solution, outcome: Outcome) -> Record:
    """Return the record of a measurement; its last repeat returned the solution `s`."""
    r = s.residual
    is_false = s.claim_check == CONTRADICTED
    observed = explain_contradicted_claim(task.solver, problem, s.status) if is_false else ""
    return task.make_record(
        status=s.status.name, relative=float(r.relative), energy=float(r.energy), velocity=float(r.velocity),
        roundoff_floor=float(r.roundoff_floor), worst_row=int(r.worst_row), worst_name=r.worst_name,
        success=bool(s.success) and task.mode == "tol", claim_check=s.claim_check,
        status_conflict="; ".join(filter(None, (s.status_conflict, observed))),
        claims=s.status in CLAIM_STATUSES, iterations=int(s.iterations), work={k: int(v) for k, v in s.work.items()},
        form=s.solver.form, message=s.message[:500], times=outcome.times, setup_time=outcome.setup_time,
        solve_time=outcome.solve_time, calibration_time=outcome.calibration_time,
        load=machine.count_runnable_processes(),
    )  # fmt: skip
