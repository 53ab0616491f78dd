"""The projection Pi of one block with its derivative, and the natural map, in rows scaled by the square root of a metric.

    row         Pi(y) is y clipped to [lower, upper];   P = 1 between the bounds, otherwise 0                      (1)

A contact has a normal and friction components g (core/block_types.pxd), with |y_g| <= a_g y_n:

    cone        Pi(y) is the projection onto |y_g| <= a_g s for all g; s is the normal of the projection           (2)
    Coulomb     y_n is clipped to [0, inf), then each y_g is projected onto its disk of radius a_g s, s = max(0, y_n)  (3)

P is an element of the generalised derivative dPi/dy; for (3) it is not symmetric. Let t_g = |y_g|, and let ray have the entries
1 (normal), a_g y_g / t_g if t_g > a_g s, and 0 otherwise. The block of P of a component is I if the component is inside its
bound, and a_g s / t_g (I - y_g y_g^T / t_g^2) on the boundary. P also has the term ray ray^T / |ray|^2 in (2), ray e_n^T in (3).
On its own rows, a component on the boundary has

    dPi/da_g = s y_g / t_g;   in (2) all rows have the additional term ray (t_g - 2 a_g s) / |ray|^2               (4)

because s = (y_n + sum a_g t_g) / |ray|^2 there. A solution with slack s in these rows is a root of the natural map

    F = z - Pi(z - s)                                                                                           (5)

To add a friction component, nothing here changes. All methods that differentiate the natural map use this file: exact blocks
(local/block_newton.pxd), Newton's methods (newton/natural_map.pxd, velocity_newton/flow.pxd), and the derivatives and states of
solutions (derivative/natural.pxd).
"""
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport euclidean_norm, project_cone_normal
from lavender_ext.core.block_types cimport CONE, MAX_FRICTION_COMPONENTS, friction_components_t


cdef inline int32_t classify_active_bound(double y, double lower, double upper) noexcept nogil:
    """Return -1 if y is not above `lower`, 1 if it is not below `upper`, otherwise 0, where P = 1 in (1); 0 for NaN."""
    return -1 if y <= lower else (1 if y >= upper else 0)


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


cdef inline void project_contact_components(int32_t law, const int32_t n_components, const int32_t n,
                                            const friction_components_t* q, const double* y, double* out,
                                            double* p) noexcept nogil:
    """Compute Pi(y) and P of `project_contact` for n rows and n_components friction components."""
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
        t[g] = euclidean_norm(y + q.first[g], q.size[g])
        x += t[g]
    s = project_cone_normal(n_components, q.friction_coefficient, t, y[0]) if law == CONE else y[0] if y[0] > 0.0 else 0.0
    out[0] = s
    if x != x:
        out[0] = x                                      # Return NaN, which the comparisons below would hide.
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


cdef inline void project_contact(int32_t law, const friction_components_t* q, const double* y, double* out,
                                 double* p) noexcept nogil:
    """Compute out (n) = Pi(y) and P (n, n), by (2) under CONE, otherwise by (3).

    n is 1 + the number of rows of the friction components q, at most 6.
    """
    cdef friction_components_t disk
    if q.n == 1 and q.size[0] == 2:                     # The common case, one disk, is compiled with constant sizes.
        disk.n, disk.first[0], disk.size[0], disk.friction_coefficient[0] = 1, 1, 2, q.friction_coefficient[0]
        project_contact_components(law, 1, 3, &disk, y, out, p)
    elif q.n:
        project_contact_components(law, q.n, q.first[q.n - 1] + q.size[q.n - 1], q, y, out, p)
    else:
        project_contact_components(law, 0, 1, q, y, out, p)


cdef inline void evaluate_natural_map(int32_t law, const friction_components_t* q, int32_t n, const double* z, const double* s,
                                      double* out, double* f, double* p) noexcept nogil:
    """Compute out (n) = Pi(z - s), P (n, n) there, and f (n) = F of a contact; F is s, without cancellation, if Pi(y) = y."""
    cdef double y[6]
    cdef int32_t k
    for k in range(n):
        y[k] = z[k] - s[k]
    project_contact(law, q, y, out, p)
    for k in range(n):
        f[k] = s[k] if out[k] == y[k] else z[k] - out[k]


cdef inline void differentiate_by_coefficients(int32_t law, const friction_components_t* q, int32_t n, const double* y, double s,
                                               double* edge) noexcept nogil:
    """Compute (4) of every component g of a contact in column q.first[g] of edge (n, n), with s the normal of Pi(y)."""
    cdef double ray[6]
    cdef double t, norm = 1.0
    cdef int32_t g, j, k
    for k in range(n * n):
        edge[k] = 0.0
    if not s > 0.0:
        return
    for k in range(n):
        ray[k] = 0.0
    ray[0] = 1.0
    for g in range(q.n):
        j = q.first[g]
        t = euclidean_norm(y + j, q.size[g])
        if t > q.friction_coefficient[g] * s:
            for k in range(j, j + q.size[g]):
                ray[k] = q.friction_coefficient[g] * y[k] / t
                edge[k * n + j] = s * y[k] / t
            norm += q.friction_coefficient[g] * q.friction_coefficient[g]
    for g in range(q.n if law == CONE else 0):
        j = q.first[g]
        t = euclidean_norm(y + j, q.size[g])
        if t > q.friction_coefficient[g] * s:
            for k in range(n):
                edge[k * n + j] += ray[k] * (t - 2.0 * q.friction_coefficient[g] * s) / norm
