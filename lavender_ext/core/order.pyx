"""Orders and colours of blocks for Python: wrappers of core/order.pxd, and colours of the blocks of a matrix."""
from libc.stdint cimport int32_t, uint64_t

import numpy as np

from lavender_ext.core.order cimport block_levels, body_levels, color_by_bodies


cdef public int32_t lav_graph_colors(int32_t n_blocks, const int32_t* block_ptr, const int32_t* block_of,
                                     const int32_t* indptr, const int32_t* indices, int32_t* mark,
                                     int32_t* color) noexcept nogil:
    """Colour blocks greedily so that no two blocks of one colour are coupled in A; return the number of colours.

    The pattern of A must be symmetric. mark (n_blocks + 1) is scratch.
    """
    cdef int32_t i, j, q, c, top = 0
    for i in range(n_blocks):
        color[i] = -1
        mark[i] = -1
    mark[n_blocks] = -1
    for i in range(n_blocks):
        for j in range(block_ptr[i], block_ptr[i + 1]):
            for q in range(indptr[j], indptr[j + 1]):
                c = color[block_of[indices[q]]]
                if c >= 0:
                    mark[c] = i
        c = 0
        while mark[c] == i:
            c += 1
        color[i] = c
        if c + 1 > top:
            top = c + 1
    return top


def body_order_levels(const int32_t[:, ::1] body, int n_bodies):
    """Return the level (k,) of each block, counted from the static bodies; `body` is (k, 2)."""
    cdef int32_t k = <int32_t>body.shape[0]
    cdef int32_t[::1] level = np.empty(n_bodies + 1, np.int32), out = np.empty(k + 1, np.int32)
    if k:
        body_levels(k, &body[0, 0], n_bodies, &level[0])
        block_levels(k, &body[0, 0], &level[0], &out[0])
    return np.asarray(out)[:k]


def body_colors(const int32_t[:, ::1] body, int n_bodies):
    """Return the colour (k,) of each block; no two blocks of one colour share a moving body."""
    cdef int32_t k = <int32_t>body.shape[0]
    cdef uint64_t[::1] used = np.zeros(n_bodies + 1, np.uint64)
    cdef int32_t[::1] color = np.empty(k + 1, np.int32)
    if k:
        color_by_bodies(k, &body[0, 0], n_bodies, &used[0], &color[0])
    return np.asarray(color)[:k]


def graph_colors(const int32_t[::1] block_ptr, const int32_t[::1] block_of, const int32_t[::1] indptr,
                 const int32_t[::1] indices):
    """Return the colour (k,) of each block; no two blocks of one colour are coupled in the symmetric pattern."""
    cdef int32_t k = <int32_t>block_ptr.shape[0] - 1
    cdef int32_t[::1] mark = np.empty(k + 1, np.int32), color = np.empty(k + 1, np.int32)
    if k and indices.shape[0]:
        lav_graph_colors(k, &block_ptr[0], &block_of[0], &indptr[0], &indices[0], &mark[0], &color[0])
    elif k:
        color[:] = 0
    return np.asarray(color)[:k]
