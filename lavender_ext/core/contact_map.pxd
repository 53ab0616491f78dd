"""The projection of one contact, in rows scaled by the square root of a metric, with its derivative.

A contact is its normal and up to three parts g behind it, tangents, spin, what rolls, with |y_g| <= a_g y_n:

    cone       Pi(y) on all of them at once: |y_g| <= a_g s, s the normal of the projection                     (1)
    Coulomb    y_n on [0, inf), then every part on its disk of radius a_g s, s = max(0, y_n)                    (2)
    P          in the derivative of Pi at y; of (2) it lacks symmetry

With ray = (1, a_g y_g / t_g where t_g = |y_g| > a_g s, else 0), a part is I where it stays inside, and
a_g s / t_g (I - y_g y_g^T / t_g^2) along its rim; besides, P has ray ray^T / |ray|^2 in (1), ray e_n^T in (2).
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport CONE, norm2, rolling_section


cdef inline double length(const double* x, int32_t n) noexcept nogil:
    """|x|, n numbers."""
    cdef int32_t i
    cdef double s = 0.0
    for i in range(n):
        s += x[i] * x[i]
    return sqrt(s)


cdef inline double section(const double* a, const double* t, double yn, int32_t spin, double* bound) noexcept nogil:
    """s of (1) and a_g s in bound (2), of tangents and spin: the largest of the candidates of every subset."""
    cdef double s = yn if yn > 0.0 else 0.0, c = (yn + a[0] * t[0]) / (1.0 + a[0] * a[0])
    s = c if c > s else s
    if spin:
        c = (yn + a[1] * t[1]) / (1.0 + a[1] * a[1])
        s = c if c > s else s
        c = (yn + a[0] * t[0] + a[1] * t[1]) / (1.0 + a[0] * a[0] + a[1] * a[1])
        s = c if c > s else s
        bound[1] = a[1] * s
    bound[0] = a[0] * s
    return s


cdef inline void along_rim(const double* y, double t, double kappa, int32_t j, int32_t m, int32_t n,
                           double* p) noexcept nogil:
    # kappa (I - y y^T / t^2) of rows [j, j + m)
    cdef int32_t k, l
    cdef double u[5]
    cdef double square = 0.0
    for k in range(m):
        u[k] = y[j + k] / t                             # t^2 may have left the range
        square += u[k] * u[k]
    for k in range(m):
        for l in range(m):
            p[(j + k) * n + j + l] += kappa * (square - u[k] * u[k] if k == l else -u[k] * u[l])


cdef inline void map_parts(int32_t law, const int32_t nt, const int32_t spin, const int32_t rolls, const double* a,
                           const double* y, double* out, double* p) noexcept nogil:
    cdef double t[3]
    cdef double bound[3]
    cdef double ray[6]
    cdef double s, norm = 1.0, x
    cdef int32_t g, j, k, l, m, n = 1 + nt + spin + 2 * rolls
    for k in range(n * n):
        p[k] = 0.0
    for k in range(n):
        out[k] = ray[k] = 0.0
    t[0] = norm2(y[1], y[2]) if nt == 2 else length(y + 1, nt)
    t[1] = fabs(y[1 + nt]) if spin else 0.0
    t[2] = norm2(y[n - 2], y[n - 1]) if rolls else 0.0
    if law != CONE:
        s = y[0] if y[0] > 0.0 else 0.0
        for g in range(3):
            bound[g] = a[g] * s
    elif rolls:
        s = rolling_section(a, t, y[0], bound)
    else:
        s = section(a, t, y[0], spin, bound)
    out[0] = s
    x = y[0] + t[0] + t[1] + t[2]
    if x != x:
        out[0] = x                                      # NaN: comparisons hide it
        return
    if not s > 0.0:
        return
    ray[0] = 1.0
    for g in range(3):
        j = 1 if g == 0 else 1 + nt if g == 1 else n - 2
        m = nt if g == 0 else spin if g == 1 else 2 * rolls
        if m == 0:
            continue
        if t[g] <= bound[g]:
            for k in range(j, j + m if bound[g] > 0.0 else j):
                out[k] = y[k]
                p[k * n + k] = 1.0
            continue
        for k in range(j, j + m):
            x = y[k] / t[g]
            ray[k] = a[g] * x
            out[k] = bound[g] * x
        norm += a[g] * a[g]
        if m > 1:
            along_rim(y, t[g], bound[g] / t[g], j, m, n, p)
    if law == CONE:
        for k in range(n):
            for l in range(n):
                p[k * n + l] += ray[k] * ray[l] / norm
        return
    for k in range(n):
        p[k * n] += ray[k]


cdef inline void contact_map(int32_t law, int32_t nt, int32_t spin, int32_t rolls, const double* a, const double* y,
                             double* out, double* p) noexcept nogil:
    """out (n) = Pi(y) and P (n, n) of (1) under CONE, else of (2); n = 1 + nt + spin + 2 rolls <= 6, a (3) of the parts."""
    if nt == 2 and not spin and not rolls:
        map_parts(law, 2, 0, 0, a, y, out, p)
    else:
        map_parts(law, nt, spin, rolls, a, y, out, p)
