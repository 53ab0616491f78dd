"""Positions corrected constraint by constraint, velocities from positions (Müller, Macklin, Chentanez, Jeschke, Kim,
"Detailed Rigid Body Simulation with Extended Position Based Dynamics", 2020).

With C a constraint's error at the present poses, n its direction, r the arms, alpha its compliance [1/(N/m)]:

    w = sum over both bodies of 1/m + (r x n).I^-1 (r x n)                                            (1)
    dlambda = (-C - alpha' lambda) / (w + alpha'),   alpha' = alpha / h^2      [kg m]                 (2)
    x <- x +- dlambda n / m,   q <- q +- 1/2 (0, I^-1 (r x dlambda n)) q

The substep:

    1   x, q at the places of free flight
    2   sweeps of (2): joints; contacts where the bodies overlap; friction as an error of place, where it stays in
        its disk, |lambda_t| <= mu lambda_n
    3   v = (x - x0)/h, omega = 2 (q q0^-1)_xyz / (h (q q0^-1)_w); of a body whose free spin changes, that of free flight
        and the turn from where it would have come, over h
    4   contacts that bear: what slides is braked by at most mu lambda_n, what parts or closes goes to -e v_n(before)

Nothing is carried from one substep to the next. A soft joint has alpha = 1/k and a damper, c = 2 m zeta omega on its
effective mass m:  dlambda = (-C - alpha' lambda - g dC) / ((1 + g) w + alpha'),  g = alpha c / h, dC = C - C(x0).
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport clip
from lavender_ext.core.rows cimport cross, dot3, joint_push, joint_velocity
from lavender_ext.engine.arrays cimport (BOX, DISTANCE, HINGE, H_CONTACTS, H_ITERATIONS, J_ANCHOR_A, J_ANCHOR_B,
                                         J_AXIS_A, J_AXIS_B, J_DAMPING, J_HERTZ, J_LENGTH, N_DYNAMIC, N_JOINT,
                                         N_JOINT_REAL, S_BOUNCE, S_H, engine_t)
from lavender_ext.engine.bodies cimport drift_rotation, rotation, to_world, turn
from lavender_ext.engine.contacts cimport normal_velocity, restitution_of
from lavender_ext.engine.projection cimport displacement, normal_speed, push_contact, push_normal
from lavender_ext.engine.vectors cimport copy3, minus3, normalise3, plus3, scale3, times3


cdef inline void turned(const engine_t* e, int32_t body, const double* local, double* out) noexcept nogil:
    # a vector of a body's frame at its present pose; body -1 is the world
    cdef double r[9]
    if body < 0:
        copy3(local, out)
    else:
        rotation(e.q + 4 * body, r)
        to_world(r, local, out)


cdef inline double weight(const engine_t* e, int32_t dyn, const double* arm, const double* n) noexcept nogil:
    # one body's part of (1); arm NULL: of a turn about n alone
    cdef double l[3]
    cdef double k[3]
    if dyn < 0:
        return 0.0
    if arm == NULL:
        copy3(n, l)
    else:
        cross(arm, n, l)
    times3(e.inv_inertia + 9 * dyn, l, k)
    return dot3(l, k) + (0.0 if arm == NULL else e.inv_mass[dyn] * dot3(n, n))


cdef inline void displace(engine_t* e, int32_t body, int32_t dyn, const double* arm, const double* p,
                          double sign) noexcept nogil:
    # a body by p [kg m] at an arm; arm NULL: a turn by p [kg m^2]
    cdef double l[3]
    cdef double k[3]
    if dyn < 0:
        return
    if arm == NULL:
        copy3(p, l)
    else:
        cross(arm, p, l)
        plus3(e.x + 3 * body, sign * e.inv_mass[dyn], p, e.x + 3 * body)
    times3(e.inv_inertia + 9 * dyn, l, k)
    scale3(sign, k, k)
    turn(e.q + 4 * body, k, 1.0)


cdef inline double correct(engine_t* e, int32_t i, const double* arm_a, const double* arm_b, const double* n,
                           double error, double before, double lam) noexcept nogil:
    """(2) of joint i along n, b against a; returns lambda. `before`: the error at the start of the substep."""
    cdef int32_t a = e.joint_bodies[2 * i], b = e.joint_bodies[2 * i + 1]
    cdef double w = weight(e, e.joint_body[2 * i], arm_a, n) + weight(e, e.joint_body[2 * i + 1], arm_b, n)
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
    displace(e, a, e.joint_body[2 * i], arm_a, p, -1.0)
    displace(e, b, e.joint_body[2 * i + 1], arm_b, p, 1.0)
    return lam + x


cdef inline void correct_joint(engine_t* e, int32_t i) noexcept nogil:
    """Distance along the anchors, ball along what parts them, hinge besides about what turns the axes apart."""
    cdef const double* p = e.joint + N_JOINT_REAL * i
    cdef int32_t a = e.joint_bodies[2 * i], b = e.joint_bodies[2 * i + 1], row = e.ptr[i], k
    cdef double arm_a[3]
    cdef double arm_b[3]
    cdef double n[3]
    cdef double size, begun = 0.0
    turned(e, a, p + J_ANCHOR_A, arm_a)
    turned(e, b, p + J_ANCHOR_B, arm_b)
    for k in range(3):
        n[k] = (e.x[3 * b + k] if b >= 0 else 0.0) + arm_b[k] - (e.x[3 * a + k] if a >= 0 else 0.0) - arm_a[k]
    size = normalise3(n)
    if e.joint_kind[i] == DISTANCE:
        if size > 0.0:
            e.impulse[row] = correct(e, i, arm_a, arm_b, n, size - p[J_LENGTH], e.joint_error[row], e.impulse[row])
        return
    if size > 0.0:
        for k in range(3):
            begun += n[k] * e.joint_error[row + k]
        # the multipliers of a direction that turns are summed by axis
        size = correct(e, i, arm_a, arm_b, n, size, begun, dot3(e.impulse + row, n)) - dot3(e.impulse + row, n)
        plus3(e.impulse + row, size, n, e.impulse + row)
    if e.joint_kind[i] != HINGE:
        return
    turned(e, a, p + J_AXIS_A, arm_a)
    turned(e, b, p + J_AXIS_B, arm_b)
    cross(arm_a, arm_b, n)                              # turns axis_a to axis_b: what b has turned too far
    size = normalise3(n)
    if size > 0.0:
        correct(e, i, NULL, NULL, n, size, 0.0, 0.0)


cdef inline void turned_by(const double* q, const double* p, double* out) noexcept nogil:
    # the rotation from p to q as a vector [rad]: 2 (q p^-1)_xyz / (q p^-1)_w, which `turn` makes of it again
    cdef double s = q[0] * p[0] + q[1] * p[1] + q[2] * p[2] + q[3] * p[3]
    s = 2.0 / s if s != 0.0 else 2.0                    # half a turn in a substep has no such vector
    out[0] = s * (q[1] * p[0] - q[0] * p[1] - q[2] * p[3] + q[3] * p[2])
    out[1] = s * (q[2] * p[0] - q[0] * p[2] - q[3] * p[1] + q[1] * p[3])
    out[2] = s * (q[3] * p[0] - q[0] * p[3] - q[1] * p[2] + q[2] * p[1])


cdef inline void moved(const engine_t* e, int32_t body, int32_t dyn, const double* local, const double* arm0,
                       int32_t material, double* arm, double* by) noexcept nogil:
    # the arm of a contact's point now, and how far the point has come; a round body's arm does not turn with it, but
    # its material does, which is what friction holds
    cdef double turn_[3]
    cdef double l[3]
    cdef int32_t k
    for k in range(3):
        arm[k] = arm0[k]
        by[k] = 0.0
    if dyn < 0:
        return
    if e.kind_of_shape[body] == BOX:
        turned(e, body, local, arm)
    for k in range(3):
        by[k] = (e.x[3 * body + k] - e.shift[6 * dyn + k]) + (arm[k] - arm0[k])
    if material and e.kind_of_shape[body] != BOX:
        turned_by(e.q + 4 * body, e.dv + 6 * dyn, turn_)
        cross(turn_, arm, l)
        plus3(by, 1.0, l, by)


cdef inline void relative_move(const engine_t* e, int32_t c, int32_t material, double* arm_a, double* arm_b,
                               double* by) noexcept nogil:
    # arms now, and how far b's point of a contact has come against a's
    cdef double by_a[3]
    moved(e, e.contact_pair[2 * c], e.contact_body[2 * c], e.local + 6 * c, e.arm_a + 3 * c, material, arm_a, by_a)
    moved(e, e.contact_pair[2 * c + 1], e.contact_body[2 * c + 1], e.local + 6 * c + 3, e.arm_b + 3 * c, material,
          arm_b, by)
    minus3(by, by_a, by)


cdef inline void displace_contact(engine_t* e, int32_t c, const double* arm_a, const double* arm_b, const double* n,
                                  double size) noexcept nogil:
    cdef double p[3]
    scale3(size, n, p)
    displace(e, e.contact_pair[2 * c], e.contact_body[2 * c], arm_a, p, -1.0)
    displace(e, e.contact_pair[2 * c + 1], e.contact_body[2 * c + 1], arm_b, p, 1.0)


cdef inline double weight_of(const engine_t* e, int32_t c, const double* arm_a, const double* arm_b,
                             const double* n) noexcept nogil:
    return weight(e, e.contact_body[2 * c], arm_a, n) + weight(e, e.contact_body[2 * c + 1], arm_b, n)


cdef inline void correct_normal(engine_t* e, int32_t c) noexcept nogil:
    cdef int32_t row = e.ptr[e.size[N_JOINT] + c]
    cdef const double* n = e.normal + 3 * c
    cdef double arm_a[3]
    cdef double arm_b[3]
    cdef double by[3]
    cdef double y, x
    relative_move(e, c, 0, arm_a, arm_b, by)
    x = e.impulse[row]
    y = x - (e.gap[c] + dot3(n, by)) / weight_of(e, c, arm_a, arm_b, n)
    y = y if y > 0.0 else 0.0
    if y != x:
        e.impulse[row] = y
        displace_contact(e, c, arm_a, arm_b, n, y - x)


cdef inline void correct_tangents(engine_t* e, int32_t c) noexcept nogil:
    cdef int32_t row = e.ptr[e.size[N_JOINT] + c]
    cdef const double* t1 = e.tangent + 3 * c
    cdef double r = e.mu[e.size[N_JOINT] + c] * e.impulse[row], w, x, s, t
    cdef double arm_a[3]
    cdef double arm_b[3]
    cdef double by[3]
    cdef double t2[3]
    if r == 0.0:
        return
    relative_move(e, c, 1, arm_a, arm_b, by)
    cross(e.normal + 3 * c, t1, t2)
    s = dot3(by, t1)
    t = dot3(by, t2)
    x = sqrt(s * s + t * t)
    if x == 0.0:
        return
    for k in range(3):
        by[k] = (s * t1[k] + t * t2[k]) / x
    w = weight_of(e, c, arm_a, arm_b, by)
    s = e.impulse[row + 1] - s / w
    t = e.impulse[row + 2] - t / w
    if s * s + t * t > r * r:
        return                                          # it slides: braked by stage 4
    e.impulse[row + 1] = s
    e.impulse[row + 2] = t
    displace_contact(e, c, arm_a, arm_b, by, -(x / w))


cdef inline void fly(engine_t* e) noexcept nogil:
    """Stage 1; the places before it in `shift` (three of six) and `dv` (four of six)."""
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
            drift_rotation(e.q + 4 * b, e.v_free + 6 * i + 3, e.inertia + 9 * b, e.inv_inertia_body + 9 * b, h)
        else:
            turn(e.q + 4 * b, e.v_free + 6 * i + 3, h)


cdef inline void take_velocities(engine_t* e) noexcept nogil:
    """Stage 3, dv = v - v*; of a body whose free spin changes, from where free flight would have turned it."""
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
            drift_rotation(p, spin, e.inertia + 9 * b, e.inv_inertia_body + 9 * b, h)
        turned_by(e.q + 4 * b, p, by)
        for k in range(3):
            e.dv[6 * i + k] = (e.x[3 * b + k] - e.shift[6 * i + k]) / h - e.v_free[6 * i + k]
            e.dv[6 * i + 3 + k] = by[k] / h - (0.0 if e.uneven[b] else e.v_free[6 * i + 3 + k])


cdef inline void bounce_contact(engine_t* e, int32_t c) noexcept nogil:
    """Stage 4 of the normal; the multipliers of the contact become impulses [N s]."""
    cdef int32_t row = e.ptr[e.size[N_JOINT] + c], a = e.contact_pair[2 * c], b = e.contact_pair[2 * c + 1], k
    cdef double before, goal
    for k in range(row, e.ptr[e.size[N_JOINT] + c + 1]):
        e.impulse[k] = e.impulse[k] / e.setting[S_H]
    if e.impulse[row] <= 0.0:
        return
    before = normal_velocity(e, a, b, c)
    goal = -restitution_of(e, a, b) * before if before < -e.setting[S_BOUNCE] else 0.0
    goal = goal - normal_speed(e, e.v_free, c) - normal_speed(e, e.dv, c)
    push_normal(e, c, e.impulse[row] + goal / e.d[row])


cdef inline void brake_contact(engine_t* e, int32_t c) noexcept nogil:
    """Stage 4 of the tangents."""
    cdef int32_t row = e.ptr[e.size[N_JOINT] + c], k
    cdef double s, t, x, left
    cdef double t2[3]
    cdef double p[3]
    cdef double turn_[6]
    cdef const double* t1 = e.tangent + 3 * c
    cdef double* lam = e.impulse + row
    if e.mu[e.size[N_JOINT] + c] == 0.0:
        return
    left = e.mu[e.size[N_JOINT] + c] * lam[0] - sqrt(lam[1] * lam[1] + lam[2] * lam[2])
    if left <= 0.0:
        return
    cross(e.normal + 3 * c, t1, t2)
    s = displacement(e, c, e.v_free, t1, turn_) + displacement(e, c, e.dv, t1, turn_)
    t = displacement(e, c, e.v_free, t2, turn_) + displacement(e, c, e.dv, t2, turn_)
    x = sqrt(s * s + t * t)
    if x == 0.0:
        return
    for k in range(3):
        p[k] = (s * t1[k] + t * t2[k]) / x
    x = x / weight_of(e, c, e.arm_a + 3 * c, e.arm_b + 3 * c, p)
    left = x if x < left else left
    scale3(-left, p, p)
    lam[1] += dot3(p, t1)
    lam[2] += dot3(p, t2)
    push_contact(e, e.dv, c, p)


cdef inline void correct_all(engine_t* e) noexcept nogil:
    """Stages 1 to 4 on the prepared rows, in the order of e.order; motors after the positions."""
    cdef int32_t i, _sweep, row, kj = e.size[N_JOINT], n = kj + e.head[H_CONTACTS]
    cdef double x, h = e.setting[S_H]
    for i in range(e.ptr[n]):
        e.impulse[i] = 0.0
    fly(e)
    for _sweep in range(e.head[H_ITERATIONS]):
        for i in range(kj):
            correct_joint(e, e.order[i])
        for i in range(kj, n):
            correct_normal(e, e.order[i] - kj)
        for i in range(kj, n):
            correct_tangents(e, e.order[i] - kj)
    take_velocities(e)
    for i in range(kj):
        for row in range(e.ptr[i], e.ptr[i + 1]):
            e.impulse[row] = e.impulse[row] / h
        if e.joint_motor[i]:
            row = e.ptr[i + 1] - 1
            x = e.b[row] - joint_velocity(e.jac + 12 * row, e.dv, e.joint_body[2 * i], e.joint_body[2 * i + 1])
            e.impulse[row] = clip(x / e.d[row], e.lower[row], e.upper[row])
            joint_push(e.minv_jac + 12 * row, e.impulse[row], e.dv, e.joint_body[2 * i], e.joint_body[2 * i + 1])
    for i in range(kj, n):
        bounce_contact(e, e.order[i] - kj)
    for i in range(kj, n):
        brake_contact(e, e.order[i] - kj)
