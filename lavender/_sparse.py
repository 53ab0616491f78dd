"""SciPy's sparse arrays, loaded when the first one is needed: they and what they import are half of `import lavender`.

`from lavender import _sparse as sp` stands where one would write `import scipy.sparse as sp`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scipy.sparse import coo_array, csc_array, csc_matrix, csr_array, csr_matrix

__all__ = [
    "coo_array",
    "csc_array",
    "csc_matrix",
    "csr_array",
    "csr_matrix",
    "issparse",
]  # and all of SciPy's others


def issparse(value: object) -> bool:
    """Whether `value` is a sparse array or matrix of SciPy; what cannot be one loads nothing."""
    if not hasattr(value, "tocsr"):
        return False
    import scipy.sparse

    return bool(scipy.sparse.issparse(value))


def __getattr__(name: str) -> Any:
    import scipy.sparse

    value = globals()[name] = getattr(scipy.sparse, name)
    return value
