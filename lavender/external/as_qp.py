"""A convex program, the conversion of its solutions to impulses, and its rows as backends expect them.

All programs are written as

    min 1/2 x.P x + q.x    subject to   A x + s = b,  s in {0}^z x R+^k x second-order cones,   lb <= x <= ub

with multipliers zeta of the rows and xi of the bounds:  P x + q + A^T zeta + xi = 0. The impulses of an answer are

    lambda = sigma S (r + R [x; zeta; xi]),                                                                      (1)

clipped to their bounds, with a diagonal S and a matrix R, whose entries are 1 and -1. `forms.py` builds these arrays in
three forms.

In the impulse and velocity forms, sigma = max(E0 / sqrt(m), V0 sqrt(heaviest mass)), with the residual E0, V0 of the
zero impulse, makes the program free of units, with unknowns near 1 also at large mass ratios; a residual of x times
sigma is a residual of the judge. Rows with a known impulse are removed: lower = upper, friction with mu = 0, rows of A
that are zero. Rows and contacts that b pushes to a bound by more than MAX_SCALED_RHS times the size of the unknowns
(for example at placeholder bounds) are also removed, because the tolerance of a backend is relative to its largest
number. `QPSolver` checks at the solution that the removed rows are at their bounds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import FloatArray
from lavender.base.lazy_import import sparse as sp
from lavender.judge.certificates import check_certificate
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.problem import Problem

IntpArray = npt.NDArray[np.intp]
MAX_BACKEND_NUMBER = 1e20  # Backends treat larger numbers as infinite, or fail.
# [-] A matrix counts as singular if a squared pivot of its Cholesky factor is at most this multiple of the diagonal.
MAX_SINGULAR_PIVOT = 1e-10
# [-] Added to the unit diagonal of a singular P for backends for a definite P. With a smaller shift, rounding errors of
# the inverse of P exceed the change of the answer, which is about the shift.
DEFINITE_SHIFT = 1e-8
#: A friction component in scaled unknowns, |x_t / a_t| <= x_n: the row of x_n, the rows of x_t, and a_t of each.
FrictionComponent = tuple[int, tuple[int, ...], tuple[float, ...]]


@dataclass(frozen=True)
class ScaledProblem:
    """Unknown rows, known impulses and scaling of a problem, which all forms use.

    Parameters
    ----------
    problem : Problem
    unknown_rows : (k,) int
        Rows of the problem with impulses that are unknowns of the program.
    fixed : (m,), N s
        Known impulses of the other rows; 0 for unknown rows.
    assumed : (n,) int
        Rows that are assumed to stay at their bound.
    root : (k,), kg^1/2
        S.
    sigma : float, J^1/2
    """

    problem: Problem
    unknown_rows: IntpArray
    fixed: FloatArray
    assumed: IntpArray
    root: FloatArray
    sigma: float

    @classmethod
    def from_problem(cls, problem: Problem, fix_above: float) -> ScaledProblem:
        """Scale a problem; fix rows at a bound that b pushes into it by more than `fix_above`."""
        c = problem.cones
        known = (c.lower == c.upper) & np.isfinite(c.lower)
        fixed = np.where(known, c.lower, 0.0)
        size = np.diff(c.ptr)
        has_own_bound = np.repeat(~c.is_contact | (size == 1), size)
        for i in np.asarray(problem.metric.empty, int):
            # The row of A is zero, so w = -b, and the sign of b determines the bound. If that bound is infinite, no
            # solution exists, which the validation of the input reports.
            if has_own_bound[i]:
                bound = c.upper[i] if problem.b[i] > 0.0 else c.lower[i] if problem.b[i] < 0.0 else 0.0
                known[i] = True
                fixed[i] = np.clip(bound if np.isfinite(bound) else 0.0, c.lower[i], c.upper[i])
        known[c.friction_rows] = c.friction_coefficient[c.friction_rows] == 0.0
        sigma, assumed = _compute_energy_scale(problem), np.zeros(0, np.intp)
        if fix_above < np.inf:
            assumed, bounds = _find_far_rows(problem, sigma, fix_above)
            assumed, bounds = assumed[~known[assumed]], bounds[~known[assumed]]
            known[assumed], fixed[assumed] = True, bounds
        unknown = np.flatnonzero(~known)
        return cls(problem, unknown, fixed, assumed, 1.0 / np.sqrt(problem.d[unknown]), sigma)

    def list_friction_components(self) -> list[FrictionComponent]:
        """Return the friction components with indices of unknown rows."""
        c = self.problem.cones
        index_of = np.full(self.problem.m, -1)
        index_of[self.unknown_rows] = np.arange(len(self.unknown_rows))
        components: list[FrictionComponent] = []
        for block, rows in c.friction_components():
            normal, tangents = int(index_of[c.ptr[block]]), index_of[list(rows)]
            if tangents[0] >= 0:
                ratios = c.friction_coefficient[list(rows)] * self.root[normal] / self.root[tangents]
                components.append((normal, tuple(tangents.tolist()), tuple(ratios.tolist())))
        return components


@dataclass(frozen=True)
class QP(ScaledProblem):
    """A convex program, and the conversion of its solutions; see the module. All arrays are free of units.

    Parameters
    ----------
    form : {"impulse", "velocity", "program"}
    P : (n, n)
        Symmetric, both triangles, equal in every bit.
    q : (n,)
    A, b : (r, n), (r,)
        Rows with s = 0, then s >= 0, then second-order cones.
    n_zero : int
        Number of rows with s = 0.
    n_nonneg : int
        Number of rows with s >= 0.
    soc : tuple of int
        Sizes of the second-order cones.
    lb, ub : (n,) or None
        Bounds; None without any.
    recovery : (k, n + r + n)
        R of (1).
    shift : (k,)
        r of (1).
    slack_map, slack_rhs : (k, n), (k,), or None
        w = sigma S^-1 (slack_map x - slack_rhs); None in the impulse form and for a singular P.
    variable_unit : float
        Variables of a quadratic program are sigma variable_unit x.
    shift_of_p : float
        Multiple of the diagonal of P that was added to P.
    """

    form: str
    P: sp.csc_matrix
    q: FloatArray
    A: sp.csc_matrix
    b: FloatArray
    n_zero: int
    n_nonneg: int
    soc: tuple[int, ...]
    lb: FloatArray | None
    ub: FloatArray | None
    recovery: sp.csr_matrix
    shift: FloatArray
    slack_map: sp.csr_matrix | None = None
    slack_rhs: FloatArray | None = None
    variable_unit: float = 1.0
    shift_of_p: float = 0.0

    @property
    def n(self) -> int:
        """Number n of unknowns x of the program."""
        return len(self.q)

    @property
    def nbytes(self) -> int:
        """Size [bytes] of the matrices of the program and of the problem."""
        matrices = (x for x in (self.P, self.A, self.recovery, self.slack_map) if x is not None)
        program = sum(x.data.nbytes + x.indices.nbytes for x in matrices)
        matrix = self.problem.matrix
        return program + (0 if matrix is None else getattr(matrix, "data", matrix).nbytes)

    @property
    def is_representable(self) -> bool:
        """Whether all numbers are below MAX_BACKEND_NUMBER. Lower bounds may be -inf, upper bounds inf.

        Unless the scaling overflows, the numbers are near 1.
        """
        numbers = (self.P.data, self.q, self.A.data, self.b)
        if not all(np.abs(x).max(initial=0.0) < MAX_BACKEND_NUMBER for x in numbers):
            return False
        if not all(np.isfinite(x).all() for x in (self.root, self.shift, self.fixed)):
            return False
        return (
            self.lb is None or self.ub is None or bool((self.lb < np.inf).all() and (self.ub > -np.inf).all())
        )

    @property
    def is_definite(self) -> bool:
        """Whether P is known to be positive definite: the velocity form without t, and programs with such a P."""
        if self.form == "velocity":
            return bool(self.P.diagonal().all())
        return self.form == "program" and not self.problem.has_singular_program

    def recover_impulse(self, x: FloatArray, zeta: FloatArray, xi: FloatArray) -> FloatArray:
        """Compute lambda (m,) [N s] by (1), clipped to constant bounds."""
        lam = self.fixed.copy()
        z = self.shift + self.recovery @ np.concatenate([x, zeta, xi])
        lam[self.unknown_rows] = self.sigma * self.root * z
        c = self.problem.cones
        return np.clip(lam, c.lower, c.upper, out=lam)

    def recover_certificate(self, x: FloatArray | None, zeta: FloatArray | None) -> FloatArray | None:
        """Compute a certificate (m,) of infeasibility from a backend's certificate; None without a candidate.

        zeta are multipliers that prove that the rows contradict each other, x is a direction in which the objective
        decreases without limit.
        """
        n, r, c = self.n, len(self.b), self.problem.cones
        rays = []
        if zeta is not None and len(zeta) == r:
            # Backends return multipliers of rows only. Those of bounds follow from A^T zeta + xi = 0.
            rays.append(np.concatenate([np.zeros(n), zeta, -(self.A.T @ zeta)]))
        if x is not None and len(x) == n:
            rays.append(np.concatenate([x, np.zeros(r + n)]))
        candidates = []
        for ray in rays:
            y = np.zeros(self.problem.m)
            y[self.unknown_rows] = self.root * (self.recovery @ ray)
            # Remove rounding errors outside of the recession cone of the bounds.
            y = np.clip(
                y, np.where(np.isfinite(c.lower), 0.0, -np.inf), np.where(np.isfinite(c.upper), 0.0, np.inf)
            )
            size = np.abs(y).max(initial=0.0)
            if 0.0 < size < np.inf:
                candidates.append(y / size)
        proofs = (y for y in candidates if check_certificate(self.problem, y) is None)
        return next(proofs, candidates[0] if candidates else None)

    def recover_bound_multiplier(self, x: FloatArray, xi: FloatArray) -> FloatArray:
        """Compute the multipliers z (m,) [m/s] of the bounds of lambda that the backend's answer implies.

        An exact answer has A lambda - b + z = 0. In the impulse form, z is xi in units of the problem; in the other
        forms, it is -w of the backend's velocities, and NaN for a singular P. Rows that were removed from the impulse
        form have z = -w.
        """
        z, unit = np.zeros(self.problem.m), self.sigma / self.root
        if self.form == "impulse":
            lam = self.fixed.copy()
            lam[self.unknown_rows] = self.sigma * self.root * x
            z = -self.problem.slack(lam) if np.isfinite(lam).all() else np.full(self.problem.m, np.nan)
            z[self.unknown_rows] = xi * unit
        elif self.slack_map is None:
            z[:] = np.nan
        else:
            z[self.unknown_rows] = -(self.slack_map @ x - self.slack_rhs) * unit
        return z

    def make_start(self, impulse: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Compute (x, zeta, xi) from a start (m,) [N s], for programs without second-order cones.

        Values and multipliers of bounds are complementary: both are split from their sum by the projection to the
        bounds.
        """
        z = impulse[self.unknown_rows] / (self.sigma * self.root) - self.shift
        x, zeta, xi = np.split(self.recovery.T @ z, [self.n, self.n + len(self.b)])
        zeta[self.n_zero :] = np.maximum(zeta[self.n_zero :], 0.0)
        curvature = self.P.diagonal()
        if self.form == "velocity":
            has_cost = curvature > 0.0
            x = np.where(has_cost, -(self.q + self.A.T @ zeta), 0.0)
            x = np.where(has_cost, x, np.maximum(self.A.T @ (self.b - self.A @ x), 0.0))
        elif self.form == "program" and self.is_definite:
            x = self.problem.qp.recover_variables(impulse) / (self.sigma * self.variable_unit)
        if self.lb is None or self.ub is None:
            return x, zeta, xi
        unit = np.where(curvature > 0.0, curvature, 1.0)
        if self.form != "program":
            xi = -(self.P @ x + self.q + self.A.T @ zeta)
        total = x + xi / unit
        x = np.clip(total, self.lb, self.ub)
        return x, zeta, (total - x) * unit


def is_singular(matrix: FloatArray) -> bool:
    """Return whether a semidefinite matrix is singular up to rounding errors."""
    try:
        pivots = np.square(np.linalg.cholesky(matrix).diagonal())
    except np.linalg.LinAlgError:
        return True
    return bool((pivots <= MAX_SINGULAR_PIVOT * matrix.diagonal()).any())


def shift_to_definite(qp: QP) -> QP:
    """Return the program with DEFINITE_SHIFT on the diagonal of P if P is singular."""
    if qp.is_definite or not is_singular(qp.P.toarray()):
        return qp
    p = sp.csc_matrix(qp.P + sp.diags_array(DEFINITE_SHIFT * qp.P.diagonal()))
    return replace(qp, P=p, shift_of_p=DEFINITE_SHIFT)


def compute_backend_tolerance(qp: QP, tol: float) -> float:
    """Compute the tolerance eps [-] of a backend, for which the judge's relative residual is at most `tol`.

    If the residual of each unknown is at most eps,

    E <= sqrt(m) sigma eps,  V <= max sqrt(nu) sigma eps
    """
    problem = qp.problem
    energy, velocity = get_zero_impulse_reference(problem)
    sizes = np.sqrt(problem.m), np.sqrt(problem.metric.nu.max(initial=0.0))
    limits = [
        start / (size * qp.sigma)
        for start, size in zip((energy, velocity), sizes, strict=True)
        if start > 0.0 and size > 0.0
    ]
    return float(tol * min([1.0, *limits]))


def _find_far_rows(problem: Problem, sigma: float, threshold: float) -> tuple[IntpArray, FloatArray]:
    """Find rows that b pushes into a bound by more than `threshold`; return their indices and impulses at that bound.

    A contact is found with all of its rows or not at all.
    """
    c, push = problem.cones, problem.b / (np.sqrt(problem.d) * sigma)
    bound = np.where(push < 0.0, c.lower, c.upper)
    is_far = (np.abs(push) > threshold) & np.isfinite(bound) & ~c.friction_rows
    # Include all rows of a contact if its normal row is far; far friction rows alone do not count.
    first = np.repeat(c.ptr[:-1], np.diff(c.ptr))
    is_far_friction = c.friction_rows & is_far[first]
    rows = np.flatnonzero(is_far | is_far_friction)
    return rows, np.where(is_far_friction, 0.0, bound)[rows]


def _compute_energy_scale(problem: Problem) -> float:
    """Compute sigma = max(E0 / sqrt(m), V0 sqrt(heaviest mass)) [J^1/2]; 1 if it is 0 or not finite."""
    energy, velocity = get_zero_impulse_reference(problem)
    if problem.has_singular_program:
        heaviest = 0.0
    elif problem.rows is None:
        d = problem.d
        heaviest = 1.0 / d.min() if len(d) else 0.0
    else:
        moving = problem.rows.inv_mass[problem.rows.inv_mass > 0.0]
        heaviest = 1.0 / moving.min() if len(moving) else 0.0
    sigma = max(energy / np.sqrt(max(problem.m, 1)), velocity * np.sqrt(heaviest))
    return float(sigma) if 0.0 < sigma < np.inf else 1.0


# -- rows and bounds, as backends expect them ---------------------------------------------------------


def list_finite_bounds(qp: QP) -> list[tuple[float, IntpArray, FloatArray]]:
    """Return (sign, indices, h) of the finite upper, then of the finite lower bounds: sign x[indices] <= h."""
    if qp.lb is None or qp.ub is None:
        return []
    indices = [np.flatnonzero(np.isfinite(bound)) for bound in (qp.ub, qp.lb)]
    return [(1.0, indices[0], qp.ub[indices[0]]), (-1.0, indices[1], -qp.lb[indices[1]])]


def make_bound_rows(qp: QP) -> tuple[sp.csr_matrix, FloatArray]:
    """Return the bounds of `list_finite_bounds` as rows C x <= h."""
    bounds = [(np.full(len(at), sign), at, h) for sign, at, h in list_finite_bounds(qp)]
    signs, indices, rhs = (
        (np.concatenate(x) for x in zip(*bounds, strict=True)) if bounds else [np.zeros(0)] * 3
    )
    return sp.csr_matrix((signs, indices.astype(int), np.arange(len(rhs) + 1)), (len(rhs), qp.n)), rhs


def merge_bound_multipliers(qp: QP, z: FloatArray) -> FloatArray:
    """Compute xi (n,) from the multipliers z; its first entries belong to the rows of `make_bound_rows`."""
    xi, first = np.zeros(qp.n), 0
    for sign, indices, _ in list_finite_bounds(qp):
        xi[indices] += sign * z[first : first + len(indices)]
        first += len(indices)
    return xi


@dataclass(frozen=True)
class ConicRows:
    """Rows A x + s = b of a program with its bounds: zero cone, nonnegative cone, second-order cones.

    Parameters
    ----------
    A, b : (r, n), (r,)
    n_nonneg : int
        Size of the nonnegative cone, which ends with the rows of the bounds.
    """

    qp: QP
    A: sp.csc_matrix
    b: FloatArray
    n_nonneg: int

    @classmethod
    def from_program(cls, qp: QP) -> ConicRows:
        """Append the bounds to the rows of the nonnegative cone."""
        first, (bounds, h) = qp.n_zero + qp.n_nonneg, make_bound_rows(qp)
        rows = sp.vstack([qp.A[:first], bounds, qp.A[first:]]) if len(qp.b) else bounds
        rhs = np.concatenate([qp.b[:first], h, qp.b[first:]])
        return cls(qp, sp.csc_matrix(rows), rhs, qp.n_nonneg + len(rhs) - len(qp.b))

    def split_multipliers(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (zeta, xi) of the multipliers z (r,)."""
        first, last = self.qp.n_zero + self.qp.n_nonneg, self.qp.n_zero + self.n_nonneg
        return np.concatenate([z[:first], z[last:]]), merge_bound_multipliers(self.qp, z[first:])

    def join_multipliers(self, zeta: FloatArray, xi: FloatArray) -> FloatArray:
        """Return z (r,) of the multipliers zeta and xi."""
        first = self.qp.n_zero + self.qp.n_nonneg
        bounds = (np.maximum(sign * xi[at], 0.0) for sign, at, _ in list_finite_bounds(self.qp))
        return np.concatenate([zeta[:first], *bounds, zeta[first:]])


def make_two_sided_rows(qp: QP, identity: bool) -> tuple[sp.csc_matrix, FloatArray, FloatArray]:
    """Return C, l and u of the rows l <= C x <= u; with `identity`, the bounds of x are appended as rows."""
    low = np.full(len(qp.b), -np.inf)
    low[: qp.n_zero] = qp.b[: qp.n_zero]
    if not identity or qp.lb is None or qp.ub is None:
        return qp.A, low, qp.b
    rows = sp.csc_matrix(sp.vstack([qp.A, sp.eye_array(qp.n)]))
    return rows, np.concatenate([low, qp.lb]), np.concatenate([qp.b, qp.ub])
