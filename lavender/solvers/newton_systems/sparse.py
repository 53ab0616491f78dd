"""Newton's matrices of an A with few entries: one pattern, whose analysis all factors by panels share.

    M = L H R^T + o L + I,   of bounded rows H + W, and H + eps where they are free with I elsewhere

L L^T where M is symmetric; else L U that exchanges rows inside a panel alone. What pivoting across panels would have
saved shows in what a solution x leaves of its right-hand side r, and is refined away once: it is as exact as

    max |r - M x| <= BACKWARD (max |M_ij| max |x| + max |r|)                                            (1)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from lavender._arrays import FloatArray, IntArray
from lavender.lu import sparse_lu
from lavender.solvers._factor import TINY, WIDE
from lavender_ext.factor.sparse import SparsePanels, is_mirrored
from lavender_ext.newton.coupled import coupled, coupled_entries, coupled_rows, element_graph
from lavender_ext.newton.solve import WHATS, Solve

if TYPE_CHECKING:
    from lavender.solvers.newton_systems.systems import MatrixSystem

__all__ = ["Coupled", "Panelled", "SparseRows"]

BACKWARD = 1e-12  # (1): thousands of roundings


@dataclass
class Panelled:
    """M in compressed rows, and the panels that factor it."""

    panels: SparsePanels
    lu: bool
    rows: sp.csr_array  # shared with the others of its pattern
    values: FloatArray
    diagonal: IntArray  # (n,) where its entries are

    def factor(self) -> bool:
        """Whether no pivot is lost."""
        d = np.ones(len(self.diagonal)) if self.lu else self.values[self.diagonal]
        self.size = float(np.abs(self.values).max()) if self.lu else 0.0
        self.rows.data = self.values
        return bool((d > 0.0).all()) and self.panels.factor(self.values, d, 0.0, TINY) == 0

    def solve(self, r: FloatArray) -> FloatArray | None:
        """M^-1 r with the last factor, None where that is not (1)."""
        x: FloatArray = self.panels.solve(r)
        if not self.lu:
            return x
        most = float(np.abs(r).max())
        for _ in range(2):
            left = r - self.rows @ x
            if float(np.abs(left).max()) <= BACKWARD * (self.size * float(np.abs(x).max()) + most):
                return x
            x = x + self.panels.solve(left)
        return None

    def matrix(self) -> sp.csr_array:
        """Without entries that are nought."""
        found = sp.csr_array((self.values, self.rows.indices, self.rows.indptr), copy=True)
        found.eliminate_zeros()
        return found


class Coupled:
    """H on the pattern of its elements, and what Newton's method makes of it."""

    def __init__(self, solve: Solve, h: sp.csr_array) -> None:
        self.elements = solve
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
        self.diagonal = _diagonal(self.indptr, self.indices)
        self.panels: dict[bool, SparsePanels] = {}
        self.rows = sp.csr_array((self.h, self.indices, self.indptr))

    def analysed(self, lu: bool) -> SparsePanels:
        """The panels of all rows; no number is looked at."""
        found = self.panels.get(lu)
        if found is None:
            found = SparsePanels(self.indptr, self.indices, lu, WIDE, self.panels.get(not lu))
            self.panels[lu] = found
        return found

    @property
    def work(self) -> float:
        """Multiply-adds of L L^T, inf where it has more entries than can be counted."""
        try:
            return float(self.analysed(False).work)
        except OverflowError:
            return np.inf

    def _whole(self, values: FloatArray, lu: bool) -> Panelled:
        return Panelled(self.analysed(lu), lu, self.rows, values, self.diagonal)

    def barrier(self, w: FloatArray, lu: bool) -> Panelled:
        """H + W of bounded rows."""
        values = self.h.copy()
        values[self.diagonal] += w
        return self._whole(values, lu)

    def small(self, left: FloatArray, right: FloatArray | None, own: float, lu: bool) -> Panelled:
        """L H R^T + own L + I of small matrices for each element; None is I."""
        values = np.empty_like(self.h)
        coupled(self.elements, self.to, self.other, self.indptr, self.h, left, right, own, values)
        return self._whole(values, lu)


class SparseRows:
    """Who factors a sparse M for `Solve` and solves with it: panels; SuperLU where these lose a pivot or digits."""

    def __init__(self, system: MatrixSystem) -> None:
        self.system = system

    def factor(self, _augmented: int, what: int, eps: float) -> bool:
        """Whether there is a factor."""
        s, own, coupled = self.system.solve, eps - 1.0, self.system.sparse
        lu = not self.system.symmetric
        if what == WHATS["natural"]:
            bounded = s.bt is None
            made = coupled.small(s.p, s.p if bounded else None, own, lu or not bounded)
        elif s.bt is None:
            with np.errstate(divide="ignore", over="ignore"):
                made = coupled.barrier(1.0 / s.v, lu)  # inf for a row that no longer moves: the step fails
        elif what == WHATS["barrier"]:
            made = coupled.small(s.bt, s.bt, 0.0, lu)
        else:
            made = coupled.small(s.pair, s.bt, 0.0, True)
        self.made: Panelled | None = made
        self.instead: Any = None
        if not np.isfinite(made.values).all():
            self.made = None
        elif not made.factor():
            self._superlu()
        return self.made is not None

    def solve(self, _augmented: int, r: FloatArray) -> FloatArray:
        """M^-1 r; not finite where there is none."""
        if self.made is not None and self.instead is None:
            x = self.made.solve(r)
            if x is not None:
                return x
            self._superlu()
        if self.made is None:
            return np.full_like(r, np.nan)
        found: FloatArray = self.instead(r)
        return found

    def _superlu(self) -> None:
        assert self.made is not None
        try:
            self.instead = sparse_lu(self.made.matrix(), permc_spec="COLAMD").solve
        except RuntimeError:
            self.made = None


def _graph(sc: Solve, a: sp.csr_array) -> tuple[IntArray, IntArray]:
    """(indptr, indices) of the elements that A couples, either way, each with itself."""
    n = len(sc.kind)
    of = np.repeat(np.arange(n, dtype=np.int32), np.diff(sc.ptr))
    to, other = element_graph(sc.ptr, of, a.indptr, a.indices)
    graph = sp.csr_array((np.ones(len(other), bool), other, to), shape=(n, n))
    graph.sort_indices()
    if not (is_mirrored(graph.indptr, graph.indices) and graph.diagonal().all()):
        graph = sp.csr_array(graph + graph.T + sp.eye_array(n, dtype=bool))
        graph.sort_indices()
    return graph.indptr.astype(np.int32), graph.indices.astype(np.int32)


def _diagonal(indptr: IntArray, indices: IntArray) -> IntArray:
    row = np.repeat(np.arange(len(indptr) - 1, dtype=np.int32), np.diff(indptr))
    return np.flatnonzero(row == indices).astype(np.int32)
