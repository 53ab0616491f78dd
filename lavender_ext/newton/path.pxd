"""Coulomb's law along a path of smoothed problems, through its folds.

With p(x) = (x + sqrt(x^2 + 4 tau^2)) / 2 for max(0, x), y = z - s, s = (H + eps) z - g, each contact's map is smooth:

    n = p(y_n),   r = a n,   m = r + p(|y_t| - r),   F_n = z_n - n,   F_t = z_t - (r / m) y_t                  (1)

(Chen, Mangasarian 1996; of a frictionless contact it is the central path z s = tau^2), with c tau for tau in m. Its
solutions from a large tau to tau = 0 are a curve in (z, log tau), on which tau may rise for a while: where contacts that
carry load pass from stick to slip, the curve turns back, and what only lowers tau loses it. How far a contact is from
its next piece is told by coordinates of its own,

    asinh(y_n / 2 tau)   and   asinh((r - |y_t|) / 2 c tau).                                               (2)

Whichever changes fastest along the tangent (b, 1), F_z b = -F_tau, be it log tau itself, is the parameter of the next
step (local parameterisation: Rheinboldt 1986): a contact that slips runs through its own coordinate while the curve turns
sharply in z and tau. A step follows the tangent and half its change, as far as the fastest coordinate may go; Newton's
method then leaves the parameter x as it is,

    F_z dz + F_tau dl = -F,   x'(dz, dl) = 0     dz = a + b dl,   F_z a = -F,   dl = -x'(a, 0) / x'(b, 1)         (3)

and is measured by what it changes of (2) and of the direction of y_t. Of one factor, simplified Newton steps follow, which
must contract (Deuflhard 2011). On the curve the sign of dl is that of -det F_z (Allgower, Georg 2003): at a large tau,
where tau falls, det F_z > 0. So its direction is known at every point, even at one that a step has come to by chance.

Which c leads to a solution soon nobody knows before: some are tried in turn, each from the start. eps is a compliance:
without it, redundant contacts share their load as tau^2 / z says, which no factor sees.
"""
from libc.math cimport fabs, floor, sqrt
from libc.stdint cimport int32_t
from libc.string cimport memset

from lavender_ext.core.validate cimport all_finite
from lavender_ext.core.block_types cimport COULOMB
from lavender_ext.newton.cones cimport is_high, is_low
from lavender_ext.newton.elements cimport elements_t, invert_small, is_row
from lavender_ext.newton.phases cimport begin_rounds, enter_rounds
from lavender_ext.newton.run cimport (N_PATH, PATH, done, enter, leave, newton_t, path_t, score, take, with_products)
from lavender_ext.newton.system cimport OF_NATURAL, solve_natural, system_factor, system_sign, system_times


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
    PATHS = 3                   # with a c of their own
    STEPS = 600                 # factorisations of one at most
    FIRST_STEPS = 15            # on the first tau,
    RAISES = 3                  # which is so often raised where they do not end
    CORRECTIONS = 4             # factors of one point
    SIMPLIFIED = 3              # steps with one factor
    REPEATED = 4                # factors that make a point exact
    SHORTER = 2                 # times that a step is halved before that
    CLEAN = 6                   # steps after which points may be as inexact as before a return
    ENDING = 4                  # Newton steps of a trial

cdef enum:                      # coordinates: 4 i + FIRST of element i (a contact's normal, a row's lower bound), then its cones
    LOG_TAU = 0                 # (a row's upper bound)
    FIRST = 1
    OF_ONE = 4


cdef inline double wide_of(int32_t k) noexcept nogil:
    """c of the k-th path."""
    return 3.0 if k < 1 else 1.0 if k < 2 else 10.0     # not ==, of which compilers make a table


cdef inline double exact_of() noexcept nogil:
    """Change of (2) by what is left of a correction, below which a point counts as one of the curve."""
    return 0.2


cdef inline double path_compliance() noexcept nogil:
    """eps, where z is of the size of g."""
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
    """F of z into n.f and y into n.t1, with a compliance eps; with `derived` small matrices and dF / d log tau (n.c)."""
    cdef const elements_t* e = n.s.e
    cdef double eps = n.path.eps
    cdef int32_t i, j, k, l, t, q, nr
    cdef double x
    cdef double p[36]
    cdef double rest[36]
    cdef double ft[6]
    with_products(n, z, n.rest)
    for j in range(e.m):
        n.rest[j] += eps * z[j]
        n.t1[j] = z[j] - n.rest[j]
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


cdef inline void change_of_y(newton_t* n, const double* dz, double* dy) noexcept nogil:
    """dy = dz - (H + eps) dz."""
    cdef int32_t j
    system_times(&n.s, dz, dy)
    for j in range(n.s.e.m):
        dy[j] = dz[j] - dy[j] - n.path.eps * dz[j]


cdef inline double rate_of(const newton_t* n, int32_t which, const double* dy, double dl, double tau,
                           double* turned) noexcept nogil:
    """What (dy, dl) changes of a coordinate at the y of the last `smooth`, and of the direction of y_t beside it."""
    cdef const elements_t* e = n.s.e
    cdef int32_t i = (which - FIRST) // OF_ONE, part = (which - FIRST) % OF_ONE, j, k, first, size
    cdef double x, dx, y, normal, root, r, q, along, square, a, wide = tau
    turned[0] = 0.0
    if which == LOG_TAU:
        return dl
    j = e.ptr[i]
    if is_row(e, i):
        x = n.t1[j] - e.lower[j] if part == 0 else e.upper[j] - n.t1[j]
        dx = dy[j] if part == 0 else -dy[j]
    elif part == 0:
        x, dx = n.t1[j], dy[j]
    else:
        y = n.t1[j]
        normal, root = plus(y, tau), sqrt(y * y + 4.0 * tau * tau)
        part += e.part[i] - 1
        size, first, a = e.size[part], e.first[part], e.reach[part]
        wide = n.path.wide * tau
        r, q = a * normal, 0.0
        along = square = 0.0
        for k in range(first, first + size):
            q += n.t1[k] * n.t1[k]
            along += n.t1[k] * dy[k]
            square += dy[k] * dy[k]
        q = sqrt(q)
        along = along / q if q > 0.0 else 0.0
        x = r - q
        dx = a * (normal * dy[j] + 2.0 * tau * tau * dl) / root - along
        square -= along * along
        turned[0] = (sqrt(square) if square > 0.0 else 0.0) / (q + r + 2.0 * wide)
    return (dx - x * dl) / sqrt(x * x + 4.0 * wide * wide)


cdef inline double fastest(const newton_t* n, const double* dy, double dl, double tau, int32_t* which,
                           double* turned) noexcept nogil:
    """The largest rate of a coordinate, and which it is; the largest of a direction."""
    cdef const elements_t* e = n.s.e
    cdef int32_t i, part
    cdef double worst = fabs(dl), x, turn
    which[0] = LOG_TAU
    turned[0] = 0.0
    for i in range(e.n):
        for part in range(OF_ONE):
            if is_row(e, i):
                if not (part == 0 and is_low(e, e.ptr[i]) or part == 1 and is_high(e, e.ptr[i])):
                    continue
            elif part > e.part[i + 1] - e.part[i]:
                continue
            x = fabs(rate_of(n, OF_ONE * i + FIRST + part, dy, dl, tau, &turn))
            turned[0] = turned[0] if turn <= turned[0] else turn
            if not x <= worst:
                worst = x
                which[0] = OF_ONE * i + FIRST + part
    return worst


cdef inline double change(const newton_t* n, const double* dy, double dl, double tau) noexcept nogil:
    """Largest change of a coordinate or direction by (dy, dl)."""
    cdef int32_t which
    cdef double turned, worst = fastest(n, dy, dl, tau, &which, &turned)
    return worst if not worst < turned else turned


# -- steps -----------------------------------------------------------------------------------------------------


cdef inline void begin_path(newton_t* n) noexcept nogil:
    """The next, from z = 0, in vectors that interior points and exchanges have left."""
    cdef path_t* x = &n.path
    cdef int32_t j, m = n.s.e.m
    x.z, x.t, x.old, x.b = n.ip.z, n.ip.u1, n.ip.u2, n.ip.hz
    x.mark[0], x.mark_t[0], x.mark[1], x.mark_t[1] = n.exchange.z, n.exchange.hz, n.exchange.kept, n.ip.everything
    memset(x.z, 0, m * sizeof(double))
    x.size = 0.0
    for j in range(m):
        x.size += n.s.e.g[j] * n.s.e.g[j]
    x.size = sqrt(x.size / m)
    x.start = x.l = logarithm(0.3 * x.size)
    x.exact = exact_of()
    x.eps = path_compliance()
    x.near = 1e-2
    x.h = 0.3
    x.last = n.s.factorisations + STEPS
    x.wide = wide_of(x.paths)
    x.paths += 1
    x.at = x.used = x.raised = x.marks = x.clean = x.bends = x.shorter = 0
    if 0.0 < x.size < 1.0 / 0.0:
        enter(n, PATH)


cdef inline bint path_factor(newton_t* n, const double* z, double tau) noexcept nogil:
    """a of (3) into n.dz and b into x.b, what they change of y into n.t2 and n.psi; False where they are not finite."""
    cdef int32_t j, m = n.s.e.m
    smooth(n, z, tau, True)
    n.counts[N_PATH] += 1
    n.s.law = COULOMB
    system_factor(&n.s, OF_NATURAL, n.path.eps)
    n.path.sign = system_sign(&n.s)
    solve_natural(&n.s, n.f, n.dz)
    solve_natural(&n.s, n.c, n.path.b)
    for j in range(m):
        n.dz[j] = -n.dz[j]
        n.path.b[j] = -n.path.b[j]
    change_of_y(n, n.dz, n.t2)
    change_of_y(n, n.path.b, n.psi)
    return all_finite(n.dz, m) and all_finite(n.path.b, m)


cdef inline double along_curve(newton_t* n, double tau, double* found) noexcept nogil:
    """dl of (3), with dz = a + b dl in place of a; how much that changes."""
    cdef path_t* x = &n.path
    cdef int32_t j
    cdef double turned, dl = 0.0
    if x.which != LOG_TAU:
        dl = -rate_of(n, x.which, n.t2, 0.0, tau, &turned) / rate_of(n, x.which, n.psi, 1.0, tau, &turned)
    for j in range(n.s.e.m):
        n.dz[j] += x.b[j] * dl
        n.t2[j] += n.psi[j] * dl
    found[0] = change(n, n.t2, dl, tau)
    return dl


cdef inline void advance(newton_t* n, double* z, double* l, double dl) noexcept nogil:
    cdef int32_t j
    for j in range(n.s.e.m):
        z[j] += n.dz[j]
    l[0] += dl


cdef inline void new_tangent(newton_t* n, double tau) noexcept nogil:
    """The direction of the last b: by the sign of the determinant, or, where that is unknown, on through the parameter."""
    cdef path_t* x = &n.path
    cdef int32_t j
    cdef double turned
    x.tl = -1.0 if x.sign > 0 else 1.0
    if x.sign == 0:
        x.tl = 1.0 if rate_of(n, x.which, n.psi, 1.0, tau, &turned) * x.speed > 0.0 else -1.0
    for j in range(n.s.e.m):
        x.t[j] = x.tl * x.b[j]


cdef inline void mark(newton_t* n) noexcept nogil:
    """The last point, to which steps that fail may return."""
    cdef path_t* x = &n.path
    cdef double* place = x.mark[0]
    cdef double* tangent = x.mark_t[0]
    x.mark[0], x.mark_t[0], x.mark[1], x.mark_t[1] = x.mark[1], x.mark_t[1], place, tangent
    x.mark_l[0], x.mark_tl[0], x.mark_h[0] = x.mark_l[1], x.mark_tl[1], x.mark_h[1]
    take(n, x.mark[1], x.z)
    take(n, x.mark_t[1], x.t)
    x.mark_l[1], x.mark_tl[1], x.mark_h[1] = x.l, x.tl, x.h
    x.marks = 2 if x.marks else 1


cdef inline bint go_back(newton_t* n) noexcept nogil:
    """To the point before, with a shorter step and more exactly; False where there is none."""
    cdef path_t* x = &n.path
    cdef double* place = x.mark[0]
    cdef double* tangent = x.mark_t[0]
    if x.marks == 0:
        return False
    take(n, x.z, x.mark[1])
    take(n, x.t, x.mark_t[1])
    x.l, x.tl, x.h = x.mark_l[1], x.mark_tl[1], 0.5 * x.mark_h[1]
    x.mark[0], x.mark_t[0], x.mark[1], x.mark_t[1] = x.mark[1], x.mark_t[1], place, tangent
    x.mark_l[1], x.mark_tl[1], x.mark_h[1] = x.mark_l[0], x.mark_tl[0], x.mark_h[0]
    x.marks -= 1
    x.exact = 0.1 * x.exact if 0.1 * x.exact > 1e-3 else 1e-3
    x.bends = x.clean = x.shorter = 0
    return True


cdef inline void predict(newton_t* n) noexcept nogil:
    """The tangent by its fastest coordinate, then z and l along tangent and curvature, into n.u and x.next."""
    cdef path_t* x = &n.path
    cdef int32_t j
    cdef double c, fast, turned, tau = exponential(x.l)
    smooth(n, x.z, tau, False)
    change_of_y(n, x.t, n.t2)
    fast = fastest(n, n.t2, x.tl, tau, &x.which, &turned)
    x.speed = rate_of(n, x.which, n.t2, x.tl, tau, &c)
    fast = fast if not fast < turned else turned
    c = 0.5 * x.h * x.h / x.before if x.bends else 0.0
    for j in range(n.s.e.m):
        x.t[j] /= fast
        n.u[j] = x.z[j] + x.h * x.t[j] + (c * (x.t[j] - x.old[j]) if x.bends else 0.0)
    x.tl /= fast
    x.next = x.l + x.h * x.tl + (c * (x.tl - x.old_l) if x.bends else 0.0)
    x.used = 0
    x.found = x.previous = 1.0 / 0.0
    x.at = CORRECTING


cdef inline bint corrected(newton_t* n) noexcept nogil:
    """One factor, and what follows with it; whether n.u is on the curve. Otherwise x.previous < 0: it leads nowhere."""
    cdef path_t* x = &n.path
    cdef int32_t j, k, m = n.s.e.m
    cdef double tau = exponential(x.next), dl, found, other, contraction = 0.5
    if not path_factor(n, n.u, tau):
        x.previous = -1.0
        return False
    dl = along_curve(n, tau, &found)
    if x.used == 0:
        x.found = found
    x.used += 1
    if not found < (0.5 * x.previous if x.previous < 2.0 else 1.0):
        x.previous = -1.0
        return False
    for k in range(SIMPLIFIED + 1):
        advance(n, n.u, &x.next, dl)
        if found * contraction < x.exact * (1.0 - contraction):
            return True
        if k == SIMPLIFIED:
            break
        tau = exponential(x.next)
        smooth(n, n.u, tau, False)
        solve_natural(&n.s, n.f, n.dz)
        for j in range(m):
            n.dz[j] = -n.dz[j]
        change_of_y(n, n.dz, n.t2)
        dl = along_curve(n, tau, &other)
        contraction = other / found
        if not contraction < 0.5:
            break
        found = other
    x.previous = found if x.used < CORRECTIONS else -1.0
    return False


cdef inline void accept(newton_t* n) noexcept nogil:
    """n.u is the next point."""
    cdef path_t* x = &n.path
    cdef double found = x.tl
    mark(n)
    take(n, x.old, x.t)
    x.old_l, x.before = x.tl, x.h
    take(n, x.z, n.u)
    x.l = x.next
    new_tangent(n, exponential(x.l))
    x.bends = found * x.tl > 0.0                        # not around a fold
    x.shorter = 0
    x.clean += 1
    if x.clean > CLEAN:
        x.exact = exact_of()
    found = exponential(logarithm(0.12 / (x.found if x.found > 1e-9 else 1e-9)) / 3.0)
    x.h *= 2.0 if found > 2.0 else 0.5 if found < 0.5 else found
    x.h = x.h if x.h < 1.5 else 1.5
    x.at = STEPPING
    found = score(n, x.z)
    if found < x.near and not done(n):
        x.near = 0.1 * found
        x.at = TRYING
        begin_rounds(n, 1, x.z, COULOMB, 1e-7, ENDING)
        enter_rounds(n, 1, ENDING)


cdef inline bint repeated(newton_t* n) noexcept nogil:
    """A Newton step on the last point, in n.u; False where it leads nowhere."""
    cdef path_t* x = &n.path
    cdef double tau = exponential(x.next), dl, found
    x.used += 1
    if not path_factor(n, n.u, tau):
        return False
    dl = along_curve(n, tau, &found)
    if not (found < x.previous and found <= 1.0):
        return False
    advance(n, n.u, &x.next, dl)
    x.previous = found
    if found < 0.02:
        take(n, x.z, n.u)
        x.l = x.next
        new_tangent(n, exponential(x.l))
        x.at = STEPPING
    return x.at == STEPPING or x.used < REPEATED


cdef inline void start(newton_t* n) noexcept nogil:
    """A Newton step on the first tau."""
    cdef path_t* x = &n.path
    cdef double tau = exponential(x.l), found
    x.used += 1
    x.which = LOG_TAU
    x.speed = -1.0
    if x.used > FIRST_STEPS or not path_factor(n, x.z, tau):
        x.raised += 1
        if x.raised > RAISES:
            leave(n)
        x.l += logarithm(10.0)                          # stacks carry more than their g says,
        x.eps *= 0.1                                    # and feel a compliance as much more
        x.start, x.used = x.l, 0
        memset(x.z, 0, n.s.e.m * sizeof(double))
        return
    along_curve(n, tau, &found)
    advance(n, x.z, &x.l, 0.0)
    if found < x.exact:
        new_tangent(n, tau)
        x.at = STEPPING


cdef inline void go_path(newton_t* n) noexcept nogil:
    """A factorisation; until the judge is content, the path is lost, or it returns."""
    cdef path_t* x = &n.path
    if x.at == TRYING:
        x.at = STEPPING
    if done(n) or n.s.factorisations >= x.last or x.l > x.start + 1.0 or x.l < logarithm(1e-13 * x.size):
        leave(n)
        return
    if x.at == STARTING:
        start(n)
        return
    if x.at == REPEATING:
        if repeated(n):
            return
        if not go_back(n):
            leave(n)
            return
        x.at = STEPPING
    if x.at == STEPPING:
        predict(n)
    if corrected(n):
        accept(n)
        return
    if x.previous > 0.0:
        return
    x.h *= 0.5
    x.shorter += 1
    x.at = STEPPING
    if x.shorter >= 2:
        x.bends = 0
    if x.shorter % SHORTER == 0:
        take(n, n.u, x.z)
        x.next, x.used, x.previous = x.l, 0, 1.0 / 0.0
        x.at = REPEATING
    elif x.h < 1e-6:
        leave(n)
