"""Time limits: whether the time that remains suffices for the forms, the set-up and the judge of a solve.

Nothing here runs if a solve has no time limit.
"""

from __future__ import annotations

import math
from time import perf_counter
from typing import Any

import numpy as np

from lavender.base.arrays import check_float
from lavender.base.deadline import Deadline
from lavender.base.lazy_import import import_numerical_modules
from lavender.problem import Problem
from lavender.solvers.costs import (
    SCIPY_MODULES,
    estimate_disk_cost,
    estimate_import_cost,
    estimate_judge_setup_cost,
    estimate_pass_cost,
    estimate_refusal_cost,
    estimate_result_cost,
    get_loose_limit,
)
from lavender.solvers.registry import Solver, SolverSpec

# [passes of the judge] Cost of judging `auto`'s last iterate and of selecting the best iterate of each island.
SELECTION_PASSES = 3


def is_too_late(problem: Problem, spec: SolverSpec, deadline: Deadline) -> bool:
    """Return whether building the forms of a problem that a solver needs would end after the deadline.

    These forms are `problem.disk`, and A if a solver of another package examines its entries. If the result is true,
    the call returns its start.
    """
    if not is_tight(problem, deadline):
        return False
    if (
        problem.rows is not None
        and problem.cones.has_ellipse
        and not deadline.fits(estimate_judge_setup_cost(problem))
    ):
        # Even counting the couplings of bodies, which gives the number of entries of A, would take too long.
        return True
    for may_import in (problem.generalized is None, False):
        cost = estimate_disk_cost(problem) + (estimate_refusal_cost(problem) if spec.external else 0.0)
        if cost == 0.0 or deadline.fits(cost):
            return False
        if not (may_import and estimate_import_cost("scipy.sparse")):
            return True
        _import_outside_time_limit(deadline)
    return True


def is_setup_too_late(solver: Solver, problem: Problem, deadline: Deadline) -> bool:
    """Return whether the solver's `prepare` would end after the deadline."""
    if deadline.fits(solver.cost(problem).setup):
        return False
    if not (solver.needs_scipy and estimate_import_cost(*SCIPY_MODULES)):
        return True
    _import_outside_time_limit(deadline)
    return not deadline.fits(solver.cost(problem).setup)


def reserve_time_of_judge(problem: Problem, spec: SolverSpec, has_start: bool, deadline: Deadline) -> bool:
    """Move the deadline to leave time for the judge; return whether the judge would end too late.

    The judge makes one pass for the result, and one for a start that is not zero.
    """
    cost = (2 if has_start or problem.guess is not None else 1) * estimate_result_cost(problem)
    if not spec.external and not deadline.fits(estimate_judge_setup_cost(problem) + cost):
        return True
    deadline.reserve_seconds(1e-9 * cost)
    selection = SELECTION_PASSES * estimate_pass_cost(problem)
    if spec.delegates and deadline.fits(4.0 * selection):
        deadline.reserve_seconds(1e-9 * selection)
    return False


def _import_outside_time_limit(deadline: Deadline) -> None:
    """Import SciPy without counting the time; otherwise no call with this limit could ever import it."""
    begin = perf_counter()
    import_numerical_modules()
    deadline.reserve_seconds(begin - perf_counter())


def is_tight(problem: Problem, deadline: Deadline) -> bool:
    """Return whether the set-up of the problem and the judge may use more than a hundredth of the remaining time.

    Otherwise, nothing is estimated before the solve, because the estimates would take longer than a small problem.
    """
    return not deadline.fits(get_loose_limit(problem))


def check_time_limit(time_limit: Any) -> float:
    """Return a time limit [s] as a number; inf if it is None.

    Raises
    ------
    InputError
        `time_limit` is not a positive number.
    """
    if type(time_limit) is float and time_limit > 0.0:
        return time_limit
    if time_limit is None or (isinstance(time_limit, np.floating) and time_limit == np.inf):
        return math.inf
    return check_float("time_limit", time_limit, above=0.0)


def make_deadline(spec: SolverSpec, limit: float, begun: float) -> Deadline:
    """Create the deadline of a call that began at this reading of the clock [s], with a limit [s].

    Third-party solvers, and the modules of SciPy that they need, are imported first, so that this time does not count.
    """
    if spec.external or not spec.builtin:
        spec.load()
        import_numerical_modules(*(() if spec.external else spec.requires))
        return Deadline(limit)
    return Deadline(limit, begun)
