"""What a problem's structure alone tells: components of its blocks, spread of its rows, an elimination order.

Two blocks are connected where they share a moving body, a tree of M, or where A has an entry between them. Union-find
with path halving; labels are numbered in the order of the first block of each component. The order of the bodies is in
graph.pxd.
"""
from libc.stdint cimport int32_t

import numpy as np

from lavender_ext.core.generalized cimport generalized_t
from lavender_ext.core.problem cimport Data
from lavender_ext.factor.graph cimport order_graph, order_room, root_of


cdef inline void join(int32_t* parent, int32_t i, int32_t j) noexcept nogil:
    # the smaller number stays the root, so that a root is the first block of its component
    i = root_of(parent, i)
    j = root_of(parent, j)
    if i < j:
        parent[j] = i
    else:
        parent[i] = j


cdef inline int32_t number(int32_t k, int32_t* parent, int32_t* label) noexcept nogil:
    cdef int32_t i, r, count = 0
    for i in range(k):
        r = root_of(parent, i)
        if r == i:
            label[i] = count
            count += 1
        else:
            label[i] = label[r]
    return count


cdef public int32_t lav_body_components(int32_t k, const int32_t* body, int32_t n_bodies, int32_t* parent,
                                        int32_t* first, int32_t* label) noexcept nogil:
    """Label of each of k blocks, body (k, 2) with -1 static; parent (k), first (n_bodies) are scratch."""
    cdef int32_t i, h, b
    for i in range(k):
        parent[i] = i
    for b in range(n_bodies):
        first[b] = -1
    for i in range(k):
        for h in range(2):
            b = body[2 * i + h]
            if b < 0:
                continue
            if first[b] < 0:
                first[b] = i
            else:
                join(parent, first[b], i)
    return number(k, parent, label)


cdef public int32_t lav_matrix_components(int32_t k, const int32_t* ptr, const int32_t* block, const int32_t* indptr,
                                          const int32_t* indices, int32_t* parent, int32_t* label) noexcept nogil:
    """The same by the entries of A in compressed rows; block (m) is the block of each row."""
    cdef int32_t i, j, q
    for i in range(k):
        parent[i] = i
    for i in range(k):
        for j in range(ptr[i], ptr[i + 1]):
            for q in range(indptr[j], indptr[j + 1]):
                if block[indices[q]] != i:
                    join(parent, i, block[indices[q]])
    return number(k, parent, label)


cdef public int32_t lav_tree_components(int32_t k, const int32_t* ptr, const generalized_t* g, int32_t* parent,
                                        int32_t* first, int32_t* label) noexcept nogil:
    """The same by the trees of M that J's rows touch; parent (k), first (2 n) are scratch."""
    cdef int32_t i, j, q, t
    cdef int32_t* tree = first + g.n
    for i in range(k):
        parent[i] = i
    for i in range(g.n):
        tree[i] = i if g.parent[i] < 0 else tree[g.parent[i]]
        first[i] = -1
    for i in range(k):
        for j in range(ptr[i], ptr[i + 1]):
            for q in range(g.jptr[j], g.jptr[j + 1]):
                t = tree[g.jidx[q]]
                if first[t] < 0:
                    first[t] = i
                else:
                    join(parent, first[t], i)
    return number(k, parent, label)


def least_degree(const int32_t[::1] ptr, const int32_t[::1] near):
    """(n,) vertices in their order of elimination; near[ptr[i]:ptr[i + 1]] are the neighbours of i, without i."""
    cdef int32_t n = <int32_t>ptr.shape[0] - 1, all_ = <int32_t>near.shape[0]
    cdef double[::1] scratch = np.empty(order_room(n, all_) // 2 + 1)
    order_array = np.empty(n, np.int32)
    cdef int32_t[::1] order = order_array, index = np.empty(4 * n + all_ // 2 + 4, np.int32)
    cdef const int32_t* entries = &near[0] if all_ else NULL
    if n:
        with nogil:
            order_graph(n, &ptr[0], entries, <int32_t*>&scratch[0], &order[0], &index[0], &index[n], &index[3 * n + 1],
                        &index[2 * n + 1])
    return order_array


def body_components(const int32_t[:, ::1] body, int n_bodies):
    """(number of components, label (k,)) of blocks between bodies (k, 2)."""
    cdef int32_t k = <int32_t>body.shape[0], count = 0
    label_array = np.zeros(k, np.int32)
    cdef int32_t[::1] label = label_array, parent = np.empty(k + 1, np.int32), first = np.empty(n_bodies + 1, np.int32)
    if k:
        with nogil:
            count = lav_body_components(k, &body[0, 0], n_bodies, &parent[0], &first[0], &label[0])
    return count, label_array


def matrix_components(const int32_t[::1] ptr, const int32_t[::1] block, const int32_t[::1] indptr,
                      const int32_t[::1] indices):
    """(number of components, label (k,)) of the blocks of a matrix in compressed rows."""
    cdef int32_t k = <int32_t>ptr.shape[0] - 1, count = 0
    label_array = np.zeros(k, np.int32)
    cdef int32_t[::1] label = label_array, parent = np.empty(k + 1, np.int32)
    cdef const int32_t* entries = &indices[0] if indices.shape[0] else NULL
    if k:
        with nogil:
            count = lav_matrix_components(k, &ptr[0], &block[0], &indptr[0], entries, &parent[0], &label[0])
    return count, label_array


def tree_components(Data p):
    """(number of components, label (k,)) of the blocks of a problem in generalised coordinates."""
    cdef int32_t k = p.blocks.n_blocks, count = 0
    label_array = np.zeros(k, np.int32)
    cdef int32_t[::1] label = label_array, parent = np.empty(k + 1, np.int32)
    cdef int32_t[::1] first = np.empty(2 * p.general.n + 1, np.int32)
    if k:
        with nogil:
            count = lav_tree_components(k, p.blocks.ptr, &p.general, &parent[0], &first[0], &label[0])
    return count, label_array


def tree_ends(Data p):
    """(k, 2) the first and the last tree that rows of each block touch, -1 without one, in generalised coordinates."""
    cdef const generalized_t* g = &p.general
    cdef int32_t i, j, q, t, k = p.blocks.n_blocks
    cdef int32_t[::1] tree = np.empty(g.n + 1, np.int32)
    ends = np.full((k, 2), -1, np.int32)
    cdef int32_t[:, ::1] body = ends
    with nogil:
        for i in range(g.n):
            tree[i] = i if g.parent[i] < 0 else tree[g.parent[i]]
        for i in range(k):
            for j in range(p.blocks.ptr[i], p.blocks.ptr[i + 1]):
                for q in range(g.jptr[j], g.jptr[j + 1]):
                    t = tree[g.jidx[q]]
                    if body[i, 0] < 0 or t < body[i, 0]:
                        body[i, 0] = t
                    if t > body[i, 1]:
                        body[i, 1] = t
    return ends


cdef enum:
    OF_BODY = 6                 # velocities at most


def bodies_in(Data p, order):
    """(body (k, 2), n, column (nv,)): velocities of J and M as those of n bodies, of which each block touches two; or None.

    A body is a run of at most six velocities, in the order given, of which neighbours stand mostly in the same panels of Y.
    column: 6 b + place of each velocity; body: -1 where a block touches fewer; `order` is that of `Generalized`.
    """
    p.prepare()
    cdef const generalized_t* g = &p.general
    cdef int32_t i, b, c, q, t, last = -1, size = 0, n = 0, k = p.blocks.n_blocks
    cdef int32_t[::1] given = np.arange(g.n, dtype=np.int32) if order is None else np.argsort(order).astype(np.int32)
    cdef int32_t[:, ::1] marks = np.full((4, g.n + 1), -1, np.int32)
    cdef int32_t* before = &marks[0, 0]                 # the velocity before each,
    cdef int32_t* on = &marks[1, 0]                     # panels that have it,
    cdef int32_t* both = &marks[2, 0]                   # and the one before too
    cdef int32_t* seen = &marks[3, 0]
    body_array, column_array = np.full((k, 2), -1, np.int32), np.empty(g.n, np.int32)
    cdef int32_t[:, ::1] body = body_array
    cdef int32_t[::1] column = column_array
    for i in range(g.n):
        c = given[i]
        before[c], last = last, c
        on[c] = both[c] = 0
    for b in range(g.n_panels):
        for q in range(g.pcol[b], g.pcol[b + 1]):
            seen[g.cols[q]] = b
        for q in range(g.pcol[b], g.pcol[b + 1]):
            c = g.cols[q]
            on[c] += 1
            both[c] += before[c] >= 0 and seen[before[c]] == b
    for i in range(g.n):
        c = given[i]
        if i > 0 and size < OF_BODY and 2 * both[c] >= max(on[c], on[before[c]]):
            size += 1
        else:
            n, size = n + 1, 1
        column[c] = OF_BODY * (n - 1) + size - 1
    for i in range(k):
        b = g.home[i]
        for q in range(g.pcol[b], g.pcol[b + 1]):
            t = column[g.cols[q]] // OF_BODY
            if body[i, 0] < 0:
                body[i, 0] = t
            elif t != body[i, 0] and t != body[i, 1]:
                if body[i, 1] >= 0:
                    return None
                body[i, 1] = t
    return (body_array, n, column_array) if n else None
