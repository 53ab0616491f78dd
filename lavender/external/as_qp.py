"""A problem as a convex program, in three forms. Pure conversion: nothing here solves.

All are written as

    min 1/2 x.P x + q.x    subject to   A x + s = b,  s in {0}^z x R+^k x second-order cones,   lb <= x <= ub

with multipliers zeta of the rows and xi of the bounds:  P x + q + A^T zeta + xi = 0.

Impulse form, x = S^-1 lambda / sigma, S = D^-1/2 (unit diagonal where `unit_diagonal`):

    P = S A S,  q = -S b / sigma,  bounds of lambda;  friction  |x_t| <= a x_n,  a = mu S_n / S_t

Velocity form, from `Problem.velocity_form` (K, theta, g; y = M^1/2 times the change of velocity):

    min 1/2 |y|^2 + 1/2 |p|^2 - (K~^T r).(y, p) + (u - l).t,   K~ = [K, theta^1/2],  w = K~ (y, p) - g

    free row                w = 0                          r = 0
    lower bound alone       w >= 0                         r = l
    both bounds             w + t >= 0, t >= 0             r = l, the multiplier ends at u - l
    upper bound alone       -w >= 0                        r = u
    disk and spin           w_n - a_s t >= a |w_t|,  t >= |w_s|;  a second disk likewise, t >= a_r |w_r|

and z = r + T zeta, lambda = sigma S z, where the rows are A = -T^T K~ (t aside). Its size is that of
the velocities, and J is never squared.

Program form, of a quadratic program with a singular P (`Problem.from_qp`; (5) of `problem/program.py`): the program
itself, with lb and ub for the bounds. S is one number for all variables and another for all rows, the geometric mean of
r^-1/2, where r_i is the largest entry of row i of (5); sigma is the root mean square of r^-1/2 times the violation of
the rows of (5) at zero.

sigma = max(E0 / sqrt(m), V0 sqrt(heaviest mass)) makes the first two free of units, with unknowns near 1 also at
large mass ratios; a residual of x times sigma is a residual of the judge. Rows whose impulse is known
(lower = upper, friction with mu = 0, rows of A that are all zero) are taken out first. So are rows and contacts that b
pushes to a bound by more than FAR_FROM_BOUND times the size of the unknowns, as placeholder bounds do: a tolerance of
the backend is relative to its largest number. `QPSolver` checks them at the answer.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import FloatArray, one_of
from lavender.base.errors import CapabilityError
from lavender.base.lazy_import import sparse as sp
from lavender.judge.certificates import check_certificate
from lavender.judge.residuals import reference
from lavender.problem import Problem

FORMS = ("impulse", "velocity", "auto")
IntpArray = npt.NDArray[np.intp]
LARGEST = 1e20  # of a program's numbers: from there on backends read infinity, or break
# A row whose scaled |b| is larger is assumed to stay at its bound: backends lose as many digits as the largest b has,
# and rows that act have b near 1. If the assumption fails, the backend is called once more with all rows.
FAR_FROM_BOUND = 1e2
# The same for the rows of a program: x is often larger than the bounds that act.
PROGRAM_FAR_FROM_BOUND = 1e6
MASS_RATIO = 1e3  # from here on the velocity form is more accurate, whatever the sizes


@dataclass(frozen=True)
class _Disk:
    """|(x_t / a_t over all tangents)| <= x_n: two tangents, a the same, or a round cone of up to five."""

    normal: int
    tangents: tuple[int, ...]
    ratios: tuple[float, ...]  # a


@dataclass(frozen=True)
class _FrictionRows:
    """Rows of friction among the kept ones, with a = mu S_n / S_t (times r on spin) in scaled unknowns."""

    pairs: list[tuple[int, int, float]]  # normal, the row bounded by |x| <= a x_n, a
    disks: list[_Disk]

    @property
    def cones(self) -> tuple[int, ...]:
        return tuple(1 + len(disk.tangents) for disk in self.disks)

    @property
    def members(self) -> list[int]:
        return [i for p in self.pairs for i in p[:2]] + [
            i for d in self.disks for i in (d.normal, *d.tangents)
        ]


@dataclass(frozen=True)
class _Parts:
    """What both forms share: rows that stay, impulses of those that do not, scaling."""

    problem: Problem
    kept: IntpArray  # (k,) rows of the problem that are unknown here
    fixed: FloatArray  # (m,) N s, impulse of the rows that are not; 0 elsewhere
    assumed: IntpArray  # rows that are assumed to stay at their bound
    root: FloatArray  # (k,) S, kg^1/2
    sigma: float  # J^1/2

    @classmethod
    def of(cls, problem: Problem, unit_diagonal: bool, assume: bool) -> _Parts:
        c = problem.cones
        known = (c.lower == c.upper) & np.isfinite(c.lower)
        fixed = np.where(known, c.lower, 0.0)
        size = np.diff(c.ptr)
        alone = np.repeat(~c.is_contact | (size == 1), size)
        for i in np.asarray(problem.metric.empty, int):
            # A row of zeros: b alone decides, and where no finite bound meets it the front door has said so.
            if alone[i]:
                bound = c.upper[i] if problem.b[i] > 0.0 else c.lower[i] if problem.b[i] < 0.0 else 0.0
                known[i] = True
                fixed[i] = np.clip(bound if np.isfinite(bound) else 0.0, c.lower[i], c.upper[i])
        known[c.friction_rows] = c.reach[c.friction_rows] == 0.0
        sigma, assumed = _sigma(problem), np.zeros(0, np.intp)
        if assume:
            far = PROGRAM_FAR_FROM_BOUND if problem.has_singular_program else FAR_FROM_BOUND
            assumed, at = _far_rows(problem, sigma, far)
            assumed, at = assumed[~known[assumed]], at[~known[assumed]]
            known[assumed], fixed[assumed] = True, at
        kept = np.flatnonzero(~known)
        d = problem.d[kept]
        if not unit_diagonal and len(d):
            d = np.full(len(d), np.exp(np.mean(np.log(d))))
        return cls(problem, kept, fixed, assumed, 1.0 / np.sqrt(d), sigma)

    def friction_rows(self) -> _FrictionRows:
        c = self.problem.cones
        reach = c.reach
        place = np.full(self.problem.m, -1)
        place[self.kept] = np.arange(len(self.kept))
        pairs: list[tuple[int, int, float]] = []
        disks: list[_Disk] = []
        for i, part in c.parts():
            if place[part[0]] < 0:
                continue
            j, at = int(place[c.ptr[i]]), [int(place[t]) for t in part]
            ratio = [float(reach[t] * self.root[j] / self.root[s]) for t, s in zip(part, at, strict=True)]
            if len(part) == 1:
                pairs.append((j, at[0], ratio[0]))
            else:
                disks.append(_Disk(j, tuple(at), tuple(ratio)))
        return _FrictionRows(pairs, disks)


@dataclass(frozen=True)
class QP(_Parts):
    """A convex program and the way back; see the module. All arrays are free of units."""

    form: str  # "impulse", "velocity" or "program"
    P: sp.csc_matrix  # (n, n) symmetric, both triangles
    q: FloatArray  # (n,)
    A: sp.csc_matrix  # (r, n)
    b: FloatArray  # (r,)
    n_zero: int  # rows with s = 0, first
    n_nonneg: int  # rows with s >= 0, next
    soc: tuple[int, ...]  # sizes of the second-order cones, last
    lb: FloatArray | None  # (n,), or no bounds at all
    ub: FloatArray | None  # (n,)
    back: sp.csr_matrix  # T (k, r), velocity form
    shift: FloatArray  # r (k,), velocity form
    lift: sp.csr_matrix  # K~ (k, n - number of t), velocity form

    @property
    def n(self) -> int:
        """Number of unknowns."""
        return len(self.q)

    @property
    def nbytes(self) -> int:
        """Bytes of its matrices, and of the problem's."""
        own = sum(x.data.nbytes + x.indices.nbytes for x in (self.P, self.A, self.back, self.lift))
        matrix = self.problem.matrix
        return own + (0 if matrix is None else getattr(matrix, "data", matrix).nbytes)

    @property
    def is_bounds_only(self) -> bool:
        """No rows, and no bound that is finite: a backend may call it unconstrained."""
        no_bound = self.lb is None or self.ub is None or not np.isfinite([self.lb, self.ub]).any()
        return len(self.b) == 0 and no_bound

    @property
    def fits(self) -> bool:
        """Its numbers are below LARGEST; bounds may be infinite on their own side.

        Where nothing overflows in the program's units they are near 1.
        """
        numbers = (self.P.data, self.q, self.A.data, self.b)
        if not all(np.abs(x).max(initial=0.0) < LARGEST for x in numbers):
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
        """Velocity form: P has no zero on its diagonal, as no row needs a t."""
        return self.form == "velocity" and self.n == self.lift.shape[1]

    def impulse(self, x: FloatArray, zeta: FloatArray, xi: FloatArray) -> FloatArray:
        """lambda (m,) [N s] of an answer, rounding outside constant bounds clipped; xi matters to a program alone."""
        lam = self.fixed.copy()
        z = x if self.form == "impulse" else self.shift + self.back @ zeta
        lam[self.kept] = self.sigma * self.root * z
        c = self.problem.cones
        return np.clip(lam, c.lower, c.upper, out=lam)

    def direction(self, x: FloatArray | None, zeta: FloatArray | None) -> FloatArray | None:
        """Certificate (m,) that no solution exists, of an unbounded x or of contradicting rows; None without one."""
        given = x if self.form == "impulse" else zeta
        if given is None or len(given) != (self.n if self.form == "impulse" else len(self.b)):
            return None
        y = np.zeros(self.problem.m)
        y[self.kept] = self.root * (given if self.form == "impulse" else self.back @ given)
        c = self.problem.cones
        # Out of the recession cone of the bounds by rounding only.
        y = np.clip(
            y, np.where(np.isfinite(c.lower), 0.0, -np.inf), np.where(np.isfinite(c.upper), 0.0, np.inf)
        )
        big = np.abs(y).max(initial=0.0)
        return y / big if 0.0 < big < np.inf else None

    def multiplier(self, x: FloatArray, xi: FloatArray) -> FloatArray:
        """The backend's own multiplier of the bounds of lambda, z (m,) [m/s] with A lambda - b + z = 0.

        Impulse form: xi. Velocity form: -w of its own velocities. Rows that were taken out: their slack.
        """
        if self.form == "impulse":
            lam = self.fixed.copy()
            lam[self.kept] = self.sigma * self.root * x
            if not np.isfinite(lam).all():
                return np.full(self.problem.m, np.nan)
            z = -self.problem.slack(lam)
            z[self.kept] = xi * (self.sigma / self.root)
            return z
        z = np.zeros(self.problem.m)
        g = self.problem.b[self.kept] * (self.root / self.sigma)
        z[self.kept] = -(self.lift @ x[: self.lift.shape[1]] - g) * (self.sigma / self.root)
        return z

    def start(self, impulse: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(x, zeta, xi) of a warm start (m,) [N s]; for programs without second-order cones."""
        z = impulse[self.kept] / (self.sigma * self.root)
        xi = np.zeros(self.n)
        if self.form == "impulse":
            if self.lb is not None and self.ub is not None:
                gradient = self.P @ z + self.q
                at_low, at_high = z <= self.lb, z >= self.ub
                xi = np.where(at_low, np.minimum(-gradient, 0.0), 0.0) + np.where(
                    at_high, np.maximum(-gradient, 0.0), 0.0
                )
            # The equality form of a linear system: P x - b = 0 with P (x + zeta) = 0.
            return z, -z if len(self.b) else np.zeros(0), xi
        ny = self.lift.shape[1]
        zeta = self.back.T @ (z - self.shift)
        zeta[self.n_zero :] = np.maximum(zeta[self.n_zero :], 0.0)
        x = np.zeros(self.n)
        x[:ny] = self.lift.T @ (self.back @ zeta) - self.q[:ny]
        x[ny:] = np.maximum(self.A[:, ny:].T @ (self.A[:, :ny] @ x[:ny] - self.b) * -1.0, 0.0)
        return x, zeta, xi


def pick_form(problem: Problem, form: str, definite: bool = False) -> str:
    """The form that `form` asks for, "impulse" or "velocity".

    "auto" takes the velocity form where rows are known and m > 6 n, the mass ratio is 1e3 or more, or
    the backend needs a definite P (`definite`).
    """
    form = one_of("form", form, FORMS)
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
    return "velocity" if definite or problem.m > 6 * rows.n_bodies or ratio >= MASS_RATIO else "impulse"


def target(problem: Problem, tol: float) -> float:
    """Largest residual of one unknown [-] with which the judge's relative residual is at most `tol`.

    E <= sqrt(m) sigma eps,  V <= max sqrt(nu) sigma eps
    """
    energy, velocity = reference(problem)
    sigma = _sigma(problem)
    each = [
        start / (size * sigma)
        for start, size in (
            (energy, np.sqrt(problem.m)),
            (velocity, np.sqrt(problem.metric.nu.max(initial=0.0))),
        )
        if start > 0.0 and size > 0.0
    ]
    return tol * min([1.0, *each])


def impulse_form(
    problem: Problem, *, unit_diagonal: bool = True, equality: bool = False, assume: bool = False
) -> QP:
    """min 1/2 l.A l - b.l over the bounds or friction cones of a symmetric problem.

    `unit_diagonal` scales by D^-1/2, otherwise by one number, so that P is A in other units; `equality` writes a linear
    system as min 1/2 x.P x subject to P x = -q, for backends that need a row; `assume` takes rows out that are far from
    leaving their bound.
    """
    parts = _Parts.of(problem, unit_diagonal, assume)
    c, kept, root, sigma = problem.cones, parts.kept, parts.root, parts.sigma
    a = problem.csr
    scale = sp.diags_array(root)
    p = sp.csc_matrix(scale @ a[kept][:, kept] @ scale)
    b = problem.b - (a @ parts.fixed if parts.fixed.any() else 0.0)
    q = -root * b[kept] / sigma
    rows, k = parts.friction_rows(), len(kept)
    lb = ub = None
    if not problem.cones.is_free:
        lb, ub = c.lower[kept] / (root * sigma), c.upper[kept] / (root * sigma)
    matrix, rhs, n_zero = sp.csc_matrix((0, k)), np.zeros(0), 0
    if equality:
        matrix, rhs, n_zero, q = p, -q, k, np.zeros(k)
    elif rows.members:
        # s = a x_n - x_t >= 0, s = a x_n + x_t >= 0;  s = (a x_n, x_t) in the cone of the disk.
        put = _Entries()
        for n, t, ratio in rows.pairs:
            put.row([(n, -ratio), (t, 1.0)])
            put.row([(n, -ratio), (t, -1.0)])
        for disk in rows.disks:
            put.row([(disk.normal, -disk.ratios[0])])
            for t, ratio in zip(disk.tangents, disk.ratios, strict=True):
                put.row([(t, -disk.ratios[0] / ratio)])
        matrix = put.matrix(k)
        rhs = np.zeros(matrix.shape[0])
    return QP(
        **vars(parts),
        form="impulse",
        P=p,
        q=q,
        A=matrix,
        b=rhs,
        n_zero=n_zero,
        n_nonneg=2 * len(rows.pairs),
        soc=rows.cones,
        lb=lb,
        ub=ub,
        back=sp.csr_matrix((k, len(rhs))),
        shift=np.zeros(k),
        lift=sp.csr_matrix((k, 0)),
    )


def velocity_form(problem: Problem, *, assume: bool = False) -> QP:
    """The mass-scaled velocity form of a problem with rows; `assume` as in `impulse_form`."""
    form = problem.velocity_form()
    parts = _Parts.of(problem, True, assume)
    c, kept, root, sigma = problem.cones, parts.kept, parts.root, parts.sigma
    k = len(kept)
    jac = sp.csr_matrix(form.jacobian)
    theta = form.theta[kept]
    soft = np.flatnonzero(theta > 0.0)
    soften = sp.csr_matrix((np.sqrt(theta[soft]), (soft, np.arange(len(soft)))), shape=(k, len(soft)))
    lift = sp.csr_matrix(sp.hstack([jac[kept], soften]))
    ny = lift.shape[1]
    g = form.rhs[kept] / sigma
    low, high = c.lower[kept] / (root * sigma), c.upper[kept] / (root * sigma)
    rows = parts.friction_rows()
    plain = np.ones(k, bool)
    plain[rows.members] = False
    has_low, has_high = np.isfinite(low), np.isfinite(high)
    free = np.flatnonzero(plain & ~has_low & ~has_high)
    lower = np.flatnonzero(plain & has_low)
    both = np.flatnonzero(plain & has_low & has_high)
    upper = np.flatnonzero(plain & ~has_low & has_high)
    shift = np.zeros(k)
    shift[lower], shift[upper] = low[lower], high[upper]
    put, slack, n, n_alone = _velocity_rows(rows, free, lower, both, upper, ny)
    back = sp.csr_matrix(put.matrix(k).T)
    velocities = sp.hstack([-(back.T @ lift), sp.csc_matrix((back.shape[1], n - ny))])
    matrix = sp.csc_matrix(velocities + slack.matrix(n))
    q = np.zeros(n)
    known = np.zeros(ny)
    known[: jac.shape[1]] = jac.T @ (parts.fixed / (form.scale * sigma))
    q[:ny] = -(lift.T @ shift) - known
    q[ny : ny + len(both)] = high[both] - low[both]
    lb = ub = None
    if n > ny:
        lb, ub = np.full(n, -np.inf), np.full(n, np.inf)
        lb[ny:] = 0.0
    diagonal = np.zeros(n)
    diagonal[:ny] = 1.0
    n_nonneg = len(lower) + len(upper) + 2 * len(rows.pairs) + n_alone
    return QP(
        **vars(parts),
        form="velocity",
        P=sp.csc_matrix(sp.diags_array(diagonal)),
        q=q,
        A=matrix,
        b=-(back.T @ g),
        n_zero=len(free),
        n_nonneg=n_nonneg,
        soc=rows.cones,
        lb=lb,
        ub=ub,
        back=back,
        shift=shift,
        lift=lift,
    )


@dataclass(frozen=True)
class ProgramQP(QP):
    """The program form: a quadratic program in the units S, sigma, and the way back to x and the multipliers."""

    n_x: int  # rows of the problem that are kept and are variables; they come first in `kept`
    general: IntpArray  # (r,) rows of the problem that are rows of A
    signs: FloatArray  # (r,) -1 for equations, 1 for G: multipliers over zeta
    bounds: tuple[tuple[float, IntpArray, IntpArray], ...]  # sign of xi, rows of the problem, their unknowns

    def impulse(self, x: FloatArray, zeta: FloatArray, xi: FloatArray) -> FloatArray:
        """x and the multipliers (m,), rounding outside constant bounds clipped."""
        c, lam = self.problem.cones, self.fixed.copy()
        lam[self.kept[: self.n_x]] = self.sigma * self.root[: self.n_x] * x
        lam += self.sigma * self._multipliers(zeta, xi)
        return np.clip(lam, c.lower, c.upper, out=lam)

    def _multipliers(self, zeta: FloatArray, xi: FloatArray) -> FloatArray:
        """(m,) over sigma, 0 for variables; of a bound with a multiplier of the other sign 0."""
        lam, scale = np.zeros(self.problem.m), np.zeros(self.problem.m)
        scale[self.kept] = self.root
        lam[self.general] = scale[self.general] * self.signs * zeta
        for sign, rows, at in self.bounds:
            force = xi[at] / self.root[at]
            lam[rows] = -force if sign == 0.0 else np.maximum(sign * force, 0.0)
        return lam

    def direction(self, x: FloatArray | None, zeta: FloatArray | None) -> FloatArray | None:
        """Certificate (m,) that no solution exists: contradicting rows, or a direction of unlimited decrease."""
        candidates = []
        if zeta is not None and len(zeta) == len(self.b):
            # Backends return multipliers of rows alone; those of the bounds balance them.
            candidates.append(self._multipliers(zeta, -(self.A.T @ zeta)))
        if x is not None and len(x) == self.n:
            y = np.zeros(self.problem.m)
            y[self.kept[: self.n_x]] = self.root[: self.n_x] * x
            candidates.append(y)
        c = self.problem.cones
        candidates = [np.where(np.isfinite(c.lower), np.maximum(y, 0.0), y) for y in candidates]
        candidates = [y / np.abs(y).max() for y in candidates if 0.0 < np.abs(y).max() < np.inf]
        proofs = (y for y in candidates if check_certificate(self.problem, y) is None)
        return next(proofs, candidates[0] if candidates else None)

    def multiplier(self, x: FloatArray, xi: FloatArray) -> FloatArray:
        """Not defined for x and multipliers together: NaN (m,)."""
        return np.full(self.problem.m, np.nan)

    def start(self, impulse: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(x, zeta, xi) of a start (m,)."""
        scaled = np.zeros(self.problem.m)
        scaled[self.kept] = impulse[self.kept] / (self.sigma * self.root)
        xi = np.zeros(self.n)
        for sign, rows, at in self.bounds:
            np.add.at(xi, at, (sign or -1.0) * impulse[rows] * self.root[at] / self.sigma)
        return scaled[self.kept[: self.n_x]], self.signs * scaled[self.general], xi


def program_form(problem: Problem, *, assume: bool = False) -> ProgramQP:
    """Write a quadratic program with a singular P in the units of its problem; `assume` as in `impulse_form`."""
    parts, qp = _Parts.of(problem, True, assume), problem.qp
    kept, n = parts.kept, len(qp.q)
    n_x = int(np.searchsorted(kept, n))
    # One unit for all variables and one for all rows: backends balance what they get, and with rows and columns that
    # are balanced twice, piqp 0.7 called a public program infeasible.
    row_size = abs(problem.csr[kept]).max(axis=1).toarray().ravel()
    root = 1.0 / np.sqrt(row_size)
    wrong = np.where(
        kept < n + qp.free, np.abs(problem.b[kept]), np.maximum(problem.b[kept], 0.0)
    )  # at x = 0
    sigma = float(np.sqrt(np.mean((root * wrong) ** 2))) or 1.0
    for part in (root[:n_x], root[n_x:]):
        if len(part):
            part[:] = np.exp(np.mean(np.log(part)))
    parts = replace(parts, root=root, sigma=sigma)
    unit = root[:n_x]
    scale = np.zeros(problem.m)
    scale[kept] = root
    place = np.full(n, -1)
    place[kept[:n_x]] = np.arange(n_x)
    is_kept = np.zeros(problem.m, bool)
    is_kept[kept] = True
    # Rows of (2) of problem/program.py, one kind after the other.
    none = np.zeros(0, np.intp)
    fixed, lower, upper = (none if at is None else at for at in (qp.fixed, qp.lower, qp.upper))
    n_a, n_g = qp.free - len(fixed), len(qp.target) - qp.free - len(lower) - len(upper)
    ends = n + np.cumsum([0, n_a, len(fixed), n_g, len(lower), len(upper)])
    rows_a, rows_f, rows_g, rows_l, rows_u = (np.arange(*of) for of in itertools.pairwise(ends))
    rows_a, rows_g = rows_a[is_kept[rows_a]], rows_g[is_kept[rows_g]]
    bounds = []
    lb, ub = np.full(n_x, -np.inf), np.full(n_x, np.inf)
    for sign, rows, at, sides in (
        (0.0, rows_f, fixed, (lb, ub)), (-1.0, rows_l, lower, (lb,)), (1.0, rows_u, upper, (ub,)),
    ):  # fmt: skip
        on = is_kept[rows] & is_kept[at]
        rows, at = rows[on], place[at[on]]
        for side in sides:
            side[at] = (-1.0 if sign > 0.0 else 1.0) * problem.b[rows] / (sigma * unit[at])
        bounds.append((sign, rows, at))
    general = np.concatenate([rows_a, rows_g])
    signs = np.concatenate([np.full(len(rows_a), -1.0), np.ones(len(rows_g))])
    jac = (
        sp.diags_array(-signs * scale[general])
        @ qp.jacobian[general - n][:, kept[:n_x]]
        @ sp.diags_array(unit)
    )
    has_bounds = any(len(rows) for _, rows, _ in bounds)
    return ProgramQP(
        **vars(parts),
        form="program",
        P=sp.csc_matrix(sp.diags_array(unit) @ qp.hessian[kept[:n_x]][:, kept[:n_x]] @ sp.diags_array(unit)),
        q=qp.q[kept[:n_x]] * unit / sigma,
        A=sp.csc_matrix(jac),
        b=-signs * scale[general] * qp.target[general - n] / sigma,
        n_zero=len(rows_a),
        n_nonneg=len(rows_g),
        soc=(),
        lb=lb if has_bounds else None,
        ub=ub if has_bounds else None,
        back=sp.csr_matrix((len(kept), len(general))),
        shift=np.zeros(len(kept)),
        lift=sp.csr_matrix((len(kept), 0)),
        n_x=n_x,
        general=general,
        signs=signs,
        bounds=tuple(bounds),
    )


def _velocity_rows(
    rows: _FrictionRows, free: IntpArray, lower: IntpArray, both: IntpArray, upper: IntpArray, ny: int
) -> tuple[_Entries, _Entries, int, int]:
    """Columns of T, entries of the t in their rows, number of unknowns, normals bounded by a sum of t alone."""
    put, slack = _Entries(), _Entries()
    t_of = {int(i): ny + j for j, i in enumerate(both)}
    n = ny + len(both)
    for i in free:
        put.row([(int(i), 1.0)])
        slack.row([])
    for i in lower:
        put.row([(int(i), 1.0)])
        slack.row([(t_of[int(i)], -1.0)] if int(i) in t_of else [])
    for i in upper:
        put.row([(int(i), -1.0)])
        slack.row([])
    heads: dict[int, list[tuple[int, float]]] = {}
    for normal, tangent, ratio in rows.pairs:
        heads.setdefault(normal, []).append((n, ratio))
        for sign in (-1.0, 1.0):
            put.row([(tangent, sign)])
            slack.row([(n, -1.0)])
        n += 1
    second: dict[int, int] = {}  # disk -> its t, where its normal has a disk before it
    for k_disk, disk in enumerate(rows.disks):
        if any(d.normal == disk.normal for d in rows.disks[:k_disk][-1:]):
            heads.setdefault(disk.normal, []).append((n, 1.0))
            second[k_disk] = n
            n += 1
    alone = [normal for normal in heads if normal not in {d.normal for d in rows.disks}]
    for normal in alone:
        put.row([(normal, 1.0)])
        slack.row(heads[normal])
    for k_disk, disk in enumerate(rows.disks):
        own = second.get(k_disk)
        put.row([(disk.normal, 1.0)] if own is None else [])
        slack.row(heads.get(disk.normal, []) if own is None else [(own, -1.0)])
        for tangent, ratio in zip(disk.tangents, disk.ratios, strict=True):
            put.row([(tangent, ratio)])
            slack.row([])
    return put, slack, n, len(alone)


def _far_rows(problem: Problem, sigma: float, threshold: float) -> tuple[IntpArray, FloatArray]:
    """Find rows (contacts as a whole) that b pushes to a bound by more than the threshold, and their impulses."""
    c, push = problem.cones, problem.b / (np.sqrt(problem.d) * sigma)
    at = np.where(push < 0.0, c.lower, c.upper)
    far = (np.abs(push) > threshold) & np.isfinite(at) & ~c.friction_rows
    # All of a contact whose normal row is far; a contact of which only friction is far stays.
    first = np.repeat(c.ptr[:-1], np.diff(c.ptr))
    of_contact = c.friction_rows & far[first]
    rows = np.flatnonzero(far | of_contact)
    return rows, np.where(of_contact, 0.0, at)[rows]


def _sigma(problem: Problem) -> float:
    energy, velocity = reference(problem)
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


class _Entries:
    """Rows of a sparse matrix, one after the other."""

    def __init__(self) -> None:
        self.ptr, self.column, self.value = [0], list[int](), list[float]()

    def row(self, entries: list[tuple[int, float]]) -> None:
        for column, value in entries:
            self.column.append(column)
            self.value.append(value)
        self.ptr.append(len(self.column))

    def matrix(self, columns: int) -> sp.csc_matrix:
        shape = (len(self.ptr) - 1, columns)
        return sp.csc_matrix(
            sp.csr_matrix((np.array(self.value, float), np.array(self.column, int), self.ptr), shape)
        )


def bound_rows(qp: QP) -> list[tuple[float, sp.csr_matrix, FloatArray, Any]]:
    """Finite bounds as rows sign x[at] <= h: (sign, rows of the identity, h, at) for upper, then lower."""
    if qp.lb is None or qp.ub is None:
        return []
    eye = sp.csr_matrix(sp.eye_array(qp.n))
    found = []
    for sign, bound in ((1.0, qp.ub), (-1.0, qp.lb)):
        at = np.flatnonzero(np.isfinite(bound))
        found.append((sign, eye[at], sign * bound[at], at))
    return found


def bound_multipliers(qp: QP, z: FloatArray) -> FloatArray:
    """xi (n,) of the multipliers of `bound_rows`, which z begins with."""
    xi, first = np.zeros(qp.n), 0
    for sign, _, _, at in bound_rows(qp):
        xi[at] += sign * z[first : first + len(at)]
        first += len(at)
    return xi


def two_sided(qp: QP, identity: bool) -> tuple[sp.csc_matrix, FloatArray, FloatArray]:
    """Rows l <= C x <= u; with `identity` the bounds of x as rows after them."""
    low = np.full(len(qp.b), -np.inf)
    low[: qp.n_zero] = qp.b[: qp.n_zero]
    if not identity or qp.lb is None or qp.ub is None:
        return qp.A, low, qp.b
    rows = sp.csc_matrix(sp.vstack([qp.A, sp.eye_array(qp.n)]))
    return rows, np.concatenate([low, qp.lb]), np.concatenate([qp.b, qp.ub])
