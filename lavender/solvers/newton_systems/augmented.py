"""The augmented system of the bodies, for rows that nearly depend on each other.

    [ I     -K^T              ] [ dy ]   [  0 ]
    [ P K   I - P + P theta   ] [ dz ] = [ -F ]        y = K^T z, P in the derivative of Pi               (1)

Eliminating dy leaves H = K K^T, eliminating dz leaves K^T K: both square the singular values of K, and what is
below sqrt(2^-53) of the largest is lost (closed loops of hinges, nearly parallel axes: 1e-6 to 1e-8 is usual,
with impulses of 1e4 and more along them). (1) holds K itself. A shift on the rows that P keeps stands for the
redundant ones, refinement takes it away again (Bjorck 1996, section 2.4.4). An interior point's systems
(H + W) dz = r likewise, with W^-1 = R^T Q and dz = R^T x,

    [ I     -K^T R^T ] [ dy ]   [  0  ]
    [ Q K    I       ] [ x  ] = [ Q r ]                                                                   (2)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import NEVER, Deadline, Stopwatch, TooLate
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import sparse_lu
from lavender.solvers.setup_times import CALLS, SPARSE, loading, sparse_work
from lavender_ext.newton.solve import WHATS, Layout, Solve


class Augmented:
    """Who factors (1) and (2) for `Solve`; K is made when it is first asked for."""

    def __init__(self, of: Solve, layout: Layout, bodies: Any) -> None:
        self.of, self.layout, self.bodies = of, layout, bodies
        self.k: Any = None
        self.lu: Any = None
        self.deadline: Deadline = NEVER
        self.seconds = 0.0  # of the next factor: the first by structure, then as long as the last took

    def factor(self, _augmented: int, what: int, eps: float) -> bool:
        """Factor (1) for the P of the last natural map, eps added to theta, or (2); whether there is a factor.

        TooLate if it would end after the deadline.
        """
        if self.k is None:
            if self.deadline.passed(CALLS):
                raise TooLate
            self.k = self._make()
            # K stands in it twice, beside the small matrices.
            entries = 2.0 * self.k.nnz + len(self.small[0])
            self.seconds = (
                CALLS + SPARSE * sparse_work(entries, sum(self.k.shape)) + loading("scipy.sparse.linalg")
            )
        if self.deadline.passed(self.seconds):
            raise TooLate
        watch = Stopwatch()
        found = self._factor_of(what, eps)
        self.seconds = watch.seconds
        return found

    def _factor_of(self, what: int, eps: float) -> bool:
        s = self.of
        if what == WHATS["natural"]:
            p = self._small(s.p)
            own = sp.eye_array(s.m) - p + p @ sp.diags_array(s.theta + eps)
            return self._factor(p, None, own)
        right = None if s.bt is None else self._small(s.bt)
        left = s.v if s.bt is None else s.bt if what == WHATS["barrier"] else s.pair
        return self._factor(self._small(left), right, sp.eye_array(s.m))

    def solve(self, _augmented: int, r: FloatArray) -> FloatArray:
        """Dz or x for the right-hand side -F or Q r; not finite where there is no factor."""
        if self.lu is None:
            return np.full_like(r, np.nan)
        n = self.k.shape[1]
        right = np.concatenate([np.zeros(n), r])
        x: FloatArray = self.lu.solve(right)
        x += self.lu.solve(right - self.matrix @ x)
        return np.ascontiguousarray(x[n:])

    def _make(self) -> Any:
        sc, n = self.of, self.layout.n
        panel, _ = sc.jacobian(self.bodies.pair, self.bodies.column)
        size, m = np.diff(sc.ptr), sc.m
        body = np.repeat(self.layout.body, size, axis=0)
        values = panel[sc.keep].reshape(m, 2, 6)
        row = np.broadcast_to(np.arange(m)[:, None, None], values.shape)
        column = np.maximum(body, 0)[:, :, None] * 6 + np.arange(6)
        used = (values != 0.0) & (body >= 0)[:, :, None]
        k = sp.csc_array((values[used], (row[used], column[used])), shape=(m, 6 * n))
        kept = sp.csr_array(k[:, np.flatnonzero(np.diff(k.indptr))])
        square = np.repeat(size, size**2)
        inner = np.arange(int(sc.wptr[-1])) - np.repeat(sc.wptr[:-1], size**2)
        base = np.repeat(sc.ptr[:-1], size**2)
        self.small = base + inner // square, base + inner % square
        return kept

    def _small(self, values: FloatArray) -> Any:
        return sp.csr_array((values, self.small), shape=(self.of.m,) * 2)

    def _factor(self, left: Any, right: Any, own: Any) -> bool:
        upper = self.k if right is None else right @ self.k
        matrix = sp.block_array([[sp.eye_array(self.k.shape[1]), -upper.T], [left @ self.k, own]])
        self.lu = None
        if not np.isfinite(matrix.data).all():
            return False
        try:
            self.lu = sparse_lu(matrix)
        except RuntimeError:
            return False
        self.matrix = sp.csr_array(matrix)
        return True
