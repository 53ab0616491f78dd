"""Union-find with path halving: the root of the component of an element."""
from libc.stdint cimport int32_t


cdef inline int32_t find_root(int32_t* parent, int32_t i) noexcept nogil:
    """Return the root of i, and halve the path from i to it."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i
