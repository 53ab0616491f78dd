"""Slack w = A lam - b over bodies, and over J and M."""
from libc.stdint cimport int32_t

from lavender_ext.core.generalized cimport multiply_jacobian_transpose, multiply_jacobian_row, solve_mass_matrix
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.rows cimport multiply_jacobian
from lavender_ext.core.view cimport generalized_t, rows_t


cdef inline void compute_body_slack(const blocks_t* p, const rows_t* r, const double* lam, const double* v,
                                    double* w) noexcept nogil:
    """Compute w = J v + c lam - b, with v = M^-1 J^T lam."""
    cdef int32_t j
    multiply_jacobian(p, r, v, w)
    for j in range(p.n_rows):
        w[j] += r.compliance[j] * lam[j] - p.b[j]


cdef inline void compute_generalized_slack(const blocks_t* p, const generalized_t* g, const double* lam, double* x,
                                           double* w) noexcept nogil:
    """Compute w = J x + c lam - b with x (n) = M^-1 J^T lam, solved with the factor of M."""
    cdef int32_t i
    multiply_jacobian_transpose(g, lam, x)
    solve_mass_matrix(g, x)
    for i in range(p.n_rows):
        w[i] = multiply_jacobian_row(g, i, x) + (g.compliance[i] * lam[i] - p.b[i])
