"""Factorisations: which one a matrix gets under `direct`, and one interface over them, `factor` and `solve`.

    band     LDL^T by diagonals in compiled code (small matrices, and any of small bandwidth)
    dense    Cholesky of a full matrix
    sparse   Cholesky by dense panels of a permuted matrix, in compiled code as well (`lavender_ext/factor/sparse.pyx`)
    general  LU where A is not symmetric definite: with pivoting (LAPACK getrf, or SuperLU; compiled for few rows), or
             first by such panels, rows exchanged inside each, where A has few entries and theirs a symmetric pattern

A pivot of at most 1e-13 d_i counts as zero: some hundred roundings of A_ii, and below what a mass ratio of
1e8 leaves.
"""

from __future__ import annotations

import os
from typing import Any, Protocol

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.base.lazy_import import import_numerics, lapack
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import sparse_lu
from lavender.problem import Problem
from lavender.solvers.setup_times import dense_work
from lavender_ext.factor.sparse import FullCholesky, SparsePanels, free_part, is_mirrored

TINY = 1e-13  # -, of d
SMALL_SIZE = 64  # rows up to which factors stay in the compiled loop, and beat those that Python hands it
SMALL_BAND = 40  # half bandwidth up to which it beats the others
DENSE_SHARE = 0.1  # of nonzeros, from which dense Cholesky beats sparse
PANELS_SHARE = 0.25  # of nonzeros, up to which panels are looked at for a linear system
# ns: of a compiled band for each row and square of its width; of a full Cholesky a call, and for each multiply-add and
# entry (LAPACK's on one thread, 0.7 to 1 of ours); of panels, their analysis included, a call, and for each nonzero of
# A, as many times more as it has some thousand rows.
BAND, FULL, DENSE, DENSE_ENTRY = 0.4, 20e3, 0.03, 3.0
PANELS, PANELS_ENTRY, PANELS_ROWS = 20e3, 17.0, 8000.0
PANELS_WORK = 0.2  # ns a multiply-add of panels, once these are counted
DENSE_LIMIT = 6000  # rows, 288 MB
WIDE = os.environ.get("LAVENDER_BASELINE", "0") in ("", "0")  # four lanes where there are: the same bits
GENERAL_LIMIT = 2000  # rows up to which a singular matrix that is not symmetric is decomposed as a dense one


def choose(problem: Problem) -> tuple[str, int, IntArray | None]:
    """Factorisation, half bandwidth and order of elimination (None: as given) for a symmetric A; by structure alone."""
    kept: tuple[str, int, IntArray | None] | None = problem.derived.cache.get(__name__)
    if kept is None:
        kept = problem.derived.cache[__name__] = _choose(problem)
    return kept


def _choose(problem: Problem) -> tuple[str, int, IntArray | None]:
    m = problem.m
    band = max(problem.bandwidth)
    if m <= SMALL_SIZE:
        return "band", band, None
    nnz = len(problem._compressed[1])
    if problem.law == "linear" and nnz <= PANELS_SHARE * m * m:
        # One factor: by what it costs.
        narrow = BAND * m * float(band + 1) ** 2
        full = FULL + dense_cost(m)
        if panels_cost(nnz, m) < min(narrow, full if m <= DENSE_LIMIT else np.inf):
            return "sparse", m - 1, None
        return ("band", band, None) if narrow <= full else ("dense", m - 1, None)
    if band <= SMALL_BAND:
        return "band", band, None
    if nnz >= DENSE_SHARE * m * m and m <= DENSE_LIMIT:
        return "dense", m - 1, None
    # A band has at most 2 band + 1 nonzeros a row: a row of more is in none so narrow.
    if np.diff(problem._compressed[0]).max() <= 2 * SMALL_BAND + 1:
        order = narrow_order(problem)
        band = permuted_band(problem, order)
        if band <= SMALL_BAND:
            return "band", band, order
    return "sparse", m - 1, None


def dense_cost(m: int) -> float:
    """Of one full Cholesky factor of m rows [ns], without the call."""
    return DENSE * dense_work(m) + DENSE_ENTRY * float(m) ** 2


def panels_cost(nnz: int, m: int) -> float:
    """Of one factor by panels [ns], of a symmetric matrix of m rows and nnz entries."""
    return PANELS + PANELS_ENTRY * nnz * (1.0 + m / PANELS_ROWS)


def narrow_order(problem: Problem) -> IntArray:
    """Rows of A in an order of small bandwidth: reverse Cuthill-McKee."""
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    order = reverse_cuthill_mckee(problem.csr, symmetric_mode=problem.is_symmetric)
    return np.ascontiguousarray(order, np.int32)


def permuted_band(problem: Problem, order: IntArray) -> int:
    """Half bandwidth of A with its rows in that order."""
    place = np.empty(problem.m, np.int64)
    place[order] = np.arange(problem.m)
    a = problem.csr
    row = np.repeat(place, np.diff(a.indptr))
    return int(np.abs(row - place[a.indices]).max(initial=0))


class Factor(Protocol):
    """Factorisation of A_FF + shift D_FF for changing free sets."""

    def factor(self, place: IntArray, n_free: int, shift: float) -> int:
        """Factor the rows with place >= 0, one at least, in order of rows; how many pivots are not above TINY d."""
        ...

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Solve for the free rows, (n_free,)."""
        ...


class DenseFactor:
    """Cholesky, A = L L^T."""

    def __init__(self, problem: Problem) -> None:
        self.a = problem.dense()
        self.d = problem.csr_data.d

    def factor(self, place: IntArray, n_free: int, shift: float) -> int:
        free = np.flatnonzero(place >= 0)
        a = self.a.copy() if n_free == len(place) else self.a[np.ix_(free, free)]
        d = self.d[free]
        if shift > 0.0:
            a.flat[:: n_free + 1] += shift * d
        self.full = FullCholesky(a, TINY * d, WIDE)
        return self.full.lost

    def solve(self, rhs: FloatArray) -> FloatArray:
        return self.full.solve(rhs)


class Panels:
    """Factors of matrices of one symmetric pattern, L L^T and L U in one order, which is found at first use."""

    def __init__(self, indptr: IntArray, indices: IntArray) -> None:
        self.pattern, self.made = (indptr, indices), dict[bool, SparsePanels]()

    def analysed(self, lu: bool) -> SparsePanels:
        """What factors and solves, with its multiply-adds as `work`; no number is looked at."""
        if lu not in self.made:
            self.made[lu] = SparsePanels(*self.pattern, lu, WIDE, self.made.get(not lu))
        return self.made[lu]

    def work(self, lu: bool = False) -> float:
        """Multiply-adds of one factor, inf where it has more entries than can be counted."""
        try:
            return float(self.analysed(lu).work)
        except OverflowError:
            return np.inf


class SparseFactor:
    """Cholesky by panels, in an order of least degree."""

    def __init__(self, problem: Problem) -> None:
        self.d = problem.csr_data.d
        self.m = problem.m
        self.pattern = rows_of(mirrored(problem.csr))
        self.whole = Panels(*self.pattern[:2])

    def factor(self, place: IntArray, n_free: int, shift: float) -> int:
        indptr, indices, data = self.pattern
        if n_free == self.m:
            self.panels, d = self.whole.analysed(False), self.d
        else:
            indptr, indices, data = free_part(indptr, indices, data, place, n_free)
            self.panels, d = SparsePanels(indptr, indices, False, WIDE), self.d[place >= 0]
        return self.panels.factor(data, d, shift, TINY)

    def solve(self, rhs: FloatArray) -> FloatArray:
        return self.panels.solve(rhs)


def mirrored(matrix: sp.csr_array) -> sp.csr_array:
    """The same in sorted rows, with an entry, if only 0, at (j, i) wherever there is one at (i, j)."""
    if is_mirrored(*rows_of(matrix)[:2]):
        return matrix
    a = sp.coo_array(matrix)
    where = (np.concatenate([a.row, a.col]), np.concatenate([a.col, a.row]))
    return sp.csr_array((np.concatenate([a.data, np.zeros(a.nnz)]), where), shape=a.shape)


def rows_of(matrix: Any) -> tuple[Any, Any, Any]:
    """(ptr, index, value) of sorted rows, as the kernels read them."""
    matrix.sort_indices()
    value = np.ascontiguousarray(matrix.data if matrix.nnz else np.zeros(1), np.float64)
    index = np.ascontiguousarray(matrix.indices if matrix.nnz else np.zeros(1), np.int32)
    return np.ascontiguousarray(matrix.indptr, np.int32), index, value


def _scaled(problem: Problem) -> tuple[FloatArray, sp.csr_array]:
    """D^-1/2 (m,), and D^-1/2 A D^-1/2."""
    scale = 1.0 / np.sqrt(problem.csr_data.d)
    return scale, sp.csr_array(sp.diags_array(scale) @ problem.csr @ sp.diags_array(scale))


def _superlu(a: sp.csc_array) -> tuple[Any, FloatArray]:
    """LU with pivoting and the sizes of its pivots; one of 0 alone where it is exactly singular."""
    try:
        lu = sparse_lu(a)
        return lu, np.abs(lu.U.diagonal())
    except RuntimeError:
        return None, np.zeros(1)


class LUFactor:
    """LU of D^-1/2 A_FF D^-1/2, of an A that is not symmetric."""

    def __init__(self, problem: Problem) -> None:
        m = problem.m
        self.scale, scaled = _scaled(problem)
        self.sparse = problem.csr.nnz < DENSE_SHARE * m * m or m > DENSE_LIMIT
        self.a: Any = scaled if self.sparse else scaled.toarray()
        if self.sparse:
            import_numerics("scipy.sparse.linalg")

    def factor(self, place: IntArray, n_free: int, shift: float) -> int:
        self.free = np.flatnonzero(place >= 0)
        if self.sparse:
            return self._factor_sparse(shift)
        a = self.a[np.ix_(self.free, self.free)]
        if shift > 0.0:
            a.flat[:: n_free + 1] += shift
        lu, pivot, info = lapack.dgetrf(a, overwrite_a=1)
        self.lu: Any = (lu, pivot)
        if info != 0:
            return n_free
        return int(np.count_nonzero(~(np.abs(np.diagonal(lu)) > TINY)))

    def _factor_sparse(self, shift: float) -> int:
        a = sp.csc_array(self.a[self.free][:, self.free])
        if shift > 0.0:
            a = sp.csc_array(a + shift * sp.eye_array(len(self.free)))
        self.lu, pivot = _superlu(a)
        return len(self.free) if self.lu is None else int(np.count_nonzero(~(pivot > TINY)))

    def solve(self, rhs: FloatArray) -> FloatArray:
        scale = self.scale[self.free]
        y = scale * rhs
        y = self.lu.solve(y) if self.sparse else lapack.dgetrs(*self.lu, y)[0]
        return scale * y


class PanelsLU:
    """LU of D^-1/2 A D^-1/2 by panels: what pivoting across them would have saved, refinement has to end.

    Attributes
    ----------
    usable : bool
        No pivot is lost to rounding.
    """

    def __init__(self, problem: Problem) -> None:
        indptr, indices, data = problem._compressed
        self.panels = SparsePanels(indptr, indices, True, WIDE)
        self.rank = problem.m
        self.usable = self.panels.factor(data, problem.csr_data.d, 0.0, TINY) == 0

    @staticmethod
    def takes(problem: Problem) -> bool:
        """Few entries, and (i, j) is one wherever (j, i) is."""
        indptr, indices, _ = problem._compressed
        return len(indices) <= PANELS_SHARE * problem.m**2 and is_mirrored(indptr, indices)

    def solve(self, rhs: FloatArray) -> FloatArray:
        return self.panels.solve(rhs)


class GeneralFactor:
    """LU of A scaled to D^-1/2 A D^-1/2, with a rank-revealing path where that is singular.

    Attributes
    ----------
    rank : int
        m, or the rank found by QR with column pivoting; -1 where A is singular and too large for that.
    """

    def __init__(self, problem: Problem) -> None:
        self.rank = m = problem.m
        self.scale, scaled = _scaled(problem)
        self.lu: Any = None
        self.dense: FloatArray | None = None
        if problem.csr.nnz >= DENSE_SHARE * m * m or m <= SMALL_SIZE:
            self._factor_dense(scaled.toarray())
        else:
            self._factor_sparse(sp.csc_array(scaled))

    def _factor_dense(self, a: FloatArray) -> None:
        lu, pivot, info = lapack.dgetrf(a)
        norm = np.abs(a).sum(axis=0).max(initial=0.0)
        rcond = lapack.dgecon(lu, norm)[0] if info == 0 and len(a) else float(len(a) == 0)
        if rcond <= TINY * max(1, len(a)) / 10.0:
            self._reveal(a)
        else:
            self.lu = (lu, pivot)

    def _factor_sparse(self, a: sp.csc_array) -> None:
        self.lu, pivot = _superlu(a)
        if pivot.min(initial=np.inf) > TINY * max(1.0, pivot.max(initial=0.0)):
            return
        self.lu = None
        if a.shape[0] <= GENERAL_LIMIT:
            self._reveal(a.toarray())
        else:
            self.rank = -1

    def _reveal(self, a: FloatArray) -> None:
        # A P = Q R; the rank is where |R_ii| falls to rounding. Least squares of least norm in the metric of D.
        self.dense = a
        u, s, vt = np.linalg.svd(a)
        self.rank = int(np.count_nonzero(s > len(a) * TINY / 10.0 * s[0])) if len(s) and s[0] > 0.0 else 0
        self.svd = (u[:, : self.rank], s[: self.rank], vt[: self.rank])
        self.null = u[:, self.rank :]

    def outside(self, rhs: FloatArray) -> FloatArray:
        """The part y of D^-1 rhs with A^T y = 0, from the left singular vectors; 0 where they are not known."""
        if self.dense is None:
            return np.zeros_like(rhs)
        return self.scale * (self.null @ (self.null.T @ (self.scale * rhs)))

    @property
    def usable(self) -> bool:
        return self.lu is not None or self.dense is not None

    def solve(self, rhs: FloatArray) -> FloatArray:
        y = self.scale * rhs
        if self.dense is not None:
            u, s, vt = self.svd
            y = vt.T @ ((u.T @ y) / s)
        elif isinstance(self.lu, tuple):
            y = lapack.dgetrs(*self.lu, y)[0]
        else:
            y = self.lu.solve(y)
        return self.scale * y
