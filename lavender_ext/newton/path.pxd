"""Coulomb's law along a path of smoothed problems, through its folds.

With p(x) = (x + sqrt(x^2 + 4 tau^2)) / 2 for max(0, x), y = z - s, s = (H + eps) z - g, each contact's map is smooth:

    n = p(y_n),   r = a n,   m = r + p(|y_t| - r),   F_n = z_n - n,   F_t = z_t - (r / m) y_t                  (1)

(Chen, Mangasarian 1996; of a frictionless contact it is the central path z s = tau^2), with c tau for tau in m. Its
solutions from a large tau, where there is one, to tau = 0 are a curve in (z, log tau), on which tau may rise for a while:
where contacts that carry load pass from stick to slip, the curve turns back, and what only lowers tau loses it. So it is
followed by its arc length (Keller 1977): with F_z b = -F_tau the tangent t = (b, 1) / |(b, 1)|, a step along t and half
the change of t, then Newton's method on F = 0 across t,

    F_z dz + F_tau dl = -F,   t . (dz, dl) = 0     dz = a + b dl,   F_z a = -F                               (2)

A step is told by what it changes of y_n, |y_t| - r and the direction of y_t, each relative to its size (to tau, where that
is less). Of one factor, simplified Newton steps follow, which must contract (Deuflhard 2011): a point where they do not is
not on the curve, however small a step is. Which c leads to a solution soon nobody knows before: some are tried in turn,
each from the start. eps is a compliance: without it, redundant contacts share their load as tau^2 / z says, which no
factor sees.
"""
from libc.math cimport fabs, floor, sqrt
from libc.stdint cimport int32_t
from libc.string cimport memset

from lavender_ext.core.parts cimport COULOMB
from lavender_ext.newton.cones cimport is_high, is_low
from lavender_ext.newton.elements cimport elements_t, invert_small, is_row
from lavender_ext.newton.phases cimport begin_rounds, enter_rounds
from lavender_ext.newton.run cimport (N_PATH, PATH, done, enter, leave, newton_t, path_t, score, take, with_products)
from lavender_ext.newton.system cimport OF_NATURAL, all_finite, solve_natural, system_factor, system_times


cdef inline double exponential(double x) noexcept nogil:
    """e^x to 1e-15 by a sum, with the same bits on every machine: those of the C library differ."""
    cdef double k, r, term = 1.0, total = 1.0
    cdef int i, _i, n
    if x < -700.0:
        return 0.0
    x = x if x < 700.0 else 700.0
    k = floor(x * 1.4426950408889634 + 0.5)
    n = <int>k
    r = x - k * 0.6931471803691238 - k * 1.9082149292705877e-10  # ln 2 in two parts
    for i in range(1, 16):
        term *= r / i
        total += term
    for _i in range(n):
        total *= 2.0
    for _i in range(-n):
        total *= 0.5
    return total


cdef inline double logarithm(double x) noexcept nogil:
    """ln x to 1e-15, the same: 2 artanh((m - 1) / (m + 1)) of x = m 2^k, |m| near 1; x > 0."""
    cdef double k = 0.0, y, square, term, total = 0.0
    cdef int i, _i
    for _i in range(1100):
        if x > 1.4142135623730951:
            x *= 0.5
            k += 1.0
        elif x < 0.7071067811865476:
            x *= 2.0
            k -= 1.0
        else:
            break
    y = (x - 1.0) / (x + 1.0)
    square, term = y * y, y
    for i in range(12):
        total += term / (2 * i + 1)
        term *= square
    return 2.0 * total + k * 0.6931471805599453


cdef enum:                      # where a path stands
    STARTING = 0                # on its first tau
    STEPPING = 1
    CORRECTING = 2
    REPEATING = 3               # the last point, more exactly
    TRYING = 4                  # whether Newton's method ends it

cdef enum:
    PATHS = 4                   # with a c of their own
    FIRST_STEPS = 40            # factorisations on the first tau
    CORRECTIONS = 5             # factors of one point
    SIMPLIFIED = 4              # steps with one factor
    REPEATED = 4                # factors that make a point exact
    SHORTER = 3                 # times that a step is shortened before that
    RETURNS = 3                 # to an earlier point, with points ten times as exact
    APART = 10                  # steps between two such points
    ENDING = 4                  # Newton steps of a trial


cdef inline double wide_of(int32_t k) noexcept nogil:
    """c of the k-th path."""
    return 3.0 if k < 1 else 10.0 if k < 2 else 1.0 if k < 3 else 0.3  # not ==, of which compilers make a table


cdef inline int32_t steps_of(int32_t k) noexcept nogil:
    """Factorisations of the k-th path at most."""
    return 350 if k < 1 else 250 if k < 2 else 500 if k < 3 else 400


cdef inline double path_compliance() noexcept nogil:
    return 1e-9


cdef inline double plus(double x, double tau) noexcept nogil:
    """p(x), exact for x < 0 as well."""
    cdef double root = sqrt(x * x + 4.0 * tau * tau)
    return 0.5 * (x + root) if x > 0.0 else 2.0 * tau * tau / (root - x)


cdef inline double slope(double x, double tau) noexcept nogil:
    """p'(x); p'(-x) = 1 - p'(x)."""
    return plus(x, tau) / sqrt(x * x + 4.0 * tau * tau)


cdef inline double rise(double x, double tau) noexcept nogil:
    """dp / d log tau"""
    return 2.0 * tau * tau / sqrt(x * x + 4.0 * tau * tau)


cdef inline double smooth_row(const elements_t* e, int32_t j, double z, double s, double tau, double* p, double* rest,
                              double* ft) noexcept nogil:
    """F, P, 1 - P and dF / d log tau of a bounded row."""
    cdef double y = z - s, f = s, x
    p[0], rest[0], ft[0] = 1.0, 0.0, 0.0
    if is_low(e, j):
        x = y - e.lower[j]
        f = s - plus(-x, tau) if x > 0.0 else z - e.lower[j] - plus(x, tau)
        p[0], rest[0], ft[0] = slope(x, tau), slope(-x, tau), -rise(x, tau)
    if is_high(e, j):
        x = e.upper[j] - y
        f = f + plus(-x, tau) if x > 0.0 else f - x + plus(x, tau)
        p[0] -= slope(-x, tau)
        rest[0] += slope(-x, tau)
        ft[0] += rise(x, tau)
    return f


cdef inline void smooth_contact(const elements_t* e, int32_t i, const double* z, const double* s, double tau, double wide,
                                double* f, double* p, double* rest, double* ft) noexcept nogil:
    """(1) of one contact, P (nr, nr), I - P without cancellation, and dF / d log tau."""
    cdef int32_t nr = e.ptr[i + 1] - e.ptr[i], first, n, k, l, g
    cdef double y = z[0] - s[0], normal = plus(y, tau), dn = slope(y, tau), a, r, q, d, root, more, m, fr, across, along, x, own
    memset(p, 0, nr * nr * sizeof(double))
    memset(rest, 0, nr * nr * sizeof(double))
    f[0] = s[0] - plus(-y, tau) if y > 0.0 else z[0] - normal
    p[0], rest[0], ft[0] = dn, slope(-y, tau), -rise(y, tau)
    for g in range(e.part[i], e.part[i + 1]):
        n = e.size[g]
        first = e.first[g] - e.ptr[i]
        a = e.reach[g]
        r, q = a * normal, 0.0
        for k in range(first, first + n):
            q += (z[k] - s[k]) * (z[k] - s[k])
        q = sqrt(q)
        d = r - q
        root = sqrt(d * d + 4.0 * wide * wide)
        more = plus(-d, wide)                            # m - r
        m = r + more
        fr = (more + r * (more / root)) / (m * m)       # d(r / m) / dr
        across = more / m
        along = (m * more + r * q * (more / root)) / (m * m)
        for k in range(first, first + n):
            x = z[k] - s[k]
            f[k] = s[k] + across * x if d > 0.0 else z[k] - r / m * x
            p[k * nr] = x * fr * a * dn
            rest[k * nr] = -p[k * nr]
            ft[k] = -x * (fr * a * rise(y, tau) - r * rise(d, wide) / (m * m))
            for l in range(first, first + n):
                own = x * (z[l] - s[l]) / (q * q) if q > 0.0 else 0.0
                rest[k * nr + l] = (across if k == l else 0.0) + (along - across) * own
                p[k * nr + l] = (1.0 if k == l else 0.0) - rest[k * nr + l]


cdef inline void smooth(newton_t* n, const double* z, double tau, bint derived) noexcept nogil:
    """F of z into n.f, with a compliance eps; with `derived` its small matrices, dF / d log tau (n.c) and y (n.t1)."""
    cdef const elements_t* e = n.s.e
    cdef double eps = path_compliance()
    cdef int32_t i, j, k, l, t, q, nr
    cdef double x
    cdef double p[36]
    cdef double rest[36]
    cdef double ft[6]
    with_products(n, z, n.rest)
    for j in range(e.m):
        n.rest[j] += eps * z[j]
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        q = e.wptr[i]
        if is_row(e, i):
            n.f[j] = smooth_row(e, j, z[j], n.rest[j], tau, p, rest, ft)
        else:
            smooth_contact(e, i, z + j, n.rest + j, tau, n.path.wide * tau, n.f + j, p, rest, ft)
        if not derived:
            continue
        for k in range(nr):
            n.c[j + k] = ft[k]
            n.t1[j + k] = z[j + k] - n.rest[j + k]
            for l in range(nr):
                n.s.p[q + k * nr + l] = p[k * nr + l]
                rest[k * nr + l] += p[k * nr + l] * (e.theta[j + l] + eps)
        invert_small(rest, n.s.einv + q, nr)
        for k in range(nr):
            for l in range(nr):
                x = 0.0
                for t in range(nr):
                    x += n.s.einv[q + k * nr + t] * p[t * nr + l]
                n.s.v[q + k * nr + l] = x


cdef inline double change(newton_t* n, const double* dz, double tau) noexcept nogil:
    """Largest relative change of a distance to the next piece by dz, at the y of the last `smooth`."""
    cdef const elements_t* e = n.s.e
    cdef int32_t i, j, k, first, size, g
    cdef double worst = 0.0, x, y, dy, r, q, along, square, wide = n.path.wide * tau
    cdef double* d = n.hdz
    system_times(&n.s, dz, d)
    for j in range(e.m):
        d[j] = dz[j] - d[j] - path_compliance() * dz[j]
    for i in range(e.n):
        j = e.ptr[i]
        y, dy = n.t1[j], d[j]
        if is_row(e, i):
            if is_low(e, j):
                x = fabs(dy) / (fabs(y - e.lower[j]) + 2.0 * tau)
                worst = worst if x <= worst else x
            if is_high(e, j):
                x = fabs(dy) / (fabs(e.upper[j] - y) + 2.0 * tau)
                worst = worst if x <= worst else x
            continue
        x = fabs(dy) / (fabs(y) + 2.0 * tau)
        worst = worst if x <= worst else x
        for g in range(e.part[i], e.part[i + 1]):
            size = e.size[g]
            first = e.first[g]
            r, q = e.reach[g] * plus(y, tau), 0.0
            along = square = 0.0
            for k in range(first, first + size):
                q += n.t1[k] * n.t1[k]
                along += n.t1[k] * d[k]
                square += d[k] * d[k]
            q = sqrt(q)
            along = along / q if q > 0.0 else 0.0
            x = fabs(e.reach[g] * slope(y, tau) * dy - along) / (fabs(r - q) + 2.0 * wide)
            worst = worst if x <= worst else x
            square -= along * along
            x = (sqrt(square) if square > 0.0 else 0.0) / (q + r + 2.0 * wide)
            worst = worst if x <= worst else x
    return worst


# -- steps -----------------------------------------------------------------------------------------------------


cdef inline double inner(const double* x, const double* y, int32_t m) noexcept nogil:
    cdef int32_t j
    cdef double total = 0.0
    for j in range(m):
        total += x[j] * y[j]
    return total


cdef inline void begin_path(newton_t* n) noexcept nogil:
    """The next, from z = 0, in vectors that interior points and exchanges have left."""
    cdef path_t* x = &n.path
    cdef int32_t m = n.s.e.m
    x.z, x.t, x.old, x.b = n.ip.z, n.ip.u1, n.ip.u2, n.ip.hz
    x.mark[0], x.mark_t[0], x.mark[1], x.mark_t[1] = n.exchange.z, n.exchange.hz, n.exchange.kept, n.ip.everything
    memset(x.z, 0, m * sizeof(double))
    x.size = sqrt(inner(n.s.e.g, n.s.e.g, m) / m)
    x.start = x.l = logarithm(3.0 * x.size)
    x.exact = 3e-3
    x.near = 1e-2
    x.h = 0.5
    x.last = n.s.factorisations + steps_of(x.paths)
    x.wide = wide_of(x.paths)
    x.paths += 1
    x.at = x.points = x.used = x.returns = 0
    if 0.0 < x.size < 1.0 / 0.0:
        enter(n, PATH)


cdef inline bint path_factor(newton_t* n, const double* z, double tau) noexcept nogil:
    """a of (2) into n.dz and b into x.b; False where they are not finite."""
    cdef int32_t j, m = n.s.e.m
    smooth(n, z, tau, True)
    n.counts[N_PATH] += 1
    n.s.law = COULOMB
    system_factor(&n.s, OF_NATURAL, path_compliance())
    solve_natural(&n.s, n.f, n.dz)
    solve_natural(&n.s, n.c, n.path.b)
    for j in range(m):
        n.dz[j] = -n.dz[j]
        n.path.b[j] = -n.path.b[j]
    return all_finite(n.dz, m) and all_finite(n.path.b, m)


cdef inline double across_tangent(newton_t* n) noexcept nogil:
    """dl of (2), with dz = a + b dl in place of a."""
    cdef path_t* x = &n.path
    cdef int32_t j, m = n.s.e.m
    cdef double w = 1.0 / x.square
    cdef double dl = -w * inner(x.t, n.dz, m) / (x.tl + w * inner(x.t, x.b, m))
    for j in range(m):
        n.dz[j] += x.b[j] * dl
    return dl


cdef inline void new_tangent(newton_t* n, bint first) noexcept nogil:
    """Of x.z and the last b, in the direction of the one before."""
    cdef path_t* x = &n.path
    cdef int32_t j, m = n.s.e.m
    cdef double size, turned
    x.square = inner(x.z, x.z, m)
    if not x.square > 0.0:
        x.square = 1.0
    size = 1.0 / sqrt(inner(x.b, x.b, m) / x.square + 1.0)
    turned = -1.0 if first else inner(x.b, x.t, m) / x.square + x.tl
    size = -size if turned < 0.0 else size
    for j in range(m):
        x.t[j] = size * x.b[j]
    x.tl = size


cdef inline void mark(newton_t* n, int32_t k) noexcept nogil:
    cdef path_t* x = &n.path
    take(n, x.mark[k], x.z)
    take(n, x.mark_t[k], x.t)
    x.mark_l[k], x.mark_tl[k], x.mark_h[k], x.mark_square[k] = x.l, x.tl, x.h, x.square


cdef inline void predict(newton_t* n) noexcept nogil:
    """z and l along tangent and curvature, into n.u and x.next."""
    cdef path_t* x = &n.path
    cdef int32_t j
    cdef double c = 0.5 * x.h * x.h / x.before if x.bends else 0.0
    for j in range(n.s.e.m):
        n.u[j] = x.z[j] + x.h * x.t[j] + (c * (x.t[j] - x.old[j]) if x.bends else 0.0)
    x.next = x.l + x.h * x.tl + (c * (x.tl - x.old_l) if x.bends else 0.0)
    x.corrected = 0
    x.found = x.previous = 1.0 / 0.0
    x.at = CORRECTING


cdef inline bint corrected(newton_t* n) noexcept nogil:
    """One factor, and what follows with it; whether n.u is on the curve. Otherwise x.found says how far it was, inf: no more."""
    cdef path_t* x = &n.path
    cdef int32_t j, _, m = n.s.e.m
    cdef double tau = exponential(x.next), dl, found, other
    if not path_factor(n, n.u, tau):
        x.previous = -1.0
        return False
    dl = across_tangent(n)
    found = change(n, n.dz, tau)
    if x.corrected == 0:
        x.found = found
    x.corrected += 1
    if not found < 0.5 * (x.previous if x.previous < 1.0 else 1.0):
        x.previous = -1.0
        return False
    for _ in range(SIMPLIFIED + 1):
        for j in range(m):
            n.u[j] += n.dz[j]
        x.next += dl
        if _ == SIMPLIFIED:
            break
        smooth(n, n.u, exponential(x.next), False)
        solve_natural(&n.s, n.f, n.dz)
        for j in range(m):
            n.dz[j] = -n.dz[j]
        dl = across_tangent(n)
        other = change(n, n.dz, tau)
        if not other < 0.5 * found:
            break
        found = other
        if found < x.exact:
            for j in range(m):
                n.u[j] += n.dz[j]
            x.next += dl
            return True
    x.previous = found if x.corrected < CORRECTIONS else -1.0
    return False


cdef inline void accept(newton_t* n) noexcept nogil:
    """n.u is the next point."""
    cdef path_t* x = &n.path
    cdef double found
    take(n, x.old, x.t)
    x.old_l = x.tl
    x.before, x.bends = x.h, 1
    take(n, x.z, n.u)
    x.l = x.next
    new_tangent(n, False)
    x.points += 1
    found = exponential(logarithm(0.2 / (x.found if x.found > 1e-9 else 1e-9)) / 3.0)
    x.h *= 2.0 if found > 2.0 else 0.5 if found < 0.5 else found
    x.shorter = 0
    x.at = STEPPING
    if x.points % APART == 0:
        take(n, x.mark[0], x.mark[1])
        take(n, x.mark_t[0], x.mark_t[1])
        x.mark_l[0], x.mark_tl[0], x.mark_h[0], x.mark_square[0] = x.mark_l[1], x.mark_tl[1], x.mark_h[1], x.mark_square[1]
        mark(n, 1)
    found = score(n, x.z)
    if found < x.near and not done(n):
        x.near = 0.1 * found
        x.at = TRYING
        begin_rounds(n, 1, x.z, COULOMB, 1e-7, ENDING)
        enter_rounds(n, 1, ENDING)


cdef inline double change_of_tangent(newton_t* n) noexcept nogil:
    """By a step of length 1."""
    cdef path_t* x = &n.path
    smooth(n, x.z, exponential(x.l), True)
    return change(n, x.t, exponential(x.l)) + fabs(x.tl)


cdef inline void go_path(newton_t* n) noexcept nogil:
    """A factorisation; until the judge is content, the path is lost, or it returns."""
    cdef path_t* x = &n.path
    cdef int32_t j, m = n.s.e.m
    cdef double found, tau, dl
    if x.at == TRYING:
        x.at = STEPPING
    if done(n) or n.s.factorisations >= x.last or x.l > x.start + 1.0 or x.l < logarithm(1e-13 * x.size):
        leave(n)
        return
    if x.at == STARTING:
        tau = exponential(x.l)
        x.used += 1
        if x.used > FIRST_STEPS or not path_factor(n, x.z, tau):
            leave(n)
            return
        for j in range(m):
            x.z[j] += n.dz[j]
        if change(n, n.dz, tau) < x.exact:
            new_tangent(n, True)
            mark(n, 0)
            mark(n, 1)
            x.bends = x.shorter = 0
            x.at = STEPPING
        return
    if x.at == REPEATING:
        x.used += 1
        if path_factor(n, x.z, exponential(x.l)):
            dl = across_tangent(n)
            found = change(n, n.dz, exponential(x.l))
            if found < 0.5:
                for j in range(m):
                    x.z[j] += n.dz[j]
                x.l += dl
            if 1e-3 <= found < 0.5 and x.used < REPEATED:
                return
            new_tangent(n, False)
        x.bends = 0
        x.at = STEPPING
    if x.at == STEPPING:
        found = change_of_tangent(n)
        x.h = x.h if x.h < 1.0 / found else 1.0 / found
        x.h = x.h if x.h < 3.0 else 3.0
        predict(n)
        return
    if corrected(n):
        accept(n)
        return
    if x.previous > 0.0:
        return
    x.shorter += 1
    x.h *= 0.6 if x.found <= 1.0 else 0.4
    x.at = STEPPING
    if x.h < 1e-9:
        if x.returns == RETURNS:
            leave(n)
            return
        x.returns += 1                                  # from a mark, more exactly
        x.exact *= 0.1
        take(n, x.z, x.mark[0])
        take(n, x.t, x.mark_t[0])
        x.l, x.tl, x.h, x.square = x.mark_l[0], x.mark_tl[0], x.mark_h[0], x.mark_square[0]
        mark(n, 1)
        x.bends = x.shorter = 0
    elif x.shorter == SHORTER:
        x.used = 0
        x.at = REPEATING
