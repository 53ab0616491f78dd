"""Convert quadratic programs to constraint problems, and solutions of these to solutions of the programs.

    min 1/2 x.P x + q.x   subject to   A x = b,  G x <= h,  lb <= x <= ub                                 (1)

It is written with equations J x = target (the first rows) and inequalities J x >= target (the other rows), where

    J = [A; I_f; -G; I_l; -I_u],   target = [b; lb_f; -h; lb_l; -ub_u]                                    (2)

f are the variables with lb = ub, l and u the other variables with a finite lower or upper bound; rows of G with
infinite h are left out. Numbers of at least 1e20 in absolute value count as infinite. The multipliers lambda are free
on the equations (A and f) and >= 0 on the inequalities, and

    P x + q + A^T y + G^T z + z_box = 0,   y = -lambda_A,  z = lambda_G,  z_box = lambda_u - lambda_l - lambda_f  (3)

P positive definite: (1) is the constraint problem of the generalised velocities x with the impulses lambda,

    M = P,   v* = -P^-1 q,   so that M (x - v*) = J^T lambda                                              (4)

P singular (its Cholesky factor has a pivot of up to MAX_SINGULAR_PIVOT times the diagonal entry): P has no inverse,
and (1) is the constraint problem of x and lambda together, with x free,

    w = [ P  -J^T ] [ x      ]  -  [ -q     ]                                                             (5)
        [ J   0   ] [ lambda ]     [ target ]

whose matrix is not symmetric. Solvers of quadratic programs receive P, q, J and target.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import (
    FloatArray,
    as_array,
    as_array_view,
    check_nonnegative_magnitudes,
    check_not_nan,
    get_shape,
    mark_read_only,
)
from lavender.base.errors import InputError
from lavender.base.lazy_import import issparse
from lavender.base.lazy_import import sparse as sp
from lavender.problem.cones import Cones
from lavender.problem.data import Names
from lavender.problem.derived import cached_property
from lavender.problem.generalized import (
    Compressed,
    Generalized,
    convert_to_compressed_rows,
    extract_lower_triangle,
)
from lavender_ext.core.assemble import dense_to_csr, mirror_lower_triangle
from lavender_ext.judge.measure import all_finite
from lavender_ext.program.error import (
    TERM_ROUNDING,
    equilibrate_program,
    find_components,
    judge_program,
)
from lavender_ext.program.rows import INFINITE, split_multipliers, stack_program

IntArray = npt.NDArray[np.int32]
IntpArray = npt.NDArray[np.intp]

# P counts as singular if a pivot of its Cholesky factor is at most this fraction of the diagonal entry.
MAX_SINGULAR_PIVOT = 1e-13
# P counts as semidefinite if P + SEMIDEFINITE_SHIFT diag(P) has a Cholesky factor. The shift covers negative
# eigenvalues that rounding causes.
SEMIDEFINITE_SHIFT = 1e-12
IMPOSSIBLE_SIDE = 1.0  # Right-hand side of a row G x <= -inf, which becomes 0 >= 1.
MAX_NAMED_ROWS = 8  # A message names up to this many rows.
MAX_PROGRAM_ASYMMETRY = (
    1e-8  # [-] An asymmetry of P up to this multiple of its largest entry is removed.
)
# Up to this many variables, the message about an indefinite P has its smallest eigenvalue.
MAX_EIGENVALUE_SIZE = 1000
NO_ROWS: IntpArray = np.zeros(0, np.intp)
ProgramArrays = tuple[Any, Any, Any, Any, Any, Any, Any, Any]  # P, q, G, h, A, b, lb, ub


@dataclass(frozen=True, eq=False)
class QPSolution:
    """Solution of a quadratic program with multipliers in the signs of OSQP and qpsolvers, and its errors.

    P x + q + A^T y + G^T z + z_box = 0,  z >= 0,  z_box > 0 at ub and < 0 at lb.

    Parameters
    ----------
    x : (n,), or None if it is proven that no x satisfies the constraints
    y : (me,), or None without A
        Multipliers of A x = b.
    z : (mi,), or None without G
        Multipliers of G x <= h; 0 if h is infinite (at least 1e20).
    z_box : (n,), or None without lb and ub
        Multipliers of the bounds.
    solution : Solution or None
        Solution of the constraint problem: status, work, certificate.
    ray : (n,), or None
        If the program is unbounded: a direction in which the objective decreases without limit, with a largest entry
        of 1. It is given if a point that satisfies the constraints was found.
    tol : float
        Largest error of a solution that counts as found.
    """

    x: Any
    y: FloatArray | None
    z: FloatArray | None
    z_box: FloatArray | None
    solution: Any
    ray: FloatArray | None
    # Impulses of the constraint problem: lambda (m,), or x and lambda (n + m,) if P is singular.
    impulse: FloatArray = field(repr=False)
    qp: QuadraticProgram = field(repr=False)
    tol: float = 1e-6

    def __str__(self) -> str:
        if self.ray is not None:
            return f"unbounded: the objective decreases without end along ray; at x it is {self.objective:.6g}"
        if self.x is None:
            return f"infeasible: no x satisfies the constraints ({self.solution.message})"
        # Show the status only if the program is not solved.
        status = "" if self.solution is None or self.found else f"{self.solution.status.name}, "
        if status == "CONVERGED, ":
            status = "the constraint problem CONVERGED, "
        verdict = "solved" if self.found else f"not solved to {self.tol:g}"
        conflict = "" if self.solution is None else self.solution.status_conflict
        conflict = f"; CONTRADICTED: {conflict}" if conflict else ""
        return (
            f"{verdict}: {status}error {self.error:.1e}, objective {self.objective:.6g}{conflict}"
        )

    @cached_property
    def _judged(self) -> tuple[Any, ...]:
        """Result of `judge_program` for x and the multipliers."""
        if self.x is None:
            return (np.inf,)
        return self.qp.judge(self.x, self.qp.select_row_multipliers(self.impulse))

    @property
    def objective(self) -> float:
        """Objective 1/2 x.P x + q.x; NaN without x."""
        if self.x is None:
            return np.nan
        curvature = self.qp.generalized.momentum_of(self.x)
        return float(0.5 * self.x @ curvature + self.qp.q @ self.x)

    @property
    def obj(self) -> float:
        """Objective, by its name in qpsolvers."""
        return self.objective

    def is_optimal(self, eps_abs: float) -> bool:
        """Return whether the primal and dual residuals and the duality gap are below `eps_abs`, in absolute terms."""
        return max(self.primal_residual, self.dual_residual, self.duality_gap) < eps_abs

    @property
    def primal_residual(self) -> float:
        """Largest violation of a row: |A x - b|, G x - h, lb - x, x - ub; inf without x."""
        if self.x is None:
            return np.inf
        qp = self.qp
        slack = qp.generalized.jac @ self.x - qp.target
        return float(np.append(np.abs(slack[: qp.free]), -slack[qp.free :]).max(initial=0.0))

    @property
    def dual_residual(self) -> float:
        """Maximum of |P x + q + A^T y + G^T z + z_box| and of -z; inf without x."""
        if self.x is None:
            return np.inf
        qp = self.qp
        lam = self.qp.select_row_multipliers(self.impulse)
        residual = qp.generalized.momentum_of(self.x) + qp.q - qp.generalized.jac.T @ lam
        return float(np.append(np.abs(residual), -lam[qp.free :]).max(initial=0.0))

    @property
    def duality_gap(self) -> float:
        """Duality gap |x.P x + q.x + b.y + h.z + bounds.z_box|; inf without x."""
        if self.x is None:
            return np.inf
        qp = self.qp
        lam = self.qp.select_row_multipliers(self.impulse)
        return float(abs(self.x @ (qp.generalized.momentum_of(self.x) + qp.q) - qp.target @ lam))

    @property
    def error(self) -> float:
        """Error of x and the multipliers, relative to the terms of the program's rows and columns; 0 if exact.

        It is the largest of three numbers, for all constraints as rows J x = t or J x >= t with multipliers lambda,
        and components of rows and columns that entries of P and J connect:

        - Row i, if it is an equation, active or violated: |J x - t|_i / (|J| |x| + |t|)_i.
        - Column j: |P x + q - J^T lambda|_j / (|P| |x| + |q|)_j.
        - Gap of a component: the sum of |lambda_i (J x - t)_i| and |x_j (P x + q - J^T lambda)_j|, divided by
          |x|.|P| |x| + |q|.|x|.

        An inequality is active if its multiplier, relative to its columns, exceeds its slack, relative to its row;
        otherwise its multiplier counts as 0. Rounding of the own terms of a row or column counts as 0, and no divisor
        depends on another component: `lavender_ext/program/error.pyx` has the formulas.
        """
        return float(self._judged[0])

    @property
    def found(self) -> bool:
        """Whether the error is at most `tol`, and no proof or ray shows that the program has no solution."""
        if self.ray is not None or not self.error <= self.tol:
            return False
        solution = self.solution
        if solution is None or solution.status.name != "INFEASIBLE":
            return True
        return bool(solution.claim_check != "confirmed")


@dataclass(frozen=True, eq=False)
class QuadraticProgram:
    """Quadratic program of a problem built by `Problem.from_qp` (`problem.qp`)."""

    q: FloatArray  # (n,)
    target: FloatArray  # (m,): right-hand sides of (2).
    free: int  # Number of rows of A and of variables with lb = ub, which are the first rows.
    generalized: Generalized  # J of (2) and M = P, which is not factored if P is singular.
    # Whether P is singular: the problem is (5), which only solvers of quadratic programs accept.
    is_singular: bool
    # Number of rows of A and of G; None without A or G.
    n_equalities: int | None
    n_inequalities: int | None
    variable: (
        IntArray  # (m,) int: variable of each row of J that is a bound, -1 for rows of A and G.
    )
    has_bounds: bool = False  # Whether lb or ub was given.
    kept: IntpArray | None = None  # (mi,) int or None: rows of G that are in J; None if all are.
    has_impossible_rows: bool = False  # Whether rows G x <= -inf were given, which became 0 <= -1.

    def problem_fields(self) -> dict[str, Any]:
        """Return the fields b, cones and matrix or generalized of the constraint problem, and its names."""
        general = self.generalized
        if not self.is_singular:
            cones = _make_one_sided_cones(self.free, len(self.target))
            return {"b": general.bias(self.target), "cones": cones, "generalized": general}
        n = len(self.q)
        jac = general.jac
        matrix = sp.csr_array(sp.block_array([[general.mass, -jac.T], [jac, None]], format="csr"))
        matrix.eliminate_zeros()
        matrix.sort_indices()
        b = np.concatenate([-self.q, self.target])
        numbers = range(len(b))
        names = Names(
            len(b), lambda: [f"variable {i}" if i < n else f"constraint {i - n}" for i in numbers]
        )
        cones = _make_one_sided_cones(n + self.free, len(b))
        return {"b": b, "cones": cones, "matrix": matrix, "names": names}

    def with_bias(self, b: FloatArray) -> QuadraticProgram:
        """Return the program of a singular P for which the right-hand side of (5) is b (n + m,)."""
        n = len(self.q)
        return replace(self, q=mark_read_only(-b[:n]), target=mark_read_only(b[n:].copy()))

    @cached_property
    def hessian(self) -> Compressed:
        """P, both triangles, in compressed rows."""
        if self.generalized.order is None:
            return mirror_lower_triangle(*self.generalized.operator.mass)
        mass = self.generalized.mass
        return mass.indptr, mass.indices, mass.data

    @cached_property
    def jacobian(self) -> Compressed:
        """J of (2) in compressed rows."""
        if self.generalized.order is None:
            return self.generalized.operator.jac
        jac = self.generalized.jac
        return jac.indptr, jac.indices, jac.data

    @property
    def arrays(self) -> dict[str, Any]:
        """P, q, and of G, h, A, b, lb, ub those that were given, for `Problem.from_qp`; G is 0 where h is infinite."""
        n = len(self.q)
        target = self.target
        P, J = _make_csr(self.hessian, n), _make_csr(self.jacobian, n)
        arrays = {"P": P, "q": self.q}
        if self.n_equalities is not None:
            arrays |= {"A": J[: self.n_equalities], "b": target[: self.n_equalities]}
        if self.has_bounds:
            lb = np.full(n, -np.inf)
            ub = np.full(n, np.inf)
            rows = np.flatnonzero(self.variable >= 0)
            sign = J.data[J.indptr[rows]]
            for side, chosen in ((lb, sign > 0.0), (ub, (sign < 0.0) | (rows < self.free))):
                side[self.variable[rows[chosen]]] = (sign * target[rows])[chosen]
            arrays |= {"lb": lb, "ub": ub}
        if self.n_inequalities is not None:
            end = self.free + (self.n_inequalities if self.kept is None else len(self.kept))
            G, h = -J[self.free : end], -target[self.free : end]
            if self.kept is not None:
                size = np.zeros(self.n_inequalities, int)
                sides = np.full(self.n_inequalities, np.inf)
                size[self.kept] = np.diff(G.indptr)
                sides[self.kept] = h
                G = _make_csr((np.append(0, np.cumsum(size)), G.indices, G.data), n)
                h = sides
            arrays |= {"G": G, "h": h}
        return arrays

    def judge(self, x: FloatArray, multipliers: FloatArray) -> tuple[Any, ...]:
        """Judge x (n,) and the multipliers (m,) of the rows: `judge_program`."""
        return judge_program(
            self.hessian,
            self.q,
            self.jacobian,
            self.target,
            self.scales,
            self.components,
            multipliers,
            x,
            self.free,
        )

    @cached_property
    def components(self) -> tuple[IntArray, int]:
        """Components of the columns and rows (n + m,), and their number: `find_components`."""
        return find_components(self.hessian, self.jacobian, len(self.q), len(self.target))

    @cached_property
    def scales(self) -> tuple[FloatArray, FloatArray, float, float]:
        """Scales D (n,), E (m,), sigma and c of `equilibrate_program`."""
        return equilibrate_program(
            self.hessian, self.q, self.jacobian, self.target, self.variable, self.free
        )

    def with_vectors(self, q: Any = None, h: Any = None, b: Any = None) -> QuadraticProgram:
        """Return the program with another q (n,), h (mi,) or b (me,); its matrices are shared, and h stays infinite."""
        changes: dict[str, Any] = {}
        if q is not None:
            changes["q"] = mark_read_only(as_array("q", q, (len(self.q),)).copy())
        target = self.target.copy()
        if b is not None:
            target[: self.n_equalities or 0] = as_array("b", b, (self.n_equalities or 0,))
        if h is not None and self.has_impossible_rows:
            raise InputError(
                "h of the program has an entry of -inf; a new program is needed for another h"
            )
        if h is not None:
            h = as_array("h", h, (self.n_inequalities or 0,), finite=False)
            h = h if self.kept is None else h[self.kept]
            target[self.free : self.free + len(h)] = -as_array("h", h, (len(h),))
        general = self.generalized
        if q is not None and not self.is_singular:
            general = general.with_jacobian(None, general.solve(-changes["q"]))
        new = replace(self, target=target, generalized=general, **changes)
        for name in ("hessian", "jacobian"):
            new.__dict__[name] = getattr(self, name)
        new.clear_rounding_of_empty_rows()
        return new

    @cached_property
    def violated_empty_rows(self) -> IntpArray:
        """Rows of A and G without coefficients that no x satisfies, (k,) int."""
        return np.flatnonzero(self._is_empty_row & self._violates_zero)

    @property
    def _is_empty_row(self) -> npt.NDArray[np.bool_]:
        """Whether each row has no coefficients (m,)."""
        ptr, _, value = self.jacobian
        is_empty = np.ones(len(self.target), bool)
        is_empty[np.repeat(np.arange(len(self.target)), np.diff(ptr))[value != 0.0]] = False
        return is_empty

    @property
    def _violates_zero(self) -> npt.NDArray[np.bool_]:
        """Whether x = 0 violates each row (m,)."""
        violates: npt.NDArray[np.bool_] = self.target > 0.0
        violates[: self.free] |= self.target[: self.free] < 0.0
        return violates

    def clear_rounding_of_empty_rows(self) -> None:
        """Set right-hand sides of a new program's rows without coefficients to 0 if they are rounding of the others.

        They are if x = 0 violates them by at most TERM_ROUNDING of the largest right-hand side of the rows of A
        and G with coefficients. A warning names the rows. `target` becomes read-only.
        """
        ptr, _, value = self.jacobian
        target = self.target
        if (ptr[1:] > ptr[:-1]).all() and value.all():
            self.__dict__["violated_empty_rows"] = NO_ROWS
        else:
            is_general = self.variable < 0
            is_empty = self._is_empty_row
            largest = np.abs(target).max(initial=0.0, where=is_general & ~is_empty)
            is_rounding = is_empty & is_general & self._violates_zero
            is_rounding &= np.abs(target) <= TERM_ROUNDING * largest
            if self.has_impossible_rows:
                is_rounding &= target != IMPOSSIBLE_SIDE
            if is_rounding.any():
                names = self.describe_rows(is_rounding.astype(float))
                warnings.warn(
                    f"rows without coefficients hold up to rounding, with right-hand sides of up to "
                    f"{np.abs(target[is_rounding]).max():.1e} beside {largest:.1e}: {names}",
                    stacklevel=4,
                )
                target[is_rounding] = 0.0
        mark_read_only(target)

    def recover_variables(self, impulse: FloatArray) -> FloatArray:
        """Compute x (n,) from the impulses (m,) of the constraint problem, or (n + m,) if P is singular."""
        if self.is_singular:
            return impulse[: len(self.q)].copy()
        return self.generalized.v_free + self.generalized.change(impulse)

    def select_row_multipliers(self, impulse: FloatArray) -> FloatArray:
        """Return the multipliers lambda (m,) of the rows from impulses (m,) or (n + m,)."""
        return impulse[len(impulse) - len(self.target) :]

    def multipliers(
        self, impulse: FloatArray
    ) -> tuple[FloatArray | None, FloatArray | None, FloatArray | None]:
        """Return (y, z, z_box) of impulses (m,), or (n + m,) if P is singular.

        If `impulse` is a certificate of infeasibility, the result proves that the program has no feasible point:
        A^T y + G^T z + z_box = 0 and b.y + h.z + (ub or lb).z_box < 0.
        """
        lam = np.ascontiguousarray(self.select_row_multipliers(impulse))
        y, z, box = split_multipliers(
            self.jacobian, self.variable, None, len(self.q), self.free, lam
        )
        if self.kept is not None:
            z_of_all_rows = np.zeros(self.n_inequalities or 0)
            z_of_all_rows[self.kept] = z
            z = z_of_all_rows
        return (
            None if self.n_equalities is None else y,
            None if self.n_inequalities is None else z,
            box if self.has_bounds else None,
        )

    def describe_rows(self, impulse: FloatArray) -> str:
        """Return the names of the rows with nonzero multipliers, such as A[0], G[3], lb[2]."""
        ptr, _, value = self.jacobian
        rows = np.flatnonzero(self.select_row_multipliers(impulse))
        names = []
        n_a = self.n_equalities or 0
        for i in rows.tolist():
            j = int(self.variable[i])
            row = i - self.free
            bound = "ub" if j >= 0 and value[ptr[i]] < 0.0 else "lb"
            row = row if self.kept is None or j >= 0 or i < n_a else int(self.kept[row])
            names.append(f"{bound}[{j}]" if j >= 0 else f"A[{i}]" if i < n_a else f"G[{row}]")
        more = f" and {len(names) - MAX_NAMED_ROWS} more" if len(names) > MAX_NAMED_ROWS else ""
        return ", ".join(names[:MAX_NAMED_ROWS]) + more

    def solution(self, solution: Any, tol: float = 1e-6) -> QPSolution:
        """Return x, y, z and z_box of a `Solution` of this problem, or of its impulses.

        `QPSolution.found` is true if the error does not exceed `tol`.
        """
        impulse = getattr(solution, "impulse", None)
        of_solution = None if impulse is None else solution
        if impulse is None:
            size = len(self.target) + (len(self.q) if self.is_singular else 0)
            impulse = as_array("impulse", solution, (size,))
        y, z, box = self.multipliers(impulse)
        return QPSolution(
            x=self.recover_variables(impulse),
            y=y,
            z=z,
            z_box=box,
            solution=of_solution,
            ray=None,
            impulse=impulse,
            qp=self,
            tol=tol,
        )


def _make_csr(rows: Any, n: int) -> Any:
    """Return compressed rows of n columns as `csr_array`."""
    ptr, idx, value = rows
    return sp.csr_array((value, idx, ptr), (len(ptr) - 1, n))


@lru_cache(maxsize=8)  # A controller solves many programs with equal cones.
def _make_one_sided_cones(free: int, m: int) -> Cones:
    """Return cones of m rows, the first ones free and the others nonnegative."""
    low = np.zeros(m)
    low[:free] = -np.inf
    return Cones.bounded(low, np.inf)


def make_quadratic_program(arrays: ProgramArrays) -> QuadraticProgram:
    """Check the arrays P, q, G, h, A, b, lb, ub and convert them to a program; see `Problem.from_qp`."""
    P, q, G, h, A, b, lb, ub = _unpack_arguments(arrays)
    q, h, b, lb, ub = (  # An array (n, 1) counts as (n,).
        np.asarray(x)[:, 0] if getattr(x, "shape", ())[1:] == (1,) else x for x in (q, h, b, lb, ub)
    )
    q = as_array("q", q, (None,))
    n = len(q)
    lower = _convert_hessian(P, n)
    A, b = _convert_rows("A", A, "b", b, n, 1.0)
    G, h = _convert_rows("G", G, "h", h, n, -1.0)
    has_bounds = lb is not None or ub is not None
    if has_bounds:
        lb, ub = (
            np.full(n, infinite) if x is None else as_array(name, x, (n,), finite=False)
            for name, x, infinite in (("lb", lb, -np.inf), ("ub", ub, np.inf))
        )
    jac, target, variable, n_fixed, n_kept, bad = stack_program(n, A, b, G, h, lb, ub)
    if bad >= 0:
        raise InputError(
            f"variable {bad}: lb = {lb[bad]}, ub = {ub[bad]}; lb < inf and ub > -inf are needed"
        )
    general, is_singular = _factor_hessian(lower, jac, q)
    n_a, n_g = (None if side is None else len(side) for side in (b, h))
    program = QuadraticProgram(
        q=q,
        target=target,
        free=n_fixed + (n_a or 0),
        generalized=general,
        is_singular=is_singular,
        n_equalities=n_a,
        n_inequalities=n_g,
        variable=variable,
        has_bounds=has_bounds,
        kept=None if h is None or n_kept == n_g else np.flatnonzero(h < INFINITE),
        has_impossible_rows=h is not None and bool(np.isneginf(h).any()),
    )
    program.clear_rounding_of_empty_rows()
    return program


# -- conversion of arguments --------------------------------------------------------------------------


def _unpack_arguments(arguments: ProgramArrays) -> ProgramArrays:
    """Return the eight arrays; the first argument may be a `qpsolvers.Problem`, or an object with its attributes."""
    P = arguments[0]
    if arguments[1] is not None and not hasattr(P, "ub"):
        return arguments
    names = ("P", "q", "G", "h", "A", "b", "lb", "ub")
    if not all(hasattr(P, name) for name in names):
        raise InputError(
            f"P is a {type(P).__name__} and q is {'missing' if arguments[1] is None else 'given'}; "
            "P and q are needed, or a qpsolvers.Problem alone"
        )
    if any(x is not None for x in arguments[1:]):
        raise InputError(
            "a qpsolvers.Problem and further arrays are given; the former alone is needed"
        )
    return tuple(getattr(P, name) for name in names)


def _convert_hessian(P: Any, n: int) -> Compressed:
    """Return the lower triangle of P with its diagonal."""
    if get_shape("P", P) != (n, n):
        raise InputError(
            f"P has shape {get_shape('P', P)}; ({n}, {n}) is needed, as q has {n} entries"
        )
    hint = "give both triangles or the upper one, or (P + P^T) / 2, which has the same x.P x"
    try:
        return extract_lower_triangle("P", P, hint)
    except InputError:
        matrix = sp.csr_array(P if issparse(P) else as_array("P", P, (n, n)))
        upper = sp.triu(matrix, 1)
        asymmetry = abs(matrix - matrix.T)
        if not sp.tril(matrix, -1).count_nonzero():
            matrix = matrix + upper.T
        elif asymmetry.max() <= MAX_PROGRAM_ASYMMETRY * abs(matrix).max():
            matrix = 0.5 * (matrix + matrix.T)
        return extract_lower_triangle("P", sp.csr_array(matrix), hint)


def _convert_rows(
    name: str, matrix: Any, rhs_name: str, rhs: Any, n: int, sign: float
) -> tuple[Compressed | None, FloatArray | None]:
    """Convert A and b, or -G and h, to checked compressed rows and an array; None without them."""
    if (matrix is None) != (rhs is None):
        missing = name if matrix is None else rhs_name
        raise InputError(
            f"{missing} is missing; both or neither of {name} and {rhs_name} are needed"
        )
    if matrix is None:
        return None, None
    sparse = issparse(matrix)
    if not sparse:
        dense = as_array_view(name, matrix, (None,) * max(1, len(get_shape(name, matrix))))
        matrix = (
            dense[None] if dense.ndim == 1 else dense
        )  # A one-dimensional array is a single row.
    if len(matrix.shape) != 2 or matrix.shape[1] != n:
        raise InputError(
            f"{name} has shape {matrix.shape}; (any, {n}) is needed, as q has {n} entries"
        )
    rows = convert_to_compressed_rows(name, matrix, sign) if sparse else dense_to_csr(matrix, sign)
    rhs = as_array(rhs_name, rhs, (len(rows[0]) - 1,), finite=name == "A")
    if name == "G" and not all_finite(rhs):
        check_not_nan(rhs_name, rhs)
    return rows, rhs


# -- definiteness of P --------------------------------------------------------------------------------


def _factor_hessian(lower: Compressed, jac: Compressed, q: FloatArray) -> tuple[Generalized, bool]:
    """Return J and M = P of (4), and whether P is singular and not factored; raise InputError for an indefinite P."""
    momentum = -q
    unfactored = Generalized.from_validated(jac, lower)
    definite = _factor_shifted(unfactored, None, momentum)
    if definite is not None and definite.operator.least_pivot > MAX_SINGULAR_PIVOT:
        return definite, False
    diagonal = lower[2][lower[0][1:] - 1]
    is_zero = diagonal == 0.0
    shift = np.where(is_zero, diagonal.max(initial=0.0) or 1.0, SEMIDEFINITE_SHIFT * diagonal)
    ptr, idx, val = lower
    # Rows and columns of P with a zero diagonal entry are empty, or P is indefinite.
    is_coupled = (is_zero[idx] | np.repeat(is_zero, np.diff(ptr))) & (val != 0.0)
    if is_coupled.any() or _factor_shifted(unfactored, shift, momentum) is None:
        check_nonnegative_magnitudes("the diagonal of P", np.abs(diagonal))
        raise InputError(f"P is not positive semidefinite: {_describe_indefinite(lower, diagonal)}")
    return unfactored, True


def _factor_shifted(
    unfactored: Generalized, d: FloatArray | None, momentum: FloatArray
) -> Generalized | None:
    """Return J and P + diag(d), or J and P without d; None if that is not positive definite."""
    try:
        return unfactored.with_diagonal_shift(d, momentum)
    except InputError:
        return None


def _describe_indefinite(lower: Compressed, diagonal: FloatArray) -> str:
    """Describe an indefinite P by its extreme eigenvalues, or if it is large by its smallest diagonal entry."""
    n = len(diagonal)
    if n <= MAX_EIGENVALUE_SIZE:
        ptr, idx, val = lower
        dense = np.zeros((n, n))
        dense[np.repeat(np.arange(n), np.diff(ptr)), idx] = val
        value = np.linalg.eigvalsh(dense)  # `eigvalsh` reads only the lower triangle.
        return f"its smallest eigenvalue is {value[0]:.3g}, its largest {value[-1]:.3g}"
    i = int(np.argmin(diagonal))
    return (
        f"P + {SEMIDEFINITE_SHIFT:g} diag(P) has no Cholesky factor; the smallest diagonal entry is P[{i}, {i}] = "
        f"{diagonal[i]:.3g}"
    )
