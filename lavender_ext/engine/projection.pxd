"""Position projection: a split impulse that moves bodies and does not change their velocities.

To first order the gap of a contact at the end of the substep is g + h (J v)_n, and to second order the errors of a rigid
joint are C + h J v + h^2/2 C'' (engine/joints.pxd). Sweeps over multipliers p [N s^2] find a shift s = M^-1 J^T p [m, rad]
with

    contact   J s >= -min(beta (g' + slop), push),  p >= 0,  g' = g + h (J v)_n  the predicted gap    (1)
    joint     J s  = -beta C' min(1, push / |beta C'|),  |.| of the linear and of the angular rows    (2)

A joint is one block of a sweep: (2) is solved for all its rows, so that the shift does not depend on the axes of the world.

Velocities are unchanged, so that the projection adds no kinetic energy. It is skipped if no contact is deeper than
the slop and no joint has an error.

A light body between heavy ones needs many sweeps; after few, s may deepen a contact that it should raise. Without slop,
the depth then grows from substep to substep out of rounding. If the slop is 0, the sweeps therefore continue, up to
MAX_SWEEPS, until

    max_c (required J s - J s)_c <= max (required J s) over contacts and joints                      (3)

which s = 0 fulfils; without (3) there is no shift.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport project_normal_update
from lavender_ext.core.rows cimport (dot3, dot12, apply_joint_impulse, joint_row_velocity, apply_impulse_to_body,
                                     compute_relative_velocity)
from lavender_ext.engine.arrays cimport (H_CONTACTS, H_POSITION_ITERATIONS, H_PROJECTED, J_HERTZ, N_DYNAMIC,
                                         N_JOINT, N_JOINT_REAL, N_JOINT_ROW, S_BETA, S_DEPTH, S_H,
                                         S_JOINT_ERROR, S_MAX_PUSH, S_SLOP, engine_t)
from lavender_ext.engine.bodies cimport get_sweep_direction
from lavender_ext.engine.joints cimport compute_row_curvature
from lavender_ext.core.vectors cimport scale3


cdef enum:
    MAX_SWEEPS = 1000   # largest number of sweeps of one projection without slop


cdef inline int32_t count_projected_rows(const engine_t* e, int32_t i) noexcept nogil:
    """Return the number of rows of joint i that are projected: a soft joint has none, a motor row has no position."""
    if e.joint[N_JOINT_REAL * i + J_HERTZ] > 0.0:
        return 0
    return e.ptr[i + 1] - e.ptr[i] - e.joint_motor[i]


cdef inline double vector_norm(int32_t n, const double* x) noexcept nogil:
    """Return the Euclidean norm of x (n)."""
    cdef double s = 0.0
    cdef int32_t k
    for k in range(n):
        s += x[k] * x[k]
    return sqrt(s)


cdef inline double set_joint_goal(const engine_t* e, int32_t i, const double* v, double* goal) noexcept nogil:
    """Write the shift that joint i requires by (2); return its predicted error [m or rad] at the velocities v (nd, 6)."""
    cdef int32_t row = e.ptr[i], n = count_projected_rows(e, i), first, count, k
    cdef double size, correction, h = e.setting[S_H], most = 0.0
    cdef double curvature[3]
    if n == 0:
        return 0.0
    for k in range(row, row + n):
        goal[k] = e.joint_error[k] + h * joint_row_velocity(e.jac + 12 * k, v, e.joint_body[2 * i], e.joint_body[2 * i + 1])
    count = compute_row_curvature(e, i, v, curvature)
    for k in range(count):
        goal[row + k] += 0.5 * h * h * curvature[k]
    first = row
    while first < row + n:                              # the linear rows, then the angular rows
        count = n if n < 3 else (3 if first == row else n - 3)
        size = vector_norm(count, goal + first)
        most = size if size > most else most
        correction = e.setting[S_BETA]
        if correction * size > e.setting[S_MAX_PUSH]:
            correction = e.setting[S_MAX_PUSH] / size
        for k in range(first, first + count):
            goal[k] *= -correction
        first += count
    return most


cdef inline void project_joint(engine_t* e, int32_t i, const double* goal) noexcept nogil:
    """Shift the bodies of joint i so that all its rows fulfil (2): the block of A is factored as L D L^T."""
    cdef int32_t row = e.ptr[i], n = count_projected_rows(e, i), j, k, t
    cdef int32_t a = e.joint_body[2 * i], b = e.joint_body[2 * i + 1]
    cdef double low[25]                                 # L below the diagonal
    cdef double d[5]
    cdef double inv_d[5]
    cdef double x[5]
    cdef double entry
    for j in range(n):
        x[j] = goal[row + j] - joint_row_velocity(e.jac + 12 * (row + j), e.shift, a, b)
        d[j] = dot12(e.jac + 12 * (row + j), e.minv_jac + 12 * (row + j))
        # A row that the rows before it determine keeps nothing of its own.
        entry = 1e-12 * d[j]
        for t in range(j):
            d[j] -= low[5 * j + t] * low[5 * j + t] * d[t]
        inv_d[j] = 1.0 / d[j] if d[j] > entry else 0.0
        for k in range(j + 1, n):
            entry = dot12(e.jac + 12 * (row + k), e.minv_jac + 12 * (row + j))
            for t in range(j):
                entry -= low[5 * k + t] * d[t] * low[5 * j + t]
            low[5 * k + j] = entry * inv_d[j]
        for t in range(j):
            x[j] -= low[5 * j + t] * x[t]
    for j in range(n - 1, -1, -1):
        x[j] *= inv_d[j]
        for k in range(j + 1, n):
            x[j] -= low[5 * k + j] * x[k]
        apply_joint_impulse(e.minv_jac + 12 * (row + j), x[j], e.shift, a, b)


cdef inline double contact_normal_velocity(const engine_t* e, const double* v, int32_t c) noexcept nogil:
    """Return a contact's relative normal velocity (J v)_n for the body velocities v (nd, 6)."""
    cdef double u[3]
    cdef double s[3]
    compute_relative_velocity(v, e.contact_body[2 * c], e.contact_body[2 * c + 1], e.arm_a + 3 * c, e.arm_b + 3 * c,
                      u, s)
    return dot3(e.normal + 3 * c, u)


cdef inline int32_t count_most_sweeps(const engine_t* e) noexcept nogil:
    """Return the largest number of sweeps of a projection."""
    cdef int32_t n = e.head[H_POSITION_ITERATIONS]
    return MAX_SWEEPS if e.setting[S_SLOP] == 0.0 and 0 < n < MAX_SWEEPS else n


cdef inline int32_t project_positions(engine_t* e) noexcept nogil:
    """Compute e.shift and return 1 if it is not zero; write S_DEPTH and S_JOINT_ERROR of the poses before the substep."""
    cdef int32_t n = e.head[H_CONTACTS], mj = e.size[N_JOINT_ROW], sweep, i, j, c, a, b, due = 0
    cdef int32_t n_sweeps = e.head[H_POSITION_ITERATIONS], max_sweeps = count_most_sweeps(e)
    cdef int32_t last_first = get_sweep_direction(e)   # as the sweeps over velocities
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
        for j in range(e.ptr[i], e.ptr[i] + count_projected_rows(e, i)):
            if fabs(e.joint_error[j]) > joint_error:
                joint_error = fabs(e.joint_error[j])
    e.setting[S_DEPTH] = depth
    e.setting[S_JOINT_ERROR] = joint_error
    if e.head[H_POSITION_ITERATIONS] == 0 or not (depth > slop or joint_error > 0.0):
        return 0
    # required corrections from the errors predicted at the end of the substep
    for i in range(6 * e.size[N_DYNAMIC]):
        e.shift[i] = e.v_free[i] + e.dv[i]              # temporarily v+
    for i in range(e.size[N_JOINT]):
        x = set_joint_goal(e, i, e.shift, goal)
        if x > 1e-3 * slop:
            due = 1
        x = beta * x if beta * x < max_correction else max_correction
        if x > before:
            before = x
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
    for sweep in range(1, max_sweeps + 1):
        for i in range(e.size[N_JOINT]):
            project_joint(e, i, goal)                   # (2)
        for j in range(n):
            c = n - 1 - j if last_first else j
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
