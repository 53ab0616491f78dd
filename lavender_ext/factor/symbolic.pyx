"""Elimination trees and patterns of block factors, and the pattern of a chain of bodies in its own order."""
from libc.stdint cimport int32_t, int64_t

import numpy as np


cdef public void lav_block_tree(int32_t n, const int32_t* nptr, const int32_t* nind, int32_t* parent,
                                int32_t* mark, int32_t* row_count, int32_t* column_count) noexcept nogil:
    """Elimination tree of the lower pattern, and how many blocks each row and column of L holds."""
    cdef int32_t k, q, j
    for k in range(n):
        parent[k] = -1
        mark[k] = k
        row_count[k] = 0
        column_count[k] = 0
        for q in range(nptr[k], nptr[k + 1]):
            j = nind[q]
            while j < k and mark[j] != k:
                if parent[j] < 0:
                    parent[j] = k
                mark[j] = k
                row_count[k] += 1
                column_count[j] += 1
                j = parent[j]


cdef public void lav_block_pattern(int32_t n, const int32_t* nptr, const int32_t* nind, const int32_t* parent,
                                   int32_t* mark, const int32_t* lptr, const int32_t* rptr, int32_t* next,
                                   int32_t* lind, int32_t* rind) noexcept nogil:
    """Rows of every column of L, and columns of every row, both ascending."""
    cdef int32_t k, q, j, p
    for k in range(n):
        mark[k] = k
        next[k] = lptr[k]
        for q in range(nptr[k], nptr[k + 1]):
            j = nind[q]
            while j < k and mark[j] != k:
                mark[j] = k
                lind[next[j]] = k
                next[j] += 1
                j = parent[j]
    for k in range(n):
        next[k] = rptr[k]
    for j in range(n):
        for p in range(lptr[j], lptr[j + 1]):
            k = lind[p]
            rind[next[k]] = j
            next[k] += 1


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
