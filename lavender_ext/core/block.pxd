"""The arithmetic of one block: the update of a sweep and the error of the judge.

A block is bounded rows, or a normal and its parts g, each with |lam_g| <= a_g lam_n (core/parts.pxd); a round cone has
one bound over all rows behind its normal (law CONE only). With w = A lam - b [m/s] and d = diag(A) [1/kg]:

    update   row      lam  <- clip(lam - w / d, lower, upper)                                  (1)
             normal   lam_n <- max(0, lam_n - w_n / d_n)                                       (2)
             part     lam_g <- radial projection on a_g lam_n of lam_g - w_g / lambda_max(A_gg) (3)
    error    row      e = lam - clip(lam - w / d, lower, upper), w / d where free              (5)
             coulomb  (5) for the normal; e_g = lam_g - Pi_disk(a_g lam_n+)(lam_g - w_g / d_g),
                      lam_n+ = max(0, lam_n)                                                   (6)
             cone     e = lam - Pi(lam - w / d) in the metric of d                             (7)

Every function here is inline, allocates nothing, calls sqrt at most, and serves the sweeps, the
judge, the engine and the WebAssembly build alike.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.parts cimport CONE, PARTS, blocks_t, disk_of, is_disk, is_round, is_rows, parts_of, parts_t


cdef inline double clip(double x, double low, double high) noexcept nogil:
    # NaN passes through, so that a lost iterate is seen.
    return low if x < low else (high if x > high else x)


cdef inline double norm2(double x, double y) noexcept nogil:
    return sqrt(x * x + y * y)


cdef inline double length(const double* x, int32_t n) noexcept nogil:
    """|x|, n numbers."""
    cdef int32_t i
    cdef double s = 0.0
    for i in range(n):
        s += x[i] * x[i]
    return sqrt(s)


cdef inline double relax_row(double lam, double w, double step, double low, double high) noexcept nogil:
    return clip(lam - w * step, low, high)              # (1)


cdef inline double relax_normal(double lam, double w, double step) noexcept nogil:
    cdef double y = lam - w * step                      # (2)
    return 0.0 if y < 0.0 else y


cdef inline void relax_tangents(double* lam, const double* w, double step, double radius,
                                int32_t n) noexcept nogil:
    # (3): lam, w of the n tangent rows; one scalar step for both. Squares decide, so that a sticking contact
    # costs no root.
    cdef double x, y, s, r
    if n == 1:
        lam[0] = clip(lam[0] - w[0] * step, -radius, radius)
        return
    x = lam[0] - w[0] * step
    y = lam[1] - w[1] * step
    s = x * x + y * y
    if s > radius * radius:
        r = radius / sqrt(s)
        x = x * r
        y = y * r
    lam[0] = x
    lam[1] = y


cdef inline double row_error(double lam, double w, double d, double low, double high) noexcept nogil:
    # (5) as clip(w / d, lam - high, lam - low): lam - clip(lam - w / d) would cost digits where no bound acts,
    # and would not see a bound that is huge beside w / d.
    return clip(w / d, lam - high, lam - low)


cdef inline void tangent_error(const double* lam, const double* w, double d, double radius,
                               int32_t n, double* e) noexcept nogil:
    cdef double x, y, r
    if n == 1:
        e[0] = row_error(lam[0], w[0], d, -radius, radius)
    elif n == 2:
        e[0] = w[0] / d
        e[1] = w[1] / d
        x = lam[0] - e[0]
        y = lam[1] - e[1]
        r = norm2(x, y)
        if r > radius:
            r = radius / r
            e[0] = lam[0] - r * x
            e[1] = lam[1] - r * y


cdef inline void coulomb_error(const double* lam, const double* w, const double* d, const parts_t* q, double* e) noexcept nogil:
    # (6)
    cdef double normal = lam[0] if lam[0] > 0.0 else 0.0, inf = 1.0 / 0.0
    cdef int32_t g, j
    e[0] = row_error(lam[0], w[0], d[0], 0.0, inf)
    for g in range(q.n):
        j = q.first[g]
        tangent_error(lam + j, w + j, d[j], q.reach[g] * normal, q.size[g], e + j)


cdef inline double weighed(double lam, double w, double d, double r) noexcept nogil:
    # sqrt(d) (lam - w / d), r = sqrt(d)
    return r * (lam - w / d)


cdef inline double share(double bound, double size) noexcept nogil:
    # of what is longer than its bound; dust may have no size
    return bound / size if size > 0.0 else 0.0


cdef inline double section(const int32_t n, const double* a, const double* t, double yn) noexcept nogil:
    """s of (7), the normal of the projection on |y_g| <= a_g s of n parts, |y_g| = t_g.

    The largest of the candidates (y_n + sum a_g t_g) / (1 + sum a_g^2) over the subsets of parts: pieces of one convex
    piecewise quadratic in s.
    """
    cdef double s = yn if yn > 0.0 else 0.0, up, down
    cdef int32_t g, subset
    for subset in range(1, 1 << n):
        up = yn
        down = 1.0
        for g in range(n):
            if subset >> g & 1:
                up += a[g] * t[g]
                down += a[g] * a[g]
        up = up / down
        if up > s:
            s = up
    return s


cdef inline void cone_error(const double* lam, const double* w, const double* d, const parts_t* q, double* e) noexcept nogil:
    # (7) after y = sqrt(d) (lam - w / d), which makes every part one of `section`
    cdef double t[PARTS]
    cdef double a[PARTS]
    cdef double y[6]
    cdef double rn = sqrt(d[0]), yn = weighed(lam[0], w[0], d[0], rn), total = yn, s, r, f
    cdef int32_t g, i, j, end
    for g in range(q.n):
        j, end = q.first[g], q.first[g] + q.size[g]
        r = sqrt(d[j])
        a[g] = q.reach[g] * r / rn
        for i in range(j, end):
            y[i] = weighed(lam[i], w[i], d[i], r)
        t[g] = length(y + j, q.size[g])
        total += t[g]
    s = section(q.n, a, t, yn)
    # e = lam - Pi: w / d where the projection moves nothing.
    e[0] = w[0] / d[0] if s == yn else lam[0] - s / rn
    for g in range(q.n):
        j, end = q.first[g], q.first[g] + q.size[g]
        f = share(a[g] * s, t[g] * sqrt(d[j]))
        for i in range(j, end):
            e[i] = lam[i] - f * y[i] if t[g] > a[g] * s else w[i] / d[i]
    if total != total:
        e[0] = total                                    # NaN: comparisons above would hide it


cdef inline int32_t round_group(int32_t tangent) noexcept nogil:
    # of tangents 1 to 5: slide, slide, spin, roll, roll
    return 0 if tangent < 3 else (1 if tangent == 3 else 2)


cdef inline double round_rest(double a, double yn) noexcept nogil:
    # q of (8) without its part of r
    return a * a * yn if yn > 0.0 else -yn


cdef inline int32_t round_section(const double* t, const double* a, double yn, double* rise, double* size) noexcept nogil:
    # Where y lies, by T_g in t (3) and a_g in a (3): -1 in the polar cone, 1 in the cone, else 0 and the r of (8);
    # size: of the tangents against the cone, NaN where y is.
    #     s = max(0, y_n) + r,     q_g = (1 + a_g^2) s - y_n = (1 + a_g^2) r + (a_g^2 y_n if y_n > 0 else -y_n)
    #     sum (a_g T_g)^2 / q_g^2 = 1,     Pi_n = s,     Pi_g = y_g a_g^2 s / q_g                            (8)
    # by Newton's method from below: the left side falls and is convex. In r, since in a narrow cone s - y_n has lost
    # the digits of q.
    cdef double r = 0.0, f, h, slope, q, inside = 0.0, polar = 0.0
    cdef int32_t g, _step
    for g in range(3):
        if t[g] > 0.0:
            inside = norm2(inside, t[g] / a[g])         # infinite without friction
            polar = norm2(polar, a[g] * t[g])
            f = a[g] * (t[g] - a[g] * yn) if yn > 0.0 else yn + a[g] * t[g]
            f = f / (1.0 + a[g] * a[g])
            if f > r:
                r = f
    size[0] = inside
    if inside <= yn:
        return 1
    if yn + polar <= 0.0:
        return -1
    if polar > 0.0:
        for _step in range(64):
            h = -1.0
            slope = 0.0
            for g in range(3):
                if t[g] > 0.0:
                    q = (1.0 + a[g] * a[g]) * r + round_rest(a[g], yn)
                    f = a[g] * t[g] / q
                    h += f * f
                    slope += 2.0 * f * f * (1.0 + a[g] * a[g]) / q
            if not h > 0.0:
                break
            f = r + h / slope
            if not f > r:
                break
            r = f
    rise[0] = r
    return 0


cdef inline double round_share(double a, double rise, double yn) noexcept nogil:
    # Pi_g / y_g of (8)
    cdef double q = (1.0 + a * a) * rise + round_rest(a, yn)
    return a * (a * ((yn if yn > 0.0 else 0.0) + rise) / q) if q > 0.0 else 0.0


cdef inline double round_loss(double a, double rise, double yn) noexcept nogil:
    # 1 - Pi_g / y_g of (8), by its own digits
    cdef double q = (1.0 + a * a) * rise + round_rest(a, yn)
    return (rise if yn > 0.0 else rise - yn) / q if q > 0.0 else 1.0


cdef inline void round_error(const double* lam, const double* w, const double* d, double mu, int32_t nt,
                             double* e) noexcept nogil:
    # (7) of ROUND, |lam_T| <= mu lam_n over all tangents together. Groups g (slide, spin, roll) have one d each: (8)
    # with y = sqrt(d) (lam - w / d), T_g = |y_g|, a_g = mu sqrt(d_g / d_n).
    cdef double t[3]
    cdef double a[3]
    cdef double rn = sqrt(d[0]), yn = weighed(lam[0], w[0], d[0], rn), y, r = 0.0, f, inside = 0.0
    cdef int32_t i, g, zone
    t[0] = t[1] = t[2] = 0.0
    a[0] = a[1] = a[2] = 0.0
    for i in range(1, 1 + nt):
        g = round_group(i)
        t[g] = norm2(t[g], weighed(lam[i], w[i], d[i], sqrt(d[i])))
        a[g] = mu * sqrt(d[i]) / rn
    zone = round_section(t, a, yn, &r, &inside)
    for i in range(1 + nt):
        e[i] = lam[i] if zone < 0 else w[i] / d[i]
    if zone == 0:
        # lam - Pi as w / d and what the projection adds, where that is the smaller part
        e[0] = (e[0] if yn > 0.0 else lam[0]) - r / rn
        for i in range(1, 1 + nt):
            f = round_share(a[round_group(i)], r, yn)
            y = lam[i] - e[i]
            e[i] = e[i] + round_loss(a[round_group(i)], r, yn) * y if f > 0.5 else lam[i] - f * y
    if not (yn == yn and inside == inside):
        e[0] = yn + inside                              # NaN: comparisons above would hide it


cdef inline void contact_error(int32_t law, const double* lam, const double* w, const double* d, const parts_t* q,
                               double* e) noexcept nogil:
    """Error of one contact of parts q under its law: where the judge tells laws apart."""
    if law == CONE:
        cone_error(lam, w, d, q, e)
    else:
        coulomb_error(lam, w, d, q, e)


cdef inline void block_error(const blocks_t* p, int32_t i, const double* lam, const double* w,
                             double* e) noexcept nogil:
    """Error e of block i [N s]; lam, w, e are whole vectors (m)."""
    cdef int32_t j = p.ptr[i], end = p.ptr[i + 1]
    cdef parts_t q
    if is_rows(p, i):
        while j < end:
            e[j] = row_error(lam[j], w[j], p.d[j], p.lower[j], p.upper[j])
            j += 1
    elif is_disk(p, i):                                 # compiled apart
        disk_of(p, i, &q)
        contact_error(p.law, lam + j, w + j, p.d + j, &q, e + j)
    elif is_round(p, i):
        round_error(lam + j, w + j, p.d + j, p.mu[i], end - j - 1, e + j)
    else:
        parts_of(p, i, &q)
        contact_error(p.law, lam + j, w + j, p.d + j, &q, e + j)
