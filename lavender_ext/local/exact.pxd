"""The problem of one block alone, solved exactly: w = W lam + q with the other blocks held still.

W is the block's own part of A, any 1x1 to 8x8, not necessarily symmetric. A contact (normal, tangents)
with a = -q_n / W_nn, h = W_nt / W_nn, S = W_tt - W_tn h, r = q_t + W_tn a, after eliminating w_n = 0:

    open    q_n >= 0 (coulomb), q in K* (cone): lam = 0                                           (1)
    stick   S lam_t = -r, lam_n = a - h.lam_t, |lam_t| <= mu lam_n                                (2)
    slip    (S + beta) lam_t = -r, |lam_t| = mu lam_n, beta = |w_t| / |lam_t| >= 0                (3)

With Delta = det(S + beta), u = -adj(S + beta) r = Delta lam_t, (3) is the scalar equation

    mu (a Delta(beta) - h.u(beta)) = |u(beta)|                                                    (4)

negative on the left minus right at beta = 0 where (2) fails, positive at infinity, so a bracket is at
hand whenever Delta > 0 between; for S = s I Newton on the quotient of both sides is exact in one step.

The cone law (w in K*, lam.w = 0) replaces (3) by (W + beta J) lam = -q, J = diag(-mu^2, 1, 1):

    v(beta) = -adj(W + beta J) q = det lam,  |v_t| = mu sign(det) v_n                             (5)

On 0 <= beta < beta*, the positive root of det(W + beta J), W + beta J is positive definite; the sign of
v_n at beta* says on which side of it the root of (5) with lam_n > 0 lies (W symmetric positive definite).

Spin: either w_s = 0, and lam_s is eliminated; or lam_s = +-mu r lam_n, and its column (cone: and row) is
added to the normal's. Three problems without spin; the one whose answer keeps the bound is the answer.

Several rows: boxed complementarity by principal pivoting.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport CONE, clip, cone_error, norm2, relax_normal, relax_row, relax_tangents


cdef enum:
    OPEN = 0
    STICK = 1
    SLIP = 2
    FAILED = -1

cdef enum:
    MAX_ROWS = 8                # of a ROW block that is solved exactly
    PREPARED = 25               # doubles of a prepared 3x3 block


cdef inline void prepare3(const double* W, double* g) noexcept nogil:
    """g (25): W row by row, 1 / W_nn (0: not positive), S row by row, det S (0: singular), 0, W^-1 where det S > 0."""
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
    # S is a difference: below 1e-14 of what was subtracted nothing of its determinant is left.
    size = fabs(W[4]) + fabs(W[8]) + fabs(W[3] * h0) + fabs(W[6] * h1)
    g[14] = det if fabs(det) > 1e-14 * size * size else 0.0
    if not g[14] > 0.0:
        return
    # T = S^-1 stands in the corner of W^-1.
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


cdef inline int32_t eliminate(int32_t n, double* a, double* x) noexcept nogil:
    """x <- a^-1 x by elimination with row pivoting, a (n, n) destroyed; a dependent row leaves its x at 0.

    Returns the rank.
    """
    cdef int32_t col[MAX_ROWS]
    cdef int32_t i, j, k, p, rank = 0
    cdef double big, f, size = 0.0
    for i in range(n * n):
        if fabs(a[i]) > size:
            size = fabs(a[i])
    for k in range(n):
        col[k] = -1
    for k in range(n):                                  # column k
        p = -1
        big = 1e-13 * size
        for i in range(rank, n):
            if fabs(a[n * i + k]) > big:
                big = fabs(a[n * i + k])
                p = i
        if p < 0:
            continue
        if p != rank:
            for j in range(n):
                f = a[n * p + j]
                a[n * p + j] = a[n * rank + j]
                a[n * rank + j] = f
            f = x[p]
            x[p] = x[rank]
            x[rank] = f
        f = 1.0 / a[n * rank + k]
        for j in range(k, n):
            a[n * rank + j] *= f
        x[rank] *= f
        for i in range(n):
            if i != rank and a[n * i + k] != 0.0:
                f = a[n * i + k]
                for j in range(k, n):
                    a[n * i + j] -= f * a[n * rank + j]
                x[i] -= f * x[rank]
        col[rank] = k
        rank += 1
    if rank == n:
        return n                                        # col is the identity
    k = n - 1
    p = rank - 1
    while k >= 0:                                       # back to the columns; from the end, nothing is overwritten
        if p >= 0 and col[p] == k:
            x[k] = x[p]
            p -= 1
        else:
            x[k] = 0.0
        k -= 1
    return rank


cdef inline int32_t slides(const double* W, const double* q, double x0, double x1, const double* lam) noexcept nogil:
    # w_t against the direction x of the friction: what cancellation may have spoiled where W is nearly singular.
    cdef double a = W[3] * lam[0], b = W[6] * lam[0], w0, w1, size
    size = fabs(a) + fabs(b) + fabs(q[1]) + fabs(q[2])
    w0 = a + q[1] + W[4] * lam[1] + W[5] * lam[2]
    w1 = b + q[2] + W[7] * lam[1] + W[8] * lam[2]
    size += (fabs(W[4]) + fabs(W[7])) * fabs(lam[1]) + (fabs(W[5]) + fabs(W[8])) * fabs(lam[2])
    size = 1e-11 * size * (fabs(x0) + fabs(x1))
    return fabs(w0 * x1 - w1 * x0) <= size and w0 * x0 + w1 * x1 <= size


cdef inline int32_t rests(int32_t m, const double* W, const double* q, const double* lam) noexcept nogil:
    # w = 0 to rounding.
    cdef int32_t i, j
    cdef double w, size
    for i in range(m):
        w = q[i]
        size = fabs(q[i])
        for j in range(m):
            w += W[m * i + j] * lam[j]
            size += fabs(W[m * i + j] * lam[j])
        if fabs(w) > 1e-11 * size:
            return 0
    return 1


cdef inline int32_t coulomb3(const double* g, const double* q, double mu, double beta, double* lam) noexcept nogil:
    """lam (3) of (1)-(4); `beta` is a guess of the slip's, 0 for none. FAILED leaves lam alone."""
    cdef double a, h0, h1, r0, r1, u0, u1, x0, x1, det, tr, hr, delta, n, P, U, U2, f, step, lo = 0.0, hi = -1.0
    cdef double hu, size
    cdef double y[3]
    cdef int32_t i, _turn, done = 0
    if q[0] >= 0.0:
        lam[0] = 0.0
        lam[1] = 0.0
        lam[2] = 0.0
        return OPEN
    if not g[9] > 0.0 or not q[0] < 0.0:
        return FAILED
    a = -q[0] * g[9]
    if mu == 0.0:
        lam[0] = a
        lam[1] = 0.0
        lam[2] = 0.0
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
        x0 = 0.0
        x1 = 0.0
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
        # Delta changes its sign at the positive root: look to the right of it.
        lo = -0.5 * tr + sqrt(0.25 * tr * tr - det)
    hr = h0 * r0 + h1 * r1
    if not beta > lo:
        # The root if S were (tr / 2) I.
        beta = (sqrt(r0 * r0 + r1 * r1) - mu * hr) / (mu * a) - 0.5 * tr
        if not beta > lo:
            beta = lo + 1e-3 * (fabs(tr) + lo)
            if not beta > 0.0:
                return FAILED
    for _turn in range(100):
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
        # Quadratic convergence: the next point is exact to rounding.
        done = fabs(f) <= 1e-8 * U and fabs(step) <= 1e-7 * beta
        step = beta - step
        if not lo < step or (hi >= 0.0 and not step < hi) or step > 1e300:
            if hi >= 0.0:
                step = 0.5 * (lo + hi)
                done = hi - lo <= 1e-15 * hi
            else:
                step = 4.0 * beta
                done = 0
                if step > 1e290:
                    return FAILED
        beta = step
    n = U + mu * hu
    if not n > 0.0 or not a / n < 1e300 or not done:
        return FAILED
    n = a / n
    y[0] = n * U
    y[1] = mu * n * x0
    y[2] = mu * n * x1
    if not slides(g, q, x0, x1, y):
        return FAILED
    for i in range(3):
        lam[i] = y[i]
    return SLIP


cdef inline int32_t coulomb3_from(const double* g, const double* w, double mu, double* lam) noexcept nogil:
    """The same from the slack w (3) of the present lam: open and sticking contacts by products alone."""
    cdef double q[3]
    cdef double n, x, y, s, f
    q[0] = w[0] - (g[0] * lam[0] + g[1] * lam[1] + g[2] * lam[2])
    if q[0] >= 0.0:
        lam[0] = 0.0
        lam[1] = 0.0
        lam[2] = 0.0
        return OPEN
    if g[14] > 0.0 and g[9] > 0.0:
        # w = 0 at lam - W^-1 w
        n = lam[0] - (g[16] * w[0] + g[17] * w[1] + g[18] * w[2])
        x = lam[1] - (g[19] * w[0] + g[20] * w[1] + g[21] * w[2])
        y = lam[2] - (g[22] * w[0] + g[23] * w[1] + g[24] * w[2])
        if n >= 0.0 and x * x + y * y <= mu * mu * n * n and mu > 0.0:
            lam[0] = n
            lam[1] = x
            lam[2] = y
            return STICK
    q[1] = w[1] - (g[3] * lam[0] + g[4] * lam[1] + g[5] * lam[2])
    q[2] = w[2] - (g[6] * lam[0] + g[7] * lam[1] + g[8] * lam[2])
    # Sliding as now would need beta = |w_t| / |lam_t|.
    s = lam[1] * lam[1] + lam[2] * lam[2]
    f = -(w[1] * lam[1] + w[2] * lam[2])
    return coulomb3(g, q, mu, f / s if s > 0.0 and f > 0.0 else 0.0, lam)


cdef inline int32_t coulomb2(const double* W, const double* q, double mu, double* lam) noexcept nogil:
    """One tangent: (1)-(3) in closed form; W (2, 2)."""
    cdef double a, h, s, r, n, t, det
    cdef int32_t _side
    if q[0] >= 0.0:
        lam[0] = 0.0
        lam[1] = 0.0
        return OPEN
    if not W[0] > 0.0 or not q[0] < 0.0:
        return FAILED
    a = -q[0] / W[0]
    h = W[1] / W[0]
    s = W[3] - W[2] * h
    r = q[1] + W[2] * a
    t = -r / s if fabs(s) > 1e-15 * (fabs(W[3]) + fabs(W[2] * h)) else 0.0
    n = a - h * t
    if fabs(t) <= mu * n and (t != 0.0 or fabs(r) <= 1e-15 * (fabs(q[1]) + fabs(W[2]) * a)):
        lam[0] = n
        lam[1] = t
        return STICK
    s = -1.0 if r > 0.0 else 1.0
    for _side in range(2):
        det = 1.0 + mu * h * s
        if det > 0.0:
            n = a / det
            t = mu * n * s
            if (n < 1e300 and s * (W[2] * n + W[3] * t + q[1])
                    <= 1e-15 * (fabs(W[2]) * n + fabs(W[3] * t) + fabs(q[1]))):
                lam[0] = n
                lam[1] = t
                return SLIP
        s = -s
    return FAILED


cdef inline int32_t on_ray(const double* W, const double* q, double mu, double s0, double s1,
                           double* lam) noexcept nogil:
    # The least of the energy on lam = l (1, mu s), l > 0: lam.w = 0.
    cdef double x0 = mu * s0, x1 = mu * s1
    cdef double n = (W[0] + (W[1] + W[3]) * x0 + (W[2] + W[6]) * x1 + W[4] * x0 * x0 + (W[5] + W[7]) * x0 * x1
                     + W[8] * x1 * x1)
    cdef double l = -(q[0] + q[1] * x0 + q[2] * x1) / n
    cdef double y[3]
    if not n > 0.0 or not l >= 0.0 or not l < 1e300:
        return FAILED
    y[0] = l
    y[1] = l * x0
    y[2] = l * x1
    if not slides(W, q, s0, s1, y):
        return FAILED
    lam[0] = l
    lam[1] = y[1]
    lam[2] = y[2]
    return SLIP


cdef inline int32_t rests_singular(const double* W, const double* q, double* x) noexcept nogil:
    # Nearly the shortest x with W x = -q, W singular: refined from W + 1e-6 diag W. 0 where there is none.
    cdef double a[9]
    cdef double y[3]
    cdef int32_t i, j, _turn
    for i in range(3):
        x[i] = 0.0
    for _turn in range(4):
        for i in range(3):
            y[i] = -q[i]
            for j in range(3):
                y[i] -= W[3 * i + j] * x[j]
                a[3 * i + j] = W[3 * i + j]
            a[4 * i] *= 1.000001
        if eliminate(3, a, y) < 3:
            return 0
        for i in range(3):
            x[i] += y[i]
    return rests(3, W, q, x)


cdef inline int32_t cone3(const double* W, const double* q, double mu, double* lam) noexcept nogil:
    """lam (3) of (5); FAILED leaves lam alone."""
    cdef double m2 = mu * mu, d1, d2, beta, top, f, df, step, lo, hi, side, P, U, d0
    cdef double v0[3]
    cdef double v1[3]
    cdef double v2[3]
    cdef double v[3]
    cdef int32_t _turn, k, done = 0
    if q[0] >= mu * norm2(q[1], q[2]):
        lam[0] = 0.0
        lam[1] = 0.0
        lam[2] = 0.0
        return OPEN
    if not W[0] > 0.0:
        return FAILED
    if mu == 0.0:
        lam[0] = -q[0] / W[0]
        lam[1] = 0.0
        lam[2] = 0.0
        return SLIP if lam[0] < 1e300 else FAILED
    # v(beta) = v0 + beta v1 + beta^2 v2, det(W + beta J) = d0 + d1 beta + d2 beta^2 - mu^2 beta^3
    v0[0] = -((W[4] * W[8] - W[5] * W[7]) * q[0] + (W[2] * W[7] - W[1] * W[8]) * q[1]
              + (W[1] * W[5] - W[2] * W[4]) * q[2])
    v0[1] = -((W[5] * W[6] - W[3] * W[8]) * q[0] + (W[0] * W[8] - W[2] * W[6]) * q[1]
              + (W[2] * W[3] - W[0] * W[5]) * q[2])
    v0[2] = -((W[3] * W[7] - W[4] * W[6]) * q[0] + (W[1] * W[6] - W[0] * W[7]) * q[1]
              + (W[0] * W[4] - W[1] * W[3]) * q[2])
    v1[0] = -((W[4] + W[8]) * q[0] - W[1] * q[1] - W[2] * q[2])
    v1[1] = -(-W[3] * q[0] + (W[0] - m2 * W[8]) * q[1] + m2 * W[5] * q[2])
    v1[2] = -(-W[6] * q[0] + m2 * W[7] * q[1] + (W[0] - m2 * W[4]) * q[2])
    v2[0] = -q[0]
    v2[1] = m2 * q[1]
    v2[2] = m2 * q[2]
    d0 = (W[0] * (W[4] * W[8] - W[5] * W[7]) + W[1] * (W[5] * W[6] - W[3] * W[8]) + W[2] * (W[3] * W[7] - W[4] * W[6]))
    d1 = W[0] * (W[4] + W[8]) - W[1] * W[3] - W[2] * W[6] - m2 * (W[4] * W[8] - W[5] * W[7])
    d2 = W[0] - m2 * (W[4] + W[8])
    if d0 > 0.0 and v0[0] >= 0.0 and norm2(v0[1], v0[2]) <= mu * v0[0] and v0[0] < 1e300 * d0:
        for k in range(3):
            v[k] = v0[k] / d0
        if rests(3, W, q, v):
            for k in range(3):
                lam[k] = v[k]
            return STICK
        return FAILED
    if d0 <= 1e-10 * (W[0] * W[4] * W[8]) and rests_singular(W, q, v) and norm2(v[1], v[2]) <= mu * v[0]:
        for k in range(3):
            lam[k] = v[k]
        return STICK
    # beta*: Newton from the right of every root falls onto the largest.
    top = W[0] / m2
    for _turn in range(60):
        f = d0 + top * (d1 + top * (d2 - m2 * top))
        df = d1 + top * (2.0 * d2 - 3.0 * m2 * top)
        if not f < 0.0 or not df < 0.0:
            break
        step = f / df
        top -= step
        if step <= 1e-15 * top:
            break
    if not top > 0.0:
        return FAILED
    side = 1.0 if v0[0] + top * (v1[0] + top * v2[0]) >= 0.0 else -1.0
    # side 1: |v_t| - mu v_n falls from positive at 0 to negative at beta*; side -1: |v_t| + mu v_n rises
    # from negative at beta* to positive at infinity.
    lo = 0.0 if side > 0.0 else top
    hi = top if side > 0.0 else -1.0
    beta = 0.5 * top if side > 0.0 else 2.0 * top
    for _turn in range(200):
        for k in range(3):
            v[k] = v0[k] + beta * (v1[k] + beta * v2[k])
        U = norm2(v[1], v[2])
        if done or not U > 0.0:
            break
        P = side * mu * v[0]
        f = U - P
        if f * side > 0.0:
            lo = beta
        else:
            hi = beta
        df = ((v[1] * (v1[1] + 2.0 * beta * v2[1]) + v[2] * (v1[2] + 2.0 * beta * v2[2])) / U
              - side * mu * (v1[0] + 2.0 * beta * v2[0]))
        step = f / df
        done = fabs(f) <= 1e-8 * U and fabs(step) <= 1e-7 * beta
        step = beta - step
        if not lo < step or (hi >= 0.0 and not step < hi) or not step < 1e300:
            if hi >= 0.0:
                step = 0.5 * (lo + hi)
                done = hi - lo <= 1e-15 * hi
            else:
                step = 4.0 * beta
                done = 0
                if step > 1e290:
                    return FAILED
        beta = step
    if not U > 0.0 or not done:
        return FAILED
    U = side / U
    return on_ray(W, q, mu, v[1] * U, v[2] * U, lam)


cdef inline int32_t cone2(const double* W, const double* q, double mu, double* lam) noexcept nogil:
    """One tangent under the cone law, in closed form; W (2, 2)."""
    cdef double det, n, t, s, l
    cdef double y[2]
    cdef int32_t _side
    if q[0] >= mu * fabs(q[1]):
        lam[0] = 0.0
        lam[1] = 0.0
        return OPEN
    det = W[0] * W[3] - W[1] * W[2]
    n = W[1] * q[1] - W[3] * q[0]
    t = W[2] * q[0] - W[0] * q[1]
    if det > 0.0 and n >= 0.0 and fabs(t) <= mu * n and n < 1e300 * det:
        y[0] = n / det
        y[1] = t / det
        if rests(2, W, q, y):
            lam[0] = y[0]
            lam[1] = y[1]
            return STICK
    s = 1.0 if t > 0.0 else -1.0
    for _side in range(2):
        n = W[0] + mu * s * (W[1] + W[2]) + mu * mu * W[3]
        l = -(q[0] + mu * s * q[1])
        if n > 0.0 and l >= 0.0 and l < 1e300 * n:
            l = l / n
            if (s * (W[2] * l + W[3] * mu * s * l + q[1])
                    <= 1e-14 * (fabs(W[2]) * l + fabs(W[3]) * mu * l + fabs(q[1]))):
                lam[0] = l
                lam[1] = mu * s * l
                return SLIP
        s = -s
    return FAILED


cdef inline int32_t contact_without_spin(int32_t law, int32_t nt, const double* W, const double* q, double mu,
                                         double* lam) noexcept nogil:
    cdef double g[PREPARED]
    if nt == 0:
        if q[0] >= 0.0:
            lam[0] = 0.0
            return OPEN
        if not W[0] > 0.0 or not q[0] < 0.0:
            return FAILED
        lam[0] = -q[0] / W[0]
        return STICK
    if nt == 1:
        return cone2(W, q, mu, lam) if law == CONE else coulomb2(W, q, mu, lam)
    if law == CONE:
        return cone3(W, q, mu, lam)
    prepare3(W, g)
    return coulomb3(g, q, mu, 0.0, lam)


cdef inline int32_t contact_with_spin(int32_t law, int32_t nt, const double* W, const double* q, double mu,
                                      double patch_radius, double* lam) noexcept nogil:
    """lam (2 + nt), spin last; W (2 + nt, 2 + nt)."""
    cdef double w[9]
    cdef double c[3]
    cdef double x[3]
    cdef double bound = mu * patch_radius, s, ws, y, size
    cdef int32_t n = 1 + nt, m = 2 + nt, i, j, k, trial, found
    # The first guess is what the block did last: sliding at a bound, or held.
    s = 1.0 if lam[n] >= bound * lam[0] else (-1.0 if lam[n] <= -bound * lam[0] else 0.0)
    for trial in range(3):
        if trial > 0:
            s = (1.0 if s == 0.0 else (-1.0 if s > 0.0 else 0.0))
        if s == 0.0 and not W[m * n + n] > 0.0:
            continue
        for i in range(n):
            y = W[m * i + n] / W[m * n + n] if s == 0.0 else 0.0
            c[i] = q[i] - y * q[n]
            for j in range(n):
                w[n * i + j] = W[m * i + j] - y * W[m * n + j]
            if s != 0.0:
                w[n * i] += s * bound * W[m * i + n]
        if s != 0.0 and law == CONE:
            c[0] += s * bound * q[n]
            for j in range(n):
                w[j] += s * bound * W[m * n + j]
            w[0] += bound * bound * W[m * n + n]
        found = contact_without_spin(law, nt, w, c, mu, x)
        if found == FAILED:
            continue
        ws = q[n]
        size = fabs(q[n])
        for j in range(n):
            ws += W[m * n + j] * x[j]
            size += fabs(W[m * n + j] * x[j])
        if s == 0.0:
            y = -ws / W[m * n + n]
            # Rounding decides on the border, where both answers are the same.
            if fabs(y) > bound * x[0] + 1e-14 * size / W[m * n + n]:
                continue
            y = clip(y, -bound * x[0], bound * x[0])
        else:
            y = s * bound * x[0]
            ws += W[m * n + n] * y
            size += fabs(W[m * n + n] * y)
            if s * ws > 1e-14 * size:
                continue
        for k in range(n):
            lam[k] = x[k]
        lam[n] = y
        return found
    return FAILED


cdef inline void local_slack(int32_t m, const double* W, const double* q, const double* lam, double* w) noexcept nogil:
    cdef int32_t i, j
    for i in range(m):
        w[i] = q[i]
        for j in range(m):
            w[i] += W[m * i + j] * lam[j]


cdef inline void project_locally(int32_t law, int32_t nt, int32_t spin, const double* W, const double* q,
                                 const double* d, const double* step, double mu, double patch_radius,
                                 double* lam) noexcept nogil:
    """Where no exact answer is found: the update of core/block.pxd (cone: projected gradient) on the block alone."""
    cdef int32_t m = 1 + nt + spin, _sweep, i
    cdef double w[4]
    cdef double e[4]
    cdef double high[4]
    cdef double change, bound
    for _sweep in range(20):
        change = 0.0
        for i in range(m):
            e[i] = lam[i]
        if law == CONE:
            for i in range(m):
                high[i] = m * d[i]
            local_slack(m, W, q, lam, w)
            cone_error(lam, w, high, mu, patch_radius, nt, spin, e)
            for i in range(m):
                lam[i] -= e[i]
                change += fabs(e[i])
        else:
            local_slack(m, W, q, lam, w)
            lam[0] = relax_normal(lam[0], w[0], step[0])
            bound = mu * lam[0]
            if nt > 0:
                local_slack(m, W, q, lam, w)
                relax_tangents(lam + 1, w + 1, step[1], bound, nt)
            if spin:
                local_slack(m, W, q, lam, w)
                lam[m - 1] = relax_row(lam[m - 1], w[m - 1], step[m - 1], -bound * patch_radius, bound * patch_radius)
            for i in range(m):
                change += fabs(lam[i] - e[i])
        if not change > 1e-12 * fabs(lam[0]):
            break


cdef inline int32_t boxed_rows(int32_t n, const double* W, const double* w, const double* step, const double* low,
                               const double* high, double* lam) noexcept nogil:
    """lam (n) between its bounds, complementary to W (lam - lam_0) + w; from the current lam_0.

    Principal pivoting, all wrong rows at once, then the first wrong one alone (Murty). Returns STICK, or FAILED
    after sweeps over the rows where neither ends.
    """
    cdef int32_t at[MAX_ROWS]   # -1 lower, 1 upper, 0 free
    cdef int32_t row[MAX_ROWS]
    cdef double a[MAX_ROWS * MAX_ROWS]
    cdef double x[MAX_ROWS]
    cdef double y[MAX_ROWS]
    cdef double z[MAX_ROWS]
    cdef double s, size, change
    cdef int32_t i, j, m, trial, wrong, _sweep
    for i in range(n):
        s = lam[i] - w[i] * step[i]
        at[i] = -1 if s < low[i] else (1 if s > high[i] else 0)
    for trial in range(20 + 6 * n):
        m = 0
        for i in range(n):
            if at[i] == 0:
                row[m] = i
                m += 1
            y[i] = (low[i] if at[i] < 0 else high[i]) - lam[i] if at[i] != 0 else 0.0     # the change
        for i in range(m):
            x[i] = -w[row[i]]
            for j in range(n):
                if at[j] != 0:
                    x[i] -= W[n * row[i] + j] * y[j]
            for j in range(m):
                a[m * i + j] = W[n * row[i] + row[j]]
        eliminate(m, a, x)
        for i in range(m):
            y[row[i]] = x[i]
        wrong = 0
        for i in range(n):
            z[i] = w[i]
            size = fabs(w[i])
            for j in range(n):
                z[i] += W[n * i + j] * y[j]
                size += fabs(W[n * i + j] * y[j])
            if at[i] == 0:
                s = lam[i] + y[i]
                j = -1 if s < low[i] else (1 if s > high[i] else 0)
                if fabs(z[i]) > 1e-10 * size:           # a dependent row that is not met
                    wrong = -1
                    break
            else:
                j = 0 if at[i] * z[i] > 1e-14 * size else at[i]
            if j != at[i]:
                wrong = 1
                at[i] = j
                if trial >= 6:
                    break
        if wrong == 0:
            for i in range(n):
                lam[i] = low[i] if at[i] < 0 else (high[i] if at[i] > 0 else lam[i] + y[i])
            return STICK
        if wrong < 0:
            break
    for i in range(n):
        x[i] = lam[i]
    for _sweep in range(50):
        change = 0.0
        for i in range(n):
            s = w[i]
            for j in range(n):
                s += W[n * i + j] * (lam[j] - x[j])
            s = relax_row(lam[i], s, step[i], low[i], high[i])
            change += fabs(s - lam[i])
            lam[i] = s
        if not change > 1e-14 * fabs(lam[0]):
            break
    return FAILED
