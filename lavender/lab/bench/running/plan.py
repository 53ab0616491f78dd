"""Define what is measured: tolerances, budgets, starts and orders, and the sequence of measurements of a solver."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

from lavender.base.arrays import check_bool, check_float, check_int, check_sequence
from lavender.base.errors import InputError, UnknownName, reject_former_names
from lavender.lab.bench.record import RENAMED_FIELDS, CaseInfo, Record
from lavender.lab.bench.running.timing import Ask, Task
from lavender.problem import Problem
from lavender.problem.ordering import SWEEP_ORDERS
from lavender.solvers.registry import SolverSpec

# A motion error is reached by solves to tighter and tighter residuals: the first, the last, and their maximum number.
FIRST_TOL, LAST_TOL, MAX_SPEED_TRIES = 1e-2, 1e-13, 6
SEQUENCE_TIME_LIMIT = 5.0  # s, of one pass over a sequence.
UNLIMITED = 10_000_000  # Iterations of a run to a tolerance: the time limit ends it first.
HANG_LIMIT = (
    60.0  # s, after which a campaign kills the process of another package's solver and records KILLED
)

FORMER_PLAN_FIELDS = {
    name.removeprefix("plan."): new for name, new in RENAMED_FIELDS.items() if name.startswith("plan.")
}


@reject_former_names(**FORMER_PLAN_FIELDS)
@dataclass(frozen=True)
class Plan:
    """How each solver is run on each case.

    Parameters
    ----------
    tolerances : relative residuals to reach, each a solve with that `tol`
    budgets : exact iteration counts (`tol=0`), for solvers that can stop anywhere
    repeats : solves of each kind; minimum and median are recorded. Repeats end early once they have
        taken `time_limit` together. Steps of a sequence of more than twenty are solved once.
    time_limit : s, of one solve
    sequence_time_limit : s, of one solver over all steps of a sequence with one budget or tolerance. The remaining
        steps are not solved, and a note says so.
    warm : also start from the problem's guess, where it has one that is no answer already
    orders : sweep orders beside "given", each at the middle budget, for solvers that take an order;
        "random:3" is random with seed 3
    motion : measure the motion error, from a reference that is solved once for each case
    prove : compare motions with an exact solution where one is enclosed (`lavender.prove`); implies `motion`. A claim
        that is further from it than the claim's own residual allows is contradicted
    velocity_tolerances : m/s, motion errors to reach; implies `motion`. Each solver is given the residual
        that is predicted to reach it, and a smaller one while it misses, at most `MAX_SPEED_TRIES` times
    times : s, in which the report is asked to name a solver
    sweeps : of `budgets`, those with which the report is asked to name one

    Raises
    ------
    InputError
        A tolerance, budget, count or limit that is not positive, a senseless seed.
    UnknownName
        An order that does not exist.
    """

    tolerances: Sequence[float] = (1e-3, 1e-6, 1e-9)
    budgets: Sequence[int] = (4, 8, 16, 32, 64)
    repeats: int = 3
    time_limit: float = 1.0
    sequence_time_limit: float = SEQUENCE_TIME_LIMIT
    warm: bool = True
    orders: Sequence[str] = ("reverse", "symmetric", "random:0", "random:1", "random:2")
    campaign: bool = False
    motion: bool = False
    prove: bool = False
    velocity_tolerances: Sequence[float] = ()
    times: Sequence[float] = ()
    sweeps: Sequence[int] = ()

    def __post_init__(self) -> None:
        for name in ("tolerances", "budgets", "orders", "velocity_tolerances", "times", "sweeps"):
            given = check_sequence(name, getattr(self, name), "words" if name == "orders" else "numbers")
            object.__setattr__(self, name, tuple(given))
        for name, values in (
            ("tolerance", self.tolerances),
            ("velocity tolerance", self.velocity_tolerances),
            ("time budget", self.times),
        ):
            for value in values:
                check_float(name, value, above=0.0)
        if not self.tolerances and not self.budgets:
            raise InputError("nothing to run: give tolerances, budgets or both")
        check_int("repeats", self.repeats, 1)
        check_float("time_limit", self.time_limit, above=0.0)
        check_float("sequence_time_limit", self.sequence_time_limit, above=0.0)
        for name in ("warm", "campaign", "motion", "prove"):
            check_bool(name, getattr(self, name))
        for word in self.orders:
            name, _, seed = str(word).partition(":")
            if name not in SWEEP_ORDERS:
                raise UnknownName("order", name, SWEEP_ORDERS)
            if seed and not (name == "random" and seed.isdecimal()):
                raise InputError(f"order {word!r}: only random takes a seed, a whole number: random:3")
        # each once: what stands twice would be run twice, and move the middle
        for name in ("tolerances", "velocity_tolerances"):
            object.__setattr__(
                self, name, tuple(sorted({float(x) for x in getattr(self, name)}, reverse=True))
            )
        for name in ("budgets", "sweeps"):
            counts = {check_int("budget", n, 1) for n in getattr(self, name)}
            object.__setattr__(self, name, tuple(sorted(counts)))
        object.__setattr__(self, "times", tuple(sorted({float(t) for t in self.times})))
        object.__setattr__(self, "orders", tuple(dict.fromkeys(self.orders)))
        object.__setattr__(self, "motion", self.motion or self.prove or bool(self.velocity_tolerances))

    timing_mode = "call"  # what of a single problem is timed, as `Record.timing_mode`

    def iteration_limit(self) -> int:
        """Return the maximum number of iterations of a run to a tolerance."""
        return UNLIMITED

    def as_dict(self) -> dict[str, Any]:
        """Return the fields, for the description of a run."""
        return asdict(self)

    def measure(
        self, info: CaseInfo, problem: Problem, spec: SolverSpec, make: Callable[[Task], Record]
    ) -> None:
        """Measure one solver on one case; each record decides which measurement follows.

        To a tolerance: an exact solver once, at the tightest tolerance; others at each tolerance, loosest first. A
        resumable solver, or one that ran out of time, gets no tighter tolerance than the one that it missed: the
        iterates would be the same. Then budgets, then sweep orders at the middle budget.
        """

        def one(mode: str, tol: float, max_iter: int, start: str, **options: Any) -> Record:
            ask = Ask(
                spec.name, mode, tol, max_iter, start=start, timing_mode="" if options else self.timing_mode
            )
            more = {"options": options, "repeats": self.repeats, "time_limit": self.time_limit}
            return make(Task.of(info, ask, **more))

        starts = ["cold"]
        if self.warm and info.guess == "start" and spec.impulse and not spec.exact:
            starts.append("warm")
        most = self.iteration_limit() if spec.resumable else 0
        for start in starts:
            for tolerance in self.tolerances[-1:] if spec.exact else self.tolerances:
                record = one("tol", tolerance, most, start)
                if not record.relative <= tolerance and (
                    spec.resumable or _rules_out_tighter_tolerances(record)
                ):
                    break
            if not spec.exact:
                self._to_speeds(partial(one, "tol", max_iter=most, start=start))
            if spec.resumable and not spec.exact:
                for n in self.budgets:
                    one("budget", 0.0, n, start)
        if spec.order and self.budgets and not spec.exact:
            middle = self.budgets[len(self.budgets) // 2]
            for word in self.orders:
                name, _, seed = word.partition(":")
                if name in ("bottom_up", "top_down") and problem.rows is None:
                    continue  # without bodies nobody knows the ground
                one("budget", 0.0, middle, "cold", order=name, **({"seed": int(seed)} if seed else {}))

    def _to_speeds(self, solve_to: Callable[[float], Record]) -> None:
        """Solve to each velocity tolerance. The ratio of motion error to residual is taken from the previous solve."""
        tol = FIRST_TOL
        last: Record | None = None
        for tolerance in self.velocity_tolerances:
            for _ in range(MAX_SPEED_TRIES):
                if last is not None:
                    speed = math.inf if last.motion_speed is None else last.motion_speed
                    if speed <= tolerance:
                        break
                    # Neither this tolerance nor a tighter one: the residual was missed, or no motion error is known.
                    if not (last.relative <= tol and speed < math.inf) or tol <= LAST_TOL:
                        return
                    tol = max(LAST_TOL, min(0.3 * tol, 0.5 * last.relative * tolerance / speed))
                last = solve_to(tol)


@reject_former_names(**FORMER_PLAN_FIELDS)
@dataclass(frozen=True)
class CampaignPlan(Plan):
    """How each solver is run without timing: runs end after a number of iterations, never by the clock.

    Its records do not depend on the machine's load or the number of workers.

    Parameters
    ----------
    cap : maximum number of iterations of a run to a tolerance
    time_limit : s, after which the process of another package's solver is killed; only its own record depends on it
    """

    repeats: int = 1
    time_limit: float = HANG_LIMIT
    cap: int = 20_000
    campaign: bool = True
    timing_mode = ""  # nothing is timed

    def iteration_limit(self) -> int:
        """Return `cap`."""
        return self.cap


def list_passes(plan: Plan, spec: SolverSpec) -> list[Ask]:
    """Return the passes over a sequence: each budget and tolerance, cold and carried."""
    most = UNLIMITED if spec.resumable else 0
    asked = [
        ("tol", tolerance, most) for tolerance in (plan.tolerances[-1:] if spec.exact else plan.tolerances)
    ]
    if spec.resumable and not spec.exact:
        asked = [*(("budget", 0.0, n) for n in plan.budgets), *asked]
    starts = ("cold", "carried") if spec.impulse and not spec.exact else ("cold",)
    return [Ask(spec.name, *what, timing_mode="steps", start=start) for start in starts for what in asked]


def _rules_out_tighter_tolerances(record: Record) -> bool:
    return record.status in ("TIME_LIMIT", "KILLED", "ERROR", "INFEASIBLE") or record.status.startswith(
        "CRASHED"
    )
