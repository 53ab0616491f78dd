"""Factor sparse matrices by SuperLU, after rejecting structurally singular matrices. No other module calls SuperLU.

A square matrix is structurally singular if some set of k rows has entries in fewer than k columns; it is then singular
for any values. SuperLU (SciPy 1.17) reads and writes outside its arrays for some structurally singular matrices, which
may crash the interpreter.
"""

from __future__ import annotations

from typing import Any

from lavender.base.lazy_import import sparse as sp
from lavender_ext.factor.linear import LinearSystem


def factor_sparse_lu(matrix: Any, **options: Any) -> Any:
    """Factor a square sparse matrix (n, n), n > 0, by SuperLU; raise RuntimeError if it is singular.

    `options` are the options of `scipy.sparse.linalg.splu`.
    """
    from scipy.sparse.linalg import (
        splu,
    )  # Imported here: it takes 0.1 s, and only this function needs it.

    a = sp.csc_array(matrix)
    # A full diagonal implies full structural rank.
    if not a.diagonal().all() and sp.csgraph.structural_rank(sp.csr_array(a)) < a.shape[0]:
        raise RuntimeError(
            "the matrix is structurally singular: its nonzero pattern makes it singular for all values of the entries"
        )
    return splu(a, **options)


def splu(system: LinearSystem) -> Any:
    """Factor the matrix of a `LinearSystem` by SuperLU, as a fallback if the system's own factorisation fails."""
    matrix = sp.csr_array((system.data, system.indices, system.indptr), copy=True)
    matrix.eliminate_zeros()
    return factor_sparse_lu(matrix, permc_spec="COLAMD")
