"""Parts of a contact that resists rolling, and its projection with the derivative.

Parts g of a contact of five or six rows after its normal: two tangents, perhaps spin, two that roll, each bounded by
its own a_g times the normal, in rows scaled by sqrt(d).
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport CONE, norm2, rolling_section


cdef inline int32_t part_of(int32_t n, int32_t g) noexcept nogil:
    # first row of a part: tangents, spin, what rolls; of a contact of n rows
    return 1 if g == 0 else 3 if g == 1 else n - 2


cdef inline int32_t part_size(int32_t n, int32_t g) noexcept nogil:
    return 2 if g != 1 else n - 5


cdef inline void rolling_map(int32_t law, int32_t n, const double* a, const double* y, double rn, double* out,
                             double* p) noexcept nogil:
    """out (n) = Pi(y) and P (n, n); a (3); rn: the normal that bounds the parts of Coulomb's law."""
    cdef double t[3]
    cdef double bound[3]
    cdef double ray[6]
    cdef double s, norm = 1.0, kappa, x
    cdef int32_t g, j, k, l, m
    for k in range(n * n):
        p[k] = 0.0
    for g in range(3):
        j = part_of(n, g)
        m = part_size(n, g)
        t[g] = norm2(y[j], y[j + 1]) if m == 2 else fabs(y[j]) if m == 1 else 0.0
    if law == CONE:
        s = rolling_section(a, t, y[0], bound)
    else:
        s = y[0] if y[0] > 0.0 else 0.0
        for g in range(3):
            bound[g] = a[g] * rn
    for k in range(n):
        out[k] = ray[k] = 0.0
    out[0] = s
    x = y[0] + t[0] + t[1] + t[2]
    if x != x:
        out[0] = x                                      # NaN: comparisons hide it
        return
    ray[0] = 1.0
    if law != CONE or s > 0.0:
        for g in range(3):
            j = part_of(n, g)
            m = part_size(n, g)
            if m == 0:
                continue
            if t[g] <= bound[g]:
                if bound[g] > 0.0:
                    for k in range(j, j + m):
                        out[k] = y[k]
                        p[k * n + k] = 1.0
                continue
            for k in range(j, j + m):
                x = y[k] / t[g]
                ray[k] = a[g] * x
                out[k] = bound[g] * x
            norm += a[g] * a[g]
            if m == 2:                                  # along the rim
                kappa = bound[g] / t[g]
                for k in range(2):
                    for l in range(2):
                        x = (y[j] * y[j] + y[j + 1] * y[j + 1] - y[j + k] * y[j + k] if k == l
                             else -y[j] * y[j + 1])
                        p[(j + k) * n + j + l] += kappa * (x / (t[g] * t[g]))
    if law == CONE:
        if s > 0.0:
            for k in range(n):
                for l in range(n):
                    p[k * n + l] += ray[k] * ray[l] / norm
        return
    p[0] = 1.0 if y[0] > 0.0 else 0.0
    if rn > 0.0:
        for k in range(1, n):
            p[k * n] += ray[k]
