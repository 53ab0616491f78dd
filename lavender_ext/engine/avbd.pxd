"""Block descent over bodies with an augmented Lagrangian (Giles, Diaz, Yuksel, "Augmented Vertex Block Descent", 2025).

Let z (6 per body) [m, rad] be the displacements of a substep, y = h v* the displacements of free flight, C the error
of a row at the start, lambda its multiplier [N s], kappa its stiffness [N s/m]. The impulses p of the rows are

    normal    p = max(0, lambda - kappa (C' + J z))        C' = C if the gap is open, else (1 - alpha) C
    tangents  p = lambda - kappa J z, in the disk mu p_n                                              (1)
    joint     p = clip(lambda - kappa ((1 - alpha) C + J z), bounds)

Each body in turn takes the Newton step of (1/2h) (z - y).M (z - y) + sum over its rows:

    (M/h + sum kappa J^T J) dz = -M (z - y)/h + sum J^T p                                             (2)

over the active rows (p > 0). If an inactive contact would become active after that step, the step is computed once more
with its row, lambda - kappa (C' + J z) < 0, included. Otherwise the next step would open the contact again, and the body
would move through the ground. After each pass all rows are updated by lambda <- p, and rows inside their bounds by

    kappa <- kappa + beta kappa0 |C' + J z| / slop,   kappa0 = 1/(h A_ii)                             (3)

A soft joint has the constants kappa = h k + c and lambda = 0. lambda and kappa of a contact start at gamma times the
cached values of the last substep, kappa at kappa0 or more. (The cache stores kappa in the entry of the spin row, which
this stepper does not support.) A substep removes at most the fraction 1 - alpha of an error. v = z/h.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport clip
from lavender_ext.core.order cimport sort_blocks_by_level
from lavender_ext.core.rows cimport cross, dot3, joint_row_velocity
from lavender_ext.engine.arrays cimport (H_CONTACTS, H_ITERATIONS, H_WARM_START, N_DYNAMIC, N_FRAME, N_JOINT,
                                         N_JOINT_ROW, S_H, S_HERTZ, S_RATIO, S_SLOP, engine_t)
from lavender_ext.engine.bodies cimport rotate_tensor_to_world
from lavender_ext.engine.projection cimport contact_displacement_along, is_rigid_joint_row
from lavender_ext.engine.vectors cimport scale3

cdef enum:
    MAX_STIFFNESS_RATIO = 100   # kappa is limited to this multiple of kappa0


cdef inline double warm_start_fraction() noexcept nogil:
    """Return gamma, the fraction of the last substep's multipliers and stiffnesses that a substep starts from."""
    return 0.99


cdef inline double compute_stabilised_gap(const engine_t* e, int32_t c) noexcept nogil:
    """Return C' [m] of a contact's normal, (1)."""
    return e.gap[c] if e.gap[c] > 0.0 else (1.0 - e.setting[S_HERTZ]) * e.gap[c]


cdef inline int32_t compute_contact_impulse(const engine_t* e, int32_t c, const double* z, double* p, double* t2, double* turn,
                                    double* error) noexcept nogil:
    """Compute the impulses p (1 or 3) of a contact by (1); return 1 if it carries load and does not slide.

    Also computes its second tangent t2, turn (rows, 6) of its axes (see `contact_displacement_along`), and
    error = C' + J z of its normal.
    """
    cdef int32_t block = e.size[N_JOINT] + c, row = e.ptr[block]
    cdef const double* n = e.normal + 3 * c
    cdef double kappa = e.push[e.size[N_JOINT_ROW] + c], friction_bound, tangential_impulse
    # normal impulse, clamped at 0
    error[0] = compute_stabilised_gap(e, c) + contact_displacement_along(e, c, z, n, turn)
    p[0] = e.impulse[row] - kappa * error[0]
    if p[0] < 0.0:
        p[0] = 0.0
    if e.mu[block] == 0.0:
        return p[0] > 0.0
    # friction, projected radially on the disk
    cross(n, e.tangent + 3 * c, t2)
    p[1] = e.impulse[row + 1] - kappa * contact_displacement_along(e, c, z, e.tangent + 3 * c, turn + 6)
    p[2] = e.impulse[row + 2] - kappa * contact_displacement_along(e, c, z, t2, turn + 12)
    friction_bound = e.mu[block] * p[0]
    tangential_impulse = sqrt(p[1] * p[1] + p[2] * p[2])
    if tangential_impulse > friction_bound:
        p[1] *= friction_bound / tangential_impulse
        p[2] *= friction_bound / tangential_impulse
        return 0
    return p[0] > 0.0


cdef inline double joint_row_impulse(const engine_t* e, int32_t i, int32_t row, const double* z) noexcept nogil:
    """Return the impulse of a joint row by (1), of a soft row by its spring and damper; a motor's error is a velocity."""
    cdef double x = joint_row_velocity(e.jac + 12 * row, z, e.joint_body[2 * i], e.joint_body[2 * i + 1])
    cdef double kappa = e.push[row], h = e.setting[S_H]
    if e.compliance[row] > 0.0:                         # engine/joints.pxd (1): 1/(h (c + h k)), target -C k/(c + h k)
        return (e.target[row] - x / h) / e.compliance[row]
    if is_rigid_joint_row(e, i, row):
        return e.impulse[row] - kappa * ((1.0 - e.setting[S_HERTZ]) * e.joint_error[row] + x)
    return clip(e.impulse[row] - kappa * (x - h * e.target[row]), e.lower[row], e.upper[row])


cdef inline void add_row_to_body_system(const double* j, double p, double kappa, double* m, double* g) noexcept nogil:
    """Add a row j (6) to the lower triangle of the matrix m of (2) and to its right-hand side g."""
    cdef int32_t k, l
    for k in range(6):
        g[k] += p * j[k]
        for l in range(k + 1):
            m[6 * k + l] += kappa * j[k] * j[l]


cdef inline void form_contact_jacobian_of_body(const double* axis, const double* turn, double sign, double* j) noexcept nogil:
    """Compute a contact's Jacobian row j (6) for one of its bodies: sign -1 for a, 1 for b."""
    scale3(sign, axis, j)
    scale3(sign, turn, j + 3)


cdef inline void add_contact_to_body_system(const engine_t* e, int32_t c, int32_t side, const double* z, double* m,
                             double* g) noexcept nogil:
    """Add the active rows of a contact to the system of its body a (side 0) or b (side 1)."""
    cdef double kappa = e.push[e.size[N_JOINT_ROW] + c], sign = 1.0 if side else -1.0, error
    cdef double p[3]
    cdef double j[6]
    cdef double t2[3]
    cdef double turn[18]
    compute_contact_impulse(e, c, z, p, t2, turn, &error)
    if p[0] == 0.0:
        return
    form_contact_jacobian_of_body(e.normal + 3 * c, turn + 3 * side, sign, j)
    add_row_to_body_system(j, p[0], kappa, m, g)
    if e.mu[e.size[N_JOINT] + c] == 0.0:
        return
    form_contact_jacobian_of_body(e.tangent + 3 * c, turn + 6 + 3 * side, sign, j)
    add_row_to_body_system(j, p[1], kappa, m, g)
    form_contact_jacobian_of_body(t2, turn + 12 + 3 * side, sign, j)
    add_row_to_body_system(j, p[2], kappa, m, g)


cdef inline int32_t add_newly_active_contact(const engine_t* e, int32_t c, int32_t side, const double* z, const double* step,
                                             double* m,
                                  double* g) noexcept nogil:
    """Add the normal row of a contact that is inactive at z but active after its body's step; return whether it was added."""
    cdef double kappa = e.push[e.size[N_JOINT_ROW] + c], p
    cdef double j[6]
    cdef double turn[6]
    p = e.impulse[e.ptr[e.size[N_JOINT] + c]] - kappa * (
        compute_stabilised_gap(e, c) + contact_displacement_along(e, c, z, e.normal + 3 * c, turn))
    form_contact_jacobian_of_body(e.normal + 3 * c, turn + 3 * side, 1.0 if side else -1.0, j)
    if p > 0.0 or p - kappa * (dot3(j, step) + dot3(j + 3, step + 3)) <= 0.0:
        return 0
    add_row_to_body_system(j, p, kappa, m, g)
    return 1


cdef inline void add_joint_to_body_system(const engine_t* e, int32_t i, int32_t side, const double* z, double* m,
                           double* g) noexcept nogil:
    """Add the rows of a joint to the system of its body a (side 0) or b (side 1)."""
    cdef int32_t row
    cdef double kappa
    for row in range(e.ptr[i], e.ptr[i + 1]):
        kappa = 1.0 / (e.setting[S_H] * e.compliance[row]) if e.compliance[row] > 0.0 else e.push[row]
        add_row_to_body_system(e.jac + 12 * row + 6 * side, joint_row_impulse(e, i, row, z), kappa, m, g)


cdef inline void solve_cholesky_6x6(double* m, double* g) noexcept nogil:
    """Solve m g' = g in place by Cholesky's L L^T; m (6, 6) is symmetric positive definite, its lower triangle is read."""
    cdef int32_t i, j, k
    cdef double s
    # factorise
    for j in range(6):
        s = m[7 * j]
        for k in range(j):
            s -= m[6 * j + k] * m[6 * j + k]
        m[7 * j] = sqrt(s) if s > 0.0 else 1.0 / 0.0        # If rounding leaves no positive pivot, this direction does not move.
        for i in range(j + 1, 6):
            s = m[6 * i + j]
            for k in range(j):
                s -= m[6 * i + k] * m[6 * j + k]
            m[6 * i + j] = s / m[7 * j]
    # substitute forwards, then backwards
    for i in range(6):
        for k in range(i):
            g[i] -= m[6 * i + k] * g[k]
        g[i] /= m[7 * i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            g[i] -= m[6 * k + i] * g[k]
        g[i] /= m[7 * i]


cdef inline void compute_world_inertia(const engine_t* e, int32_t i, double* inertia) noexcept nogil:
    """Compute the world inertia (3, 3) [kg m^2] of a dynamic body; without frames inertia is isotropic."""
    cdef int32_t b = e.body_of[i], k
    if e.size[N_FRAME] > 0:
        rotate_tensor_to_world(e.rot + 9 * b, e.inertia + 9 * b, inertia)
    else:
        for k in range(9):
            inertia[k] = e.inertia[9 * b + k]


cdef inline void step_body_descent(engine_t* e, int32_t i, const int32_t* first, const int32_t* rows) noexcept nogil:
    """Take the Newton step (2) of body i; rows[first[i]:first[i + 1]] holds 2 block + side for each of its blocks."""
    cdef double m[36]
    cdef double g[6]
    cdef double factor[36]
    cdef double step[6]
    cdef double inertia[9]
    cdef double h = e.setting[S_H], mass = 1.0 / e.inv_mass[i], x
    cdef double* z = e.shift
    cdef int32_t k, l, kj = e.size[N_JOINT], activated = 0
    for k in range(36):
        m[k] = 0.0
    # inertia: M / h and -M (z - y) / h
    compute_world_inertia(e, i, inertia)
    for k in range(3):
        m[7 * k] = mass / h
        g[k] = -mass * (z[6 * i + k] - h * e.v_free[6 * i + k]) / h
        x = 0.0
        for l in range(3):
            m[6 * (3 + k) + 3 + l] = inertia[3 * k + l] / h
            x += inertia[3 * k + l] * (z[6 * i + 3 + l] - h * e.v_free[6 * i + 3 + l])
        g[3 + k] = -x / h
    # active rows
    for k in range(first[i], first[i + 1]):
        l = rows[k] >> 1
        if l < kj:
            add_joint_to_body_system(e, l, rows[k] & 1, z, m, g)
        else:
            add_contact_to_body_system(e, l - kj, rows[k] & 1, z, m, g)
    # step; if it activates contacts, compute it once more with them
    for k in range(36):
        factor[k] = m[k]
    for k in range(6):
        step[k] = g[k]
    solve_cholesky_6x6(factor, step)
    for k in range(first[i], first[i + 1]):
        if rows[k] >> 1 >= kj:
            activated |= add_newly_active_contact(e, (rows[k] >> 1) - kj, rows[k] & 1, z, step, m, g)
    if activated:
        solve_cholesky_6x6(m, g)
    for k in range(6):
        z[6 * i + k] += g[k] if activated else step[k]


cdef inline void increase_stiffness(double* kappa, double kappa0, double error, double beta, double slop) noexcept nogil:
    """Increase a row's stiffness by (3)."""
    kappa[0] += beta * kappa0 * fabs(error) / slop
    if kappa[0] > MAX_STIFFNESS_RATIO * kappa0:
        kappa[0] = MAX_STIFFNESS_RATIO * kappa0


cdef inline void update_multipliers(engine_t* e) noexcept nogil:
    """Set lambda = p of (1) for all rows, and increase the stiffness of rows inside their bounds by (3)."""
    cdef int32_t i, c, row, k, sticks
    cdef double h = e.setting[S_H], beta = e.setting[S_RATIO], slop = e.setting[S_SLOP], x
    cdef double p[3]
    cdef double t2[3]
    cdef double turn[18]
    cdef const double* z = e.shift
    if slop < 1e-6:
        slop = 1e-6
    for i in range(e.size[N_JOINT]):
        for row in range(e.ptr[i], e.ptr[i + 1]):
            x = joint_row_impulse(e, i, row, z)
            e.impulse[row] = x
            if e.compliance[row] == 0.0 and is_rigid_joint_row(e, i, row):
                x = (1.0 - e.setting[S_HERTZ]) * e.joint_error[row]
                x += joint_row_velocity(e.jac + 12 * row, z, e.joint_body[2 * i], e.joint_body[2 * i + 1])
                increase_stiffness(e.push + row, 1.0 / (h * e.d[row]), x, beta, slop)
    for c in range(e.head[H_CONTACTS]):
        row = e.ptr[e.size[N_JOINT] + c]
        sticks = compute_contact_impulse(e, c, z, p, t2, turn, &x)
        for k in range(e.ptr[e.size[N_JOINT] + c + 1] - row):
            e.impulse[row + k] = p[k]
        if sticks:
            increase_stiffness(e.push + e.size[N_JOINT_ROW] + c, 1.0 / (h * e.d[row]), x, beta, slop)


cdef inline void warm_start_stiffness(engine_t* e, double gamma) noexcept nogil:
    """Start stiffnesses at gamma times their values after the last substep, at least kappa0, and scale lambda by gamma."""
    cdef int32_t i, c, row, k
    cdef double kappa0, h = e.setting[S_H]
    for i in range(e.size[N_JOINT]):
        for row in range(e.ptr[i], e.ptr[i + 1]):
            kappa0 = 1.0 / (h * e.d[row])
            e.push[row] = gamma * e.push[row] if e.head[H_WARM_START] else kappa0
            if not kappa0 <= e.push[row] <= MAX_STIFFNESS_RATIO * kappa0:
                e.push[row] = kappa0
            e.impulse[row] = gamma * e.impulse[row]
    for c in range(e.head[H_CONTACTS]):
        row = e.ptr[e.size[N_JOINT] + c]
        kappa0 = 1.0 / (h * e.d[row])
        k = e.size[N_JOINT_ROW] + c
        e.push[k] = gamma * e.push[k]
        if not kappa0 <= e.push[k] <= MAX_STIFFNESS_RATIO * kappa0:
            e.push[k] = kappa0
        for k in range(row, e.ptr[e.size[N_JOINT] + c + 1]):
            e.impulse[k] = gamma * e.impulse[k]


cdef inline void run_avbd_substep(engine_t* e) noexcept nogil:
    """Solve the prepared rows of a substep by passes of (2) over all bodies, and set dv = z/h - v*."""
    cdef int32_t nd = e.size[N_DYNAMIC], n = e.size[N_JOINT] + e.head[H_CONTACTS], i, _pass
    cdef int32_t* first = e.order_scratch               # (nd + 1), followed by two entries per block
    cdef int32_t* rows = first + nd + 1
    sort_blocks_by_level(2 * n, e.joint_body, nd, first, rows)
    warm_start_stiffness(e, warm_start_fraction())
    for i in range(6 * nd):
        e.shift[i] = e.setting[S_H] * e.v_free[i]
    for _pass in range(e.head[H_ITERATIONS]):
        for i in range(nd):
            step_body_descent(e, i, first, rows)
        update_multipliers(e)
    for i in range(6 * nd):
        e.dv[i] = e.shift[i] / e.setting[S_H] - e.v_free[i]
