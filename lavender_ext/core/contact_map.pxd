"""The projection of one contact, in rows scaled by the square root of a metric, with its derivative.

A contact is its normal and the parts g behind it (core/parts.pxd), with |y_g| <= a_g y_n:

    cone       Pi(y) on all of them at once: |y_g| <= a_g s, s the normal of the projection                     (1)
    Coulomb    y_n on [0, inf), then every part on its disk of radius a_g s, s = max(0, y_n)                    (2)
    P          in the derivative of Pi at y; of (2) it lacks symmetry

With ray = (1, a_g y_g / t_g where t_g = |y_g| > a_g s, else 0), a part is I where it stays inside, and
a_g s / t_g (I - y_g y_g^T / t_g^2) along its rim; besides, P has ray ray^T / |ray|^2 in (1), ray e_n^T in (2).
"""
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport length, section
from lavender_ext.core.parts cimport CONE, PARTS, parts_t


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


cdef inline void map_parts(int32_t law, const int32_t parts, const int32_t n, const parts_t* q, const double* y, double* out,
                           double* p) noexcept nogil:
    cdef double t[PARTS]
    cdef double ray[6]
    cdef double s, norm = 1.0, x, bound
    cdef int32_t g, j, k, l, m
    for k in range(n * n):
        p[k] = 0.0
    for k in range(n):
        out[k] = ray[k] = 0.0
    x = y[0]
    for g in range(parts):
        t[g] = length(y + q.first[g], q.size[g])
        x += t[g]
    s = section(parts, q.reach, t, y[0]) if law == CONE else y[0] if y[0] > 0.0 else 0.0
    out[0] = s
    if x != x:
        out[0] = x                                      # NaN: comparisons hide it
        return
    if not s > 0.0:
        return
    ray[0] = 1.0
    for g in range(parts):
        j = q.first[g]
        m = q.size[g]
        bound = q.reach[g] * s
        if t[g] <= bound:
            for k in range(j, j + m if bound > 0.0 else j):
                out[k] = y[k]
                p[k * n + k] = 1.0
            continue
        for k in range(j, j + m):
            x = y[k] / t[g]
            ray[k] = q.reach[g] * x
            out[k] = bound * x
        norm += q.reach[g] * q.reach[g]
        if m > 1:
            along_rim(y, t[g], bound / t[g], j, m, n, p)
    if law == CONE:
        for k in range(n):
            for l in range(n):
                p[k * n + l] += ray[k] * ray[l] / norm
        return
    for k in range(n):
        p[k * n] += ray[k]


cdef inline void contact_map(int32_t law, const parts_t* q, const double* y, double* out, double* p) noexcept nogil:
    """out (n) = Pi(y) and P (n, n) of (1) under CONE, else of (2); n = 1 + rows of the parts q <= 6, a_g their reach."""
    cdef parts_t disk
    if q.n == 1 and q.size[0] == 2:                     # compiled apart
        disk.n, disk.first[0], disk.size[0], disk.reach[0] = 1, 1, 2, q.reach[0]
        map_parts(law, 1, 3, &disk, y, out, p)
    elif q.n:
        map_parts(law, q.n, q.first[q.n - 1] + q.size[q.n - 1], q, y, out, p)
    else:
        map_parts(law, 0, 1, q, y, out, p)
