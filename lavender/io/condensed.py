"""A = J M^-1 J^T of a file whose M is no mass matrix: sizes are bounded before anything is made."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import sparse_lu
from lavender.io.stored import Budget

CHUNK = 2**23  # numbers of M^-1 J^T, or of A, held dense at a time: 64 MiB
ENTRY = 16  # bytes of an entry of a sparse matrix: number and index


def condensed(
    mass: sp.csr_array, jt: sp.csr_array, f: FloatArray, budget: Budget
) -> tuple[sp.csr_array, FloatArray]:
    """A (m, m) and J M^-1 f (m,) of M (n, n), J^T (n, m) and f (n,); raises InputError where they take too much."""
    label = sp.csgraph.connected_components(mass, directed=False)[1]
    budget.spend(ENTRY * max_entries(label, jt), "A = H^T M^-1 H")
    solve = _factor(mass, label, budget)
    m = jt.shape[1]
    step = max(1, CHUNK // max(1, *jt.shape))
    columns = sp.csc_array(jt)
    j = sp.csr_array(jt.T)
    parts = [sp.csr_array(j @ solve(columns[:, k : min(k + step, m)].toarray())) for k in range(0, m, step)]
    a = sp.csr_array(sp.hstack(parts)) if parts else sp.csr_array((0, 0))
    gap = mass - mass.T
    if gap.nnz == 0 or not np.any(gap.data):
        a = sp.csr_array(0.5 * (a + a.T))  # what the order of additions left, where M is symmetric
    return a, j @ solve(f)


def max_entries(label: np.ndarray, jt: sp.csr_array) -> int:
    """At most so many entries has J M^-1 J^T; `label` (n,) says which parts of M hang together.

    A row of J that touches a part meets there every row that touches it: a part with r rows makes at most r^2.
    """
    m = jt.shape[1]
    part = np.repeat(label.astype(np.int64), np.diff(jt.indptr))
    touched = np.unique(part * m + jt.indices) // m if len(part) else part
    rows = np.bincount(touched, minlength=1).astype(float)
    return int(min(rows @ rows, float(m) ** 2))


def _factor(matrix: sp.csr_array, label: np.ndarray, budget: Budget) -> Callable[[np.ndarray], np.ndarray]:
    """x = M^-1 y by LU factors whose size is bounded beforehand.

    A part of n unknowns has at most n^2 entries in its factors. Where that is too much, the order is one of small
    bandwidth: with l below and u above the diagonal, L and U with row exchanges stay within n (2 l + u + 1).
    """
    n = matrix.shape[0]
    size = np.bincount(label).astype(float)
    dense = ENTRY * int(size @ size)
    try:
        if dense <= budget.left:
            return sparse_lu(matrix).solve
        order = sp.csgraph.reverse_cuthill_mckee(sp.csr_array(matrix), symmetric_mode=False)
        permuted = sp.coo_array(matrix[order][:, order])
        off = permuted.row.astype(np.int64) - permuted.col
        width = 2 * int(off.max(initial=0)) - int(off.min(initial=0)) + 1
        budget.spend(ENTRY * n * min(width, n), "the factors of M")
        factor = sparse_lu(permuted, permc_spec="NATURAL")
    except RuntimeError as error:
        raise InputError(f"M cannot be factorised ({error}); an invertible M is needed") from None
    back = np.argsort(order)
    return lambda y: factor.solve(y[order])[back]
