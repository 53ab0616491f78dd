"""Position projection: a split impulse that moves bodies and does not change their velocities.

To first order the gap of a contact at the end of the substep is g + h (J v)_n, and the error of a rigid
joint row C + h J v. Sweeps over multipliers p [N s^2] find a shift s = M^-1 J^T p [m, rad] with

    contact   J s >= -min(beta (g' + slop), push),  p >= 0,  g' = g + h (J v)_n  the predicted gap    (1)
    joint     J s  = -clip(beta C', push)                                                            (2)

Velocities are unchanged, so that the projection adds no kinetic energy. It is skipped if no contact is deeper than
the slop and no joint has an error.

A light body between heavy ones needs many sweeps; after few, s may deepen a contact that it should raise. Without slop,
the depth then grows from substep to substep out of rounding. If the slop is 0, the sweeps therefore continue, up to
MAX_SWEEPS, until

    max_c (required J s - J s)_c <= max (required J s) over contacts and joints                      (3)

which s = 0 fulfils; without (3) there is no shift.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport clip, project_normal_update
from lavender_ext.core.rows cimport (dot3, apply_joint_impulse, joint_row_velocity, apply_impulse_to_body,
                                     compute_relative_velocity)
from lavender_ext.engine.arrays cimport (H_CONTACTS, H_POSITION_ITERATIONS, H_PROJECTED, J_HERTZ, N_DYNAMIC,
                                         N_JOINT, N_JOINT_REAL, N_JOINT_ROW, S_BETA, S_DEPTH, S_H,
                                         S_JOINT_ERROR, S_MAX_PUSH, S_SLOP, engine_t)
from lavender_ext.core.vectors cimport scale3


cdef enum:
    MAX_SWEEPS = 1000   # largest number of sweeps of one projection without slop


cdef inline int32_t is_rigid_joint_row(const engine_t* e, int32_t i, int32_t row) noexcept nogil:
    """Return whether a joint row is projected: soft rows correct their own errors, a motor row has no position."""
    return e.joint[N_JOINT_REAL * i + J_HERTZ] == 0.0 and not (e.joint_motor[i] and row == e.ptr[i + 1] - 1)


cdef inline double contact_normal_velocity(const engine_t* e, const double* v, int32_t c) noexcept nogil:
    """Return a contact's relative normal velocity (J v)_n for the body velocities v (nd, 6)."""
    cdef double u[3]
    cdef double s[3]
    compute_relative_velocity(v, e.contact_body[2 * c], e.contact_body[2 * c + 1], e.arm_a + 3 * c, e.arm_b + 3 * c,
                      u, s)
    return dot3(e.normal + 3 * c, u)


cdef inline int32_t project_positions(engine_t* e) noexcept nogil:
    """Compute e.shift and return 1 if it is not zero; write S_DEPTH and S_JOINT_ERROR of the poses before the substep."""
    cdef int32_t n = e.head[H_CONTACTS], mj = e.size[N_JOINT_ROW], sweep, i, j, c, a, b, due = 0
    cdef int32_t n_sweeps = e.head[H_POSITION_ITERATIONS], max_sweeps = n_sweeps
    cdef double h = e.setting[S_H], slop = e.setting[S_SLOP], beta = e.setting[S_BETA]
    cdef double max_correction = e.setting[S_MAX_PUSH]
    cdef double depth = 0.0, joint_error = 0.0, x, new_multiplier, change, before = 0.0, after
    cdef double impulse[3]
    # required J s of each joint row and contact; the target array is not needed after the solve
    cdef double* goal = e.target
    e.head[H_PROJECTED] = 0
    # largest errors
    for c in range(n):
        if -e.gap[c] > depth:
            depth = -e.gap[c]
    for i in range(e.size[N_JOINT]):
        for j in range(e.ptr[i], e.ptr[i + 1]):
            if is_rigid_joint_row(e, i, j) and fabs(e.joint_error[j]) > joint_error:
                joint_error = fabs(e.joint_error[j])
    e.setting[S_DEPTH] = depth
    e.setting[S_JOINT_ERROR] = joint_error
    if e.head[H_POSITION_ITERATIONS] == 0 or not (depth > slop or joint_error > 0.0):
        return 0
    # required corrections from the errors predicted at the end of the substep
    for i in range(6 * e.size[N_DYNAMIC]):
        e.shift[i] = e.v_free[i] + e.dv[i]              # temporarily v+
    for i in range(e.size[N_JOINT]):
        a = e.joint_body[2 * i]
        b = e.joint_body[2 * i + 1]
        for j in range(e.ptr[i], e.ptr[i + 1]):
            e.push[j] = 0.0
            x = e.joint_error[j] + h * joint_row_velocity(e.jac + 12 * j, e.shift, a, b)
            goal[j] = -clip(beta * x, -max_correction, max_correction)
            if fabs(goal[j]) > before and is_rigid_joint_row(e, i, j):
                before = fabs(goal[j])
            if fabs(x) > 1e-3 * slop and is_rigid_joint_row(e, i, j):
                due = 1
    for c in range(n):
        e.push[mj + c] = 0.0
        x = -beta * (e.gap[c] + h * contact_normal_velocity(e, e.shift, c) + slop)
        if x > 0.0:
            due = 1
        goal[mj + c] = x if x < max_correction else max_correction
        if goal[mj + c] > before:
            before = goal[mj + c]
    if not due:
        return 0
    # sweeps over joints, then contacts
    for i in range(6 * e.size[N_DYNAMIC]):
        e.shift[i] = 0.0
    if slop == 0.0 and 0 < n_sweeps < MAX_SWEEPS:
        max_sweeps = MAX_SWEEPS
    for sweep in range(1, max_sweeps + 1):
        for i in range(e.size[N_JOINT]):
            a = e.joint_body[2 * i]
            b = e.joint_body[2 * i + 1]
            for j in range(e.ptr[i], e.ptr[i + 1]):
                if is_rigid_joint_row(e, i, j):
                    change = (goal[j] - joint_row_velocity(e.jac + 12 * j, e.shift, a, b)) * e.step[j]      # (2)
                    apply_joint_impulse(e.minv_jac + 12 * j, change, e.shift, a, b)
        for c in range(n):
            new_multiplier = project_normal_update(e.push[mj + c], contact_normal_velocity(e, e.shift, c) - goal[mj + c],
                                          e.step[e.ptr[e.size[N_JOINT] + c]])                           # (1)
            change = new_multiplier - e.push[mj + c]
            if change == 0.0:
                continue
            e.push[mj + c] = new_multiplier
            scale3(change, e.normal + 3 * c, impulse)
            a, b = e.contact_body[2 * c], e.contact_body[2 * c + 1]
            if a >= 0:
                apply_impulse_to_body(e.shift + 6 * a, e.inv_mass[a], e.inv_inertia + 9 * a, e.arm_a + 3 * c, impulse, -1.0)
            if b >= 0:
                apply_impulse_to_body(e.shift + 6 * b, e.inv_mass[b], e.inv_inertia + 9 * b, e.arm_b + 3 * c, impulse, 1.0)
        if slop > 0.0 or sweep < n_sweeps:
            continue
        # (3)
        after = 0.0
        for c in range(n):
            x = goal[mj + c] - contact_normal_velocity(e, e.shift, c)
            if x > after:
                after = x
        if after <= before:
            e.head[H_PROJECTED] = sweep
            return 1
    if slop > 0.0 or n_sweeps == 0:
        e.head[H_PROJECTED] = n_sweeps
        return 1
    return 0
