"""The factored form: joint rows, compact contacts, and the bodies between them.

A body's velocity is six numbers (linear [m/s], angular [rad/s]); body -1 is static, read as zero and
never written. Relative velocity at a contact, from body a to body b,

    u = (v_b + omega_b x arm_b) - (v_a + omega_a x arm_a)                                      (1)
    w_n = n.u,  w_t = t.u with t2 = n x t1,  w_s = n.(omega_b - omega_a),  w_r = t.(omega_b - omega_a)  (2)

and an impulse P [N s] with spin s [N m s] along n (of one that rolls along t) changes

    v_b += P / m_b,  omega_b += I_b^-1 (arm_b x P + s n),  and the opposite on a.              (3)

Because the rows of one contact couple by A_tn, A_sn, A_st alone, a sweep reads u once, follows it
through these couplings, and writes both bodies once, omega by the stored I^-1 (arm x axis) of each row
(`swing`: a product instead of two on the way from one contact to the next, 1.3 times as fast):

    w_t after the normal's step = t.u + A_tn (change of lam_n), and so on.                     (4)
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport relax_normal, relax_row, relax_tangents
from lavender_ext.core.parts cimport blocks_t, is_box, is_disk, n_directions, n_turns, parts_of, parts_t
from lavender_ext.core.view cimport rows_t


cdef inline double dot3(const double* a, const double* b) noexcept nogil:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


cdef inline void cross(const double* a, const double* b, double* out) noexcept nogil:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


cdef inline void relative_velocity(const double* v, int32_t a, int32_t b, const double* arm_a,
                                   const double* arm_b, double* u, double* spin) noexcept nogil:
    # (1) in u, and omega_b - omega_a in spin.
    cdef const double* x
    cdef int32_t k
    for k in range(3):
        u[k] = 0.0
        spin[k] = 0.0
    if b >= 0:
        x = v + 6 * b
        u[0] = x[0] + (x[4] * arm_b[2] - x[5] * arm_b[1])
        u[1] = x[1] + (x[5] * arm_b[0] - x[3] * arm_b[2])
        u[2] = x[2] + (x[3] * arm_b[1] - x[4] * arm_b[0])
        for k in range(3):
            spin[k] = x[3 + k]
    if a >= 0:
        x = v + 6 * a
        u[0] -= x[0] + (x[4] * arm_a[2] - x[5] * arm_a[1])
        u[1] -= x[1] + (x[5] * arm_a[0] - x[3] * arm_a[2])
        u[2] -= x[2] + (x[3] * arm_a[1] - x[4] * arm_a[0])
        for k in range(3):
            spin[k] -= x[3 + k]


cdef inline void push(double* v, double inv_mass, const double* inv_inertia, const double* arm,
                      const double* impulse, const double* twist, double sign) noexcept nogil:
    # (3) for one body; twist = s n, or NULL.
    cdef double l[3]
    cdef int32_t k
    cross(arm, impulse, l)
    if twist != NULL:
        for k in range(3):
            l[k] += twist[k]
    for k in range(3):
        l[k] = sign * l[k]
        v[k] += sign * inv_mass * impulse[k]
    for k in range(3):
        v[3 + k] += dot3(inv_inertia + 3 * k, l)


cdef inline void push_bodies(double* v, int32_t a, int32_t b, const double* inv_mass,
                             const double* inv_inertia, const double* arm_a, const double* arm_b,
                             const double* impulse, const double* twist) noexcept nogil:
    if a >= 0:
        push(v + 6 * a, inv_mass[a], inv_inertia + 9 * a, arm_a, impulse, twist, -1.0)
    if b >= 0:
        push(v + 6 * b, inv_mass[b], inv_inertia + 9 * b, arm_b, impulse, twist, 1.0)


cdef inline double joint_velocity(const double* jac, const double* v, int32_t a, int32_t b) noexcept nogil:
    cdef double s = 0.0, t = 0.0
    cdef int32_t k
    if a >= 0:
        for k in range(6):
            s += jac[k] * v[6 * a + k]
    if b >= 0:
        for k in range(6):
            t += jac[6 + k] * v[6 * b + k]
    return s + t


cdef inline void joint_push(const double* minv_jac, double change, double* v, int32_t a,
                            int32_t b) noexcept nogil:
    cdef int32_t k
    if a >= 0:
        for k in range(6):
            v[6 * a + k] += change * minv_jac[k]
    if b >= 0:
        for k in range(6):
            v[6 * b + k] += change * minv_jac[6 + k]


cdef inline void relax_joint(const blocks_t* p, const rows_t* r, int32_t i, double* lam,
                             double* v) noexcept nogil:
    """One joint, its rows in turn: w = J v + c lam - b, equation (1) of core/block.pxd."""
    cdef int32_t j, a = r.joint_body[2 * i], b = r.joint_body[2 * i + 1]
    cdef double w, y
    for j in range(p.ptr[i], p.ptr[i + 1]):
        w = joint_velocity(r.jac + 12 * j, v, a, b) + r.compliance[j] * lam[j] - p.b[j]
        y = relax_row(lam[j], w, p.step[j], p.lower[j], p.upper[j])
        joint_push(r.minv_jac + 12 * j, y - lam[j], v, a, b)
        lam[j] = y


cdef inline void swing_body(double* v, double inv_mass, const double* swing, const double* impulse, double dn,
                            double d0, double d1, double ds, int32_t nt, int32_t spin,
                            double sign) noexcept nogil:
    # (3) for one body: swing is at the first row of this contact and this side.
    cdef int32_t k
    cdef double w
    for k in range(3):
        v[k] += sign * (inv_mass * impulse[k])
        w = dn * swing[k]
        if nt > 0:
            w += d0 * swing[6 + k]
        if nt > 1:
            w += d1 * swing[12 + k]
        if spin:
            w += ds * swing[6 * (1 + nt) + k]
        v[3 + k] += sign * w


cdef inline void relax_contact(const double* normal, const double* tangent, const double* arm_a,
                               const double* arm_b, const double* coupling, const double* swing,
                               const double* compliance, const double* rhs, const double* step, double mu,
                               double second, int32_t nt, int32_t spin, bint box, int32_t a, int32_t b,
                               const double* inv_mass, double* lam, double* v) noexcept nogil:
    """One contact: normal, tangents together (of a box one after the other), spin; all pointers are at its first entry.

    mu, second: reach of its tangents, and of what spins or of the second side of a box.
    """
    cdef double u[3]
    cdef double omega[3]
    cdef double t2[3]
    cdef double impulse[3]
    cdef double w[2]
    cdef double old[2]
    cdef double y, dn, ds = 0.0, d0 = 0.0, d1 = 0.0
    cdef int32_t k, js = 1 + nt
    relative_velocity(v, a, b, arm_a, arm_b, u, omega)
    y = relax_normal(lam[0], dot3(normal, u) + (compliance[0] * lam[0] - rhs[0]), step[0])
    dn = y - lam[0]
    lam[0] = y
    for k in range(3):
        impulse[k] = dn * normal[k]
    if nt > 0:
        old[0] = lam[1]
        w[0] = (dot3(tangent, u) + (compliance[1] * lam[1] - rhs[1])) + coupling[0] * dn
        if nt == 2:
            cross(normal, tangent, t2)
            old[1] = lam[2]
            w[1] = (dot3(t2, u) + (compliance[2] * lam[2] - rhs[2])) + coupling[1] * dn
        if box:
            lam[1] = relax_row(lam[1], w[0], step[1], -(mu * y), mu * y)
            # What the first moved comes last, so that all else need not wait for it.
            lam[2] = relax_row(old[1] - w[1] * step[2], lam[1] - old[0], coupling[2] * step[2],
                               -(second * y), second * y)
        else:
            relax_tangents(lam + 1, w, step[1], mu * y, nt)
        d0 = lam[1] - old[0]
        for k in range(3):
            impulse[k] += d0 * tangent[k]
        if nt == 2:
            d1 = lam[2] - old[1]
            for k in range(3):
                impulse[k] += d1 * t2[k]
    if spin:
        w[0] = (dot3(normal, omega) + (compliance[js] * lam[js] - rhs[js])
                + coupling[2] * dn + coupling[3] * d0 + coupling[4] * d1)
        y = relax_row(lam[js], w[0], step[js], -(second * y), second * y)
        ds = y - lam[js]
        lam[js] = y
    if a >= 0:
        swing_body(v + 6 * a, inv_mass[a], swing, impulse, dn, d0, d1, ds, nt, spin, -1.0)
    if b >= 0:
        swing_body(v + 6 * b, inv_mass[b], swing + 3, impulse, dn, d0, d1, ds, nt, spin, 1.0)


cdef inline void turn_body(double* v, const double* swing, double d0, double d1, double sign) noexcept nogil:
    cdef int32_t k
    for k in range(3):
        v[3 + k] += sign * (d0 * swing[k] + d1 * swing[6 + k])


cdef inline void relax_rolls(const double* normal, const double* tangent, const double* swing, const double* compliance,
                               const double* rhs, const double* step, double radius, int32_t a, int32_t b, double* lam,
                               double* v) noexcept nogil:
    """The two rows that roll, after `relax_contact`, on the v of now; all pointers are at the first of them."""
    cdef double omega[3]
    cdef double t2[3]
    cdef double w[2]
    cdef double x = lam[0], y = lam[1]
    cdef int32_t k
    for k in range(3):
        omega[k] = (v[6 * b + 3 + k] if b >= 0 else 0.0) - (v[6 * a + 3 + k] if a >= 0 else 0.0)
    cross(normal, tangent, t2)
    w[0] = dot3(tangent, omega) + (compliance[0] * x - rhs[0])
    w[1] = dot3(t2, omega) + (compliance[1] * y - rhs[1])
    relax_tangents(lam, w, step[0], radius, 2)
    if a >= 0:
        turn_body(v + 6 * a, swing, lam[0] - x, lam[1] - y, -1.0)
    if b >= 0:
        turn_body(v + 6 * b, swing + 3, lam[0] - x, lam[1] - y, 1.0)


cdef inline void relax_contact_block(const blocks_t* p, const rows_t* r, int32_t i, double* lam,
                                     double* v) noexcept nogil:
    # The common kinds with their sizes as constants: a compiler then leaves out the rows that are not there.
    cdef int32_t c = i - r.n_joints, j = p.ptr[i], n = p.ptr[i + 1] - j, a = r.contact_body[2 * c]
    cdef int32_t b = r.contact_body[2 * c + 1], nt, turns
    cdef const double* normal = r.normal + 3 * c
    cdef const double* tangent = r.tangent + 3 * c
    cdef const double* coupling = r.coupling + 5 * c
    cdef const double* swing = r.swing + 6 * (j - p.ptr[r.n_joints])
    cdef parts_t q
    if is_disk(p, i):
        relax_contact(normal, tangent, r.arm_a + 3 * c, r.arm_b + 3 * c, coupling, swing, r.compliance + j, p.b + j,
                      p.step + j, p.mu[i], 0.0, 2, 0, False, a, b, r.inv_mass, lam + j, v)
        return
    if n == 1:
        relax_contact(normal, NULL, r.arm_a + 3 * c, r.arm_b + 3 * c, NULL, swing, r.compliance + j, p.b + j,
                      p.step + j, 0.0, 0.0, 0, 0, False, a, b, r.inv_mass, lam + j, v)
        return
    parts_of(p, i, &q)
    if is_box(p, i):
        relax_contact(normal, tangent, r.arm_a + 3 * c, r.arm_b + 3 * c, coupling, swing, r.compliance + j, p.b + j,
                      p.step + j, q.reach[0], q.reach[1], 2, 0, True, a, b, r.inv_mass, lam + j, v)
        return
    nt = n_directions(p, i)
    turns = n_turns(p, i)
    relax_contact(normal, tangent, r.arm_a + 3 * c, r.arm_b + 3 * c, coupling, swing, r.compliance + j, p.b + j,
                  p.step + j, q.reach[0], q.reach[1 if nt else 0] if turns & 1 else 0.0, nt, turns & 1, False, a, b,
                  r.inv_mass, lam + j, v)
    if turns & 2:
        relax_rolls(normal, tangent, swing + 6 * (n - 2), r.compliance + j + n - 2, p.b + j + n - 2, p.step + j + n - 2,
                      q.reach[q.n - 1] * lam[j], a, b, lam + j + n - 2, v)


cdef inline void relax_rows_block(const blocks_t* p, const rows_t* r, int32_t i, double* lam,
                                  double* v) noexcept nogil:
    if i < r.n_joints:
        relax_joint(p, r, i, lam, v)
    else:
        relax_contact_block(p, r, i, lam, v)


cdef inline void contact_slack(const rows_t* r, int32_t c, int32_t nt, int32_t turns, const double* v,
                               double* w) noexcept nogil:
    # (2): J v of one contact.
    cdef double u[3]
    cdef double omega[3]
    cdef double t2[3]
    cdef const double* n = r.normal + 3 * c
    relative_velocity(v, r.contact_body[2 * c], r.contact_body[2 * c + 1], r.arm_a + 3 * c,
                      r.arm_b + 3 * c, u, omega)
    w[0] = dot3(n, u)
    if nt > 0:
        w[1] = dot3(r.tangent + 3 * c, u)
    if nt == 2:
        cross(n, r.tangent + 3 * c, t2)
        w[2] = dot3(t2, u)
    if turns & 1:
        w[1 + nt] = dot3(n, omega)
    if turns & 2:
        w[1 + nt + (turns & 1)] = dot3(r.tangent + 3 * c, omega)
        w[2 + nt + (turns & 1)] = dot3(t2, omega)


cdef inline void rows_times(const blocks_t* p, const rows_t* r, const double* v, double* out) noexcept nogil:
    # J v (m) of all rows; v (n, 6).
    cdef int32_t i, j, c
    for i in range(r.n_joints):
        for j in range(p.ptr[i], p.ptr[i + 1]):
            out[j] = joint_velocity(r.jac + 12 * j, v, r.joint_body[2 * i], r.joint_body[2 * i + 1])
    for c in range(r.n_contacts):
        i = r.n_joints + c
        contact_slack(r, c, n_directions(p, i), n_turns(p, i), v, out + p.ptr[i])


cdef inline void contact_jacobian(const rows_t* r, int32_t c, int32_t nt, int32_t turns,
                                  double* jac) noexcept nogil:
    # Rows of one contact as (1 + nt + turns, 12), in the layout of joint rows.
    cdef double axis[3]
    cdef double arm[3]
    cdef const double* n = r.normal + 3 * c
    cdef int32_t row, k
    for row in range(1 + nt + turns):
        for k in range(12):
            jac[12 * row + k] = 0.0
        if row > nt:                                    # spins about n, rolls about t1 and t2
            for k in range(3):
                axis[k] = n[k] if row == nt + (turns & 1) else r.tangent[3 * c + k]
            if row == nt + (turns & 1) + 2:
                cross(n, r.tangent + 3 * c, axis)
            for k in range(3):
                jac[12 * row + 3 + k] = -axis[k]
                jac[12 * row + 9 + k] = axis[k]
            continue
        if row == 0:
            for k in range(3):
                axis[k] = n[k]
        elif row == 1:
            for k in range(3):
                axis[k] = r.tangent[3 * c + k]
        else:
            cross(n, r.tangent + 3 * c, axis)
        cross(r.arm_a + 3 * c, axis, arm)
        for k in range(3):
            jac[12 * row + k] = -axis[k]
            jac[12 * row + 3 + k] = -arm[k]
            jac[12 * row + 6 + k] = axis[k]
        cross(r.arm_b + 3 * c, axis, arm)
        for k in range(3):
            jac[12 * row + 9 + k] = arm[k]
    # A static side has no columns.
    for row in range(1 + nt + turns):
        for k in range(6):
            if r.contact_body[2 * c] < 0:
                jac[12 * row + k] = 0.0
            if r.contact_body[2 * c + 1] < 0:
                jac[12 * row + 6 + k] = 0.0


cdef inline void minv_times(const double* jac, const double* inv_mass, const double* inv_inertia, int32_t a,
                            int32_t b, double* out) noexcept nogil:
    # M^-1 J^T of one row, in the layout of joint rows.
    cdef int32_t k
    for k in range(12):
        out[k] = 0.0
    if a >= 0:
        for k in range(3):
            out[k] = inv_mass[a] * jac[k]
            out[3 + k] = dot3(inv_inertia + 9 * a + 3 * k, jac + 3)
    if b >= 0:
        for k in range(3):
            out[6 + k] = inv_mass[b] * jac[6 + k]
            out[9 + k] = dot3(inv_inertia + 9 * b + 3 * k, jac + 9)


cdef inline void contact_diagonal(const double* normal, const double* tangent, const double* arm_a,
                                  const double* arm_b,
                                  int32_t nt, int32_t turns, int32_t a, int32_t b, const double* inv_mass,
                                  const double* inv_inertia, double* d, double* off, double* coupling,
                                  double* swing) noexcept nogil:
    """A among the rows of one contact, without compliance: diagonal d (1 + nt + turns), off = A_t1t2 and
    A_r1r2, coupling (5).

    And swing (1 + nt + turns, 6): I_a^-1 (arm_a x axis), I_b^-1 (arm_b x axis) of each row, 0 where static.

    With l = arm x axis (for spin l = n, for one that rolls l = t), A_pq = (sum 1/m) p.q + sum l_p . I^-1 l_q over both bodies.
    """
    cdef double axis[12]        # n, t1, t2
    cdef double l[9]
    cdef double k[9]
    cdef double ks[3]
    cdef double m = 0.0
    cdef const double* arm
    cdef const double* inv
    cdef int32_t side, body, i, q, roll = 1 + nt + (turns & 1)
    for i in range(3):
        axis[i] = normal[i]
    if nt > 0:
        for i in range(3):
            axis[3 + i] = tangent[i]
    if nt > 1:
        cross(normal, tangent, axis + 6)
    for i in range(1 + nt + turns):
        d[i] = 0.0
    for i in range(6 * (1 + nt + turns)):
        swing[i] = 0.0
    off[0] = off[1] = 0.0
    if nt + turns > 0:
        for i in range(5):
            coupling[i] = 0.0
    for side in range(2):
        body = a if side == 0 else b
        if body < 0:
            continue
        arm = arm_a if side == 0 else arm_b
        inv = inv_inertia + 9 * body
        m += inv_mass[body]
        for i in range(1 + nt):
            cross(arm, axis + 3 * i, l + 3 * i)
            for q in range(3):
                k[3 * i + q] = dot3(inv + 3 * q, l + 3 * i)
                swing[6 * i + 3 * side + q] = k[3 * i + q]
            d[i] += dot3(l + 3 * i, k + 3 * i)
        if nt > 0:
            coupling[0] += dot3(l + 3, k)
        if nt > 1:
            coupling[1] += dot3(l + 6, k)
            off[0] += dot3(l + 3, k + 6)
        if turns & 1:
            for q in range(3):
                ks[q] = dot3(inv + 3 * q, normal)
                swing[6 * (1 + nt) + 3 * side + q] = ks[q]
            d[1 + nt] += dot3(normal, ks)
            coupling[2] += dot3(normal, k)
            for i in range(nt):
                coupling[3 + i] += dot3(normal, k + 3 + 3 * i)
        if turns & 2:
            for i in range(2):
                for q in range(3):
                    ks[q] = dot3(inv + 3 * q, axis + 3 + 3 * i)
                    swing[6 * (roll + i) + 3 * side + q] = ks[q]
                d[roll + i] += dot3(axis + 3 + 3 * i, ks)
            off[1] += dot3(axis + 3, ks)
    for i in range(1 + nt):
        d[i] += m * dot3(axis + 3 * i, axis + 3 * i)
    if nt > 0:
        coupling[0] += m * dot3(axis + 3, axis)
    if nt > 1:
        coupling[1] += m * dot3(axis + 6, axis)
        off[0] += m * dot3(axis + 3, axis + 6)


cdef inline double reciprocal(double x) noexcept nogil:
    # 1 / d; 0 of a row that nothing moves
    return 1.0 / x if x > 0.0 else 0.0


cdef inline double largest_eigenvalue(double a, double b, double c) noexcept nogil:
    # of [[a, b], [b, c]]
    cdef double h = 0.5 * (a - c)
    return 0.5 * (a + c) + sqrt(h * h + b * b)


cdef inline double dot6(const double* x, const double* y) noexcept nogil:
    return ((x[0] * y[0] + x[1] * y[1]) + (x[2] * y[2] + x[3] * y[3])) + (x[4] * y[4] + x[5] * y[5])


cdef inline double dot12(const double* x, const double* y) noexcept nogil:
    cdef double s = 0.0
    cdef int32_t k
    for k in range(12):
        s += x[k] * y[k]
    return s
