"""Slack w = A lam - b over bodies, and over J and M."""
from libc.stdint cimport int32_t

from lavender_ext.core.generalized cimport jac_transpose_times, jac_row, tree_solve
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.rows cimport rows_times
from lavender_ext.core.view cimport generalized_t, rows_t


cdef inline void rows_slack(const blocks_t* p, const rows_t* r, const double* lam, const double* v,
                                double* w) noexcept nogil:
    """Compute w = J v + c lam - b, with v = M^-1 J^T lam."""
    cdef int32_t j
    rows_times(p, r, v, w)
    for j in range(p.n_rows):
        w[j] += r.compliance[j] * lam[j] - p.b[j]


cdef inline void general_slack(const blocks_t* p, const generalized_t* g, const double* lam, double* x,
                               double* w) noexcept nogil:
    """Compute w = J x + c lam - b with x (n) = M^-1 J^T lam, solved with the factor of M."""
    cdef int32_t i
    jac_transpose_times(g, lam, x)
    tree_solve(g, x)
    for i in range(p.n_rows):
        w[i] = jac_row(g, i, x) + (g.compliance[i] * lam[i] - p.b[i])
