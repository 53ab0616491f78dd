"""Patterns of sparse matrices in compressed rows: bandwidths, symmetry, and the part of the free rows."""
from libc.stdint cimport int32_t

import numpy as np

from lavender_ext.core.csr cimport measure_asymmetry_and_bandwidth
from lavender_ext.core.view cimport csr_t


def bandwidth(const int32_t[::1] indptr, const int32_t[::1] indices):
    """Return the (lower, upper) bandwidth of a canonical CSR matrix, from the ends of its rows."""
    cdef Py_ssize_t i, n = indptr.shape[0] - 1
    cdef int32_t lower = 0, upper = 0
    for i in range(n):
        if indptr[i] < indptr[i + 1]:
            lower = max(lower, <int32_t>i - indices[indptr[i]])
            upper = max(upper, indices[indptr[i + 1] - 1] - <int32_t>i)
    return lower, upper


def measure_asymmetry(const int32_t[::1] indptr, const int32_t[::1] indices, const double[::1] data, const double[::1] d):
    """Return the asymmetry of a canonical CSR matrix with the metric d (n,)."""
    cdef int32_t n = <int32_t>indptr.shape[0] - 1
    cdef int32_t band[2]
    cdef double asymmetry
    cdef csr_t a
    cdef int32_t[::1] cursor
    if n <= 0 or data.shape[0] == 0:
        return 0.0
    a.indptr = &indptr[0]
    a.indices = &indices[0]
    a.data = &data[0]
    cursor = np.empty(n, np.int32)
    with nogil:
        asymmetry = measure_asymmetry_and_bandwidth(&a, &d[0], n, &cursor[0], band)
    return asymmetry


def has_symmetric_pattern(const int32_t[::1] indptr, const int32_t[::1] indices):
    """Return whether the pattern of a canonical CSR matrix is symmetric."""
    cdef int32_t[::1] cursor = np.array(indptr)
    cdef int32_t i, j, q
    for i in range(indptr.shape[0] - 1):
        for q in range(indptr[i], indptr[i + 1]):
            j = indices[q]
            if cursor[j] == indptr[j + 1] or indices[cursor[j]] != i:
                return False                            # Rows are visited in order, so the next entry of row j must be i.
            cursor[j] += 1
    return True


def extract_free_part(const int32_t[::1] indptr, const int32_t[::1] indices, const double[::1] data, const int32_t[::1] place,
                      int n_free):
    """Return (indptr, indices, data) of the rows and columns with place >= 0, numbered in the order of the rows."""
    cdef int32_t i, q, k = 0, n = <int32_t>indptr.shape[0] - 1
    ptr_array = np.zeros(n_free + 1, np.int32)
    cdef int32_t[::1] ptr = ptr_array, idx
    cdef double[::1] val
    for i in range(n):
        if place[i] >= 0:
            for q in range(indptr[i], indptr[i + 1]):
                k += place[indices[q]] >= 0
            ptr[place[i] + 1] = k
    idx_array, val_array = np.empty(k, np.int32), np.empty(k)
    idx, val = idx_array, val_array
    k = 0
    for i in range(n):
        if place[i] >= 0:
            for q in range(indptr[i], indptr[i + 1]):
                if place[indices[q]] >= 0:
                    idx[k] = place[indices[q]]
                    val[k] = data[q]
                    k += 1
    return ptr_array, idx_array, val_array
