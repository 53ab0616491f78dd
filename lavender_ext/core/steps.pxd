"""Steps of a sweep, and one d for rows that share it.

    d_i     on two tangents the mean of both, and on the two that roll                               (1)
    step_i  = 1/d_i; on tangents 1/lambda_max of the symmetric part of A_tt, d_t where not positive;
              likewise on the two that roll                                                       (3)
"""
from libc.stdint cimport int32_t

from lavender_ext.core.parts cimport blocks_t, groups_of, parts_t
from lavender_ext.core.rows cimport largest_eigenvalue, reciprocal
from lavender_ext.core.view cimport csr_t


cdef inline double csr_entry(const csr_t* a, int32_t i, int32_t j) noexcept nogil:
    cdef int32_t q
    cdef double s = 0.0
    for q in range(a.indptr[i], a.indptr[i + 1]):
        if a.indices[q] == j:
            s += a.data[q]
    return s


cdef inline double csr_largest(const csr_t* a, int32_t j, const double* d, const double* big) noexcept nogil:
    # lambda_max of (3) on rows j and j + 1, with the largest entry of each row in `big`
    cdef double most = big[j] if big[j] > big[j + 1] else big[j + 1], e
    e = largest_eigenvalue(csr_entry(a, j, j), 0.5 * (csr_entry(a, j, j + 1) + csr_entry(a, j + 1, j)),
                           csr_entry(a, j + 1, j + 1))
    return e if e > 1e-10 * most else d[j]


cdef inline void block_steps(const blocks_t* p, int32_t i, const parts_t* part, const double* most, const double* d,
                             double* step) noexcept nogil:
    # (3) of block i: `most` is lambda_max of its parts of two rows, d where not positive
    cdef int32_t j = p.ptr[i], g, k
    for k in range(j, p.ptr[i + 1]):
        step[k] = reciprocal(d[k])
    for g in range(part.n):
        if part.size[g] == 2:                           # no sweep relaxes a round cone
            k = j + part.first[g]
            step[k] = step[k + 1] = reciprocal(most[g] if most[g] > 0.0 else d[k])


cdef inline void pair_means(const blocks_t* p, int32_t i, double* d) noexcept nogil:
    # One d for the two rows of a part.
    cdef parts_t group
    cdef int32_t g, k
    groups_of(p, i, &group)
    for g in range(group.n):
        if group.size[g] == 2:
            k = p.ptr[i] + group.first[g]
            d[k] = 0.5 * (d[k] + d[k + 1])
            d[k + 1] = d[k]
