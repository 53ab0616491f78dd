"""Define the measurements of a run: tolerances, budgets, starts and orders, and their sequence for a solver."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from lavender.base.arrays import check_bool, check_float, check_int, check_sequence
from lavender.base.errors import InputError, UnknownName
from lavender.problem import Problem
from lavender.problem.ordering import SWEEP_ORDERS
from lavender.report.records import CaseInfo, Record
from lavender.report.timing import Task
from lavender.solvers.registry import SolverSpec

DEFAULT_SEQUENCE_TIME_LIMIT = 5.0  # [s] Time limit of one pass over a sequence.
UNLIMITED_ITERATIONS = 10_000_000  # Iteration limit of a run to a tolerance; the time limit ends it first.
# [s] After this time, a campaign kills the process of a third-party solver and records KILLED.
HANG_LIMIT = 60.0


@dataclass(frozen=True)
class Plan:
    """Parameters of the runs of each solver on each case.

    Parameters
    ----------
    tolerances : sequence of float
        Relative residuals to reach, each by a solve with this `tol`.
    budgets : sequence of int
        Exact iteration counts (`tol=0`), for solvers that can stop after any iteration.
    repeats : int
        Number of solves of each kind, of which minimum and median are recorded. A solve of more than 50 ms is not
        repeated, and steps of sequences of more than twenty steps are solved once. The fastest solvers of a case are
        then repeated alternately, until each has twice as many solves and one more.
    time_limit : float, s
        Limit of one solve.
    sequence_time_limit : float, s
        Limit of one solver over all steps of a sequence at one budget or tolerance. The remaining steps are not
        solved, and a note is recorded.
    warm : bool
        Also start from the problem's guess, unless it is an answer.
    orders : sequence of str
        Sweep orders in addition to "given", each at the middle budget, for solvers with a sweep order; "random:3" is
        random with seed 3.
    campaign : bool
        Measure no times; see `CampaignPlan`.
    cap : int
        Largest number of iterations of a run to a tolerance.

    Raises
    ------
    InputError
        A tolerance, budget, count or limit is not positive, or a seed is invalid.
    UnknownName
        An order does not exist.
    """

    tolerances: Sequence[float] = (1e-3, 1e-6, 1e-9)
    budgets: Sequence[int] = (4, 8, 16, 32, 64)
    repeats: int = 3
    time_limit: float = 1.0
    sequence_time_limit: float = DEFAULT_SEQUENCE_TIME_LIMIT
    warm: bool = True
    orders: Sequence[str] = ()
    campaign: bool = False
    cap: int = UNLIMITED_ITERATIONS

    def __post_init__(self) -> None:
        for name in ("tolerances", "budgets", "orders"):
            entries = check_sequence(name, getattr(self, name), "words" if name == "orders" else "numbers")
            object.__setattr__(self, name, tuple(entries))
        for value in self.tolerances:
            check_float("tolerance", value, above=0.0)
        if not self.tolerances and not self.budgets:
            raise InputError("without tolerances and budgets there is nothing to run: give one of the two")
        check_int("repeats", self.repeats, 1)
        check_int("cap", self.cap, 1)
        check_float("time_limit", self.time_limit, above=0.0)
        check_float("sequence_time_limit", self.sequence_time_limit, above=0.0)
        for name in ("warm", "campaign"):
            check_bool(name, getattr(self, name))
        for word in self.orders:
            name, _, seed = str(word).partition(":")
            if name not in SWEEP_ORDERS:
                raise UnknownName("order", name, SWEEP_ORDERS)
            if seed and not (name == "random" and seed.isdecimal()):
                raise InputError(
                    f"order {word!r} has an invalid seed {seed!r}; only the order random has a seed, an "
                    "integer: random:3"
                )
        # Remove duplicates: a value given twice would be run twice and change the middle value.
        unique: dict[str, Iterable[Any]] = {
            "tolerances": sorted({float(x) for x in self.tolerances}, reverse=True),
            "budgets": sorted({check_int("budget", n, 1) for n in self.budgets}),
            "orders": dict.fromkeys(self.orders),
        }
        for name, values in unique.items():
            object.__setattr__(self, name, tuple(values))

    def measure_solver(
        self, info: CaseInfo, problem: Problem, spec: SolverSpec, make: Callable[[Task], Record]
    ) -> None:
        """Measure one solver on one case; each record decides the next measurement.

        Runs to a tolerance come first. An exact solver runs once, at the tightest tolerance; other solvers run at each
        tolerance, the loosest first. After a missed tolerance, a resumable solver does not run at tighter tolerances,
        since its iterates would be the same, nor does a solver that ran out of time. Then follow runs with fixed
        budgets, then runs in other sweep orders at the middle budget.
        """

        def measure_one(mode: str, tol: float, max_iter: int, start: str, order: str = "given") -> Record:
            """Make one measurement; a fixed number of iterations is timed once."""
            repeats = 1 if mode == "budget" else self.repeats
            return make(
                Task.of_case(info, spec.name, mode, tol, max_iter, start, self.time_limit, repeats, order)
            )

        starts = ["cold"]
        if self.warm and info.guess == "start" and spec.impulse and not spec.exact:
            starts.append("warm")
        max_iterations = self.cap if spec.resumable else 0
        for start in starts:
            for tolerance in self.tolerances[-1:] if spec.exact else self.tolerances:
                record = measure_one("tol", tolerance, max_iterations, start)
                is_last = spec.resumable or _rules_out_tighter_tolerances(record)
                if is_last and not record.relative <= tolerance:
                    break
            if spec.resumable and not spec.exact:
                for n in self.budgets:
                    measure_one("budget", 0.0, n, start)
        if spec.order and self.budgets and not spec.exact:
            middle = self.budgets[len(self.budgets) // 2]
            for word in self.orders:
                if word in ("bottom_up", "top_down") and problem.rows is None:
                    continue  # Both orders sort blocks by the height of bodies, which are not known.
                measure_one("budget", 0.0, middle, "cold", word)


@dataclass(frozen=True)
class CampaignPlan(Plan):
    """Parameters of runs without times, which end after a number of iterations and not by the clock.

    Its records do not depend on the machine's load or the number of workers.

    After `time_limit` the process of a third-party solver is killed; only its own record depends on it.
    """

    repeats: int = 1
    time_limit: float = HANG_LIMIT
    campaign: bool = True
    cap: int = 20_000


def list_passes(plan: Plan, spec: SolverSpec) -> list[tuple[str, float, int, str]]:
    """Return (mode, tol, max_iter, start) of each pass over a sequence, cold and with carried impulses."""
    max_iterations = UNLIMITED_ITERATIONS if spec.resumable else 0
    tolerances = plan.tolerances[-1:] if spec.exact else plan.tolerances
    targets = [("tol", tolerance, max_iterations) for tolerance in tolerances]
    if spec.resumable and not spec.exact:
        targets = [*(("budget", 0.0, n) for n in plan.budgets), *targets]
    starts = ("cold", "carried") if spec.impulse and not spec.exact else ("cold",)
    return [(*target, start) for start in starts for target in targets]


def _rules_out_tighter_tolerances(record: Record) -> bool:
    """Whether a run that missed its tolerance shows that tighter tolerances cannot be reached either."""
    return record.status.startswith(("TIME_LIMIT", "KILLED", "ERROR", "INFEASIBLE", "CRASHED"))
