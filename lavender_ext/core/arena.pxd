"""One layout of the arrays of a method, which counts its workspace without memory and binds the arrays with memory.

    arena_t counted = make_arena(NULL, NULL)        the function that takes the arrays only counts them
    bind(..., &counted)                             counted.n_real doubles and counted.n_index int32 are needed
    arena_t memory = make_arena(real, index)        the caller has allocated both
    bind(..., &memory)                              every array is bound

A layout must not read or write the arrays that it takes unless `has_memory` of its arena holds.
"""
from libc.stdint cimport int32_t, int64_t


cdef struct arena_t:
    double* real                # NULL: only count
    int32_t* index
    int64_t n_real              # doubles taken so far
    int64_t n_index             # int32 taken so far


cdef inline arena_t make_arena(double* real, int32_t* index) noexcept nogil:
    """Return an arena over two buffers, or over none (NULL) to count."""
    return arena_t(real, index, 0, 0)


cdef inline bint has_memory(const arena_t* a) noexcept nogil:
    """Return whether the arena has memory."""
    return a.real != NULL


cdef inline double* take_doubles(arena_t* a, int64_t count) noexcept nogil:
    """Return the next `count` doubles; NULL without memory."""
    a.n_real += count
    return a.real + (a.n_real - count) if a.real != NULL else NULL


cdef inline int32_t* take_integers(arena_t* a, int64_t count) noexcept nogil:
    """Return the next `count` int32; NULL without memory."""
    a.n_index += count
    return a.index + (a.n_index - count) if a.index != NULL else NULL
