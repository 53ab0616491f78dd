"""One sweep over the blocks (n_blocks) of an order, each loop with the update of a block inlined whole.

A module of their own, since that is what a compiler has workspace for: beside other loops it would call the updates.
"""
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport relax_row
from lavender_ext.core.csr cimport csr_dot
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.rows cimport relax_rows_block
from lavender_ext.core.view cimport csr_t, generalized_t, rows_t
from lavender_ext.sweep.pgs cimport relax_csr_block, relax_general_block


cdef void relax_matrix(const blocks_t* p, const csr_t* a, const int32_t* order, double* lam) noexcept nogil:
    """Over A; no order: every block is one row, as it stands."""
    cdef int32_t i
    if order == NULL:                                   # without the lookups
        for i in range(p.n_blocks):
            lam[i] = relax_row(lam[i], csr_dot(a, i, lam) - p.b[i], p.step[i], p.lower[i], p.upper[i])
        return
    for i in range(p.n_blocks):
        relax_csr_block(p, a, order[i], lam)


cdef void relax_bodies(const blocks_t* p, const rows_t* r, const int32_t* order, double* lam, double* v) noexcept nogil:
    """Over bodies, v (n_bodies, 6) = M^-1 J^T lam."""
    cdef int32_t i
    for i in range(p.n_blocks):
        relax_rows_block(p, r, order[i], lam, v)


cdef void relax_general(const blocks_t* p, const generalized_t* g, const int32_t* order, double* lam,
                        double* u) noexcept nogil:
    """Over J and M, u (nv) = Y^T lam."""
    cdef int32_t i
    for i in range(p.n_blocks):
        relax_general_block(p, g, order[i], lam, u)
