"""Exact solution of one round cone: w = W lam + q in K*, lam in K = {|lam_T| <= mu lam_n}, lam.w = 0.

The cone has one to five tangents, the law is CONE, and W is symmetric positive semidefinite. For a given normal impulse s
the tangents minimise the energy over a ball of radius mu s (More, Sorensen 1983); with W_TT = Q diag(h) Q^T

    c = Q^T (q_T + s W_Tn),   z = -c / (h + beta),   beta >= 0:  beta = 0 or |z| = mu s               (1)

s is the root of the derivative of that minimum, which is convex in s:

    f(s) = W_nn s + q_n + W_nT Q z - mu^2 beta s                                                      (2)

A sliding contact then has w_n = mu |w_T| (w_T = -beta Q z), a sticking one w = 0. Prepared: W (n, n), Q (nt, nt)
by columns, h (nt).
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport length, round_error
from lavender_ext.local.small cimport FAILED, OPEN, SLIP, STICK


cdef enum:
    MAX_TANGENTS = 5
    MAX_ITERATIONS = 60         # sweeps of Jacobi's method, and iterations of each root search


cdef inline void symmetric_eigen(int32_t n, double* a, double* vectors, double* h) noexcept nogil:
    """Decompose a symmetric a (n, n) = Q diag(h) Q^T by Jacobi's method; a is overwritten, vectors (n, n) is Q^T."""
    cdef int32_t i, j, k, _iteration
    cdef double off, size, t, c, s, x, y
    for i in range(n * n):
        vectors[i] = 0.0
    for i in range(n):
        vectors[i * n + i] = 1.0
    for _iteration in range(MAX_ITERATIONS):
        off = 0.0
        size = 0.0
        for i in range(n):
            size += a[i * n + i] * a[i * n + i]
            for j in range(i):
                off += a[i * n + j] * a[i * n + j]
        if not off > 1e-32 * size:
            break
        for i in range(n):
            for j in range(i):
                if a[i * n + j] == 0.0:
                    continue
                x = (a[j * n + j] - a[i * n + i]) / (2.0 * a[i * n + j])
                t = (1.0 if x >= 0.0 else -1.0) / (fabs(x) + sqrt(1.0 + x * x))
                c = 1.0 / sqrt(1.0 + t * t)
                s = t * c
                for k in range(n):
                    x = a[k * n + i]
                    y = a[k * n + j]
                    a[k * n + i] = c * x - s * y
                    a[k * n + j] = s * x + c * y
                for k in range(n):
                    x = a[i * n + k]
                    y = a[j * n + k]
                    a[i * n + k] = c * x - s * y
                    a[j * n + k] = s * x + c * y
                    x = vectors[i * n + k]
                    y = vectors[j * n + k]
                    vectors[i * n + k] = c * x - s * y
                    vectors[j * n + k] = s * x + c * y
    for i in range(n):
        h[i] = a[i * n + i] if a[i * n + i] > 0.0 else 0.0


cdef inline void prepare_round(int32_t n, const double* W, double* g) noexcept nogil:
    """Write W, Q and h of a contact of n rows to g."""
    cdef int32_t nt = n - 1, i, j
    cdef double a[MAX_TANGENTS * MAX_TANGENTS]
    for i in range(n * n):
        g[i] = W[i]
    for i in range(nt):
        for j in range(nt):
            a[i * nt + j] = 0.5 * (W[(1 + i) * n + 1 + j] + W[(1 + j) * n + 1 + i])
    symmetric_eigen(nt, a, g + n * n, g + n * n + nt * nt)


cdef inline double minimize_in_ball(int32_t nt, const double* h, const double* c, double radius, double* z) noexcept nogil:
    """Compute z and return beta of (1). Newton's method on 1 / |z| starts from below, from where it does not overshoot."""
    cdef int32_t i, _iteration
    cdef double beta = 0.0, size, slope, x, top = 0.0
    for i in range(nt):
        if h[i] > top:
            top = h[i]
    for i in range(nt):
        x = fabs(c[i]) / radius - h[i]
        if x > beta:
            beta = x
    for _iteration in range(MAX_ITERATIONS):
        size = 0.0
        slope = 0.0
        for i in range(nt):
            if c[i] == 0.0 or (beta == 0.0 and h[i] <= 1e-14 * top):
                z[i] = 0.0                              # no force, or no stiffness
                continue
            z[i] = -c[i] / (h[i] + beta)
            size += z[i] * z[i]
            slope += z[i] * z[i] / (h[i] + beta)
        size = sqrt(size)
        if size <= radius or not slope > 0.0:
            break
        x = beta + (size - radius) / radius * (size * size / slope)
        if not x > beta:
            break
        beta = x
    return beta


cdef inline double normal_derivative(int32_t n, const double* g, const double* q, double mu, double s, double* z) noexcept nogil:
    """Return f(s) of (2) and compute z of (1)."""
    cdef int32_t nt = n - 1, i, j
    cdef const double* rotation = g + n * n
    cdef double c[MAX_TANGENTS]
    cdef double f = g[0] * s + q[0], beta, x
    for i in range(nt):
        x = 0.0
        for j in range(nt):
            x += rotation[i * nt + j] * (q[1 + j] + s * g[(1 + j) * n])
        c[i] = x
    beta = minimize_in_ball(nt, rotation + nt * nt, c, mu * s, z)
    for i in range(nt):
        x = 0.0
        for j in range(nt):
            x += rotation[i * nt + j] * g[1 + j]
        f += x * z[i]
    return f - mu * mu * beta * s


cdef inline int32_t round_contact(int32_t n, const double* g, const double* q, const double* d, double mu,
                                  double* lam) noexcept nogil:
    """Solve for lam (n); FAILED keeps lam."""
    cdef int32_t nt = n - 1, i, j, _iteration, side = 0
    cdef const double* rotation = g + n * n
    cdef double z[MAX_TANGENTS]
    cdef double x[MAX_TANGENTS + 1]
    cdef double w[MAX_TANGENTS + 1]
    cdef double e[MAX_TANGENTS + 1]
    cdef double low = 0.0, high, at_low, at_high, s, f, size = length(q + 1, nt), wrong
    if q[0] >= mu * size:
        for i in range(n):
            lam[i] = 0.0
        return OPEN
    if not g[0] > 0.0:
        return FAILED
    if mu == 0.0:
        for i in range(1, n):
            lam[i] = 0.0
        lam[0] = -q[0] / g[0]
        return SLIP
    at_low = q[0] - mu * size
    high = lam[0] if lam[0] > 0.0 else fabs(at_low) / g[0]
    at_high = normal_derivative(n, g, q, mu, high, z)
    for _iteration in range(200):
        if at_high >= 0.0:
            break
        low = high
        at_low = at_high
        high = 2.0 * high
        at_high = normal_derivative(n, g, q, mu, high, z)
    if not at_high >= 0.0:
        return FAILED
    s = high
    for _iteration in range(3 * MAX_ITERATIONS):                      # regula falsi with halved end values (Dowell, Jarratt 1971)
        if at_high == 0.0 or high - low <= 2e-16 * high:
            s = high
            break
        s = low - at_low * (high - low) / (at_high - at_low)
        if not low < s < high:
            s = 0.5 * (low + high)
            if not low < s < high:
                break
        f = normal_derivative(n, g, q, mu, s, z)
        if f == 0.0:
            break
        if f < 0.0:
            low = s
            at_low = f
            if side < 0:
                at_high *= 0.5
            side = -1
        else:
            high = s
            at_high = f
            if side > 0:
                at_low *= 0.5
            side = 1
    normal_derivative(n, g, q, mu, s, z)
    x[0] = s
    for j in range(nt):
        x[1 + j] = 0.0
        for i in range(nt):
            x[1 + j] += rotation[i * nt + j] * z[i]
    # W may be unsymmetric; accept the result only if the judge's error is small.
    size = 0.0
    wrong = 0.0
    for i in range(n):
        w[i] = q[i]
        f = fabs(q[i])
        for j in range(n):
            w[i] += g[i * n + j] * x[j]
            f += fabs(g[i * n + j] * x[j])
        size += f * f / d[i]
    round_error(x, w, d, mu, nt, e)
    for i in range(n):
        wrong += d[i] * e[i] * e[i]
    if not wrong <= 1e-20 * size:
        return FAILED
    for i in range(n):
        lam[i] = x[i]
    return STICK
