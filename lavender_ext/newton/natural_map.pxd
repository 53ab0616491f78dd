"""The natural map F = z - Pi(z - s) of every element and its derivative, for Newton steps, and the judge's error from F.

With a proximal weight eps on what is fixed by H alone,

    (I - P + P (theta + eps)) dz + P K dy = r,   dy = K^T dz,   P in the derivative of Pi         (5)

which with E = I - P + P (theta + eps) is (2) of elements.pxd for V = E^-1 P, r -> P^-1 r. For Coulomb friction the
radius of the disk is a_t max(0, z_n - s_n) (Alart and Curnier 1991), P is not symmetric, and N is factored by block
LU.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport length
from lavender_ext.core.contact_map cimport contact_map
from lavender_ext.core.block_types cimport CONE, friction_components_t
from lavender_ext.newton.elements cimport element_parts, elements_t, invert_small, is_row


cdef inline void natural_contact(const elements_t* e, int32_t i, int32_t law, const double* z, const double* s, double* f,
                                 double* p) noexcept nogil:
    """F (nr) and P (nr, nr) of one contact, Pi in the metric of d."""
    cdef int32_t nr = e.ptr[i + 1] - e.ptr[i], k
    cdef double y[6]
    cdef friction_components_t q
    element_parts(e, i, &q)
    for k in range(nr):
        y[k] = z[k] - s[k]
    contact_map(law, &q, y, f, p)
    for k in range(nr):
        f[k] = s[k] if f[k] == y[k] else z[k] - f[k]


cdef inline double natural(const elements_t* e, const double* z, const double* s, int32_t law, double eps,
                               double* f, double* p, double* einv, double* v) noexcept nogil:
    """F, P, E^-1 and V = E^-1 P of (5) for every element; returns |F|, the judge's energy error.

    law: CONE or COULOMB. einv, v may be NULL: F and P alone.
    """
    cdef int32_t i, j, k, l, q, nr, piece
    cdef double total = 0.0
    cdef double y, x
    cdef double a[36]
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        q = e.wptr[i]
        if is_row(e, i):
            y = z[j] - s[j]
            piece = 1
            if y < e.lower[j]:
                f[j] = z[j] - e.lower[j]
                p[q] = 0.0
                piece = 0
            elif y > e.upper[j]:
                f[j] = z[j] - e.upper[j]
                p[q] = 0.0
                piece = 2
            else:
                f[j] = s[j]
                p[q] = 1.0
            total += f[j] * f[j]
            if v != NULL:
                if piece == 1:
                    einv[q] = 1.0 / (e.theta[j] + eps)
                    v[q] = einv[q]
                else:
                    einv[q] = 1.0
                    v[q] = 0.0
            continue
        natural_contact(e, i, law, z + j, s + j, f + j, p + q)
        for k in range(nr):
            total += f[j + k] * f[j + k]
        if v != NULL:
            for k in range(nr):
                for l in range(nr):
                    x = p[q + k * nr + l]
                    a[k * nr + l] = x * (e.theta[j + l] + eps) - x
                a[k * nr + k] += 1.0
            invert_small(a, einv + q, nr)
            for k in range(nr):
                for l in range(nr):
                    x = 0.0
                    for piece in range(nr):
                        x += einv[q + k * nr + piece] * p[q + piece * nr + l]
                    v[q + k * nr + l] = x
    return sqrt(total)


cdef inline void convex_error(const elements_t* e, const double* z, const double* hz, const double* speed,
                                  double* energy, double* velocity) noexcept nogil:
    """|F| of the convex natural map, and the largest speed |f|, of a part by its norm."""
    cdef int32_t i, j, k, g, nr
    cdef double total = 0.0, worst = 0.0, x
    cdef double s[6]
    cdef double f[6]
    cdef double p[36]
    for i in range(e.n):
        j = e.ptr[i]
        if is_row(e, i):
            x = hz[j] - e.g[j]
            if z[j] - x < e.lower[j]:
                x = z[j] - e.lower[j]
            elif z[j] - x > e.upper[j]:
                x = z[j] - e.upper[j]
            total += x * x
            x = fabs(x) * speed[j]
            worst = x if x > worst else worst
            continue
        nr = e.ptr[i + 1] - j
        for k in range(nr):
            s[k] = hz[j + k] - e.g[j + k]
        natural_contact(e, i, CONE, z + j, s, f, p)
        for k in range(nr):
            total += f[k] * f[k]
        x = fabs(f[0]) * speed[j]
        worst = x if x > worst else worst
        for g in range(e.part[i], e.part[i + 1]):
            x = length(f + e.first[g] - j, e.size[g]) * speed[e.first[g]]
            worst = x if x > worst else worst
    energy[0] = sqrt(total)
    velocity[0] = worst


cdef inline double z_end(const elements_t* e, int32_t j, double y) noexcept nogil:
    # which bound y is beyond: -1, 1 or 0 for none
    return -1.0 if y < e.lower[j] else 1.0 if y > e.upper[j] else 0.0
