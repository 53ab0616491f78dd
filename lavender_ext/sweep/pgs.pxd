"""One block of projected Gauss-Seidel over A in compressed rows, or over J and M; over bodies see core/rows.pxd.

    w_q   = sum_j A_qj lam_j - b_q                              of this moment                           (1)
    lam_q <- clip(lam_q - w_q / d_q, lower_q, upper_q)          a row; a normal has the bounds 0, inf    (2)
    lam_t <- the part of lam_t - w_t / step that is within mu lam_n, tangents together; spin, rolling alike (3)

Over J and M the whitened velocities u = Y^T lam are kept: w = Y u + c lam - b, then u += Y^T (change).
"""
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport (CONTACT_ROLLING, ROW, blocks_t, n_apart, n_tangents, relax_normal, relax_row,
                                      relax_tangents)
from lavender_ext.core.csr cimport csr_dot, csr_t
from lavender_ext.core.generalized cimport generalized_t, whitened_dot, whitened_push
from lavender_ext.core.rows cimport rows_t


cdef inline void relax_csr_block(const blocks_t* p, const csr_t* a, int32_t i, double* lam) noexcept nogil:
    cdef int32_t j = p.ptr[i], end = p.ptr[i + 1], kind = p.kind[i], nt, q
    cdef double w[2]
    cdef double bound
    if kind == ROW:
        for q in range(j, end):
            lam[q] = relax_row(lam[q], csr_dot(a, q, lam) - p.b[q], p.step[q], p.lower[q], p.upper[q])
        return
    nt = n_tangents(kind, end - j)
    lam[j] = relax_normal(lam[j], csr_dot(a, j, lam) - p.b[j], p.step[j])
    bound = p.mu[i] * lam[j]
    if nt > 0:
        for q in range(nt):
            w[q] = csr_dot(a, j + 1 + q, lam) - p.b[j + 1 + q]
        relax_tangents(lam + j + 1, w, p.step[j + 1], bound, nt)
    if n_apart(kind, end - j) & 1:
        q = j + 1 + nt
        bound = p.patch_radius[i] * bound
        lam[q] = relax_row(lam[q], csr_dot(a, q, lam) - p.b[q], p.step[q], -bound, bound)
    if kind == CONTACT_ROLLING:
        for q in range(2):
            w[q] = csr_dot(a, end - 2 + q, lam) - p.b[end - 2 + q]
        relax_tangents(lam + end - 2, w, p.step[end - 2], p.rolling[i] * lam[j], 2)


cdef inline void take_general(const generalized_t* g, int32_t panel, int32_t q, double now, double* lam,
                              double* u) noexcept nogil:
    whitened_push(g, panel, q, now - lam[q], u)
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
    cdef int32_t j = p.ptr[i], end = p.ptr[i + 1], kind = p.kind[i], b = g.home[i], nt, q
    cdef double bound, x
    if kind == ROW:
        for q in range(j, end):
            x = general_slack_of(p, g, b, q, lam, u)
            take_general(g, b, q, relax_row(lam[q], x, p.step[q], p.lower[q], p.upper[q]), lam, u)
        return
    nt = n_tangents(kind, end - j)
    take_general(g, b, j, relax_normal(lam[j], general_slack_of(p, g, b, j, lam, u), p.step[j]), lam, u)
    bound = p.mu[i] * lam[j]
    if nt > 0:
        relax_general_disk(p, g, b, j + 1, nt, bound, lam, u)
    if n_apart(kind, end - j) & 1:
        q = j + 1 + nt
        bound = p.patch_radius[i] * bound
        x = general_slack_of(p, g, b, q, lam, u)
        take_general(g, b, q, relax_row(lam[q], x, p.step[q], -bound, bound), lam, u)
    if kind == CONTACT_ROLLING:
        relax_general_disk(p, g, b, end - 2, 2, p.rolling[i] * lam[j], lam, u)


cdef void relax_matrix(const blocks_t* p, const csr_t* a, const int32_t* order, int32_t first, int32_t end,
                       double* lam) noexcept nogil
cdef void relax_bodies(const blocks_t* p, const rows_t* r, const int32_t* order, int32_t first, int32_t end, double* lam,
                       double* v) noexcept nogil
cdef void relax_general(const blocks_t* p, const generalized_t* g, const int32_t* order, int32_t first, int32_t end,
                        double* lam, double* u) noexcept nogil
