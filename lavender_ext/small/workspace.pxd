"""Workspace that grows, for one small problem after the other: fresh pages for each cost more than what is done in them."""
from libc.stdint cimport int32_t, int64_t
from libc.stdlib cimport free, malloc

from lavender_ext.core.method cimport workspace_t


cdef inline bint has_workspace_size(workspace_t* r, int64_t n_index, int64_t n_real) noexcept nogil:
    """Is there workspace for so many, made where there was none? What grows is empty."""
    if n_index > r.n_index:
        free(r.index)
        r.index = <int32_t*>malloc(2 * n_index * sizeof(int32_t))
        r.n_index = 2 * n_index if r.index != NULL else 0
    if n_real > r.n_real:
        free(r.real)
        r.real = <double*>malloc(2 * n_real * sizeof(double))
        r.n_real = 2 * n_real if r.real != NULL else 0
    return n_index <= r.n_index and n_real <= r.n_real


cdef inline void leave(workspace_t* r) noexcept nogil:
    free(r.index)
    free(r.real)
