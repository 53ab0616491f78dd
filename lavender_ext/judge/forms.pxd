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

from lavender_ext.core.block cimport compute_block_error
from lavender_ext.core.csr cimport csr_row_dot, csr_row_dot_with_abs_sum
from lavender_ext.core.generalized cimport add_abs_panel_transpose_product, multiply_abs_whitened_panel
from lavender_ext.core.block_types cimport blocks_t, has_independent_rows, count_tangent_rows, count_angular_rows
from lavender_ext.core.rows cimport cross
from lavender_ext.core.velocity cimport add_vector_6, compute_velocity_change
from lavender_ext.core.view cimport csr_t, generalized_t, rows_t
from lavender_ext.judge.score cimport score_t
from lavender_ext.judge.slack cimport compute_generalized_slack, compute_body_slack
from lavender_ext.judge.tally cimport (
    add_block_floor, add_row_floor, begin_island_scores, get_block_in_order, add_island_to_score, write_score_floor,
    floor_t, index_of_island_begin, index_of_island_end, make_empty_floor, make_empty_tally, write_score_norms,
    score_all_blocks, add_block_error, tally_t,
)


# -- islands --------------------------------------------------------------------------------------------


cdef inline void add_island_floor_to_total(const floor_t* island, floor_t* total) noexcept nogil:
    """Add the floor of an island to the floor of all rows."""
    total.energy += island.energy
    if island.fast > total.fast:
        total.fast = island.fast


cdef inline void score_with_floor(const blocks_t* p, const rows_t* r, const double* lam, const double* w, double* e,
                                  const double* sizes, score_t* out) noexcept nogil:
    """Compute errors e, norms and floors from the slack w, island by island.

    With bodies r, sizes is the result of `compute_abs_velocity`. If r is NULL, sizes (m) is an upper bound of |A| |lam|.
    """
    cdef int32_t island, a, i, end, n = begin_island_scores(p, out)
    cdef const int32_t* order = p.islands.order if p.islands != NULL else NULL
    cdef tally_t own, s = make_empty_tally()
    cdef floor_t floor, f = make_empty_floor()
    for island in range(n):
        own = make_empty_tally()
        floor = make_empty_floor()
        end = index_of_island_end(p, island)
        for a in range(index_of_island_begin(p, island), end):
            i = get_block_in_order(order, a)
            compute_block_error(p, i, lam, w, e)
            add_block_error(p, i, e, &own)
            if r == NULL:
                add_block_floor(p, i, lam, w, e, sizes + p.ptr[i], &floor)
            elif i < r.n_joints:
                add_joint_floor(p, r, i, lam, w, sizes, &floor)
            else:
                add_contact_floor(p, r, i - r.n_joints, lam, w, e, sizes, &floor)
        add_island_to_score(p, island, w, e, &own, &floor, &s, out)
        add_island_floor_to_total(&floor, &f)
    write_score_norms(p, e, &s, out)
    write_score_floor(&f, out)


# -- A in compressed rows ----------------------------------------------------------------------------


cdef inline void compute_csr_slack(const blocks_t* p, const csr_t* a, const double* lam, double* w) noexcept nogil:
    """Compute w = A lam - b."""
    cdef int32_t i
    for i in range(p.n_rows):
        w[i] = csr_row_dot(a, i, lam) - p.b[i]


cdef inline void judge_csr_block(const blocks_t* p, const csr_t* a, int32_t i, const double* lam, double* w, double* e, tally_t* s,
                           floor_t* f) noexcept nogil:
    """Compute slack and error of block i; add the error to s and its rounding to f."""
    cdef int32_t j = p.ptr[i], k
    cdef double size[6]
    for k in range(j, p.ptr[i + 1]):
        w[k] = csr_row_dot_with_abs_sum(a, k, lam, size + (0 if has_independent_rows(p, i) else k - j)) - p.b[k]
        if has_independent_rows(p, i):                               # Such a block may have any number of rows.
            add_row_floor(p, k, lam[k], w[k], size[0], f)
    compute_block_error(p, i, lam, w, e)
    add_block_error(p, i, e, s)
    if not has_independent_rows(p, i):
        add_block_floor(p, i, lam, w, e, size, f)


cdef inline void judge_impulse_over_csr(const blocks_t* p, const csr_t* a, const double* lam, double* w, double* e, bint floor,
                           score_t* out) noexcept nogil:
    """Judge lam over A in compressed rows."""
    cdef int32_t island, k, end, n
    cdef const int32_t* order = p.islands.order if p.islands != NULL else NULL
    cdef tally_t own, s = make_empty_tally()
    cdef floor_t island_floor_, f = make_empty_floor()
    if not floor:
        compute_csr_slack(p, a, lam, w)
        score_all_blocks(p, lam, w, e, out)
        return
    n = begin_island_scores(p, out)
    for island in range(n):
        own = make_empty_tally()
        island_floor_ = make_empty_floor()
        end = index_of_island_end(p, island)
        for k in range(index_of_island_begin(p, island), end):
            judge_csr_block(p, a, get_block_in_order(order, k), lam, w, e, &own, &island_floor_)
        add_island_to_score(p, island, w, e, &own, &island_floor_, &s, out)
        add_island_floor_to_total(&island_floor_, &f)
    write_score_norms(p, e, &s, out)
    write_score_floor(&f, out)


# -- the factored form -------------------------------------------------------------------------------


cdef inline void add_joint_abs_wrench(const blocks_t* p, const rows_t* r, int32_t i, const double* lam,
                                   double* size) noexcept nogil:
    """Add |J|^T |lam| of joint i to size (n, 6)."""
    cdef double x[12]
    cdef const double* row
    cdef int32_t j, k, a = r.joint_body[2 * i], b = r.joint_body[2 * i + 1]
    for k in range(12):
        x[k] = 0.0
    for j in range(p.ptr[i], p.ptr[i + 1]):
        row = r.jac + 12 * j
        for k in range(12):
            x[k] += fabs(row[k] * lam[j])
    if a >= 0:
        add_vector_6(size + 6 * a, x)
    if b >= 0:
        add_vector_6(size + 6 * b, x + 6)


cdef inline double abs_cross_component(const double* x, const double* y, int32_t k) noexcept nogil:
    """Return |(x x y)_k|."""
    if k == 0:
        return fabs(x[1] * y[2] - x[2] * y[1])
    if k == 1:
        return fabs(x[2] * y[0] - x[0] * y[2])
    return fabs(x[0] * y[1] - x[1] * y[0])


cdef inline void add_one_body_abs_wrench(const double* n, const double* t1, const double* t2, const double* arm, int32_t nt,
                                  int32_t n_angular, double x, double y, double z, const double* angular,
                                  double* out) noexcept nogil:
    """Add |J|^T |lam| of one contact on one body to out (6).

    x, y, z are |lam| of the normal and the tangents; angular (n_angular) are the impulses of the spin and rolling rows.
    """
    cdef int32_t k
    cdef double s, l
    for k in range(3):
        s = fabs(n[k]) * x
        l = abs_cross_component(arm, n, k) * x
        if nt > 0:
            s += fabs(t1[k]) * y
            l += abs_cross_component(arm, t1, k) * y
        if nt > 1:
            s += fabs(t2[k]) * z
            l += abs_cross_component(arm, t2, k) * z
        if n_angular & 1:
            l += fabs(n[k]) * fabs(angular[0])
        if n_angular & 2:
            l += fabs(t1[k]) * fabs(angular[n_angular & 1]) + fabs(t2[k]) * fabs(angular[1 + (n_angular & 1)])
        out[k] += s
        out[3 + k] += l


cdef inline void add_contact_abs_wrench(const rows_t* r, int32_t c, int32_t nt, int32_t n_angular, const double* lam,
                                     double* size) noexcept nogil:
    """Add |J|^T |lam| of contact c to size (n, 6)."""
    cdef double t2[3]
    cdef double y = 0.0, z = 0.0
    cdef const double* n = r.normal + 3 * c
    cdef const double* t1 = r.tangent + 3 * c
    cdef int32_t a = r.contact_body[2 * c], b = r.contact_body[2 * c + 1]
    if nt > 0:
        y = fabs(lam[1])
    if nt > 1:
        z = fabs(lam[2])
        cross(n, t1, t2)
    if a >= 0:
        add_one_body_abs_wrench(n, t1, t2, r.arm_a + 3 * c, nt, n_angular, fabs(lam[0]), y, z, lam + 1 + nt, size + 6 * a)
    if b >= 0:
        add_one_body_abs_wrench(n, t1, t2, r.arm_b + 3 * c, nt, n_angular, fabs(lam[0]), y, z, lam + 1 + nt, size + 6 * b)


cdef inline void compute_abs_velocity(const blocks_t* p, const rows_t* r, const double* lam, double* size) noexcept nogil:
    """Compute size (n, 6) = |M^-1| |J|^T |lam|."""
    cdef int32_t i, j, c, k, nt, n_angular
    cdef double* x
    cdef const double* inv
    cdef double t[3]
    for i in range(6 * r.n_bodies):
        size[i] = 0.0
    for i in range(r.n_joints):
        add_joint_abs_wrench(p, r, i, lam, size)
    for c in range(r.n_contacts):
        i = r.n_joints + c
        j = p.ptr[i]
        nt = count_tangent_rows(p, i)
        n_angular = count_angular_rows(p, i)
        if n_angular or nt == 1:                            # the two common kinds below have constant sizes
            add_contact_abs_wrench(r, c, nt, n_angular, lam + j, size)
        elif nt == 2:
            add_contact_abs_wrench(r, c, 2, 0, lam + j, size)
        else:
            add_contact_abs_wrench(r, c, 0, 0, lam + j, size)
    for i in range(r.n_bodies):
        x = size + 6 * <ssize_t>i
        inv = r.inv_inertia + 9 * <ssize_t>i
        for k in range(3):
            x[k] *= r.inv_mass[i]
            t[k] = x[3 + k]
        for k in range(3):
            x[3 + k] = (fabs(inv[3 * k]) * t[0] + fabs(inv[3 * k + 1]) * t[1]) + fabs(inv[3 * k + 2]) * t[2]


cdef inline double joint_row_abs_velocity(const double* jac, const double* size, int32_t a, int32_t b) noexcept nogil:
    """Return |J| size of one joint row; two sums, for two vector lanes."""
    cdef double s = 0.0, t = 0.0
    cdef const double* x
    cdef int32_t k
    if a >= 0:
        x = size + 6 * a
        for k in range(3):
            s += fabs(jac[2 * k]) * x[2 * k]
            t += fabs(jac[2 * k + 1]) * x[2 * k + 1]
    if b >= 0:
        x = size + 6 * b
        for k in range(3):
            s += fabs(jac[6 + 2 * k]) * x[2 * k]
            t += fabs(jac[7 + 2 * k]) * x[2 * k + 1]
    return s + t


cdef inline double one_body_abs_velocity(const double* axis, const double* arm, const double* size) noexcept nogil:
    """Return |axis| . linear + |arm x axis| . angular of size (6)."""
    cdef double s = 0.0, t = 0.0
    cdef int32_t k
    for k in range(3):
        s += fabs(axis[k]) * size[k]
        t += abs_cross_component(arm, axis, k) * size[3 + k]
    return s + t


cdef inline void compute_contact_abs_velocity(const rows_t* r, int32_t c, int32_t nt, int32_t n_angular, const double* size,
                               double* out) noexcept nogil:
    """Compute |J| size of the rows of contact c."""
    cdef double t2[3]
    cdef const double* n = r.normal + 3 * c
    cdef const double* t1 = r.tangent + 3 * c
    cdef const double* arm
    cdef const double* x
    cdef int32_t k, side, body, roll = 1 + nt + (n_angular & 1)
    if nt > 1:
        cross(n, t1, t2)
    for k in range(1 + nt + n_angular):
        out[k] = 0.0
    for side in range(2):
        body = r.contact_body[2 * c + side]
        if body < 0:
            continue
        arm = r.arm_b + 3 * c if side else r.arm_a + 3 * c
        x = size + 6 * body
        out[0] += one_body_abs_velocity(n, arm, x)
        if nt > 0:
            out[1] += one_body_abs_velocity(t1, arm, x)
        if nt > 1:
            out[2] += one_body_abs_velocity(t2, arm, x)
        if n_angular & 1:
            for k in range(3):
                out[1 + nt] += fabs(n[k]) * x[3 + k]
        if n_angular & 2:
            for k in range(3):
                out[roll] += fabs(t1[k]) * x[3 + k]
                out[roll + 1] += fabs(t2[k]) * x[3 + k]


cdef inline void add_joint_floor(const blocks_t* p, const rows_t* r, int32_t i, const double* lam, const double* w,
                             const double* sizes, floor_t* f) noexcept nogil:
    """Add the rounding of the rows of joint i to f; sizes is the result of `compute_abs_velocity`."""
    cdef int32_t j, a = r.joint_body[2 * i], b = r.joint_body[2 * i + 1]
    for j in range(p.ptr[i], p.ptr[i + 1]):
        add_row_floor(p, j, lam[j], w[j], r.compliance[j] * fabs(lam[j]) + joint_row_abs_velocity(r.jac + 12 * j, sizes, a, b), f)


cdef inline void add_contact_floor(const blocks_t* p, const rows_t* r, int32_t c, const double* lam, const double* w,
                               const double* e, const double* sizes, floor_t* f) noexcept nogil:
    """Add the rounding of the rows of contact c to f; sizes is the result of `compute_abs_velocity`."""
    cdef int32_t k, i = r.n_joints + c, j = p.ptr[i], n = p.ptr[i + 1] - j
    cdef int32_t nt = count_tangent_rows(p, i), n_angular = count_angular_rows(p, i)
    cdef double size[6]
    if n_angular or nt == 1:                                # the two common kinds below have constant sizes
        compute_contact_abs_velocity(r, c, nt, n_angular, sizes, size)
    elif nt == 2:
        compute_contact_abs_velocity(r, c, 2, 0, sizes, size)
    else:
        compute_contact_abs_velocity(r, c, 0, 0, sizes, size)
    for k in range(n):
        size[k] = r.compliance[j + k] * fabs(lam[j + k]) + size[k]
    add_block_floor(p, i, lam, w, e, size, f)


cdef inline void judge_impulse_over_bodies(const blocks_t* p, const rows_t* r, const double* lam, double* w, double* e, double* v,
                            bint floor, score_t* out) noexcept nogil:
    """Judge lam over bodies; v (12 n) is scratch, (6 n) without a floor."""
    cdef double* sizes = v + 6 * <ssize_t>r.n_bodies
    compute_velocity_change(p, r, lam, v)
    compute_body_slack(p, r, lam, v, w)
    if not floor:
        score_all_blocks(p, lam, w, e, out)
        return
    compute_abs_velocity(p, r, lam, sizes)
    score_with_floor(p, r, lam, w, e, sizes, out)


# -- generalised coordinates ---------------------------------------------------------------------------


cdef inline const double* bound_generalized_terms(const blocks_t* p, const generalized_t* g, const double* lam, const double* extra,
                                        double* x) noexcept nogil:
    """Return |Y| |Y|^T |lam| + c |lam| + extra (m), an upper bound of |A| |lam|, inside x (n + m); extra is (m) or NULL."""
    cdef int32_t i
    cdef double* size = x + g.n
    for i in range(g.n):
        x[i] = 0.0
    for i in range(g.n_panels):
        add_abs_panel_transpose_product(g, i, lam, x)
    for i in range(g.n_panels):
        multiply_abs_whitened_panel(g, i, x, size)
    for i in range(p.n_rows):
        size[i] += g.compliance[i] * fabs(lam[i])
    if extra != NULL:
        for i in range(p.n_rows):
            size[i] += extra[i]
    return size


cdef inline void score_generalized_slack(const blocks_t* p, const generalized_t* g, const double* lam, const double* w, double* e,
                               double* x, const double* extra, score_t* out) noexcept nogil:
    """Compute errors e from the slack w, their norms and floors; extra as in `bound_generalized_terms`, x (n + m) is scratch."""
    score_with_floor(p, NULL, lam, w, e, bound_generalized_terms(p, g, lam, extra, x), out)


cdef inline void judge_impulse_over_generalized(const blocks_t* p, const generalized_t* g, const double* lam, double* w, double* e,
                               double* x, bint floor, score_t* out) noexcept nogil:
    """Judge lam over J and M; x (n + m) is scratch, (n) without a floor."""
    compute_generalized_slack(p, g, lam, x, w)
    if floor:
        score_generalized_slack(p, g, lam, w, e, x, NULL, out)
    else:
        score_all_blocks(p, lam, w, e, out)
