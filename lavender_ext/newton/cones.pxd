"""Second-order cones of a contact in their own coordinates: scaling, steps to the boundary, divisions.

Component g of contact i has the cone |x_1..| <= x_0 of x = G z, with G = diag(1, 1/a) for a > 1 and diag(a, 1) else, on
the normal and on the rows of the component. No entry of G is below 1, so that G does not magnify a proximal term.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport euclidean_norm
from lavender_ext.newton.elements cimport elements_t


cdef enum:                      # stored for each cone after w (n), T = eta [w_0 w_1'; w_1 I + w_1 w_1' / (1 + w_0)]
    SCALING_ETA = 4
    SCALING_INV_ETA = 5         # 1 / eta
    SCALING_INV_SUM = 6         # 1 / (1 + w_0)
    SCALING_V = 8               # v (n)
    SCALING_C = 12              # v \\ c of the combined step (n)
    CONE_SCALING_SIZE = 16


cdef inline double cone_gap(const double* x, int32_t n) noexcept nogil:
    """Return x_0 - |x_1..|."""
    return x[0] - euclidean_norm(x + 1, n - 1)


cdef inline double cone_det(const double* x, int32_t n) noexcept nogil:
    """Return x_0^2 - |x_1..|^2."""
    cdef double t = euclidean_norm(x + 1, n - 1)
    return (x[0] - t) * (x[0] + t)


cdef inline double distance_to_boundary(const double* x, const double* dx, int32_t n) noexcept nogil:
    """Return the largest t with x + t dx in the second-order cone; 1e30 if there is no largest."""
    cdef double a = dx[0] * dx[0], b = x[0] * dx[0], c = cone_det(x, n), disc, q
    cdef int32_t i
    for i in range(1, n):
        a -= dx[i] * dx[i]
        b -= x[i] * dx[i]
    if c <= 0.0:
        return 0.0
    disc = b * b - a * c
    if disc < 0.0:
        return 1e30
    q = -b + sqrt(disc)
    if q <= 0.0:
        return 1e30
    return c / q


cdef inline int32_t cone_size(const elements_t* e, int32_t g) noexcept nogil:
    """Return the dimension of the cone of component g."""
    return 1 + e.size[g]


cdef inline double* scaling_of(const elements_t* e, int32_t g) noexcept nogil:
    """Return the stored scaling of component g."""
    return e.scaling + CONE_SCALING_SIZE * g


cdef inline double normal_factor(double a) noexcept nogil:
    """Return the entry of G on the normal."""
    return a if a > 1.0 else 1.0


cdef inline double tangent_factor(double a) noexcept nogil:
    """Return the entry of G on the rows of the component."""
    return 1.0 / a if a < 1.0 else 1.0


cdef inline void load_cone_variable(const elements_t* e, int32_t i, int32_t g, const double* z, double* x) noexcept nogil:
    """Compute x = G z for component g of contact i."""
    cdef int32_t q = e.first[g] - 1, k
    cdef double a = e.reach[g]
    x[0] = normal_factor(a) * z[e.ptr[i]]
    for k in range(1, cone_size(e, g)):
        x[k] = tangent_factor(a) * z[q + k]


cdef inline void add_cone_transpose(const elements_t* e, int32_t i, int32_t g, const double* x, double* z) noexcept nogil:
    """Add G^T x of component g of contact i to z."""
    cdef int32_t q = e.first[g] - 1, k
    cdef double a = e.reach[g]
    z[e.ptr[i]] += normal_factor(a) * x[0]
    for k in range(1, cone_size(e, g)):
        z[q + k] += tangent_factor(a) * x[k]


# Storage of duals. u1 (m): of the lower bound, or of the first component's cone. u2 (m): of the upper bound, or of the
# other cones; their first numbers use the places of the normal and of the row after it, which u2 leaves free.
cdef inline double* dual_normal(const elements_t* e, int32_t i, int32_t g, double* u1, double* u2) noexcept nogil:
    """Return the address of the first number of the dual of cone g of element i."""
    return u1 + e.ptr[i] if g == e.part[i] else u2 + e.ptr[i] + (g - e.part[i] - 1)


cdef inline void load_cone_dual(const elements_t* e, int32_t i, int32_t g, const double* u1, const double* u2,
                           double* x) noexcept nogil:
    """Copy the dual of cone g of element i from u1 and u2 to x."""
    cdef const double* u = u1 if g == e.part[i] else u2
    cdef int32_t q = e.first[g] - 1, k
    x[0] = dual_normal(e, i, g, <double*>u1, <double*>u2)[0]
    for k in range(1, cone_size(e, g)):
        x[k] = u[q + k]


cdef inline void store_cone_dual(const elements_t* e, int32_t i, int32_t g, const double* x, double* u1, double* u2) noexcept nogil:
    """Copy x to the dual of cone g of element i in u1 and u2."""
    cdef double* u = u1 if g == e.part[i] else u2
    cdef int32_t q = e.first[g] - 1, k
    dual_normal(e, i, g, u1, u2)[0] = x[0]
    for k in range(1, cone_size(e, g)):
        u[q + k] = x[k]


cdef inline void compute_nt_scaling(const double* s, const double* u, int32_t n, double* w, double* eta) noexcept nogil:
    """Compute the scaling T = eta [w_0 w_1'; w_1 I + w_1 w_1' / (1 + w_0)] with T u = T^-1 s (Nesterov, Todd 1997)."""
    cdef double ds = sqrt(cone_det(s, n)), du = sqrt(cone_det(u, n)), dot = 0.0, gamma
    cdef int32_t k
    for k in range(n):
        dot += s[k] * u[k]
    gamma = sqrt(0.5 * (1.0 + dot / (ds * du)))
    w[0] = (s[0] / ds + u[0] / du) / (2.0 * gamma)
    for k in range(1, n):
        w[k] = (s[k] / ds - u[k] / du) / (2.0 * gamma)
    dot = 1.0
    for k in range(1, n):
        dot += w[k] * w[k]
    w[0] = sqrt(dot)                                    # Restore w_0^2 - |w_1|^2 = 1 after rounding.
    eta[0] = sqrt(ds / du)


cdef inline void apply_scaling(const double* w, int32_t n, const double* x, double* out) noexcept nogil:
    """Compute out = T x with the scaling T that w holds."""
    cdef double t = 0.0
    cdef int32_t k
    for k in range(1, n):
        t += w[k] * x[k]
    out[0] = w[SCALING_ETA] * (w[0] * x[0] + t)
    t = x[0] + t * w[SCALING_INV_SUM]
    for k in range(1, n):
        out[k] = w[SCALING_ETA] * (x[k] + w[k] * t)


cdef inline void apply_inv_scaling(const double* w, int32_t n, const double* x, double* out) noexcept nogil:
    """Compute out = T^-1 x with the scaling T that w holds."""
    cdef double t = 0.0
    cdef int32_t k
    for k in range(1, n):
        t += w[k] * x[k]
    out[0] = w[SCALING_INV_ETA] * (w[0] * x[0] - t)
    t = t * w[SCALING_INV_SUM] - x[0]
    for k in range(1, n):
        out[k] = w[SCALING_INV_ETA] * (x[k] + w[k] * t)


cdef inline bint has_lower_bound(const elements_t* e, int32_t j) noexcept nogil:
    """Return whether row j has a lower bound."""
    return e.lower[j] > -1.0 / 0.0


cdef inline bint has_upper_bound(const elements_t* e, int32_t j) noexcept nogil:
    """Return whether row j has an upper bound."""
    return e.upper[j] < 1.0 / 0.0


cdef struct cone_weight_t:      # G^-1 (T^-2 + delta)^-1 G^-T = x [1 h][1 h]^T + [0 0; 0 c]
    double x                    # entry of the normal (x above)
    double h[4]                 # (n - 1)
    double c[4]                 # (n - 1, n - 1)
    double root[4]              # square root of c


cdef inline void compute_cone_scaling(const double* s, const double* u, int32_t n, double a, double delta, double* w,
                            cone_weight_t* out) noexcept nogil:
    """Compute the scaling of s and u into w (CONE_SCALING_SIZE), and the cone's weight.

    The weight uses the eigenvalues of T^2, which are eta^2 (w_0 +- |w_1|)^2 along (1, +-w_1/|w_1|) and eta^2 across:
    the matrix T^-2 itself would lose the small ones.
    """
    cdef double d[4]
    cdef double eta, size, grow, shrink, across, along, x, gn = normal_factor(a), gt = tangent_factor(a)
    cdef int32_t k, l, nt = n - 1
    compute_nt_scaling(s, u, n, w, &eta)
    w[SCALING_ETA] = eta
    w[SCALING_INV_ETA] = 1.0 / eta
    w[SCALING_INV_SUM] = 1.0 / (1.0 + w[0])
    apply_scaling(w, n, u, w + SCALING_V)
    size = euclidean_norm(w + 1, nt)
    grow = eta * (w[0] + size)
    shrink = eta / (w[0] + size)
    grow = grow * grow
    shrink = shrink * shrink
    across = eta * eta
    grow = grow / (1.0 + delta * grow)
    shrink = shrink / (1.0 + delta * shrink)
    across = across / (1.0 + delta * across)
    along = 2.0 * shrink * (grow / (grow + shrink)) / (gt * gt)
    across = across / (gt * gt)
    for k in range(nt):
        d[k] = w[1 + k] / size if size > 0.0 else (1.0 if k == 0 else 0.0)
        out.h[k] = (grow - shrink) / (grow + shrink) * (gn / gt) * d[k]
    for k in range(nt):
        for l in range(nt):
            x = 1.0 if k == l else 0.0
            out.c[k * nt + l] = across * x + (along - across) * d[k] * d[l]
            out.root[k * nt + l] = sqrt(across) * x + (sqrt(along) - sqrt(across)) * d[k] * d[l]
    out.x = 0.5 * (grow + shrink) / (gn * gn)


cdef inline double limit_step_to_nonnegative(double x, double dx, double best) noexcept nogil:
    """Return the smaller of `best` and the step along dx at which x > 0 becomes 0."""
    if dx < 0.0 and -x / dx < best:
        return -x / dx
    return best


# Steps of a cone are computed in scaled coordinates, where T^-1 s = T u = v. With y = T^-1 G dz, T du is -v - y for the
# affine step and -(v \\ c) - y for the combined step. T maps the cone onto itself, so step lengths do not change.
cdef inline void compute_affine_cone_step(const elements_t* e, int32_t i, int32_t g, const double* da, const int32_t n,
                             double* y, double* back) noexcept nogil:
    """Compute y = T^-1 G dz_a and back = T du_a."""
    cdef const double *w = scaling_of(e, g)
    cdef double x[4]
    cdef int32_t k
    load_cone_variable(e, i, g, da, x)
    apply_inv_scaling(w, n, x, y)
    for k in range(n):
        back[k] = -w[SCALING_V + k] - y[k]


cdef inline void compute_combined_cone_rhs(const elements_t* e, int32_t i, int32_t g, const double* da, double sigma_mu,
                               const int32_t n, double* rhs) noexcept nogil:
    """Compute v \\\\ c of interior.pxd (4) into the cone's scaling, and rhs = T^-1 (v \\\\ c)."""
    cdef double *w = scaling_of(e, g)
    cdef const double *v = w + SCALING_V
    cdef double *c = w + SCALING_C
    cdef double x[4]
    cdef double y[4]
    cdef double back[4]
    cdef double dot = 0.0
    cdef int32_t k
    compute_affine_cone_step(e, i, g, da, n, y, back)
    x[0] = -sigma_mu
    for k in range(n):
        x[0] += v[k] * v[k] + y[k] * back[k]
    for k in range(1, n):
        x[k] = 2.0 * v[0] * v[k] + y[0] * back[k] + back[0] * y[k]
    for k in range(1, n):
        dot += v[k] * x[k]
    c[0] = (v[0] * x[0] - dot) / cone_det(v, n)         # v o c = x in the Jordan algebra of the cone
    for k in range(1, n):
        c[k] = (x[k] - c[0] * v[k]) / v[0]
    apply_inv_scaling(w, n, c, rhs)


cdef inline double limit_cone_step(const elements_t* e, int32_t i, int32_t g, const double* dz, double best,
                               const int32_t n, double* du) noexcept nogil:
    """Compute du of the combined step; return the smaller of `best` and the step to the boundary."""
    cdef const double *w = scaling_of(e, g)
    cdef double x[4]
    cdef double y[4]
    cdef double a
    cdef int32_t k
    load_cone_variable(e, i, g, dz, x)
    apply_inv_scaling(w, n, x, y)
    a = distance_to_boundary(w + SCALING_V, y, n)
    best = a if a < best else best
    for k in range(n):
        y[k] = -w[SCALING_C + k] - y[k]
    a = distance_to_boundary(w + SCALING_V, y, n)
    apply_inv_scaling(w, n, y, du)
    return a if a < best else best
