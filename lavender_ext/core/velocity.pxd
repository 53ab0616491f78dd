"""Velocity change M^-1 J^T lam of all impulses: wrenches are summed on each body, then multiplied by M^-1 once per body.

    f_i = sum of J^T lam over the blocks of body i      (linear [N s], angular [N m s])
    v_i = (f_i / m_i, I_i^-1 l_i)                                                              (1)
"""
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport blocks_t, count_tangent_rows, count_angular_rows
from lavender_ext.core.rows cimport cross, dot3
from lavender_ext.core.view cimport rows_t


cdef inline void add_vector_6(double* total, const double* x) noexcept nogil:
    """Add x (6) to `total`."""
    cdef int32_t k
    for k in range(6):
        total[k] += x[k]


cdef inline void add_contact_wrench(const rows_t* r, int32_t c, int32_t nt, int32_t n_angular, const double* lam,
                                    double* f) noexcept nogil:
    """Add J^T lam of contact c to f (n, 6); lam points at its normal."""
    cdef double t2[3]
    cdef double x[3]
    cdef double l[3]
    cdef double twist[3]
    cdef const double* n = r.normal + 3 * c
    cdef const double* rolling = lam + 1 + nt + (n_angular & 1)
    cdef int32_t k, a = r.contact_body[2 * c], b = r.contact_body[2 * c + 1]
    if nt > 1:
        cross(n, r.tangent + 3 * c, t2)
    for k in range(3):
        x[k] = lam[0] * n[k]
        if nt > 0:
            x[k] += lam[1] * r.tangent[3 * c + k]
        if nt > 1:
            x[k] += lam[2] * t2[k]
        twist[k] = lam[1 + nt] * n[k] if n_angular & 1 else 0.0
        if n_angular & 2:
            twist[k] += rolling[0] * r.tangent[3 * c + k] + rolling[1] * t2[k]
    if a >= 0:
        cross(r.arm_a + 3 * c, x, l)
        for k in range(3):
            f[6 * a + k] -= x[k]
            f[6 * a + 3 + k] -= l[k] + twist[k] if n_angular else l[k]
    if b >= 0:
        cross(r.arm_b + 3 * c, x, l)
        for k in range(3):
            f[6 * b + k] += x[k]
            f[6 * b + 3 + k] += l[k] + twist[k] if n_angular else l[k]


cdef inline void apply_body_inverse_mass(const rows_t* r, double* v) noexcept nogil:
    """Multiply wrenches v (n, 6) by M^-1 in place (1)."""
    cdef int32_t i, k
    cdef double l[3]
    cdef double* x = v
    cdef const double* inv = r.inv_inertia
    for i in range(r.n_bodies):
        for k in range(3):
            x[k] *= r.inv_mass[i]
            l[k] = x[3 + k]
        for k in range(3):
            x[3 + k] = dot3(inv + 3 * k, l)
        x += 6
        inv += 9


cdef inline void compute_body_wrenches(const blocks_t* p, const rows_t* r, const double* lam, double* f) noexcept nogil:
    """Compute f (n, 6) = J^T lam of all blocks."""
    cdef int32_t i, j, k, c, nt, n_angular
    cdef double x[12]
    cdef const double* row
    for i in range(6 * r.n_bodies):
        f[i] = 0.0
    for i in range(r.n_joints):
        for k in range(12):
            x[k] = 0.0
        for j in range(p.ptr[i], p.ptr[i + 1]):
            row = r.jac + 12 * j
            for k in range(12):
                x[k] += row[k] * lam[j]
        if r.joint_body[2 * i] >= 0:
            add_vector_6(f + 6 * r.joint_body[2 * i], x)
        if r.joint_body[2 * i + 1] >= 0:
            add_vector_6(f + 6 * r.joint_body[2 * i + 1], x + 6)
    for c in range(r.n_contacts):
        i = r.n_joints + c
        j = p.ptr[i]
        nt = count_tangent_rows(p, i)
        n_angular = count_angular_rows(p, i)
        if n_angular or nt == 1:                            # The two common kinds below are compiled with constant sizes.
            add_contact_wrench(r, c, nt, n_angular, lam + j, f)
        elif nt == 2:
            add_contact_wrench(r, c, 2, 0, lam + j, f)
        else:
            add_contact_wrench(r, c, 0, 0, lam + j, f)


cdef inline void compute_velocity_change(const blocks_t* p, const rows_t* r, const double* lam, double* v) noexcept nogil:
    """Compute v (n, 6) = M^-1 J^T lam of all blocks by (1)."""
    compute_body_wrenches(p, r, lam, v)
    apply_body_inverse_mass(r, v)
