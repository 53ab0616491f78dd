"""Solve a small problem in one compiled call; the solution's other fields are computed when one is first read."""

from __future__ import annotations

import math
from time import perf_counter
from typing import Any

from lavender.base.arrays import FloatArray
from lavender.judge.residuals import get_zero_impulse_reference, make_residual
from lavender.judge.solution import CONVERGED, TIME_LIMIT, Claim, Solution, Status
from lavender.problem import Problem
from lavender.solvers.costs import (
    RATES,
    estimate_formation_cost,
    estimate_judge_setup_cost,
    estimate_pass_cost,
    get_loose_limit,
)
from lavender.solvers.decisions import DECISIONS, SMALL_ROWS
from lavender.solvers.registry import SolverSpec, get
from lavender.solvers.small import MAX_SWEEPS_BEFORE_FACTOR
from lavender.solving.finish import FinishedRun, make_fields
from lavender.solving.loop import select_best_impulse
from lavender_ext.batch.many import bind_types, solve_compiled

COST_PER_SECOND = 0.9e9  # [ns/s] Estimated cost that a compiled call may have per second of its time limit.
NO_STAGE_MESSAGE = "the time limit was over before its turn: the start"


def get_call_time_fraction(problem: Problem, seconds: float) -> float:
    """Return the fraction of a time limit of `seconds` that the compiled call may use; 0 if it is not made.

    With at most SMALL_ROWS rows, the call may use all of the time. Larger problems may fail in the call, so it may use
    only a fraction of the time, into which its set-up must fit. The kernel stops at the estimated cost of this time.
    """
    if seconds == math.inf or len(problem.b) <= SMALL_ROWS:
        return 1.0
    if problem.generalized is None and problem.law in ("linear", "lcp"):
        return 0.0
    if 1e9 * seconds > get_loose_limit(problem):
        return DECISIONS.time_share
    if problem.generalized is not None:
        cost = estimate_judge_setup_cost(problem) + estimate_pass_cost(problem)
    else:
        sweeps = MAX_SWEEPS_BEFORE_FACTOR * get("anderson").load()().cost(problem).iteration
        cost = RATES["island row"] * problem.m + estimate_formation_cost(problem) + sweeps
    return DECISIONS.time_share if 1e-9 * cost <= DECISIONS.time_share * seconds else 0.0


def solve_small(
    problem: Problem, spec: SolverSpec, impulse: Any, tol: float, limit: float = math.inf
) -> tuple[Solution | None, tuple[int, ...] | None]:
    """Solve and judge a small problem by one compiled call, if the solver has one that accepts the problem.

    A call ends when its estimated cost reaches the time limit [s]. It then returns the better of its iterate and the
    start if the problem has at most SMALL_ROWS rows, and otherwise None, because time may remain for other solvers.

    Returns
    -------
    Solution or None
        None if `Prepared` has to solve the problem.
    tuple of int or None
        Work counts of a call that did not solve the problem. None if the first result is a solution or no call was
        made; empty if the time limit leaves no time for a call.
    """
    fraction = 1.0
    if limit < math.inf and spec.small is not None:
        if problem.derived.view is None and len(problem.b) > SMALL_ROWS:
            return None, None
        fraction = get_call_time_fraction(problem, limit)
        if fraction == 0.0:
            return None, ()
    begin = perf_counter()
    solution, judged, counts, start = solve_compiled(
        problem, spec, impulse, tol, COST_PER_SECOND * fraction * limit
    )
    if solution is not None:
        return solution, None
    if judged is None or limit == math.inf or fraction < 1.0 or judged.relative == judged.roundoff_floor:
        # `Prepared` continues: time remains, or the impulses are so large that rounding hides b.
        return None, counts
    judged = select_best_impulse(problem, judged, start, tol).refine(math.inf)
    judged.impulse.setflags(write=False)
    start = start if start is None or impulse is None else start.copy()
    rest = compute_postponed_fields, (problem, spec, judged, counts, start, TIME_LIMIT)
    return (
        Solution.with_late_fields(judged.impulse, TIME_LIMIT, tol, perf_counter() - begin, rest),
        None,
    )


def compute_postponed_fields(
    problem: Problem,
    spec: SolverSpec,
    judged: Any,
    counts: Any,
    start: FloatArray | None,
    status: Status = CONVERGED,
) -> dict[str, Any]:
    """Return the fields of the solution of a compiled call that `Solution.with_late_fields` postpones."""
    if spec.small is None:  # Only worlds of `solve_many` have no compiled call of their own.
        claim = Claim(status, 0, {}, NO_STAGE_MESSAGE)
    else:
        claim = spec.small.make_claim(problem, counts, start, judged.relative, status)
    run = FinishedRun(problem, spec, {}, judged.impulse, claim, tol=0.0)
    return make_fields(run, judged)


bind_types(
    (
        Problem, Solution, CONVERGED, compute_postponed_fields, make_residual, perf_counter,
        get_zero_impulse_reference,
    )
)  # fmt: skip
