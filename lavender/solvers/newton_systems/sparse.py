"""Factorise the Newton matrices of a sparse A; all factors by panels share the analysis of one pattern.

    M = L H R^T + o L + I;   for bounded rows H + W, and H + eps on free rows with I on the others

M is factored as L L^T if it is symmetric, else as L U with row exchanges only inside each panel. The error that missing
pivoting across panels causes is visible in the residual of a solution x for the right-hand side r. It is refined once,
and x must satisfy

    max |r - M x| <= BACKWARD_TOLERANCE (max |M_ij| max |x| + max |r|)                                            (1)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import factor_sparse_lu
from lavender.solvers.factors import PIVOT_TOLERANCE, Panels
from lavender_ext.factor.sparse import is_mirrored
from lavender_ext.newton.coupled import coupled, coupled_entries, coupled_rows, element_graph
from lavender_ext.newton.solve import SYSTEMS, Solve

BACKWARD_TOLERANCE = 1e-12  # Largest accepted backward error (1): thousands of roundings.


class SparseRows:
    """H on the pattern of its elements, and the factorisations of Newton's matrices, which `Solve` calls.

    Matrices are factored by panels, and by SuperLU if panels lose a pivot or digits.
    """

    def __init__(self, solve: Solve, h: sp.csr_array, symmetric: bool) -> None:
        self.kernel, self.symmetric = solve, symmetric
        self.h: FloatArray = h.data
        if not solve.has_friction and is_mirrored(h.indptr, h.indices) and h.diagonal().all():
            # The pattern is the graph of its elements.
            self.to, self.other = self.indptr, self.indices = (h.indptr, h.indices)
        else:
            self.to, self.other = _graph(solve, h)
            self.indptr, self.indices = coupled_rows(solve.ptr, self.to, self.other)
            self.h = coupled_entries(h.indptr, h.indices, h.data, self.indptr, self.indices)
        row = np.repeat(np.arange(solve.m, dtype=np.int32), np.diff(self.indptr))
        self.diagonal = np.flatnonzero(row == self.indices).astype(np.int32)
        self.panels = Panels(self.indptr, self.indices)
        self.rows = sp.csr_array((self.h, self.indices, self.indptr))
        self.lu = self.is_factored = False
        self.max_entry = 0.0
        self.superlu_solve: Any = None

    def factor(self, _augmented: int, what: int, eps: float) -> bool:
        """Factor the matrix of the kind `what`; return whether that succeeded."""
        s, bounded = self.kernel, self.kernel.bt is None
        self.lu = not self.symmetric or what == SYSTEMS["pair"]
        if what == SYSTEMS["natural"]:
            self.lu = self.lu or not bounded
            self.rows.data = self._coupled(s.p, s.p if bounded else None, eps - 1.0)
        elif not bounded:
            self.rows.data = self._coupled(s.bt if what == SYSTEMS["barrier"] else s.pair, s.bt, 0.0)
        else:
            self.rows.data = self.h.copy()
            with np.errstate(divide="ignore", over="ignore"):
                # An infinite entry belongs to a row that no longer moves: the step fails.
                self.rows.data[self.diagonal] += 1.0 / s.v
        self.superlu_solve, self.is_factored = None, False  # This also holds after Ctrl-C.
        if np.isfinite(self.rows.data).all():
            self.is_factored = self.factor_panels() or self._factor_superlu()
        return self.is_factored

    def _coupled(self, left_factor: FloatArray, right: FloatArray | None, own: float) -> FloatArray:
        """Return the entries of L H R^T + own L + I for small matrices L and R of each element; None is I."""
        values = np.empty_like(self.h)
        coupled(self.kernel, self.to, self.other, self.indptr, self.h, left_factor, right, own, values)
        return values

    def factor_panels(self) -> bool:
        """Factor M by panels; return whether no pivot was lost."""
        values = self.rows.data
        d = np.ones(len(self.diagonal)) if self.lu else values[self.diagonal]
        self.max_entry = float(np.abs(values).max()) if self.lu else 0.0
        return (
            bool((d > 0.0).all())
            and self.panels.analysed(self.lu).factor(values, d, 0.0, PIVOT_TOLERANCE) == 0
        )

    def solve_panels(self, r: FloatArray) -> FloatArray | None:
        """Return M^-1 r with the factor by panels, or None if it does not satisfy (1)."""
        panels = self.panels.analysed(self.lu)
        x: FloatArray = panels.solve(r)
        if not self.lu:
            return x
        max_r = float(np.abs(r).max())
        for _ in range(2):
            error = r - self.rows @ x
            bound = BACKWARD_TOLERANCE * (self.max_entry * float(np.abs(x).max()) + max_r)
            if float(np.abs(error).max()) <= bound:
                return x
            x = x + panels.solve(error)
        return None

    def solve(self, _augmented: int, r: FloatArray) -> FloatArray:
        """Return M^-1 r; NaN if M has no factor."""
        if self.is_factored and self.superlu_solve is None:
            x = self.solve_panels(r)
            if x is not None:
                return x
            self.is_factored = self._factor_superlu()
        if not self.is_factored:
            return np.full_like(r, np.nan)
        solution: FloatArray = self.superlu_solve(r)
        return solution

    def _factor_superlu(self) -> bool:
        """Factor M by SuperLU; return whether that succeeded."""
        matrix = self.rows.copy()
        matrix.eliminate_zeros()
        try:
            self.superlu_solve = factor_sparse_lu(matrix, permc_spec="COLAMD").solve
        except RuntimeError:
            return False
        return True


def _graph(sc: Solve, a: sp.csr_array) -> tuple[IntArray, IntArray]:
    """Return (indptr, indices) of the symmetric graph of the elements that A couples, with all diagonal entries."""
    n = len(sc.ptr) - 1
    element = np.repeat(np.arange(n, dtype=np.int32), np.diff(sc.ptr))
    to, other = element_graph(sc.ptr, element, a.indptr, a.indices)
    graph = sp.csr_array((np.ones(len(other), bool), other, to), shape=(n, n))
    graph.sort_indices()
    if not (is_mirrored(graph.indptr, graph.indices) and graph.diagonal().all()):
        graph = sp.csr_array(graph + graph.T + sp.eye_array(n, dtype=bool))
        graph.sort_indices()
    return graph.indptr.astype(np.int32), graph.indices.astype(np.int32)
