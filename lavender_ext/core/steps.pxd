"""Steps of a sweep, and the common d of two rows of a friction component.

    d_i     = the mean of both d on two tangents and on two rolling rows                                           (1)
    step_i  = 1/d_i; on two tangents 1/lambda_max of the symmetric part of A_tt, 1/d_t if lambda_max is not positive;
              likewise on two rolling rows                                                                         (3)
"""
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport blocks_t, get_row_groups, friction_components_t
from lavender_ext.core.rows cimport largest_eigenvalue_2x2, reciprocal_or_zero
from lavender_ext.core.view cimport csr_t


cdef inline double get_csr_entry(const csr_t* a, int32_t i, int32_t j) noexcept nogil:
    """Return A_ij."""
    cdef int32_t q
    cdef double s = 0.0
    for q in range(a.indptr[i], a.indptr[i + 1]):
        if a.indices[q] == j:
            s += a.data[q]
    return s


cdef inline double largest_eigenvalue_of_csr_pair(const csr_t* a, int32_t j, const double* d, const double* big) noexcept nogil:
    """Return lambda_max of (3) on rows j and j + 1, or d[j] if lambda_max is zero or negative within rounding.

    big (m) is the largest absolute entry of each row of A.
    """
    cdef double scale = big[j] if big[j] > big[j + 1] else big[j + 1], e
    e = largest_eigenvalue_2x2(get_csr_entry(a, j, j), 0.5 * (get_csr_entry(a, j, j + 1) + get_csr_entry(a, j + 1, j)),
                           get_csr_entry(a, j + 1, j + 1))
    return e if e > 1e-10 * scale else d[j]


cdef inline void compute_block_steps(const blocks_t* p, int32_t i, const friction_components_t* part, const double* eigenvalue,
                                     const double* d, double* step) noexcept nogil:
    """Compute the steps (3) of block i; eigenvalue[g] is lambda_max of component g if it has two rows."""
    cdef int32_t j = p.ptr[i], g, k
    for k in range(j, p.ptr[i + 1]):
        step[k] = reciprocal_or_zero(d[k])
    for g in range(part.n):
        if part.size[g] == 2:                           # No sweep updates a round cone, so larger components need no step.
            k = j + part.first[g]
            step[k] = step[k + 1] = reciprocal_or_zero(eigenvalue[g] if eigenvalue[g] > 0.0 else d[k])


cdef inline void average_diagonal_of_pairs(const blocks_t* p, int32_t i, double* d) noexcept nogil:
    """Replace d of the two rows of each group of block i by their mean (1)."""
    cdef friction_components_t group
    cdef int32_t g, k
    get_row_groups(p, i, &group)
    for g in range(group.n):
        if group.size[g] == 2:
            k = p.ptr[i] + group.first[g]
            d[k] = 0.5 * (d[k] + d[k + 1])
            d[k + 1] = d[k]
