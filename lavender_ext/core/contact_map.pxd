"""The projection of one contact, in rows scaled by the square root of a metric, with its derivative.

A contact has a normal and friction components g (core/block_types.pxd), with |y_g| <= a_g y_n:

    cone       Pi(y) is the projection onto |y_g| <= a_g s for all g; s is the normal of the projection         (1)
    Coulomb    y_n is clipped to [0, inf), then each y_g is projected onto its disk of radius a_g s, s = max(0, y_n)    (2)
    P          an element of the generalised derivative of Pi at y; for (2) it is not symmetric

Let t_g = |y_g|, and let ray have the entries 1 (normal), a_g y_g / t_g if t_g > a_g s, and 0 otherwise. The block of P of
a component is I if the component is inside its bound, and a_g s / t_g (I - y_g y_g^T / t_g^2) on the boundary. P also has
the term ray ray^T / |ray|^2 in (1), ray e_n^T in (2).
"""
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport length, projected_normal
from lavender_ext.core.block_types cimport CONE, MAX_FRICTION_COMPONENTS, friction_components_t


cdef inline void add_tangential_derivative(const double* y, double t, double kappa, int32_t j, int32_t m, int32_t n,
                           double* p) noexcept nogil:
    """Add kappa (I - y y^T / t^2) of rows [j, j + m) to p (n, n)."""
    cdef int32_t k, l
    cdef double u[5]
    cdef double square = 0.0
    for k in range(m):
        u[k] = y[j + k] / t                             # Divide first: t^2 may overflow.
        square += u[k] * u[k]
    for k in range(m):
        for l in range(m):
            p[(j + k) * n + j + l] += kappa * (square - u[k] * u[k] if k == l else -u[k] * u[l])


cdef inline void project_components(int32_t law, const int32_t n_components, const int32_t n, const friction_components_t* q,
                                    const double* y, double* out, double* p) noexcept nogil:
    """Compute Pi(y) and P of `contact_map` for n rows and n_components friction components."""
    cdef double t[MAX_FRICTION_COMPONENTS]
    cdef double ray[6]
    cdef double s, norm = 1.0, x, bound
    cdef int32_t g, j, k, l, m
    for k in range(n * n):
        p[k] = 0.0
    for k in range(n):
        out[k] = ray[k] = 0.0
    x = y[0]
    for g in range(n_components):
        t[g] = length(y + q.first[g], q.size[g])
        x += t[g]
    s = projected_normal(n_components, q.friction_coefficient, t, y[0]) if law == CONE else y[0] if y[0] > 0.0 else 0.0
    out[0] = s
    if x != x:
        out[0] = x                                      # NaN: the comparisons below would hide it
        return
    if not s > 0.0:
        return
    ray[0] = 1.0
    for g in range(n_components):
        j = q.first[g]
        m = q.size[g]
        bound = q.friction_coefficient[g] * s
        # inside the bound: identity
        if t[g] <= bound:
            for k in range(j, j + m if bound > 0.0 else j):
                out[k] = y[k]
                p[k * n + k] = 1.0
            continue
        # beyond the bound: radial projection
        for k in range(j, j + m):
            x = y[k] / t[g]
            ray[k] = q.friction_coefficient[g] * x
            out[k] = bound * x
        norm += q.friction_coefficient[g] * q.friction_coefficient[g]
        if m > 1:
            add_tangential_derivative(y, t[g], bound / t[g], j, m, n, p)
    if law == CONE:
        for k in range(n):
            for l in range(n):
                p[k * n + l] += ray[k] * ray[l] / norm
        return
    for k in range(n):
        p[k * n] += ray[k]


cdef inline void contact_map(int32_t law, const friction_components_t* q, const double* y, double* out, double* p) noexcept nogil:
    """Compute out (n) = Pi(y) and P (n, n), by (1) under CONE, otherwise by (2).

    n is 1 + the number of rows of the friction components q, at most 6.
    """
    cdef friction_components_t disk
    if q.n == 1 and q.size[0] == 2:                     # one disk: compiled with constant sizes
        disk.n, disk.first[0], disk.size[0], disk.friction_coefficient[0] = 1, 1, 2, q.friction_coefficient[0]
        project_components(law, 1, 3, &disk, y, out, p)
    elif q.n:
        project_components(law, q.n, q.first[q.n - 1] + q.size[q.n - 1], q, y, out, p)
    else:
        project_components(law, 0, 1, q, y, out, p)
