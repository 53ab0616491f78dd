"""Solve a small problem in one compiled call; the solution's other fields are computed when one is first read."""

from __future__ import annotations

import math
from time import perf_counter
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.judge.residuals import make_residual
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
from lavender_ext.judge.measure import all_finite

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
    """Solve and judge a small problem, which `spec._tries_compiled_call`, by one compiled call.

    A call ends when its estimated cost reaches the time limit [s]. It then returns the better of its iterate and the
    start if the problem has at most SMALL_ROWS rows, and otherwise None, because time may remain for other solvers. The
    fields of claim, counts and residual are computed when they are first accessed.

    Returns
    -------
    Solution or None
        None if `Prepared` has to solve the problem.
    tuple of int or None
        Work counts of a call that did not solve the problem. None if the first result is a solution or no call was
        made; empty if the time limit leaves no time for a call.
    """
    small: Any = spec.small
    if not isinstance(tol, float) or not 0.0 < tol < math.inf:
        return None, None
    view = problem.derived.view
    if view is None:
        # Islands of larger problems may take long, so `Prepared` solves them between checks of the clock.
        if len(problem.b) > SMALL_ROWS or problem.has_singular_program:
            return None, None
        view = problem.cones._blocks
    if view.has_ellipse:
        return None, None
    fraction = 1.0
    if limit < math.inf:
        fraction = get_call_time_fraction(problem, limit)
        if fraction == 0.0:
            return None, ()
    start = perf_counter()
    if impulse is None:
        first = problem.guess
    elif (
        type(impulse) is np.ndarray and impulse.dtype is problem.b.dtype and impulse.shape == problem.b.shape
        and impulse.flags.c_contiguous and all_finite(impulse)
    ):  # fmt: skip
        first = impulse
    else:
        first = problem.impulse_array(impulse)
    judged, counts = small.solve_and_judge(problem, first, tol, COST_PER_SECOND * fraction * limit)
    if judged is None:
        return None, counts
    status = CONVERGED
    if judged.relative > tol:
        if limit == math.inf or fraction < 1.0 or judged.relative == judged.roundoff_floor:
            # `Prepared` continues: time remains, or the impulses are so large that rounding hides b.
            return None, counts
        status, judged = TIME_LIMIT, select_best_impulse(problem, judged, first, tol).refine(math.inf)
        judged.impulse.setflags(write=False)
    # Copy the start, because the caller may change the array later.
    start_point = first if first is None or impulse is None else first.copy()
    solution = Solution.with_late_fields(
        judged.impulse,
        status,
        tol,
        perf_counter() - start,
        (compute_postponed_fields, (problem, spec, judged, counts, start_point, status)),
        (make_residual, (problem, judged)),
    )
    return solution, None


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
