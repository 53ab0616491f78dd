"""Velocity weight nu: d, except on angular rows of blocks that also have linear rows.

    spin, rolling rows  nu = d of their normal                                                 (1)
    angular joint row   nu = 1/m_a + 1/m_b                                                     (2)
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport blocks_t, count_angular_rows
from lavender_ext.core.view cimport rows_t


cdef inline void compute_velocity_weights(const blocks_t* p, const double* d, double* nu) noexcept nogil:
    """Compute nu (m) if only a matrix is known: d (m), with (1) on angular rows."""
    cdef int32_t i, j, end
    for j in range(p.n_rows):
        nu[j] = d[j]
    for i in range(p.n_blocks):
        end = p.ptr[i + 1]
        for j in range(end - count_angular_rows(p, i), end):
            nu[j] = d[p.ptr[i]]


cdef inline void set_angular_joint_weights(const blocks_t* p, const rows_t* r, double* nu) noexcept nogil:
    """Apply (2) to the angular joint rows, after `compute_velocity_weights`."""
    cdef int32_t i, q, t, a, b
    cdef double linear, inv
    for i in range(r.n_joints):
        a = r.joint_body[2 * i]
        b = r.joint_body[2 * i + 1]
        for q in range(p.ptr[i], p.ptr[i + 1]):
            linear = 0.0
            for t in range(3):
                linear += fabs(r.jac[12 * q + t]) + fabs(r.jac[12 * q + 6 + t])
            if linear == 0.0:
                inv = 0.0
                if a >= 0:
                    inv += r.inv_mass[a]
                if b >= 0:
                    inv += r.inv_mass[b]
                if inv > 0.0:
                    nu[q] = inv
