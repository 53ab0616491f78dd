"""The engine's velocity problem as the shared kernels see it, and what an observation says of its contacts."""
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport COULOMB, blocks_t, row_error
from lavender_ext.core.rows cimport dot3, relative_velocity, rows_t
from lavender_ext.engine.arrays cimport H_CONTACTS, H_CONTACT_ROWS, N_DYNAMIC, N_JOINT, N_JOINT_ROW, engine_t


cdef inline void view(const engine_t* e, blocks_t* p, rows_t* r) noexcept nogil:
    # nu = d: right for contacts without spin and for linear joint rows; whoever judges other rows sets it
    p.n_blocks = e.size[N_JOINT] + e.head[H_CONTACTS]
    p.n_rows = e.size[N_JOINT_ROW] + e.head[H_CONTACT_ROWS]
    p.law = COULOMB
    p.ptr = e.ptr
    p.kind = e.kind
    p.lower = e.lower
    p.upper = e.upper
    p.mu = e.mu
    p.patch_radius = e.patch_radius
    p.b = e.b
    p.d = e.d
    p.nu = e.d
    p.step = e.step
    r.n_bodies = e.size[N_DYNAMIC]
    r.n_joints = e.size[N_JOINT]
    r.n_contacts = e.head[H_CONTACTS]
    r.jac = e.jac
    r.minv_jac = e.minv_jac
    r.joint_body = e.joint_body
    r.normal = e.normal
    r.tangent = e.tangent
    r.arm_a = e.arm_a
    r.arm_b = e.arm_b
    r.contact_body = e.contact_body
    r.coupling = e.coupling
    r.swing = e.swing
    r.inv_mass = e.inv_mass
    r.inv_inertia = e.inv_inertia
    r.compliance = e.compliance


cdef inline double normal_speed(const engine_t* e, const double* v, int32_t c) noexcept nogil:
    cdef double u[3]
    cdef double s[3]
    relative_velocity(v, e.contact_body[2 * c], e.contact_body[2 * c + 1], e.arm_a + 3 * c, e.arm_b + 3 * c,
                      u, s)
    return dot3(e.normal + 3 * c, u)


cdef inline void measure(const engine_t* e, double* residual, double* violation) noexcept nogil:
    # max |e_n| [N s] and max(0, -w_n) [m/s] over the contacts, w_n = J dv + c lam - b
    cdef int32_t c, row
    cdef double w, x, inf = 1.0 / 0.0, big = 0.0, low = 0.0
    for c in range(e.head[H_CONTACTS]):
        row = e.ptr[e.size[N_JOINT] + c]
        w = normal_speed(e, e.dv, c) + (e.compliance[row] * e.impulse[row] - e.b[row])
        x = row_error(e.impulse[row], w, e.d[row], 0.0, inf)
        x = -x if x < 0.0 else x
        if not x <= big:
            big = x
        if not -w <= low:
            low = -w
    residual[0] = big
    violation[0] = low
