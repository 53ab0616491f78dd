"""Check the arguments of a solve, and whether its time limit leaves time for the forms that a solver needs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from lavender.base.arrays import check_bool, check_float, check_int
from lavender.base.deadline import NEVER, Deadline, Stopwatch
from lavender.base.errors import CapabilityError, InputError
from lavender.base.lazy_import import import_numerical_modules
from lavender.problem import Problem, check_problem
from lavender.solvers.costs import (
    estimate_disk_cost,
    estimate_import_cost,
    estimate_judge_setup_cost,
    estimate_refusal_cost,
    get_loose_limit,
)
from lavender.solvers.loop import Callback
from lavender.solvers.registry import SolverSpec

if TYPE_CHECKING:
    pass


def check_accepted(problem: Problem, spec: SolverSpec, deadline: Deadline = NEVER) -> bool:
    """Raise an error if the argument is not a problem or the solver refuses it; return the result of `is_too_late`.

    If that is true, only the kind of the problem is checked, because other checks would exceed the time limit.
    """
    check_problem(problem)
    late = is_too_late(problem, spec, deadline)
    reason = spec.refuses(problem, late)
    if reason:
        raise CapabilityError(f"solver {spec.name!r} {reason}")
    return late


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
        and deadline.has_passed(1e-9 * estimate_judge_setup_cost(problem))
    ):
        # Even counting the couplings of bodies, which gives the number of entries of A, would take too long.
        return True
    refusal = estimate_refusal_cost(problem) if spec.external else 0.0
    needed = 1e-9 * (estimate_disk_cost(problem) + refusal)
    if (
        needed > 0.0
        and problem.generalized is None
        and deadline.has_passed(needed)
        and estimate_import_cost("scipy.sparse")
    ):
        watch = Stopwatch()
        import_numerical_modules()
        # Import SciPy without counting the time; otherwise no call with this limit could ever import it.
        deadline.reserve_seconds(-watch.elapsed_seconds)
        needed = 1e-9 * (estimate_disk_cost(problem) + refusal)
    return needed > 0.0 and deadline.has_passed(needed)


def is_tight(problem: Problem, deadline: Deadline) -> bool:
    """Return whether the set-up of the problem and the judge may use more than a hundredth of the remaining time.

    Otherwise, nothing is estimated before the solve, because the estimates would take longer than a small problem.
    """
    return deadline.is_set and deadline.has_passed(1e-9 * get_loose_limit(problem))


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


def make_deadline(spec: SolverSpec, limit: float, begun: float | None = None) -> Deadline:
    """Create the deadline of a call from its time limit [s].

    Third-party solvers, and the modules of SciPy that they need, are imported first, so that this time does not count.
    """
    if limit == math.inf:
        return NEVER
    if spec.external or not spec.builtin:
        spec.load()
        import_numerical_modules(*(() if spec.external else spec.requires))
        begun = None
    return Deadline(limit, begun)


def check_budget(spec: SolverSpec, tol: float, max_iter: int | None) -> tuple[float, int]:
    """Return `tol` and `max_iter` as numbers; a `max_iter` of None becomes the default of the spec.

    Raises
    ------
    InputError
        A value is not valid.
    """
    tol = check_float("tol", tol, low=0.0)
    return tol, check_int("max_iter", spec.max_iter if max_iter is None else max_iter)


def check_records(spec: SolverSpec, history: bool, callback: Callback | None) -> None:
    """Raise an error if `history` or `callback` is not valid or not supported by the solver."""
    if callback is not None and not callable(callback):
        raise InputError(f"callback is {callback!r}; a function of (iterations, impulse, residual) is needed")
    if callback is not None and not spec.callback:
        raise CapabilityError(
            f"solver {spec.name!r} runs in one call, so it cannot call a callback: leave callback out, or "
            "use a solver of lavender.available(problem, callback=True)"
        )
    if check_bool("history", history) and not spec.history:
        raise CapabilityError(
            f"solver {spec.name!r} runs in one call, so it cannot record a history: leave history out, or "
            "use a solver of lavender.available(problem, history=True)"
        )
