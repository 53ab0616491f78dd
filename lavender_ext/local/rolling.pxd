"""One contact that resists rolling: its projection with the derivative, and its problem with the other blocks held still.

Parts g of a contact of five or six rows after its normal: two tangents, perhaps spin, two that roll, each bounded by
its own a_g times the normal. In z = sqrt(d) lam, with y = z - (H z - g):

    z = Pi(y),   (I - P + P H) dz = -(z - Pi(y)),   P in the derivative of Pi                    (1)

by Newton's method (Coulomb: Alart and Curnier 1991), each step halved while |z - Pi(y)| does not fall.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport CONE, norm2, rolling_section
from lavender_ext.local.small cimport FAILED, MAX_ROWS, OPEN, STICK, eliminate


cdef enum:
    STEPS = 40                  # of Newton's method
    HALVINGS = 6                # of a step, which is then taken as it is


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


cdef inline double residue(int32_t law, int32_t n, const double* H, const double* g, const double* a, const double* z,
                           double* out, double* p, double* size) noexcept nogil:
    # |z - Pi(y)|, Pi(y) in out; size: of what is added up
    cdef double y[MAX_ROWS]
    cdef double total = 0.0, s, x
    cdef int32_t i, j
    size[0] = 0.0
    for i in range(n):
        s = -g[i]
        x = fabs(g[i]) + fabs(z[i])
        for j in range(n):
            s += H[n * i + j] * z[j]
            x += fabs(H[n * i + j] * z[j])
        y[i] = z[i] - s
        size[0] = x if x > size[0] else size[0]
    rolling_map(law, n, a, y, y[0] if y[0] > 0.0 else 0.0, out, p)
    for i in range(n):
        total += (z[i] - out[i]) * (z[i] - out[i])
    return sqrt(total)


cdef inline int32_t rolling_contact(int32_t law, int32_t n, const double* W, const double* q, const double* d, double mu,
                                    double patch_radius, double rolling, double* lam) noexcept nogil:
    """lam (n), n = 5 or 6, from the present one; FAILED, lam left alone, where Newton's method does not end."""
    cdef double H[MAX_ROWS * MAX_ROWS]
    cdef double P[MAX_ROWS * MAX_ROWS]
    cdef double A[MAX_ROWS * MAX_ROWS]
    cdef double g[MAX_ROWS]
    cdef double z[MAX_ROWS]
    cdef double f[MAX_ROWS]
    cdef double to[MAX_ROWS]
    cdef double out[MAX_ROWS]
    cdef double root[MAX_ROWS]
    cdef double a[3]
    cdef double now, next_, size, x
    cdef int32_t i, j, k, _step, _halving, start
    if not W[0] > 0.0:
        return FAILED
    for i in range(n):
        root[i] = sqrt(d[i])
    for i in range(n):
        g[i] = -q[i] / root[i]
        for j in range(n):
            H[n * i + j] = W[n * i + j] / (root[i] * root[j])
    a[0] = mu * root[1] / root[0]
    a[1] = mu * patch_radius * root[3] / root[0] if n == 6 else 0.0
    a[2] = rolling * root[n - 2] / root[0]
    for start in range(2):                              # from where it is, then from where everything sticks
        for i in range(n):
            z[i] = root[i] * lam[i] if start == 0 else g[i]
        if start == 1:
            for i in range(n * n):
                A[i] = H[i]
            eliminate(n, A, z)
        now = residue(law, n, H, g, a, z, out, P, &size)
        for _step in range(STEPS):
            if not now > 1e-15 * size:
                break
            for i in range(n):
                f[i] = out[i] - z[i]
                for j in range(n):
                    x = (1.0 if i == j else 0.0) - P[n * i + j]
                    for k in range(n):
                        x += P[n * i + k] * H[n * k + j]
                    A[n * i + j] = x
            eliminate(n, A, f)
            x = 1.0
            for _halving in range(HALVINGS):
                for i in range(n):
                    to[i] = z[i] + x * f[i]
                next_ = residue(law, n, H, g, a, to, out, P, &size)
                if next_ < now:
                    break
                x = 0.5 * x
            if not next_ < now and now <= 1e-13 * size:
                residue(law, n, H, g, a, z, out, P, &size)
                break
            for i in range(n):
                z[i] = to[i]
            now = next_
        if now <= 1e-13 * size:
            for i in range(n):
                lam[i] = out[i] / root[i]
            return STICK if lam[0] > 0.0 else OPEN
    return FAILED
