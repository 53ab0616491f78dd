"""Exact solution of one contact under Coulomb's law: w = W lam + q with the other blocks fixed.

A contact (normal, tangents) with a = -q_n / W_nn, h = W_nt / W_nn, S = W_tt - W_tn h, r = q_t + W_tn a, after
eliminating w_n = 0:

    open    q_n >= 0: lam = 0                                                                     (1)
    stick   S lam_t = -r, lam_n = a - h.lam_t, |lam_t| <= mu lam_n                                (2)
    slip    (S + beta) lam_t = -r, |lam_t| = mu lam_n, beta = |w_t| / |lam_t| >= 0                (3)

With Delta = det(S + beta), u = -adj(S + beta) r = Delta lam_t, (3) is the scalar equation

    mu (a Delta(beta) - h.u(beta)) = |u(beta)|                                                    (4)

The left side minus the right side is negative at beta = 0 if (2) fails, and positive at infinity, which is a bracket if
Delta > 0 in between. For S = s I one step of Newton's method on the quotient of both sides is exact.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.local.small cimport FAILED, OPEN, SLIP, STICK


cdef enum:
    PREPARED = 25               # number of doubles of a prepared 3x3 block
    ONE_PATTERN = 15            # index of a flag in them, which `prepare_coulomb_disk` sets to 0


cdef inline void prepare_coulomb_disk(const double* W, double* g) noexcept nogil:
    """Compute the prepared numbers g (25) of a disk from its diagonal block W (3, 3).

    g holds, matrices row by row: W, 1 / W_nn (0 if W_nn is not positive), S, det S (0 if S is singular), 0, W^-1 if det S > 0.
    """
    cdef double h0, h1, k0, k1, inv, det, size, t00, t01, t10, t11
    cdef int32_t i
    for i in range(9):
        g[i] = W[i]
    for i in range(9, PREPARED):
        g[i] = 0.0
    if not W[0] > 0.0:
        return
    inv = 1.0 / W[0]
    h0 = W[1] * inv
    h1 = W[2] * inv
    g[9] = inv
    g[10] = W[4] - W[3] * h0
    g[11] = W[5] - W[3] * h1
    g[12] = W[7] - W[6] * h0
    g[13] = W[8] - W[6] * h1
    det = g[10] * g[13] - g[11] * g[12]
    # S is a difference of terms; a determinant below 1e-14 times their squared size is rounding.
    size = fabs(W[4]) + fabs(W[8]) + fabs(W[3] * h0) + fabs(W[6] * h1)
    g[14] = det if fabs(det) > 1e-14 * size * size else 0.0
    if not g[14] > 0.0:
        return
    # T = S^-1 is the tangential block of W^-1.
    det = 1.0 / det
    t00 = g[13] * det
    t01 = -g[11] * det
    t10 = -g[12] * det
    t11 = g[10] * det
    k0 = W[3] * inv
    k1 = W[6] * inv
    g[17] = -(h0 * t00 + h1 * t10)
    g[18] = -(h0 * t01 + h1 * t11)
    g[19] = -(t00 * k0 + t01 * k1)
    g[20] = t00
    g[21] = t01
    g[22] = -(t10 * k0 + t11 * k1)
    g[23] = t10
    g[24] = t11
    g[16] = inv - (h0 * g[19] + h1 * g[22])


cdef inline int32_t opposes_friction(const double* W, const double* q, double x0, double x1, const double* lam) noexcept nogil:
    """Return whether w_t opposes the friction direction x within rounding; cancellation may break this for a singular W."""
    cdef double a = W[3] * lam[0], b = W[6] * lam[0], w0, w1, size
    size = fabs(a) + fabs(b) + fabs(q[1]) + fabs(q[2])
    w0 = a + q[1] + W[4] * lam[1] + W[5] * lam[2]
    w1 = b + q[2] + W[7] * lam[1] + W[8] * lam[2]
    size += (fabs(W[4]) + fabs(W[7])) * fabs(lam[1]) + (fabs(W[5]) + fabs(W[8])) * fabs(lam[2])
    size = 1e-11 * size * (fabs(x0) + fabs(x1))
    return fabs(w0 * x1 - w1 * x0) <= size and w0 * x0 + w1 * x1 <= size


cdef inline int32_t solve_coulomb_disk(const double* g, const double* q, double mu, double beta, double* lam) noexcept nogil:
    """Solve (1)-(4) for lam (3) [N s]; return FAILED and leave lam unchanged if that fails.

    `beta` is a first guess of beta in (3), 0 without a guess.
    """
    cdef double a, h0, h1, r0, r1, u0, u1, x0, x1, det, tr, hr, delta, n, P, U, U2, f, step, lo = 0.0, hi = -1.0
    cdef double hu, size
    cdef double y[3]
    cdef int32_t i, _iteration, done = 0
    if q[0] >= 0.0:
        lam[0] = lam[1] = lam[2] = 0.0
        return OPEN
    if not g[9] > 0.0 or not q[0] < 0.0:
        return FAILED
    a = -q[0] * g[9]
    if mu == 0.0:
        lam[0] = a
        lam[1] = lam[2] = 0.0
        return SLIP
    h0 = g[1] * g[9]
    h1 = g[2] * g[9]
    r0 = q[1] + g[3] * a
    r1 = q[2] + g[6] * a
    # u(0) = -adj(S) r
    u0 = g[11] * r1 - g[13] * r0
    u1 = g[12] * r0 - g[10] * r1
    det = g[14]
    tr = g[10] + g[13]
    if det > 0.0:
        n = a * det - (h0 * u0 + h1 * u1)
        if n >= 0.0 and u0 * u0 + u1 * u1 <= mu * mu * n * n:
            det = 1.0 / det
            lam[0] = n * det
            lam[1] = u0 * det
            lam[2] = u1 * det
            return STICK
    elif det == 0.0:
        # Rank one or zero: the shortest lam_t with S lam_t = -r, if r is in the range of S.
        size = g[10] * g[10] + g[11] * g[11] + g[12] * g[12] + g[13] * g[13]
        x0 = x1 = 0.0
        if size > 0.0:
            x0 = -(g[10] * r0 + g[12] * r1) / size
            x1 = -(g[11] * r0 + g[13] * r1) / size
        n = a - h0 * x0 - h1 * x1
        if (n >= 0.0 and x0 * x0 + x1 * x1 <= mu * mu * n * n
                and fabs(g[10] * x0 + g[11] * x1 + r0) + fabs(g[12] * x0 + g[13] * x1 + r1)
                <= 1e-13 * (fabs(q[1]) + fabs(q[2]) + (fabs(g[3]) + fabs(g[6])) * a)):
            lam[0] = n
            lam[1] = x0
            lam[2] = x1
            return STICK
        det = g[10] * g[13] - g[11] * g[12]
        if det < 0.0:
            det = 0.0
    else:
        # Delta changes its sign at the positive root; search to the right of it.
        lo = -0.5 * tr + sqrt(0.25 * tr * tr - det)
    hr = h0 * r0 + h1 * r1
    if not beta > lo:
        # initial guess: the root for S = (tr / 2) I
        beta = (sqrt(r0 * r0 + r1 * r1) - mu * hr) / (mu * a) - 0.5 * tr
        if not beta > lo:
            beta = lo + 1e-3 * (fabs(tr) + lo)
            if not beta > 0.0:
                return FAILED
    for _iteration in range(100):
        delta = det + beta * (tr + beta)
        x0 = u0 - beta * r0
        x1 = u1 - beta * r1
        U2 = x0 * x0 + x1 * x1
        U = sqrt(U2)
        hu = h0 * x0 + h1 * x1
        P = mu * (a * delta - hu)
        if done or not U > 0.0:
            break
        f = P - U
        if fabs(f) <= 1e-15 * U:
            done = 1
            break
        if f < 0.0:
            lo = beta
        else:
            hi = beta
        # Newton on P / U - 1: P' = mu (a (tr + 2 beta) + h.r), U' = -x.r / U
        step = f * U2 / (mu * (a * (tr + 2.0 * beta) + hr) * U2 + P * (x0 * r0 + x1 * r1))
        # Convergence is quadratic: the next point is exact within rounding.
        done = fabs(f) <= 1e-8 * U and fabs(step) <= 1e-7 * beta
        if lo < beta - step and (hi < 0.0 or beta - step < hi):
            beta = beta - step
        else:                                           # the middle of the interval, or 4 beta if its end is unknown
            done = hi >= 0.0 and hi - lo <= 1e-15 * hi
            beta = 0.5 * (lo + hi) if hi >= 0.0 else 4.0 * beta
    n = U + mu * hu
    if not n > 0.0 or not a / n < 1.0 / 0.0 or not done:
        return FAILED
    n = a / n
    y[0] = n * U
    y[1] = mu * n * x0
    y[2] = mu * n * x1
    if not opposes_friction(g, q, x0, x1, y):
        return FAILED
    for i in range(3):
        lam[i] = y[i]
    return SLIP


cdef inline bint update_sticking_disk(const double* g, const double* w, double mu, double* lam) noexcept nogil:
    """Set lam (3) to lam - W^-1 w, at which w = 0, if it is within the cone; return whether it is."""
    cdef double n, x, y
    if not g[14] > 0.0 or not g[9] > 0.0:
        return False
    n = lam[0] - (g[16] * w[0] + g[17] * w[1] + g[18] * w[2])
    x = lam[1] - (g[19] * w[0] + g[20] * w[1] + g[21] * w[2])
    y = lam[2] - (g[22] * w[0] + g[23] * w[1] + g[24] * w[2])
    if not (n >= 0.0 and x * x + y * y <= mu * mu * n * n and mu > 0.0):
        return False
    lam[0], lam[1], lam[2] = n, x, y
    return True


cdef inline int32_t update_coulomb_disk(const double* g, const double* w, double mu, double* lam) noexcept nogil:
    """Solve for lam (3) from the slack w (3) of the present lam; open and sticking contacts need only products."""
    cdef double q[3]
    cdef double s, f
    q[0] = w[0] - (g[0] * lam[0] + g[1] * lam[1] + g[2] * lam[2])
    if q[0] >= 0.0:
        lam[0] = lam[1] = lam[2] = 0.0
        return OPEN
    if update_sticking_disk(g, w, mu, lam):
        return STICK
    q[1] = w[1] - (g[3] * lam[0] + g[4] * lam[1] + g[5] * lam[2])
    q[2] = w[2] - (g[6] * lam[0] + g[7] * lam[1] + g[8] * lam[2])
    # guess: beta = |w_t| / |lam_t| of the present sliding
    s = lam[1] * lam[1] + lam[2] * lam[2]
    f = -(w[1] * lam[1] + w[2] * lam[2])
    return solve_coulomb_disk(g, q, mu, f / s if s > 0.0 and f > 0.0 else 0.0, lam)
