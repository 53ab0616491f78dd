"""A path of smoothed problems to a solution of Coulomb's law, through its folds.

With p(x) = (x + sqrt(x^2 + 4 tau^2)) / 2 for max(0, x), y = z - s, s = (H + eps) z - g, each contact's map is smooth:

    n = p(y_n),   r = a n,   m = r + p(|y_t| - r),   F_n = z_n - n,   F_t = z_t - (r / m) y_t                  (1)

(Chen, Mangasarian 1996; without friction it is the central path z s = tau^2), with c tau in place of tau in m. The
solutions from a large tau to tau = 0 are a curve in (z, log tau), along which tau may rise for a while. If loaded
contacts pass from stick to slip, the curve turns back, and a method that only lowers tau loses it. The distance of a
contact from another state is measured by coordinates:

    asinh(y_n / 2 tau)   and   asinh((r - |y_t|) / 2 c tau).                                               (2)

The coordinate, or log tau, that changes fastest along the tangent (b, 1), F_z b = -F_tau, is the parameter of the next
step (local parameterisation: Rheinboldt 1986). A contact that slips follows its own coordinate while the curve turns
sharply in z and tau. A step follows the tangent as far as the fastest coordinate may change. Newton's method then keeps
the parameter x,

    F_z dz + F_tau dl = -F,   x'(dz, dl) = 0     dz = a + b dl,   F_z a = -F,   dl = -x'(a, 0) / x'(b, 1)         (3)

and its progress is the change of (2) and of the direction of y_t. On the curve the sign of dl is that of -det F_z
(Allgower, Georg 2003): at a large tau, where tau falls, det F_z > 0. So the direction is known at every point, even at
one that a step has reached by chance.

The compliance eps prevents that redundant contacts share their load as tau^2 / z determines, which no factor can resolve.

    stage        step                                            event                  next stage
    STARTING     Newton's method at the first tau                on the curve           STEPPING
                                                                 does not converge      STARTING at ten times tau
    STEPPING     follow the tangent by h                                                CORRECTING
    CORRECTING   Newton step (3)                                 on the curve           STEPPING, or TRYING
                                                                 diverges, first time   STEPPING with h / 2
                                                                 diverges, second time  REPEATING
    REPEATING    Newton steps on the last point                  exact                  STEPPING
                                                                 diverges               STEPPING from a saved point
    TRYING       damped Newton from a point with a low residual  not solved             STEPPING
"""
from libc.math cimport fabs, floor, sqrt
from libc.stdint cimport int32_t
from libc.string cimport memset

from lavender_ext.core.validate cimport all_finite
from lavender_ext.core.block_types cimport COULOMB
from lavender_ext.factor.linear cimport compute_determinant_sign
from lavender_ext.newton.cones cimport has_lower_bound, has_upper_bound
from lavender_ext.newton.elements cimport elements_t, invert_and_multiply, is_row
from lavender_ext.newton.damped_newton cimport begin_damped_newton, push_damped_newton
from lavender_ext.newton.run cimport (N_PATH, PATH, compute_slack, copy_vector, is_finished, newton_t, path_t,
                                      pop_phase, push_phase, judge_and_keep_best_point)
from lavender_ext.newton.system cimport (NATURAL, SPARSE, solve_natural_map_system, factor_newton_system,
                                         multiply_system_matrix)


cdef inline double compute_exponential(double x) noexcept nogil:
    """Return e^x to 1e-15 by a sum with the same bits on every machine, unlike the C library."""
    cdef double k, r, term = 1.0, total = 1.0
    cdef int i, _i, n
    if x < -700.0:
        return 0.0
    x = x if x < 700.0 else 700.0
    k = floor(x * 1.4426950408889634 + 0.5)
    n = <int>k
    r = x - k * 0.6931471803691238 - k * 1.9082149292705877e-10  # ln 2 in two parts.
    for i in range(1, 16):
        term *= r / i
        total += term
    for _i in range(n):
        total *= 2.0
    for _i in range(-n):
        total *= 0.5
    return total


cdef inline double compute_logarithm(double x) noexcept nogil:
    """Return ln x of x > 0 to 1e-15, with the same bits on every machine: 2 artanh((m - 1) / (m + 1)) for x = m 2^k, m near 1."""
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


cdef enum:                      # stages of a path (table above)
    STARTING = 0
    STEPPING = 1
    CORRECTING = 2
    REPEATING = 3
    TRYING = 4

cdef enum:                      # outcomes of a correction
    DIVERGING = 0
    CONVERGING = 1
    ON_CURVE = 2

cdef enum:
    MAX_PATH_FACTORISATIONS = 600   # Budget of one path; most end within 300.
    PATH_PATIENCE = 100         # Euler steps follow if so many factorisations do not halve the residual; heaps take up to 80.
    MAX_START_STEPS = 15        # Newton steps at one first tau.
    MAX_TAU_RAISES = 3          # The first tau is raised up to this often: contacts of towers carry up to some hundred times g.
    MAX_CORRECTIONS = 4         # Newton steps of one point; if more are needed, the step is halved instead.
    MAX_REPEATED_CORRECTIONS = 4    # Newton steps that correct the last point further.
    HALVINGS_TO_REPEAT = 2      # Halvings of a step before the last point is corrected further.
    STEPS_TO_FULL_TOLERANCE = 6     # Steps after a return to a saved point for which the smaller tolerance applies.
    TRIAL_FACTORISATIONS = 4    # Budget of damped Newton that starts from a point of the path.

cdef enum:                      # coordinates: 4 i + FIRST_COORDINATE is the normal of element i (or a row's lower bound). Its
    LOG_TAU = 0                 # components (or the row's upper bound) follow.
    FIRST_COORDINATE = 1
    COORDINATES_PER_ELEMENT = 4


cdef inline double friction_ratio() noexcept nogil:
    """Return c, tau of friction over tau of normals."""
    return 3.0


cdef inline double curve_tolerance() noexcept nogil:
    """Return the change of (2) by a correction below which a point counts as on the curve."""
    return 0.2


cdef inline double path_compliance() noexcept nogil:
    """Return the first compliance eps of the smoothed path, relative to d. If the path cannot start, eps is divided by ten."""
    return 1e-9


cdef inline double smooth_max(double x, double tau) noexcept nogil:
    """Return p(x) without cancellation for x < 0."""
    cdef double root = sqrt(x * x + 4.0 * tau * tau)
    return 0.5 * (x + root) if x > 0.0 else 2.0 * tau * tau / (root - x)


cdef inline double smooth_max_slope(double x, double tau) noexcept nogil:
    """Return p'(x). It satisfies p'(-x) = 1 - p'(x)."""
    return smooth_max(x, tau) / sqrt(x * x + 4.0 * tau * tau)


cdef inline double smooth_max_log_tau_derivative(double x, double tau) noexcept nogil:
    """Return dp / d log tau."""
    return 2.0 * tau * tau / sqrt(x * x + 4.0 * tau * tau)


cdef struct smooth_t:           # the smoothed map of one element of n rows
    double f[6]                 # F
    double p[36]                # (n, n) P
    double rest[36]             # (n, n) I - P
    double ft[6]                # dF / d log tau


cdef inline void evaluate_smoothed_row_map(const elements_t* e, int32_t j, double z, double s, double tau,
                                           smooth_t* out) noexcept nogil:
    """Compute the smoothed map of a bounded row."""
    cdef double y = z - s, x
    out.f[0], out.p[0], out.rest[0], out.ft[0] = s, 1.0, 0.0, 0.0
    if has_lower_bound(e, j):
        x = y - e.lower[j]
        out.f[0] = s - smooth_max(-x, tau) if x > 0.0 else z - e.lower[j] - smooth_max(x, tau)
        out.p[0], out.rest[0], out.ft[0] = smooth_max_slope(x, tau), smooth_max_slope(-x, tau), \
            -smooth_max_log_tau_derivative(x, tau)
    if has_upper_bound(e, j):
        x = e.upper[j] - y
        out.f[0] = out.f[0] + smooth_max(-x, tau) if x > 0.0 else out.f[0] - x + smooth_max(x, tau)
        out.p[0] -= smooth_max_slope(-x, tau)
        out.rest[0] += smooth_max_slope(-x, tau)
        out.ft[0] += smooth_max_log_tau_derivative(x, tau)


cdef inline void evaluate_smoothed_contact_map(const elements_t* e, int32_t i, const double* z, const double* s, double tau,
                                               double wide, smooth_t* out) noexcept nogil:
    """Compute (1) of one contact and its derivatives, I - P without cancellation; `wide` is c tau."""
    cdef int32_t nr = e.ptr[i + 1] - e.ptr[i], first, n, k, l, g
    cdef double y = z[0] - s[0], normal = smooth_max(y, tau), dn = smooth_max_slope(y, tau)
    cdef double a, r, q, d, root, more, m, fr, across, along, x, own
    memset(out.p, 0, nr * nr * sizeof(double))
    memset(out.rest, 0, nr * nr * sizeof(double))
    # Normal.
    out.f[0] = s[0] - smooth_max(-y, tau) if y > 0.0 else z[0] - normal
    out.p[0], out.rest[0], out.ft[0] = dn, smooth_max_slope(-y, tau), -smooth_max_log_tau_derivative(y, tau)
    # Friction components.
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
        more = smooth_max(-d, wide)                     # m - r
        m = r + more
        fr = (more + r * (more / root)) / (m * m)       # d(r / m) / dr
        across = more / m
        along = (m * more + r * q * (more / root)) / (m * m)
        for k in range(first, first + n):
            x = z[k] - s[k]
            out.f[k] = s[k] + across * x if d > 0.0 else z[k] - r / m * x
            out.p[k * nr] = x * fr * a * dn
            out.rest[k * nr] = -out.p[k * nr]
            out.ft[k] = -x * (fr * a * smooth_max_log_tau_derivative(y, tau) - r * smooth_max_log_tau_derivative(d, wide) / (m * m))
            for l in range(first, first + n):
                own = x * (z[l] - s[l]) / (q * q) if q > 0.0 else 0.0
                out.rest[k * nr + l] = (across if k == l else 0.0) + (along - across) * own
                out.p[k * nr + l] = (1.0 if k == l else 0.0) - out.rest[k * nr + l]


cdef inline void evaluate_smoothed_map(newton_t* n, const double* z, double tau, bint derived) noexcept nogil:
    """Compute F of z into n.f and y into n.t1; with `derived` also the small matrices and dF / d log tau (n.c)."""
    cdef const elements_t* e = n.s.e
    cdef double eps = n.path.eps
    cdef int32_t i, j, k, l, q, nr
    cdef smooth_t own
    compute_slack(n, z, n.slack)
    for j in range(e.m):
        n.slack[j] += eps * z[j]
        n.t1[j] = z[j] - n.slack[j]
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        q = e.wptr[i]
        if is_row(e, i):
            evaluate_smoothed_row_map(e, j, z[j], n.slack[j], tau, &own)
        else:
            evaluate_smoothed_contact_map(e, i, z + j, n.slack + j, tau, friction_ratio() * tau, &own)
        for k in range(nr):
            n.f[j + k] = own.f[k]
        if not derived:
            continue
        for k in range(nr):
            n.c[j + k] = own.ft[k]
            for l in range(nr):
                n.s.p[q + k * nr + l] = own.p[k * nr + l]
                own.rest[k * nr + l] += own.p[k * nr + l] * (e.theta[j + l] + eps)
        invert_and_multiply(own.rest, own.p, n.s.einv + q, n.s.v + q, nr)


cdef inline void compute_change_of_y(newton_t* n, const double* dz, double* dy) noexcept nogil:
    """Compute the change dy = dz - (H + eps) dz (m) of y by a change dz (m)."""
    cdef int32_t j
    multiply_system_matrix(&n.s, dz, dy)
    for j in range(n.s.e.m):
        dy[j] = dz[j] - dy[j] - n.path.eps * dz[j]


cdef inline double compute_coordinate_rate(const newton_t* n, int32_t which, const double* dy, double dl, double tau,
                           double* turned) noexcept nogil:
    """Return the rate of coordinate `which` along (dy, dl) at the last evaluated y; write the rate of y_t's direction."""
    cdef const elements_t* e = n.s.e
    cdef int32_t i = (which - FIRST_COORDINATE) // COORDINATES_PER_ELEMENT
    cdef int32_t part = (which - FIRST_COORDINATE) % COORDINATES_PER_ELEMENT, j, k, first, size
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
        normal, root = smooth_max(y, tau), sqrt(y * y + 4.0 * tau * tau)
        part += e.part[i] - 1
        size, first, a = e.size[part], e.first[part], e.reach[part]
        wide = friction_ratio() * tau
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


cdef inline double find_fastest_coordinate(const newton_t* n, const double* dy, double dl, double tau, int32_t* which,
                           double* turned) noexcept nogil:
    """Return the largest rate of a coordinate along (dy, dl); write this coordinate, and the largest rate of a direction y_t."""
    cdef const elements_t* e = n.s.e
    cdef int32_t i, part
    cdef double worst = fabs(dl), x, turn
    which[0] = LOG_TAU
    turned[0] = 0.0
    for i in range(e.n):
        for part in range(COORDINATES_PER_ELEMENT):
            if is_row(e, i):
                if not (part == 0 and has_lower_bound(e, e.ptr[i]) or part == 1 and has_upper_bound(e, e.ptr[i])):
                    continue
            elif part > e.part[i + 1] - e.part[i]:
                continue
            x = fabs(compute_coordinate_rate(n, COORDINATES_PER_ELEMENT * i + FIRST_COORDINATE + part, dy, dl, tau, &turn))
            turned[0] = turned[0] if turn <= turned[0] else turn
            if not x <= worst:
                worst = x
                which[0] = COORDINATES_PER_ELEMENT * i + FIRST_COORDINATE + part
    return worst


# -- steps -----------------------------------------------------------------------------------------------------


cdef inline void begin_path(newton_t* n) noexcept nogil:
    """Begin the next path from z = 0."""
    cdef path_t* x = &n.path
    cdef int32_t j, m = n.s.e.m
    memset(x.z, 0, m * sizeof(double))
    x.size = 0.0
    for j in range(m):
        x.size += n.s.e.g[j] * n.s.e.g[j]
    x.size = sqrt(x.size / m)
    x.start = x.l = compute_logarithm(0.3 * x.size)
    x.tolerance = curve_tolerance()
    x.eps = path_compliance()
    x.trial_residual = 1e-2
    x.h = 0.3                   # change of the fastest coordinate in the first step
    x.since, x.lowest = n.s.factorisations, 1.0 / 0.0
    x.last = n.s.factorisations + MAX_PATH_FACTORISATIONS
    x.stage = x.factors = x.raises = x.n_saved = x.steps_since_return = x.halvings = 0
    if 0.0 < x.size < 1.0 / 0.0:
        push_phase(n, PATH)


cdef inline bint continue_path(newton_t* n) noexcept nogil:
    """Continue a path that has ended because its residual did not fall; return False if it ended otherwise."""
    cdef path_t* x = &n.path
    cdef int32_t end = x.since + PATH_PATIENCE
    if x.stage != STEPPING or end >= x.last:
        return False
    x.last += n.s.factorisations - end
    x.since = n.s.factorisations
    push_phase(n, PATH)
    return True


cdef inline bint compute_path_directions(newton_t* n, const double* z, double tau) noexcept nogil:
    """Compute a of (3) into n.dz and b into x.b, and their changes of y into n.t2 and n.psi; return whether they are finite."""
    cdef int32_t j, m = n.s.e.m
    evaluate_smoothed_map(n, z, tau, True)
    n.counts[N_PATH] += 1
    n.s.law = COULOMB
    factor_newton_system(&n.s, NATURAL, n.path.eps)
    # The sign of the determinant of (3) is 0 if it is unknown.
    n.path.sign = 0 if n.s.augmented or n.s.form == SPARSE else compute_determinant_sign(n.s.linear)
    solve_natural_map_system(&n.s, n.f, n.dz)
    solve_natural_map_system(&n.s, n.c, n.path.b)
    for j in range(m):
        n.dz[j] = -n.dz[j]
        n.path.b[j] = -n.path.b[j]
    compute_change_of_y(n, n.dz, n.t2)
    compute_change_of_y(n, n.path.b, n.psi)
    return all_finite(n.dz, m) and all_finite(n.path.b, m)


cdef inline double eliminate_parameter_change(newton_t* n, double tau, double* change) noexcept nogil:
    """Return dl of (3) and replace a in n.dz by dz = a + b dl; write the largest change of a coordinate or direction."""
    cdef path_t* x = &n.path
    cdef int32_t j, which
    cdef double turned, dl = 0.0
    if x.parameter != LOG_TAU:
        dl = -compute_coordinate_rate(n, x.parameter, n.t2, 0.0, tau, &turned) / compute_coordinate_rate(n, x.parameter, n.psi,
                                                                                                         1.0, tau, &turned)
    for j in range(n.s.e.m):
        n.dz[j] += x.b[j] * dl
        n.t2[j] += n.psi[j] * dl
    change[0] = find_fastest_coordinate(n, n.t2, dl, tau, &which, &turned)
    change[0] = change[0] if not change[0] < turned else turned
    return dl


cdef inline void add_path_step(newton_t* n, double* z, double* l, double dl) noexcept nogil:
    """Add n.dz to z, and dl to log tau."""
    cdef int32_t j
    for j in range(n.s.e.m):
        z[j] += n.dz[j]
    l[0] += dl


cdef inline void compute_path_tangent(newton_t* n, double tau) noexcept nogil:
    """Compute the tangent from the last b, with the direction that follows from the sign of the determinant.

    If the sign is unknown, the parameter continues in its direction.
    """
    cdef path_t* x = &n.path
    cdef int32_t j
    cdef double turned
    x.tl = -1.0 if x.sign > 0 else 1.0
    if x.sign == 0:
        x.tl = 1.0 if compute_coordinate_rate(n, x.parameter, n.psi, 1.0, tau, &turned) * x.speed > 0.0 else -1.0
    for j in range(n.s.e.m):
        x.t[j] = x.tl * x.b[j]


cdef inline bint return_to_saved_path_point(newton_t* n) noexcept nogil:
    """Return to the newest saved point and remove it; halve its step and divide the tolerance by 10. False if none is saved."""
    cdef path_t* x = &n.path
    cdef double* z = x.saved_z[0]
    cdef double* tangent = x.saved_t[0]
    if x.n_saved == 0:
        return False
    copy_vector(n, x.z, x.saved_z[1])
    copy_vector(n, x.t, x.saved_t[1])
    x.l, x.tl, x.h = x.saved_l[1], x.saved_tl[1], 0.5 * x.saved_h[1]
    x.saved_z[0], x.saved_t[0], x.saved_z[1], x.saved_t[1] = x.saved_z[1], x.saved_t[1], z, tangent
    x.saved_l[1], x.saved_tl[1], x.saved_h[1] = x.saved_l[0], x.saved_tl[0], x.saved_h[0]
    x.n_saved -= 1
    x.tolerance = 0.1 * x.tolerance if 0.1 * x.tolerance > 1e-3 else 1e-3
    x.steps_since_return = x.halvings = 0
    return True


cdef inline void predict_path_point(newton_t* n) noexcept nogil:
    """Scale the tangent by its fastest coordinate and follow it by h, into n.u and x.next."""
    cdef path_t* x = &n.path
    cdef int32_t j
    cdef double fast, turned, ignored, tau = compute_exponential(x.l)
    evaluate_smoothed_map(n, x.z, tau, False)
    compute_change_of_y(n, x.t, n.t2)
    fast = find_fastest_coordinate(n, n.t2, x.tl, tau, &x.parameter, &turned)
    x.speed = compute_coordinate_rate(n, x.parameter, n.t2, x.tl, tau, &ignored)
    fast = fast if not fast < turned else turned
    for j in range(n.s.e.m):
        x.t[j] /= fast
        n.u[j] = x.z[j] + x.h * x.t[j]
    x.tl /= fast
    x.next = x.l + x.h * x.tl
    x.factors = 0
    x.change = 1.0 / 0.0
    x.stage = CORRECTING


cdef inline int32_t correct_path_point(newton_t* n) noexcept nogil:
    """Take a Newton step (3) on n.u; return ON_CURVE, CONVERGING, or DIVERGING if the step from the last point fails."""
    cdef path_t* x = &n.path
    cdef double tau = compute_exponential(x.next), dl, change
    if not compute_path_directions(n, n.u, tau):
        return DIVERGING
    dl = eliminate_parameter_change(n, tau, &change)
    if x.factors == 0:
        x.first_change = change
    x.factors += 1
    if not change < (0.5 * x.change if x.change < 2.0 else 1.0):
        return DIVERGING
    add_path_step(n, n.u, &x.next, dl)
    if change < x.tolerance:
        return ON_CURVE
    x.change = change
    return CONVERGING if x.factors < MAX_CORRECTIONS else DIVERGING


cdef inline void accept_path_point(newton_t* n) noexcept nogil:
    """Make n.u the last point, choose the next step length, and try to end the path by damped Newton."""
    cdef path_t* x = &n.path
    cdef double factor, residual
    cdef double* z = x.saved_z[0]
    cdef double* tangent = x.saved_t[0]
    # Save the last point, to which the path returns if steps fail. Two points are saved; a third one replaces the older.
    x.saved_z[0], x.saved_t[0], x.saved_z[1], x.saved_t[1] = x.saved_z[1], x.saved_t[1], z, tangent
    x.saved_l[0], x.saved_tl[0], x.saved_h[0] = x.saved_l[1], x.saved_tl[1], x.saved_h[1]
    copy_vector(n, x.saved_z[1], x.z)
    copy_vector(n, x.saved_t[1], x.t)
    x.saved_l[1], x.saved_tl[1], x.saved_h[1] = x.l, x.tl, x.h
    x.n_saved = 2 if x.n_saved else 1
    copy_vector(n, x.z, n.u)
    x.l = x.next
    compute_path_tangent(n, compute_exponential(x.l))
    x.halvings = 0
    x.steps_since_return += 1
    if x.steps_since_return > STEPS_TO_FULL_TOLERANCE:
        x.tolerance = curve_tolerance()
    # The first correction should change the coordinates by 0.12; it grows with the third power of h.
    factor = compute_exponential(compute_logarithm(0.12 / (x.first_change if x.first_change > 1e-9 else 1e-9)) / 3.0)
    x.h *= 2.0 if factor > 2.0 else 0.5 if factor < 0.5 else factor
    x.h = x.h if x.h < 1.5 else 1.5
    x.stage = STEPPING
    residual = judge_and_keep_best_point(n, x.z)
    if residual < 0.5 * x.lowest:
        x.lowest, x.since = residual, n.s.factorisations
    if residual < x.trial_residual and not is_finished(n):
        x.trial_residual = 0.1 * residual
        x.stage = TRYING
        begin_damped_newton(n, x.z, COULOMB, 1e-7, TRIAL_FACTORISATIONS)
        push_damped_newton(n, TRIAL_FACTORISATIONS)


cdef inline bint correct_path_point_further(newton_t* n) noexcept nogil:
    """Correct the last point further, and store the result in n.u; return False if that fails."""
    cdef path_t* x = &n.path
    cdef double tau = compute_exponential(x.next), dl, change
    x.factors += 1
    if not compute_path_directions(n, n.u, tau):
        return False
    dl = eliminate_parameter_change(n, tau, &change)
    if not (change < x.change and change <= 1.0):
        return False
    add_path_step(n, n.u, &x.next, dl)
    x.change = change
    if change < 0.02:
        copy_vector(n, x.z, n.u)
        x.l = x.next
        compute_path_tangent(n, compute_exponential(x.l))
        x.stage = STEPPING
    return x.stage == STEPPING or x.factors < MAX_REPEATED_CORRECTIONS


cdef inline void start_path(newton_t* n) noexcept nogil:
    """Take a Newton step at the first tau. If the steps do not converge, raise tau and begin again."""
    cdef path_t* x = &n.path
    cdef double tau = compute_exponential(x.l), change
    x.factors += 1
    x.parameter = LOG_TAU
    x.speed = -1.0
    if x.factors > MAX_START_STEPS or not compute_path_directions(n, x.z, tau):
        x.raises += 1
        if x.raises > MAX_TAU_RAISES:
            pop_phase(n)
        # The lowest contacts of a stack carry a multiple of the load that g suggests, and a compliance acts on them as much more.
        x.l += compute_logarithm(10.0)
        x.eps *= 0.1
        x.start, x.factors = x.l, 0
        memset(x.z, 0, n.s.e.m * sizeof(double))
        return
    eliminate_parameter_change(n, tau, &change)
    add_path_step(n, x.z, &x.l, 0.0)
    if change < x.tolerance:
        compute_path_tangent(n, tau)
        x.stage = STEPPING


cdef inline void step_path(newton_t* n) noexcept nogil:
    """Do one factorisation of the path, until the judge accepts a point or no step succeeds."""
    cdef path_t* x = &n.path
    cdef int32_t outcome
    if x.stage == TRYING:
        x.stage = STEPPING
    if is_finished(n) or n.s.factorisations >= x.last or x.l > x.start + 1.0 or x.l < compute_logarithm(1e-13 * x.size):
        pop_phase(n)
        return
    if x.stage == STARTING:
        start_path(n)
        return
    if x.stage == REPEATING:
        if correct_path_point_further(n):
            return
        if not return_to_saved_path_point(n):
            pop_phase(n)
            return
        x.stage = STEPPING
    if x.stage == STEPPING:
        if n.s.factorisations - x.since > PATH_PATIENCE:
            pop_phase(n)
            return
        predict_path_point(n)
    outcome = correct_path_point(n)
    if outcome == ON_CURVE:
        accept_path_point(n)
    if outcome != DIVERGING:
        return
    # The step fails: halve it; after every second failure correct the last point further.
    x.h *= 0.5
    x.halvings += 1
    x.stage = STEPPING
    if x.halvings % HALVINGS_TO_REPEAT == 0:
        copy_vector(n, n.u, x.z)
        x.next, x.factors, x.change = x.l, 0, 1.0 / 0.0
        x.stage = REPEATING
    elif x.h < 1e-6:
        pop_phase(n)
