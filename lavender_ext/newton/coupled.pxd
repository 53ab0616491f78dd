"""H in compressed rows with the pattern of elements, and the matrices of Newton's method in the same pattern.

    M = L H R^T + o L + I         L, R have one small matrix for each element; R may be the identity              (1)

The rows of an element share their columns: those of all elements that H couples it to, in either direction.
`list_neighbours` and `merge_graphs` find the graph of the elements, `list_coupled_rows` its rows.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t

from lavender_ext.core.view cimport csr_t
from lavender_ext.newton.elements cimport elements_t


cdef struct coupled_t:
    int32_t* to                 # (elements + 1) graph of the elements
    int32_t* other
    int32_t* indptr             # (m + 1) rows of H and M
    int32_t* indices
    int32_t* diagonal           # (m) entry of the diagonal of each row
    double* h                   # entries of H


cdef inline int32_t list_neighbours(const elements_t* e, const csr_t* h, const int32_t* element, int32_t* mark, int32_t* to,
                                    int32_t* other) noexcept nogil:
    """List the elements whose columns an element's rows of H have, and itself; return their number.

    element (m) has the element of each row; mark (elements) is scratch; `other` NULL: only count.
    """
    cdef int32_t i, q, k, count = 0
    for i in range(e.n):
        mark[i] = -1
    for i in range(e.n):
        to[i] = count
        for q in range(h.indptr[e.ptr[i]] - 1, h.indptr[e.ptr[i + 1]]):
            k = i if q < h.indptr[e.ptr[i]] else element[h.indices[q]]
            if mark[k] != i:
                mark[k] = i
                if other != NULL:
                    other[count] = k
                count += 1
    to[e.n] = count
    return count


cdef inline void transpose_graph(int32_t n, const int32_t* ptr, const int32_t* near, int32_t* to, int32_t* other) noexcept nogil:
    """Transpose a graph of n vertices: pointers in `to` (n + 2), ascending neighbours."""
    cdef int32_t i, q
    for i in range(n + 2):
        to[i] = 0
    for q in range(ptr[n]):
        to[near[q] + 2] += 1
    for i in range(2, n + 2):
        to[i] += to[i - 1]
    for i in range(n):
        for q in range(ptr[i], ptr[i + 1]):
            other[to[near[q] + 1]] = i
            to[near[q] + 1] += 1


cdef inline int32_t merge_graphs(int32_t n, const int32_t* ptr, const int32_t* near, const int32_t* other_ptr,
                                 const int32_t* other_near, int32_t* to, int32_t* out) noexcept nogil:
    """Merge two graphs of n vertices with ascending neighbours; return the number of entries. `out` NULL: only count."""
    cdef int32_t i, p, q, k, count = 0
    for i in range(n):
        p, q = ptr[i], other_ptr[i]
        to[i] = count
        while p < ptr[i + 1] or q < other_ptr[i + 1]:
            k = near[p] if q == other_ptr[i + 1] or p < ptr[i + 1] and near[p] < other_near[q] else other_near[q]
            p += p < ptr[i + 1] and near[p] == k
            q += q < other_ptr[i + 1] and other_near[q] == k
            if out != NULL:
                out[count] = k
            count += 1
    to[n] = count
    return count


cdef inline int32_t list_coupled_rows(const coupled_t* c, const elements_t* e, int32_t* indices) noexcept nogil:
    """Write `indptr`, and unless `indices` is NULL the ascending columns and `diagonal`; return the number of entries."""
    cdef int32_t i, j, q, k, count = 0
    for i in range(e.n):
        for j in range(e.ptr[i], e.ptr[i + 1]):
            c.indptr[j] = count
            for q in range(c.to[i], c.to[i + 1]):
                for k in range(e.ptr[c.other[q]], e.ptr[c.other[q] + 1]):
                    if indices != NULL:
                        indices[count] = k
                        if k == j:
                            c.diagonal[j] = count
                    count += 1
    c.indptr[e.m] = count
    return count


cdef inline bint copy_coupled_entries(const coupled_t* c, int32_t m, const csr_t* h, int32_t* place) noexcept nogil:
    """Copy the entries of H, with 0 for missing ones; return whether H is symmetric. place (m) is scratch."""
    cdef int32_t i, j, p, q
    cdef bint same = True
    for i in range(m):
        place[i] = c.indptr[i]
        q = h.indptr[i]
        for p in range(c.indptr[i], c.indptr[i + 1]):
            c.h[p] = 0.0
            if q < h.indptr[i + 1] and h.indices[q] == c.indices[p]:
                c.h[p] = h.data[q]
                q += 1
    for i in range(m):
        for p in range(c.indptr[i], c.indptr[i + 1]):
            j = c.indices[p]                            # The entries of column j, in a symmetric pattern, follow row by row.
            same = same and fabs(c.h[p] - c.h[place[j]]) <= 1e-14
            place[j] += 1
    return same


cdef inline void form_coupled_block(const double* h, double* out, int32_t ld, const double* left, const double* right,
                               double own, bint diagonal, const int32_t ni, const int32_t nj) noexcept nogil:
    """Compute (1) for one pair of elements; the rows of h and out have stride ld."""
    cdef int32_t k, l, t
    cdef double x
    cdef double half[36]
    for k in range(ni):
        for l in range(nj):
            x = h[k * ld + l]
            if left != NULL:
                x = 0.0
                for t in range(ni):
                    x += left[k * ni + t] * h[t * ld + l]
            half[k * nj + l] = x
    for k in range(ni):
        for l in range(nj):
            x = half[k * nj + l]
            if right != NULL:
                x = 0.0
                for t in range(nj):
                    x += half[k * nj + t] * right[l * nj + t]
            if diagonal:
                x += own * left[k * ni + l]
                if k == l:
                    x += 1.0
            out[k * ld + l] = x


cdef inline void form_coupled_entries(const coupled_t* c, const elements_t* e, const double* left, const double* right, double own,
                                double* out) noexcept nogil:
    """Compute the entries of (1); right may be NULL (the identity)."""
    cdef int32_t i, j, q, ni, nj, at, ld
    cdef const double* r = NULL
    for i in range(e.n):
        ni = e.ptr[i + 1] - e.ptr[i]
        at = c.indptr[e.ptr[i]]
        ld = c.indptr[e.ptr[i] + 1] - at
        for q in range(c.to[i], c.to[i + 1]):
            j = c.other[q]
            nj = e.ptr[j + 1] - e.ptr[j]
            if right != NULL:
                r = right + e.wptr[j]
            if ni == 3 and nj == 3:
                form_coupled_block(c.h + at, out + at, ld, left + e.wptr[i], r, own, i == j, 3, 3)
            elif ni == 1 and nj == 1:
                form_coupled_block(c.h + at, out + at, ld, left + e.wptr[i], r, own, i == j, 1, 1)
            else:
                form_coupled_block(c.h + at, out + at, ld, left + e.wptr[i], r, own, i == j, ni, nj)
            at += nj
