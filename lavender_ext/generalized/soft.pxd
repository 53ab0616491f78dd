"""The impulse that a softened block answers with, and its derivative.

With theta > 0 [1/kg] on every row and s = J (v - v*) - b [m/s], shifted, a block's law determines its impulse:

    z = -s / theta
    row        lambda = clip(z, lower, upper)
    cone       lambda = Pi(z), the projection on the cone in the metric of theta                         (1)
    coulomb    lambda_n = max(0, z_n), tangents on the disk mu lambda_n, spin on mu r lambda_n           (2)
    V          -d lambda / d s, of the block's rows

theta is equal on all tangents of a disk, which makes (1) a closed form: y = sqrt(theta) z, and s as in
`core/block.pxd`, (7). Tangents may be one to five (a round cone); a cylinder has a spin row beside its disk;
what rolls has a disk of its own (`core/rolling.pxd`).
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.rolling cimport rolling_map


cdef enum:
    OFF = 0                     # V = 0
    INSIDE = 1                  # V = 1 / theta
    SLIDES = 2                  # V changes with s


cdef inline double size_of(const double* x, int32_t n) noexcept nogil:
    cdef int32_t i
    cdef double s = 0.0
    for i in range(n):
        s += x[i] * x[i]
    return sqrt(s)


cdef inline void no_derivative(double* v, int32_t n) noexcept nogil:
    cdef int32_t i
    for i in range(n * n):
        v[i] = 0.0


cdef inline int32_t cone_map(int32_t nt, int32_t spin, const double* theta, double mu, double radius, double* lam,
                             double* v) noexcept nogil:
    """(1) of one contact: z in lam becomes lambda; v ((1 + nt + spin)^2), or NULL."""
    cdef int32_t i, j, n = 1 + nt + spin, on_t, on_s
    cdef double rn = sqrt(theta[0]), rt = 1.0, rs = 1.0, at = 0.0, as_ = 0.0, yn, t = 0.0, ys = 0.0, s, c, den, f, g
    cdef double unit[5]
    yn = rn * lam[0]
    if nt > 0:
        rt = sqrt(theta[1])
        at = mu * rt / rn
        t = rt * size_of(lam + 1, nt)
    if spin:
        rs = sqrt(theta[n - 1])
        as_ = mu * radius * rs / rn
        ys = rs * lam[n - 1]
    s = yn if yn > 0.0 else 0.0
    c = (yn + at * t) / (1.0 + at * at)
    if c > s:
        s = c
    if spin:
        c = (yn + as_ * fabs(ys)) / (1.0 + as_ * as_)
        if c > s:
            s = c
        c = (yn + at * t + as_ * fabs(ys)) / (1.0 + at * at + as_ * as_)
        if c > s:
            s = c
    if v != NULL:
        no_derivative(v, n)
    if not s > 0.0:
        for i in range(n):
            lam[i] = 0.0 * yn                           # NaN stays
        return OFF
    on_t = t > at * s
    on_s = fabs(ys) > as_ * s
    if not on_t and not on_s:
        if v != NULL:
            for i in range(n):
                v[i * n + i] = 1.0 / theta[i]
        return INSIDE
    lam[0] = s / rn
    den = 1.0 + (at * at if on_t else 0.0) + (as_ * as_ if on_s else 0.0)
    f = at * s / t if on_t else 1.0
    for i in range(nt):
        unit[i] = rt * lam[1 + i] / t if on_t else 0.0
        lam[1 + i] *= f
    g = 0.0
    if on_s:
        g = 1.0 if ys > 0.0 else -1.0
        lam[n - 1] = g * as_ * s / rs
    if v == NULL:
        return SLIDES
    # In y: d s = (d y_n + a_t unit.d y_t + a_s g d y_s) / den, and P_t = a_t s unit, P_s = a_s s g where they slide.
    v[0] = 1.0 / (den * theta[0])
    for i in range(nt):
        v[1 + i] = at * unit[i] / (den * rn * rt)
        v[(1 + i) * n] = v[1 + i]
    for i in range(nt):
        for j in range(nt):
            if on_t:
                c = (at * at / den - f) * unit[i] * unit[j] + (f if i == j else 0.0)
            else:
                c = 1.0 if i == j else 0.0
            v[(1 + i) * n + 1 + j] = c / theta[1]
    if spin:
        j = n - 1
        v[j] = as_ * g / (den * rn * rs)
        v[j * n] = v[j]
        for i in range(nt):
            c = at * as_ * unit[i] * g / (den * rt * rs)
            v[(1 + i) * n + j] = c
            v[j * n + 1 + i] = c
        v[j * n + j] = (as_ * as_ / den if on_s else 1.0) / theta[j]
    return SLIDES


cdef inline int32_t coulomb_map(int32_t nt, int32_t spin, const double* theta, double mu, double radius, double* lam,
                                double* v) noexcept nogil:
    """(2) of one contact; v lacks symmetry where it slides."""
    cdef int32_t i, j, n = 1 + nt + spin, zone = INSIDE
    cdef double bound, t, f
    cdef double unit[5]
    if v != NULL:
        no_derivative(v, n)
    if not lam[0] > 0.0:
        f = 0.0 * lam[0]                                # NaN stays
        for i in range(n):
            lam[i] = f
        return OFF
    if v != NULL:
        v[0] = 1.0 / theta[0]
    bound = mu * lam[0]
    t = size_of(lam + 1, nt)
    if t > bound:
        zone = SLIDES
        f = bound / t
        for i in range(nt):
            unit[i] = lam[1 + i] / t
            lam[1 + i] *= f
        if v != NULL:
            for i in range(nt):
                v[(1 + i) * n] = mu * unit[i] / theta[0]
                for j in range(nt):
                    v[(1 + i) * n + 1 + j] = f * ((1.0 if i == j else 0.0) - unit[i] * unit[j]) / theta[1]
    elif v != NULL:
        for i in range(nt):
            v[(1 + i) * n + 1 + i] = 1.0 / theta[1]
    if spin:
        j = n - 1
        bound = bound * radius
        if fabs(lam[j]) > bound:
            zone = SLIDES
            f = 1.0 if lam[j] > 0.0 else -1.0
            lam[j] = f * bound
            if v != NULL:
                v[j * n] = f * mu * radius / theta[0]
        elif v != NULL:
            v[j * n + j] = 1.0 / theta[j]
    return zone


cdef inline void rolling_response(int32_t law, int32_t n, const double* theta, double mu, double radius, double rolling,
                                  double* lam, double* v) noexcept nogil:
    """(1) or (2) of one contact that resists rolling, n rows."""
    cdef double a[3]
    cdef double y[6]
    cdef double out[6]
    cdef double root[6]
    cdef int32_t i, j
    for i in range(n):
        root[i] = sqrt(theta[i])
        y[i] = root[i] * lam[i]
    a[0] = mu * root[1] / root[0]
    a[1] = mu * radius * root[3] / root[0] if n == 6 else 0.0
    a[2] = rolling * root[n - 2] / root[0]
    rolling_map(law, n, a, y, y[0] if y[0] > 0.0 else 0.0, out, v)
    for i in range(n):
        lam[i] = lam[i] if out[i] == y[i] else out[i] / root[i]
        for j in range(n):
            v[i * n + j] = v[i * n + j] / (root[i] * root[j])
