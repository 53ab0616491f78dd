"""What this machine can do: sweeps with nothing around them, compiled with the kernels' flags.

    csr      projected Gauss-Seidel, bounds 0..   a sweep over A in compressed rows, one running sum, no blocks
    contact  normal and disk on body velocities   a sweep over contacts of 192 bytes, one record each

They are the same mathematics as `sweep/serial.pyx` (their impulses agree to rounding) without what a library
adds: block kinds, laws, joints, compliance, orders, stopping tests.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t

import numpy as np


cdef public void lav_limit_csr(int32_t m, const int32_t* indptr, const int32_t* indices, const double* data,
                               const double* b, const double* step, double* lam, int32_t n) noexcept nogil:
    cdef int32_t _s, i, k
    cdef double w, y
    for _s in range(n):
        for i in range(m):
            w = -b[i]
            for k in range(indptr[i], indptr[i + 1]):
                w += data[k] * lam[indices[k]]
            y = lam[i] - w * step[i]
            lam[i] = y if y > 0.0 else 0.0


cdef struct limit_body_t:       # 128 bytes
    double v[6]
    double inv_mass
    double inv_inertia[9]


cdef struct limit_contact_t:    # 192 bytes
    int32_t a
    int32_t b
    double normal[3]
    double tangent[3]
    double arm_a[3]
    double arm_b[3]
    double coupling[2]          # A_t1n, A_t2n
    double step[2]              # normal, tangents
    double rhs[3]
    double mu
    double lam[3]


cdef inline void limit_cross(const double* a, const double* b, double* out) noexcept nogil:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


cdef inline double limit_dot(const double* a, const double* b) noexcept nogil:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


cdef inline void limit_push(limit_body_t* x, const double* arm, const double* impulse) noexcept nogil:
    cdef double l[3]
    cdef int32_t k
    limit_cross(arm, impulse, l)
    for k in range(3):
        x.v[k] += x.inv_mass * impulse[k]
        x.v[3 + k] += limit_dot(x.inv_inertia + 3 * k, l)


cdef public void lav_limit_contact(limit_contact_t* contacts, limit_body_t* bodies, int32_t m, int32_t n) noexcept nogil:
    """bodies[0] is the ground: without mass, at rest."""
    cdef int32_t _s, i, k
    cdef limit_contact_t* c
    cdef limit_body_t* a
    cdef limit_body_t* b
    cdef double u[3]
    cdef double wa[3]
    cdef double wb[3]
    cdef double t2[3]
    cdef double impulse[3]
    cdef double y, dn, x0, x1, size, radius
    for _s in range(n):
        for i in range(m):
            c = contacts + i
            a = bodies + c.a
            b = bodies + c.b
            limit_cross(a.v + 3, c.arm_a, wa)
            limit_cross(b.v + 3, c.arm_b, wb)
            for k in range(3):
                u[k] = (b.v[k] + wb[k]) - (a.v[k] + wa[k])
            limit_cross(c.normal, c.tangent, t2)
            y = c.lam[0] - (limit_dot(c.normal, u) - c.rhs[0]) * c.step[0]
            y = y if y > 0.0 else 0.0
            dn = y - c.lam[0]
            c.lam[0] = y
            x0 = c.lam[1] - (limit_dot(c.tangent, u) - c.rhs[1] + c.coupling[0] * dn) * c.step[1]
            x1 = c.lam[2] - (limit_dot(t2, u) - c.rhs[2] + c.coupling[1] * dn) * c.step[1]
            size = x0 * x0 + x1 * x1
            radius = c.mu * y
            if size > radius * radius:
                size = radius / sqrt(size)
                x0 *= size
                x1 *= size
            for k in range(3):
                impulse[k] = dn * c.normal[k] + (x0 - c.lam[1]) * c.tangent[k] + (x1 - c.lam[2]) * t2[k]
            c.lam[1] = x0
            c.lam[2] = x1
            limit_push(b, c.arm_b, impulse)
            for k in range(3):
                impulse[k] = -impulse[k]
            limit_push(a, c.arm_a, impulse)


def csr(const int32_t[::1] indptr, const int32_t[::1] indices, const double[::1] data, const double[::1] b,
        const double[::1] step, double[::1] lam, int n):
    """n sweeps over rows bounded by 0 below, in place."""
    lav_limit_csr(<int32_t>b.shape[0], &indptr[0], &indices[0], &data[0], &b[0], &step[0], &lam[0], n)


#: One contact and one body as records, for arrays of zeros.
CONTACT = np.dtype([("body", np.int32, 2), ("normal", float, 3), ("tangent", float, 3), ("arm_a", float, 3),
                    ("arm_b", float, 3), ("coupling", float, 2), ("step", float, 2), ("rhs", float, 3),
                    ("mu", float), ("lam", float, 3)])
BODY = np.dtype([("v", float, 6), ("inv_mass", float), ("inv_inertia", float, 9)])
assert CONTACT.itemsize == sizeof(limit_contact_t) and BODY.itemsize == sizeof(limit_body_t)


def contact(unsigned char[::1] contacts, unsigned char[::1] bodies, int n):
    """n sweeps in place over arrays of CONTACT and BODY, seen as bytes; body 0 is the ground."""
    if contacts.shape[0]:
        lav_limit_contact(<limit_contact_t*>&contacts[0], <limit_body_t*>&bodies[0],
                          <int32_t>(contacts.shape[0] // <Py_ssize_t>sizeof(limit_contact_t)), n)
