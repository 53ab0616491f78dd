"""Define what is measured: levels, budgets, starts and orders, and the sequence of measurements of a solver."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

from lavender.base.arrays import check_bool, check_float, check_int, check_sequence
from lavender.base.errors import InputError, UnknownName
from lavender.lab.bench.record import CaseInfo, Record
from lavender.lab.bench.running.timing import Ask, Task
from lavender.problem import Problem
from lavender.problem.ordering import SWEEP_ORDERS
from lavender.solvers.registry import SolverSpec

# A motion error is reached by solves to tighter and tighter residuals: the first, the last, and their maximum number.
FIRST_TOL, LAST_TOL, MAX_SPEED_TRIES = 1e-2, 1e-13, 6
PASS_LIMIT = 5.0  # s, of one pass over a sequence.
UNLIMITED = 10_000_000  # Iterations of a run to a tolerance: the time limit ends it first.
HANG_LIMIT = (
    60.0  # s, after which a campaign kills the process of another package's solver and records KILLED
)


@dataclass(frozen=True)
class Plan:
    """How each solver is run on each case.

    Parameters
    ----------
    levels : relative residuals to reach, each a solve with that `tol`
    budgets : exact iteration counts (`tol=0`), for solvers that can stop anywhere
    repeats : solves of each kind; minimum and median are recorded. Repeats end early once they have
        taken `time_limit` together. Steps of a sequence of more than twenty are solved once.
    time_limit : s, of one solve
    pass_limit : s, of one solver over all steps of a sequence at one budget or level. The steps that are left over are
        not solved, and a note says so.
    warm : also start from the problem's guess, where it has one that is no answer already
    orders : sweep orders beside "given", each at the middle budget, for solvers that take an order;
        "random:3" is random with seed 3
    motion : measure the motion error, from a reference that is solved once for each case
    prove : compare motions with an exact solution where one is enclosed (`lavender.prove`); implies `motion`. A claim
        that is further from it than the claim's own residual allows is contradicted
    speed_levels : m/s, motion errors to reach; implies `motion`. Each solver is asked for the residual that takes it
        there: again and tighter while it misses, at most `MAX_SPEED_TRIES` times a level
    times : s, in which the report is asked to name a solver
    sweeps : of `budgets`, those with which the report is asked to name one

    Raises
    ------
    InputError
        A level, budget, count or limit that is not positive, a senseless seed.
    UnknownName
        An order that does not exist.
    """

    levels: Sequence[float] = (1e-3, 1e-6, 1e-9)
    budgets: Sequence[int] = (4, 8, 16, 32, 64)
    repeats: int = 3
    time_limit: float = 1.0
    pass_limit: float = PASS_LIMIT
    warm: bool = True
    orders: Sequence[str] = ("reverse", "symmetric", "random:0", "random:1", "random:2")
    campaign: bool = False
    motion: bool = False
    prove: bool = False
    speed_levels: Sequence[float] = ()
    times: Sequence[float] = ()
    sweeps: Sequence[int] = ()

    def __post_init__(self) -> None:
        for name in ("levels", "budgets", "orders", "speed_levels", "times", "sweeps"):
            given = check_sequence(name, getattr(self, name), "words" if name == "orders" else "numbers")
            object.__setattr__(self, name, tuple(given))
        for name, values in (
            ("level", self.levels),
            ("speed level", self.speed_levels),
            ("time budget", self.times),
        ):
            for value in values:
                check_float(name, value, above=0.0)
        if not self.levels and not self.budgets:
            raise InputError("nothing to run: give levels, budgets or both")
        check_int("repeats", self.repeats, 1)
        check_float("time_limit", self.time_limit, above=0.0)
        check_float("pass_limit", self.pass_limit, above=0.0)
        for name in ("warm", "campaign", "motion", "prove"):
            check_bool(name, getattr(self, name))
        for word in self.orders:
            name, _, seed = str(word).partition(":")
            if name not in SWEEP_ORDERS:
                raise UnknownName("order", name, SWEEP_ORDERS)
            if seed and not (name == "random" and seed.isdecimal()):
                raise InputError(f"order {word!r}: only random takes a seed, a whole number: random:3")
        # each once: what stands twice would be run twice, and move the middle
        for name in ("levels", "speed_levels"):
            object.__setattr__(
                self, name, tuple(sorted({float(x) for x in getattr(self, name)}, reverse=True))
            )
        for name in ("budgets", "sweeps"):
            counts = {check_int("budget", n, 1) for n in getattr(self, name)}
            object.__setattr__(self, name, tuple(sorted(counts)))
        object.__setattr__(self, "times", tuple(sorted({float(t) for t in self.times})))
        object.__setattr__(self, "orders", tuple(dict.fromkeys(self.orders)))
        object.__setattr__(self, "motion", self.motion or self.prove or bool(self.speed_levels))

    way = "call"  # what of a single problem is timed, as `Record.way`

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

        To a tolerance: an exact solver once, at the tightest level. Others level by level; one that can
        be resumed, or that ran out of time, is not asked for a tighter level than the one it missed: the
        iterates would be the same. Then budgets, then sweep orders at the middle budget.
        """

        def one(mode: str, tol: float, max_iter: int, start: str, **options: Any) -> Record:
            ask = Ask(spec.name, mode, tol, max_iter, start=start, way="" if options else self.way)
            more = {"options": options, "repeats": self.repeats, "time_limit": self.time_limit}
            return make(Task.of(info, ask, **more))

        starts = ["cold"]
        if self.warm and info.guess == "start" and spec.impulse and not spec.exact:
            starts.append("warm")
        most = self.iteration_limit() if spec.resumable else 0
        for start in starts:
            for level in self.levels[-1:] if spec.exact else self.levels:
                record = one("tol", level, most, start)
                if not record.relative <= level and (spec.resumable or _rules_out_tighter_levels(record)):
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
        """Solve to each speed level. The ratio of motion error to residual is taken from the previous solve."""
        tol = FIRST_TOL
        last: Record | None = None
        for level in self.speed_levels:
            for _ in range(MAX_SPEED_TRIES):
                if last is not None:
                    speed = math.inf if last.motion_speed is None else last.motion_speed
                    if speed <= level:
                        break
                    # Neither this level nor a tighter one: the residual was missed, or no motion error is known.
                    if not (last.relative <= tol and speed < math.inf) or tol <= LAST_TOL:
                        return
                    tol = max(LAST_TOL, min(0.3 * tol, 0.5 * last.relative * level / speed))
                last = solve_to(tol)


@dataclass(frozen=True)
class CampaignPlan(Plan):
    """How each solver is run without timing: runs end after a number of iterations, never by the clock.

    Its records do not depend on the machine's load or the number of workers.

    Parameters
    ----------
    cap : maximum number of iterations of a run to a level
    time_limit : s, after which the process of another package's solver is killed; only its own record depends on it
    """

    repeats: int = 1
    time_limit: float = HANG_LIMIT
    cap: int = 20_000
    campaign: bool = True
    way = ""  # nothing is timed

    def iteration_limit(self) -> int:
        """Return `cap`."""
        return self.cap


def list_passes(plan: Plan, spec: SolverSpec) -> list[Ask]:
    """Return the passes over a sequence: each budget and level, cold and carried."""
    most = UNLIMITED if spec.resumable else 0
    asked = [("tol", level, most) for level in (plan.levels[-1:] if spec.exact else plan.levels)]
    if spec.resumable and not spec.exact:
        asked = [*(("budget", 0.0, n) for n in plan.budgets), *asked]
    starts = ("cold", "carried") if spec.impulse and not spec.exact else ("cold",)
    return [Ask(spec.name, *what, way="steps", start=start) for start in starts for what in asked]


def _rules_out_tighter_levels(record: Record) -> bool:
    return record.status in ("TIME_LIMIT", "KILLED", "ERROR", "INFEASIBLE") or record.status.startswith(
        "CRASHED"
    )
