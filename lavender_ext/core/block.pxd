"""The arithmetic of one block: the update of a sweep and the error of the judge.

A block is one or more bounded rows (ROW), or a contact: a normal row, then 0, 1 or 2 tangent rows
(CONTACT), then one spin row (CONTACT_SPIN); or a normal and two tangents, each bounded by itself (CONTACT_BOX, in
(1) to (7) a contact of one tangent and, in the place of spin, the other: r is then mu_2 / mu_1); or a normal, two
tangents, perhaps a spin row, and two rows that roll (CONTACT_ROLLING); or a contact of three to five tangents in one
cone (ROUND: two that slide, one that spins, two that roll, scaled to one mu; law CONE only). With w = A lam - b [m/s]
and d = diag(A) [1/kg]:

    update   row      lam  <- clip(lam - w / d, lower, upper)                                  (1)
             normal   lam_n <- max(0, lam_n - w_n / d_n)                                       (2)
             tangents lam_t <- radial projection on mu lam_n of lam_t - w_t / lambda_max(A_tt)  (3)
             spin     lam_s <- clip(lam_s - w_s / d_s, -mu r lam_n, mu r lam_n)                (4)
             rolling  as (3), on mu_r lam_n
    error    row      e = lam - clip(lam - w / d, lower, upper), w / d where free              (5)
             coulomb  (5) for the normal; e_t = lam_t - Pi_disk(mu lam_n+)(lam_t - w_t / d_t),
                      e_s, e_r likewise on mu r lam_n+, mu_r lam_n+, lam_n+ = max(0, lam_n)     (6)
             cone     e = lam - Pi(lam - w / d) in the metric of d                             (7)

Every function here is inline, allocates nothing, calls sqrt at most, and serves the sweeps, the
judge, the engine and the WebAssembly build alike.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t


cdef enum:
    ROW = 0
    CONTACT = 1
    CONTACT_SPIN = 2
    ROUND = 3
    CONTACT_BOX = 4
    CONTACT_ROLLING = 5

cdef enum:
    COULOMB = 0
    CONE = 1


cdef struct blocks_t:
    int32_t n_blocks            # k
    int32_t n_rows              # m
    int32_t law                 # COULOMB | CONE
    const int32_t* ptr          # (k + 1) first row of each block; ptr[0] = 0, increasing
    const int32_t* kind         # (k) ROW | CONTACT | CONTACT_SPIN | ROUND | CONTACT_BOX | CONTACT_ROLLING
    const double* lower         # (m) N s, read on ROW blocks
    const double* upper         # (m) N s, read on ROW blocks
    const double* mu            # (k) -, >= 0
    const double* patch_radius  # (k) m, of CONTACT_BOX mu_2 / mu_1 [-]; >= 0
    const double* b             # (m) m/s
    const double* d             # (m) 1/kg, > 0, equal on the two tangents of a contact, and on the two that roll
    const double* nu            # (m) 1/kg, > 0: velocity error = sqrt(nu d) |e|
    const double* step          # (m) kg: 1/d, on tangents 1/lambda_max(A_tt), likewise on the two that roll
    const double* rolling       # (k) m, >= 0: mu_r, read on CONTACT_ROLLING alone


cdef inline double clip(double x, double low, double high) noexcept nogil:
    # NaN passes through, so that a lost iterate is seen.
    return low if x < low else (high if x > high else x)


cdef inline double norm2(double x, double y) noexcept nogil:
    return sqrt(x * x + y * y)


cdef inline double mu_r(const blocks_t* p, int32_t i) noexcept nogil:
    return p.rolling[i] if p.kind[i] == CONTACT_ROLLING else 0.0


cdef inline bint has_friction(const blocks_t* p) noexcept nogil:
    """A block whose bounds depend on its own normal: else both laws are the same."""
    cdef int32_t i
    for i in range(p.n_blocks):
        if p.kind[i] != ROW and p.ptr[i + 1] - p.ptr[i] > 1 and (p.mu[i] > 0.0 or mu_r(p, i) > 0.0):
            return True
    return False


cdef inline int32_t ends_apart(int32_t kind) noexcept nogil:
    """Has the last row of a contact a bound of its own, mu r lam_n: the spin, the second side of a box?"""
    return kind == CONTACT_SPIN or kind == CONTACT_BOX


cdef inline int32_t n_tangents(int32_t kind, int32_t size) noexcept nogil:
    # that mu lam_n bounds together: CONTACT and ROUND are odd; rows with a bound of their own are left out
    return 2 if kind == CONTACT_ROLLING else size - 2 + (kind & 1)


cdef inline int32_t n_directions(int32_t kind, int32_t size) noexcept nogil:
    """Tangent rows, as directions in space."""
    return size - 1 - n_turns(kind, size)


cdef inline int32_t n_apart(int32_t kind, int32_t size) noexcept nogil:
    """Rows behind those that mu lam_n bounds together, as bits: 1 on mu r lam_n (`ends_apart`), 2 for two on mu_r lam_n."""
    return size - 3 if kind == CONTACT_ROLLING else ends_apart(kind)


cdef inline int32_t n_turns(int32_t kind, int32_t size) noexcept nogil:
    """Rows of a contact behind its tangents, as bits and as their number: 1 spins, 2 roll, 3 is one that spins and two."""
    return 1 if kind == CONTACT_SPIN else size - 3 if kind == CONTACT_ROLLING else 0


cdef inline int32_t roll_at(int32_t kind, int32_t size) noexcept nogil:
    # Offset of the two rows that roll; -2 without them.
    return size - 2 if kind == CONTACT_ROLLING or kind == ROUND and size == 6 else -2


cdef inline bint is_pair(int32_t nt, int32_t roll, int32_t offset) noexcept nogil:
    # Do the rows at this offset in a contact and behind it count by their norm? The two that slide, the two that roll.
    return offset == 1 and nt >= 2 or offset == roll


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


cdef inline void coulomb_error(const double* lam, const double* w, const double* d, double mu,
                               double patch_radius, double rolling, int32_t nt, int32_t turns, double* e) noexcept nogil:
    # (6): one contact of 1 + nt + turns rows.
    cdef double normal = lam[0] if lam[0] > 0.0 else 0.0, bound = mu * normal, inf = 1.0 / 0.0
    cdef int32_t k = 1 + nt + (turns & 1)
    e[0] = row_error(lam[0], w[0], d[0], 0.0, inf)
    if nt > 0:
        tangent_error(lam + 1, w + 1, d[1], bound, nt, e + 1)
    if turns & 1:
        e[1 + nt] = row_error(lam[1 + nt], w[1 + nt], d[1 + nt], -bound * patch_radius, bound * patch_radius)
    if turns & 2:
        tangent_error(lam + k, w + k, d[k], rolling * normal, 2, e + k)


cdef inline double weighed(double lam, double w, double d, double r) noexcept nogil:
    # sqrt(d) (lam - w / d), r = sqrt(d)
    return r * (lam - w / d)


cdef inline double share(double bound, double size) noexcept nogil:
    # of what is longer than its bound; dust may have no size
    return bound / size if size > 0.0 else 0.0


cdef inline double rolling_section(const double* a, const double* t, double yn, double* bound) noexcept nogil:
    """s of (7) and a_g s in bound (3) for three parts, |y_g| = t_g <= a_g s each; a_g = 0 where one is not there.

    The largest of the eight candidates (y_n + sum a_g t_g) / (1 + sum a_g^2) over subsets, as before, each over the widest
    part in it.
    """
    cdef double s = yn if yn > 0.0 else 0.0, up, down, f, most
    cdef int32_t g, subset
    for subset in range(1, 8):
        most = 1.0
        for g in range(3):
            if subset >> g & 1 and a[g] > most:
                most = a[g]
        up = yn / most
        down = 1.0 / most / most
        for g in range(3):
            if subset >> g & 1:
                f = a[g] / most
                up += f * t[g]
                down += f * f
        up = up / down
        if up / most > s:
            s = up / most
    for g in range(3):
        bound[g] = a[g] * s
    return s


cdef inline void project_rolling(const double* lam, const double* w, const double* d, double mu, double patch_radius,
                                 double rolling, int32_t turns, double* e) noexcept nogil:
    # (7) of a normal, two tangents, perhaps spin, and two that roll: parts g of one or two rows, each with one d
    cdef double t[3]
    cdef double a[3]
    cdef double bound[3]
    cdef double y[6]
    cdef double rn = sqrt(d[0]), yn = weighed(lam[0], w[0], d[0], rn), s, r
    cdef int32_t g, i, k = 3 + (turns & 1), j, n
    t[1] = a[1] = 0.0
    for g in range(3):
        if g == 1 and not turns & 1:
            continue
        j = 1 if g == 0 else 3 if g == 1 else k
        n = 1 if g == 1 else 2
        r = sqrt(d[j])
        a[g] = (rolling if g == 2 else mu) * (r * (patch_radius if g == 1 else 1.0)) / rn
        t[g] = 0.0
        for i in range(j, j + n):
            y[i] = weighed(lam[i], w[i], d[i], r)
            t[g] = norm2(t[g], y[i])
    s = rolling_section(a, t, yn, bound)
    e[0] = w[0] / d[0] if s == yn else lam[0] - s / rn
    for g in range(3):
        if g == 1 and not turns & 1:
            continue
        j = 1 if g == 0 else 3 if g == 1 else k
        n = 1 if g == 1 else 2
        for i in range(j, j + n):
            if t[g] > bound[g]:
                e[i] = lam[i] - share(bound[g], t[g] * sqrt(d[i])) * y[i]
            else:
                e[i] = w[i] / d[i]
    if not (yn == yn and t[0] == t[0] and t[1] == t[1] and t[2] == t[2]):
        e[0] = yn + t[0] + t[1] + t[2]                  # NaN: comparisons above would hide it


cdef inline void project_error(const double* lam, const double* w, const double* d, double mu,
                               double patch_radius, int32_t nt, int32_t spin, double* e) noexcept nogil:
    # (7): the projection on {|y_t| <= a_t y_n, |y_s| <= a_s y_n} after y = sqrt(d) (lam - w / d). The
    # largest of the four candidates for s is the projection's normal part: three pieces of one
    # convex piecewise quadratic in s.
    cdef double rn = sqrt(d[0]), rt = 1.0, rs = 1.0, at = 0.0, as_ = 0.0
    cdef double yn, y0 = 0.0, y1 = 0.0, ys = 0.0, t = 0.0, s, c, f, bound_t, bound_s
    cdef int32_t i, js = 1 + nt
    yn = weighed(lam[0], w[0], d[0], rn)
    if nt > 0:
        rt = sqrt(d[1])
        at = mu * rt / rn
        y0 = weighed(lam[1], w[1], d[1], rt)
        if nt == 2:
            y1 = weighed(lam[2], w[2], d[2], rt)
        t = norm2(y0, y1)
    if spin:
        rs = sqrt(d[js])
        as_ = mu * patch_radius * rs / rn
        ys = weighed(lam[js], w[js], d[js], rs)
    s = yn if yn > 0.0 else 0.0
    c = (yn + at * t) / (1.0 + at * at)
    if c > s:
        s = c
    c = (yn + as_ * fabs(ys)) / (1.0 + as_ * as_)
    if c > s:
        s = c
    c = (yn + at * t + as_ * fabs(ys)) / (1.0 + at * at + as_ * as_)
    if c > s:
        s = c
    bound_t = at * s
    bound_s = as_ * s
    # e = lam - Pi: w / d where the projection moves nothing.
    e[0] = w[0] / d[0] if s == yn else lam[0] - s / rn
    if nt > 0:
        if t > bound_t:
            f = share(bound_t, t * rt)
            e[1] = lam[1] - f * y0
            if nt == 2:
                e[2] = lam[2] - f * y1
        else:
            for i in range(1, 1 + nt):
                e[i] = w[i] / d[i]
    if spin:
        if ys > bound_s:
            e[js] = lam[js] - bound_s / rs
        elif ys < -bound_s:
            e[js] = lam[js] + bound_s / rs
        else:
            e[js] = w[js] / d[js]
    if not (yn == yn and t == t and ys == ys):
        e[0] = yn + t + ys                              # NaN: comparisons above would hide it


cdef inline void cone_error(const double* lam, const double* w, const double* d, double mu, double patch_radius,
                            double rolling, int32_t nt, int32_t turns, double* e) noexcept nogil:
    if turns & 2:
        project_rolling(lam, w, d, mu, patch_radius, rolling, turns, e)
    else:
        project_error(lam, w, d, mu, patch_radius, nt, turns, e)


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


cdef inline void contact_error(int32_t law, const double* lam, const double* w, const double* d, double mu,
                               double patch_radius, double rolling, int32_t nt, int32_t turns, double* e) noexcept nogil:
    """Error of one contact of 1 + nt + turns rows under its law: where the judge tells laws apart."""
    if law == CONE:
        cone_error(lam, w, d, mu, patch_radius, rolling, nt, turns, e)
    else:
        coulomb_error(lam, w, d, mu, patch_radius, rolling, nt, turns, e)


cdef inline void block_error(const blocks_t* p, int32_t i, const double* lam, const double* w,
                             double* e) noexcept nogil:
    """Error e of block i [N s]; lam, w, e are whole vectors (m)."""
    cdef int32_t j = p.ptr[i], end = p.ptr[i + 1], kind = p.kind[i], nt
    if kind == ROW:
        while j < end:
            e[j] = row_error(lam[j], w[j], p.d[j], p.lower[j], p.upper[j])
            j += 1
        return
    nt = n_tangents(kind, end - j)
    if kind == ROUND:
        round_error(lam + j, w + j, p.d + j, p.mu[i], nt, e + j)
    else:
        contact_error(p.law, lam + j, w + j, p.d + j, p.mu[i], p.patch_radius[i], mu_r(p, i), nt,
                      n_apart(kind, end - j), e + j)
