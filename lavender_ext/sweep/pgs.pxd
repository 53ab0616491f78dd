"""One block of projected Gauss-Seidel over A in compressed rows, or over J and M; over bodies see core/rows.pxd.

    w_q   = sum_j A_qj lam_j - b_q                              of this moment                           (1)
    lam_q <- clip(lam_q - w_q / d_q, lower_q, upper_q)          a row; a normal has the bounds 0, inf    (2)
    lam_g <- the part of lam_g - w_g / step that is within a_g lam_n, for each part g of a contact      (3)

Over J and M the whitened velocities u = Y^T lam are kept: w = Y u + c lam - b, then u += Y^T (change).
"""
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport relax_normal, relax_row, relax_tangents
from lavender_ext.core.csr cimport csr_dot
from lavender_ext.core.generalized cimport whitened_dot, add_scaled_whitened_row
from lavender_ext.core.block_types cimport blocks_t, is_rows, get_friction_components, friction_components_t
from lavender_ext.core.view cimport csr_t, generalized_t, rows_t


cdef inline void relax_csr_block(const blocks_t* p, const csr_t* a, int32_t i, double* lam) noexcept nogil:
    cdef int32_t j = p.ptr[i], g, k, q
    cdef double w[2]
    cdef friction_components_t part
    if is_rows(p, i):
        for q in range(j, p.ptr[i + 1]):
            lam[q] = relax_row(lam[q], csr_dot(a, q, lam) - p.b[q], p.step[q], p.lower[q], p.upper[q])
        return
    lam[j] = relax_normal(lam[j], csr_dot(a, j, lam) - p.b[j], p.step[j])
    get_friction_components(p, i, &part)
    for g in range(part.n):
        k = j + part.first[g]
        for q in range(part.size[g]):
            w[q] = csr_dot(a, k + q, lam) - p.b[k + q]
        relax_tangents(lam + k, w, p.step[k], part.friction_coefficient[g] * lam[j], part.size[g])


cdef inline void take_general(const generalized_t* g, int32_t panel, int32_t q, double now, double* lam,
                              double* u) noexcept nogil:
    add_scaled_whitened_row(g, panel, q, now - lam[q], u)
    lam[q] = now


cdef inline double general_slack_of(const blocks_t* p, const generalized_t* g, int32_t panel, int32_t q,
                                    const double* lam, const double* u) noexcept nogil:
    return whitened_dot(g, panel, q, u) + (g.compliance[q] * lam[q] - p.b[q])


cdef inline void relax_general_disk(const blocks_t* p, const generalized_t* g, int32_t panel, int32_t j, int32_t n,
                                    double radius, double* lam, double* u) noexcept nogil:
    # the n rows from j on together
    cdef double w[2]
    cdef double now[2]
    cdef int32_t q
    for q in range(n):
        now[q] = lam[j + q]
        w[q] = general_slack_of(p, g, panel, j + q, lam, u)
    relax_tangents(now, w, p.step[j], radius, n)
    for q in range(n):
        take_general(g, panel, j + q, now[q], lam, u)


cdef inline void relax_general_block(const blocks_t* p, const generalized_t* g, int32_t i, double* lam,
                                     double* u) noexcept nogil:
    cdef int32_t j = p.ptr[i], b = g.home[i], k, q
    cdef double x
    cdef friction_components_t part
    if is_rows(p, i):
        for q in range(j, p.ptr[i + 1]):
            x = general_slack_of(p, g, b, q, lam, u)
            take_general(g, b, q, relax_row(lam[q], x, p.step[q], p.lower[q], p.upper[q]), lam, u)
        return
    take_general(g, b, j, relax_normal(lam[j], general_slack_of(p, g, b, j, lam, u), p.step[j]), lam, u)
    get_friction_components(p, i, &part)
    for k in range(part.n):
        relax_general_disk(p, g, b, j + part.first[k], part.size[k], part.friction_coefficient[k] * lam[j], lam, u)


cdef void relax_matrix(const blocks_t* p, const csr_t* a, const int32_t* order, double* lam) noexcept nogil
cdef void relax_bodies(const blocks_t* p, const rows_t* r, const int32_t* order, double* lam, double* v) noexcept nogil
cdef void relax_general(const blocks_t* p, const generalized_t* g, const int32_t* order, double* lam,
                        double* u) noexcept nogil
