"""Soft contacts and joints, then a relaxation without their bias (Catto, "Solver2D", 2024).

A constraint C, J v its rate and m = 1/A_ii its effective mass, is a damped spring of frequency f and damping ratio
zeta on that mass. Integrated implicitly over a substep h, with omega = 2 pi f (derivation as in engine/joints.pxd):

    m omega^2 = k,  2 m zeta omega = c:    lambda = -h (k (C + h J v) + c J v)                           (1)
    a1 = 2 zeta + h omega,  a2 = h omega a1
    J v + (omega / a1) C + (A_ii / a2) lambda = 0                                                        (2)

so it is a row with target -(omega / a1) C and compliance A_ii / a2, and a sweep of it is the update with mass scale
a2 / (1 + a2) and impulse scale 1 / (1 + a2). The substep:

    1   penetrating contacts and rigid joints get (2), contacts with the target limited to the push speed; open gaps may
        close, but not more
    2   warm start and sweeps; positions move by these velocities
    3   relaxing sweeps without bias: target 0, no compliance; gaps that are open after stage 2 may close
    4   restitution: v_n = -e v_n(before) if the contact carries load and closed faster than the threshold

Stage 3 removes the velocity that pushed bodies apart, so that it adds no energy.
"""
from libc.stdint cimport int32_t

from lavender_ext.core.rows cimport joint_row_velocity, reciprocal_or_zero
from lavender_ext.engine.arrays cimport (H_CONTACTS, N_DYNAMIC, N_JOINT, S_BOUNCE, S_H, S_HERTZ, S_PUSH, S_RATIO,
                                         engine_t)
from lavender_ext.engine.contacts cimport initial_normal_velocity, get_pair_restitution
from lavender_ext.engine.projection cimport contact_normal_velocity, set_normal_impulse, is_rigid_joint_row


cdef inline void compute_soft_parameters(double hertz, double ratio, double h, double* rate, double* a2) noexcept nogil:
    """Compute omega / a1 [1/s] and a2 [-] of (2)."""
    cdef double omega, a1
    omega = 6.283185307179586 * hertz
    a1 = 2.0 * ratio + h * omega
    rate[0] = omega / a1
    a2[0] = h * omega * a1


cdef inline void set_soft_constraint_rows(engine_t* e) noexcept nogil:
    """Apply (2) to the prepared rows: penetrating contacts and rigid joint rows."""
    cdef int32_t i, c, j, a, b
    cdef double h = e.setting[S_H], rate, a2, stiff, stiff_a2, push_velocity
    cdef double hertz = e.setting[S_HERTZ]
    # limit the frequency to a period of four substeps, the shortest that sweeps can resolve
    if hertz * h > 0.25:
        hertz = 0.25 / h
    compute_soft_parameters(2.0 * hertz, 2.0, h, &stiff, &stiff_a2)   # joints, and contacts with static bodies
    for i in range(e.size[N_JOINT]):
        a = e.joint_body[2 * i]
        b = e.joint_body[2 * i + 1]
        for j in range(e.ptr[i], e.ptr[i + 1]):
            if is_rigid_joint_row(e, i, j):
                e.compliance[j] = e.d[j] / stiff_a2
                e.target[j] = -stiff * e.joint_error[j]
                e.d[j] += e.compliance[j]
                e.step[j] = reciprocal_or_zero(e.d[j])
                e.b[j] = e.target[j] - joint_row_velocity(e.jac + 12 * j, e.v_free, a, b)
    compute_soft_parameters(hertz, e.setting[S_RATIO], h, &rate, &a2)
    compute_soft_parameters(2.0 * hertz, e.setting[S_RATIO], h, &stiff, &stiff_a2)
    for c in range(e.head[H_CONTACTS]):
        j = e.ptr[e.size[N_JOINT] + c]
        i = e.contact_body[2 * c] < 0 or e.contact_body[2 * c + 1] < 0
        e.compliance[j] = 0.0
        if e.gap[c] > 0.0:
            # speculative contact: the gap may close
            e.target[j] = -e.gap[c] / h
        else:
            # penetration: push apart, limited to the push speed
            push_velocity = -(stiff if i else rate) * e.gap[c]
            e.target[j] = push_velocity if push_velocity < e.setting[S_PUSH] else e.setting[S_PUSH]
            e.compliance[j] = e.d[j] / (stiff_a2 if i else a2)
            e.d[j] += e.compliance[j]
            e.step[j] = reciprocal_or_zero(e.d[j])
        e.b[j] = e.target[j] - contact_normal_velocity(e, e.v_free, c)


cdef inline void set_rows_without_bias(engine_t* e) noexcept nogil:
    """Store dv, which moves the bodies, in `shift`, and set the rows of stage 3 with the gaps at the end of stage 2."""
    cdef int32_t i, c, j, a, b
    cdef double h = e.setting[S_H], gap
    for i in range(6 * e.size[N_DYNAMIC]):
        e.shift[i] = e.dv[i]
    for i in range(e.size[N_JOINT]):
        a = e.joint_body[2 * i]
        b = e.joint_body[2 * i + 1]
        for j in range(e.ptr[i], e.ptr[i + 1]):
            if is_rigid_joint_row(e, i, j):
                e.d[j] -= e.compliance[j]
                e.compliance[j] = 0.0
                e.step[j] = reciprocal_or_zero(e.d[j])
                e.target[j] = 0.0
                e.b[j] = 0.0 - joint_row_velocity(e.jac + 12 * j, e.v_free, a, b)
    for c in range(e.head[H_CONTACTS]):
        j = e.ptr[e.size[N_JOINT] + c]
        gap = contact_normal_velocity(e, e.v_free, c)
        e.b[j] = 0.0 - gap
        gap = e.gap[c] + h * (gap + contact_normal_velocity(e, e.dv, c))
        e.d[j] -= e.compliance[j]
        e.compliance[j] = 0.0
        e.step[j] = reciprocal_or_zero(e.d[j])
        e.target[j] = -gap / h if gap > 0.0 else 0.0
        e.b[j] = e.target[j] + e.b[j]


cdef inline void apply_restitution(engine_t* e) noexcept nogil:
    """Apply restitution (stage 4), contact by contact; e.v holds the velocities before the substep."""
    cdef int32_t c, j, a, b
    cdef double restitution, initial_velocity, relative_normal_velocity
    for c in range(e.head[H_CONTACTS]):
        a = e.contact_pair[2 * c]
        b = e.contact_pair[2 * c + 1]
        restitution = get_pair_restitution(e, a, b)
        j = e.ptr[e.size[N_JOINT] + c]
        if restitution == 0.0 or e.impulse[j] <= 0.0:
            continue
        # only contacts that closed faster than the threshold
        initial_velocity = initial_normal_velocity(e, a, b, c)
        if initial_velocity > -e.setting[S_BOUNCE]:
            continue
        # current relative normal velocity plus the rebound
        relative_normal_velocity = (contact_normal_velocity(e, e.v_free, c) + contact_normal_velocity(e, e.dv, c)
                                    + restitution * initial_velocity)
        set_normal_impulse(e, c, e.impulse[j] - relative_normal_velocity * e.step[j])
