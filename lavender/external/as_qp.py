"""Convert a problem to a convex program, in one of three forms.

All forms are written as

    min 1/2 x.P x + q.x    subject to   A x + s = b,  s in {0}^z x R+^k x second-order cones,   lb <= x <= ub

with multipliers zeta of the rows and xi of the bounds:  P x + q + A^T zeta + xi = 0.

Impulse form, x = S^-1 lambda / sigma, S = D^-1/2 (with `unit_diagonal`, else one number for all rows):

    P = S A S,  q = -S b / sigma,  bounds of lambda;  friction  |x_t| <= a x_n,  a = mu S_n / S_t

Velocity form, from `Problem.velocity_form` (K, theta, g; y = M^1/2 times the change of velocity):

    min 1/2 |y|^2 + 1/2 |p|^2 - (K~^T r).(y, p) + (u - l).t,   K~ = [K, theta^1/2],  w = K~ (y, p) - g

    free row                w = 0                          r = 0
    only a lower bound      w >= 0                         r = l
    both bounds             w + t >= 0, t >= 0             r = l, the multiplier does not exceed u - l
    only an upper bound     -w >= 0                        r = u
    disk and spin           w_n - a_s t >= a |w_t|,  t >= |w_s|;  a second disk likewise, t >= a_r |w_r|

with z = r + T zeta, lambda = sigma S z, and the rows A = -T^T K~ (without the columns of t). The unknowns are the
velocities y, one p for each soft row, and t; J J^T is never formed.

Program form, of a quadratic program with a singular P (`Problem.from_qp`; `problem/program.py` (5)): the program with
lb and ub for the bounds. S is one number for all variables and another for all rows, the geometric mean of r^-1/2,
with r_i the largest entry of row i of (5); sigma is the root mean square of r^-1/2 times the violation of the rows of
(5) at zero.

sigma = max(E0 / sqrt(m), V0 sqrt(heaviest mass)), with the residual E0, V0 of the zero impulse, makes the first two
forms free of units, with unknowns near 1 also at large mass ratios; a residual of x times sigma is a residual of the
judge. Rows with a known impulse are removed: lower = upper, friction with mu = 0, rows of A that are zero. Rows and
contacts that b pushes to a bound by more than MAX_SCALED_RHS times the size of the unknowns (for example at
placeholder bounds) are also removed, because the tolerance of a backend is relative to its largest number. `QPSolver`
checks at the solution that the removed rows are at their bounds.
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

PROGRAM_FORMS = ("impulse", "velocity", "auto")
IntpArray = npt.NDArray[np.intp]
MAX_BACKEND_NUMBER = 1e20  # Backends treat larger numbers as infinite, or fail.
# [-] A row with a larger scaled |b| is assumed to stay at its bound and is removed. Active rows have a scaled b near
# 1, and a b of 10^k costs a backend k digits. If the assumption fails, the backend is called once more with all rows.
MAX_SCALED_RHS = 1e2
# [-] Value of MAX_SCALED_RHS in the program form. It is larger, because |x| often exceeds the active bounds.
MAX_SCALED_PROGRAM_RHS = 1e6
# At and above this mass ratio, the velocity form is more accurate at all sizes.
VELOCITY_FORM_MASS_RATIO = 1e3


@dataclass(frozen=True)
class _Disk:
    """Friction component in scaled unknowns: the norm of x_t / a_t over its tangents t is at most x_n.

    It is a disk of two tangents with equal a_t, or a round cone.

    Parameters
    ----------
    normal : int
        Row of x_n.
    tangents : tuple of int
        Rows of x_t.
    ratios : tuple of float
        a_t of each tangent.
    """

    normal: int
    tangents: tuple[int, ...]
    ratios: tuple[float, ...]


@dataclass(frozen=True)
class _FrictionRows:
    """Friction components of the unknown rows, with a = mu S_n / S_t (times r for spin) in scaled unknowns.

    Parameters
    ----------
    pairs : list of (normal row, friction row, a)
        Components of one row, |x| <= a x_n.
    disks : list of _Disk
        Components of several rows.
    """

    pairs: list[tuple[int, int, float]]
    disks: list[_Disk]

    @property
    def cone_sizes(self) -> tuple[int, ...]:
        """Size of the second-order cone of each disk."""
        return tuple(1 + len(disk.tangents) for disk in self.disks)

    @property
    def all_rows(self) -> list[int]:
        """All rows of all components."""
        return [i for p in self.pairs for i in p[:2]] + [
            i for d in self.disks for i in (d.normal, *d.tangents)
        ]


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
    def from_problem(cls, problem: Problem, unit_diagonal: bool, fix_far_rows: bool) -> _ScaledProblem:
        """Scale a problem; with `fix_far_rows`, fix rows at a bound that b pushes far into it (MAX_SCALED_RHS)."""
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
        if fix_far_rows:
            threshold = MAX_SCALED_PROGRAM_RHS if problem.has_singular_program else MAX_SCALED_RHS
            assumed, bounds = _find_far_rows(problem, sigma, threshold)
            assumed, bounds = assumed[~known[assumed]], bounds[~known[assumed]]
            known[assumed], fixed[assumed] = True, bounds
        unknown = np.flatnonzero(~known)
        d = problem.d[unknown]
        if not unit_diagonal and len(d):
            d = np.full(len(d), np.exp(np.mean(np.log(d))))
        return cls(problem, unknown, fixed, assumed, 1.0 / np.sqrt(d), sigma)

    def map_friction_rows(self) -> _FrictionRows:
        """Return the friction components with indices of unknown rows."""
        c = self.problem.cones
        coefficient = c.friction_coefficient
        unknown_of_row = np.full(self.problem.m, -1)
        unknown_of_row[self.unknown_rows] = np.arange(len(self.unknown_rows))
        pairs: list[tuple[int, int, float]] = []
        disks: list[_Disk] = []
        for block, rows in c.friction_components():
            if unknown_of_row[rows[0]] < 0:
                continue
            normal = int(unknown_of_row[c.ptr[block]])
            tangents = [int(unknown_of_row[row]) for row in rows]
            ratios = [
                float(coefficient[row] * self.root[normal] / self.root[t])
                for row, t in zip(rows, tangents, strict=True)
            ]
            if len(rows) == 1:
                pairs.append((normal, tangents[0], ratios[0]))
            else:
                disks.append(_Disk(normal, tuple(tangents), tuple(ratios)))
        return _FrictionRows(pairs, disks)


@dataclass(frozen=True)
class QP(_ScaledProblem):
    """A convex program, and the conversion of its solutions; see the module. All arrays are free of units.

    Parameters
    ----------
    form : {"impulse", "velocity", "program"}
    P : (n, n)
        Symmetric, both triangles.
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
    multiplier_map : (k, r)
        T of the velocity form.
    shift : (k,)
        r of the velocity form.
    velocity_map : (k, n - number of t)
        K~ of the velocity form.
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
    multiplier_map: sp.csr_matrix
    shift: FloatArray
    velocity_map: sp.csr_matrix

    @property
    def n(self) -> int:
        """Number n of unknowns x of the program."""
        return len(self.q)

    @property
    def nbytes(self) -> int:
        """Size [bytes] of the matrices of the program and of the problem."""
        matrices = self.P, self.A, self.multiplier_map, self.velocity_map
        program = sum(x.data.nbytes + x.indices.nbytes for x in matrices)
        matrix = self.problem.matrix
        return program + (0 if matrix is None else getattr(matrix, "data", matrix).nbytes)

    @property
    def is_bounds_only(self) -> bool:
        """Whether the program has no rows and no finite bounds: a backend may treat it as unconstrained."""
        no_bound = self.lb is None or self.ub is None or not np.isfinite([self.lb, self.ub]).any()
        return len(self.b) == 0 and no_bound

    @property
    def is_representable(self) -> bool:
        """Whether all numbers are below MAX_BACKEND_NUMBER. Lower bounds may be -inf, upper bounds inf.

        Unless the scaling overflows, the numbers are near 1.
        """
        numbers = (self.P.data, self.q, self.A.data, self.b)
        if not all(np.abs(x).max(initial=0.0) < MAX_BACKEND_NUMBER for x in numbers):
            return False
        if not (
            np.isfinite(self.root).all() and np.isfinite(self.shift).all() and np.isfinite(self.fixed).all()
        ):
            return False
        return (
            self.lb is None or self.ub is None or bool(np.all(self.lb < np.inf) and np.all(self.ub > -np.inf))
        )

    @property
    def is_definite(self) -> bool:
        """Whether P is positive definite: the velocity form without unknowns t."""
        return self.form == "velocity" and self.n == self.velocity_map.shape[1]

    def recover_impulse(self, x: FloatArray, zeta: FloatArray, xi: FloatArray) -> FloatArray:
        """Compute lambda (m,) [N s], clipped to constant bounds, from a solution x and its multipliers zeta and xi.

        Only the program form uses xi.
        """
        lam = self.fixed.copy()
        z = x if self.form == "impulse" else self.shift + self.multiplier_map @ zeta
        lam[self.unknown_rows] = self.sigma * self.root * z
        c = self.problem.cones
        return np.clip(lam, c.lower, c.upper, out=lam)

    def recover_certificate(self, x: FloatArray | None, zeta: FloatArray | None) -> FloatArray | None:
        """Compute a certificate (m,) of infeasibility from a backend's certificate; None without a valid one.

        In the impulse form x is a direction in which the objective is unbounded, in the velocity form zeta are
        multipliers that prove that the rows contradict each other.
        """
        vector = x if self.form == "impulse" else zeta
        if vector is None or len(vector) != (self.n if self.form == "impulse" else len(self.b)):
            return None
        y = np.zeros(self.problem.m)
        y[self.unknown_rows] = self.root * (
            vector if self.form == "impulse" else self.multiplier_map @ vector
        )
        c = self.problem.cones
        # Remove rounding errors outside of the recession cone of the bounds.
        y = np.clip(
            y, np.where(np.isfinite(c.lower), 0.0, -np.inf), np.where(np.isfinite(c.upper), 0.0, np.inf)
        )
        size = np.abs(y).max(initial=0.0)
        return y / size if 0.0 < size < np.inf else None

    def recover_bound_multiplier(self, x: FloatArray, xi: FloatArray) -> FloatArray:
        """Compute the multipliers z (m,) [m/s] of the bounds of lambda that the backend's answer implies.

        An exact answer has A lambda - b + z = 0. In the impulse form, z is xi in units of the problem; in the velocity
        form, it is -w of the backend's velocities. Rows that were removed from the program have z = -w.
        """
        if self.form == "impulse":
            lam = self.fixed.copy()
            lam[self.unknown_rows] = self.sigma * self.root * x
            if not np.isfinite(lam).all():
                return np.full(self.problem.m, np.nan)
            z = -self.problem.slack(lam)
            z[self.unknown_rows] = xi * (self.sigma / self.root)
            return z
        z = np.zeros(self.problem.m)
        g = self.problem.b[self.unknown_rows] * (self.root / self.sigma)
        z[self.unknown_rows] = -(self.velocity_map @ x[: self.velocity_map.shape[1]] - g) * (
            self.sigma / self.root
        )
        return z

    def make_start(self, impulse: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Compute (x, zeta, xi) from a start (m,) [N s], for programs without second-order cones."""
        z = impulse[self.unknown_rows] / (self.sigma * self.root)
        xi = np.zeros(self.n)
        if self.form == "impulse":
            if self.lb is not None and self.ub is not None:
                gradient = self.P @ z + self.q
                at_low, at_high = z <= self.lb, z >= self.ub
                xi = np.where(at_low, np.minimum(-gradient, 0.0), 0.0) + np.where(
                    at_high, np.maximum(-gradient, 0.0), 0.0
                )
            # In the equality form, P x = b and P (x + zeta) = 0: the multipliers are zeta = -x.
            return z, -z if len(self.b) else np.zeros(0), xi
        ny = self.velocity_map.shape[1]
        zeta = self.multiplier_map.T @ (z - self.shift)
        zeta[self.n_zero :] = np.maximum(zeta[self.n_zero :], 0.0)
        x = np.zeros(self.n)
        x[:ny] = self.velocity_map.T @ (self.multiplier_map @ zeta) - self.q[:ny]
        x[ny:] = np.maximum(self.A[:, ny:].T @ (self.A[:, :ny] @ x[:ny] - self.b) * -1.0, 0.0)
        return x, zeta, xi


def choose_program_form(problem: Problem, form: str, definite: bool = False) -> str:
    """Choose the form of the program, "impulse" or "velocity".

    Parameters
    ----------
    problem : Problem
    form : {"impulse", "velocity", "auto"}
        "auto" chooses the velocity form for a problem with bodies or J and M if m exceeds six times the number of
        bodies, if the mass ratio is at least VELOCITY_FORM_MASS_RATIO, or if `definite` is set.
    definite : bool
        Whether the backend needs a positive definite P.

    Raises
    ------
    InputError
        The form is unknown.
    CapabilityError
        `form` is "velocity", and the problem is a matrix.
    """
    form = check_choice("form", form, PROGRAM_FORMS)
    rows = problem.rows
    if form == "velocity" and rows is None:
        raise CapabilityError(
            "form='velocity' needs a problem with rows (Problem.from_rows) and without ellipses; this one is a matrix"
        )
    if form != "auto":
        return form
    if rows is None:
        return "impulse"
    moving = rows.inv_mass[rows.inv_mass > 0.0]
    ratio = moving.max() / moving.min() if len(moving) else 1.0
    return (
        "velocity"
        if definite or problem.m > 6 * rows.n_bodies or ratio >= VELOCITY_FORM_MASS_RATIO
        else "impulse"
    )


def compute_backend_tolerance(problem: Problem, tol: float) -> float:
    """Compute the tolerance eps [-] of a backend, for which the judge's relative residual is at most `tol`.

    If the residual of each unknown is at most eps,

    E <= sqrt(m) sigma eps,  V <= max sqrt(nu) sigma eps
    """
    energy, velocity = get_zero_impulse_reference(problem)
    sigma = _compute_energy_scale(problem)
    limits = [
        start / (size * sigma)
        for start, size in (
            (energy, np.sqrt(problem.m)),
            (velocity, np.sqrt(problem.metric.nu.max(initial=0.0))),
        )
        if start > 0.0 and size > 0.0
    ]
    return tol * min([1.0, *limits])


def build_impulse_form(
    problem: Problem, *, unit_diagonal: bool = True, equality: bool = False, fix_far_rows: bool = False
) -> QP:
    """Build the impulse form: min 1/2 l.A l - b.l over the bounds or friction cones of a symmetric problem.

    Parameters
    ----------
    problem : Problem
    unit_diagonal : bool
        Whether to scale by D^-1/2. If false, all rows are scaled by one number, so that P is a multiple of A.
    equality : bool
        Write a linear system as min 1/2 x.P x subject to P x = -q, for backends that need a row.
    fix_far_rows : bool
        Whether to remove rows that b pushes far into a bound (MAX_SCALED_RHS).
    """
    scaled = _ScaledProblem.from_problem(problem, unit_diagonal, fix_far_rows)
    c, unknown, root, sigma = problem.cones, scaled.unknown_rows, scaled.root, scaled.sigma
    a = problem.csr
    scale = sp.diags_array(root)
    p = sp.csc_matrix(scale @ a[unknown][:, unknown] @ scale)
    b = problem.b - (a @ scaled.fixed if scaled.fixed.any() else 0.0)
    q = -root * b[unknown] / sigma
    rows, k = scaled.map_friction_rows(), len(unknown)
    lb = ub = None
    if not problem.cones.is_free:
        lb, ub = c.lower[unknown] / (root * sigma), c.upper[unknown] / (root * sigma)
    matrix, rhs, n_zero = sp.csc_matrix((0, k)), np.zeros(0), 0
    if equality:
        matrix, rhs, n_zero, q = p, -q, k, np.zeros(k)
    elif rows.all_rows:
        # A pair gives s = a x_n - x_t >= 0 and s = a x_n + x_t >= 0, a disk gives s = (a x_n, x_t) in a second-order
        # cone.
        builder = _RowBuilder()
        for n, t, ratio in rows.pairs:
            builder.add_row([(n, -ratio), (t, 1.0)])
            builder.add_row([(n, -ratio), (t, -1.0)])
        for disk in rows.disks:
            builder.add_row([(disk.normal, -disk.ratios[0])])
            for t, ratio in zip(disk.tangents, disk.ratios, strict=True):
                builder.add_row([(t, -disk.ratios[0] / ratio)])
        matrix = builder.build_matrix(k)
        rhs = np.zeros(matrix.shape[0])
    return QP(
        **vars(scaled),
        form="impulse",
        P=p,
        q=q,
        A=matrix,
        b=rhs,
        n_zero=n_zero,
        n_nonneg=2 * len(rows.pairs),
        soc=rows.cone_sizes,
        lb=lb,
        ub=ub,
        multiplier_map=sp.csr_matrix((k, len(rhs))),
        shift=np.zeros(k),
        velocity_map=sp.csr_matrix((k, 0)),
    )


def build_velocity_form(problem: Problem, *, fix_far_rows: bool = False) -> QP:
    """Build the mass-scaled velocity form of a problem with rows.

    The parameter `fix_far_rows` is described at `build_impulse_form`.
    """
    form = problem.velocity_form()
    scaled = _ScaledProblem.from_problem(problem, True, fix_far_rows)
    c, unknown, root, sigma = problem.cones, scaled.unknown_rows, scaled.root, scaled.sigma
    k = len(unknown)
    # Form K~ = [K, theta^1/2].
    jac = sp.csr_matrix(form.jacobian)
    theta = form.theta[unknown]
    soft = np.flatnonzero(theta > 0.0)
    root_theta = sp.csr_matrix((np.sqrt(theta[soft]), (soft, np.arange(len(soft)))), shape=(k, len(soft)))
    velocity_map = sp.csr_matrix(sp.hstack([jac[unknown], root_theta]))
    ny = velocity_map.shape[1]
    g = form.rhs[unknown] / sigma
    # Classify bounded rows as free, with a lower bound, with both bounds, or with an upper bound.
    low, high = c.lower[unknown] / (root * sigma), c.upper[unknown] / (root * sigma)
    rows = scaled.map_friction_rows()
    is_bounded_row = np.ones(k, bool)
    is_bounded_row[rows.all_rows] = False
    has_low, has_high = np.isfinite(low), np.isfinite(high)
    free = np.flatnonzero(is_bounded_row & ~has_low & ~has_high)
    lower = np.flatnonzero(is_bounded_row & has_low)
    both = np.flatnonzero(is_bounded_row & has_low & has_high)
    upper = np.flatnonzero(is_bounded_row & ~has_low & has_high)
    shift = np.zeros(k)
    shift[lower], shift[upper] = low[lower], high[upper]
    # Form the rows A = -T^T K~, and append the columns of t.
    columns_of_t, t_entries, n, n_normals = _build_velocity_rows(rows, free, lower, both, upper, ny)
    multiplier_map = sp.csr_matrix(columns_of_t.build_matrix(k).T)
    velocities = sp.hstack(
        [-(multiplier_map.T @ velocity_map), sp.csc_matrix((multiplier_map.shape[1], n - ny))]
    )
    matrix = sp.csc_matrix(velocities + t_entries.build_matrix(n))
    q = np.zeros(n)
    known = np.zeros(ny)
    known[: jac.shape[1]] = jac.T @ (scaled.fixed / (form.scale * sigma))
    q[:ny] = -(velocity_map.T @ shift) - known
    q[ny : ny + len(both)] = high[both] - low[both]
    lb = ub = None
    if n > ny:
        lb, ub = np.full(n, -np.inf), np.full(n, np.inf)
        lb[ny:] = 0.0
    diagonal = np.zeros(n)
    diagonal[:ny] = 1.0
    n_nonneg = len(lower) + len(upper) + 2 * len(rows.pairs) + n_normals
    return QP(
        **vars(scaled),
        form="velocity",
        P=sp.csc_matrix(sp.diags_array(diagonal)),
        q=q,
        A=matrix,
        b=-(multiplier_map.T @ g),
        n_zero=len(free),
        n_nonneg=n_nonneg,
        soc=rows.cone_sizes,
        lb=lb,
        ub=ub,
        multiplier_map=multiplier_map,
        shift=shift,
        velocity_map=velocity_map,
    )


@dataclass(frozen=True)
class ProgramQP(QP):
    """The program form: a quadratic program in the units S and sigma, with the conversion of its solutions.

    Parameters
    ----------
    n_x : int
        Number of unknown rows that are variables; they are the first ones of `unknown_rows`.
    general : (r,) int
        Rows of the problem that are rows of A.
    signs : (r,)
        Factor from zeta to the multiplier of `problem/program.py`: -1 for equations, 1 for rows of G.
    bounds : tuple of (sign, rows, indices)
        Bounds of variables: sign of xi, rows of the problem, and indices of the bounded variables.
    """

    n_x: int
    general: IntpArray
    signs: FloatArray
    bounds: tuple[tuple[float, IntpArray, IntpArray], ...]

    def recover_impulse(self, x: FloatArray, zeta: FloatArray, xi: FloatArray) -> FloatArray:
        """Return x and the multipliers (m,), clipped to constant bounds."""
        c, lam = self.problem.cones, self.fixed.copy()
        lam[self.unknown_rows[: self.n_x]] = self.sigma * self.root[: self.n_x] * x
        lam += self.sigma * self._recover_row_multipliers(zeta, xi)
        return np.clip(lam, c.lower, c.upper, out=lam)

    def _recover_row_multipliers(self, zeta: FloatArray, xi: FloatArray) -> FloatArray:
        """Return lambda / sigma (m,) from the multipliers zeta of general rows and xi of bounds of the program.

        The entries of variables, and of bounds with a multiplier of the wrong sign, are 0.
        """
        lam, scale = np.zeros(self.problem.m), np.zeros(self.problem.m)
        scale[self.unknown_rows] = self.root
        lam[self.general] = scale[self.general] * self.signs * zeta
        for sign, rows, at in self.bounds:
            force = xi[at] / self.root[at]
            lam[rows] = -force if sign == 0.0 else np.maximum(sign * force, 0.0)
        return lam

    def recover_certificate(self, x: FloatArray | None, zeta: FloatArray | None) -> FloatArray | None:
        """Compute a certificate (m,) of infeasibility from zeta or x.

        zeta gives multipliers of contradicting rows; x gives a direction in which the objective decreases without
        limit.
        """
        candidates = []
        if zeta is not None and len(zeta) == len(self.b):
            # Backends return multipliers of rows only. Those of bounds follow from A^T zeta + xi = 0.
            candidates.append(self._recover_row_multipliers(zeta, -(self.A.T @ zeta)))
        if x is not None and len(x) == self.n:
            y = np.zeros(self.problem.m)
            y[self.unknown_rows[: self.n_x]] = self.root[: self.n_x] * x
            candidates.append(y)
        c = self.problem.cones
        candidates = [np.where(np.isfinite(c.lower), np.maximum(y, 0.0), y) for y in candidates]
        candidates = [y / np.abs(y).max() for y in candidates if 0.0 < np.abs(y).max() < np.inf]
        proofs = (y for y in candidates if check_certificate(self.problem, y) is None)
        return next(proofs, candidates[0] if candidates else None)

    def recover_bound_multiplier(self, x: FloatArray, xi: FloatArray) -> FloatArray:
        """Return NaN (m,), because the program form has no multipliers of the bounds of lambda."""
        return np.full(self.problem.m, np.nan)

    def make_start(self, impulse: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Compute (x, zeta, xi) from a start (m,)."""
        scaled = np.zeros(self.problem.m)
        scaled[self.unknown_rows] = impulse[self.unknown_rows] / (self.sigma * self.root)
        xi = np.zeros(self.n)
        for sign, rows, at in self.bounds:
            np.add.at(xi, at, (sign or -1.0) * impulse[rows] * self.root[at] / self.sigma)
        return scaled[self.unknown_rows[: self.n_x]], self.signs * scaled[self.general], xi


def build_program_form(problem: Problem, *, fix_far_rows: bool = False) -> ProgramQP:
    """Write a quadratic program with a singular P in the units of its problem.

    The parameter `fix_far_rows` is described at `build_impulse_form`.
    """
    scaled, qp = _ScaledProblem.from_problem(problem, True, fix_far_rows), problem.qp
    unknown, n = scaled.unknown_rows, len(qp.q)
    n_x = int(np.searchsorted(unknown, n))
    # Scale all variables by one number and all rows by one number, because backends equilibrate rows and columns
    # themselves. With a second equilibration here, piqp 0.7 reported that a feasible public program is infeasible.
    row_size = abs(problem.csr[unknown]).max(axis=1).toarray().ravel()
    root = 1.0 / np.sqrt(row_size)
    # Violation of the rows at x = 0.
    violation = np.where(
        unknown < n + qp.free, np.abs(problem.b[unknown]), np.maximum(problem.b[unknown], 0.0)
    )
    sigma = float(np.sqrt(np.mean((root * violation) ** 2))) or 1.0
    for roots in (root[:n_x], root[n_x:]):
        if len(roots):
            roots[:] = np.exp(np.mean(np.log(roots)))
    scaled = replace(scaled, root=root, sigma=sigma)
    unit = root[:n_x]
    scale = np.zeros(problem.m)
    scale[unknown] = root
    index_of = np.full(n, -1)
    index_of[unknown[:n_x]] = np.arange(n_x)
    is_unknown = np.zeros(problem.m, bool)
    is_unknown[unknown] = True
    # Classify the rows of `problem/program.py` (2): equations, G, fixed variables, lower and upper bounds.
    empty = np.zeros(0, np.intp)
    fixed, lower, upper = (empty if at is None else at for at in (qp.fixed, qp.lower, qp.upper))
    n_a, n_g = qp.free - len(fixed), len(qp.target) - qp.free - len(lower) - len(upper)
    ends = n + np.cumsum([0, n_a, len(fixed), n_g, len(lower), len(upper)])
    rows_a, rows_f, rows_g, rows_l, rows_u = (np.arange(*ends_of) for ends_of in itertools.pairwise(ends))
    rows_a, rows_g = rows_a[is_unknown[rows_a]], rows_g[is_unknown[rows_g]]
    bounds = []
    lb, ub = np.full(n_x, -np.inf), np.full(n_x, np.inf)
    for sign, rows, at, sides in (
        (0.0, rows_f, fixed, (lb, ub)), (-1.0, rows_l, lower, (lb,)), (1.0, rows_u, upper, (ub,)),
    ):  # fmt: skip
        both = is_unknown[rows] & is_unknown[at]
        rows, at = rows[both], index_of[at[both]]
        for side in sides:
            side[at] = (-1.0 if sign > 0.0 else 1.0) * problem.b[rows] / (sigma * unit[at])
        bounds.append((sign, rows, at))
    general = np.concatenate([rows_a, rows_g])
    signs = np.concatenate([np.full(len(rows_a), -1.0), np.ones(len(rows_g))])
    jac = (
        sp.diags_array(-signs * scale[general])
        @ qp.jacobian[general - n][:, unknown[:n_x]]
        @ sp.diags_array(unit)
    )
    has_bounds = any(len(rows) for _, rows, _ in bounds)
    return ProgramQP(
        **vars(scaled),
        form="program",
        P=sp.csc_matrix(
            sp.diags_array(unit) @ qp.hessian[unknown[:n_x]][:, unknown[:n_x]] @ sp.diags_array(unit)
        ),
        q=qp.q[unknown[:n_x]] * unit / sigma,
        A=sp.csc_matrix(jac),
        b=-signs * scale[general] * qp.target[general - n] / sigma,
        n_zero=len(rows_a),
        n_nonneg=len(rows_g),
        soc=(),
        lb=lb if has_bounds else None,
        ub=ub if has_bounds else None,
        multiplier_map=sp.csr_matrix((len(unknown), len(general))),
        shift=np.zeros(len(unknown)),
        velocity_map=sp.csr_matrix((len(unknown), 0)),
        n_x=n_x,
        general=general,
        signs=signs,
        bounds=tuple(bounds),
    )


def _build_velocity_rows(
    rows: _FrictionRows, free: IntpArray, lower: IntpArray, both: IntpArray, upper: IntpArray, ny: int
) -> tuple[_RowBuilder, _RowBuilder, int, int]:
    """Build the rows of the velocity form.

    Returns
    -------
    columns, t_entries : _RowBuilder
        Columns of T, and the entries of the unknowns t, for each row of the program.
    n : int
        Number of unknowns.
    n_normals : int
        Number of normals that are bounded by a sum of t only.
    """
    columns, t_entries = _RowBuilder(), _RowBuilder()
    # Write bounded rows. A row with both bounds has an unknown t.
    t_of_row = {int(i): ny + j for j, i in enumerate(both)}
    n = ny + len(both)
    for i in free:
        columns.add_row([(int(i), 1.0)])
        t_entries.add_row([])
    for i in lower:
        columns.add_row([(int(i), 1.0)])
        t_entries.add_row([(t_of_row[int(i)], -1.0)] if int(i) in t_of_row else [])
    for i in upper:
        columns.add_row([(int(i), -1.0)])
        t_entries.add_row([])
    # Write friction rows with a separate bound as t >= |w_t|.
    t_of_normal: dict[int, list[tuple[int, float]]] = {}
    for normal, tangent, ratio in rows.pairs:
        t_of_normal.setdefault(normal, []).append((n, ratio))
        for sign in (-1.0, 1.0):
            columns.add_row([(tangent, sign)])
            t_entries.add_row([(n, -1.0)])
        n += 1
    # Write the second disk of a contact as t >= |w|.
    t_of_disk: dict[int, int] = {}
    for k_disk, disk in enumerate(rows.disks):
        if any(d.normal == disk.normal for d in rows.disks[:k_disk][-1:]):
            t_of_normal.setdefault(disk.normal, []).append((n, 1.0))
            t_of_disk[k_disk] = n
            n += 1
    # Write normals of contacts without a disk as w_n >= sum of a t.
    normals = [normal for normal in t_of_normal if normal not in {d.normal for d in rows.disks}]
    for normal in normals:
        columns.add_row([(normal, 1.0)])
        t_entries.add_row(t_of_normal[normal])
    # Write disks as second-order cones.
    for k_disk, disk in enumerate(rows.disks):
        t = t_of_disk.get(k_disk)
        columns.add_row([(disk.normal, 1.0)] if t is None else [])
        t_entries.add_row(t_of_normal.get(disk.normal, []) if t is None else [(t, -1.0)])
        for tangent, ratio in zip(disk.tangents, disk.ratios, strict=True):
            columns.add_row([(tangent, ratio)])
            t_entries.add_row([])
    return columns, t_entries, n, len(normals)


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


class _RowBuilder:
    """Builder of a sparse matrix from its rows in order."""

    def __init__(self) -> None:
        self.ptr, self.column, self.value = [0], list[int](), list[float]()

    def add_row(self, entries: list[tuple[int, float]]) -> None:
        """Add a row of (column, value) entries."""
        for column, value in entries:
            self.column.append(column)
            self.value.append(value)
        self.ptr.append(len(self.column))

    def build_matrix(self, columns: int) -> sp.csc_matrix:
        """Return the matrix with this number of columns."""
        shape = (len(self.ptr) - 1, columns)
        return sp.csc_matrix(
            sp.csr_matrix((np.array(self.value, float), np.array(self.column, int), self.ptr), shape)
        )


def make_bound_rows(qp: QP) -> list[tuple[float, sp.csr_matrix, FloatArray, Any]]:
    """Return finite bounds as rows sign x[indices] <= h.

    Returns
    -------
    list of (sign, rows of the identity, h, indices)
        One entry for the upper and one for the lower bounds, if there are any.
    """
    if qp.lb is None or qp.ub is None:
        return []
    eye = sp.csr_matrix(sp.eye_array(qp.n))
    groups = []
    for sign, bound in ((1.0, qp.ub), (-1.0, qp.lb)):
        indices = np.flatnonzero(np.isfinite(bound))
        groups.append((sign, eye[indices], sign * bound[indices], indices))
    return groups


def merge_bound_multipliers(qp: QP, z: FloatArray) -> FloatArray:
    """Compute xi (n,) from the multipliers z; its first entries belong to the rows of `make_bound_rows`."""
    xi, first = np.zeros(qp.n), 0
    for sign, _, _, indices in make_bound_rows(qp):
        xi[indices] += sign * z[first : first + len(indices)]
        first += len(indices)
    return xi


def make_two_sided_rows(qp: QP, identity: bool) -> tuple[sp.csc_matrix, FloatArray, FloatArray]:
    """Return C, l and u of the rows l <= C x <= u; with `identity`, the bounds of x are appended as rows."""
    low = np.full(len(qp.b), -np.inf)
    low[: qp.n_zero] = qp.b[: qp.n_zero]
    if not identity or qp.lb is None or qp.ub is None:
        return qp.A, low, qp.b
    rows = sp.csc_matrix(sp.vstack([qp.A, sp.eye_array(qp.n)]))
    return rows, np.concatenate([low, qp.lb]), np.concatenate([qp.b, qp.ub])
