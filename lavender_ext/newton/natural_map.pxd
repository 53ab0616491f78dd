"""The natural map F = z - Pi(z - s) of every element and its derivative, for Newton steps, and the judge's error from F.

With a proximal weight eps on what is fixed by H alone,

    (I - P + P (theta + eps)) dz + P K dy = r,   dy = K^T dz,   P in the derivative of Pi         (5)

which with E = I - P + P (theta + eps) is (2) of elements.pxd for V = E^-1 P, r -> P^-1 r. For Coulomb friction the
radius of the disk is a_t max(0, z_n - s_n) (Alart and Curnier 1991), P is not symmetric, and N is factored by block
LU.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport euclidean_norm
from lavender_ext.core.block_projection cimport classify_active_bound, evaluate_natural_map
from lavender_ext.core.block_types cimport CONE, friction_components_t
from lavender_ext.newton.elements cimport elements_t, invert_and_multiply, is_row


cdef inline void evaluate_contact_natural_map(const elements_t* e, int32_t i, int32_t law, const double* z, const double* s,
                                              double* f, double* p) noexcept nogil:
    """Compute F (nr) and P (nr, nr) of one contact, with Pi in the metric of d."""
    cdef int32_t g, at = e.part[i]
    cdef double out[6]
    cdef friction_components_t q                        # with coefficients in the scaled unknown
    q.n = e.part[i + 1] - at
    for g in range(q.n):
        q.first[g], q.size[g], q.friction_coefficient[g] = e.first[at + g] - e.ptr[i], e.size[at + g], e.reach[at + g]
    evaluate_natural_map(law, &q, e.ptr[i + 1] - e.ptr[i], z, s, out, f, p)


cdef inline double evaluate_all_natural_maps(const elements_t* e, const double* z, const double* s, int32_t law, double eps,
                               double* f, double* p, double* einv, double* v) noexcept nogil:
    """Compute F, P, E^-1 and V = E^-1 P of (5) for every element; return |F|, the judge's energy error.

    law is CONE or COULOMB. If v is NULL, only F and P are computed.
    """
    cdef int32_t i, j, k, l, q, nr, side
    cdef double total = 0.0
    cdef double x
    cdef double a[36]
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        q = e.wptr[i]
        if is_row(e, i):
            side = classify_active_bound(z[j] - s[j], e.lower[j], e.upper[j])
            f[j] = s[j] if side == 0 else z[j] - (e.lower[j] if side < 0 else e.upper[j])
            p[q] = 1.0 if side == 0 else 0.0
            total += f[j] * f[j]
            if v != NULL:
                einv[q] = 1.0 / (e.theta[j] + eps) if side == 0 else 1.0
                v[q] = einv[q] if side == 0 else 0.0
            continue
        evaluate_contact_natural_map(e, i, law, z + j, s + j, f + j, p + q)
        for k in range(nr):
            total += f[j + k] * f[j + k]
        if v != NULL:
            for k in range(nr):
                for l in range(nr):
                    x = p[q + k * nr + l]
                    a[k * nr + l] = x * (e.theta[j + l] + eps) - x
                a[k * nr + k] += 1.0
            invert_and_multiply(a, p + q, einv + q, v + q, nr)
    return sqrt(total)


cdef inline void compute_convex_residual(const elements_t* e, const double* z, const double* hz, const double* speed,
                                  double* energy, double* velocity) noexcept nogil:
    """Compute |F| of the convex natural map, and the largest speed |f| of a bounded row or friction component."""
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
        evaluate_contact_natural_map(e, i, CONE, z + j, s, f, p)
        for k in range(nr):
            total += f[k] * f[k]
        x = fabs(f[0]) * speed[j]
        worst = x if x > worst else worst
        for g in range(e.part[i], e.part[i + 1]):
            x = euclidean_norm(f + e.first[g] - j, e.size[g]) * speed[e.first[g]]
            worst = x if x > worst else worst
    energy[0] = sqrt(total)
    velocity[0] = worst
