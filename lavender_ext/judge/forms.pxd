"""The judge's pass over each form of A: slack w = A lam - b, error e of every block, their norms, and round-off floors.

    F_i = 2^-53 (|A| |lam| + |b|)_i             [m/s]; factored form: |A| |lam| is |J| |M^-1| |J|^T |lam| + c |lam|;
                                                |A| |lam| is at least d_i |lam_i| if a pair is projected to its bound;
                                                F_i = 0 if w_i keeps the row at its bound by more than F_i
    floor energy sqrt(sum F^2 / d), floor velocity max F sqrt(nu / d)

The products of a row are used for w and F, so that A is read once. In the factored form core/velocity.pxd computes
v = M^-1 J^T lam, and a second loop computes J v.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t

from lavender_ext.core.csr cimport csr_row_dot
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.rows cimport get_block_jacobian
from lavender_ext.core.velocity cimport add_vector_6, compute_velocity_change
from lavender_ext.core.view cimport csr_t, generalized_t, get_block_bodies, rows_t
from lavender_ext.judge.score cimport score_t
from lavender_ext.judge.slack cimport compute_generalized_slack, compute_body_slack
from lavender_ext.judge.tally cimport score_all_blocks


# -- A in compressed rows ----------------------------------------------------------------------------


cdef inline void compute_csr_slack(const blocks_t* p, const csr_t* a, const double* lam, double* w) noexcept nogil:
    """Compute w = A lam - b."""
    cdef int32_t i
    for i in range(p.n_rows):
        w[i] = csr_row_dot(a, i, lam) - p.b[i]


# -- the factored form -------------------------------------------------------------------------------


cdef inline void compute_abs_velocity(const blocks_t* p, const rows_t* r, const double* lam, double* size) noexcept nogil:
    """Compute size (n, 6) = |M^-1| |J|^T |lam|."""
    cdef int32_t i, j, k
    cdef double* x
    cdef const double* inv
    cdef const double* row
    cdef double t[3]
    cdef double sum_[12]
    cdef double scratch[72]
    for i in range(6 * r.n_bodies):
        size[i] = 0.0
    for i in range(p.n_blocks):
        row = get_block_jacobian(p, r, i, scratch)
        for k in range(12):
            sum_[k] = 0.0
        for j in range(p.ptr[i], p.ptr[i + 1]):
            for k in range(12):
                sum_[k] += fabs(row[k] * lam[j])
            row += 12
        for k in range(2):
            if get_block_bodies(r, i)[k] >= 0:
                add_vector_6(size + 6 * get_block_bodies(r, i)[k], sum_ + 6 * k)
    for i in range(r.n_bodies):
        x = size + 6 * <ssize_t>i
        inv = r.inv_inertia + 9 * <ssize_t>i
        for k in range(3):
            x[k] *= r.inv_mass[i]
            t[k] = x[3 + k]
        for k in range(3):
            x[3 + k] = (fabs(inv[3 * k]) * t[0] + fabs(inv[3 * k + 1]) * t[1]) + fabs(inv[3 * k + 2]) * t[2]


cdef inline void judge_impulse_over_bodies(const blocks_t* p, const rows_t* r, const double* lam, double* w, double* e,
                                           double* v, bint floor, score_t* out) noexcept nogil:
    """Judge lam over bodies; v (12 n + m) is scratch, (6 n) without a floor."""
    cdef double* abs_velocity = v + 6 * <ssize_t>r.n_bodies
    cdef double* sizes = abs_velocity + 6 * <ssize_t>r.n_bodies
    cdef double scratch[72]
    cdef const double* jac
    cdef const double* x
    cdef const int32_t* bodies
    cdef int32_t i, j, k, side
    cdef double s, t
    compute_velocity_change(p, r, lam, v)
    compute_body_slack(p, r, lam, v, w)
    if not floor:
        score_all_blocks(p, lam, w, e, NULL, out)
        return
    compute_abs_velocity(p, r, lam, abs_velocity)
    for i in range(p.n_blocks):
        jac, bodies = get_block_jacobian(p, r, i, scratch), get_block_bodies(r, i)
        for j in range(p.ptr[i], p.ptr[i + 1]):
            s = t = 0.0                                 # |J| |v| of the row: two sums, for two vector lanes
            for side in range(2):
                if bodies[side] >= 0:
                    x = abs_velocity + 6 * bodies[side]
                    for k in range(3):
                        s += fabs(jac[6 * side + 2 * k]) * x[2 * k]
                        t += fabs(jac[6 * side + 2 * k + 1]) * x[2 * k + 1]
            sizes[j] = r.compliance[j] * fabs(lam[j]) + (s + t)
            jac += 12
    score_all_blocks(p, lam, w, e, sizes, out)


# -- generalised coordinates ---------------------------------------------------------------------------


cdef inline void score_generalized_slack(const blocks_t* p, const generalized_t* g, const double* lam, const double* w,
                                         double* e, double* x, const double* extra, score_t* out) noexcept nogil:
    """Compute errors e from the slack w, their norms and floors.

    The floors follow from |Y| |Y|^T |lam| + c |lam| + extra, an upper bound of |A| |lam|; extra is (m) or NULL, x (n + m) is
    scratch.
    """
    cdef int32_t i, a, b, nc
    cdef double* size = x + g.n
    cdef const int32_t* cols
    cdef const double* y
    cdef double s
    for i in range(g.n):
        x[i] = 0.0
    for b in range(g.n_panels):                         # x = |Y|^T |lam|
        cols, y, nc = g.cols + g.pcol[b], g.y + g.pval[b], g.pcol[b + 1] - g.pcol[b]
        for i in range(g.prow[b], g.prow[b + 1]):
            if lam[i] != 0.0:
                for a in range(nc):
                    x[cols[a]] += fabs(y[a] * lam[i])
            y += nc
    for b in range(g.n_panels):                         # |Y| x
        cols, y, nc = g.cols + g.pcol[b], g.y + g.pval[b], g.pcol[b + 1] - g.pcol[b]
        for i in range(g.prow[b], g.prow[b + 1]):
            s = 0.0
            for a in range(nc):
                s += fabs(y[a]) * x[cols[a]]
            size[i] = s
            y += nc
    for i in range(p.n_rows):
        size[i] += g.compliance[i] * fabs(lam[i])
    if extra != NULL:
        for i in range(p.n_rows):
            size[i] += extra[i]
    score_all_blocks(p, lam, w, e, size, out)


cdef inline void judge_impulse_over_generalized(const blocks_t* p, const generalized_t* g, const double* lam, double* w,
                                                double* e, double* x, bint floor, score_t* out) noexcept nogil:
    """Judge lam over J and M; x (n + m) is scratch, (n) without a floor."""
    compute_generalized_slack(p, g, lam, x, w)
    if floor:
        score_generalized_slack(p, g, lam, w, e, x, NULL, out)
    else:
        score_all_blocks(p, lam, w, e, NULL, out)
