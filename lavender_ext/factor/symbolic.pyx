"""Elimination trees and patterns of block factors, and the pattern of a chain of bodies in its own order."""
from libc.stdint cimport int32_t, int64_t

import numpy as np

from lavender_ext.factor.symbolic cimport block_pattern, block_tree, postorder_of


cdef public void lav_block_tree(int32_t n, const int32_t* nptr, const int32_t* nind, int32_t* parent,
                                int32_t* mark, int32_t* row_count, int32_t* column_count) noexcept nogil:
    """Elimination tree of the lower pattern, and how many blocks each row and column of L holds."""
    block_tree(n, nptr, nind, parent, mark, row_count, column_count)


cdef public void lav_block_pattern(int32_t n, const int32_t* nptr, const int32_t* nind, const int32_t* parent,
                                   int32_t* mark, const int32_t* lptr, const int32_t* rptr, int32_t* next,
                                   int32_t* lind, int32_t* rind) noexcept nogil:
    """Rows of every column of L, and columns of every row, both ascending."""
    block_pattern(n, nptr, nind, parent, mark, lptr, rptr, next, lind, rind)


def factor_pattern(const int32_t[::1] nptr, const int32_t[::1] nind):
    """(lptr, lind, rptr, rind) of the factor of a lower block pattern; nptr (n + 1), diagonal last in each row."""
    cdef int32_t n = <int32_t>nptr.shape[0] - 1
    cdef int32_t[::1] parent = np.empty(n + 1, np.int32), mark = np.empty(n + 1, np.int32)
    cdef int32_t[::1] row_count = np.empty(n + 1, np.int32), column_count = np.empty(n + 1, np.int32)
    lptr_array, rptr_array = np.empty(n + 1, np.int32), np.empty(n + 1, np.int32)
    cdef int32_t[::1] lptr = lptr_array, rptr = rptr_array
    cdef int64_t total = 0
    cdef int32_t i
    lav_block_tree(n, &nptr[0], &nind[0], &parent[0], &mark[0], &row_count[0], &column_count[0])
    for i in range(n):
        total += column_count[i]
    if total >= 2**31:
        raise OverflowError("the factor has 2^31 blocks or more")
    lptr[0] = rptr[0] = 0
    for i in range(n):
        lptr[i + 1] = lptr[i] + column_count[i]
        rptr[i + 1] = rptr[i] + row_count[i]
    lind_array, rind_array = np.empty(lptr[n] + 1, np.int32), np.empty(lptr[n] + 1, np.int32)
    cdef int32_t[::1] lind = lind_array, rind = rind_array
    lav_block_pattern(n, &nptr[0], &nind[0], &parent[0], &mark[0], &lptr[0], &rptr[0], &row_count[0], &lind[0], &rind[0])
    return lptr_array, lind_array, rptr_array, rind_array


def chain_pattern(const int32_t[:, ::1] body, int n):
    """As `graph.body_pattern`, bodies in their own order, where each meets its neighbours alone; or None."""
    cdef int32_t k = <int32_t>body.shape[0], i, a, b
    for i in range(k):
        a = body[i, 0]
        b = body[i, 1]
        if a >= 0 and b >= 0 and (a - b > 1 or b - a > 1):
            return None
    nptr_array, nind_array = np.empty(n + 1, np.int32), np.empty(2 * n + 1, np.int32)
    node_array, slot_array, turned_array = np.empty((k, 2), np.int32), np.zeros((k, 3), np.int32), np.empty(k, np.int32)
    cdef int32_t[::1] meets = np.zeros(n + 1, np.int32), nptr = nptr_array, nind = nind_array, turned = turned_array
    cdef int32_t[:, ::1] node = node_array, slot = slot_array
    for i in range(k):
        a = body[i, 0]
        b = body[i, 1]
        turned[i] = a < b
        node[i, 0] = b if a < b else a
        node[i, 1] = a if a < b else b
        if node[i, 1] >= 0:
            meets[node[i, 0]] = 1
    nptr[0] = 0
    for i in range(n):
        nptr[i + 1] = nptr[i] + 1 + meets[i]
        if meets[i]:
            nind[nptr[i]] = i - 1
        nind[nptr[i + 1] - 1] = i
    for i in range(k):
        a = node[i, 0]
        b = node[i, 1]
        if a >= 0:
            slot[i, 0] = nptr[a + 1] - 1
        if b >= 0:
            slot[i, 1] = nptr[b + 1] - 1
            slot[i, 2] = nptr[a]
    return nptr_array, nind_array[:nptr_array[n]].copy(), node_array, slot_array, turned_array


cdef public void lav_postorder(int32_t n, const int32_t* parent, int32_t* child, int32_t* sibling, int32_t* stack,
                               int32_t* rank) noexcept nogil:
    """rank (n): place of each column after its children and beside them; roots, and siblings, in their order."""
    postorder_of(n, parent, child, sibling, stack, rank)


def postorder(const int32_t[::1] nptr, const int32_t[::1] nind):
    """(n,) places that keep the fill and put columns of one pattern beside each other."""
    cdef int32_t n = <int32_t>nptr.shape[0] - 1
    cdef int32_t[::1] parent = np.empty(n + 1, np.int32), a = np.empty(n + 1, np.int32), b = np.empty(n + 1, np.int32)
    cdef int32_t[::1] c = np.empty(n + 1, np.int32)
    out = np.empty(n, np.int32)
    cdef int32_t[::1] rank = out
    if n:
        lav_block_tree(n, &nptr[0], &nind[0], &parent[0], &a[0], &b[0], &c[0])
        lav_postorder(n, &parent[0], &a[0], &b[0], &c[0], &rank[0])
    return out


cdef public int32_t lav_supernodes(int32_t n, const int32_t* lptr, const int32_t* lind, int32_t few, double share,
                                   int32_t* first, int32_t* zeros) noexcept nogil:
    """Panels of neighbouring block columns, each the parent of the one before: their number, `first` of each.

    A column joins the panel before it where its pattern is that panel's, or where the zeros that are then held as numbers
    are at most `share` of the panel (panels up to `few` columns: four times as many). zeros (n) is scratch.
    """
    cdef int32_t j, k = 0, width, below
    cdef double held, all_
    if n == 0:
        return 0
    first[0] = 0
    zeros[0] = 0
    for j in range(1, n):
        below = lptr[j + 1] - lptr[j]
        if lptr[j] > lptr[j - 1] and lind[lptr[j - 1]] == j:
            width = j - first[k]
            # Every column before gets the rows of j; it has those of its own below j already.
            held = zeros[k] + <double>width * (below + 1 - (lptr[j] - lptr[j - 1]))
            all_ = 0.5 * (width + 1.0) * (width + 2.0) + (width + 1.0) * below
            if held <= (4.0 * share if width < few else share) * all_:
                zeros[k] = <int32_t>held
                continue
        k += 1
        first[k] = j
        zeros[k] = 0
    first[k + 1] = n
    return k + 1


def supernodes(const int32_t[::1] nptr, const int32_t[::1] nind, const int32_t[::1] lptr, const int32_t[::1] lind, int s,
               int few, double share):
    """(first, of, rptr, rows, height, at, spot, temp) of `supernodes_t`; temp: room for one product at most."""
    cdef int32_t n = <int32_t>nptr.shape[0] - 1, k, i, j, q, c, width, rows, most = 0, run
    first_array = np.empty(n + 1, np.int32)
    cdef int32_t[::1] first = first_array, zeros = np.empty(n + 1, np.int32)
    k = lav_supernodes(n, &lptr[0], &lind[0], few, share, &first[0], &zeros[0])
    of_array, rptr_array = np.empty(n + 1, np.int32), np.zeros(k + 1, np.int32)
    height_array, at_array = np.zeros(k + 1, np.int32), np.zeros(k + 1, np.int64)
    cdef int32_t[::1] of = of_array, rptr = rptr_array, height = height_array, rows_
    cdef int64_t[::1] at = at_array, spot
    for i in range(k):
        c = first[i + 1] - 1                            # its last column has the rows below
        rptr[i + 1] = rptr[i] + lptr[c + 1] - lptr[c]
        width = s * (first[i + 1] - first[i])
        height[i] = width + s * (rptr[i + 1] - rptr[i])
        at[i + 1] = at[i] + <int64_t>width * height[i]
        for j in range(first[i], first[i + 1]):
            of[j] = i
    rows_array, spot_array = np.empty(rptr[k] + 1, np.int32), np.empty(nind.shape[0] + 1, np.int64)
    rows_ = rows_array
    spot = spot_array
    for i in range(k):
        c = first[i + 1] - 1
        for q in range(lptr[c + 1] - lptr[c]):
            rows_[rptr[i] + q] = lind[lptr[c] + q]
        run = 0                                         # rows in one later panel: what it takes at a time
        for q in range(rptr[i], rptr[i + 1]):
            run = run + 1 if q > rptr[i] and of[rows_[q]] == of[rows_[q - 1]] else 1
            width = s * s * run * (rptr[i + 1] - q + run - 1)
            if width > most:
                most = width
        if s * (rptr[i + 1] - rptr[i]) > most:
            most = s * (rptr[i + 1] - rptr[i])
    for j in range(n):
        for q in range(nptr[j], nptr[j + 1]):
            c = nind[q]
            i = of[c]
            if j < first[i + 1]:
                rows = s * (j - first[i])
            else:
                width = rptr[i]
                while rows_[width] != j:
                    width += 1
                rows = s * (first[i + 1] - first[i] + width - rptr[i])
            spot[q] = at[i] + rows + <int64_t>s * (c - first[i]) * height[i]
    return first_array[: k + 1].copy(), of_array, rptr_array, rows_array, height_array, at_array, spot_array, most
