"""What `auto` would do with a problem, and what it expects that to cost: nothing is run."""

from __future__ import annotations

import math

import numpy as np

from lavender.errors import CapabilityError, InputError
from lavender.problem import Problem
from lavender.registry import get
from lavender.residuals import reference
from lavender.solvers.costs import Plan, made

__all__ = ["Plan", "explain"]


def explain(problem: Problem, tol: float = 1e-6) -> Plan:
    """The plan of `auto` for a problem: candidates with counted costs, their order, and who is first.

    Parameters
    ----------
    problem : Problem
    tol : float, default 1e-6
        Relative residual that would be asked for.

    Returns
    -------
    Plan
        `print` it; `lavender.solve(problem, plan=plan)` goes by it, on problems of the same structure.

    Raises
    ------
    InputError
        Not a problem, or one without rows; `tol` is not above 0.
    CapabilityError
        `auto` has no candidate that takes the problem.
    """
    if not isinstance(problem, Problem):
        raise InputError(f"problem is a {type(problem).__name__}; a lavender.Problem is needed")
    if isinstance(tol, bool) or not isinstance(tol, (int, float, np.number)) or not 0.0 < tol < math.inf:
        raise InputError(f"tol is {tol!r}; a number above 0 is needed")
    if problem.m == 0:
        raise InputError("the problem has no rows: there is nothing to plan")
    reason = get("auto").refuses(problem)
    if reason is not None:
        raise CapabilityError(f"solver 'auto' {reason}")
    problem = problem.disk  # where it has ellipses
    reference(problem)
    plan = made(problem, float(tol))
    if not plan.candidates:
        raise CapabilityError(
            f"auto has no candidate that takes a problem under the law {problem.law!r} given as {problem.operator}: "
            "lavender.available(problem) lists the solvers that do"
        )
    return plan
