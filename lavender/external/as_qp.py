"""Convert a problem to a convex program, in one of three forms.

All forms are written as

    min 1/2 x.P x + q.x    subject to   A x + s = b,  s in {0}^z x R+^k x second-order cones,   lb <= x <= ub

with multipliers zeta of the rows and xi of the bounds:  P x + q + A^T zeta + xi = 0. The impulses of an answer are

    lambda = sigma S (r + R [x; zeta; xi]),                                                                      (1)

clipped to their bounds, with a diagonal S and a matrix R, whose entries are 1 and -1.

Impulse form, lambda = sigma S x, S = D^-1/2 (with `unit_diagonal`, else one number for all rows):

    P = S A S,  q = -S b / sigma,  bounds of lambda;  friction  |x_t| <= a x_n,  a = mu S_n / S_t

Velocity form, from `Problem.velocity_form` (K, theta, g; y = M^1/2 times the change of velocity), S = D^-1/2:

    min 1/2 |y|^2 + 1/2 |p|^2 - (K~^T r).(y, p) + (u - l).t,   K~ = [K, theta^1/2],  w = K~ (y, p) - g

    free row                w = 0                          r = 0
    only a lower bound      w >= 0                         r = l
    both bounds             w + t >= 0, t >= 0             r = l, the multiplier does not exceed u - l
    only an upper bound     -w >= 0                        r = u
    disk and spin           w_n - a_s t >= a |w_t|,  t >= |w_s|;  a second disk likewise, t >= a_r |w_r|

with lambda = sigma S (r + T zeta), and the rows A = -T^T K~ (without the columns of t). The unknowns are the velocities
y, one p for each soft row, and t; J J^T is never formed.

Program form, of a quadratic program (`Problem.from_qp`): the user's own P, q, A, G and bounds. S is one number for all
variables and another for all rows, the geometric mean of r^-1/2, with r_i the largest entry of row i of (5) of
`problem/program.py`; sigma is the root mean square of r^-1/2 times the violation of the rows of (5) at zero. All three
are rounded to powers of PROGRAM_UNIT, so that a backend receives the user's numbers in every bit if they are near 1.
Backends equilibrate rows and columns themselves: with a second equilibration here, piqp 0.7 reported that a feasible
public program is infeasible.

In the first two forms, sigma = max(E0 / sqrt(m), V0 sqrt(heaviest mass)), with the residual E0, V0 of the zero
impulse, makes the program free of units, with unknowns near 1 also at large mass ratios; a residual of x times sigma is
a residual of the judge. Rows with a known impulse are removed: lower = upper, friction with mu = 0, rows of A that are
zero. Rows and contacts that b pushes to a bound by more than MAX_SCALED_RHS times the size of the unknowns (for example
at placeholder bounds) are also removed, because the tolerance of a backend is relative to its largest number.
`QPSolver` checks at the solution that the removed rows are at their bounds.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import FloatArray, check_choice
from lavender.base.errors import CapabilityError
from lavender.base.lazy_import import sparse as sp
from lavender.judge.certificates import check_certificate
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.problem import Problem

PROGRAM_FORMS = ("impulse", "velocity", "program", "auto")
IntpArray = npt.NDArray[np.intp]
MAX_BACKEND_NUMBER = 1e20  # Backends treat larger numbers as infinite, or fail.
# [-] A row with a larger scaled |b| is assumed to stay at its bound and is removed. Active rows have a scaled b near
# 1, and a b of 10^k costs a backend k digits. If the assumption fails, the backend is called once more with all rows.
MAX_SCALED_RHS = 1e2
# [-] Value of MAX_SCALED_RHS for programs with a singular P. It is larger, because |x| often exceeds the active bounds.
MAX_SCALED_SINGULAR_RHS = 1e6
# At and above this mass ratio, the velocity form is more accurate at all sizes.
VELOCITY_FORM_MASS_RATIO = 1e3
# [-] A matrix counts as singular if a squared pivot of its Cholesky factor is at most this multiple of the diagonal.
MAX_SINGULAR_PIVOT = 1e-10
# [-] Added to the unit diagonal of a singular P for backends for a definite P. With a smaller shift, rounding errors of
# the inverse of P exceed the change of the answer, which is about the shift.
DEFINITE_SHIFT = 1e-8
# With more rows, only the numbers of rows and of velocities show whether A is singular.
MAX_PIVOT_ROWS = 1000
PROGRAM_UNIT = 16.0  # Power of two, larger than the differences of scale that matter to a backend.
#: A friction component in scaled unknowns, |x_t / a_t| <= x_n: the row of x_n, the rows of x_t, and a_t of each.
FrictionComponent = tuple[int, tuple[int, ...], tuple[float, ...]]
Entries = list[tuple[int, float]]  # (column, value) of each entry of a row of a matrix.


@dataclass(frozen=True)
class _ScaledProblem:
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
    def from_problem(cls, problem: Problem, fix_above: float) -> _ScaledProblem:
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
class QP(_ScaledProblem):
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


def choose_program_form(problem: Problem, form: str, definite: bool = False) -> str:
    """Choose the form of the program: "impulse", "velocity" or "program".

    Parameters
    ----------
    problem : Problem
    form : {"impulse", "velocity", "program", "auto"}
        "auto" chooses the program form for a quadratic program (`Problem.from_qp`), and else the velocity form

        - for bodies or J and M if `definite` is set,
        - for bodies if m exceeds its number of unknowns, without those of soft rows, or if the mass ratio is at least
          VELOCITY_FORM_MASS_RATIO,
        - for J and M if A is singular.
    definite : bool
        Whether the backend needs a positive definite P.

    Raises
    ------
    InputError
        The form is unknown.
    CapabilityError
        The problem does not have this form.
    """
    form, rows = check_choice("form", form, PROGRAM_FORMS), problem.rows
    if form == "program" and problem.qp is None:
        raise CapabilityError("form='program' needs a quadratic program (Problem.from_qp)")
    if form in ("impulse", "velocity") and problem.has_singular_program:
        raise CapabilityError(f"form={form!r} needs a positive definite P; P of this program is singular")
    if form == "velocity" and problem.matrix is not None:
        raise CapabilityError(
            "form='velocity' needs a problem with bodies (Problem.from_rows, without ellipses) or J and M "
            "(Problem.from_jacobian); this one is a matrix"
        )
    if form != "auto":
        return form
    if problem.qp is not None:
        return "program"
    if rows is None:
        is_singular = problem.generalized is not None and (definite or _has_singular_delassus(problem))
        return "velocity" if is_singular else "impulse"
    moving = rows.inv_mass[rows.inv_mass > 0.0]
    ratio = moving.max() / moving.min() if len(moving) else 1.0
    n_slacks = np.count_nonzero(np.isfinite(problem.cones.lower) & np.isfinite(problem.cones.upper))
    is_smaller = problem.m > 6 * rows.n_bodies + n_slacks
    return "velocity" if definite or is_smaller or ratio >= VELOCITY_FORM_MASS_RATIO else "impulse"


def _has_singular_delassus(problem: Problem) -> bool:
    """Return whether A of a problem with J and M is singular."""
    assert problem.generalized is not None
    if np.count_nonzero(problem.compliance == 0.0) > problem.generalized.nv:
        return True
    if problem.m > MAX_PIVOT_ROWS:
        return False
    root = 1.0 / np.sqrt(problem.d)
    return _is_singular(root[:, None] * problem.dense() * root)


def _is_singular(matrix: FloatArray) -> bool:
    """Return whether a semidefinite matrix is singular up to rounding errors."""
    try:
        pivots = np.square(np.linalg.cholesky(matrix).diagonal())
    except np.linalg.LinAlgError:
        return True
    return bool((pivots <= MAX_SINGULAR_PIVOT * matrix.diagonal()).any())


def shift_to_definite(qp: QP) -> QP:
    """Return the program with DEFINITE_SHIFT on the diagonal of P if P is singular."""
    if qp.is_definite or not _is_singular(qp.P.toarray()):
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


def build_program(problem: Problem, form: str, *, fix_far_rows: bool = False, **options: Any) -> QP:
    """Build the program in the given form.

    Parameters
    ----------
    problem : Problem
    form : {"impulse", "velocity", "program"}
    fix_far_rows : bool
        Whether to remove rows that b pushes far into a bound (MAX_SCALED_RHS).
    **options
        Options of `build_impulse_form`.
    """
    threshold = MAX_SCALED_SINGULAR_RHS if problem.has_singular_program else MAX_SCALED_RHS
    scaled = _ScaledProblem.from_problem(problem, threshold if fix_far_rows else np.inf)
    build: Any = {
        "impulse": _build_impulse_form,
        "velocity": _build_velocity_form,
        "program": _build_program_form,
    }
    qp: QP = build[form](scaled, **options)
    if len(qp.b) or (qp.lb is not None and qp.ub is not None and np.isfinite([qp.lb, qp.ub]).any()):
        return qp
    # Many backends need a row or a bound, and qpsolvers passes programs without them to LSQR: add 0 x <= 1.
    values, bounds = qp.recovery[:, : qp.n], sp.csr_matrix((len(qp.root), 1 + qp.n))
    recovery, row = sp.csr_matrix(sp.hstack([values, bounds])), sp.csc_matrix((1, qp.n))
    return replace(qp, A=row, b=np.ones(1), n_nonneg=1, lb=None, ub=None, recovery=recovery)


def _build_impulse_form(scaled: _ScaledProblem, unit_diagonal: bool = True) -> QP:
    """Build the impulse form: min 1/2 l.A l - b.l over the bounds or friction cones of a symmetric problem.

    Parameters
    ----------
    scaled : _ScaledProblem
    unit_diagonal : bool
        Whether to scale by D^-1/2. If false, all rows are scaled by one number, so that P is a multiple of A.
    """
    problem, unknown, sigma, k = scaled.problem, scaled.unknown_rows, scaled.sigma, len(scaled.unknown_rows)
    if not unit_diagonal and k:
        scaled.root[:] = np.exp(np.mean(np.log(scaled.root)))
    c, root, a = problem.cones, scaled.root, problem.csr
    p = _mirror_lower_triangle(a[unknown][:, unknown], root)
    q = -root * (problem.b - (a @ scaled.fixed if scaled.fixed.any() else 0.0))[unknown] / sigma
    lb, ub = c.lower[unknown] / (root * sigma), c.upper[unknown] / (root * sigma)
    components = scaled.list_friction_components()
    linear: list[Entries] = []
    conic: list[Entries] = []
    for n, tangents, ratios in components:
        # A pair gives s = a x_n - x_t >= 0 and s = a x_n + x_t >= 0, a disk gives s = (a x_n, x_t) in a second-order
        # cone.
        a_n = ratios[0]
        if len(tangents) == 1:
            linear += [[(n, -a_n), (tangents[0], sign)] for sign in (1.0, -1.0)]
        else:
            conic += [[(n, -a_n)], *([(t, -a_n / a_t)] for t, a_t in zip(tangents, ratios, strict=True))]
    matrix = _build_matrix(linear + conic, k).tocsc()
    r = matrix.shape[0]
    return QP(
        **vars(scaled),
        form="impulse",
        P=p,
        q=q,
        A=matrix,
        b=np.zeros(r),
        n_zero=0,
        n_nonneg=len(linear),
        soc=_list_cone_sizes(components),
        lb=None if c.is_free else lb,
        ub=None if c.is_free else ub,
        recovery=sp.csr_matrix(sp.eye_array(k, k + r + k)),
        shift=np.zeros(k),
    )


def _build_velocity_form(scaled: _ScaledProblem) -> QP:
    """Build the mass-scaled velocity form of a problem with bodies or J and M."""
    problem, unknown, root, sigma = scaled.problem, scaled.unknown_rows, scaled.root, scaled.sigma
    form, c, k = problem.velocity_form(), problem.cones, len(unknown)
    # Form K~ = [K, theta^1/2].
    jac, theta = sp.csr_matrix(form.jacobian), form.theta[unknown]
    soft = np.flatnonzero(theta > 0.0)
    root_theta = sp.csr_matrix((np.sqrt(theta[soft]), (soft, np.arange(len(soft)))), shape=(k, len(soft)))
    velocity_map = sp.csr_matrix(sp.hstack([jac[unknown], root_theta]))
    ny = velocity_map.shape[1]
    g = form.rhs[unknown] / sigma
    # Classify bounded rows as free, with a lower bound, with both bounds, or with an upper bound.
    low, high = c.lower[unknown] / (root * sigma), c.upper[unknown] / (root * sigma)
    components = scaled.list_friction_components()
    is_bounded = np.ones(k, bool)
    is_bounded[[i for n, tangents, _ in components for i in (n, *tangents)]] = False
    has_low, has_high = is_bounded & np.isfinite(low), is_bounded & np.isfinite(high)
    free, upper = np.flatnonzero(is_bounded & ~has_low & ~has_high), np.flatnonzero(has_high & ~has_low)
    both = np.flatnonzero(has_low & has_high)
    shift = np.where(has_low, low, np.where(has_high, high, 0.0))
    t_of_row = dict(zip(both.tolist(), range(ny, ny + len(both)), strict=True))
    rows, n_friction = _list_velocity_rows(components, free, np.flatnonzero(has_low), upper, ny, t_of_row)
    n, r = ny + len(both) + n_friction, len(rows)
    # Form the rows A = -T^T K~, and append the columns of t.
    transposed = _build_matrix([multipliers for multipliers, _ in rows], k)
    velocities = -(transposed @ velocity_map)
    velocities.resize(r, n)
    q = np.zeros(n)
    known = np.zeros(ny)
    known[: jac.shape[1]] = jac.T @ (scaled.fixed / (form.scale * sigma))
    q[:ny] = -(velocity_map.T @ shift) - known
    q[ny : ny + len(both)] = high[both] - low[both]
    velocity_map.resize(k, n)
    is_slack = np.arange(n) >= ny
    return QP(
        **vars(scaled),
        form="velocity",
        P=sp.csc_matrix(sp.diags_array(np.where(is_slack, 0.0, 1.0))),
        q=q,
        A=sp.csc_matrix(velocities + _build_matrix([slacks for _, slacks in rows], n)),
        b=-(transposed @ g),
        n_zero=len(free),
        n_nonneg=r - len(free) - sum(_list_cone_sizes(components)),
        soc=_list_cone_sizes(components),
        lb=np.where(is_slack, 0.0, -np.inf) if n > ny else None,
        ub=np.full(n, np.inf) if n > ny else None,
        recovery=sp.csr_matrix(sp.hstack([sp.csr_matrix((k, n)), transposed.T, sp.csr_matrix((k, n))])),
        shift=shift,
        slack_map=velocity_map,
        slack_rhs=g,
    )


def _list_velocity_rows(
    components: list[FrictionComponent],
    free: IntpArray,
    lower: IntpArray,
    upper: IntpArray,
    ny: int,
    t_of_row: dict[int, int],
) -> tuple[list[tuple[Entries, Entries]], int]:
    """List the rows of the velocity form: entries of a column of T, and of the unknowns t, for each row of A.

    Parameters
    ----------
    components : list of FrictionComponent
    free, lower, upper : (k,) int
        Rows without friction that are free, have a lower bound, or have only an upper bound.
    ny : int
        Number of velocities, which the unknowns t follow.
    t_of_row : dict
        Unknown t of each row with both bounds.

    Returns
    -------
    rows, n_friction : list of (entries, entries), int
        The rows, and the number of unknowns t of friction, which follow those of `t_of_row`.
    """
    rows: list[tuple[Entries, Entries]] = [([(i, -1.0)], []) for i in free.tolist()]
    rows += [([(i, 1.0)], [(t_of_row[i], -1.0)] if i in t_of_row else []) for i in lower.tolist()]
    rows += [([(i, -1.0)], []) for i in upper.tolist()]
    first = ny + len(t_of_row)
    new, t_of_normal = itertools.count(first), dict[int, Entries]()
    # A friction component of one row has t >= |w_t|.
    for normal, tangents, ratios in components:
        if len(tangents) == 1:
            t = next(new)
            t_of_normal.setdefault(normal, []).append((t, ratios[0]))
            rows += [([(tangents[0], sign)], [(t, -1.0)]) for sign in (-1.0, 1.0)]
    # The second disk of a contact has t >= |w|.
    disks = [x for x in components if len(x[1]) > 1]
    t_of_disk: dict[int, int] = {}
    for k, (one, two) in enumerate(itertools.pairwise(disks), 1):
        if one[0] == two[0]:
            t_of_disk[k] = next(new)
            t_of_normal.setdefault(two[0], []).append((t_of_disk[k], 1.0))
    # Normals without a disk have w_n >= sum of a t; disks are second-order cones.
    has_disk = {disk[0] for disk in disks}
    rows += [([(normal, 1.0)], entries) for normal, entries in t_of_normal.items() if normal not in has_disk]
    for k, (normal, tangents, ratios) in enumerate(disks):
        is_second = k in t_of_disk
        rows.append(
            ([], [(t_of_disk[k], -1.0)]) if is_second else ([(normal, 1.0)], t_of_normal.get(normal, []))
        )
        rows += [([(tangent, ratio)], []) for tangent, ratio in zip(tangents, ratios, strict=True)]
    return rows, next(new) - first


def _build_program_form(scaled: _ScaledProblem) -> QP:
    """Build the program form of a quadratic program."""
    qp, unknown = scaled.problem.qp, scaled.unknown_rows
    n, m = len(qp.q), len(qp.target)
    # With a singular P, the first impulses are the variables.
    offset = n if qp.is_singular else 0
    variables = unknown[unknown < n] if offset else np.arange(n)
    n_x, k = len(variables), len(unknown)
    n_shared = n_x if offset else 0
    rows = unknown[n_shared:] - offset
    # Scale by the largest entries of the rows of (5) and their violations at x = 0.
    sizes = np.zeros(n + m)
    for matrix, row_first in ((qp.generalized.mass, 0), (qp.generalized.jac, n)):
        row_of_entry = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
        for first, index in ((row_first, row_of_entry), (0, matrix.indices)):
            np.maximum.at(sizes, first + index, np.abs(matrix.data))
    violation = np.concatenate([np.abs(qp.q), np.maximum(qp.target, 0.0)])
    violation[n : n + qp.free] = np.abs(qp.target[: qp.free])
    parts = variables, n + rows
    roots = [1.0 / np.sqrt(sizes[part]) for part in parts]
    squares = [(root * violation[part]) ** 2 for root, part in zip(roots, parts, strict=True)]
    sigma = _round_unit(np.sqrt(np.mean(np.concatenate(squares))))
    unit, row_unit = (_round_unit(np.exp(np.mean(np.log(root)))) if len(root) else 1.0 for root in roots)
    # Classify the rows of `problem/program.py` (2): A, fixed variables, G, lower and upper bounds.
    none = np.zeros(0, np.intp)
    fixed, lower, upper = (none if at is None else at for at in (qp.fixed, qp.lower, qp.upper))
    n_a, n_g = qp.free - len(fixed), m - qp.free - len(lower) - len(upper)
    kind = np.repeat(range(5), [n_a, len(fixed), n_g, len(lower), len(upper)])[rows]
    variable = np.concatenate([np.zeros(n_a, int), fixed, np.zeros(n_g, int), lower, upper])[rows]
    index_of = np.zeros(n, int)
    index_of[variables] = np.arange(n_x)
    at, sign = index_of[variable], np.array([-1.0, -1.0, 1.0, -1.0, 1.0])[kind]
    is_general = (kind == 0) | (kind == 2)
    general = np.flatnonzero(is_general)
    r = len(general)
    root = np.where(is_general, row_unit, 1.0 / unit)
    jac, hessian = qp.generalized.jac, qp.generalized.mass
    if len(rows) < m or n_x < n:
        jac, hessian = jac[rows][:, variables], hessian[variables][:, variables]
    entries = jac.data * np.repeat(root * unit, np.diff(jac.indptr))
    jac = sp.csr_matrix((entries, jac.indices, jac.indptr), jac.shape)
    target = root * qp.target[rows] / sigma
    lb, ub = np.full(n_x, -np.inf), np.full(n_x, np.inf)
    is_lower, is_fixed, is_upper = (kind == 1) | (kind == 3), kind == 1, kind == 4
    lb[at[is_lower]], ub[at[is_fixed]], ub[at[is_upper]] = (
        target[is_lower],
        target[is_fixed],
        -target[is_upper],
    )
    # The multipliers of rows, then of bounds, in the order of the rows of the problem.
    column = np.where(is_general, np.cumsum(is_general) - 1, r + at) + n_x
    columns = np.concatenate([np.arange(n_shared), column])
    recovery = (np.concatenate([np.ones(n_shared), sign]), columns, np.arange(k + 1))
    has_bounds = r < len(rows)
    fields = vars(scaled) | {"root": np.concatenate([np.full(n_shared, unit), root]), "sigma": sigma}
    flip, matrix = -sign[general], jac[general] if has_bounds else jac.copy()
    matrix.data *= np.repeat(flip, np.diff(matrix.indptr))
    return QP(
        **fields,
        form="program",
        P=sp.csc_matrix(hessian * unit**2),
        q=qp.q[variables] * unit / sigma,
        A=sp.csc_matrix(matrix),
        b=flip * target[general],
        n_zero=int(np.count_nonzero(kind == 0)),
        n_nonneg=int(np.count_nonzero(kind == 2)),
        soc=(),
        lb=lb if has_bounds else None,
        ub=ub if has_bounds else None,
        recovery=sp.csr_matrix(recovery, (k, n_x + r + n_x)),
        shift=np.zeros(k),
        slack_map=None if offset else jac,
        slack_rhs=None if offset else target,
        variable_unit=unit,
    )


def _round_unit(x: float) -> float:
    """Round a positive number to a power of PROGRAM_UNIT; return 1 for 0."""
    return float(PROGRAM_UNIT ** np.round(np.log(x) / np.log(PROGRAM_UNIT))) if x > 0.0 else 1.0


def _list_cone_sizes(components: list[FrictionComponent]) -> tuple[int, ...]:
    """Return the size of the second-order cone of each component of several rows."""
    return tuple(1 + len(tangents) for _, tangents, _ in components if len(tangents) > 1)


def _mirror_lower_triangle(matrix: sp.csr_array, root: FloatArray) -> sp.csc_matrix:
    """Return diag(root) A diag(root) from the lower triangle of A, with both triangles equal in every bit."""
    entries = matrix.tocoo()
    is_lower = entries.row >= entries.col
    i, j = entries.row[is_lower], entries.col[is_lower]
    value, off = entries.data[is_lower] * (root[i] * root[j]), i > j
    data = np.concatenate([value, value[off]])
    return sp.csc_matrix((data, (np.concatenate([i, j[off]]), np.concatenate([j, i[off]]))), matrix.shape)


def _build_matrix(rows: list[Entries], columns: int) -> sp.csr_matrix:
    """Build a sparse matrix from the entries of its rows."""
    entries = [entry for row in rows for entry in row]
    ptr = np.cumsum([0, *map(len, rows)])
    data, index = np.array([x for _, x in entries], float), np.array([i for i, _ in entries], int)
    return sp.csr_matrix((data, index, ptr), (len(rows), columns))


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
