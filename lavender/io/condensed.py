"""Form A = J M^-1 J^T of a file in which M is not a mass matrix; memory is bounded before any allocation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import factor_sparse_lu
from lavender.io.stored import Budget

DENSE_CHUNK_NUMBERS = 2**23  # At most this many entries of M^-1 J^T or A are held densely at a time (64 MiB).
SPARSE_ENTRY_BYTES = 16  # Bytes of one entry of a sparse matrix: value and index.


def form_dense_a(
    mass: sp.csr_array, jt: sp.csr_array, f: FloatArray, budget: Budget
) -> tuple[sp.csr_array, FloatArray]:
    """Return A = J M^-1 J^T (m, m) and J M^-1 f (m,) for M (n, n), J^T (n, m) and f (n,).

    Raises
    ------
    InputError
        M is singular, or the matrices may need more memory than the budget allows.
    """
    label = sp.csgraph.connected_components(mass, directed=False)[1]
    budget.reserve_bytes(SPARSE_ENTRY_BYTES * bound_condensed_entries(label, jt), "A = H^T M^-1 H")
    solve = _make_mass_solver(mass, label, budget)
    m = jt.shape[1]
    step = max(1, DENSE_CHUNK_NUMBERS // max(1, *jt.shape))
    columns = sp.csc_array(jt)
    j = sp.csr_array(jt.T)
    parts = [sp.csr_array(j @ solve(columns[:, k : min(k + step, m)].toarray())) for k in range(0, m, step)]
    a = sp.csr_array(sp.hstack(parts)) if parts else sp.csr_array((0, 0))
    gap = mass - mass.T
    if gap.nnz == 0 or not np.any(gap.data):
        a = sp.csr_array(0.5 * (a + a.T))  # With a symmetric M, A is asymmetric only by rounding.
    return a, j @ solve(f)


def bound_condensed_entries(label: np.ndarray, jt: sp.csr_array) -> int:
    """Return an upper bound of the number of entries of J M^-1 J^T; `label` (n,) holds the connected component of M.

    Two rows of J are coupled only if they touch the same component: a component that r rows touch contributes at
    most r^2 entries.
    """
    m = jt.shape[1]
    part = np.repeat(label.astype(np.int64), np.diff(jt.indptr))
    touched = np.unique(part * m + jt.indices) // m if len(part) else part
    rows = np.bincount(touched, minlength=1).astype(float)
    return int(min(rows @ rows, float(m) ** 2))


def _make_mass_solver(
    matrix: sp.csr_array, label: np.ndarray, budget: Budget
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function y -> M^-1 y that uses LU factors of a size that is bounded in advance.

    The factors of a connected component of n unknowns have up to n^2 entries. If that exceeds the memory budget, the
    unknowns are ordered for a small bandwidth: with l diagonals below and u above the main diagonal, L and U with row
    exchanges have up to n (2 l + u + 1) entries.
    """
    n = matrix.shape[0]
    size = np.bincount(label).astype(float)
    dense = SPARSE_ENTRY_BYTES * int(size @ size)
    try:
        if dense <= budget.remaining:
            return factor_sparse_lu(matrix).solve
        order = sp.csgraph.reverse_cuthill_mckee(sp.csr_array(matrix), symmetric_mode=False)
        permuted = sp.coo_array(matrix[order][:, order])
        offset = permuted.row.astype(np.int64) - permuted.col
        width = 2 * int(offset.max(initial=0)) - int(offset.min(initial=0)) + 1
        budget.reserve_bytes(SPARSE_ENTRY_BYTES * n * min(width, n), "the factors of M")
        factor = factor_sparse_lu(permuted, permc_spec="NATURAL")
    except RuntimeError as error:
        raise InputError(f"M cannot be factorised ({error}); an invertible M is needed") from None
    inverse_order = np.argsort(order)
    return lambda y: factor.solve(y[order])[inverse_order]
