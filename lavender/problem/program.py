"""Quadratic programs as constraint problems: a pure conversion, and the way back.

    min 1/2 x.P x + q.x   subject to   A x = b,  G x <= h,  lb <= x <= ub                                 (1)

With the rows J x = target (the first ones) and J x >= target (the others),

    J = [A; I_f; -G; I_l; -I_u],   target = [b; lb_f; -h; lb_l; -ub_u]                                    (2)

f: variables with lb = ub; l, u: other finite bounds; of G the rows with finite h. Numbers of 1e20 or more in size count
as infinite. The multipliers lambda of the rows are free on the first ones, >= 0 on the others, and

    P x + q + A^T y + G^T z + z_box = 0,   y = -lambda_A,  z = lambda_G,  z_box = lambda_u - lambda_l - lambda_f  (3)

P positive definite: (1) is the constraint problem of the generalised velocities x with the impulses lambda,

    M = P,   v* = -P^-1 q,   so that M (x - v*) = J^T lambda                                              (4)

P singular, if its Cholesky factor has a pivot of at most SINGULAR times the diagonal entry: P has no inverse, and (1)
is the constraint problem of x and lambda together, with x free,

    w = [ P  -J^T ] [ x      ]  -  [ -q     ]                                                             (5)
        [ J   0   ] [ lambda ]     [ target ]

whose matrix is not symmetric. Solvers of quadratic programs get P, q, J and target themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import (
    FloatArray,
    IntArray,
    as_array,
    as_array_view,
    check_not_nan,
    check_sizes,
    read_only,
    shape_of,
)
from lavender.base.errors import InputError
from lavender.base.lazy_import import issparse
from lavender.base.lazy_import import sparse as sp
from lavender.problem.cones import Cones
from lavender.problem.derived import cached_property
from lavender.problem.generalized import Compressed, Generalized, compressed, lower_of
from lavender_ext.core.assemble import dense_to_csr, mirrored, stacked
from lavender_ext.core.checks import largest
from lavender_ext.judge.measure import all_finite, program_residuals

IntpArray = npt.NDArray[np.intp]

SINGULAR = (
    1e-13  # P is singular if a pivot of its Cholesky factor is at most this share of the diagonal entry.
)
SHIFT = 1e-12  # P is semidefinite if P + SHIFT diag(P) has a Cholesky factor: rounding may leave negative eigenvalues.
# If q is 0, all forces may vanish at the solution; they are then compared with this share of the terms of P x.
SHARE_OF_CURVATURE = 1e-3
INFINITE = 1e20  # A side or bound of this size counts as infinite, as in other packages.
MAX_EIGENVALUE_SIZE = 1000  # Up to this size, the message about an indefinite P has its least eigenvalue.
Given = tuple[Any, Any, Any, Any, Any, Any, Any, Any]  # P, q, G, h, A, b, lb, ub


@dataclass(frozen=True, eq=False)
class QPSolution:
    """x and the multipliers of a quadratic program, in the signs of OSQP and qpsolvers, and their errors.

    P x + q + A^T y + G^T z + z_box = 0,  z >= 0,  z_box > 0 at ub and < 0 at lb.

    Parameters
    ----------
    x : (n,)
    y : (me,), or None without A
        Multipliers of A x = b.
    z : (mi,), or None without G
        Multipliers of G x <= h; 0 where h is infinite, from 1e20 on.
    z_box : (n,), or None without lb and ub
        Multipliers of the bounds.
    solution : Solution or None
        Of the constraint problem: status, work, certificate.
    ray : (n,), or None
        A direction in which the objective decreases without end, |ray| = 1 in its largest entry, if a point that
        satisfies the constraints was found: the program is unbounded.
    tol : float
        Error up to which the answer counts as found.
    """

    x: FloatArray
    y: FloatArray | None
    z: FloatArray | None
    z_box: FloatArray | None
    solution: Any
    ray: FloatArray | None
    impulse: FloatArray = field(repr=False)  # (m,) lambda, or (n + m,) x and lambda of a singular P
    qp: QuadraticProgram = field(repr=False)
    tol: float = 1e-6

    def __str__(self) -> str:
        if self.ray is not None:
            return (
                f"unbounded: the objective decreases without end along ray; at x it is {self.objective:.6g}"
            )
        # The status belongs to the constraint problem; the verdict on the program is `found`.
        status = "" if self.solution is None or self.found else f"{self.solution.status.name}, "
        if self.solution is not None and self.solution.claim_check == "not proven":
            status = f"{self.solution.status.name} (not proven), "
        if status == "CONVERGED, ":
            status = "the constraint problem CONVERGED, "
        verdict = "solved" if self.found else f"not solved to {self.tol:g}"
        conflict = "" if self.solution is None else self.solution.status_conflict
        conflict = f"; CONTRADICTED: {conflict}" if conflict else ""
        return f"{verdict}: {status}error {self.error:.1e}, objective {self.objective:.6g}{conflict}"

    @cached_property
    def _curvature(self) -> FloatArray:
        """P x (n,)."""
        return self.qp.times_hessian(self.x)

    @cached_property
    def _residuals(self) -> tuple[float, ...]:
        """r_p, r_d, gap, the three relative to their own terms, and the largest of these."""
        qp, multipliers, least_force = self.qp, self.qp.of_rows(self.impulse), 0.0
        if largest(qp.q) == 0.0:
            least_force = SHARE_OF_CURVATURE * float((abs(qp.hessian) @ np.abs(self.x)).max(initial=0.0))
        jac, order = qp.compressed_rows
        result: tuple[float, ...] = program_residuals(
            self.x, qp.q, self._curvature, qp.force(multipliers), qp.times_rows(self.x), qp.target, multipliers,
            qp.free, jac, self.x if order is None else self.x[order], qp.sizes_without_rows, least_force,
        )  # fmt: skip
        return result

    @property
    def objective(self) -> float:
        """1/2 x.P x + q.x."""
        return float(0.5 * self.x @ self._curvature + self.qp.q @ self.x)

    @property
    def primal_residual(self) -> float:
        """Largest violation of a row: |A x - b|, G x - h, lb - x, x - ub."""
        return self._residuals[0]

    @property
    def dual_residual(self) -> float:
        """max |P x + q + A^T y + G^T z + z_box|, or the largest negative z if that is more."""
        return self._residuals[1]

    @property
    def duality_gap(self) -> float:
        """|x.P x + q.x + b.y + h.z + bounds.z_box|."""
        return self._residuals[2]

    @property
    def error(self) -> float:
        """The largest of the three residuals, each relative to its own terms; 0 is a solution.

        Primal: the violation of each row relative to the largest of |J_ij x_j| and |target_i| of this row, but at most
        to the largest of |J x|, |target| and |x| over all acting rows, as in OSQP and Clarabel. If the row's terms
        vanish, as in x >= 0, it is relative to what the acting rows make of its variables. Dual: relative to the
        largest of |q|, |P x| and |J^T lambda|; if q is 0, to at least 1e-3 of the largest row of |P| |x|. Gap: relative
        to |objective|, or to 1e-3 of the sum of its terms if these cancel further; gaps of rows with opposite signs are
        added, not subtracted. A row that does not act enters no scale: one that is satisfied and has no multiplier, or
        is far from its bound.
        """
        return self._residuals[6]

    @property
    def found(self) -> bool:
        """Whether the error is at most `tol`, no ray or certificate shows that there is no solution, and the solver's
        claim is not contradicted.
        """
        if self.ray is not None or not self.error <= self.tol:
            return False
        solution = self.solution
        if solution is None:
            return True
        if solution.status.name == "INFEASIBLE":
            return bool(solution.claim_check == "not proven")
        return not solution.is_contradicted


@dataclass(frozen=True, eq=False)
class QuadraticProgram:
    """The program of a problem made by `Problem.from_qp` (`problem.qp`).

    Parameters
    ----------
    q : (n,)
    target : (m,)
        The right-hand sides of (2).
    free : int
        Rows of A and of variables with lb = ub, which come first.
    generalized : Generalized or None
        J of (2) and M = P; None if P is singular.
    singular : (P, J) or None
        Both as (indptr, indices, data) if P is singular, P with both triangles.
    n_equalities, n_inequalities : int or None
        Rows of A and of G as given; None without.
    kept : (mi,) int or None
        Rows of G that are in J; None: all.
    fixed, lower, upper : (n_f,), (n_l,), (n_u,) int, or None without lb and ub
        Variables of the rows of bounds.
    """

    q: FloatArray
    target: FloatArray
    free: int
    generalized: Generalized | None
    singular: tuple[Compressed, Compressed] | None
    n_equalities: int | None
    n_inequalities: int | None
    kept: IntpArray | None
    fixed: IntpArray | None
    lower: IntpArray | None
    upper: IntpArray | None

    @property
    def is_singular(self) -> bool:
        """Whether P is singular: the problem is (5), which solvers of quadratic programs take."""
        return self.generalized is None

    def problem_fields(self) -> dict[str, Any]:
        """Return the fields b, cones and matrix or generalized of the constraint problem."""
        if self.generalized is not None:
            cones = _one_sided(self.free, len(self.target))
            return {"b": self.generalized.bias(self.target), "cones": cones, "generalized": self.generalized}
        n, jac = len(self.q), self.jacobian
        matrix = sp.csr_array(sp.block_array([[self.hessian, -jac.T], [jac, None]], format="csr"))
        matrix.eliminate_zeros()
        matrix.sort_indices()
        b = np.concatenate([-self.q, self.target])
        return {"b": b, "cones": _one_sided(n + self.free, len(b)), "matrix": matrix}

    def with_bias(self, b: FloatArray) -> QuadraticProgram:
        """Return the program of a singular P whose right-hand side in (5) is b (n + m,)."""
        n = len(self.q)
        return replace(self, q=read_only(-b[:n]), target=read_only(b[n:].copy()))

    def with_saddle(self) -> QuadraticProgram:
        """Return the same program in the form (5), whatever P is."""
        if self.generalized is None:
            return self
        general = self.generalized
        hessian, jac = ((x.indptr, x.indices, x.data) for x in (general.mass, general.jac))
        return replace(self, generalized=None, singular=(hessian, jac))

    @cached_property
    def hessian(self) -> sp.csr_array:
        """P (n, n), both triangles."""
        if self.generalized is not None:
            return self.generalized.mass
        assert self.singular is not None
        return sp.csr_array(self.singular[0][::-1], shape=(len(self.q), len(self.q)))

    @cached_property
    def jacobian(self) -> sp.csr_array:
        """J (m, n)."""
        if self.generalized is not None:
            return self.generalized.jac
        assert self.singular is not None
        return sp.csr_array(self.singular[1][::-1], shape=(len(self.target), len(self.q)))

    @property
    def compressed_rows(self) -> tuple[Compressed, IntArray | None]:
        """J as (indptr, indices, data), and the variable of each of its columns; None: in order."""
        if self.generalized is not None:
            return self.generalized.operator.jac, self.generalized.order
        assert self.singular is not None
        return self.singular[1], None

    def times_hessian(self, x: FloatArray) -> FloatArray:
        """P x (n,)."""
        return self.hessian @ x if self.generalized is None else self.generalized.momentum_of(x)

    def times_rows(self, x: FloatArray) -> FloatArray:
        """J x (m,)."""
        return self.jacobian @ x if self.generalized is None else self.generalized.velocity_of(x)

    def force(self, multipliers: FloatArray) -> FloatArray:
        """J^T lambda (n,) of multipliers (m,)."""
        if self.generalized is None:
            return self.jacobian.T @ multipliers
        return self.generalized.force(multipliers)

    def sizes_without_rows(self) -> FloatArray:
        """(n,) Size of each variable without rows, |q_i| / P_ii or else |v*_i|, in the order of J's columns."""
        general = self.generalized
        if general is None:
            diagonal = self.hessian.diagonal()
            return np.divide(np.abs(self.q), diagonal, out=np.zeros(len(self.q)), where=diagonal > 0.0)
        ptr, _, value = general.operator.mass  # the lower triangle, diagonal last
        force, free = np.abs(self.q), np.abs(general.v_free)
        if general.order is not None:
            force, free = force[general.order], free[general.order]
        size = force / value[ptr[1:] - 1]
        out: FloatArray = np.where(size > 0.0, size, free)
        return out

    def variables(self, impulse: FloatArray) -> FloatArray:
        """x (n,) of the impulses (m,) of the constraint problem, or (n + m,) if P is singular."""
        if self.generalized is None:
            return impulse[: len(self.q)].copy()
        return self.generalized.v_free + self.generalized.change(impulse)

    def of_rows(self, impulse: FloatArray) -> FloatArray:
        """The multipliers lambda (m,) of the rows in impulses (m,) or (n + m,)."""
        return impulse[len(impulse) - len(self.target) :]

    def multipliers(
        self, impulse: FloatArray
    ) -> tuple[FloatArray | None, FloatArray | None, FloatArray | None]:
        """Return (y, z, z_box) of impulses, or of a certificate the proof that the program has no feasible point.

        `impulse` is (m,), or (n + m,) if P is singular. Of a certificate, A^T y + G^T z + z_box = 0 and
        b.y + h.z + (ub or lb).z_box < 0.
        """
        y = z = box = None
        impulse = self.of_rows(impulse)
        at, end = self.n_equalities or 0, len(impulse)
        if self.n_equalities is not None:
            y = -impulse[:at]
        if self.fixed is not None and self.lower is not None and self.upper is not None:
            box = np.zeros(len(self.q))
            box[self.upper] = impulse[end - len(self.upper) :]
            end -= len(self.upper)
            box[self.lower] -= impulse[end - len(self.lower) : end]
            end -= len(self.lower)
            box[self.fixed] = -impulse[at : self.free]
        if self.n_inequalities is not None:
            z = impulse[self.free : end]
            if self.kept is not None:
                every = np.zeros(self.n_inequalities)
                every[self.kept] = z
                z = every
        return y, z, box

    def solution(self, solution: Any, tol: float = 1e-6) -> QPSolution:
        """Return x, y, z and z_box of a `Solution` of this problem, or of its impulses.

        It is `found` if the error is at most `tol`.
        """
        impulse = getattr(solution, "impulse", None)
        of_solution = None if impulse is None else solution
        if impulse is None:
            size = len(self.target) + (len(self.q) if self.is_singular else 0)
            impulse = as_array("impulse", solution, (size,))
        y, z, box = self.multipliers(impulse)
        return QPSolution(
            x=self.variables(impulse), y=y, z=z, z_box=box, solution=of_solution, ray=None, impulse=impulse, qp=self,
            tol=tol,
        )  # fmt: skip


@lru_cache(maxsize=8)  # programs of one controller have the same
def _one_sided(free: int, m: int) -> Cones:
    low = np.zeros(m)
    low[:free] = -np.inf
    return Cones.bounded(low, np.inf)


def convert_program(given: Given) -> QuadraticProgram:
    """The program of P, q, G, h, A, b, lb, ub as a constraint problem; see `Problem.from_qp`."""
    P, q, G, h, A, b, lb, ub = given
    q = as_array("q", q, (None,))
    n = len(q)
    lower = _hessian(P, n)
    rows = _Rows(n)
    n_a, _ = rows.given("A", A, "b", b)
    fixed = low = up = None
    if lb is not None or ub is not None:
        lb, ub = (
            np.full(n, infinite) if x is None else as_array(name, x, (n,), finite=False)
            for name, x, infinite in (("lb", lb, -np.inf), ("ub", ub, np.inf))
        )
        _check_bounds(lb, ub)
        equal = lb == ub
        fixed, low, up = (
            np.flatnonzero(on) for on in (equal, (lb > -INFINITE) > equal, (ub < INFINITE) > equal)
        )
        rows.bounds(fixed, lb, 1.0)
    free = rows.m
    n_g, kept = rows.given("G", G, "h", h)
    if low is not None and up is not None:
        rows.bounds(low, lb, 1.0)
        rows.bounds(up, ub, -1.0)
    jac, target = rows.stacked
    general = _definite(lower, jac, q)
    return QuadraticProgram(
        q=q, target=read_only(target), free=free, generalized=general,
        singular=None if general is not None else (mirrored(*lower), jac), n_equalities=n_a, n_inequalities=n_g,
        kept=kept, fixed=fixed, lower=low, upper=up,
    )  # fmt: skip


def program_of_matrix(matrix: sp.csr_array, b: FloatArray, cones: Cones, n: int) -> QuadraticProgram:
    """Return the program of n variables whose problem (5) has this matrix, right-hand side and bounds.

    Its equations count as A x = b, its other rows as G x <= h.

    Raises
    ------
    InputError
        They do not have the form (5), or P is not positive semidefinite.
    """
    jac, hessian = sp.csr_array(matrix[n:, :n]), sp.csr_array(matrix[:n, :n])
    free = int(np.count_nonzero(np.isneginf(cones.lower[n:])))
    if matrix[n:, n:].nnz or abs(matrix[:n, n:] + jac.T).nnz or cones != _one_sided(n + free, len(b)):
        raise InputError(f"the problem is not that of a quadratic program of {n} variables")
    lower = lower_of("P", hessian, "give both triangles")
    rows = compressed("J", jac)
    _definite(lower, rows, -b[:n])
    return QuadraticProgram(
        q=read_only(-b[:n]), target=read_only(b[n:].copy()), free=free, generalized=None,
        singular=(mirrored(*lower), rows), n_equalities=free, n_inequalities=len(b) - n - free, kept=None, fixed=None,
        lower=None, upper=None,
    )  # fmt: skip


# -- what is given ------------------------------------------------------------------------------------


def unpack_program(given: Given) -> Given:
    """The eight arrays; the first may be a `qpsolvers.Problem`, or another object with these eight attributes."""
    P = given[0]
    if given[1] is not None and not hasattr(P, "ub"):
        return given
    names = ("P", "q", "G", "h", "A", "b", "lb", "ub")
    if not all(hasattr(P, name) for name in names):
        raise InputError(
            f"P is a {type(P).__name__}, q None; P and q are needed, or a qpsolvers.Problem alone"
        )
    if any(x is not None for x in given[1:]):
        raise InputError("a qpsolvers.Problem holds all arrays: give it alone")
    return tuple(getattr(P, name) for name in names)


def _matrix(name: str, given: Any, n: int, sign: float) -> Compressed:
    """Rows of a dense or sparse matrix of n columns times a sign, without zeros, checked; one dimension is one row."""
    sparse = issparse(given)
    if not sparse:
        dense = as_array_view(name, given, (None,) * max(1, len(shape_of(name, given))))
        given = dense[None] if dense.ndim == 1 else dense
    if len(given.shape) != 2 or given.shape[1] != n:
        raise InputError(f"{name} has shape {given.shape}; (any, {n}) is needed, as q has {n} entries")
    return compressed(name, given, sign) if sparse else dense_to_csr(given, sign)


def _hessian(P: Any, n: int) -> Compressed:
    """P's lower triangle with its diagonal."""
    if shape_of("P", P) != (n, n):
        raise InputError(f"P has shape {shape_of('P', P)}; ({n}, {n}) is needed, as q has {n} entries")
    return lower_of("P", P, "give both triangles, or (P + P^T) / 2, which has the same x.P x")


class _Rows:
    """J and target of (2), put together from above."""

    def __init__(self, n: int) -> None:
        self.n, self.m = n, 0
        self.parts = list[Compressed]()
        self.targets = list[FloatArray]()

    def put(self, rows: Compressed, target: FloatArray) -> None:
        self.parts.append(rows)
        self.targets.append(target)
        self.m += len(target)

    @property
    def stacked(self) -> tuple[Compressed, FloatArray]:
        """J and target, all parts one under another."""
        if len(self.parts) == 1:
            return self.parts[0], self.targets[0]
        parts = [(*rows, False, 1.0, len(rows[0]) - 1) for rows in self.parts]
        return stacked(self.n, parts), np.concatenate([np.zeros(0), *self.targets])

    def bounds(self, at: IntpArray, bound: FloatArray, sign: float) -> None:
        """sign x_i >= sign bound_i of these variables."""
        k = len(at)
        rows = np.arange(k + 1, dtype=np.int32), at.astype(np.int32), np.full(k, sign)
        self.put(rows, sign * bound[at])

    def given(self, name: str, matrix: Any, side: str, vector: Any) -> tuple[int | None, IntpArray | None]:
        """A or G; how many rows were given, and which of them are put here: None, all; not those with h infinite."""
        if (matrix is None) != (vector is None):
            missing = name if matrix is None else side
            raise InputError(f"{missing} is missing: {name} and {side} go together")
        if matrix is None:
            return None, None
        rows = _matrix(name, matrix, self.n, 1.0 if name == "A" else -1.0)
        m = len(rows[0]) - 1
        if name == "A":
            self.put(rows, as_array(side, vector, (m,)))
            return m, None
        right, kept = as_array(side, vector, (m,), finite=False), None
        if not (all_finite(right) and (right < INFINITE).all()):
            check_not_nan(side, right)
            kept = np.flatnonzero(right < INFINITE)
            rows, right = _picked(rows, kept), right[kept]
            if not all_finite(right):
                raise InputError(f"h is -inf at [{kept[np.argmin(right)]}]: no x is below it")
        self.put(rows, -right)
        return m, kept


def _picked(rows: Compressed, kept: IntpArray) -> Compressed:
    ptr, idx, val = rows
    size = np.diff(ptr)
    on = np.repeat(np.isin(np.arange(len(size)), kept), size)
    return np.concatenate([[0], np.cumsum(size[kept])]).astype(np.int32), idx[on], val[on]


def _check_bounds(lb: FloatArray, ub: FloatArray) -> None:
    bad = np.flatnonzero(~((lb <= ub) & (lb < np.inf) & (ub > -np.inf)))
    if len(bad):
        i = bad[0]
        raise InputError(
            f"variable {i}: lb = {lb[i]}, ub = {ub[i]}; lb <= ub is needed, and a number between them"
        )


# -- P that is singular -------------------------------------------------------------------------------


def _definite(lower: Compressed, jac: Compressed, q: FloatArray) -> Generalized | None:
    """Return J and M = P of (4), or None if P is singular.

    Raises
    ------
    InputError
        P is not positive semidefinite.
    """
    momentum, unfactored = -q, Generalized.from_validated(jac, lower)
    definite = _shifted(unfactored, np.zeros(len(q)), momentum)
    if definite is not None and definite.operator.least_pivot > SINGULAR:
        return definite
    diagonal = lower[2][lower[0][1:] - 1]
    zero = diagonal == 0.0
    shift = np.where(zero, diagonal.max(initial=0.0) or 1.0, SHIFT * diagonal)
    if not _rows_are_empty(lower, zero) or _shifted(unfactored, shift, momentum) is None:
        check_sizes("the diagonal of P", np.abs(diagonal))
        raise InputError(f"P is not positive semidefinite: {_least_eigenvalue(lower, diagonal)}")
    return None


def _shifted(unfactored: Generalized, d: FloatArray, momentum: FloatArray) -> Generalized | None:
    """Return J and P + diag(d), or None if that is not positive definite."""
    try:
        return unfactored.shifted(d, momentum)
    except InputError:
        return None


def _rows_are_empty(lower: Compressed, zero: FloatArray) -> bool:
    """Return whether rows and columns with a zero diagonal have no entries; otherwise P is indefinite."""
    ptr, idx, val = lower
    beside = (zero[idx] | np.repeat(zero, np.diff(ptr))) & (val != 0.0)
    return not beside.any()


def _least_eigenvalue(lower: Compressed, diagonal: FloatArray) -> str:
    n = len(diagonal)
    if n <= MAX_EIGENVALUE_SIZE:
        ptr, idx, val = lower
        dense = np.zeros((n, n))
        dense[np.repeat(np.arange(n), np.diff(ptr)), idx] = val
        value = np.linalg.eigvalsh(dense)  # which reads the lower triangle
        return f"its least eigenvalue is {value[0]:.3g}, its largest {value[-1]:.3g}"
    i = int(np.argmin(diagonal))
    return f"P + {SHIFT:g} diag(P) has no Cholesky factor; the least diagonal entry is P[{i}, {i}] = {diagonal[i]:.3g}"
