"""Second-order cones of a contact in their own coordinates: scaling, steps to the boundary, divisions."""
from libc.math cimport sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport length
from lavender_ext.newton.elements cimport elements_t


cdef enum:                      # what is kept of a cone, from w (n) on: T = eta [w_0 w_1'; w_1 I + w_1 w_1' / (1 + w_0)]
    KEPT_ETA = 4
    KEPT_SHRINK = 5             # 1 / eta
    KEPT_TURN = 6               # 1 / (1 + w_0)
    KEPT_V = 8                  # v (n)
    KEPT_C = 12                 # v \\ c of the combined step (n)
    KEPT = 16


cdef inline double cone_gap(const double* x, int32_t n) noexcept nogil:
    # x_0 - |x_1..|
    return x[0] - length(x + 1, n - 1)


cdef inline double cone_det(const double* x, int32_t n) noexcept nogil:
    cdef double t = length(x + 1, n - 1)
    return (x[0] - t) * (x[0] + t)


cdef inline double cone_step(const double* x, const double* dx, int32_t n) noexcept nogil:
    # largest step to the boundary of the second-order cone; 1e30 where there is none
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


# The cone of part g of element i in its own coordinates: x_0 = a z_n, then the rows of the part.
cdef inline int32_t cone_size(const elements_t* e, int32_t g) noexcept nogil:
    return 1 + e.size[g]


cdef inline double* kept(const elements_t* e, int32_t g) noexcept nogil:
    return e.scaling + KEPT * g


cdef inline double on_normal(double a) noexcept nogil:
    return a if a > 1.0 else 1.0


cdef inline double on_tangent(double a) noexcept nogil:
    return 1.0 / a if a < 1.0 else 1.0


cdef inline void gather(const elements_t* e, int32_t i, int32_t g, const double* z, double* x) noexcept nogil:
    # x = G z, G = diag(1, 1/a) or diag(a, 1): no entry below 1, so that G never blows a proximal term up
    cdef int32_t q = e.first[g] - 1, k
    cdef double a = e.reach[g]
    x[0] = on_normal(a) * z[e.ptr[i]]
    for k in range(1, cone_size(e, g)):
        x[k] = on_tangent(a) * z[q + k]


cdef inline void scatter(const elements_t* e, int32_t i, int32_t g, const double* x, double* z) noexcept nogil:
    # z += G^T x
    cdef int32_t q = e.first[g] - 1, k
    cdef double a = e.reach[g]
    z[e.ptr[i]] += on_normal(a) * x[0]
    for k in range(1, cone_size(e, g)):
        z[q + k] += on_tangent(a) * x[k]


# u1 (m): dual of the lower bound, or of the first part's cone. u2 (m): of the upper bound, or of the other cones, whose
# first numbers are on the normal and on the row behind it, which the first part leaves free.
cdef inline double* dual_head(const elements_t* e, int32_t i, int32_t g, double* u1, double* u2) noexcept nogil:
    return u1 + e.ptr[i] if g == e.part[i] else u2 + e.ptr[i] + (g - e.part[i] - 1)


cdef inline void load_dual(const elements_t* e, int32_t i, int32_t g, const double* u1, const double* u2,
                           double* x) noexcept nogil:
    cdef const double* u = u1 if g == e.part[i] else u2
    cdef int32_t q = e.first[g] - 1, k
    x[0] = dual_head(e, i, g, <double*>u1, <double*>u2)[0]
    for k in range(1, cone_size(e, g)):
        x[k] = u[q + k]


cdef inline void store_dual(const elements_t* e, int32_t i, int32_t g, const double* x, double* u1, double* u2) noexcept nogil:
    cdef double* u = u1 if g == e.part[i] else u2
    cdef int32_t q = e.first[g] - 1, k
    dual_head(e, i, g, u1, u2)[0] = x[0]
    for k in range(1, cone_size(e, g)):
        u[q + k] = x[k]


cdef inline void nt_scaling(const double* s, const double* u, int32_t n, double* w, double* eta) noexcept nogil:
    # T = eta [w0 w1'; w1 I + w1 w1'/(1 + w0)], T u = T^-1 s
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
    w[0] = sqrt(dot)                                    # w0^2 - |w1|^2 = 1 again after rounding
    eta[0] = sqrt(ds / du)


cdef inline void scale_times(const double* w, int32_t n, const double* x, double* out) noexcept nogil:
    # T x
    cdef double t = 0.0
    cdef int32_t k
    for k in range(1, n):
        t += w[k] * x[k]
    out[0] = w[KEPT_ETA] * (w[0] * x[0] + t)
    t = x[0] + t * w[KEPT_TURN]
    for k in range(1, n):
        out[k] = w[KEPT_ETA] * (x[k] + w[k] * t)


cdef inline void scale_back(const double* w, int32_t n, const double* x, double* out) noexcept nogil:
    # T^-1 x
    cdef double t = 0.0
    cdef int32_t k
    for k in range(1, n):
        t += w[k] * x[k]
    out[0] = w[KEPT_SHRINK] * (w[0] * x[0] - t)
    t = t * w[KEPT_TURN] - x[0]
    for k in range(1, n):
        out[k] = w[KEPT_SHRINK] * (x[k] + w[k] * t)


cdef inline void cone_divide(const double* v, const double* c, int32_t n, double* out) noexcept nogil:
    # v o out = c
    cdef double det = cone_det(v, n), dot = 0.0
    cdef int32_t k
    for k in range(1, n):
        dot += v[k] * c[k]
    out[0] = (v[0] * c[0] - dot) / det
    for k in range(1, n):
        out[k] = (c[k] - out[0] * v[k]) / v[0]


cdef inline bint is_low(const elements_t* e, int32_t j) noexcept nogil:
    return e.lower[j] > -1.0 / 0.0


cdef inline bint is_high(const elements_t* e, int32_t j) noexcept nogil:
    return e.upper[j] < 1.0 / 0.0


cdef inline void slack_dual(const elements_t* e, int32_t i, int32_t g, const double* hz, double* c) noexcept nogil:
    # u with G^T u = H z - g where the contact has one cone
    cdef int32_t j = e.ptr[i], q = e.first[g] - 1, k
    cdef double a = e.reach[g]
    c[0] = (hz[j] - e.g[j]) / on_normal(a)
    for k in range(1, cone_size(e, g)):
        c[k] = (hz[q + k] - e.g[q + k]) / on_tangent(a)


cdef inline double cone_parts(const double* s, const double* u, int32_t n, double a, double delta, double* w,
                              double* h, double* c, double* root) noexcept nogil:
    # (T^-2 + delta)^-1 between G^-1 and G^-T as x [1 h][1 h]^T + [0 0; 0 c]: returns x, the normal's own entry.
    # Through the eigenvalues of T^2, eta^2 (w0 +- |w1|)^2 along (1, +-w1/|w1|) and eta^2 across: as a matrix
    # T^-2 would lose the small ones. c and its square root are (n - 1, n - 1).
    # w (KEPT) keeps the scaling, and v.
    cdef double d[4]
    cdef double eta, size, grow, shrink, across, along, x, gn = on_normal(a), gt = on_tangent(a)
    cdef int32_t k, l, nt = n - 1
    nt_scaling(s, u, n, w, &eta)
    w[KEPT_ETA] = eta
    w[KEPT_SHRINK] = 1.0 / eta
    w[KEPT_TURN] = 1.0 / (1.0 + w[0])
    scale_times(w, n, u, w + KEPT_V)
    size = length(w + 1, nt)
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
        h[k] = (grow - shrink) / (grow + shrink) * (gn / gt) * d[k]
    for k in range(nt):
        for l in range(nt):
            x = 1.0 if k == l else 0.0
            c[k * nt + l] = across * x + (along - across) * d[k] * d[l]
            root[k * nt + l] = sqrt(across) * x + (sqrt(along) - sqrt(across)) * d[k] * d[l]
    return 0.5 * (grow + shrink) / (gn * gn)


cdef inline double row_limit(double x, double dx, double best) noexcept nogil:
    if dx < 0.0 and -x / dx < best:
        return -x / dx
    return best


# Steps of a cone are taken in the scaled coordinates, where T^-1 s = T u = v: with y = T^-1 G dz, T du = -v - y for
# the affine step and -(v \\ c) - y for the combined one. T maps the cone onto itself, so lengths are the same.
cdef inline void cone_affine(const elements_t* e, int32_t i, int32_t g, const double* da, const int32_t n,
                             double* y, double* back) noexcept nogil:
    # y = T^-1 G dz_a, back = T du_a
    cdef const double *w = kept(e, g)
    cdef double x[4]
    cdef int32_t k
    gather(e, i, g, da, x)
    scale_back(w, n, x, y)
    for k in range(n):
        back[k] = -w[KEPT_V + k] - y[k]


cdef inline void cone_combined(const elements_t* e, int32_t i, int32_t g, const double* da, double sigma_mu,
                               const int32_t n, double* rhs) noexcept nogil:
    # v \\ c of (4) into the cone's store; rhs = T^-1 (v \\ c)
    cdef double *w = kept(e, g)
    cdef const double *v = w + KEPT_V
    cdef double x[4]
    cdef double y[4]
    cdef double back[4]
    cdef int32_t k
    cone_affine(e, i, g, da, n, y, back)
    x[0] = -sigma_mu
    for k in range(n):
        x[0] += v[k] * v[k] + y[k] * back[k]
    for k in range(1, n):
        x[k] = 2.0 * v[0] * v[k] + y[0] * back[k] + back[0] * y[k]
    cone_divide(v, x, n, w + KEPT_C)
    scale_back(w, n, w + KEPT_C, rhs)


cdef inline double cone_length(const elements_t* e, int32_t i, int32_t g, const double* dz, double best,
                               const int32_t n, double* du) noexcept nogil:
    # the combined step's length, at most `best`; du
    cdef const double *w = kept(e, g)
    cdef double x[4]
    cdef double y[4]
    cdef double a
    cdef int32_t k
    gather(e, i, g, dz, x)
    scale_back(w, n, x, y)
    a = cone_step(w + KEPT_V, y, n)
    best = a if a < best else best
    for k in range(n):
        y[k] = -w[KEPT_C + k] - y[k]
    a = cone_step(w + KEPT_V, y, n)
    scale_back(w, n, y, du)
    return a if a < best else best
