"""Patterns of a sparse A in Newton's method: graph of the elements, rows of H, scaled entries (`coupled.pxd`)."""
from libc.stdint cimport int32_t

import numpy as np


cdef void expand_graph_to_rows(int32_t n, const int32_t* ptr, const int32_t* to, const int32_t* other,
                    int32_t* indptr, int32_t* indices) noexcept nogil:
    """Write the compressed rows of a graph of n elements, columns ascending; if indices is NULL, write indptr only."""
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


def find_element_graph(const int32_t[::1] ptr, const int32_t[::1] element, const int32_t[::1] indptr,
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


def scale_matrix_entries(const int32_t[::1] indptr, const int32_t[::1] indices, const double[::1] a, const double[::1] scale):
    """Return the entries of diag(scale) A diag(scale)."""
    out_array = np.empty(a.shape[0])
    cdef double[::1] out = out_array
    cdef int32_t i, q
    with nogil:
        for i in range(indptr.shape[0] - 1):
            for q in range(indptr[i], indptr[i + 1]):
                out[q] = scale[i] * a[q] * scale[indices[q]]
    return out_array


def list_coupled_rows(const int32_t[::1] ptr, const int32_t[::1] to, const int32_t[::1] other):
    """Return (indptr, indices) of the rows of the graph of elements; n > 0."""
    cdef int32_t n = <int32_t>ptr.shape[0] - 1
    indptr_array = np.empty(ptr[n] + 1, np.int32)
    cdef int32_t[::1] indptr = indptr_array, indices
    expand_graph_to_rows(n, &ptr[0], &to[0], &other[0], &indptr[0], NULL)
    indices_array = np.empty(indptr[ptr[n]], np.int32)
    indices = indices_array
    if indices.shape[0]:
        with nogil:
            expand_graph_to_rows(n, &ptr[0], &to[0], &other[0], &indptr[0], &indices[0])
    return indptr_array, indices_array


def copy_coupled_entries(const int32_t[::1] aptr, const int32_t[::1] aind, const double[::1] a, const int32_t[::1] indptr,
                    const int32_t[::1] indices):
    """Return the entries of A in the pattern of `list_coupled_rows`, with 0 where A has no entry; columns of A must ascend."""
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
