"""What `auto` would do with a problem, and the cost that it expects; nothing is run."""

from __future__ import annotations

from lavender._arrays import number
from lavender.errors import CapabilityError, InputError
from lavender.problem import Problem
from lavender.registry import get
from lavender.residuals import reference
from lavender.solvers.costs import Plan, made

__all__ = ["Plan", "explain"]


def explain(problem: Problem, tol: float = 1e-6) -> Plan:
    """The plan of `auto` for a problem: its candidates, their expected costs, and which runs first. Nothing is solved.

    Parameters
    ----------
    problem : Problem
    tol : float, default 1e-6
        The relative residual that a solve would ask for.

    Returns
    -------
    Plan
        Print it, or pass it to `lavender.solve(problem, plan=plan)` for problems of the same structure.

    Raises
    ------
    InputError
        `problem` is not a Problem or has no rows, or `tol` is not above 0.
    CapabilityError
        `auto` has no candidate that accepts the problem.
    """
    if not isinstance(problem, Problem):
        raise InputError(f"problem is a {type(problem).__name__}; a lavender.Problem is needed")
    tol = number("tol", tol, above=0.0)
    if problem.m == 0:
        raise InputError("the problem has no rows: there is nothing to plan")
    reason = get("auto").refuses(problem)
    if reason is not None:
        raise CapabilityError(f"solver 'auto' {reason}")
    problem = problem.disk  # where it has ellipses
    reference(problem)
    plan = made(problem, tol)
    if not plan.candidates:
        raise CapabilityError(
            f"auto has no candidate that takes a problem under the law {problem.law!r} given as {problem.operator}: "
            "lavender.available(problem) lists the solvers that do"
        )
    return plan
