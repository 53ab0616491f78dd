"""Block descent over bodies with an augmented Lagrangian (Giles, Diaz, Yuksel, "Augmented Vertex Block Descent", 2025).

Displacements z of a substep, 6 a body [m, rad], y = h v* those of free flight, J z linear in them, C the error of a
row at the start, lambda its multiplier [N s], kappa its stiffness [N s/m]. With impulses p of the rows

    normal    p = max(0, lambda - kappa (C' + J z))        C' = C where the gap is open, (1 - alpha) C where not
    tangents  p = lambda - kappa J z, in the disk mu p_n                                              (1)
    joint     p = clip(lambda - kappa ((1 - alpha) C + J z), bounds)

body after body takes the Newton step of (1/2h) (z - y).M (z - y) + sum over its rows:

    (M/h + sum kappa J^T J) dz = -M (z - y)/h + sum J^T p                                             (2)

over the rows that push. Where a contact that did not would push after that step (the next step would open it again, and
so on, through the ground), the step is taken once more with its row, of lambda - kappa (C' + J z) < 0, too. Then all rows
take lambda <- p, and those inside their bounds

    kappa <- kappa + beta kappa0 |C' + J z| / slop,   kappa0 = 1/(h A_ii)                             (3)

A soft joint keeps kappa = h k + c and lambda = 0. lambda and kappa of a contact begin at gamma times what the cache has
of the last substep (kappa in the place of the spin row, which this stepper does not know), never below kappa0. The
share alpha of an error is left where it is, so that a substep takes away no more than 1 - alpha of it. v = z/h.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport clip
from lavender_ext.core.order cimport sort_by_level
from lavender_ext.core.rows cimport cross, dot3, joint_velocity
from lavender_ext.engine.arrays cimport (H_CONTACTS, H_ITERATIONS, H_WARM_START, N_DYNAMIC, N_FRAME, N_JOINT,
                                         N_JOINT_ROW, S_H, S_HERTZ, S_RATIO, S_SLOP, engine_t)
from lavender_ext.engine.bodies cimport world_tensor
from lavender_ext.engine.projection cimport displacement, rigid_row
from lavender_ext.engine.vectors cimport scale3

cdef enum:
    STIFFEST = 100              # times kappa0


cdef inline double fading() noexcept nogil:
    return 0.99                                         # gamma


cdef inline double normal_error(const engine_t* e, int32_t c) noexcept nogil:
    return e.gap[c] if e.gap[c] > 0.0 else (1.0 - e.setting[S_HERTZ]) * e.gap[c]


cdef inline int32_t contact_impulse(const engine_t* e, int32_t c, const double* z, double* p, double* t2, double* turn,
                                    double* error) noexcept nogil:
    """(1) of a contact: p (1 or 3); 1 where it bears and does not slide.

    And its second tangent, turn (rows, 6) of its axes, and C' + J z of its normal.
    """
    cdef int32_t block = e.size[N_JOINT] + c, row = e.ptr[block]
    cdef const double* n = e.normal + 3 * c
    cdef double kappa = e.push[e.size[N_JOINT_ROW] + c], r, s
    error[0] = normal_error(e, c) + displacement(e, c, z, n, turn)
    p[0] = e.impulse[row] - kappa * error[0]
    if p[0] < 0.0:
        p[0] = 0.0
    if e.mu[block] == 0.0:
        return p[0] > 0.0
    cross(n, e.tangent + 3 * c, t2)
    p[1] = e.impulse[row + 1] - kappa * displacement(e, c, z, e.tangent + 3 * c, turn + 6)
    p[2] = e.impulse[row + 2] - kappa * displacement(e, c, z, t2, turn + 12)
    r = e.mu[block] * p[0]
    s = sqrt(p[1] * p[1] + p[2] * p[2])
    if s > r:
        p[1] *= r / s
        p[2] *= r / s
        return 0
    return p[0] > 0.0


cdef inline double joint_impulse(const engine_t* e, int32_t i, int32_t row, const double* z) noexcept nogil:
    """(1) of a joint row; a motor's error is a speed, a soft row has its spring and damper."""
    cdef double x = joint_velocity(e.jac + 12 * row, z, e.joint_body[2 * i], e.joint_body[2 * i + 1])
    cdef double kappa = e.push[row], h = e.setting[S_H]
    if e.compliance[row] > 0.0:                         # of engine/joints.pxd: 1/(h (c + h k)), target -C k/(c + h k)
        return (e.target[row] - x / h) / e.compliance[row]
    if rigid_row(e, i, row):
        return e.impulse[row] - kappa * ((1.0 - e.setting[S_HERTZ]) * e.joint_error[row] + x)
    return clip(e.impulse[row] - kappa * (x - h * e.target[row]), e.lower[row], e.upper[row])


cdef inline void add_row(const double* j, double p, double kappa, double* m, double* g) noexcept nogil:
    # lower half of the matrix of (2), and its right-hand side
    cdef int32_t k, l
    for k in range(6):
        g[k] += p * j[k]
        for l in range(k + 1):
            m[6 * k + l] += kappa * j[k] * j[l]


cdef inline void contact_row(const double* axis, const double* turn, double sign, double* j) noexcept nogil:
    scale3(sign, axis, j)
    scale3(sign, turn, j + 3)


cdef inline void add_contact(const engine_t* e, int32_t c, int32_t side, const double* z, double* m,
                             double* g) noexcept nogil:
    cdef double kappa = e.push[e.size[N_JOINT_ROW] + c], sign = 1.0 if side else -1.0, error
    cdef double p[3]
    cdef double j[6]
    cdef double t2[3]
    cdef double turn[18]
    contact_impulse(e, c, z, p, t2, turn, &error)
    if p[0] == 0.0:
        return
    contact_row(e.normal + 3 * c, turn + 3 * side, sign, j)
    add_row(j, p[0], kappa, m, g)
    if e.mu[e.size[N_JOINT] + c] == 0.0:
        return
    contact_row(e.tangent + 3 * c, turn + 6 + 3 * side, sign, j)
    add_row(j, p[1], kappa, m, g)
    contact_row(t2, turn + 12 + 3 * side, sign, j)
    add_row(j, p[2], kappa, m, g)


cdef inline int32_t add_met(const engine_t* e, int32_t c, int32_t side, const double* z, const double* step, double* m,
                            double* g) noexcept nogil:
    """Whether a contact that does not push at z would after the step of its body; its row is then added."""
    cdef double kappa = e.push[e.size[N_JOINT_ROW] + c], p
    cdef double j[6]
    cdef double turn[6]
    p = e.impulse[e.ptr[e.size[N_JOINT] + c]] - kappa * (normal_error(e, c) + displacement(e, c, z, e.normal + 3 * c, turn))
    contact_row(e.normal + 3 * c, turn + 3 * side, 1.0 if side else -1.0, j)
    if p > 0.0 or p - kappa * (dot3(j, step) + dot3(j + 3, step + 3)) <= 0.0:
        return 0
    add_row(j, p, kappa, m, g)
    return 1


cdef inline void add_joint(const engine_t* e, int32_t i, int32_t side, const double* z, double* m,
                           double* g) noexcept nogil:
    cdef int32_t row
    cdef double kappa
    for row in range(e.ptr[i], e.ptr[i + 1]):
        kappa = 1.0 / (e.setting[S_H] * e.compliance[row]) if e.compliance[row] > 0.0 else e.push[row]
        add_row(e.jac + 12 * row + 6 * side, joint_impulse(e, i, row, z), kappa, m, g)


cdef inline void solve_6(double* m, double* g) noexcept nogil:
    """g <- m^-1 g by L L^T in place; m (6, 6) symmetric and definite, its lower half is read."""
    cdef int32_t i, j, k
    cdef double s
    for j in range(6):
        s = m[7 * j]
        for k in range(j):
            s -= m[6 * j + k] * m[6 * j + k]
        m[7 * j] = sqrt(s) if s > 0.0 else 1.0 / 0.0        # what rounding took away moves nothing
        for i in range(j + 1, 6):
            s = m[6 * i + j]
            for k in range(j):
                s -= m[6 * i + k] * m[6 * j + k]
            m[6 * i + j] = s / m[7 * j]
    for i in range(6):
        for k in range(i):
            g[i] -= m[6 * i + k] * g[k]
        g[i] /= m[7 * i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            g[i] -= m[6 * k + i] * g[k]
        g[i] /= m[7 * i]


cdef inline void mass_matrix(const engine_t* e, int32_t i, double* inertia) noexcept nogil:
    # world inertia (3, 3) of a body; without frames it has no direction
    cdef int32_t b = e.body_of[i], k
    if e.size[N_FRAME] > 0:
        world_tensor(e.rot + 9 * b, e.inertia + 9 * b, inertia)
    else:
        for k in range(9):
            inertia[k] = e.inertia[9 * b + k]


cdef inline void descend(engine_t* e, int32_t i, const int32_t* first, const int32_t* rows) noexcept nogil:
    """(2) of body i; rows[first[i]:first[i + 1]]: its blocks, twice their number, plus the side that it is on."""
    cdef double m[36]
    cdef double g[6]
    cdef double factor[36]
    cdef double step[6]
    cdef double inertia[9]
    cdef double h = e.setting[S_H], mass = 1.0 / e.inv_mass[i], x
    cdef double* z = e.shift
    cdef int32_t k, l, kj = e.size[N_JOINT], met = 0
    for k in range(36):
        m[k] = 0.0
    mass_matrix(e, i, inertia)
    for k in range(3):
        m[7 * k] = mass / h
        g[k] = -mass * (z[6 * i + k] - h * e.v_free[6 * i + k]) / h
        x = 0.0
        for l in range(3):
            m[6 * (3 + k) + 3 + l] = inertia[3 * k + l] / h
            x += inertia[3 * k + l] * (z[6 * i + 3 + l] - h * e.v_free[6 * i + 3 + l])
        g[3 + k] = -x / h
    for k in range(first[i], first[i + 1]):
        l = rows[k] >> 1
        if l < kj:
            add_joint(e, l, rows[k] & 1, z, m, g)
        else:
            add_contact(e, l - kj, rows[k] & 1, z, m, g)
    for k in range(36):
        factor[k] = m[k]
    for k in range(6):
        step[k] = g[k]
    solve_6(factor, step)
    for k in range(first[i], first[i + 1]):
        if rows[k] >> 1 >= kj:
            met |= add_met(e, (rows[k] >> 1) - kj, rows[k] & 1, z, step, m, g)
    if met:
        solve_6(m, g)
    for k in range(6):
        z[6 * i + k] += g[k] if met else step[k]


cdef inline void stiffen(double* kappa, double least, double error, double beta, double slop) noexcept nogil:
    # (3)
    kappa[0] += beta * least * fabs(error) / slop
    if kappa[0] > STIFFEST * least:
        kappa[0] = STIFFEST * least


cdef inline void take_multipliers(engine_t* e) noexcept nogil:
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
            x = joint_impulse(e, i, row, z)
            e.impulse[row] = x
            if e.compliance[row] == 0.0 and rigid_row(e, i, row):
                x = (1.0 - e.setting[S_HERTZ]) * e.joint_error[row]
                x += joint_velocity(e.jac + 12 * row, z, e.joint_body[2 * i], e.joint_body[2 * i + 1])
                stiffen(e.push + row, 1.0 / (h * e.d[row]), x, beta, slop)
    for c in range(e.head[H_CONTACTS]):
        row = e.ptr[e.size[N_JOINT] + c]
        sticks = contact_impulse(e, c, z, p, t2, turn, &x)
        for k in range(e.ptr[e.size[N_JOINT] + c + 1] - row):
            e.impulse[row + k] = p[k]
        if sticks:
            stiffen(e.push + e.size[N_JOINT_ROW] + c, 1.0 / (h * e.d[row]), x, beta, slop)


cdef inline void start_stiffness(engine_t* e, double gamma) noexcept nogil:
    """kappa0, or gamma times what the last substep left; guesses times gamma."""
    cdef int32_t i, c, row, k
    cdef double least, h = e.setting[S_H]
    for i in range(e.size[N_JOINT]):
        for row in range(e.ptr[i], e.ptr[i + 1]):
            least = 1.0 / (h * e.d[row])
            e.push[row] = gamma * e.push[row] if e.head[H_WARM_START] else least
            if not least <= e.push[row] <= STIFFEST * least:
                e.push[row] = least
            e.impulse[row] = gamma * e.impulse[row]
    for c in range(e.head[H_CONTACTS]):
        row = e.ptr[e.size[N_JOINT] + c]
        least = 1.0 / (h * e.d[row])
        k = e.size[N_JOINT_ROW] + c
        e.push[k] = gamma * e.push[k]
        if not least <= e.push[k] <= STIFFEST * least:
            e.push[k] = least
        for k in range(row, e.ptr[e.size[N_JOINT] + c + 1]):
            e.impulse[k] = gamma * e.impulse[k]


cdef inline void descend_all(engine_t* e) noexcept nogil:
    """The whole substep on the prepared rows; dv = z/h - v*."""
    cdef int32_t nd = e.size[N_DYNAMIC], n = e.size[N_JOINT] + e.head[H_CONTACTS], i, _pass
    cdef int32_t* first = e.order_scratch               # (nd + 1), then two entries a block
    cdef int32_t* rows = first + nd + 1
    sort_by_level(2 * n, e.joint_body, nd, first, rows)
    start_stiffness(e, fading())
    for i in range(6 * nd):
        e.shift[i] = e.setting[S_H] * e.v_free[i]
    for _pass in range(e.head[H_ITERATIONS]):
        for i in range(nd):
            descend(e, i, first, rows)
        take_multipliers(e)
    for i in range(6 * nd):
        e.dv[i] = e.shift[i] / e.setting[S_H] - e.v_free[i]
