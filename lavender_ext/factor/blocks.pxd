"""Factorisation of a matrix N of n x n blocks, each (s, s), with a symmetric block pattern: N = L L^T, or L U by panels.

The analysis orders nothing: block rows are eliminated as they stand (`graph.pxd` has an order). Its supernodes are those of
`symbolic.pxd`, of whole blocks. `block_matrix_t` contains N; `factor_blocks` copies it into the panels of `supernodal.pxd`.
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memset

from lavender_ext.factor.factors cimport block_matrix_t, supernodal_t
from lavender_ext.factor.supernodal cimport clear_descendant_lists, factor_supernode, panel_width, rows_below, set_local_rows


cdef inline void copy_blocks_to_panels(const block_matrix_t* f, int32_t lu) noexcept nogil:
    """Copy the blocks of N to the panels of its factor, and set all other entries of the panels to 0."""
    cdef const supernodal_t* p = &f.factor
    cdef int32_t k, q, r, c, i, s = f.s
    cdef int64_t ld, b = s * s
    cdef double* y
    cdef const double* x
    memset(p.values, 0, sizeof(double) * p.value_offset[p.supernodes])
    if lu:
        memset(p.upper, 0, sizeof(double) * p.upper_offset[p.supernodes])
    for k in range(f.n):
        for q in range(f.nptr[k], f.nptr[k + 1]):
            i = p.supernode_of[s * f.nind[q]]
            ld = panel_width(p, i) + rows_below(p, i)
            y = p.values + f.lower_offset[q]
            x = f.nval + q * b
            for c in range(s):
                for r in range(s):
                    y[r + c * ld] = x[r * s + c]
            if not lu or f.nind[q] == k:
                continue
            x = f.mval + q * b
            if k * s < p.first[i + 1]:
                y = p.values + f.upper_offset[q]
                for c in range(s):
                    for r in range(s):
                        y[c + r * ld] = x[r * s + c]
            else:
                y = p.upper + f.upper_offset[q]
                ld = rows_below(p, i)
                for c in range(s):
                    for r in range(s):
                        y[r + c * ld] = x[r * s + c]


cdef inline int32_t factor_blocks(const block_matrix_t* f, int32_t lu) noexcept nogil:
    """Factor N = L L^T, or L U with row exchanges inside panels; return the number of pivots lost to rounding."""
    cdef const supernodal_t* p = &f.factor
    cdef int32_t i, lost = 0
    clear_descendant_lists(p)
    copy_blocks_to_panels(f, lu)
    for i in range(p.supernodes):
        set_local_rows(p, i)
        lost += factor_supernode(p, i, lu, NULL, 0.0)
    return lost
