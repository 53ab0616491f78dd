"""Time solves, and define the plan of a run: tolerances, budgets and starts. No other module times solves.

The timed call is the one that a report prints, `lv.solve(problem, "name", tol=...)`, of a quadratic program
`lv.solve_qp(problem, "name", tol=...)`, including the judge. The arrays of its problem are newly written, as by a
simulator, and other work has used the processor's caches since. The first call has the time limit; if it ends and is
quick, it is repeated. BLAS and OpenMP use one thread, and the garbage collector is off.
"""

from __future__ import annotations

import gc
import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from statistics import median
from time import perf_counter
from typing import Any, TypeAlias

import numpy as np

from lavender.base.arrays import FloatArray, check_bool, check_float, check_int, check_sequence
from lavender.base.deadline import Deadline
from lavender.base.errors import InputError, require_packages
from lavender.base.lazy_import import import_numerical_modules
from lavender.judge.solution import CONTRADICTED, Solution, Status, raise_if_interrupted
from lavender.problem import Problem
from lavender.programs.backends import explain_contradicted_claim
from lavender.report import machine
from lavender.report.case_kinds import ContactCase, ProgramCase, make_case
from lavender.report.store import ERROR, RUN_COLUMNS, Row
from lavender.report.text import format_tolerance
from lavender.solvers import registry
from lavender.solvers.registry import SolverSpec, program_backends
from lavender.solving.limits import import_before_limit

DEFAULT_SEQUENCE_TIME_LIMIT = 5.0  # [s] Time limit of one pass over a sequence.
UNLIMITED_ITERATIONS = (
    10_000_000  # Iteration limit of a run to a tolerance; the time limit ends it first.
)
HANG_LIMIT = 60.0  # [s] Time limit of a solver of another package in a campaign.
LONG_TIME = 0.05  # [s] A call that took longer is not repeated: caches and the clock hardly affect its time.
Target: TypeAlias = tuple[str, float, int, str]  # Mode, tol, max_iter and start of a run.
CLAIM_STATUSES = (Status.CONVERGED, Status.ROUNDOFF_LIMIT, Status.INFEASIBLE)
# A run that missed its tolerance with one of these reaches no tighter tolerance either.
HOPELESS_STATUSES = ("TIME_LIMIT", "ERROR", "INFEASIBLE")
# Line that removes a guess from a problem.
COLD_PROBLEM = "problem = dataclasses.replace(problem, guess=None)"
CARRIED_START = (
    "before, impulse = problems[0], problems[0].start()",
    "for problem in problems:",
    "    start = lv.report.carry_impulses(before, impulse, problem)",
)


def make_task(
    case: Row, solver: str, mode: str, tol: float, max_iter: int, start: str, time_limit: float
) -> Row:
    """Return the row of a measurement of a solver on a case before it is made."""
    own = {name: case[name] for name in ("run", "case", "sha", "step")}
    target = {"solver": solver, "mode": mode, "tol": tol, "max_iter": max_iter, "start": start}
    return {"kind": "run"} | RUN_COLUMNS | own | target | {"time_limit": time_limit}


def add_times(row: Row, times: Sequence[float]) -> Row:
    """Return a row with the times [s] of its repetitions, their minimum, median and number."""
    middle = median(times) if times else math.nan
    return {
        **row,
        "times": list(times),
        "time": min(times, default=math.nan),
        "time_median": middle,
        "repetitions": len(times),
    }


def format_call(record: Any, guessed: bool = False) -> tuple[str, ...]:
    """Return the lines of Python with which a record, or a row of a frame, was measured.

    If `guessed` is true, some problems have a guess, and a line before a cold start removes it.
    """
    short = format_tolerance(record.tol)
    text = f"tol={short if float(short) == record.tol else repr(record.tol)}"
    spec = registry.specs().get(record.solver)
    if record.mode == "budget" or (spec is not None and record.iterations > spec.max_iter):
        text += f", max_iter={record.max_iter}"
    call = ProgramCase.call if getattr(record, "law", "") == "program" else ContactCase.call
    if record.start != "carried":
        cold = (COLD_PROBLEM,) if guessed and record.start == "cold" else ()
        return (*cold, f'lv.{call}(problem, "{record.solver}", {text})')
    call = f'    solution = lv.{call}(problem, "{record.solver}", impulse=start, {text})'
    return (*CARRIED_START, call, "    before, impulse = problem, solution.impulse")


@cache
def _import_solver_code(solver: str, call: str) -> None:
    """Make a call with one row, with and without a time limit, so that no measurement includes imports."""
    spec = registry.get(solver)
    import_before_limit(spec, Deadline(1.0))
    if not (spec.builtin or spec.requires):
        return
    if call == "solve":
        tiny = (Problem.lcp if "lcp" in spec.laws else Problem.linear)(np.eye(1), np.ones(1))
    else:
        # The adapter of programs uses these modules.
        import_numerical_modules("scipy.sparse.linalg", "scipy.optimize")
        tiny = Problem.from_qp(np.eye(1), np.ones(1), lb=np.zeros(1))
        if spec.delegates:
            for backend in program_backends():
                _import_solver_code(backend.name, call)
    for limit in (None, 1.0):
        with suppress(Exception):
            make_case(tiny).solve(solver, time_limit=limit)


def _start_workers(case: ContactCase, solver: str) -> None:
    """Start the processes that a call with a time limit uses: a process was ended if its call exceeded the limit."""
    spec = registry.get(solver)
    if spec.delegates and case.problem.qp is not None:
        solvers = [backend.load()() for backend in program_backends()]
    else:
        solvers = [spec.load()()] if spec.external and spec.builtin else []
    for backend in solvers:
        backend.start_workers(None, 0.0)


@cache
def _get_thread_pools(code: tuple[str, ...]) -> Any:
    """Return the controller of the BLAS and OpenMP libraries that are loaded with a solver of this code."""
    # The search takes some 20 ms: do it once for each package, after its own libraries and SciPy's are loaded.
    require_packages("a timed measurement", "threadpoolctl")
    from threadpoolctl import ThreadpoolController

    import_numerical_modules()
    return ThreadpoolController()


@contextmanager
def limit_to_one_thread(solver: str = "") -> Iterator[None]:
    """Limit BLAS and OpenMP to one thread, including the libraries that are loaded when `solver` is imported."""
    spec = registry.specs().get(solver)
    code = () if spec is None else (*spec.requires, *(() if spec.builtin else (solver,)))
    with _get_thread_pools(code).limit(limits=1):
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


def measure_task(
    problem: Problem, task: Row, impulse: Any = None, repeats: int = 1, is_guarded: bool = True
) -> tuple[Row, FloatArray | None]:
    """Make one measurement; return its row and the final impulses (m,) [N s] or None.

    An exception of the solver becomes a row of status ERROR. `impulse` is the start for the start "carried"; "cold"
    starts from Pi(0), "warm" from the problem's guess. With `is_guarded`, the first of the repeated calls has the time
    limit; else no call has.
    """
    times: list[float] = []
    calibration_times: list[float] = []
    try:
        case = make_case(problem)
        _import_solver_code(task["solver"], case.call)
        with _stabilise_timing(task["solver"]):
            begun = perf_counter()
            while len(times) < repeats:
                calibration_times.append(measure_calibration_time())
                solution, elapsed = _time_call(
                    case, task, impulse, limited=is_guarded and not times
                )
                times.append(elapsed)
                late = elapsed > LONG_TIME or perf_counter() - begun > task["time_limit"]
                if late or solution.status is Status.TIME_LIMIT:
                    break
    except Exception as error:
        # A backend may raise any exception; only its own record is lost.
        message = f"{type(error).__name__}: {error}".strip()[:500]
        return add_times(task | {"status": ERROR, "message": message}, ()), None
    row = add_times(
        make_row(problem, task, solution) | {"calibration_time": min(calibration_times)}, times
    )
    return row, solution.impulse if np.isfinite(solution.impulse).all() else None


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


def _time_call(case: ContactCase, task: Row, impulse: Any, limited: bool) -> tuple[Solution, float]:
    """Make the call once, with the time limit if `limited`, and return its solution and time [s].

    A plug-in may not test convergence and would then use all iterations: it runs with its default limit first.
    """
    solver = task["solver"]
    largest = task["max_iter"] or None
    arguments = {"tol": task["tol"]}
    if limited:
        arguments["time_limit"] = task["time_limit"]
        _start_workers(case, solver)
    if task["start"] == "carried":
        arguments["impulse"] = case.problem.start() if impulse is None else impulse
    limits = (
        [None] if task["mode"] == "tol" and not registry.get(solver).builtin and largest else []
    )
    for max_iter in (*limits, largest):
        fresh = case.copy(task["start"])
        start_time = perf_counter()
        solution = fresh.solve(solver, **arguments, max_iter=max_iter)
        elapsed = perf_counter() - start_time
        if raise_if_interrupted(solution).status is not Status.MAX_ITERATIONS:
            break
    return solution, elapsed


def make_row(problem: Problem, task: Row, s: Solution) -> Row:
    """Return the row of a measurement that returned the solution `s`, without times of calls."""
    is_false = s.claim_check == CONTRADICTED
    observed = explain_contradicted_claim(task["solver"], problem, s.status) if is_false else ""
    results = {
        "status": s.status.name,
        "success": bool(s.success) and task["mode"] == "tol",
        "claim_check": s.claim_check,
        "status_conflict": "; ".join(filter(None, (s.status_conflict, observed))),
        "claims": s.status in CLAIM_STATUSES,
        "iterations": int(s.iterations),
        "work": json.dumps({k: int(v) for k, v in s.work.items()}),
        "form": s.solver.form,
        "message": s.message[:500],
        "setup_time": s.setup_time,
        "solve_time": s.solve_time,
        "load": machine.count_runnable_processes(),
    }
    return task | results | make_case(problem).judge(s)


# -- plans -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Plan:
    """Parameters of the runs of each solver on each case.

    Raises
    ------
    InputError
        A tolerance, budget, count or limit is not positive.
    """

    # Relative residuals to reach, each by a solve with this `tol`.
    tolerances: Sequence[float] = (1e-3, 1e-6, 1e-9)
    # Exact iteration counts (`tol=0`), for solvers that can stop after any iteration.
    budgets: Sequence[int] = (4, 8, 16, 32, 64)
    # Each kind of solve runs so many times, and the minimum and median are recorded. A solve of more than 50 ms is not
    # repeated, and steps of sequences of more than twenty steps are solved once.
    repeats: int = 3
    time_limit: float = 1.0  # [s] Limit of one solve.
    # [s] Limit of one solver over all steps of a sequence at one budget or tolerance. The remaining steps are not
    # solved, and a note is recorded.
    sequence_time_limit: float = DEFAULT_SEQUENCE_TIME_LIMIT
    warm: bool = True  # Whether to start also from the problem's guess, unless it is an answer.
    campaign: bool = False  # Whether no times are measured; see `CampaignPlan`.
    cap: int = UNLIMITED_ITERATIONS  # Largest number of iterations of a run to a tolerance.

    def __post_init__(self) -> None:
        tolerances = [
            check_float("tolerance", x, above=0.0)
            for x in check_sequence("tolerances", self.tolerances, "numbers")
        ]
        budgets = [
            check_int("budget", n, 1) for n in check_sequence("budgets", self.budgets, "numbers")
        ]
        if not tolerances and not budgets:
            raise InputError(
                "without tolerances and budgets there is nothing to run: give one of the two"
            )
        # Remove duplicates: a value given twice would be run twice and change the middle value.
        object.__setattr__(self, "tolerances", tuple(sorted(set(tolerances), reverse=True)))
        object.__setattr__(self, "budgets", tuple(sorted(set(budgets))))
        for name in ("repeats", "cap"):
            check_int(name, getattr(self, name), 1)
        for name in ("time_limit", "sequence_time_limit"):
            check_float(name, getattr(self, name), above=0.0)
        for name in ("warm", "campaign"):
            check_bool(name, getattr(self, name))

    def measure_solver(
        self, case: Row, spec: SolverSpec, make: Callable[[Target, int], Row]
    ) -> None:
        """Measure one solver on one case; each row decides the next measurement.

        Runs to a tolerance come first. An exact solver runs once, at the tightest tolerance; other solvers run at each
        tolerance, the loosest first. After a missed tolerance, a resumable solver does not run at tighter tolerances,
        since its iterates would be the same, nor does a solver that ran out of time. Then follow runs with fixed
        budgets, which are timed once.
        """
        starts = ["cold"]
        if self.warm and case["guess"] == "start" and spec.impulse and not spec.exact:
            starts.append("warm")
        max_iterations = self.cap if spec.resumable else 0
        for start in starts:
            for tolerance in self.tolerances[-1:] if spec.exact else self.tolerances:
                row = make(("tol", tolerance, max_iterations, start), self.repeats)
                is_last = spec.resumable or str(row["status"]).startswith(HOPELESS_STATUSES)
                if is_last and not row["relative"] <= tolerance:
                    break
            if spec.resumable and not spec.exact:
                for n in self.budgets:
                    make(("budget", 0.0, n, start), 1)


@dataclass(frozen=True)
class CampaignPlan(Plan):
    """Parameters of runs without times, which end after a number of iterations and not by the clock.

    Its records do not depend on the machine's load or the number of workers.

    `time_limit` applies to solvers of other packages; only their own records depend on it.
    """

    repeats: int = 1
    time_limit: float = HANG_LIMIT
    campaign: bool = True
    cap: int = 20_000


def list_passes(plan: Plan, spec: SolverSpec) -> list[Target]:
    """Return the target of each pass over a sequence, cold and with carried impulses."""
    max_iterations = UNLIMITED_ITERATIONS if spec.resumable else 0
    tolerances = plan.tolerances[-1:] if spec.exact else plan.tolerances
    targets = [("tol", tolerance, max_iterations) for tolerance in tolerances]
    if spec.resumable and not spec.exact:
        targets = [*(("budget", 0.0, n) for n in plan.budgets), *targets]
    starts = ("cold", "carried") if spec.impulse and not spec.exact else ("cold",)
    return [(*target, start) for start in starts for target in targets]
