"""Factorisations of `direct`: selection by the matrix, and a common interface with `factor` and `solve`.

    band     LDL^T by diagonals in compiled code (small matrices, and matrices of small bandwidth)
    dense    Cholesky of a full matrix
    sparse   Cholesky by supernodes of a permuted matrix, in compiled code (`lavender_ext/factor/linear.pxd`)
    general  LU with pivoting, if A is not symmetric positive definite: LAPACK's getrf, or SuperLU; compiled for few
             rows. If A is sparse with a symmetric pattern, supernodal LU with exchanges inside panels is tried first

A pivot of at most 1e-13 d_i counts as zero: this is some hundred roundings of A_ii, and less than the pivots of
problems with a mass ratio of 1e8.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.base.deadline import NEVER
from lavender.base.lazy_import import import_numerical_modules, lapack
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import factor_sparse_lu
from lavender.problem import Problem
from lavender.solvers.costs import RATES, estimate_dense_factor_cost
from lavender_ext.factor.linear import LinearSystem
from lavender_ext.factor.sparse import extract_free_part, has_symmetric_pattern

PIVOT_TOLERANCE = 1e-13  # Pivots of at most this multiple of d_i count as zero [-].
# Up to this many rows, factors are computed in the compiled loop, which is faster than factors by Python.
MAX_COMPILED_FACTOR_ROWS = 64
MAX_COMPILED_BAND = 40  # Up to this half bandwidth, the compiled band factorisation is the fastest.
MIN_DENSE_FRACTION = (
    0.1  # Above this fraction of nonzeros, dense Cholesky is faster than sparse Cholesky.
)
MAX_PANELS_FRACTION = (
    0.25  # Supernodal LU is considered for a linear system up to this fraction of nonzeros.
)
# A factor by panels costs 1 + rows / PANELS_GROWTH_ROWS times its rate per entry.
PANELS_GROWTH_ROWS = 8000.0
# Matrices with more rows are not stored as dense arrays; at this size one takes 288 MB.
MAX_DENSE_ROWS = 6000
# Whether to use vectors of four numbers if the processor has them. The results have the same bits.
USE_WIDE_LANES = os.environ.get("LAVENDER_BASELINE", "0") in ("", "0")
# Up to this many rows, the rank of a singular asymmetric matrix is computed with a dense decomposition.
MAX_DENSE_RANK_ROWS = 2000


def choose_factorisation(problem: Problem) -> tuple[str, int, IntArray | None]:
    """Choose the factorisation of a symmetric A by its structure.

    Return its name, the half bandwidth, and the elimination order, which is None for the given order.
    """
    choice: tuple[str, int, IntArray | None] | None = problem.derived.cache.get(__name__)
    if choice is None:
        choice = problem.derived.cache[__name__] = _compute_factorisation_choice(problem)
    return choice


def _compute_factorisation_choice(problem: Problem) -> tuple[str, int, IntArray | None]:
    """Compute the choice of `choose_factorisation`."""
    m = problem.m
    band = max(problem.bandwidth)
    if m <= MAX_COMPILED_FACTOR_ROWS:
        return "band", band, None
    nnz = len(problem._compressed[1])
    if problem.law == "linear" and nnz <= MAX_PANELS_FRACTION * m * m:
        # A linear problem needs one factorisation: choose the cheapest.
        narrow = RATES["band work"] * m * float(band + 1) ** 2
        full = RATES["dense call"] + estimate_dense_factor_cost(m)
        panels = RATES["panels call"] + RATES["panels entry"] * nnz * (1.0 + m / PANELS_GROWTH_ROWS)
        if panels < min(narrow, full if m <= MAX_DENSE_ROWS else np.inf):
            return "sparse", m - 1, None
        return ("band", band, None) if narrow <= full else ("dense", m - 1, None)
    if band <= MAX_COMPILED_BAND:
        return "band", band, None
    if nnz >= MIN_DENSE_FRACTION * m * m and m <= MAX_DENSE_ROWS:
        return "dense", m - 1, None
    # In a narrow band, every row has at most 2 band + 1 nonzeros.
    if np.diff(problem._compressed[0]).max() <= 2 * MAX_COMPILED_BAND + 1:
        from scipy.sparse.csgraph import reverse_cuthill_mckee

        a = problem.csr
        order = reverse_cuthill_mckee(a, symmetric_mode=problem.is_symmetric)
        order = np.ascontiguousarray(order, np.int32)
        position = np.empty(m, np.int64)
        position[order] = np.arange(m)
        row = np.repeat(position, np.diff(a.indptr))
        band = int(np.abs(row - position[a.indices]).max(initial=0))
        if band <= MAX_COMPILED_BAND:
            return "band", band, order
    return "sparse", m - 1, None


# The kernel of `PivotState` calls `DenseFactor`, `SparseFactor` or `LUFactor`. `factor(place, n_free, shift)` factors
# A + shift D of the free rows, which have place >= 0, in their order. It returns the number of pivots that do not
# exceed PIVOT_TOLERANCE d, or -1 after the deadline. `solve` solves for the free rows, (n_free,).


class DenseFactor:
    """Dense Cholesky factor, A = L L^T."""

    deadline = NEVER

    def __init__(self, problem: Problem) -> None:
        self.a = problem.dense()
        self.d = problem.csr_data.d

    def factor(self, place: IntArray, n_free: int, shift: float) -> int:
        free = np.flatnonzero(place >= 0)
        a = self.a.copy() if n_free == len(place) else self.a[np.ix_(free, free)]
        self.system = LinearSystem(n_free, USE_WIDE_LANES)
        return self.system.factor(a, self.d[free], shift, PIVOT_TOLERANCE, deadline=self.deadline)

    def solve(self, rhs: FloatArray) -> FloatArray:
        return self.system.solve(rhs)


class SparseFactor:
    """Cholesky factor by supernodes, in an order of minimum degree."""

    deadline = NEVER

    def __init__(self, problem: Problem) -> None:
        self.d = problem.csr_data.d
        self.m = problem.m
        self.pattern = get_sorted_csr_arrays(make_pattern_symmetric(problem.csr))
        self.all_rows = LinearSystem(self.pattern[:2], USE_WIDE_LANES)

    def factor(self, place: IntArray, n_free: int, shift: float) -> int:
        indptr, indices, data = self.pattern
        self.system, d = self.all_rows, self.d
        if n_free < self.m:
            indptr, indices, data = extract_free_part(indptr, indices, data, place, n_free)
            self.system = LinearSystem((indptr, indices), USE_WIDE_LANES)
            d = d[place >= 0]
        return self.system.factor(data, d, shift, PIVOT_TOLERANCE, deadline=self.deadline)

    def solve(self, rhs: FloatArray) -> FloatArray:
        return self.system.solve(rhs)


def make_pattern_symmetric(matrix: sp.csr_array) -> sp.csr_array:
    """Return the matrix with sorted rows and a symmetric pattern: entries of 0 are added if necessary."""
    if has_symmetric_pattern(*get_sorted_csr_arrays(matrix)[:2]):
        return matrix
    a = sp.coo_array(matrix)
    positions = (np.concatenate([a.row, a.col]), np.concatenate([a.col, a.row]))
    return sp.csr_array((np.concatenate([a.data, np.zeros(a.nnz)]), positions), shape=a.shape)


def get_sorted_csr_arrays(matrix: Any) -> tuple[Any, Any, Any]:
    """Return (ptr, index, value) of the sorted rows in the types of the kernels."""
    matrix.sort_indices()
    value = np.ascontiguousarray(matrix.data if matrix.nnz else np.zeros(1), np.float64)
    index = np.ascontiguousarray(matrix.indices if matrix.nnz else np.zeros(1), np.int32)
    return np.ascontiguousarray(matrix.indptr, np.int32), index, value


def _scale_to_unit_diagonal(problem: Problem) -> tuple[FloatArray, sp.csr_array]:
    """Return D^-1/2 (m,) and D^-1/2 A D^-1/2."""
    scale = 1.0 / np.sqrt(problem.csr_data.d)
    return scale, sp.csr_array(sp.diags_array(scale) @ problem.csr @ sp.diags_array(scale))


def _factor_with_superlu(a: sp.csc_array) -> tuple[Any, FloatArray]:
    """Return LU with pivoting and the magnitudes of its pivots; (None, [0]) if the matrix is exactly singular."""
    try:
        lu = factor_sparse_lu(a)
        return lu, np.abs(lu.U.diagonal())
    except RuntimeError:
        return None, np.zeros(1)


class LUFactor:
    """LU factor of D^-1/2 A_FF D^-1/2 for an asymmetric A; LAPACK and SuperLU read no clock."""

    deadline = NEVER

    def __init__(self, problem: Problem) -> None:
        m = problem.m
        self.scale, scaled = _scale_to_unit_diagonal(problem)
        self.sparse = problem.csr.nnz < MIN_DENSE_FRACTION * m * m or m > MAX_DENSE_ROWS
        self.a: Any = scaled if self.sparse else scaled.toarray()
        if self.sparse:
            import_numerical_modules("scipy.sparse.linalg")

    def factor(self, place: IntArray, n_free: int, shift: float) -> int:
        if self.deadline.has_passed():
            return -1
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
        return int(np.count_nonzero(~(np.abs(np.diagonal(lu)) > PIVOT_TOLERANCE)))

    def _factor_sparse(self, shift: float) -> int:
        a = sp.csc_array(self.a[self.free][:, self.free])
        if shift > 0.0:
            a = sp.csc_array(a + shift * sp.eye_array(len(self.free)))
        self.lu, pivot = _factor_with_superlu(a)
        return (
            len(self.free) if self.lu is None else int(np.count_nonzero(~(pivot > PIVOT_TOLERANCE)))
        )

    def solve(self, rhs: FloatArray) -> FloatArray:
        scale = self.scale[self.free]
        y = scale * rhs
        y = self.lu.solve(y) if self.sparse else lapack.dgetrs(*self.lu, y)[0]
        return scale * y


class PanelsLU:
    """Supernodal LU factor of D^-1/2 A D^-1/2. Refinement corrects errors that pivoting across panels would avoid.

    Attributes
    ----------
    usable : bool
        Whether all pivots are above rounding errors.
    """

    def __init__(self, problem: Problem) -> None:
        indptr, indices, data = problem._compressed
        self.system = LinearSystem((indptr, indices), USE_WIDE_LANES)
        self.rank = problem.m
        self.usable = self.system.factor(data, problem.csr_data.d, 0.0, PIVOT_TOLERANCE, True) == 0

    @staticmethod
    def accepts(problem: Problem) -> bool:
        """Return whether A is sparse with a symmetric pattern."""
        indptr, indices, _ = problem._compressed
        return len(indices) <= MAX_PANELS_FRACTION * problem.m**2 and has_symmetric_pattern(
            indptr, indices
        )

    def solve(self, rhs: FloatArray) -> FloatArray:
        return self.system.solve(rhs)


class RankRevealingFactor:
    """LU factor of D^-1/2 A D^-1/2, or its singular value decomposition if the matrix is singular.

    Attributes
    ----------
    rank : int
        m if A is regular, else the rank; -1 if A is singular and too large for a singular value decomposition.
    """

    def __init__(self, problem: Problem) -> None:
        self.rank = m = problem.m
        self.scale, scaled = _scale_to_unit_diagonal(problem)
        self.lu: Any = None
        self.dense: FloatArray | None = None
        if problem.csr.nnz >= MIN_DENSE_FRACTION * m * m or m <= MAX_COMPILED_FACTOR_ROWS:
            self._factor_dense(scaled.toarray())
        else:
            self._factor_sparse(sp.csc_array(scaled))

    def _factor_dense(self, a: FloatArray) -> None:
        lu, pivot, info = lapack.dgetrf(a)
        norm = np.abs(a).sum(axis=0).max(initial=0.0)
        rcond = lapack.dgecon(lu, norm)[0] if info == 0 and len(a) else float(len(a) == 0)
        if rcond <= PIVOT_TOLERANCE * max(1, len(a)) / 10.0:
            self._decompose_singular_matrix(a)
        else:
            self.lu = (lu, pivot)

    def _factor_sparse(self, a: sp.csc_array) -> None:
        self.lu, pivot = _factor_with_superlu(a)
        if pivot.min(initial=np.inf) > PIVOT_TOLERANCE * max(1.0, pivot.max(initial=0.0)):
            return
        self.lu = None
        if a.shape[0] <= MAX_DENSE_RANK_ROWS:
            self._decompose_singular_matrix(a.toarray())
        else:
            self.rank = -1

    def _decompose_singular_matrix(self, a: FloatArray) -> None:
        """Compute the singular value decomposition of a singular A, for its rank and least-squares solutions."""
        self.dense = a
        u, s, vt = np.linalg.svd(a)
        self.rank = (
            int(np.count_nonzero(s > len(a) * PIVOT_TOLERANCE / 10.0 * s[0]))
            if len(s) and s[0] > 0.0
            else 0
        )
        self.svd = (u[:, : self.rank], s[: self.rank], vt[: self.rank])
        self.null = u[:, self.rank :]

    def compute_left_null_part(self, rhs: FloatArray) -> FloatArray:
        """Return the part y of D^-1 rhs with A^T y = 0, from the left singular vectors; 0 if they are not known."""
        if self.dense is None:
            return np.zeros_like(rhs)
        return self.scale * (self.null @ (self.null.T @ (self.scale * rhs)))

    @property
    def usable(self) -> bool:
        """Whether a factor exists."""
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
