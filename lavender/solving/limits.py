"""Time limits: their check, and the deadline of a call."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lavender.base.arrays import check_float
from lavender.base.deadline import NEVER, Deadline, stop_clock
from lavender.base.lazy_import import import_numerical_modules
from lavender.problem import Problem
from lavender.solvers.registry import SolverSpec

# [ns] Cost of two passes of the judge and of the solution, per row and per multiply-add of a product with A.
JUDGE_COST, JUDGE_COST_PER_ROW, JUDGE_COST_PER_ENTRY = 6e4, 80.0, 2.0
MAX_JUDGE_SHARE = 0.3  # Largest part of the remaining time that is reserved for the judge.


def check_time_limit(time_limit: Any) -> float:
    """Return a time limit [s] as a number; inf if it is None."""
    if type(time_limit) is float and time_limit > 0.0:
        return time_limit
    if time_limit is None or (isinstance(time_limit, np.floating) and time_limit == np.inf):
        return math.inf
    return check_float("time_limit", time_limit, above=0.0)


def start_limit(time_limit: Any) -> Deadline:
    """Check the time limit [s] of a call that begins now, and return its deadline; NEVER if it is None."""
    return NEVER if time_limit is None else Deadline(check_time_limit(time_limit))


def reserve_time_of_judge(problem: Problem, deadline: Deadline) -> None:
    """Move the deadline by the counted cost of the passes of the judge after a solve, at most a part of the time."""
    cost = JUDGE_COST + JUDGE_COST_PER_ROW * problem.m + JUDGE_COST_PER_ENTRY * problem.metric.work
    left = deadline.get_remaining_seconds() or 0.0
    deadline.extend(-min(1e-9 * cost, MAX_JUDGE_SHARE * left))


def import_before_limit(spec: SolverSpec, deadline: Deadline) -> None:
    """Import a solver under a limit, and the modules of SciPy that it may need; this time does not count."""
    if not deadline.is_set:
        return
    with stop_clock(deadline):
        if spec.external or not spec.builtin:
            spec.load()
            import_numerical_modules(*(() if spec.external else spec.requires))
        elif spec.lazy_modules:
            import_numerical_modules(*spec.lazy_modules)
