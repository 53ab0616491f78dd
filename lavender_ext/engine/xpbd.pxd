"""Positions corrected constraint by constraint, velocities from positions (Müller, Macklin, Chentanez, Jeschke, Kim,
"Detailed Rigid Body Simulation with Extended Position Based Dynamics", 2020).

With C a constraint's error at the present poses, n its direction, r the arms, alpha its compliance [1/(N/m)]:

    w = sum over both bodies of 1/m + (r x n).I^-1 (r x n)                                            (1)
    dlambda = (-C - alpha' lambda) / (w + alpha'),   alpha' = alpha / h^2      [kg m]                 (2)
    x <- x +- dlambda n / m,   q <- q +- 1/2 (0, I^-1 (r x dlambda n)) q

The substep:

    1   advance x, q by free flight
    2   sweeps of (2): joints; overlapping contacts; friction as a position error, if it stays inside its disk,
        |lambda_t| <= mu lambda_n
    3   v = (x - x0)/h, omega = 2 (q q0^-1)_xyz / (h (q q0^-1)_w). A body with anisotropic inertia gets the angular
        velocity of free flight plus the rotation from its free-flight pose to its corrected pose, divided by h
    4   loaded contacts: sliding is reduced by at most mu lambda_n, the normal velocity is set to -e v_n(before)

No multiplier is reused in the next substep. A soft joint has alpha = 1/k and a damper, c = 2 m zeta omega on its
effective mass m:  dlambda = (-C - alpha' lambda - g dC) / ((1 + g) w + alpha'),  g = alpha c / h, dC = C - C(x0).
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport clip
from lavender_ext.core.rows cimport cross, dot3, apply_joint_impulse, joint_row_velocity
from lavender_ext.engine.arrays cimport (BOX, DISTANCE, HINGE, H_CONTACTS, H_ITERATIONS, J_ANCHOR_A, J_ANCHOR_B,
                                         J_AXIS_A, J_AXIS_B, J_DAMPING, J_HERTZ, J_LENGTH, N_DYNAMIC, N_JOINT,
                                         N_JOINT_REAL, S_BOUNCE, S_H, engine_t)
from lavender_ext.engine.bodies cimport advance_rotation, compute_rotation_matrix, rotate_to_world, rotate_quaternion
from lavender_ext.engine.contacts cimport initial_normal_velocity, get_pair_restitution
from lavender_ext.engine.projection cimport (
    contact_displacement_along, contact_normal_velocity, apply_contact_impulse, set_normal_impulse,
)
from lavender_ext.engine.vectors cimport copy3, subtract3, normalise3, add_scaled3, scale3, matvec3


cdef inline void rotate_vector_to_world(const engine_t* e, int32_t body, const double* local, double* out) noexcept nogil:
    """Rotate a vector from a body's frame at its current pose to the world; body -1 is the world."""
    cdef double r[9]
    if body < 0:
        copy3(local, out)
    else:
        compute_rotation_matrix(e.q + 4 * body, r)
        rotate_to_world(r, local, out)


cdef inline double generalised_inverse_mass_of_body(const engine_t* e, int32_t dyn, const double* arm,
                                                    const double* n) noexcept nogil:
    """Return one body's contribution to (1); arm NULL: of a rotation about n."""
    cdef double l[3]
    cdef double k[3]
    if dyn < 0:
        return 0.0
    if arm == NULL:
        copy3(n, l)
    else:
        cross(arm, n, l)
    matvec3(e.inv_inertia + 9 * dyn, l, k)
    return dot3(l, k) + (0.0 if arm == NULL else e.inv_mass[dyn] * dot3(n, n))


cdef inline void displace_body(engine_t* e, int32_t body, int32_t dyn, const double* arm, const double* p,
                          double sign) noexcept nogil:
    """Displace a body by p [kg m] at an arm; arm NULL: rotate it by p [kg m^2]."""
    cdef double l[3]
    cdef double k[3]
    if dyn < 0:
        return
    if arm == NULL:
        copy3(p, l)
    else:
        cross(arm, p, l)
        add_scaled3(e.x + 3 * body, sign * e.inv_mass[dyn], p, e.x + 3 * body)
    matvec3(e.inv_inertia + 9 * dyn, l, k)
    scale3(sign, k, k)
    rotate_quaternion(e.q + 4 * body, k, 1.0)


cdef inline double apply_positional_correction(engine_t* e, int32_t i, const double* arm_a, const double* arm_b, const double* n,
                           double error, double before, double lam) noexcept nogil:
    """Apply (2) to joint i along n, b relative to a, and return lambda; `before` is the error at the start of the substep."""
    cdef int32_t a = e.joint_bodies[2 * i], b = e.joint_bodies[2 * i + 1]
    cdef double w = (generalised_inverse_mass_of_body(e, e.joint_body[2 * i], arm_a, n)
                     + generalised_inverse_mass_of_body(e, e.joint_body[2 * i + 1], arm_b, n))
    cdef double h = e.setting[S_H], alpha = 0.0, g = 0.0, omega, x
    cdef double p[3]
    if w <= 0.0:
        return lam
    if e.joint[N_JOINT_REAL * i + J_HERTZ] > 0.0:
        omega = 6.283185307179586 * e.joint[N_JOINT_REAL * i + J_HERTZ]
        alpha = w / (omega * omega)                     # 1/k, k = m omega^2
        g = alpha * 2.0 * e.joint[N_JOINT_REAL * i + J_DAMPING] * omega / w / h
        alpha = alpha / (h * h)
    x = (-error - alpha * lam - g * (error - before)) / ((1.0 + g) * w + alpha)
    scale3(x, n, p)
    displace_body(e, a, e.joint_body[2 * i], arm_a, p, -1.0)
    displace_body(e, b, e.joint_body[2 * i + 1], arm_b, p, 1.0)
    return lam + x


cdef inline void correct_joint_positions(engine_t* e, int32_t i) noexcept nogil:
    """Correct a joint's errors: its length, the separation of its anchors, or for a hinge also the angle of its axes."""
    cdef const double* p = e.joint + N_JOINT_REAL * i
    cdef int32_t a = e.joint_bodies[2 * i], b = e.joint_bodies[2 * i + 1], row = e.ptr[i], k
    cdef double arm_a[3]
    cdef double arm_b[3]
    cdef double n[3]
    cdef double size, initial_error = 0.0
    rotate_vector_to_world(e, a, p + J_ANCHOR_A, arm_a)
    rotate_vector_to_world(e, b, p + J_ANCHOR_B, arm_b)
    for k in range(3):
        n[k] = (e.x[3 * b + k] if b >= 0 else 0.0) + arm_b[k] - (e.x[3 * a + k] if a >= 0 else 0.0) - arm_a[k]
    size = normalise3(n)
    # distance: the length error
    if e.joint_kind[i] == DISTANCE:
        if size > 0.0:
            e.impulse[row] = apply_positional_correction(e, i, arm_a, arm_b, n, size - p[J_LENGTH], e.joint_error[row],
                                                         e.impulse[row])
        return
    # ball: the separation of the anchors; multipliers of the changing direction n are accumulated by world axis
    if size > 0.0:
        for k in range(3):
            initial_error += n[k] * e.joint_error[row + k]
        size = apply_positional_correction(e, i, arm_a, arm_b, n, size, initial_error,
                                           dot3(e.impulse + row, n)) - dot3(e.impulse + row, n)
        add_scaled3(e.impulse + row, size, n, e.impulse + row)
    if e.joint_kind[i] != HINGE:
        return
    # hinge: the rotation between the axes
    rotate_vector_to_world(e, a, p + J_AXIS_A, arm_a)
    rotate_vector_to_world(e, b, p + J_AXIS_B, arm_b)
    cross(arm_a, arm_b, n)                              # rotation vector from axis_a to axis_b: the rotation of b to remove
    size = normalise3(n)
    if size > 0.0:
        apply_positional_correction(e, i, NULL, NULL, n, size, 0.0, 0.0)


cdef inline void compute_rotation_between(const double* q, const double* p, double* out) noexcept nogil:
    """Compute the rotation from p to q as a vector [rad], 2 (q p^-1)_xyz / (q p^-1)_w, the inverse of `rotate_quaternion`."""
    cdef double s = q[0] * p[0] + q[1] * p[1] + q[2] * p[2] + q[3] * p[3]
    s = 2.0 / s if s != 0.0 else 2.0                    # rotation by pi: the vector is infinite
    out[0] = s * (q[1] * p[0] - q[0] * p[1] - q[2] * p[3] + q[3] * p[2])
    out[1] = s * (q[2] * p[0] - q[0] * p[2] - q[3] * p[1] + q[1] * p[3])
    out[2] = s * (q[3] * p[0] - q[0] * p[3] - q[1] * p[2] + q[2] * p[1])


cdef inline void compute_contact_point_displacement(const engine_t* e, int32_t body, int32_t dyn, const double* local,
                                                    const double* arm0,
                       int32_t material, double* arm, double* by) noexcept nogil:
    """Compute the current arm of a contact point and the point's displacement during the substep.

    The arm of a sphere does not rotate with the body. With `material` (for friction) its displacement includes the
    rotation of the material.
    """
    cdef double rotation_vector[3]
    cdef double l[3]
    cdef int32_t k
    for k in range(3):
        arm[k] = arm0[k]
        by[k] = 0.0
    if dyn < 0:
        return
    if e.kind_of_shape[body] == BOX:
        rotate_vector_to_world(e, body, local, arm)
    for k in range(3):
        by[k] = (e.x[3 * body + k] - e.shift[6 * dyn + k]) + (arm[k] - arm0[k])
    if material and e.kind_of_shape[body] != BOX:
        compute_rotation_between(e.q + 4 * body, e.dv + 6 * dyn, rotation_vector)
        cross(rotation_vector, arm, l)
        add_scaled3(by, 1.0, l, by)


cdef inline void compute_relative_contact_displacement(const engine_t* e, int32_t c, int32_t material, double* arm_a, double* arm_b,
                               double* by) noexcept nogil:
    """Compute a contact's current arms and the displacement of b's point relative to a's."""
    cdef double by_a[3]
    compute_contact_point_displacement(e, e.contact_pair[2 * c], e.contact_body[2 * c], e.local + 6 * c, e.arm_a + 3 * c, material,
                                       arm_a, by_a)
    compute_contact_point_displacement(e, e.contact_pair[2 * c + 1], e.contact_body[2 * c + 1], e.local + 6 * c + 3,
                                       e.arm_b + 3 * c, material,
          arm_b, by)
    subtract3(by, by_a, by)


cdef inline void displace_contact(engine_t* e, int32_t c, const double* arm_a, const double* arm_b, const double* n,
                                  double size) noexcept nogil:
    """Displace both bodies of a contact by size [kg m] along n."""
    cdef double p[3]
    scale3(size, n, p)
    displace_body(e, e.contact_pair[2 * c], e.contact_body[2 * c], arm_a, p, -1.0)
    displace_body(e, e.contact_pair[2 * c + 1], e.contact_body[2 * c + 1], arm_b, p, 1.0)


cdef inline double contact_inverse_mass(const engine_t* e, int32_t c, const double* arm_a, const double* arm_b,
                             const double* n) noexcept nogil:
    """Return the generalised inverse mass (1) of a contact along n."""
    return (generalised_inverse_mass_of_body(e, e.contact_body[2 * c], arm_a, n)
            + generalised_inverse_mass_of_body(e, e.contact_body[2 * c + 1], arm_b, n))


cdef inline void correct_penetration(engine_t* e, int32_t c) noexcept nogil:
    """Correct the penetration of a contact by (2), with its multiplier clamped at 0."""
    cdef int32_t row = e.ptr[e.size[N_JOINT] + c]
    cdef const double* n = e.normal + 3 * c
    cdef double arm_a[3]
    cdef double arm_b[3]
    cdef double by[3]
    cdef double new_multiplier, multiplier
    compute_relative_contact_displacement(e, c, 0, arm_a, arm_b, by)
    multiplier = e.impulse[row]
    new_multiplier = multiplier - (e.gap[c] + dot3(n, by)) / contact_inverse_mass(e, c, arm_a, arm_b, n)
    new_multiplier = new_multiplier if new_multiplier > 0.0 else 0.0
    if new_multiplier != multiplier:
        e.impulse[row] = new_multiplier
        displace_contact(e, c, arm_a, arm_b, n, new_multiplier - multiplier)


cdef inline void correct_tangential_displacement(engine_t* e, int32_t c) noexcept nogil:
    """Undo the tangential displacement of a contact if the friction for it stays inside the disk."""
    cdef int32_t row = e.ptr[e.size[N_JOINT] + c]
    cdef const double* t1 = e.tangent + 3 * c
    cdef double friction_bound = e.mu[e.size[N_JOINT] + c] * e.impulse[row], w, x, s, t
    cdef double arm_a[3]
    cdef double arm_b[3]
    cdef double by[3]
    cdef double t2[3]
    if friction_bound == 0.0:
        return
    # tangential displacement and its direction
    compute_relative_contact_displacement(e, c, 1, arm_a, arm_b, by)
    cross(e.normal + 3 * c, t1, t2)
    s = dot3(by, t1)
    t = dot3(by, t2)
    x = sqrt(s * s + t * t)
    if x == 0.0:
        return
    for k in range(3):
        by[k] = (s * t1[k] + t * t2[k]) / x
    # multipliers that undo it
    w = contact_inverse_mass(e, c, arm_a, arm_b, by)
    s = e.impulse[row + 1] - s / w
    t = e.impulse[row + 2] - t / w
    if s * s + t * t > friction_bound * friction_bound:
        return                                          # sliding: stage 4 applies friction to the velocity
    e.impulse[row + 1] = s
    e.impulse[row + 2] = t
    displace_contact(e, c, arm_a, arm_b, by, -(x / w))


cdef inline void advance_free_flight(engine_t* e) noexcept nogil:
    """Advance all bodies by free flight (stage 1); store previous positions in `shift` (3 of 6), quaternions in `dv` (4 of 6)."""
    cdef int32_t i, k, b
    cdef double h = e.setting[S_H]
    for i in range(e.size[N_DYNAMIC]):
        b = e.body_of[i]
        for k in range(3):
            e.shift[6 * i + k] = e.x[3 * b + k]
            e.x[3 * b + k] += h * e.v_free[6 * i + k]
        for k in range(4):
            e.dv[6 * i + k] = e.q[4 * b + k]
        if e.uneven[b]:
            advance_rotation(e.q + 4 * b, e.v_free + 6 * i + 3, e.inertia + 9 * b, e.inv_inertia_body + 9 * b, h)
        else:
            rotate_quaternion(e.q + 4 * b, e.v_free + 6 * i + 3, h)


cdef inline void compute_velocities_from_poses(engine_t* e) noexcept nogil:
    """Compute dv = v - v* from the poses (stage 3); for anisotropic inertia relative to the rotation of free flight."""
    cdef int32_t i, k, b
    cdef double h = e.setting[S_H]
    cdef double p[4]
    cdef double by[3]
    cdef double spin[3]
    for i in range(e.size[N_DYNAMIC]):
        b = e.body_of[i]
        for k in range(4):
            p[k] = e.dv[6 * i + k]
        if e.uneven[b]:
            copy3(e.v + 6 * b + 3, spin)
            advance_rotation(p, spin, e.inertia + 9 * b, e.inv_inertia_body + 9 * b, h)
        compute_rotation_between(e.q + 4 * b, p, by)
        for k in range(3):
            e.dv[6 * i + k] = (e.x[3 * b + k] - e.shift[6 * i + k]) / h - e.v_free[6 * i + k]
            e.dv[6 * i + 3 + k] = by[k] / h - (0.0 if e.uneven[b] else e.v_free[6 * i + 3 + k])


cdef inline void apply_contact_restitution(engine_t* e, int32_t c) noexcept nogil:
    """Convert a contact's multipliers to impulses [N s] and apply restitution (stage 4, normal)."""
    cdef int32_t row = e.ptr[e.size[N_JOINT] + c], a = e.contact_pair[2 * c], b = e.contact_pair[2 * c + 1], k
    cdef double initial_velocity, velocity_change
    for k in range(row, e.ptr[e.size[N_JOINT] + c + 1]):
        e.impulse[k] = e.impulse[k] / e.setting[S_H]
    if e.impulse[row] <= 0.0:
        return
    # required change of the relative normal velocity
    initial_velocity = initial_normal_velocity(e, a, b, c)
    velocity_change = -get_pair_restitution(e, a, b) * initial_velocity if initial_velocity < -e.setting[S_BOUNCE] else 0.0
    velocity_change = velocity_change - contact_normal_velocity(e, e.v_free, c) - contact_normal_velocity(e, e.dv, c)
    set_normal_impulse(e, c, e.impulse[row] + velocity_change / e.d[row])


cdef inline void apply_sliding_friction(engine_t* e, int32_t c) noexcept nogil:
    """Reduce a contact's sliding velocity by the friction that its disk still allows (stage 4, tangents)."""
    cdef int32_t row = e.ptr[e.size[N_JOINT] + c], k
    cdef double s, t, x, remaining_friction
    cdef double t2[3]
    cdef double p[3]
    cdef double angular[6]
    cdef const double* t1 = e.tangent + 3 * c
    cdef double* lam = e.impulse + row
    if e.mu[e.size[N_JOINT] + c] == 0.0:
        return
    # remaining friction impulse inside the disk
    remaining_friction = e.mu[e.size[N_JOINT] + c] * lam[0] - sqrt(lam[1] * lam[1] + lam[2] * lam[2])
    if remaining_friction <= 0.0:
        return
    # relative tangential velocity and its direction
    cross(e.normal + 3 * c, t1, t2)
    s = contact_displacement_along(e, c, e.v_free, t1, angular) + contact_displacement_along(e, c, e.dv, t1, angular)
    t = contact_displacement_along(e, c, e.v_free, t2, angular) + contact_displacement_along(e, c, e.dv, t2, angular)
    x = sqrt(s * s + t * t)
    if x == 0.0:
        return
    for k in range(3):
        p[k] = (s * t1[k] + t * t2[k]) / x
    x = x / contact_inverse_mass(e, c, e.arm_a + 3 * c, e.arm_b + 3 * c, p)
    # apply the impulse that stops sliding, limited to the remaining friction
    remaining_friction = x if x < remaining_friction else remaining_friction
    scale3(-remaining_friction, p, p)
    lam[1] += dot3(p, t1)
    lam[2] += dot3(p, t2)
    apply_contact_impulse(e, e.dv, c, p)


cdef inline void run_xpbd_substep(engine_t* e) noexcept nogil:
    """Run stages 1 to 4 on the prepared rows in the order of e.order; motors act on velocities, after stage 3."""
    cdef int32_t i, _sweep, row, kj = e.size[N_JOINT], n = kj + e.head[H_CONTACTS]
    cdef double x, h = e.setting[S_H]
    for i in range(e.ptr[n]):
        e.impulse[i] = 0.0
    # stages 1 and 2: free flight, sweeps over positions
    advance_free_flight(e)
    for _sweep in range(e.head[H_ITERATIONS]):
        for i in range(kj):
            correct_joint_positions(e, e.order[i])
        for i in range(kj, n):
            correct_penetration(e, e.order[i] - kj)
        for i in range(kj, n):
            correct_tangential_displacement(e, e.order[i] - kj)
    # stage 3: velocities, joint impulses, motors
    compute_velocities_from_poses(e)
    for i in range(kj):
        for row in range(e.ptr[i], e.ptr[i + 1]):
            e.impulse[row] = e.impulse[row] / h
        if e.joint_motor[i]:
            row = e.ptr[i + 1] - 1
            x = e.b[row] - joint_row_velocity(e.jac + 12 * row, e.dv, e.joint_body[2 * i], e.joint_body[2 * i + 1])
            e.impulse[row] = clip(x / e.d[row], e.lower[row], e.upper[row])
            apply_joint_impulse(e.minv_jac + 12 * row, e.impulse[row], e.dv, e.joint_body[2 * i], e.joint_body[2 * i + 1])
    # stage 4: restitution, then friction
    for i in range(kj, n):
        apply_contact_restitution(e, e.order[i] - kj)
    for i in range(kj, n):
        apply_sliding_friction(e, e.order[i] - kj)
