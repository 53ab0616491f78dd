"""SuperLU by one door, which keeps out what has no LU whatever its entries are.

A square matrix some of whose rows have entries in too few columns between them is singular for any values. SuperLU
reads and writes outside its arrays on some of these before it can say so (SciPy 1.17), which may end the interpreter.
"""

from __future__ import annotations

from typing import Any

from lavender._later import sparse as sp

__all__ = ["sparse_lu"]


def sparse_lu(matrix: Any, **options: Any) -> Any:
    """SuperLU's factor of a square sparse matrix (n, n), n > 0; RuntimeError where it is singular."""
    from scipy.sparse.linalg import splu  # 0.1 s to import, needed only here

    a = sp.csc_array(matrix)
    # A diagonal without a gap is one entry for every row and column.
    if not a.diagonal().all() and sp.csgraph.structural_rank(sp.csr_array(a)) < a.shape[0]:
        raise RuntimeError("the matrix is singular whatever its entries are")
    return splu(a, **options)
