"""The update of the rows of a joint between two bodies, for one joint or for two (core/numbers.pxd)."""
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.numbers cimport clip_number, convert_to_type_of, number_t
from lavender_ext.core.view cimport rows_t


cdef struct joint_t:                # arrays of `number_t` that the update of a joint reads
    int32_t n_rows
    const double* compliance        # (n_rows) 1/kg
    const double* b                 # (n_rows) m/s
    const double* step              # (n_rows) kg
    const double* lower             # (n_rows) N s
    const double* upper             # (n_rows) N s
    const double* jac               # (n_rows, 12) as in rows_t
    const double* minv_jac          # (n_rows, 12)
    int32_t body_a                  # negative: static
    int32_t body_b


cdef inline void relax_joint(const joint_t* joint, number_t* lam, number_t* va, number_t* vb) noexcept nogil:
    """Update the rows of a joint in sequence by (1) of core/block.pxd, with w = J v + c lam - b."""
    cdef const number_t* compliance = <const number_t*>joint.compliance
    cdef const number_t* b = <const number_t*>joint.b
    cdef const number_t* step = <const number_t*>joint.step
    cdef const number_t* lower = <const number_t*>joint.lower
    cdef const number_t* upper = <const number_t*>joint.upper
    cdef const number_t* jac = <const number_t*>joint.jac
    cdef const number_t* minv_jac = <const number_t*>joint.minv_jac
    cdef number_t velocity_a, velocity_b, slack, impulse, change
    cdef int32_t row, k
    for row in range(joint.n_rows):
        # slack
        velocity_a = convert_to_type_of(lam, 0.0)
        velocity_b = convert_to_type_of(lam, 0.0)
        if joint.body_a >= 0:
            for k in range(6):
                velocity_a = velocity_a + jac[k] * va[k]
        if joint.body_b >= 0:
            for k in range(6):
                velocity_b = velocity_b + jac[6 + k] * vb[k]
        slack = ((velocity_a + velocity_b) + compliance[row] * lam[row]) - b[row]
        # impulse
        impulse = clip_number(lam[row] - slack * step[row], lower[row], upper[row])
        change = impulse - lam[row]
        lam[row] = impulse
        # velocities of both bodies
        if joint.body_a >= 0:
            for k in range(6):
                va[k] = va[k] + change * minv_jac[k]
        if joint.body_b >= 0:
            for k in range(6):
                vb[k] = vb[k] + change * minv_jac[6 + k]
        jac += 12
        minv_jac += 12


cdef inline void bind_joint_arrays(const blocks_t* p, const rows_t* r, int32_t i, joint_t* out) noexcept nogil:
    """Point `out` at the arrays of joint i."""
    cdef int32_t j = p.ptr[i]
    out.n_rows = p.ptr[i + 1] - j
    out.compliance, out.b, out.step = r.compliance + j, p.b + j, p.step + j
    out.lower, out.upper = p.lower + j, p.upper + j
    out.jac, out.minv_jac = r.jac + 12 * j, r.minv_jac + 12 * j
    out.body_a, out.body_b = r.joint_body[2 * i], r.joint_body[2 * i + 1]


cdef inline void relax_joint_block(const blocks_t* p, const rows_t* r, int32_t i, double* lam, double* v) noexcept nogil:
    """Update joint block i; lam (m), v (n_bodies, 6)."""
    cdef joint_t joint
    bind_joint_arrays(p, r, i, &joint)
    relax_joint(&joint, lam + p.ptr[i], v + 6 * <ssize_t>r.joint_body[2 * i], v + 6 * <ssize_t>r.joint_body[2 * i + 1])
