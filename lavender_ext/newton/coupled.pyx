"""H in compressed rows with the pattern of elements, and the matrices of Newton's method in the same pattern.

    M = L H R^T + o L + I         L, R have one small matrix for each element; R may be the identity              (1)

The rows of an element share their columns: those of all elements that H couples it to, in either direction.
"""
from libc.stdint cimport int32_t

import numpy as np

from lavender_ext.newton.elements cimport elements_t
from lavender_ext.newton.solve cimport elements_of


cdef public void lav_coupled_rows(int32_t n, const int32_t* ptr, const int32_t* to, const int32_t* other,
                                  int32_t* indptr, int32_t* indices) noexcept nogil:
    """Write the compressed rows of the graph (to, other) of n elements, columns ascending; with indices NULL indptr alone."""
    cdef int32_t i, j, q, r, width, at
    indptr[0] = 0
    for i in range(n):
        width = 0
        for q in range(to[i], to[i + 1]):
            width += ptr[other[q] + 1] - ptr[other[q]]
        for r in range(ptr[i], ptr[i + 1]):
            at = indptr[r]
            indptr[r + 1] = at + width
            if indices != NULL:
                for q in range(to[i], to[i + 1]):
                    for j in range(ptr[other[q]], ptr[other[q] + 1]):
                        indices[at] = j
                        at += 1


cdef inline void coupled_block(const double* h, double* out, int32_t ld, const double* left, const double* right,
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


cdef public void lav_coupled(const elements_t* e, const int32_t* to, const int32_t* other, const int32_t* indptr,
                             const double* h, const double* left, const double* right, double own,
                             double* out) noexcept nogil:
    """Compute (1); right may be NULL (the identity)."""
    cdef int32_t i, j, q, ni, nj, at, ld
    cdef const double* r = NULL
    for i in range(e.n):
        ni = e.ptr[i + 1] - e.ptr[i]
        at = indptr[e.ptr[i]]
        ld = indptr[e.ptr[i] + 1] - at
        for q in range(to[i], to[i + 1]):
            j = other[q]
            nj = e.ptr[j + 1] - e.ptr[j]
            if right != NULL:
                r = right + e.wptr[j]
            if ni == 3 and nj == 3:
                coupled_block(h + at, out + at, ld, left + e.wptr[i], r, own, i == j, 3, 3)
            elif ni == 1 and nj == 1:
                coupled_block(h + at, out + at, ld, left + e.wptr[i], r, own, i == j, 1, 1)
            else:
                coupled_block(h + at, out + at, ld, left + e.wptr[i], r, own, i == j, ni, nj)
            at += nj


def element_graph(const int32_t[::1] ptr, const int32_t[::1] element, const int32_t[::1] indptr,
                  const int32_t[::1] indices):
    """Return (indptr, indices) of the graph of elements: the elements whose columns appear in an element's rows of A."""
    cdef int32_t n = <int32_t>ptr.shape[0] - 1, i, j, q, k, count = 0
    to_array, other_array = np.zeros(n + 1, np.int32), np.empty(indices.shape[0], np.int32)
    cdef int32_t[::1] mark = np.full(n, -1, np.int32), to = to_array, other = other_array
    with nogil:
        for i in range(n):
            for j in range(ptr[i], ptr[i + 1]):
                for q in range(indptr[j], indptr[j + 1]):
                    k = element[indices[q]]
                    if mark[k] != i:
                        mark[k] = i
                        other[count] = k
                        count += 1
            to[i + 1] = count
    return to_array, other_array[:count].copy()


def scaled_entries(const int32_t[::1] indptr, const int32_t[::1] indices, const double[::1] a, const double[::1] scale):
    """Return the entries of diag(scale) A diag(scale)."""
    out_array = np.empty(a.shape[0])
    cdef double[::1] out = out_array
    cdef int32_t i, q
    with nogil:
        for i in range(indptr.shape[0] - 1):
            for q in range(indptr[i], indptr[i + 1]):
                out[q] = scale[i] * a[q] * scale[indices[q]]
    return out_array


def coupled_rows(const int32_t[::1] ptr, const int32_t[::1] to, const int32_t[::1] other):
    """Return (indptr, indices) of the rows of the graph of elements; n > 0."""
    cdef int32_t n = <int32_t>ptr.shape[0] - 1
    indptr_array = np.empty(ptr[n] + 1, np.int32)
    cdef int32_t[::1] indptr = indptr_array, indices
    lav_coupled_rows(n, &ptr[0], &to[0], &other[0], &indptr[0], NULL)
    indices_array = np.empty(indptr[ptr[n]], np.int32)
    indices = indices_array
    if indices.shape[0]:
        with nogil:
            lav_coupled_rows(n, &ptr[0], &to[0], &other[0], &indptr[0], &indices[0])
    return indptr_array, indices_array


def coupled_entries(const int32_t[::1] aptr, const int32_t[::1] aind, const double[::1] a, const int32_t[::1] indptr,
                    const int32_t[::1] indices):
    """Return the entries of A, whose columns ascend, in the pattern of `coupled_rows`, which includes its own."""
    out_array = np.zeros(indices.shape[0])
    cdef double[::1] out = out_array
    cdef int32_t i, p, q
    with nogil:
        for i in range(indptr.shape[0] - 1):
            q = aptr[i]
            for p in range(indptr[i], indptr[i + 1]):
                if q < aptr[i + 1] and aind[q] == indices[p]:
                    out[p] = a[q]
                    q += 1
    return out_array


def coupled(s, const int32_t[::1] to, const int32_t[::1] other, const int32_t[::1] indptr,
            const double[::1] h, const double[::1] left, right, double own, double[::1] out):
    """Compute (1) for the elements of a `newton.solve.Solve`; right may be None (the identity)."""
    cdef const elements_t* e = elements_of(s)
    cdef const double[::1] r
    cdef const double* second = NULL
    if right is not None:
        r = right
        second = &r[0]
    with nogil:
        lav_coupled(e, &to[0], &other[0], &indptr[0], &h[0], &left[0], second, own, &out[0])
