"""Newton's method on the natural map through the augmented system, for rows that nearly depend on each other.

    [ I     -K^T              ] [ dy ]   [  0 ]
    [ P K   I - P + P theta   ] [ dz ] = [ -F ]        y = K^T z, P in the derivative of Pi               (1)

Eliminating dy leaves H = K K^T, eliminating dz leaves K^T K: both square the singular values of K, and what is
below sqrt(2^-53) of the largest is lost (closed loops of hinges, nearly parallel axes: 1e-6 to 1e-8 is usual,
with impulses of 1e4 and more along them). (1) holds K itself. `SHIFT` on the rows that P keeps stands for the
redundant ones, refinement takes it away again (Bjorck 1996, section 2.4.4). An interior point's systems
(H + W) dz = r likewise, with W^-1 = R^T Q and dz = R^T x,

    [ I     -K^T R^T ] [ dy ]   [  0  ]
    [ Q K    I       ] [ x  ] = [ Q r ]                                                                   (2)
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp

from lavender._arrays import FloatArray
from lavender._lu import sparse_lu
from lavender.solvers._newton.interior_point import InteriorPoint
from lavender.solvers._newton.row_steps import refined
from lavender.solvers._newton.run import Run
from lavender.solvers._newton.systems import CONVEX, System, VelocitySystem
from lavender_ext.newton.panel import scaled_jacobian

SHIFT = 1e-14  # of d; squared singular values below it count as zero
WORTH = 1e-3  # relative residual from which near-dependent rows may be what is in the way
ROWS = 10_000  # up to which one factorisation stays well below 0.2 s
STEPS = 60  # of one interior point at most
SHORT = 0.05  # step length that gets nowhere
PATIENCE = 4  # such steps in a row before an interior point is given up
IDLE = 15  # steps in a row that do not halve the residual, likewise, once it is below NEAR
NEAR = 1e-5  # relative residual from which Newton steps are asked at each new decade


class AugmentedSystem(System):
    """A velocity form whose Newton systems of the natural map are solved through (1)."""

    form = "velocity"

    def __init__(self, system: VelocitySystem) -> None:
        # Elements and the vectors between calls are those of the given system.
        self.sc, self.elements, self.law, self.cost = system.sc, system.elements, system.law, system.cost
        self.v, self.einv, self.bt, self.p = system.v, system.einv, system.bt, system.p
        self.t, self.q = system.t, system.q
        sc, rows = self.sc, self.sc.problem.rows
        assert rows is not None and sc.bodies is not None
        self.given = system
        panel = np.zeros((sc.problem.m, 12))
        scaled_jacobian(sc.problem.data, rows.inv_inertia, np.sqrt(rows.inv_mass), panel)
        size, m = np.diff(sc.ptr), sc.m
        body = np.repeat(sc.bodies, size, axis=0)
        values = panel[sc.keep].reshape(m, 2, 6)
        row = np.broadcast_to(np.arange(m)[:, None, None], values.shape)
        column = np.maximum(body, 0)[:, :, None] * 6 + np.arange(6)
        used = (values != 0.0) & (body >= 0)[:, :, None]
        k = sp.csc_array((values[used], (row[used], column[used])), shape=(m, 6 * rows.n_bodies))
        self.k = sp.csr_array(k[:, np.flatnonzero(np.diff(k.indptr))])
        self.unknowns = self.k.shape[1]
        square = np.repeat(size, size**2)
        inner = np.arange(int(sc.wptr[-1])) - np.repeat(sc.wptr[:-1], size**2)
        base = np.repeat(sc.ptr[:-1], size**2)
        self.small = base + inner // square, base + inner % square
        self.lu: Any = None

    def times(self, z: FloatArray) -> FloatArray:
        return self.given.times(z)

    def factor_natural(self, eps: float) -> bool:
        """Factor (1) for the P of the last `natural`, `eps` added to theta."""
        p = self._small(self.p)
        return self._factor_whole(
            p, None, sp.eye_array(self.sc.m) - p + p @ sp.diags_array(self.sc.theta + eps)
        )

    def solve_natural(self, r: FloatArray) -> FloatArray:
        return self._solve_whole(r)

    def factor_barrier(self) -> bool:
        return self.factor_pair(self.v if self.bt is None else self.bt, self.bt)

    def solve_barrier(self, r: FloatArray) -> FloatArray:
        return self.solve_pair(r)

    def factor_pair(self, left: FloatArray, right: FloatArray | None) -> bool:
        """Factor (2); `right` None is I."""
        self.left, self.right = self._small(left), None if right is None else self._small(right)
        return self._factor_whole(self.left, self.right, sp.eye_array(self.sc.m))

    def solve_pair(self, r: FloatArray) -> FloatArray:
        """dz of (2)."""
        x = self._solve_whole(self.left @ r)
        return x if self.right is None else self.right.T @ x

    def _small(self, values: FloatArray) -> Any:
        m = self.sc.m
        return sp.csr_array((values, self.small), shape=(m, m))

    def _factor_whole(self, left: Any, right: Any, own: Any) -> bool:
        upper = self.k if right is None else right @ self.k
        matrix = sp.block_array([[sp.eye_array(self.unknowns), -upper.T], [left @ self.k, own]])
        self.given.factorisations += 1
        self.lu = None
        if not np.isfinite(matrix.data).all():
            return False
        try:
            self.lu = sparse_lu(matrix)
        except RuntimeError:
            return False
        self.matrix = sp.csr_array(matrix)
        return True

    def _solve_whole(self, r: FloatArray) -> FloatArray:
        if self.lu is None:
            return np.full_like(r, np.nan)
        n = self.unknowns
        right = np.concatenate([np.zeros(n), r])
        x: FloatArray = self.lu.solve(right)
        x += self.lu.solve(right - self.matrix @ x)
        return x[n:]


def polish_augmented(
    run: Run, z: FloatArray, law: int = CONVEX, *, patience: int = 3, limit: int = 12
) -> None:
    """Newton steps from z through (1) until the judge is content or `patience` of them gain nothing."""
    given = run.system
    if not isinstance(given, VelocitySystem):
        return
    system = AugmentedSystem(given)
    f = np.empty_like(z)
    best, worse = run.score(z), 0
    for _ in range(limit):
        if run.done():
            return
        system.natural(z, system.times(z) - system.sc.g, law, SHIFT, f)
        system.factor_natural(SHIFT)
        run.count("augmented steps")
        z = z + refined(system, -f)
        if not np.isfinite(z).all():
            return
        relative = run.score(z)
        worse = 0 if relative < 0.5 * best else worse + 1
        best = min(best, relative)
        if worse >= patience or (worse and run.at_floor()):
            return


def solve_augmented(run: Run) -> None:
    """A cold interior point of the convex law through (2), polished through (1)."""
    if isinstance(run.system, VelocitySystem) and run.system.sc.m <= ROWS:
        advance(
            run, InteriorPoint(AugmentedSystem(run.system), SHIFT), CONVEX, "augmented interior point steps"
        )


def advance(run: Run, ip: InteriorPoint, law: int, name: str) -> tuple[float, FloatArray]:
    """Steps, and Newton steps of `law` through (1), until the judge is content or they get nowhere.

    Returns the lowest relative residual of the steps, and its z.
    """
    near, short, idle, best, z = NEAR, 0, 0, np.inf, ip.z.copy()
    for _ in range(STEPS):
        if run.done() or not ip.step():
            break
        run.count(name)
        relative = run.score(ip.z)
        idle = 0 if relative < 0.5 * best else idle + 1
        if relative < best:
            best, z = relative, ip.z.copy()
        if relative < near and not run.done():
            near = 0.1 * relative
            if isinstance(ip.system, AugmentedSystem):
                polish_augmented(run, ip.z.copy(), law, patience=2, limit=4)
            if run.at_floor():
                break
        short = short + 1 if ip.length < SHORT else 0
        if short >= PATIENCE or (idle > IDLE and best < NEAR) or ip.gap < 1e-24 * ip.first_gap:
            break
    return best, z
