"""Quadratic programs with the calls of qpsolvers: `import lavender.qp as qpsolvers`.

    x = lavender.qp.solve_qp(P, q, G, h, A, b, lb, ub, solver="clarabel")       # (n,) or None

`lavender.solve_qp` returns the multipliers, the error and the status as well.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.problem import Problem, QPSolution
from lavender.programs import quadratic
from lavender.solvers.registry import available

__all__ = ["available_solvers", "solve_problem", "solve_qp"]

DEFAULT_TOL = 1e-6


#: Names of the installed solvers that `solve_qp` accepts.
available_solvers: list[str] = available(Problem.from_qp(np.eye(1), np.zeros(1), lb=np.zeros(1)))


def solve_qp(
    P: Any,
    q: Any,
    G: Any = None,
    h: Any = None,
    A: Any = None,
    b: Any = None,
    lb: Any = None,
    ub: Any = None,
    solver: str | None = None,
    initvals: Any = None,
    verbose: bool = False,
    **kwargs: Any,
) -> FloatArray | None:
    """Solve a quadratic program as `qpsolvers.solve_qp` does: min 1/2 x.P x + q.x, G x <= h, A x = b, lb <= x <= ub.

    Differs from qpsolvers in that `solver` has a default, and that x is returned only if its error, judged by
    lavender, is at most `tol` (default 1e-6).

    Parameters
    ----------
    P : (n, n) array or sparse
        Symmetric, or its upper triangle.
    q : (n,) or (n, 1)
    G, h, A, b, lb, ub : arrays, optional
    solver : str, optional
        A name of `available_solvers`; default "auto".
    initvals : (n,), optional
        Start x, for backends that accept one.
    verbose : bool
        Whether the backend prints its output.
    **kwargs
        `tol`, `time_limit` [s], `max_iter`, and options of the solver.

    Returns
    -------
    x : (n,) or None
        None if no solution was found.
    """
    answer = quadratic.solve_qp(
        P,
        q,
        G,
        h,
        A,
        b,
        lb,
        ub,
        solver or "auto",
        initvals,
        verbose,
        **{"tol": DEFAULT_TOL, **kwargs},
    )
    return np.array(answer.x) if answer.found else None


def solve_problem(
    problem: Any,
    solver: str | None = None,
    initvals: Any = None,
    verbose: bool = False,
    **kwargs: Any,
) -> QPSolution:
    """Solve a `qpsolvers.Problem` and return its solution with the multipliers.

    Parameters
    ----------
    problem : qpsolvers.Problem, or Problem of `Problem.from_qp`
    solver, initvals, verbose, **kwargs
        As in `solve_qp`.
    """
    program = problem if isinstance(problem, Problem) else Problem.from_qp(problem)
    return quadratic.solve_qp(
        program,
        solver=solver or "auto",
        initvals=initvals,
        verbose=verbose,
        **{"tol": DEFAULT_TOL, **kwargs},
    )
