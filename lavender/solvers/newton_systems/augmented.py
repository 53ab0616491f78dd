"""Augmented system of the bodies, for nearly dependent rows.

    [ I     -K^T              ] [ dy ]   [  0 ]
    [ P K   I - P + P theta   ] [ dz ] = [ -F ]        y = K^T z, P in the derivative of Pi               (1)

Eliminating dy gives H = K K^T, eliminating dz gives K^T K. Both square the singular values of K, so that values below
sqrt(2^-53) of the largest are lost. Closed loops of hinges and nearly parallel axes have singular values of 1e-6 to
1e-8, and impulses of 1e4 and more along them. (1) contains K itself. A shift on the rows with P = 1 makes systems with
redundant rows regular; refinement removes the effect of the shift (Bjorck 1996, section 2.4.4). The systems
(H + W) dz = r of an interior point are treated in the same way, with W^-1 = R^T Q and dz = R^T x,

    [ I     -K^T R^T ] [ dy ]   [  0  ]
    [ Q K    I       ] [ x  ] = [ Q r ]                                                                   (2)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import factor_sparse_lu
from lavender.problem import Problem
from lavender_ext.newton.solve import SYSTEMS, Layout, Solve, compute_body_jacobian


class AugmentedSystem:
    """Factorises (1) and (2) for the kernel `Solve`. K is built at the first call."""

    def __init__(self, problem: Problem, layout: Layout, bodies: Any, kernel: Solve) -> None:
        self.problem, self.layout, self.bodies, self.kernel = problem, layout, bodies, kernel
        self.k: Any = None
        self.lu: Any = None

    def factor(self, what: int, eps: float) -> bool:
        """Factor (2), or (1) for the P of the last natural map with eps added to theta; return whether it succeeded.

        SuperLU reads no clock; after the deadline, nothing is factored.
        """
        deadline = self.kernel.deadline
        if deadline is not None and deadline.has_passed():
            return False
        s = self.arrays = self.kernel.view_arrays()
        if self.k is None:
            self.k = self._build_jacobian()
        if what == SYSTEMS["natural"]:
            p = self._block_matrix(s.p)
            own = sp.eye_array(s.m) - p + p @ sp.diags_array(s.theta + eps)
            return self._factor(p, None, own)
        right = None if s.bt is None else self._block_matrix(s.bt)
        left_factor = s.v if s.bt is None else s.bt if what == SYSTEMS["barrier"] else s.pair
        return self._factor(self._block_matrix(left_factor), right, sp.eye_array(s.m))

    def solve(self, r: FloatArray) -> FloatArray:
        """Return dz or x for the right-hand side -F or Q r; NaN if there is no factor."""
        if self.lu is None:
            return np.full_like(r, np.nan)
        n = self.k.shape[1]
        right = np.concatenate([np.zeros(n), r])
        x: FloatArray = self.lu.solve(right)
        x += self.lu.solve(right - self.matrix @ x)
        return np.ascontiguousarray(x[n:])

    def _build_jacobian(self) -> Any:
        """Build K (m, 6 n) without empty columns, and the positions of the entries of block matrices."""
        sc = self.arrays
        n = self.layout.n
        panel, _ = compute_body_jacobian(self.problem.metric, self.bodies.pair, self.bodies.column)
        size = np.diff(sc.ptr)
        m = sc.m
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
        self.block_entries = base + inner // square, base + inner % square
        return kept

    def _block_matrix(self, values: FloatArray) -> Any:
        """Return the block-diagonal matrix (m, m) with these values."""
        return sp.csr_array((values, self.block_entries), shape=(self.arrays.m,) * 2)

    def _factor(self, left_factor: Any, right: Any, own: Any) -> bool:
        """Factor [[I, -(right K)^T], [left K, own]]; `right` None is the identity."""
        upper = self.k if right is None else right @ self.k
        matrix = sp.block_array(
            [[sp.eye_array(self.k.shape[1]), -upper.T], [left_factor @ self.k, own]]
        )
        self.lu = None
        if not np.isfinite(matrix.data).all():
            return False
        try:
            self.lu = factor_sparse_lu(matrix)
        except RuntimeError:
            return False
        self.matrix = sp.csr_array(matrix)
        return True
