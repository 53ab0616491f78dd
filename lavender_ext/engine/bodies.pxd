"""Bodies in free flight: frames, quaternions, and an integration step that conserves angular momentum.

    q <- q + 1/2 h (0, omega) q, normalised                                                    (1)
    I = R I_body R^T,   L = I omega                                                            (2)

A body with anisotropic inertia is integrated by the midpoint rule at constant L [N m s]:

    q' = (1) over h/2 with omega,  omega' = I(q')^-1 L,                                        (3)
    q <- (1) over h with omega',   omega <- I(q)^-1 L

so the gyroscopic term conserves angular momentum to rounding and energy to O(h^2). Isotropic inertia
(spheres, cubes) needs (1) alone.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.validate cimport find_invalid_number
from lavender_ext.engine.arrays cimport (ALTERNATING, COLORED_PAIRS, H_KEPT, H_ORDER, H_PHASE, H_STEP, N_BODY, N_DYNAMIC, N_FRAME,
                                         S_GRAVITY, S_H, engine_t)
from lavender_ext.core.vectors cimport copy3, add_scaled3, matvec3


cdef inline void compute_rotation_matrix(const double* q, double* r) noexcept nogil:
    """Compute the rotation matrix r (3, 3), body to world, of a unit quaternion w, x, y, z."""
    cdef double w = q[0], x = q[1], y = q[2], z = q[3]
    r[0] = 1.0 - 2.0 * (y * y + z * z)
    r[1] = 2.0 * (x * y - w * z)
    r[2] = 2.0 * (x * z + w * y)
    r[3] = 2.0 * (x * y + w * z)
    r[4] = 1.0 - 2.0 * (x * x + z * z)
    r[5] = 2.0 * (y * z - w * x)
    r[6] = 2.0 * (x * z - w * y)
    r[7] = 2.0 * (y * z + w * x)
    r[8] = 1.0 - 2.0 * (x * x + y * y)


cdef inline void rotate_to_world(const double* r, const double* a, double* out) noexcept nogil:
    """Rotate a vector from the body's frame to the world: out = R a."""
    matvec3(r, a, out)


cdef inline void rotate_to_body(const double* r, const double* a, double* out) noexcept nogil:
    """Rotate a vector from the world to the body's frame: out = R^T a."""
    cdef int32_t k
    for k in range(3):
        out[k] = r[k] * a[0] + r[3 + k] * a[1] + r[6 + k] * a[2]


cdef inline void rotate_quaternion(double* q, const double* omega, double h) noexcept nogil:
    """Rotate the quaternion q by omega [rad/s] over h [s], (1)."""
    cdef double w = q[0], x = q[1], y = q[2], z = q[3], s, f = 0.5 * h
    cdef double a = f * omega[0], b = f * omega[1], c = f * omega[2]
    q[0] = w - (a * x + b * y + c * z)
    q[1] = x + (a * w + b * z - c * y)
    q[2] = y + (b * w + c * x - a * z)
    q[3] = z + (c * w + a * y - b * x)
    s = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    s = 1.0 / sqrt(s)
    q[0] *= s
    q[1] *= s
    q[2] *= s
    q[3] *= s


cdef inline void rotate_tensor_to_world(const double* r, const double* body, double* out) noexcept nogil:
    """Transform a symmetric tensor to the world, out = R T R^T; out is exactly symmetric."""
    cdef double t[9]
    cdef int32_t i, j
    for i in range(3):
        for j in range(3):
            t[3 * i + j] = r[3 * i] * body[j] + r[3 * i + 1] * body[3 + j] + r[3 * i + 2] * body[6 + j]
    for i in range(3):
        for j in range(i, 3):
            out[3 * i + j] = t[3 * i] * r[3 * j] + t[3 * i + 1] * r[3 * j + 1] + t[3 * i + 2] * r[3 * j + 2]
            out[3 * j + i] = out[3 * i + j]


cdef inline void multiply_by_world_tensor(const double* r, const double* body, const double* a, double* out) noexcept nogil:
    """Compute out = R T R^T a: a tensor in the body's frame times a world vector."""
    cdef double s[3]
    cdef double t[3]
    rotate_to_body(r, a, s)
    matvec3(body, s, t)
    rotate_to_world(r, t, out)


cdef inline void advance_rotation(double* q, double* omega, const double* inertia, const double* inv_inertia,
                                  double h) noexcept nogil:
    """Advance q and omega over h at constant angular momentum, (3)."""
    cdef double r[9]
    cdef double half[4]
    cdef double momentum[3]
    cdef double middle[3]
    cdef int32_t k
    compute_rotation_matrix(q, r)
    multiply_by_world_tensor(r, inertia, omega, momentum)
    for k in range(4):
        half[k] = q[k]
    rotate_quaternion(half, omega, 0.5 * h)
    compute_rotation_matrix(half, r)
    multiply_by_world_tensor(r, inv_inertia, momentum, middle)
    rotate_quaternion(q, middle, h)
    compute_rotation_matrix(q, r)
    multiply_by_world_tensor(r, inv_inertia, momentum, omega)


cdef inline int32_t are_contacts_new(const engine_t* e) noexcept nogil:
    """Return whether the coming substep builds all contacts anew."""
    return e.head[H_PHASE] == 0 and not e.head[H_KEPT]


cdef inline int32_t get_sweep_direction(const engine_t* e) noexcept nogil:
    """Return 1 if the substep visits the contacts in reverse, else 0; the order of reference is that of their numbers or colours.

    Under the alternating order, the first substep of the step has numbered the contacts in its order.
    """
    if e.head[H_ORDER] == COLORED_PAIRS:
        return e.head[H_STEP] & 1
    return e.head[H_PHASE] & 1 if e.head[H_ORDER] == ALTERNATING else 0


cdef inline void begin_body_substep(engine_t* e) noexcept nogil:
    """Compute frames, world inverse inertia and v* = v + h g of the coming substep.

    A body whose contacts keep their rows keeps its inverse inertia, so that A = J M^-1 J^T has one M.
    """
    cdef int32_t i, b
    cdef double h = e.setting[S_H]
    cdef const double* g = e.setting + S_GRAVITY
    if e.size[N_FRAME] > 0:
        for i in range(e.size[N_BODY]):
            compute_rotation_matrix(e.q + 4 * i, e.rot + 9 * i)
    for i in range(e.size[N_DYNAMIC]):
        b = e.body_of[i]
        if e.uneven[b] and (are_contacts_new(e) or e.due[b]):
            rotate_tensor_to_world(e.rot + 9 * b, e.inv_inertia_body + 9 * b, e.inv_inertia + 9 * i)
        add_scaled3(e.v + 6 * b, h, g, e.v_free + 6 * i)
        copy3(e.v + 6 * b + 3, e.v_free + 6 * i + 3)


cdef inline int32_t advance_bodies(engine_t* e, int32_t shifted) noexcept nogil:
    """Set v = v* + dv, advance the poses over h by v, and add the shift of the position projection.

    Returns the first body with a state out of range or not finite, or -1.
    """
    cdef int32_t i, k, b, lost = -1
    cdef double h = e.setting[S_H]
    cdef double* v
    cdef double* x
    cdef double* q
    for i in range(e.size[N_DYNAMIC]):
        b = e.body_of[i]
        v = e.v + 6 * b
        x = e.x + 3 * b
        q = e.q + 4 * b
        for k in range(6):
            v[k] = e.v_free[6 * i + k] + e.dv[6 * i + k]
        add_scaled3(x, h, v, x)
        if e.uneven[b]:
            advance_rotation(q, v + 3, e.inertia + 9 * b, e.inv_inertia_body + 9 * b, h)
        elif v[3] != 0.0 or v[4] != 0.0 or v[5] != 0.0:
            rotate_quaternion(q, v + 3, h)
        if shifted:
            add_scaled3(x, 1.0, e.shift + 6 * i, x)
            rotate_quaternion(q, e.shift + 6 * i + 3, 1.0)
        # the range that core/validate.pxd (1) allows
        if lost < 0 and (find_invalid_number(v, 6) >= 0 or find_invalid_number(x, 3) >= 0 or find_invalid_number(q, 4) >= 0):
            lost = b
    return lost
