"""Block Gauss-Seidel: one block's own part of A, prepared once, and its update in a sweep.

Prepared numbers of block i stand from g[start[i]] on:

    one row                      nothing: lam <- clip(lam - w / d)
    rows, 2 to 8, all free       W^-1 (n, n), then 1; where W is singular W, then 0
    rows, 2 to 8, bounded        W (n, n), then 0
    normal, two tangents         prepare3 of local.pxd; g[15] = 1 where the rows of A share one pattern
    other contacts               W (n, n)
"""
from libc.stdint cimport int32_t

from lavender_ext.block cimport (CONE, CONTACT_SPIN, ROW, blocks_t, n_tangents, relax_normal, relax_row)
from lavender_ext.local cimport (FAILED, MAX_ROWS, PREPARED, boxed_rows, cone3, contact_with_spin,
                                 contact_without_spin, coulomb3, eliminate, prepare3, project_locally)


cdef inline int32_t prepared_size(const blocks_t* p, int32_t i) noexcept nogil:
    cdef int32_t n = p.ptr[i + 1] - p.ptr[i]
    if p.kind[i] == ROW:
        return n * n + 1 if 1 < n <= MAX_ROWS else 0
    if p.kind[i] != CONTACT_SPIN and n == 3:
        return PREPARED
    return n * n


cdef inline void prepare_block(const blocks_t* p, int32_t i, const double* W, int32_t one_pattern, double* g) noexcept nogil:
    """g from the block's part W (n, n) of A; not for blocks of one row or of more than MAX_ROWS."""
    cdef int32_t j = p.ptr[i], n = p.ptr[i + 1] - j, q, k, free = 1
    cdef double inf = 1.0 / 0.0
    cdef double a[MAX_ROWS * MAX_ROWS]
    cdef double x[MAX_ROWS]
    if p.kind[i] != ROW:
        if p.kind[i] != CONTACT_SPIN and n == 3:
            prepare3(W, g)
            # A normal whose d falls back has no trustworthy W_nn to divide by.
            if W[0] != p.d[j]:
                g[9] = 0.0
            g[15] = one_pattern
        else:
            for q in range(n * n):
                g[q] = W[q]
            if W[0] != p.d[j]:
                g[0] = 0.0
        return
    for q in range(j, p.ptr[i + 1]):
        if p.lower[q] != -inf or p.upper[q] != inf:
            free = 0
    g[n * n] = free
    if free:
        for k in range(n):
            for q in range(n * n):
                a[q] = W[q]
            for q in range(n):
                x[q] = 1.0 if q == k else 0.0
            if eliminate(n, a, x) < n:
                g[n * n] = 0.0
                break
            for q in range(n):
                g[n * q + k] = x[q]
    if g[n * n] == 0.0:
        for q in range(n * n):
            g[q] = W[q]


cdef inline int32_t solve_block(const blocks_t* p, int32_t i, const double* g, const double* w, double* lam) noexcept nogil:
    """The exact update of block i from its slack w; lam at its first row. 1 where it fell back."""
    cdef int32_t j = p.ptr[i], n = p.ptr[i + 1] - j, kind = p.kind[i], k, t, nt, found
    cdef double q[4]
    cdef double x[MAX_ROWS]
    cdef double s, f
    if kind == ROW:
        if n == 1:
            lam[0] = relax_row(lam[0], w[0], p.step[j], p.lower[j], p.upper[j])
            return 0
        if g[n * n] != 0.0:
            for k in range(n):
                s = 0.0
                for t in range(n):
                    s += g[n * k + t] * w[t]
                x[k] = s
            for k in range(n):
                lam[k] -= x[k]
            return 0
        return boxed_rows(n, g, w, p.step + j, p.lower + j, p.upper + j, lam) == FAILED
    if n == 1:
        lam[0] = relax_normal(lam[0], w[0], p.step[j])
        return 0
    nt = n_tangents(kind, n)
    if n == 3 and kind != CONTACT_SPIN:
        # q = w - W lam
        q[0] = w[0] - (g[0] * lam[0] + g[1] * lam[1] + g[2] * lam[2])
        q[1] = w[1] - (g[3] * lam[0] + g[4] * lam[1] + g[5] * lam[2])
        q[2] = w[2] - (g[6] * lam[0] + g[7] * lam[1] + g[8] * lam[2])
        if p.law == CONE:
            found = cone3(g, q, p.mu[i], lam) if g[9] > 0.0 or q[0] >= 0.0 else FAILED
        else:
            # Sliding as now would need beta = |w_t| / |lam_t|.
            s = lam[1] * lam[1] + lam[2] * lam[2]
            f = -(w[1] * lam[1] + w[2] * lam[2])
            found = coulomb3(g, q, p.mu[i], f / s if s > 0.0 and f > 0.0 else 0.0, lam)
    else:
        for k in range(n):
            s = w[k]
            for t in range(n):
                s -= g[n * k + t] * lam[t]
            q[k] = s
        if kind == CONTACT_SPIN:
            found = contact_with_spin(p.law, nt, g, q, p.mu[i], p.patch_radius[i], lam)
        else:
            found = contact_without_spin(p.law, nt, g, q, p.mu[i], lam)
    if found == FAILED:
        project_locally(p.law, nt, kind == CONTACT_SPIN, g, q, p.d + j, p.step + j, p.mu[i], p.patch_radius[i], lam)
        return 1
    return 0
