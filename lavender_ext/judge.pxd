"""The judge's pass: w = A lam - b formed anew, error e of every block, three sums over rows.

    E   = sqrt(sum d e^2)                       [sqrt J]
    V   = max sqrt(nu d) |e|                    [m/s], |e| the pair's norm on tangents
    F_i = 2^-53 (|A| |lam| + |b|)_i             [m/s]; factored: |J| |M^-1| |J|^T |lam| + c |lam| for |A| |lam|
    floor energy sqrt(sum F^2 / d), floor velocity max F sqrt(nu / d)
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.block cimport CONTACT_SPIN, ROW, block_error, blocks_t, n_tangents, norm2
from lavender_ext.csr cimport csr_abs_dot, csr_dot, csr_t
from lavender_ext.rows cimport abs_push, contact_jacobian, contact_push, joint_push, rows_t, rows_times


cdef struct score_t:
    double energy               # sqrt J
    double velocity             # m/s
    double floor_energy         # sqrt J
    double floor_velocity       # m/s
    int32_t worst               # row of the largest velocity error, -1 where there is none
    int32_t finite              # 0 where e holds a NaN or an infinity


cdef struct sum_t:              # sum of squares as scale^2 * ssq: neither over- nor underflows
    double scale
    double ssq


cdef inline void add_square(sum_t* s, double x) noexcept nogil:
    cdef double r
    x = fabs(x)
    if x > s.scale:
        r = s.scale / x
        s.ssq = 1.0 + s.ssq * r * r
        s.scale = x
    elif x > 0.0:
        r = x / s.scale
        s.ssq += r * r


cdef inline double root(const sum_t* s) noexcept nogil:
    return s.scale * sqrt(s.ssq)


cdef inline void csr_slack(const blocks_t* p, const csr_t* a, const double* lam, double* w) noexcept nogil:
    cdef int32_t i
    for i in range(p.n_rows):
        w[i] = csr_dot(a, i, lam) - p.b[i]


cdef inline void rows_velocity(const blocks_t* p, const rows_t* r, const double* lam, double* v) noexcept nogil:
    """v = M^-1 J^T lam, (n, 6)."""
    cdef int32_t i, j, c
    for i in range(6 * r.n_bodies):
        v[i] = 0.0
    for i in range(r.n_joints):
        for j in range(p.ptr[i], p.ptr[i + 1]):
            joint_push(r.minv_jac + 12 * j, lam[j], v, r.joint_body[2 * i], r.joint_body[2 * i + 1])
    for c in range(r.n_contacts):
        i = r.n_joints + c
        j = p.ptr[i]
        contact_push(r, c, n_tangents(p.kind[i], p.ptr[i + 1] - j), p.kind[i] == CONTACT_SPIN, lam + j, v)


cdef inline void rows_slack(const blocks_t* p, const rows_t* r, const double* lam, const double* v,
                                double* w) noexcept nogil:
    """w = J v + c lam - b, v = M^-1 J^T lam."""
    cdef int32_t j
    rows_times(p, r, v, w)
    for j in range(p.n_rows):
        w[j] += r.compliance[j] * lam[j] - p.b[j]


cdef inline void score_rows(const blocks_t* p, const double* lam, const double* w, double* e, score_t* out) noexcept nogil:
    """Errors e (m) of all blocks and their two sums; the floor entries are left alone."""
    cdef int32_t i, j, k, nt, worst = -1
    cdef double v, t, energy = 0.0, big = -1.0
    cdef sum_t total = sum_t(0.0, 0.0)
    # Plain sums of squares, one division a row; kept where they can neither have over- nor underflown:
    # (d e) e and (d e)(nu e), for e^2 alone may vanish beside a d of 1e160.
    for i in range(p.n_blocks):
        block_error(p, i, lam, w, e)
        j = p.ptr[i]
        nt = 0 if p.kind[i] == ROW else n_tangents(p.kind[i], p.ptr[i + 1] - j)
        for k in range(j, p.ptr[i + 1]):
            v = p.d[k] * e[k]
            energy += v * e[k]
            t = v * (p.nu[k] * e[k])
            if nt == 2 and k == j + 1:
                t += (p.d[k] * e[k + 1]) * (p.nu[k] * e[k + 1])
            if t > big and not (nt == 2 and k == j + 2):
                big = t
                worst = k
    if 1e-250 < energy < 1e250 and 1e-250 < big < 1e250:
        out.worst = worst
        out.finite = 1
        out.energy = sqrt(energy)
        out.velocity = sqrt(big)
        return
    big = -1.0
    out.worst = -1
    out.finite = 1
    for i in range(p.n_blocks):
        j = p.ptr[i]
        nt = 0 if p.kind[i] == ROW else n_tangents(p.kind[i], p.ptr[i + 1] - j)
        for k in range(j, p.ptr[i + 1]):
            add_square(&total, sqrt(p.d[k]) * e[k])
            if nt == 2 and k == j + 2:
                continue                                # the pair counts once, below
            v = norm2(e[k], e[k + 1]) if nt == 2 and k == j + 1 else fabs(e[k])
            v = sqrt(p.nu[k]) * sqrt(p.d[k]) * v
            if v > big:
                big = v
                out.worst = k
            elif v != v and out.finite:
                out.finite = 0
                out.worst = k
                big = 1.0 / 0.0
    if big > 1.7976931348623157e308:
        out.finite = 0
    out.energy = root(&total)
    out.velocity = big if big > 0.0 else 0.0


cdef inline void add_floor(const blocks_t* p, int32_t i, double size, sum_t* total, double* big) noexcept nogil:
    cdef double f = 1.1102230246251565e-16 * (size + fabs(p.b[i])), v
    add_square(total, f / sqrt(p.d[i]))
    v = f * (sqrt(p.nu[i]) / sqrt(p.d[i]))
    if v > big[0]:
        big[0] = v


cdef inline void csr_floor(const blocks_t* p, const csr_t* a, const double* lam, score_t* out) noexcept nogil:
    cdef int32_t i
    cdef sum_t total = sum_t(0.0, 0.0)
    cdef double f, t, energy = 0.0, big = 0.0
    for i in range(p.n_rows):
        f = 1.1102230246251565e-16 * (csr_abs_dot(a, i, lam) + fabs(p.b[i]))
        t = f / p.d[i]
        energy += t * f
        t = p.nu[i] * t * f
        if t > big:
            big = t
    if 1e-250 < energy < 1e250 and 1e-250 < big < 1e250:
        out.floor_energy = sqrt(energy)
        out.floor_velocity = sqrt(big)
        return
    big = 0.0
    for i in range(p.n_rows):
        add_floor(p, i, csr_abs_dot(a, i, lam), &total, &big)
    out.floor_energy = root(&total)
    out.floor_velocity = big


cdef inline double abs_joint_velocity(const double* jac, const double* v, int32_t a, int32_t b) noexcept nogil:
    cdef double s = 0.0
    cdef int32_t k
    for k in range(6):
        if a >= 0:
            s += fabs(jac[k]) * v[6 * a + k]
        if b >= 0:
            s += fabs(jac[6 + k]) * v[6 * b + k]
    return s


cdef inline void rows_floor(const blocks_t* p, const rows_t* r, const double* lam, double* v, score_t* out) noexcept nogil:
    """v (n, 6) is scratch."""
    cdef int32_t i, j, c, q, t, a, b
    cdef double size
    cdef double jac[48]
    cdef const double* row
    cdef sum_t total = sum_t(0.0, 0.0)
    cdef double big = 0.0
    for i in range(6 * r.n_bodies):
        v[i] = 0.0
    for t in range(2):                                  # first the bodies, then the rows
        for i in range(p.n_blocks):
            j = p.ptr[i]
            c = i - r.n_joints
            if c < 0:
                a = r.joint_body[2 * i]
                b = r.joint_body[2 * i + 1]
                row = r.jac + 12 * j
            else:
                a = r.contact_body[2 * c]
                b = r.contact_body[2 * c + 1]
                contact_jacobian(r, c, n_tangents(p.kind[i], p.ptr[i + 1] - j), p.kind[i] == CONTACT_SPIN, jac)
                row = jac
            for q in range(j, p.ptr[i + 1]):
                if t == 0:
                    abs_push(row, fabs(lam[q]), r.inv_mass, r.inv_inertia, a, b, v)
                else:
                    size = r.compliance[q] * fabs(lam[q])
                    size += abs_joint_velocity(row, v, a, b)
                    add_floor(p, q, size, &total, &big)
                row += 12
    out.floor_energy = root(&total)
    out.floor_velocity = big


cdef inline void judge_into(const blocks_t* p, const csr_t* a, const rows_t* r, bint factored, const double* lam, double* w,
                     double* e, double* v, bint floor, score_t* out) noexcept nogil:
    """Slack into w (m), error into e (m), the sums into out; v (n_bodies, 6) is scratch, read where factored."""
    if factored:
        rows_velocity(p, r, lam, v)
        rows_slack(p, r, lam, v, w)
        score_rows(p, lam, w, e, out)
        if floor:
            rows_floor(p, r, lam, v, out)
    else:
        csr_slack(p, a, lam, w)
        score_rows(p, lam, w, e, out)
        if floor:
            csr_floor(p, a, lam, out)
