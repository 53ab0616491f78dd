"""J and M of generalised coordinates, from dense rows to M = L^T D L: shared by `Operator`, batches and the C library."""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.thin cimport thin
from lavender_ext.core.tree cimport factor_tree
from lavender_ext.core.view cimport generalized_t


cdef enum:
    THIN_PADDING = 8            # number of entries that `thin` may write beyond the end of an array
    EXPECTED_FACTORISATIONS = 20        # assumed number of factorisations of M for one problem, for which an order is searched


# -- layout ------------------------------------------------------------------------------------------------------

cdef inline int32_t compress_dense_rows(const double* a, int64_t stride, int32_t m, int32_t n, int32_t* ptr, int32_t* idx,
                                        double* val) noexcept nogil:
    """Write a dense matrix (m, n) in compressed rows without zeros; return the number of entries."""
    cdef int32_t i, q = 0
    ptr[0] = 0
    for i in range(m):
        q += thin(n, a, NULL, idx + q, val + q)
        a += stride
        ptr[i + 1] = q
    return q


cdef inline bint is_symmetric(const double* a, int64_t stride, int32_t n) noexcept nogil:
    """Return whether a (n, n) is exactly symmetric, where 0 equals -0. The loop has no branch, so that compilers vectorise it."""
    cdef int32_t i, j, differs = 0
    for i in range(n):
        for j in range(i):
            differs |= a[i * stride + j] != a[j * stride + i]
    return not differs


cdef inline double relative_entry_asymmetry(const double* a, int64_t stride, int32_t i, int32_t j) noexcept nogil:
    """Return |a_ij - a_ji| / sqrt(a_ii a_jj), or |a_ij - a_ji| if a_ii a_jj is not positive."""
    cdef double gap = fabs(a[i * stride + j] - a[j * stride + i]), size = a[i * (stride + 1)] * a[j * (stride + 1)]
    return gap / sqrt(size) if gap > 0.0 and size > 0.0 else gap


cdef inline int32_t compress_lower_triangle(const double* a, int64_t stride, double max_asymmetry, int32_t n, int32_t* ptr,
                                            int32_t* idx, double* val) noexcept nogil:
    """Write the lower triangle of a (n, n) in compressed rows, with every diagonal entry; return the number of entries.

    Returns -1 if `relative_entry_asymmetry` of an entry is above `max_asymmetry` or NaN.
    """
    cdef bint symmetric = is_symmetric(a, stride, n)
    cdef const double* row = a
    cdef int32_t i, j, q = 0
    ptr[0] = 0
    for i in range(n):
        if symmetric:
            q += thin(i, row, NULL, idx + q, val + q)
        for j in range(0 if symmetric else i):
            if row[j] != 0.0 or a[j * stride + i] != 0.0:
                if row[j] != a[j * stride + i] and not relative_entry_asymmetry(a, stride, i, j) <= max_asymmetry:
                    return -1
                idx[q] = j
                val[q] = row[j]
                q += 1
        idx[q] = i
        val[q] = row[i]
        q += 1
        ptr[i + 1] = q
        row += stride
    return q


# -- order and factor --------------------------------------------------------------------------------------------

cdef inline double count_mass_factor_work(const generalized_t* g) noexcept nogil:
    """Return the multiply-adds of the factorisation: c (c + 1) / 2 for a row with c entries left of the diagonal."""
    cdef int32_t i, c
    cdef double work = 0.0
    for i in range(g.n):
        c = g.lptr[i + 1] - g.lptr[i]
        work += 0.5 * c * (c + 1.0)
    return work


cdef inline bint ordering_pays_off(const generalized_t* g, int32_t entries) noexcept nogil:
    """Return whether the search of an order with less fill-in takes less time than the factorisations of M save.

    `entries` is the number of entries of the lower triangle of M. A factorisation without fill-in takes the least work if all
    rows have the same number of entries; this lower bound excludes matrices that are nearly full. Times [ns] were measured on
    trees of 9 to 800 velocities in the wrong order: the search and the factorisation in the new order take 0.2 ms and 0.13 us
    for each entry; a multiply-add takes 2 ns. (For
    example, a robot of 9 velocities whose root slides in two directions has a fill-in of one entry.)
    """
    cdef double off_diagonal = entries - g.n, work
    if g.lptr[g.n] <= off_diagonal:                     # There is no fill-in.
        return False
    work = count_mass_factor_work(g)
    return work > off_diagonal * (off_diagonal / g.n + 1.0) and 2.0 * EXPECTED_FACTORISATIONS * work > 4e5 + 130.0 * entries


cdef inline int32_t factor_mass(generalized_t* g, double* lval, double* inv_pivot, double* root) noexcept nogil:
    """Factor M of g in the pattern of L; bind L, 1 / D and D^-1/2 to the last three arguments.

    Return -1, or the row of a pivot that is too small.
    """
    cdef int32_t i, failed
    g.lval, g.inv_pivot, g.root = lval, inv_pivot, root
    if g.n == 0:
        return -1
    failed = factor_tree(g.n, g.mptr, g.midx, g.mval, g.lptr, g.lidx, lval, root, inv_pivot)
    for i in range(g.n):
        root[i] = sqrt(inv_pivot[i])
    return failed
