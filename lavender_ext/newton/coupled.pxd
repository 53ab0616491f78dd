"""H in compressed rows with the pattern of elements, and the matrices of Newton's method in the same pattern.

    M = L H R^T + o L + I         L, R have one small matrix for each element; R may be the identity              (1)

The rows of an element share their columns: those of all elements that H couples it to, in either direction.
"""
from libc.stdint cimport int32_t

from lavender_ext.newton.elements cimport elements_t


cdef struct coupled_t:
    const int32_t* to           # (elements + 1) graph of the elements
    const int32_t* other
    const int32_t* indptr       # (m + 1) rows of H and M
    const int32_t* diagonal     # (m) entry of the diagonal of each row
    const double* h             # entries of H


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
