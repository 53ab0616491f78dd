"""Quadratic programs with the names and calls of qpsolvers: `import lavender.qp as qpsolvers`.

    x = lavender.qp.solve_qp(P, q, G, h, A, b, lb, ub, solver="clarabel")       # (n,) or None

`solve_qp`, `solve_problem`, `solve_ls`, `solve_unconstrained` and `<name>_solve_qp` call lavender, and
raise exceptions of qpsolvers that are exceptions of lavender as well. The other names, such as
`Problem` and `ActiveSet`, are those of qpsolvers, which is imported when one is first used.
`lavender.solve_qp` has another result, with the error and the status as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, partial
from importlib.util import find_spec
from time import perf_counter
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import (
    CapabilityError,
    InputError,
    LavenderError,
    SolverUnavailable,
    UnknownName,
)
from lavender.base.lazy_import import issparse
from lavender.base.lazy_import import sparse as sp
from lavender.problem import Problem as ConstraintProblem
from lavender.problem.program import make_quadratic_program
from lavender.programs import quadratic
from lavender.programs.backends import BACKENDS
from lavender.solvers.registry import available

__all__ = [
    "Solution",
    "available_solvers",
    "dense_solvers",
    "solve_ls",
    "solve_problem",
    "solve_qp",
    "solve_unconstrained",
    "sparse_solvers",
]

DEFAULT_TOL = 1e-9
DENSE_BACKENDS = {backend.name for backend in BACKENDS if backend.dense}

#: Names of the installed solvers that accept every convex program. Solvers of bounded rows, such as
#: "newton", are accepted by name if P is positive definite.
available_solvers: list[str] = available(
    ConstraintProblem.from_qp(np.zeros((1, 1)), np.ones(1), lb=np.zeros(1))
)
#: Names of the solvers that keep the matrices sparse; all accept sparse matrices and dense ones.
sparse_solvers: list[str] = [name for name in available_solvers if name not in DENSE_BACKENDS]
#: Names of the solvers that compute with dense matrices.
dense_solvers: list[str] = [name for name in available_solvers if name in DENSE_BACKENDS]


@dataclass
class Solution:
    """Solution of a program, with the fields and methods of `qpsolvers.Solution`.

    Parameters
    ----------
    problem : qpsolvers.Problem, or an object with `unpack()`
    extras : dict
        "answer" has the `lavender.QPSolution`.
    found : bool or None
        None if no solver ran.
    obj : float, or None without x
    x : (n,), or None if no solution was found
    y, z, z_box : arrays, or None without x
        Empty without equations, inequalities or bounds; z_box has the sign of the active bound, + for ub.
    build_time, solve_time : float, s
    """

    problem: Any
    extras: dict[str, Any] = field(default_factory=dict)
    found: bool | None = None
    obj: float | None = None
    x: FloatArray | None = None
    y: FloatArray | None = None
    z: FloatArray | None = None
    z_box: FloatArray | None = None
    build_time: float | None = None
    solve_time: float | None = None

    def primal_residual(self) -> float:
        """Return the largest violation of a row or bound; inf without a solution."""
        if not self.found or self.x is None:
            return np.inf
        _, _, G, h, A, b, lb, ub = self.problem.unpack()
        x = self.x
        parts = [] if G is None else [G @ x - h]
        parts += [] if A is None else [np.abs(A @ x - b)]
        parts += [] if lb is None else [lb - x]
        parts += [] if ub is None else [x - ub]
        return float(
            max((part.max(initial=0.0) for part in map(np.atleast_1d, parts)), default=0.0)
        )

    def dual_residual(self) -> float:
        """Return the largest entry of |P x + q + A^T y + G^T z + z_box|; inf without x or multipliers."""
        if not self.found or self.x is None:
            return np.inf
        P, q, G, _, A, _, lb, ub = self.problem.unpack()
        total = P @ self.x + q
        for matrix, multipliers in ((A, self.y), (G, self.z)):
            if matrix is not None:
                if multipliers is None:
                    return np.inf
                total = total + matrix.T @ multipliers
        if lb is not None or ub is not None:
            if self.z_box is None:
                return np.inf
            total = total + self.z_box
        return float(np.abs(total).max(initial=0.0))

    def duality_gap(self) -> float:
        """Return |x.P x + q.x + b.y + h.z + bounds.z_box|; inf without x or multipliers."""
        if not self.found or self.x is None:
            return np.inf
        P, q, _, h, _, b, lb, ub = self.problem.unpack()
        total = self.x @ (P @ self.x) + q @ self.x
        for side, multipliers in ((b, self.y), (h, self.z)):
            if side is not None:
                if multipliers is None:
                    return np.inf
                finite = np.isfinite(side)
                total += side[finite] @ multipliers[finite]
        if self.z_box is not None:
            for bound, part in (
                (lb, np.minimum(self.z_box, 0.0)),
                (ub, np.maximum(self.z_box, 0.0)),
            ):
                if bound is not None:
                    finite = np.isfinite(bound)
                    total += bound[finite] @ part[finite]
        return float(abs(total))

    def is_optimal(self, eps_abs: float) -> bool:
        """Return whether both residuals and the gap are below `eps_abs`, in absolute terms."""
        return max(self.primal_residual(), self.dual_residual(), self.duality_gap()) < eps_abs


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

    Differs from qpsolvers in that x is returned only if its error, judged by lavender, is at most `tol`.

    Parameters
    ----------
    P : (n, n) array or sparse
        Symmetric, or its upper triangle.
    q : (n,) or (n, 1)
    G, h, A, b, lb, ub : arrays, optional
    solver : str
        A name of `available_solvers`, or another solver if P is positive definite.
    initvals : (n,), optional
        Start x, for backends that accept one.
    verbose : bool
        Whether the backend prints its output.
    **kwargs
        `tol` (default 1e-9), `time_limit` [s], `max_iter`, and options of the solver.

    Returns
    -------
    x : (n,) or None
        None if no solution was found.

    Raises
    ------
    NoSolverSelected, SolverNotFound
        `solver` is None, or not installed.
    ProblemError
        The arrays are invalid, the solver does not accept the program, or the objective is unbounded and there
        are no constraints.
    ParamError
        An option is invalid.
    """
    if solver is None:
        raise _make_error(
            "NoSolverSelected", f"solver is None; one of {', '.join(available_solvers)} is needed"
        )
    answer = _solve((P, q, G, h, A, b, lb, ub), solver, initvals, verbose, kwargs)[0]
    return np.array(answer.x) if answer.found else None


def solve_problem(
    problem: Any,
    solver: str = "auto",
    initvals: Any = None,
    verbose: bool = False,
    **kwargs: Any,
) -> Solution:
    """Solve a `qpsolvers.Problem` and return its solution with the multipliers.

    Parameters
    ----------
    problem : qpsolvers.Problem, or a lavender Problem of `Problem.from_qp`
    solver, initvals, verbose, **kwargs
        As in `solve_qp`.
    """
    answer, build_time, solve_time = _solve(
        (problem, *[None] * 7), solver, initvals, verbose, kwargs
    )
    given = _Arrays(answer.qp) if isinstance(problem, ConstraintProblem) else problem
    out = Solution(
        given, {"answer": answer}, answer.found, build_time=build_time, solve_time=solve_time
    )
    if answer.found:
        out.x, out.obj = np.array(answer.x), answer.objective
        out.y, out.z, out.z_box = (
            np.zeros(0) if part is None else np.array(part)
            for part in (answer.y, answer.z, answer.z_box)
        )
    return out


def solve_ls(
    R: Any,
    s: Any,
    G: Any = None,
    h: Any = None,
    A: Any = None,
    b: Any = None,
    lb: Any = None,
    ub: Any = None,
    W: Any = None,
    solver: str | None = None,
    initvals: Any = None,
    verbose: bool = False,
    sparse_conversion: bool | None = None,
    **kwargs: Any,
) -> FloatArray | None:
    """Minimise 1/2 (R x - s).W (R x - s) with the constraints of `solve_qp`; return x (n,), or None.

    Parameters
    ----------
    R : (k, n) array or sparse
    s : (k,)
    W : (k, k), optional
        Symmetric positive definite; default: the unit matrix.
    sparse_conversion : bool, optional
        Whether the residual R x - s is a variable of its own, so that R^T W R is not formed; default: if R is
        sparse.
    G, h, A, b, lb, ub, solver, initvals, verbose, **kwargs
        As in `solve_qp`.
    """
    if sparse_conversion is None:
        sparse_conversion = issparse(R)
    if not sparse_conversion:
        weighted = R if W is None else W @ R
        P, q = R.T @ weighted, -(weighted.T @ s)
        return solve_qp(P, q, G, h, A, b, lb, ub, solver, initvals, verbose, **kwargs)
    k, n = R.shape
    unit = sp.eye_array(k, format="csc")

    def widen(matrix: Any) -> Any:
        rows = sp.csc_array(np.atleast_2d(matrix) if not issparse(matrix) else matrix)
        return sp.hstack([rows, sp.csc_array((rows.shape[0], k))], format="csc")

    residual_rows = sp.hstack([sp.csc_array(R), -unit], format="csc")
    equations = residual_rows if A is None else sp.vstack([widen(A), residual_rows], format="csc")
    sides = s if A is None else np.append(b, s)
    free = np.full(k, np.inf)
    x = solve_qp(
        sp.block_diag([sp.csc_array((n, n)), unit if W is None else W], format="csc"),
        np.zeros(n + k),
        None if G is None else widen(G),
        h,
        equations,
        sides,
        None if lb is None else np.append(lb, -free),
        None if ub is None else np.append(ub, free),
        solver,
        None if initvals is None else np.append(initvals, R @ initvals - s),
        verbose,
        **kwargs,
    )
    return None if x is None else x[:n]


def solve_unconstrained(problem: Any) -> Solution:
    """Solve a `qpsolvers.Problem` without constraints."""
    return solve_problem(problem, "auto")


def __getattr__(name: str) -> Any:
    """Return `<solver>_solve_qp`, or a name of qpsolvers."""
    solver = name.removesuffix("_solve_qp")
    if solver != name and solver in available_solvers:
        function = partial(solve_qp, solver=solver)
        function.__doc__ = f"Solve a quadratic program by {solver}: `solve_qp`."
        return function
    is_public = name == "__version__" or not name.startswith("__")
    if is_public and find_spec("qpsolvers") is not None:
        import qpsolvers

        if hasattr(qpsolvers, name):
            return None if solver != name else getattr(qpsolvers, name)
    hint = (
        ""
        if find_spec("qpsolvers")
        else "; names of qpsolvers need its package: pip install qpsolvers"
    )
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")


# -- errors ------------------------------------------------------------------------------------------

# Exceptions of qpsolvers that are raised here, with the exception of lavender that they are as well.
_ERRORS: dict[str, type[LavenderError]] = {
    "NoSolverSelected": InputError,
    "ParamError": InputError,
    "ProblemError": InputError,
    "SolverNotFound": SolverUnavailable,
    "SolverError": LavenderError,
}


@cache
def _make_error_class(name: str) -> type[Exception]:
    """Return an exception that is both that of qpsolvers with this name, if installed, and one of lavender."""
    bases: tuple[type[Exception], ...] = (_ERRORS[name],)
    if find_spec("qpsolvers") is not None:
        import qpsolvers

        bases = (getattr(qpsolvers, name), *bases)
    return type(name, bases, {"__module__": __name__, "__doc__": f"`qpsolvers.{name}`."})


def _make_error(name: str, message: str) -> Exception:
    return _make_error_class(name)(message)


@contextmanager
def _translate(kinds: dict[type[Exception], str]) -> Iterator[None]:
    """Raise the exception of qpsolvers for an exception of lavender."""
    try:
        yield
    except LavenderError as error:
        for kind, name in kinds.items():
            if isinstance(error, kind):
                raise _make_error(name, str(error.args[0] if error.args else error)) from error
        raise


class _Arrays:
    """The arrays of a lavender problem in the order of `qpsolvers.Problem.unpack`."""

    def __init__(self, qp: Any) -> None:
        self._arrays = qp.arrays

    def unpack(self) -> tuple[Any, ...]:
        """Return P, q, G, h, A, b, lb, ub; None for those that were not given."""
        return tuple(map(self._arrays.get, ("P", "q", "G", "h", "A", "b", "lb", "ub")))


def _solve(
    arrays: tuple[Any, ...], solver: str, initvals: Any, verbose: bool, options: dict[str, Any]
) -> tuple[Any, float, float]:
    """Return the answer of `lavender.solve_qp`, and the times [s] to build the program and to solve it."""
    begun = perf_counter()
    problem = arrays[0] if isinstance(arrays[0], ConstraintProblem) else None
    with _translate({InputError: "ProblemError"}):
        if problem is None:
            program = make_quadratic_program(arrays)
        else:
            program = quadratic.get_quadratic_program(problem)
    built = perf_counter()
    kinds: dict[type[Exception], str] = {
        UnknownName: "SolverNotFound",
        SolverUnavailable: "SolverNotFound",
        CapabilityError: "ProblemError",
        InputError: "ParamError",
    }
    with _translate(kinds):
        answer = quadratic.solve_program(
            program,
            problem,
            built,
            solver=solver,
            initvals=initvals,
            verbose=verbose,
            **{"tol": DEFAULT_TOL, **options},
        )
    if answer.ray is not None and not len(answer.qp.target):
        raise _make_error(
            "ProblemError", "the objective decreases without limit, and there are no constraints"
        )
    return answer, built - begun, perf_counter() - built
