"""Joints: rows of the velocity problem from the poses, rigid or soft.

    distance   1 row    n.(p_b - p_a) = length, n the unit vector between the anchors
    ball       3 rows   p_b = p_a
    hinge      5 rows   ball, and the axis of b normal to two sides of a;  with a motor a 6th row, bounded:
                        axis.(omega_b - omega_a) = speed, |impulse| <= h torque

With C the error of a row [m or rad] and f, zeta its frequency [Hz] and damping ratio, a soft row is a
damped spring on the effective mass m = 1/A_ii, integrated implicitly (Catto 2011):

    k = m (2 pi f)^2,  c = 2 m zeta (2 pi f),  compliance = 1/(h (c + h k)),
    target = -C k / (c + h k)                                                                  (1)

A rigid row has target 0; the position projection removes its error.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.validate cimport min_magnitude
from lavender_ext.core.block_types cimport ROW
from lavender_ext.core.rows cimport cross, dot3, dot12, joint_row_velocity, multiply_inverse_mass, reciprocal_or_zero
from lavender_ext.engine.arrays cimport (BALL, DISTANCE, H_WARM_START, J_ANCHOR_A, J_ANCHOR_B,
                                         J_AXIS_A, J_AXIS_B, J_DAMPING, J_HERTZ, J_LENGTH, J_SIDE_A, J_SPEED,
                                         J_TORQUE, N_JOINT, N_JOINT_REAL, ROWS_PER_CONTACT, S_H, engine_t)
from lavender_ext.engine.bodies cimport rotate_to_world
from lavender_ext.core.vectors cimport copy3, subtract3, add_scaled3, scale3


cdef inline void rotate_direction_to_world(const engine_t* e, int32_t body, const double* local, double* out) noexcept nogil:
    """Rotate a direction from a body's frame to the world; body -1 is the world."""
    if body < 0:
        copy3(local, out)
    else:
        rotate_to_world(e.rot + 9 * body, local, out)


cdef inline void compute_world_anchor(const engine_t* e, int32_t body, const double* local, double* arm,
                                      double* point) noexcept nogil:
    """Compute an anchor's arm from the body's centre and its point, both in the world frame."""
    rotate_direction_to_world(e, body, local, arm)
    if body < 0:
        copy3(arm, point)
    else:
        add_scaled3(e.x + 3 * body, 1.0, arm, point)


cdef inline void fill_linear_jacobian_row(double* jac, const double* axis, const double* arm_a,
                                          const double* arm_b) noexcept nogil:
    """Fill the Jacobian row (12) of axis.(v_b + omega_b x arm_b - v_a - omega_a x arm_a)."""
    scale3(-1.0, axis, jac)
    cross(arm_a, axis, jac + 3)
    scale3(-1.0, jac + 3, jac + 3)
    copy3(axis, jac + 6)
    cross(arm_b, axis, jac + 9)


cdef inline void fill_angular_jacobian_row(double* jac, const double* axis) noexcept nogil:
    """Fill the Jacobian row (12) of axis.(omega_b - omega_a)."""
    cdef int32_t k
    for k in range(3):
        jac[k] = 0.0
        jac[3 + k] = -axis[k]
        jac[6 + k] = 0.0
        jac[9 + k] = axis[k]


cdef inline void compute_joint_geometry(engine_t* e, int32_t i) noexcept nogil:
    """Compute the Jacobian rows and errors of joint i at the current poses."""
    cdef const double* p = e.joint + N_JOINT_REAL * i
    cdef int32_t a = e.joint_bodies[2 * i], b = e.joint_bodies[2 * i + 1], row = e.ptr[i], k
    cdef double arm_a[3]
    cdef double arm_b[3]
    cdef double pa[3]
    cdef double pb[3]
    cdef double axis[3]
    cdef double other[3]
    cdef double side[3]
    cdef double length
    compute_world_anchor(e, a, p + J_ANCHOR_A, arm_a, pa)
    compute_world_anchor(e, b, p + J_ANCHOR_B, arm_b, pb)
    # distance: one row along the line between the anchors
    if e.joint_kind[i] == DISTANCE:
        subtract3(pb, pa, axis)
        length = sqrt(dot3(axis, axis))
        if length > min_magnitude():
            for k in range(3):
                axis[k] = axis[k] / length
        else:
            axis[0] = axis[1] = 0.0
            axis[2] = 1.0
        fill_linear_jacobian_row(e.jac + 12 * row, axis, arm_a, arm_b)
        e.joint_error[row] = length - p[J_LENGTH]
        return
    # ball: the three world axes
    for k in range(3):
        axis[0] = axis[1] = axis[2] = 0.0
        axis[k] = 1.0
        fill_linear_jacobian_row(e.jac + 12 * (row + k), axis, arm_a, arm_b)
        e.joint_error[row + k] = pb[k] - pa[k]
    if e.joint_kind[i] == BALL:
        return
    # hinge: two angular rows normal to the axis
    rotate_direction_to_world(e, a, p + J_AXIS_A, axis)
    rotate_direction_to_world(e, b, p + J_AXIS_B, other)
    rotate_direction_to_world(e, a, p + J_SIDE_A, side)
    fill_angular_jacobian_row(e.jac + 12 * (row + 3), side)
    cross(axis, side, pa)
    fill_angular_jacobian_row(e.jac + 12 * (row + 4), pa)
    cross(axis, other, pb)                              # rotation vector from axis_a to axis_b
    e.joint_error[row + 3] = dot3(pb, side)
    e.joint_error[row + 4] = dot3(pb, pa)
    # motor: relative angular velocity about the axis
    if e.joint_motor[i]:
        fill_angular_jacobian_row(e.jac + 12 * (row + 5), axis)
        e.joint_error[row + 5] = 0.0


cdef inline void build_joint_rows(engine_t* e) noexcept nogil:
    """Build rows, diagonal, compliance, right-hand side and warm start of all joints."""
    cdef int32_t i, row, a, b
    cdef double h = e.setting[S_H], omega, k, c, d, inf = 1.0 / 0.0
    cdef const double* p
    for i in range(e.size[N_JOINT]):
        p = e.joint + N_JOINT_REAL * i
        a = e.joint_body[2 * i]
        b = e.joint_body[2 * i + 1]
        compute_joint_geometry(e, i)
        e.kind[i] = ROW
        e.mu[i] = e.patch_radius[i] = 0.0
        if e.size[ROWS_PER_CONTACT] > 4:
            e.rolling[i] = 0.0
        for row in range(e.ptr[i], e.ptr[i + 1]):
            multiply_inverse_mass(e.jac + 12 * row, e.inv_mass, e.inv_inertia, a, b, e.minv_jac + 12 * row)
            d = dot12(e.jac + 12 * row, e.minv_jac + 12 * row)
            e.lower[row] = -inf
            e.upper[row] = inf
            e.compliance[row] = e.target[row] = 0.0
            if e.joint_motor[i] and row == e.ptr[i + 1] - 1:
                e.lower[row] = -h * p[J_TORQUE]
                e.upper[row] = h * p[J_TORQUE]
                e.target[row] = p[J_SPEED]
            elif p[J_HERTZ] > 0.0 and d > 0.0:          # (1)
                omega = 6.283185307179586 * p[J_HERTZ]
                k = omega * omega / d
                c = 2.0 * p[J_DAMPING] * omega / d
                e.compliance[row] = 1.0 / (h * (c + h * k))
                e.target[row] = -e.joint_error[row] * k / (c + h * k)
            e.d[row] = d + e.compliance[row]
            e.step[row] = reciprocal_or_zero(e.d[row])
            e.b[row] = e.target[row] - joint_row_velocity(e.jac + 12 * row, e.v_free, a, b)
            e.impulse[row] = e.joint_impulse[row] if e.head[H_WARM_START] else 0.0
