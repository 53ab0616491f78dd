"""The factored form of A: rows of joints, contacts stored by normal, tangent and arms, and the bodies on which these act.

A body's velocity is six numbers (linear [m/s], angular [rad/s]). Body -1 is static: its velocity is zero and is never
written. Relative velocity at a contact, from body a to body b:

    u = (v_b + omega_b x arm_b) - (v_a + omega_a x arm_a)                                      (1)
    w_n = n.u,  w_t = t.u with t2 = n x t1,  w_s = n.(omega_b - omega_a),  w_r = t.(omega_b - omega_a)  (2)

An impulse P [N s] with an angular impulse s [N m s] along n (rolling rows: along t) changes

    v_b += P / m_b,  omega_b += I_b^-1 (arm_b x P + s n),  and the opposite on a.              (3)

The update of a contact in a sweep is in core/contact.pxd.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport blocks_t, count_angular_rows, count_tangent_rows
from lavender_ext.core.view cimport rows_t


cdef inline double dot3(const double* a, const double* b) noexcept nogil:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


cdef inline void cross(const double* a, const double* b, double* out) noexcept nogil:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


cdef inline void compute_relative_velocity(const double* v, int32_t a, int32_t b, const double* arm_a, const double* arm_b,
                                           double* u, double* spin) noexcept nogil:
    """Compute the relative velocity u (1), and omega_b - omega_a in `spin`."""
    cdef const double* x
    cdef int32_t k
    for k in range(3):
        u[k] = spin[k] = 0.0
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


cdef inline void apply_impulse_to_body(double* v, double inv_mass, const double* inv_inertia, const double* arm,
                                       const double* impulse, double sign) noexcept nogil:
    """Apply an impulse to one body by (3) without s. `sign` is -1 for body a, 1 for body b."""
    cdef double l[3]
    cdef int32_t k
    cross(arm, impulse, l)
    for k in range(3):
        l[k] = sign * l[k]
        v[k] += sign * inv_mass * impulse[k]
    for k in range(3):
        v[3 + k] += dot3(inv_inertia + 3 * k, l)


cdef inline double joint_row_velocity(const double* jac, const double* v, int32_t a, int32_t b) noexcept nogil:
    """Return the product of one joint row (12) with the velocities of its bodies."""
    cdef double s = 0.0, t = 0.0
    cdef int32_t k
    if a >= 0:
        for k in range(6):
            s += jac[k] * v[6 * a + k]
    if b >= 0:
        for k in range(6):
            t += jac[6 + k] * v[6 * b + k]
    return s + t


cdef inline void apply_joint_impulse(const double* minv_jac, double change, double* v, int32_t a, int32_t b) noexcept nogil:
    """Apply the impulse change of one joint row to the velocities of its bodies."""
    cdef int32_t k
    if a >= 0:
        for k in range(6):
            v[6 * a + k] += change * minv_jac[k]
    if b >= 0:
        for k in range(6):
            v[6 * b + k] += change * minv_jac[6 + k]


cdef inline void compute_contact_velocity(const rows_t* r, int32_t c, int32_t nt, int32_t n_angular, const double* v,
                                          double* w) noexcept nogil:
    """Compute the relative velocities w of the rows of one contact by (2), its rows of J v."""
    cdef double u[3]
    cdef double omega[3]
    cdef double t2[3]
    cdef const double* n = r.normal + 3 * c
    compute_relative_velocity(v, r.contact_body[2 * c], r.contact_body[2 * c + 1], r.arm_a + 3 * c,
                      r.arm_b + 3 * c, u, omega)
    w[0] = dot3(n, u)
    if nt > 0:
        w[1] = dot3(r.tangent + 3 * c, u)
    if nt == 2:
        cross(n, r.tangent + 3 * c, t2)
        w[2] = dot3(t2, u)
    if n_angular & 1:
        w[1 + nt] = dot3(n, omega)
    if n_angular & 2:
        w[1 + nt + (n_angular & 1)] = dot3(r.tangent + 3 * c, omega)
        w[2 + nt + (n_angular & 1)] = dot3(t2, omega)


cdef inline void multiply_jacobian(const blocks_t* p, const rows_t* r, const double* v, double* out) noexcept nogil:
    """Compute out (m) = J v for v (n, 6)."""
    cdef int32_t i, j, c
    for i in range(r.n_joints):
        for j in range(p.ptr[i], p.ptr[i + 1]):
            out[j] = joint_row_velocity(r.jac + 12 * j, v, r.joint_body[2 * i], r.joint_body[2 * i + 1])
    for c in range(r.n_contacts):
        i = r.n_joints + c
        compute_contact_velocity(r, c, count_tangent_rows(p, i), count_angular_rows(p, i), v, out + p.ptr[i])


cdef inline void form_contact_jacobian(const rows_t* r, int32_t c, int32_t nt, int32_t n_angular, double* jac) noexcept nogil:
    """Write the rows of one contact (1 + nt + n_angular, 12) in the layout of joint rows; columns of static bodies are zero."""
    cdef const double* n = r.normal + 3 * c
    cdef const double* t1 = r.tangent + 3 * c
    cdef const double* axis
    cdef double t2[3]
    cdef double moment[3]
    cdef double sign
    cdef int32_t row, side, k, first = nt + 1 + (n_angular & 1)         # first: the first row of rolling
    if nt > 1:
        cross(n, t1, t2)
    for row in range(1 + nt + n_angular):
        # Spin is about n, rolling about t1 and t2.
        axis = n if row == 0 or nt < row < first else t1 if row == 1 or row == first else t2
        for side in range(2):
            sign = 1.0 if side else -1.0
            if r.contact_body[2 * c + side] < 0:
                for k in range(6):
                    jac[k] = 0.0
            elif row > nt:
                for k in range(3):
                    jac[k] = 0.0
                    jac[3 + k] = sign * axis[k]
            else:
                cross((r.arm_b if side else r.arm_a) + 3 * c, axis, moment)
                for k in range(3):
                    jac[k] = sign * axis[k]
                    jac[3 + k] = sign * moment[k]
            jac += 6


cdef inline const double* get_block_jacobian(const blocks_t* p, const rows_t* r, int32_t i, double* scratch) noexcept nogil:
    """Return the rows of J (12 each) of block i: those of a joint, or those of a contact, written to scratch (72)."""
    if i < r.n_joints:
        return r.jac + 12 * p.ptr[i]
    cdef int32_t nt = count_tangent_rows(p, i), n_angular = count_angular_rows(p, i)
    if n_angular == 0 and nt == 2:                          # The two common kinds are compiled with constant sizes.
        form_contact_jacobian(r, i - r.n_joints, 2, 0, scratch)
    elif n_angular == 0 and nt == 0:
        form_contact_jacobian(r, i - r.n_joints, 0, 0, scratch)
    else:
        form_contact_jacobian(r, i - r.n_joints, nt, n_angular, scratch)
    return scratch


cdef inline void multiply_inverse_mass(const double* jac, const double* inv_mass, const double* inv_inertia, int32_t a,
                                       int32_t b, double* out) noexcept nogil:
    """Compute M^-1 J^T of one row in the layout of joint rows."""
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


cdef inline void compute_contact_delassus_block(const double* normal, const double* tangent, const double* arm_a,
                                                const double* arm_b, int32_t nt, int32_t n_angular, int32_t a, int32_t b,
                                                const double* inv_mass, const double* inv_inertia, double* d, double* off,
                                                double* coupling, double* inv_inertia_arm) noexcept nogil:
    """Compute the block of A of one contact, without compliance.

    d (1 + nt + n_angular) is its diagonal, off = (A_t1t2, A_r1r2), coupling (5) as in `rows_t`. inv_inertia_arm
    (1 + nt + n_angular, 6) receives I_a^-1 (arm_a x axis) and I_b^-1 (arm_b x axis) of each row, 0 for a static body.

    With l = arm x axis (l = n for spin, l = t for rolling), A_pq = (sum 1/m) p.q + sum l_p . I^-1 l_q over both bodies.
    """
    cdef double axis[12]        # n, t1, t2
    cdef double l[9]
    cdef double k[9]
    cdef double ks[3]
    cdef double m = 0.0
    cdef const double* arm
    cdef const double* inv
    cdef int32_t side, body, i, q, roll = 1 + nt + (n_angular & 1)
    for i in range(3):
        axis[i] = normal[i]
    if nt > 0:
        for i in range(3):
            axis[3 + i] = tangent[i]
    if nt > 1:
        cross(normal, tangent, axis + 6)
    for i in range(1 + nt + n_angular):
        d[i] = 0.0
    for i in range(6 * (1 + nt + n_angular)):
        inv_inertia_arm[i] = 0.0
    off[0] = off[1] = 0.0
    if nt + n_angular > 0:
        for i in range(5):
            coupling[i] = 0.0
    for side in range(2):
        body = a if side == 0 else b
        if body < 0:
            continue
        arm = arm_a if side == 0 else arm_b
        inv = inv_inertia + 9 * body
        m += inv_mass[body]
        # normal and tangents
        for i in range(1 + nt):
            cross(arm, axis + 3 * i, l + 3 * i)
            for q in range(3):
                k[3 * i + q] = dot3(inv + 3 * q, l + 3 * i)
                inv_inertia_arm[6 * i + 3 * side + q] = k[3 * i + q]
            d[i] += dot3(l + 3 * i, k + 3 * i)
        if nt > 0:
            coupling[0] += dot3(l + 3, k)
        if nt > 1:
            coupling[1] += dot3(l + 6, k)
            off[0] += dot3(l + 3, k + 6)
        # spin
        if n_angular & 1:
            for q in range(3):
                ks[q] = dot3(inv + 3 * q, normal)
                inv_inertia_arm[6 * (1 + nt) + 3 * side + q] = ks[q]
            d[1 + nt] += dot3(normal, ks)
            coupling[2] += dot3(normal, k)
            for i in range(nt):
                coupling[3 + i] += dot3(normal, k + 3 + 3 * i)
        # rolling
        if n_angular & 2:
            for i in range(2):
                for q in range(3):
                    ks[q] = dot3(inv + 3 * q, axis + 3 + 3 * i)
                    inv_inertia_arm[6 * (roll + i) + 3 * side + q] = ks[q]
                d[roll + i] += dot3(axis + 3 + 3 * i, ks)
            off[1] += dot3(axis + 3, ks)
    # linear terms
    for i in range(1 + nt):
        d[i] += m * dot3(axis + 3 * i, axis + 3 * i)
    if nt > 0:
        coupling[0] += m * dot3(axis + 3, axis)
    if nt > 1:
        coupling[1] += m * dot3(axis + 6, axis)
        off[0] += m * dot3(axis + 3, axis + 6)


cdef inline double reciprocal_or_zero(double x) noexcept nogil:
    """Return 1 / x, or 0 if x is not positive, as for a row that no impulse moves."""
    return 1.0 / x if x > 0.0 else 0.0


cdef inline double largest_eigenvalue_2x2(double a, double b, double c) noexcept nogil:
    """Return the largest eigenvalue of [[a, b], [b, c]]."""
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
