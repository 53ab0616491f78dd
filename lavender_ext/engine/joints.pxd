"""Joints: rows of the velocity problem from the poses, rigid or soft.

    distance   1 row    n.(p_b - p_a) = length, n the unit vector between the anchors
    ball       3 rows   p_b = p_a
    hinge      5 rows   ball, and the axis of b normal to two sides of a;  with a motor a 6th row, bounded:
                        axis.(omega_b - omega_a) = speed, |impulse| <= h torque

With C the errors of the rows [m or rad] and h the substep, the bodies move in circles, so that the error at the end of the
substep is not C + h J v but, with omega x (omega x arm) of both anchors in the second derivative C'',

    C + h J v + h^2/2 C''                                                                      (1)

A rigid row keeps its error to second order: its target is -h/2 C''. The impulse then turns the velocity of a body on a circle
as much before as after the tangent, and a pendulum neither gains nor loses energy from it (Ryckaert, Ciccotti, Berendsen
1977). Without the term it loses the fraction (h omega)^2 of its energy in a substep. The position projection removes C. In a closed
loop it leaves about 1e-6 m of C, so that rows which depend on the others do so no longer and resist every motion of the loop.
For solvers that solve all rows, the rigid joints of loops therefore have a compliance of S_JOINT_GIVE times the mean d of the
linear rows, or of the angular rows: their sums are the same in all axes.

A soft joint of frequency f and damping ratio zeta is a damped spring on the effective mass A^-1 of its block of rows,
integrated implicitly (Catto 2011). Its rows are combined so that the block is diagonal: the angular rows along the principal
axes of their part of A, and the linear rows without the motion that the angular rows exert, along the principal axes of the
rest (Schur complement). Each combined row is then an oscillator of its own, m = 1/A_ii, in any axes of the world,

    k = m (2 pi f)^2,  c = 2 m zeta (2 pi f),  compliance = 1/(h (c + h k)),
    target = -(C + h^2/2 C'') k / (c + h k)                                                    (2)

`joint_impulse` holds the impulses of all joints in the rows above: the three world axes, then the two sides.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.validate cimport min_magnitude
from lavender_ext.core.block_types cimport ROW
from lavender_ext.core.rows cimport cross, dot3, dot12, joint_row_velocity, multiply_inverse_mass, reciprocal_or_zero
from lavender_ext.engine.arrays cimport (BALL, DISTANCE, HINGE, H_WARM_START, J_ANCHOR_A, J_ANCHOR_B,
                                         J_AXIS_A, J_AXIS_B, J_DAMPING, J_HERTZ, J_LENGTH, J_LOOP, J_SIDE_A, J_SPEED,
                                         J_TORQUE, N_JOINT, N_JOINT_REAL, ROWS_PER_CONTACT, S_H, S_JOINT_GIVE, engine_t)
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


cdef inline void add_anchor_motion(const engine_t* e, const double* v, int32_t body, const double* local, double sign,
                                   double* point, double* velocity, double* acceleration) noexcept nogil:
    """Add sign times an anchor's point, velocity and acceleration omega x (omega x arm); v (nd, 6) of the bodies."""
    cdef double arm[3]
    cdef double x[3]
    cdef double moving[3]
    cdef int32_t i = e.dyn[body] if body >= 0 else -1
    compute_world_anchor(e, body, local, arm, x)
    add_scaled3(point, sign, x, point)
    if i < 0:
        return
    cross(v + 6 * i + 3, arm, moving)
    cross(v + 6 * i + 3, moving, x)
    add_scaled3(acceleration, sign, x, acceleration)
    add_scaled3(velocity, sign, v + 6 * i, velocity)
    add_scaled3(velocity, sign, moving, velocity)


cdef inline int32_t compute_row_curvature(const engine_t* e, int32_t i, const double* v, double* curvature) noexcept nogil:
    """Compute C'' (3) [m/s^2] of the linear rows of joint i at the velocities v (nd, 6); return their number."""
    cdef const double* p = e.joint + N_JOINT_REAL * i
    cdef const double* axis = e.jac + 12 * e.ptr[i] + 6
    cdef double apart[3]
    cdef double velocity[3]
    cdef double length, along
    cdef int32_t k
    for k in range(3):
        curvature[k] = apart[k] = velocity[k] = 0.0
    add_anchor_motion(e, v, e.joint_bodies[2 * i], p + J_ANCHOR_A, -1.0, apart, velocity, curvature)
    add_anchor_motion(e, v, e.joint_bodies[2 * i + 1], p + J_ANCHOR_B, 1.0, apart, velocity, curvature)
    if e.joint_kind[i] != DISTANCE:
        return 3
    # The line between the anchors turns.
    along = dot3(axis, velocity)
    length = sqrt(dot3(apart, apart))
    curvature[0] = dot3(axis, curvature)
    if length > min_magnitude():
        curvature[0] += (dot3(velocity, velocity) - along * along) / length
    return 1


cdef inline void find_principal_axes(int32_t n, double* a, double* axes) noexcept nogil:
    """Compute orthonormal eigenvectors, the columns of axes (n, n), of a symmetric matrix a (n, n), n <= 3.

    Jacobi's method; `a` becomes diagonal. An entry that rounding alone may have caused is treated as zero.
    """
    cdef int32_t i, j, k, _sweep
    cdef double t, c, s, x, y
    for i in range(n):
        for j in range(n):
            axes[n * i + j] = 1.0 if i == j else 0.0
    for _sweep in range(10):
        for i in range(n - 1):
            for j in range(i + 1, n):
                if fabs(a[n * i + j]) <= 1e-15 * (fabs(a[n * i + i]) + fabs(a[n * j + j])):
                    a[n * i + j] = a[n * j + i] = 0.0
                    continue
                t = (a[n * j + j] - a[n * i + i]) / (2.0 * a[n * i + j])
                t = (1.0 if t >= 0.0 else -1.0) / (fabs(t) + sqrt(t * t + 1.0))
                c = 1.0 / sqrt(t * t + 1.0)
                s = t * c
                for k in range(n):                      # columns i and j of `a` and of the axes
                    x = a[n * k + i]
                    y = a[n * k + j]
                    a[n * k + i] = c * x - s * y
                    a[n * k + j] = s * x + c * y
                    x = axes[n * k + i]
                    y = axes[n * k + j]
                    axes[n * k + i] = c * x - s * y
                    axes[n * k + j] = s * x + c * y
                for k in range(n):                      # rows i and j
                    x = a[n * i + k]
                    y = a[n * j + k]
                    a[n * i + k] = c * x - s * y
                    a[n * j + k] = s * x + c * y


cdef inline void turn_rows_to_principal_axes(engine_t* e, int32_t row, int32_t n) noexcept nogil:
    """Replace n <= 3 joint rows from `row` on by the combinations along the principal axes of their block of A."""
    cdef double block[9]
    cdef double axes[9]
    cdef double old[3]
    cdef int32_t i, j, k
    for i in range(n):
        for j in range(i, n):
            block[n * i + j] = block[n * j + i] = dot12(e.jac + 12 * (row + i), e.minv_jac + 12 * (row + j))
    find_principal_axes(n, block, axes)
    for k in range(25):                                 # 12 columns of J, 12 of M^-1 J^T, and the errors
        for i in range(n):
            old[i] = (e.jac[12 * (row + i) + k] if k < 12 else e.minv_jac[12 * (row + i) + k - 12] if k < 24
                      else e.joint_error[row + i])
        for i in range(n):
            block[i] = 0.0
            for j in range(n):
                block[i] += axes[n * j + i] * old[j]
            if k < 12:
                e.jac[12 * (row + i) + k] = block[i]
            elif k < 24:
                e.minv_jac[12 * (row + i) + k - 12] = block[i]
            else:
                e.joint_error[row + i] = block[i]


cdef inline void subtract_multiple_12(double* x, double factor, const double* y) noexcept nogil:
    """Subtract factor * y (12) from x (12)."""
    cdef int32_t k
    for k in range(12):
        x[k] -= factor * y[k]


cdef inline void decouple_soft_rows(engine_t* e, int32_t i) noexcept nogil:
    """Combine the rows of a soft ball or hinge joint, with M^-1 J^T, so that its block of A is diagonal."""
    cdef int32_t row = e.ptr[i], j, k
    cdef double share
    cdef double* x
    if e.joint_kind[i] == HINGE:
        turn_rows_to_principal_axes(e, row + 3, 2)
        for j in range(row + 3, row + 5):
            for k in range(row, row + 3):               # The linear row k exerts nothing on the angular row j.
                x = e.minv_jac + 12 * j
                share = dot12(e.jac + 12 * k, x) * reciprocal_or_zero(dot12(e.jac + 12 * j, x))
                subtract_multiple_12(e.jac + 12 * k, share, e.jac + 12 * j)
                subtract_multiple_12(e.minv_jac + 12 * k, share, x)
                e.joint_error[k] -= share * e.joint_error[j]
    turn_rows_to_principal_axes(e, row, 3)


cdef inline int32_t has_combined_rows(const engine_t* e, int32_t i) noexcept nogil:
    """Return whether the rows of joint i are combinations of the rows of its kind."""
    return e.joint_kind[i] != DISTANCE and e.joint[N_JOINT_REAL * i + J_HERTZ] > 0.0


cdef inline void compute_joint_sides(const engine_t* e, int32_t i, double* arm_b, double* side, double* other) noexcept nogil:
    """Compute the arm of b and both sides of a hinge in the world frame."""
    cdef const double* p = e.joint + N_JOINT_REAL * i
    rotate_direction_to_world(e, e.joint_bodies[2 * i + 1], p + J_ANCHOR_B, arm_b)
    rotate_direction_to_world(e, e.joint_bodies[2 * i], p + J_AXIS_A, arm_b + 3)
    rotate_direction_to_world(e, e.joint_bodies[2 * i], p + J_SIDE_A, side)
    cross(arm_b + 3, side, other)


cdef inline void start_combined_rows(engine_t* e, int32_t i) noexcept nogil:
    """Write the warm start of combined rows: the impulses that exert the force and the moment of joint_impulse."""
    cdef int32_t row = e.ptr[i], j, k
    cdef const double* raw = e.joint_impulse + row
    cdef double arm[6]
    cdef double side[3]
    cdef double other[3]
    cdef double moment[3]
    compute_joint_sides(e, i, arm, side, other)
    cross(arm, raw, moment)
    for k in range(3):
        e.impulse[row + k] = dot3(e.jac + 12 * (row + k) + 6, raw)
    if e.joint_kind[i] != HINGE:
        return
    add_scaled3(moment, raw[3], side, moment)
    add_scaled3(moment, raw[4], other, moment)
    for k in range(3):
        add_scaled3(moment, -e.impulse[row + k], e.jac + 12 * (row + k) + 9, moment)
    for j in range(3, 5):
        e.impulse[row + j] = dot3(e.jac + 12 * (row + j) + 9, moment)


cdef inline void store_joint_impulses(engine_t* e) noexcept nogil:
    """Write the impulses of the solve to joint_impulse, in the rows of each joint's kind."""
    cdef int32_t i, j, k, row
    cdef double arm[6]
    cdef double side[3]
    cdef double other[3]
    cdef double moment[3]
    cdef double* raw
    for i in range(e.size[N_JOINT]):
        row = e.ptr[i]
        raw = e.joint_impulse + row
        for j in range(e.ptr[i + 1] - row):
            raw[j] = e.impulse[row + j]
        if not has_combined_rows(e, i):
            continue
        for k in range(3):
            raw[k] = moment[k] = 0.0
        for j in range(3):
            add_scaled3(raw, e.impulse[row + j], e.jac + 12 * (row + j) + 6, raw)
        if e.joint_kind[i] != HINGE:
            continue
        compute_joint_sides(e, i, arm, side, other)
        cross(raw, arm, moment)
        for j in range(5):
            add_scaled3(moment, e.impulse[row + j], e.jac + 12 * (row + j) + 9, moment)
        raw[3] = dot3(side, moment)
        raw[4] = dot3(other, moment)


cdef inline void give_rows(engine_t* e, int32_t first, int32_t n) noexcept nogil:
    """Give n rows from `first` on a compliance of S_JOINT_GIVE times the mean of their d."""
    cdef int32_t row
    cdef double total = 0.0
    for row in range(first, first + n):
        total += dot12(e.jac + 12 * row, e.minv_jac + 12 * row)
    for row in range(first, first + n):
        e.compliance[row] = e.setting[S_JOINT_GIVE] * total / n


cdef inline void build_joint_rows(engine_t* e) noexcept nogil:
    """Build rows, diagonal, compliance, right-hand side and warm start of all joints; e.v_free holds v*."""
    cdef int32_t i, row, a, b, k, n_linear
    cdef double h = e.setting[S_H], omega, stiffness, c, d, inf = 1.0 / 0.0
    cdef double curvature[3]
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
            e.compliance[row] = e.target[row] = 0.0
            e.impulse[row] = e.joint_impulse[row] if e.head[H_WARM_START] else 0.0
        n_linear = compute_row_curvature(e, i, e.v_free, curvature)
        for k in range(n_linear):
            row = e.ptr[i] + k
            if p[J_HERTZ] > 0.0:
                e.joint_error[row] += 0.5 * h * h * curvature[k]    # (1)
            else:
                e.target[row] = -0.5 * h * curvature[k]
        if has_combined_rows(e, i):
            decouple_soft_rows(e, i)
            if e.head[H_WARM_START]:
                start_combined_rows(e, i)
        if e.setting[S_JOINT_GIVE] * p[J_LOOP] > 0.0:
            give_rows(e, e.ptr[i], n_linear)
            if e.joint_kind[i] == HINGE:
                give_rows(e, e.ptr[i] + 3, 2)
        for row in range(e.ptr[i], e.ptr[i + 1]):
            d = dot12(e.jac + 12 * row, e.minv_jac + 12 * row)
            e.lower[row] = -inf
            e.upper[row] = inf
            if e.joint_motor[i] and row == e.ptr[i + 1] - 1:
                e.lower[row] = -h * p[J_TORQUE]
                e.upper[row] = h * p[J_TORQUE]
                e.target[row] = p[J_SPEED]
            elif p[J_HERTZ] > 0.0 and d > 0.0:          # (2)
                omega = 6.283185307179586 * p[J_HERTZ]
                stiffness = omega * omega / d
                c = 2.0 * p[J_DAMPING] * omega / d
                e.compliance[row] = 1.0 / (h * (c + h * stiffness))
                e.target[row] = -e.joint_error[row] * stiffness / (c + h * stiffness)
            e.d[row] = d + e.compliance[row]
            e.step[row] = reciprocal_or_zero(e.d[row])
            e.b[row] = e.target[row] - joint_row_velocity(e.jac + 12 * row, e.v_free, a, b)
