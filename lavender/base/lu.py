"""The only call of SuperLU; it refuses structurally singular matrices.

A square matrix is structurally singular if some of its rows together have entries in too few columns; it is then
singular for any values. SuperLU (SciPy 1.17) reads and writes outside its arrays on some of these, which may crash the
interpreter.
"""

from __future__ import annotations

from typing import Any

from lavender.base.lazy_import import sparse as sp


def sparse_lu(matrix: Any, **options: Any) -> Any:
    """SuperLU's factor of a square sparse matrix (n, n), n > 0; RuntimeError if it is singular."""
    from scipy.sparse.linalg import splu  # 0.1 s to import, needed only here

    a = sp.csc_array(matrix)
    # A full diagonal gives every row and column an entry of its own.
    if not a.diagonal().all() and sp.csgraph.structural_rank(sp.csr_array(a)) < a.shape[0]:
        raise RuntimeError("the matrix is singular whatever its entries are")
    return splu(a, **options)
