"""One block of projected Gauss-Seidel over A in compressed rows; over the factored form see core/rows.pxd."""
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport (CONTACT_SPIN, ROW, blocks_t, n_tangents, relax_normal, relax_row,
                                      relax_tangents)
from lavender_ext.core.csr cimport csr_dot, csr_t


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
    if kind == CONTACT_SPIN:
        q = end - 1
        bound = p.patch_radius[i] * bound
        lam[q] = relax_row(lam[q], csr_dot(a, q, lam) - p.b[q], p.step[q], -bound, bound)
