"""Solve small problems in one compiled call, and build the claim from its counts.

The call is used for few rows of bodies or of A and for small islands with friction (`lavender_ext/small/call.pyx`),
and for generalised coordinates if Newton's method is estimated to cost no more than other solvers
(`lavender_ext/batch/task.pxd`). The overhead of Python would exceed the time of such a solve. If the call does not
find a solution, it returns None, and the solver runs from the beginning as on any other problem.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from math import inf, nan
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.judge.residuals import get_zero_impulse_reference, judge_impulse
from lavender.judge.solution import Claim, SolverStage, Status, format_work_count, sum_work_counts
from lavender.problem import Problem
from lavender.solvers.costs import RATES
from lavender.solvers.decisions import DECISIONS, SMALL_ROWS
from lavender.solvers.islands import find_islands
from lavender.solvers.newton_systems import general
from lavender_ext.batch.many import Call, Small
from lavender_ext.newton.solve import MAX_ROWS_ALWAYS_DENSE

# Key in `Derived.cache` of the problem's compiled call, a `Small`; its value is False if there is none.
COMPILED_CALL_KEY = "lavender.solvers.small: compiled call"

# If an island has at least this many rows per velocity, Newton's matrix N over velocities is treated as full: it is
# then smaller than the data from which it is formed.
DENSE_ROWS_PER_VELOCITY = 10.0
VELOCITIES_OF_TWO_BODIES = 12.0
# Largest number of Newton steps of all islands of velocities, within the default limits of each solver.
NEWTON_MAX_STEPS, AUTO_MAX_STEPS = 1500.0, 1e6


def make_limits(
    sweeps: float,
    max_cost: float = DECISIONS.call_cost,
    steps: float = NEWTON_MAX_STEPS,
    lanes: bool = False,
) -> FloatArray:
    """Return the limits of compiled calls over generalised velocities: number of sweeps, cost [ns], Newton steps.

    `lanes`: contacts of the kind that lanes of vectors solve are solved by their method.
    """
    sweep = (
        RATES["tree"],
        RATES["sweep row"],
        RATES["sweep cone"],
        RATES["sweep velocities"],
        sweeps,
    )
    step = RATES["entry"], RATES["work"]["velocities"], DECISIONS.factorisations
    row_rates = RATES["velocity row"], RATES["velocity contact row"]
    rows = SMALL_ROWS, MAX_ROWS_ALWAYS_DENSE, DENSE_ROWS_PER_VELOCITY, VELOCITIES_OF_TWO_BODIES
    numbers = [*step, *row_rates, *sweep, general.MAX_MATRIX_ENTRIES, max_cost, *rows, steps, lanes]
    return np.array(numbers)


def get_small_call(problem: Problem) -> Any:
    """Return the compiled call of a small problem or of small islands, or None. The call is cached with the problem."""
    call = problem.derived.cache.get(COMPILED_CALL_KEY)
    if call is None:
        call = problem.derived.cache[COMPILED_CALL_KEY] = _make_call(problem) or False
    return call or None


def _make_call(problem: Problem) -> Small | None:
    """Build the compiled call, or None for round cones, rolling friction, large islands and empty rows."""
    cones = problem.cones
    count = 1
    label = None
    bounded = call_uses_pivots(problem)
    if cones.has_round or cones.has_rolling:
        return None
    if problem.m > SMALL_ROWS:
        if bounded:
            return None
        count, label = find_islands(problem)
        if count == 1 or np.bincount(label, np.diff(cones.ptr)).max() > DECISIONS.island_rows:
            return None
    get_zero_impulse_reference(problem)
    data = problem.metric
    if len(data.empty) or data.relative_at_zero < 0.0:
        return None
    return Small(data, problem.csr_data if bounded else data, count > 1)


def call_uses_pivots(problem: Problem) -> bool:
    """Return whether the compiled call over A or bodies uses pivots: all rows are bounded or free."""
    return problem.law in ("linear", "lcp")


def describe_small_call(problem: Problem) -> str:
    """Describe the solver of the compiled call of `auto`; return an empty text if the call is not made."""
    if problem.generalized is not None:
        kernel = general.prepare_islands(problem)
        if kernel is None:
            return ""
        cost, max_cost = AUTO.call.cost(problem.metric, kernel.work, kernel.islands)
        return (
            f"newton on J and M, counted to take {1e-3 * cost:.3g} us" if cost <= max_cost else ""
        )
    small = get_small_call(problem)
    if small is None:
        return ""
    if call_uses_pivots(problem):
        return "direct (block pivots), then lemke if these do not end"
    count = find_islands(problem)[0] if problem.m > SMALL_ROWS else 1
    return "sweeps (anderson), then newton" + (f", on each of {count} islands" if count > 1 else "")


@dataclass(frozen=True)
class SmallCall:
    """The compiled call of a solver for small problems (`SolverSpec.small`)."""

    name: str  # Name of the solver.
    limits: (
        FloatArray | None
    )  # Limits of the cost over generalised velocities; None if it does not accept them.
    pivots: bool  # Whether the call accepts bounded rows.
    # Whether the call also accepts friction. It then returns a start that is already a solution, and replaces a start
    # that is worse than the zero impulse.
    hands_over: bool = False
    call: Call = field(init=False)

    def __post_init__(self) -> None:
        call = Call(self.limits, DECISIONS, self.pivots, self.hands_over, get_small_call)
        object.__setattr__(self, "call", call)

    def __reduce__(self) -> str:
        """Return the name of the module's variable, because `call` cannot be pickled; a copy is the variable."""
        return self.name.upper()

    def cost_limit(self, problem: Problem, kernel: Any) -> float:
        """Return the largest accepted cost [ns] of the call over J and M; 0 if the call is never made."""
        return (
            0.0
            if self.limits is None
            else float(self.call.cost(problem.metric, 0.0, kernel.islands)[1])
        )

    def list_claims_of_failed_call(
        self, problem: Problem, counts: tuple[int, ...] | None
    ) -> list[tuple[str, Claim]]:
        """Return (solver name, claim) for each solver that ran in a failed call, from its counts."""
        if counts is None or not any(counts):  # No solver ran, as for a start that is the result.
            return []
        if problem.generalized is not None:
            done = _split_velocity_counts(counts)
        else:
            done = (_split_pivoting_counts if call_uses_pivots(problem) else _split_stage_counts)(
                counts
            )
        return [(name, Claim(Status.STALLED, 0, work)) for name, work in done[1]]

    def make_claim(
        self,
        problem: Problem,
        counts: tuple[int, ...] | None,
        start: FloatArray | None,
        after: float,
        status: Status = Status.CONVERGED,
    ) -> Claim:
        """Build the claim of a call from its counts, its start (m,) or None, and its relative residual `after`.

        The counts are None if no solver ran.
        """
        if counts is None:
            return Claim(status, 0)
        if problem.generalized is not None:
            if self.name == "newton":
                return general.make_claim(status, counts)
            done, ran = _split_velocity_counts(counts)
        else:
            done, ran = (
                _split_pivoting_counts if call_uses_pivots(problem) else _split_stage_counts
            )(counts)
        if self.name == "direct":
            rank, shifts = ran[0][1].get("rank"), ran[0][1].get("shifts")
            symmetric = problem.is_symmetric
            note = "A is not symmetric" if problem.law == "linear" and not symmetric else ""
            if rank:
                note = f"A is singular, rank {rank} of {problem.m}"
            elif shifts and problem.law != "linear":
                note = "A is singular on the free rows: shifted and refined"
            return Claim(status, done, ran[0][1], note, form="band" if symmetric else "LU")
        stages = _make_stages(problem, ran, start, after)
        work = sum_work_counts(stage.work for stage in stages)
        return Claim(status, done, work, describe_stages(stages), stages=stages)


SolverWork = list[
    tuple[str, dict[str, int]]
]  # (name of the solver, {kind of work: count}) of each stage.


def _split_velocity_counts(counts: tuple[int, ...]) -> tuple[int, SolverWork]:
    """Return the iterations and the work of each solver from the counts of a call over J and M.

    Lanes sweep over the rows first, as `pgs` does, and continue by Newton steps over the rows; Newton's method over
    velocities runs without lanes, or after them (`lavender_ext/batch/lanes.h`).
    """
    sweeps, steps = counts[4:6]
    ran: SolverWork = []
    if sweeps:
        ran.append(("pgs", {"sweeps": sweeps}))
    if steps:
        ran.append(("newton", {"factorisations": steps}))
    claim = general.make_claim(Status.CONVERGED, counts)
    if any(claim.work.values()):
        ran.append(("newton", dict(claim.work)))
    return claim.iterations, ran


def _split_pivoting_counts(counts: tuple[int, ...]) -> tuple[int, SolverWork]:
    """Return the iterations and the work of each solver from the counts of a call with pivots."""
    done, swept, refined, factored, exchanged, shifts, rank, path = counts
    work = {
        "sweeps": 4 * swept,
        "rank": rank,
        "shifts": shifts,
        "refinements": refined,
        "factorisations": factored,
        "pivots": exchanged,
    }
    direct = "direct", {kind: count for kind, count in work.items() if count}
    return done, [direct, ("lemke", {"pivots": path})] if path else [direct]


def _split_stage_counts(counts: tuple[int, ...]) -> tuple[int, SolverWork]:
    """Return the iterations and the work of each solver from the counts of a call with sweeps and Newton's method."""
    done, sweeps, restarts, factorisations, driven, count, *_ = counts
    suffix = f" on {count} islands" if count > 1 else ""
    ran = [("anderson" + suffix, {"sweeps": sweeps, "restarts": restarts})]
    if not sweeps and factorisations:
        ran = []
    if factorisations:
        suffix = f" on {driven} islands" if count > 1 else ""
        ran.append(("newton" + suffix, {"factorisations": factorisations}))
    return done, ran


def _make_stages(
    problem: Problem, ran: SolverWork, start: FloatArray | None, after: float
) -> tuple[SolverStage, ...]:
    """Return the stages of one compiled call; the residual between two stages is NaN."""
    if start is None or np.array_equal(start, problem._start):
        before = float(problem.metric.relative_at_zero)
    else:
        before = float(judge_impulse(problem, start.copy()).relative)
    residuals = [before, *(len(ran) - 1) * [nan], after]
    return tuple(
        SolverStage(name, work, *residuals[i : i + 2]) for i, (name, work) in enumerate(ran)
    )


def describe_stages(stages: Sequence[SolverStage]) -> str:
    """Describe the stages that ran; consecutive stages of one solver are combined."""
    return " -> ".join(
        describe_work(name, sum_work_counts(stage.work for stage in group))
        for name, group in groupby(stages, key=lambda stage: stage.solver)
    )


def describe_work(name: str, work: Mapping[str, int]) -> str:
    """Describe the work of a solver."""
    done = ", ".join(format_work_count(count, kind) for kind, count in work.items() if count)
    return f"{name} {done}" if done else name


AUTO = SmallCall(
    "auto", make_limits(DECISIONS.first_sweeps, steps=AUTO_MAX_STEPS, lanes=True), True, True
)
DIRECT = SmallCall("direct", None, True)
NEWTON = SmallCall("newton", make_limits(inf), False)


def estimate_velocity_newton_cost(problem: Problem, work: float) -> float:
    """Estimate the cost [ns] of Newton's method over velocities, with `work` multiply-adds to factorise all islands."""
    return float(NEWTON.call.cost(problem.metric, work, 1)[0])
