"""Union-find with path halving."""
from libc.stdint cimport int32_t


cdef inline int32_t find_root(int32_t* parent, int32_t i) noexcept nogil:
    """Return the root of i, and halve its path."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i
