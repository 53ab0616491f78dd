"""Coulomb friction by an interior point method on De Saxce's change of variable.

    s = H z - g,   u = s + phi(s_t) e_n,   phi = a_t |s_t| + a_s |s_s| + a_r |s_r|    (De Saxce, Feng 1998)   (1)
    z in K,  u in K*,  z . u = 0     on every contact                                                   (2)

With phi frozen, (1) and (2) are the convex problem of the "cone" law with its normals lowered by phi, and
phi <- phi(s_t) is Cadoux's fixed point (Cadoux 2009; Acary, Cadoux, Lemarechal, Malick 2011): dozens of
convex problems. Here phi moves with every step of one interior point, and so does its derivative: with
psi = phi'(s_t) on tangents, spin and rolling, 0 on the normal, C = I - e_n psi^T and B = C^-1 = I + e_n psi^T,

    du = -q - W dz,    C du = H dz - r_d,    r_d = u - s - phi e_n,                                      (3)
    (H + C W) dz = r_d - C q = r_d - q + (psi . q) e_n,                                                  (4)

q and W = G^T T^-2 G as in the convex method (`lavender_ext/newton/interior.pxd`), whose kernels take every step; phi
and psi are read off u, which shares its tangents with s. W^-1 = L L^T gives (C W)^-1 = L P, P = L^T B, so

    velocity   N = I + K^T L P K,   N dy = K^T L P r,   dz = L P (r - K dy)                              (5)
    impulse    (I + P H L) y = P r,   dz = L y                                                           (6)

Both matrices lack symmetry and are factored by LU. The central path of a problem that is not monotone may
turn back: steps then shrink to nothing. With `share` psi for psi in B, share a little below 1, the method is
between Newton's and the fixed point and passes such folds, at a linear rate, after which Newton's method on
the Alart-Curnier map ends it. Several shares are tried in turn.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from lavender._arrays import FloatArray
from lavender.cones import CONTACT_ROLLING, CONTACT_SPIN, ROW
from lavender.solvers._newton.augmented import ROWS, SHIFT, AugmentedSystem, advance
from lavender.solvers._newton.interior_point import InteriorPoint
from lavender.solvers._newton.proximal import Proximal
from lavender.solvers._newton.run import Run
from lavender.solvers._newton.scaled import Scaled
from lavender.solvers._newton.systems import AUGMENTED, VelocitySystem

SHARES = (0.7, 0.95, 1.0, 0.85, 0.5)  # of phi's derivative, tried in turn
# First weight, steps of a round and factorisations of the proximal Newton methods after each interior point.
FINISH = ((1e-3, 10, 15), (1e-7, 12, 12))


class _Slip:
    """Index arrays of (1): which rows are tangents, spins and rolling, and of which contact."""

    def __init__(self, sc: Scaled) -> None:
        ptr, kind, wptr = sc.ptr, sc.kind, sc.wptr
        size = np.diff(ptr)
        self.n, self.m = len(size), int(ptr[-1])
        self.first = ptr[:-1]
        self.element = np.repeat(np.arange(self.n), size)
        position = np.arange(self.m) - np.repeat(self.first, size)
        contact = (kind != ROW)[self.element]
        rolls = kind == CONTACT_ROLLING
        spins = (kind == CONTACT_SPIN) | (rolls & (size == 6))
        from_end = size[self.element] - position
        self.rolling = rolls[self.element] & (from_end <= 2)
        spin = spins[self.element] & (from_end == np.where(rolls, 3, 1)[self.element])
        tangent = contact & (position > 0) & ~spin & ~self.rolling
        self.a_t = np.where(np.bincount(self.element, tangent, minlength=self.n) > 0, sc.a_t, 0.0)
        self.a_s = np.where(spins, sc.a_s, 0.0)
        self.a_r = np.zeros(self.n) if sc.a_r is None else sc.a_r
        # G^T: the cones' own coordinates are (a z_n, z_t) where a > 1, else (z_n, z_t / a).
        one_t, one_s = np.minimum(self.a_t, 1.0)[self.element], np.minimum(self.a_s, 1.0)[self.element]
        self.from_u1 = np.divide(1.0, one_t, out=np.zeros(self.m), where=tangent)
        self.from_u2 = np.divide(1.0, one_s, out=np.zeros(self.m), where=spin)
        self.normal_u1 = np.where(self.a_t > 0.0, np.maximum(self.a_t, 1.0), np.where(kind == ROW, 1.0, 0.0))
        self.normal_u2 = np.where(spins, np.maximum(self.a_s, 1.0), np.where(kind == ROW, -1.0, 0.0))
        # The rolling cone's entry on the normal stands in u2 on the first tangent.
        one_r = np.minimum(self.a_r, 1.0)[self.element]
        self.from_u2 += np.divide(1.0, one_r, out=np.zeros(self.m), where=self.rolling)
        self.turned = np.flatnonzero(rolls)
        self.normal_u3 = np.maximum(self.a_r, 1.0)[self.turned]
        # Entries (r, c) of every element's small matrix: the row c of the problem, and where (r, 0) is.
        square = np.repeat(size, size**2)
        inner = np.arange(int(wptr[-1])) - np.repeat(wptr[:-1], size**2)
        self.column = np.repeat(self.first, size**2) + inner % square
        self.row = np.repeat(self.first, size**2) + inner // square
        self.first_entry = np.repeat(wptr[:-1], size**2) + (inner // square) * square

    def dual(self, u1: FloatArray, u2: FloatArray) -> FloatArray:
        """G^T u (m,): u on every row."""
        out: FloatArray = self.from_u1 * u1 + self.from_u2 * u2
        out[self.first] = self.normal_u1 * u1[self.first] + self.normal_u2 * u2[self.first]
        if len(self.turned):
            out[self.first[self.turned]] += self.normal_u3 * u2[self.first[self.turned] + 1]
        return out

    def slip(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """phi (n,) of s (m,), and psi (m,)."""
        st = np.where(self.from_u1 > 0.0, s, 0.0)
        sr = np.where(self.rolling, s, 0.0)
        ss = np.where((self.from_u2 > 0.0) & ~self.rolling, s, 0.0)
        t = np.sqrt(np.bincount(self.element, st * st, minlength=self.n))
        spin = np.bincount(self.element, np.abs(ss), minlength=self.n)
        along = np.divide(self.a_t, t, out=np.zeros(self.n), where=t > 0.0)
        psi = along[self.element] * st + self.a_s[self.element] * np.sign(ss)
        phi = self.a_t * t + self.a_s * spin
        if len(self.turned):
            r = np.sqrt(np.bincount(self.element, sr * sr, minlength=self.n))
            psi += np.divide(self.a_r, r, out=np.zeros(self.n), where=r > 0.0)[self.element] * sr
            phi = phi + self.a_r * r
        return phi, psi

    def dot(self, psi: FloatArray, x: FloatArray) -> FloatArray:
        """psi . x (n,) on every element."""
        out: FloatArray = np.asarray(np.bincount(self.element, psi * x, minlength=self.n), np.float64)
        return out


@dataclass
class DeSaxce(InteriorPoint):
    """The interior point of (3) and (4); `share` of phi's derivative enters."""

    compiled: ClassVar[bool] = False
    share: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.slips = _Slip(self.system.sc)

    def step(self) -> bool:
        """One predictor-corrector step; False where the factorisation or the step fails."""
        sy, sc, e, of = self.system, self.system.sc, self.system.elements, self.slips
        z, u1, u2, first = self.z, self.u1, self.u2, self.slips.first
        hz = sy.times(z)
        u = of.dual(u1, u2)
        phi, psi = of.slip(u)
        psi *= self.share
        gap = e.scale(z, u1, u2, self.delta, sy.v, sy.bt)
        if not self._factor(psi) and not np.isfinite(gap):
            return False
        lowered = sc.g.copy()
        lowered[first] -= phi
        # The predictor's q is u itself.
        r = lowered - hz
        r[first] += of.dot(psi, u)
        da = self.system.solve_pair(r)
        mu = gap / max(self.degree, 1.0)
        _, after = e.affine(z, u1, u2, da)
        sigma = min(1.0, max(after / gap, 0.0)) ** 3 if gap > 0 else 0.0
        # The convex right-hand side is r_d - q for u - s alone; q comes back by difference.
        e.rhs(z, u1, u2, hz, da, sigma * mu, self.r)
        q = u - (hz - sc.g) - self.r
        self.r[first] += of.dot(psi, q) - phi
        dz = self.system.solve_pair(self.r)
        if not np.isfinite(dz).all():
            return False
        self.length = e.step(z, u1, u2, dz, da, sigma * mu, 0.995, self.t1, self.t2)
        self.lowest_gap = min(self.lowest_gap, self.gap)
        self.gap = mu
        self.first_gap = max(self.first_gap, mu)
        return self.length > 0.0

    def _factor(self, psi: FloatArray) -> bool:
        sy, of = self.system, self.slips
        wide = psi[of.column]
        if sy.bt is None:
            self._with_compliance(psi, wide)
        else:
            self.p = sy.bt + sy.bt[of.first_entry] * wide
            sy.v += sy.v[of.first_entry] * wide
        return sy.factor_pair(sy.v if sy.bt is None else self.p, sy.bt)

    def _with_compliance(self, psi: FloatArray, wide: FloatArray) -> None:
        # (theta + C W)^-1 = (V^-1 + e_n (psi theta)^T)^-1 B with V = (theta + W)^-1     (Sherman, Morrison)
        sy, of = self.system, self.slips
        v, normal = sy.v, sy.v[of.first_entry]
        across = np.bincount(of.column, (psi * sy.sc.theta)[of.row] * v, minlength=of.m)
        own = across[of.first][of.element]
        sy.v[:] = v + normal * wide - normal * ((across + own * psi) / (1.0 + own))[of.column]


def solve_desaxce(run: Run, shares: tuple[float, ...] = SHARES) -> None:
    """Interior points, each ended by Newton's method on the Alart-Curnier map, until the judge is content."""
    for share in shares:
        best, z = advance(run, DeSaxce(run.system, share=share), AUGMENTED, "De Saxce steps")
        if run.done() or run.at_floor():
            return
        for alpha, inner, limit in FINISH:
            best, z = apart(run, Proximal(z, AUGMENTED, min(alpha, best), inner), limit)
            if run.done() or run.at_floor():
                return


def solve_desaxce_augmented(run: Run, shares: tuple[float, ...] = SHARES[:2]) -> None:
    """The same through the augmented system of the bodies, for rows that nearly depend on each other."""
    if not isinstance(run.system, VelocitySystem) or run.system.sc.m > ROWS:
        return
    system = AugmentedSystem(run.system)
    for share in shares:
        advance(run, DeSaxce(system, SHIFT, share=share), AUGMENTED, "augmented De Saxce steps")
        if run.done() or run.at_floor():
            return


def apart(run: Run, method: Proximal, limit: int) -> tuple[float, FloatArray]:
    """`limit` factorisations of a method judged by its own progress; the lowest residual and its z."""
    before, z = run.best, run.best_z
    run.best = np.inf
    try:
        method.advance(run, limit)
    finally:
        best, own = run.best, run.best_z
        if before <= best:
            run.best, run.best_z = before, z
    return best, own
