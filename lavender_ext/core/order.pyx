"""Orders, levels and colours of blocks: the functions of core/order.pxd, colours from the pattern of A, and Python functions."""
from libc.stdint cimport int32_t, uint64_t

import numpy as np

from lavender_ext.core.order cimport RANDOM, SYMMETRIC, next_random


cdef void reverse_blocks(int32_t* order, int32_t first, int32_t end) noexcept nogil:
    """Reverse order[first:end]."""
    cdef int32_t i = first, j = end - 1, t
    while i < j:
        t = order[i]
        order[i] = order[j]
        order[j] = t
        i += 1
        j -= 1


cdef void update_sweep_order(int32_t mode, int32_t first_sweep, int32_t* order, int32_t first, int32_t end,
                             uint64_t* rng) noexcept nogil:
    """Update order[first:end] in place for the next sweep, as `mode` requires; first_sweep is 1 before the first sweep."""
    cdef int32_t i, j, t
    if mode == RANDOM:
        # Fisher-Yates. A random index below n is r n / 2^32, rounded down, with 32 random bits r.
        for i in range(end - 1, first, -1):
            j = first + <int32_t>(((next_random(rng) >> 32) * <uint64_t>(i - first + 1)) >> 32)
            t = order[i]
            order[i] = order[j]
            order[j] = t
    elif mode == SYMMETRIC and not first_sweep:
        reverse_blocks(order, first, end)


cdef int32_t find_block_levels(int32_t n_blocks, const int32_t* body, int32_t n_bodies, int32_t* level,
                               int32_t* out) noexcept nogil:
    """Compute the level of each block in out (n_blocks), 0 on the ground; return an upper bound of the number of levels.

    A block is one level above the lower of its two bodies. The levels of bodies, in level (n_bodies), are breadth-first from the
    static ones (body -1); bodies without a path to a static body get the last level + 1. `body` is (n_blocks, 2). Edges are
    relaxed forwards and backwards until no level changes, which is linear for scenes whose bodies are numbered from the ground up.
    """
    cdef int32_t i, a, b, la, lb, changed, top = 0, far = 2147483647, _pass
    for i in range(n_bodies):
        level[i] = far
    for _pass in range(n_bodies + 1):                   # The last pass changes nothing.
        changed = 0
        for i in range(2 * n_blocks):
            a = body[2 * i] if i < n_blocks else body[2 * (2 * n_blocks - 1 - i)]
            b = body[2 * i + 1] if i < n_blocks else body[2 * (2 * n_blocks - 1 - i) + 1]
            la = -1 if a < 0 else level[a]
            lb = -1 if b < 0 else level[b]
            if a >= 0 and lb != far and lb + 1 < la:
                level[a] = lb + 1
                changed = 1
            if b >= 0 and la != far and la + 1 < lb:
                level[b] = la + 1
                changed = 1
        if not changed:
            break
    for i in range(n_bodies):
        if level[i] != far and level[i] > top:
            top = level[i]
    for i in range(n_bodies):
        if level[i] == far:
            level[i] = top + 1
    for i in range(n_blocks):
        la = 0 if body[2 * i] < 0 else level[body[2 * i]] + 1
        lb = 0 if body[2 * i + 1] < 0 else level[body[2 * i + 1]] + 1
        out[i] = la if la < lb else lb
    return top + 3


cdef void sort_blocks_by_level(int32_t n_blocks, const int32_t* level, int32_t n_levels, int32_t* start,
                               int32_t* order) noexcept nogil:
    """Sort blocks by level (stable counting sort); blocks of level -1 are omitted.

    start (n_levels + 1) receives the first index of each level in `order`.
    """
    cdef int32_t i
    for i in range(n_levels + 1):
        start[i] = 0
    for i in range(n_blocks):
        if level[i] >= 0:
            start[level[i]] += 1
    for i in range(n_levels):                           # the end of each level, from which it is filled backwards
        start[i + 1] += start[i]
    for i in range(n_blocks - 1, -1, -1):
        if level[i] >= 0:
            start[level[i]] -= 1
            order[start[level[i]]] = i


cdef int32_t color_blocks_by_bodies(int32_t n_blocks, const int32_t* body, int32_t n_bodies, bint by_pair, uint64_t* used,
                                    int32_t* color) noexcept nogil:
    """Colour blocks greedily so that no two blocks of one colour share a moving body; return the number of colours.

    With `by_pair`, successive blocks of the same two bodies have one colour, and only these share a body.
    `used` (n_bodies) holds one bit per colour of the current group of 63 colours. Blocks without a free bit are coloured in
    the next group.
    """
    cdef int32_t i, a, b, c, base = 0, uncoloured = n_blocks, top = 0
    cdef uint64_t occupied
    for i in range(n_blocks):
        color[i] = -1
    while uncoloured > 0:
        for i in range(n_bodies):
            used[i] = 0
        for i in range(n_blocks):
            if color[i] >= 0:
                continue
            a = body[2 * i]
            b = body[2 * i + 1]
            if by_pair and i > 0 and color[i - 1] >= 0 and a == body[2 * i - 2] and b == body[2 * i - 1]:
                color[i] = color[i - 1]
                uncoloured -= 1
                continue
            occupied = 0
            if a >= 0:
                occupied |= used[a]
            if b >= 0:
                occupied |= used[b]
            c = 0
            while c < 63 and (occupied >> c) & 1:
                c += 1
            if c == 63:
                continue
            if a >= 0:
                used[a] |= (<uint64_t>1) << c
            if b >= 0:
                used[b] |= (<uint64_t>1) << c
            color[i] = base + c
            if base + c + 1 > top:
                top = base + c + 1
            uncoloured -= 1
        base += 63
    return top


cdef public int32_t lav_color_blocks_by_matrix(int32_t n_blocks, const int32_t* block_ptr, const int32_t* block_of,
                                               const int32_t* indptr, const int32_t* indices, int32_t* mark,
                                               int32_t* color) noexcept nogil:
    """Colour blocks greedily so that no two blocks of one colour are coupled in A; return the number of colours.

    The pattern of A must be symmetric. mark (n_blocks + 1) is scratch.
    """
    cdef int32_t i, j, q, c, top = 0
    for i in range(n_blocks):
        color[i] = mark[i] = -1
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


def compute_block_levels(const int32_t[:, ::1] body, int n_bodies):
    """Return the level (k,) of each block, counted from the static bodies; `body` is (k, 2)."""
    cdef int32_t k = <int32_t>body.shape[0]
    cdef int32_t[::1] level = np.empty(n_bodies + 1, np.int32), out = np.empty(k + 1, np.int32)
    if k:
        find_block_levels(k, &body[0, 0], n_bodies, &level[0], &out[0])
    return np.asarray(out)[:k]


def compute_body_colors(const int32_t[:, ::1] body, int n_bodies):
    """Return the colour (k,) of each block; no two blocks of one colour share a moving body."""
    cdef int32_t k = <int32_t>body.shape[0]
    cdef uint64_t[::1] used = np.zeros(n_bodies + 1, np.uint64)
    cdef int32_t[::1] color = np.empty(k + 1, np.int32)
    if k:
        color_blocks_by_bodies(k, &body[0, 0], n_bodies, False, &used[0], &color[0])
    return np.asarray(color)[:k]


def compute_matrix_colors(const int32_t[::1] block_ptr, const int32_t[::1] block_of, const int32_t[::1] indptr,
                          const int32_t[::1] indices):
    """Return the colour (k,) of each block; no two blocks of one colour are coupled in the symmetric pattern."""
    cdef int32_t k = <int32_t>block_ptr.shape[0] - 1
    cdef int32_t[::1] mark = np.empty(k + 1, np.int32), color = np.empty(k + 1, np.int32)
    if k and indices.shape[0]:
        lav_color_blocks_by_matrix(k, &block_ptr[0], &block_of[0], &indptr[0], &indices[0], &mark[0], &color[0])
    elif k:
        color[:] = 0
    return np.asarray(color)[:k]
