"""An order of elimination in which a sparse symmetric matrix is a narrow band (Cuthill, McKee 1969, reversed).

From the row of fewest entries on, breadth first: each row is followed by those of its neighbours that were not reached
before, fewest entries first, the smaller row before the larger; then once more from the far end. Of each component the
narrower of the two; backwards, which fills less.
"""
from libc.stdint cimport int32_t

import numpy as np

cdef enum:
    SHORT = 16                  # numbers up to which insertion beats a heap


cdef inline void sink(int32_t* x, int32_t i, int32_t n) noexcept nogil:
    cdef int32_t child, own = x[i]
    while 2 * i + 1 < n:
        child = 2 * i + 1
        if child + 1 < n and x[child + 1] > x[child]:
            child += 1
        if x[child] <= own:
            break
        x[i] = x[child]
        i = child
    x[i] = own


cdef inline void sort(int32_t* x, int32_t n) noexcept nogil:
    cdef int32_t i, j, own
    if n <= SHORT:
        for i in range(1, n):
            own = x[i]
            j = i
            while j > 0 and x[j - 1] > own:
                x[j] = x[j - 1]
                j -= 1
            x[j] = own
        return
    for i in range(n // 2 - 1, -1, -1):
        sink(x, i, n)
    for i in range(n - 1, 0, -1):
        own = x[0]
        x[0] = x[i]
        x[i] = own
        sink(x, 0, i)


cdef inline int32_t spread(const int32_t* indptr, const int32_t* indices, const int32_t* by_size, const int32_t* rank,
                           int32_t* reached, int32_t mark, int32_t seed, int32_t* order, int32_t* last) noexcept nogil:
    # Rows of the mark before that are reached from a row, in order; their number. last: where the farthest begin.
    cdef int32_t head = 0, count = 1, level, end = 1, q, i, j
    order[0] = seed
    reached[seed] = mark
    last[0] = 0
    while head < count:
        if head == end:
            last[0] = head
            end = count
        i = order[head]
        head += 1
        level = count
        for q in range(indptr[i], indptr[i + 1]):
            j = indices[q]
            if reached[j] == mark - 1:
                reached[j] = mark
                order[count] = rank[j]
                count += 1
        sort(order + level, count - level)
        for q in range(level, count):
            order[q] = by_size[order[q]]
    return count


cdef inline int32_t widest(const int32_t* indptr, const int32_t* indices, const int32_t* order, int32_t n,
                           int32_t* place) noexcept nogil:
    # half bandwidth of n rows in order
    cdef int32_t i, q, far, band = 0
    for i in range(n):
        place[order[i]] = i
    for i in range(n):
        for q in range(indptr[order[i]], indptr[order[i] + 1]):
            far = place[indices[q]] - i
            far = far if far > 0 else -far
            if far > band:
                band = far
    return band


cdef public int32_t lav_narrow_order(int32_t n, const int32_t* indptr, const int32_t* indices, int32_t* first,
                                     int32_t* by_size, int32_t* rank, int32_t* place, int32_t* other,
                                     int32_t* order) noexcept nogil:
    """The order (n) of a symmetric pattern in compressed rows, and its half bandwidth.

    first (n + 2), by_size, rank, place and other (n) are scratch.
    """
    cdef int32_t i, j, size, at, count = 0, own, again, last = 0, seed
    for i in range(n + 2):
        first[i] = 0
    for i in range(n):
        size = indptr[i + 1] - indptr[i]
        first[(size if size < n else n) + 1] += 1
    for i in range(n):
        first[i + 1] += first[i]
    for i in range(n):                                  # rows by their entries, the smaller first
        size = indptr[i + 1] - indptr[i]
        size = size if size < n else n
        by_size[first[size]] = i
        rank[i] = first[size]
        first[size] += 1
    for i in range(n):
        first[i] = 0                                    # from here on: in which pass a row was reached,
        place[i] = 0
    for at in range(n):
        if first[by_size[at]]:
            continue
        own = spread(indptr, indices, by_size, rank, first, 1, by_size[at], order + count, &last)
        # Again from the far end, where it may be narrower.
        seed = order[count + last]
        for i in range(count + last, count + own):
            if rank[order[i]] < rank[seed]:
                seed = order[i]
        again = spread(indptr, indices, by_size, rank, first, 2, seed, other, &last)
        for i in range(count, count + own):
            first[order[i]] = 2
        # (of a pattern that is not symmetric fewer)
        if again == own and widest(indptr, indices, other, own, place) < widest(indptr, indices, order + count, own, place):
            for i in range(own):
                order[count + i] = other[i]
        count += own
    for i in range(n // 2):
        j = order[i]
        order[i] = order[n - 1 - i]
        order[n - 1 - i] = j
    return widest(indptr, indices, order, n, place)


def narrow_order(const int32_t[::1] indptr, const int32_t[::1] indices):
    """(order (n,), half bandwidth in it) of a symmetric matrix in canonical compressed rows."""
    cdef int32_t n = <int32_t>indptr.shape[0] - 1, band = 0
    found = np.empty(n, np.int32)
    cdef int32_t[::1] order = found, room = np.empty(5 * n + 2, np.int32)
    if n and indices.shape[0]:
        with nogil:
            band = lav_narrow_order(n, &indptr[0], &indices[0], &room[0], &room[n + 2], &room[2 * n + 2],
                                    &room[3 * n + 2], &room[4 * n + 2], &order[0])
    elif n:
        found[:] = np.arange(n)
    return found, band
