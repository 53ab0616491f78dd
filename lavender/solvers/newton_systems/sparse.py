"""Newton's matrices of an A with few entries: one pattern, whose analysis all factors by panels share.

    M = L H R^T + o L + I,   of bounded rows H + W, and H + eps where they are free with I elsewhere

L L^T where M is symmetric; else L U that exchanges rows inside a panel alone. What pivoting across panels would have
saved shows in what a solution x leaves of its right-hand side r, and is refined away once: it is as exact as

    max |r - M x| <= BACKWARD (max |M_ij| max |x| + max |r|)                                            (1)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import sparse_lu
from lavender.solvers.factors import TINY, Panels
from lavender_ext.factor.sparse import is_mirrored
from lavender_ext.newton.coupled import coupled, coupled_entries, coupled_rows, element_graph
from lavender_ext.newton.solve import WHATS, Solve

BACKWARD = 1e-12  # (1): thousands of roundings


class SparseRows:
    """H on the pattern of its elements; who factors for `Solve` what Newton's method makes of it, and solves with that.

    By panels; by SuperLU where these lose a pivot or digits.
    """

    def __init__(self, solve: Solve, h: sp.csr_array, symmetric: bool) -> None:
        self.small, self.symmetric = solve, symmetric
        self.h: FloatArray = h.data
        if not solve.has_friction and is_mirrored(h.indptr, h.indices) and h.diagonal().all():
            self.to, self.other = self.indptr, self.indices = (
                h.indptr,
                h.indices,
            )  # a pattern is its own graph
        else:
            self.to, self.other = _graph(solve, h)
            self.indptr, self.indices = coupled_rows(solve.ptr, self.to, self.other)
            self.h = coupled_entries(h.indptr, h.indices, h.data, self.indptr, self.indices)
        row = np.repeat(np.arange(solve.m, dtype=np.int32), np.diff(self.indptr))
        self.diagonal = np.flatnonzero(row == self.indices).astype(np.int32)
        self.panels = Panels(self.indptr, self.indices)
        self.rows = sp.csr_array((self.h, self.indices, self.indptr))
        self.lu = self.made = False
        self.size = 0.0
        self.instead: Any = None

    def factor(self, _augmented: int, what: int, eps: float) -> bool:
        """Whether there is a factor."""
        s, bounded = self.small, self.small.bt is None
        self.lu = not self.symmetric or what == WHATS["pair"]
        if what == WHATS["natural"]:
            self.lu = self.lu or not bounded
            self.rows.data = self._coupled(s.p, s.p if bounded else None, eps - 1.0)
        elif not bounded:
            self.rows.data = self._coupled(s.bt if what == WHATS["barrier"] else s.pair, s.bt, 0.0)
        else:
            self.rows.data = self.h.copy()
            with np.errstate(divide="ignore", over="ignore"):
                self.rows.data[self.diagonal] += (
                    1.0 / s.v
                )  # inf for a row that no longer moves: the step fails
        self.instead, self.made = None, False  # and so after Ctrl-C
        if np.isfinite(self.rows.data).all():
            self.made = self.factor_panels() or self._superlu()
        return self.made

    def _coupled(self, left: FloatArray, right: FloatArray | None, own: float) -> FloatArray:
        """L H R^T + own L + I of small matrices for each element; None is I."""
        values = np.empty_like(self.h)
        coupled(self.small, self.to, self.other, self.indptr, self.h, left, right, own, values)
        return values

    def factor_panels(self) -> bool:
        """Whether panels lose no pivot of M."""
        values = self.rows.data
        d = np.ones(len(self.diagonal)) if self.lu else values[self.diagonal]
        self.size = float(np.abs(values).max()) if self.lu else 0.0
        return bool((d > 0.0).all()) and self.panels.analysed(self.lu).factor(values, d, 0.0, TINY) == 0

    def solve_panels(self, r: FloatArray) -> FloatArray | None:
        """M^-1 r with the last factor, None where that is not (1)."""
        panels = self.panels.analysed(self.lu)
        x: FloatArray = panels.solve(r)
        if not self.lu:
            return x
        most = float(np.abs(r).max())
        for _ in range(2):
            left = r - self.rows @ x
            if float(np.abs(left).max()) <= BACKWARD * (self.size * float(np.abs(x).max()) + most):
                return x
            x = x + panels.solve(left)
        return None

    def solve(self, _augmented: int, r: FloatArray) -> FloatArray:
        """M^-1 r; not finite where there is none."""
        if self.made and self.instead is None:
            x = self.solve_panels(r)
            if x is not None:
                return x
            self.made = self._superlu()
        if not self.made:
            return np.full_like(r, np.nan)
        found: FloatArray = self.instead(r)
        return found

    def _superlu(self) -> bool:
        matrix = self.rows.copy()
        matrix.eliminate_zeros()
        try:
            self.instead = sparse_lu(matrix, permc_spec="COLAMD").solve
        except RuntimeError:
            return False
        return True


def _graph(sc: Solve, a: sp.csr_array) -> tuple[IntArray, IntArray]:
    """(indptr, indices) of the elements that A couples, either way, each with itself."""
    n = len(sc.ptr) - 1
    of = np.repeat(np.arange(n, dtype=np.int32), np.diff(sc.ptr))
    to, other = element_graph(sc.ptr, of, a.indptr, a.indices)
    graph = sp.csr_array((np.ones(len(other), bool), other, to), shape=(n, n))
    graph.sort_indices()
    if not (is_mirrored(graph.indptr, graph.indices) and graph.diagonal().all()):
        graph = sp.csr_array(graph + graph.T + sp.eye_array(n, dtype=bool))
        graph.sort_indices()
    return graph.indptr.astype(np.int32), graph.indices.astype(np.int32)
