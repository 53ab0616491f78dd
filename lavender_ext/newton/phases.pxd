"""What Newton's method consists of, one factorisation at a time: exchanges, interior points, proximal rounds.

    exchanges   F(z) = z - Pi(z - (H z - g)) = 0,   (I - P + P H) dz = -F                                 (1)
    rounds      F_c(z) = z - Pi(z - (H z - g) - alpha (z - c)),   c = z of the last round                (2)

Exchanges solve the rows inside their bounds, rows with the wrong sign change sides, and so on: the primal-dual active
set method (Qi, Sun 1993; Hintermueller, Ito, Kunisch 2002). Where rows depend on each other it may go round in circles:
it is given up where the contraction of the number of rows c_k that change their side promises more steps than an
interior point takes, or c_k stands still,

    k log(c_k) / log(c_0 / c_k)         exchanges left after the k-th                                   (3)

Rounds are the proximal point method (Rockafellar 1976): the inner problem is strongly monotone where H is monotone, and
steps pass a non-monotone line search on |F_c| (Grippo, Lampariello, Lucidi 1986). alpha falls the faster the shorter
the rounds are, and rises where one fails.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t
from libc.string cimport memset

from lavender_ext.core.block_projection cimport active_bound
from lavender_ext.core.validate cimport all_finite, norm_inf
from lavender_ext.core.block_types cimport CONE
from lavender_ext.judge.score cimport relative
from lavender_ext.newton.cones cimport cone_gap, cone_size, gather, is_high, is_low
from lavender_ext.newton.elements cimport elements_t, is_row
from lavender_ext.newton.run cimport (APPROACH, EXCHANGES, INNER, INTERIOR, N_AUGMENTED, N_AUGMENTED_DE_SAXCE,
                                      N_AUGMENTED_INTERIOR, N_DE_SAXCE, N_EXCHANGES, N_INTERIOR, N_ROUNDS, POLISH,
                                      PROXIMAL, PURSUIT, SECOND, at_floor, begin_apart, done, end_apart, enter, exchange_t,
                                      leave, progress_t, newton_t, polish_t, proximal_t, pursuit_t, relative_at, score,
                                      spent, take, with_products)
from lavender_ext.newton.steps cimport interior_step
from lavender_ext.newton.system cimport (OF_BARRIER, OF_NATURAL, solve_natural, solve_refined, system_factor, system_natural,
                                         system_solve, system_t, system_times)


cdef enum:
    EXCHANGE_STEPS = 12         # factorisations of an interior point, as it usually takes
    STILL = 4                   # exchanges in a row after which no fewer rows change than before
    INTERIOR_STEPS = 1000       # of one interior point at most, whatever the budget
    INTERIOR_PATIENCE = 15      # steps that halve neither residual nor gap
    CLOSE_STILL = 3             # steps that do not halve the residual where rounding holds it up
    END = 12                    # factorisations of the rounds that end an interior point of cones
    MEMORY = 6                  # steps that the non-monotone line search looks back
    HALVINGS = 7                # of one step
    REFINED = 3                 # solves of (4) with one factor
    RESTS = 4                   # factors of (4) at most, each with fewer elements
    FREE = 20                   # rounds in a row that cost no factorisation, and so change nothing but the weight
    FIRST = 8                   # factorisations of the first stretch from the start
    STRETCH = 12                # factorisations between two checks of what rounds gain
    STRETCHES = 1000            # of one pursuit at most, whatever its budget
    TRIAL = 2                   # Newton steps of rounds that try to end an interior point of De Saxce's
    APPROACH_STEPS = 60         # of one interior point of De Saxce's or of the augmented system at most
    SHORT_STEPS = 4             # steps in a row that get nowhere before that is given up
    APPROACH_IDLE = 15          # steps in a row that do not halve the residual, likewise
    LIMITLESS = 2147483647


cdef inline double close_to() noexcept nogil:
    """Relative residual from which rounding is what holds an interior point up."""
    return 1e-6


cdef inline double shift_of() noexcept nogil:
    """Of d, on rows of the augmented system: squared singular values below it count as zero."""
    return 1e-14


# -- (1) -------------------------------------------------------------------------------------------------------


cdef inline int32_t sides(const elements_t* e, const double* z, const double* hz, int32_t* side, bint counted) noexcept nogil:
    """The bound that every row rests on by its natural map; how many have changed since, where `counted`."""
    cdef int32_t j, now, changed = 0
    for j in range(e.m):
        now = active_bound(z[j] - hz[j] + e.g[j], e.lower[j], e.upper[j])
        if counted:
            changed += now != side[j]
        else:
            side[j] = now
    return changed


cdef inline void begin_exchanges(newton_t* n, const double* z) noexcept nogil:
    cdef exchange_t* x = &n.exchange
    take(n, x.z, z)
    take(n, x.kept, z)
    system_times(&n.s, x.z, x.hz)
    x.best = relative_at(n, x.z, x.hz)
    x.judged = x.first = x.done = x.still = 0
    x.fewest = LIMITLESS
    enter(n, EXCHANGES)


cdef inline bint exchange_once(newton_t* n) noexcept nogil:
    """One exchange with a weight of 1e-9, which refinement takes away again; False where it is not finite."""
    cdef exchange_t* x = &n.exchange
    cdef int32_t j
    cdef bint finite
    for j in range(n.s.e.m):
        n.rest[j] = x.hz[j] - n.s.e.g[j]
    sides(n.s.e, x.z, x.hz, x.side, False)
    system_natural(&n.s, x.z, n.rest, CONE, 1e-9, n.f)
    system_factor(&n.s, OF_NATURAL, 1e-9)
    for j in range(n.s.e.m):
        n.f[j] = -n.f[j]
    solve_refined(&n.s, n.f, n.dz, n.r, n.da)
    finite = all_finite(n.dz, n.s.e.m)
    if finite:
        for j in range(n.s.e.m):
            x.z[j] += n.dz[j]
        system_times(&n.s, x.z, x.hz)
    return finite


cdef inline bint too_many(int32_t first, int32_t now, int32_t done_) noexcept nogil:
    """Does (3) promise more than an interior point takes?"""
    cdef double a = 1.0, b = 1.0
    cdef int32_t _
    if done_ == 0 or now <= 1:
        return False
    if now >= first:
        return True
    for _ in range(done_):
        a *= now
    for _ in range(EXCHANGE_STEPS):
        b *= <double>first / now
    return a > b


cdef inline void end_exchanges(newton_t* n) noexcept nogil:
    if not n.exchange.judged:
        score(n, n.exchange.kept)
    leave(n)


cdef inline void go_exchange(newton_t* n) noexcept nogil:
    """One exchange of bounded rows, until the judge is content, nothing changes, or (3) promises too little."""
    cdef exchange_t* x = &n.exchange
    cdef double found
    cdef int32_t changed
    cdef bint gains
    if x.best <= n.tol and not x.judged:
        x.judged = 1
        if score(n, x.kept) <= n.tol:
            leave(n)
            return
    if done(n):
        end_exchanges(n)
        return
    n.counts[N_EXCHANGES] += 1
    if not exchange_once(n):
        end_exchanges(n)
        return
    found = relative_at(n, x.z, x.hz)
    gains = found < 0.5 * x.best
    if found < x.best:
        x.best, x.judged = found, 0
        take(n, x.kept, x.z)
    changed = sides(n.s.e, x.z, x.hz, x.side, True)
    x.still = 0 if changed < x.fewest else x.still + 1
    x.fewest = changed if changed < x.fewest else x.fewest
    # The same rows again: what is left of their weight is refined away, as long as that gains.
    if x.best > n.tol and (not gains if changed == 0 else x.still >= STILL or too_many(x.first, changed, x.done)):
        end_exchanges(n)
        return
    if not gains and n.tol < x.best < 1e-5:
        x.judged = 1
        score(n, x.kept)
        if at_floor(n):
            leave(n)
            return
    x.first = x.first if x.first else changed
    x.done += 1


# -- interior points of the convex law ---------------------------------------------------------------------------


cdef inline bint ends(const elements_t* e, int32_t i, const double* y) noexcept nogil:
    """Whether y cannot go on for ever on element i."""
    cdef int32_t g
    cdef double x[4]
    if is_row(e, i):
        return (y[e.ptr[i]] < 0.0 and is_low(e, e.ptr[i])) or (y[e.ptr[i]] > 0.0 and is_high(e, e.ptr[i]))
    for g in range(e.part[i], e.part[i + 1]):
        gather(e, i, g, y, x)
        if cone_gap(x, cone_size(e, g)) < 0.0:
            return True
    return False


cdef inline void rest_on(newton_t* n, int32_t i) noexcept nogil:
    """`direction` changes nothing on element i."""
    cdef int32_t k
    memset(n.direction + n.s.e.ptr[i], 0, (n.s.e.ptr[i + 1] - n.s.e.ptr[i]) * sizeof(double))
    for k in range(n.s.e.wptr[i], n.s.e.wptr[i + 1]):
        n.s.v[k] = 0.0
        if n.s.bt != NULL:
            n.s.bt[k] = 0.0


cdef inline void ask_interior(newton_t* n) noexcept nogil:
    """Without a solution an interior point walks off inside the cones along what H does not see. A proof, if the caller
    finds it one, is the y with H y = 0 next to its z in the metric of the cones,

        y <- y - (H + W)^-1 H y,   W z = u                                                                (4)

    with W of its last step, on elements whose z outgrows its dual u; those that y would lead out of their bounds rest.
    """
    cdef system_t* s = &n.s
    cdef const elements_t* e = s.e
    cdef int32_t i, j, _, resting = 1, left = RESTS
    if not norm_inf(n.ip.hz, e.m) < 1e-3 * norm_inf(n.ip.z, e.m):
        return
    take(n, n.direction, n.ip.z)
    for i in range(e.n):
        j = e.ptr[i]
        if (not fabs(n.ip.z[j]) > fabs(n.ip.u1[j]) or s.v[e.wptr[i]] * 0.0 != 0.0
                or (is_row(e, i) and is_low(e, j) and is_high(e, j))):
            rest_on(n, i)
    while resting and left and not spent(n):
        left -= 1
        system_factor(s, OF_BARRIER, 0.0)
        for _ in range(REFINED):
            system_times(s, n.direction, n.rest)
            system_solve(s, OF_BARRIER, n.rest, n.trial)
            for j in range(e.m):
                n.direction[j] -= n.trial[j]
        resting = 0
        for i in range(e.n):
            if ends(e, i, n.direction):
                rest_on(n, i)
                resting += 1
    n.asked = resting == 0


cdef inline void begin_progress(newton_t* n, double near) noexcept nogil:
    cdef progress_t* k = &n.progress
    k.lowest = 1.0 / 0.0
    k.near = near
    k.idle = k.still = k.steps = k.at = k.augmented = 0
    take(n, k.kept, n.ip.z)


cdef inline void begin_steps(newton_t* n, bint rows) noexcept nogil:
    """Steps from where the interior point stands."""
    begin_progress(n, 1e-2)
    n.progress.rows = rows
    enter(n, INTERIOR)


cdef inline void end_steps(newton_t* n, bint rounds) noexcept nogil:
    """Its best point is judged; cones close to their end are ended by rounds."""
    cdef progress_t* k = &n.progress
    leave(n)
    if k.lowest < n.best:
        score(n, k.kept)
    if rounds and not k.rows and k.lowest < close_to() and not done(n) and not at_floor(n):
        begin_rounds(n, 1, k.kept, CONE, 1e-4 if k.lowest > 1e-4 else k.lowest, INNER)
        enter_rounds(n, 1, END)
    elif not k.rows and k.lowest >= close_to() and not done(n):
        ask_interior(n)


cdef inline void go_interior(newton_t* n) noexcept nogil:
    """A step; bounded rows are exchanged at each new decade."""
    cdef progress_t* k = &n.progress
    cdef double found
    cdef bint gains
    if k.at == 0:
        if k.steps == INTERIOR_STEPS or done(n) or not interior_step(n):
            end_steps(n, True)
            return
        k.steps += 1
        n.counts[N_INTERIOR] += 1
        found = relative(n.ip.energy, n.ip.velocity, n.problem.e0, n.problem.v0)
        gains = found < 0.5 * k.lowest
        k.idle = 0 if gains or n.ip.gap < 0.5 * n.ip.lowest_gap else k.idle + 1
        k.still = 0 if gains else k.still + 1
        if found < k.lowest:
            k.lowest = found
            take(n, k.kept, n.ip.z)
        if found <= n.tol and score(n, n.ip.z) <= n.tol:
            end_steps(n, False)
            return
        if k.rows and found < k.near:
            k.near = 0.1 * found
            k.at = 1
            begin_exchanges(n, n.ip.z)
            return
    else:
        k.at = 0
        if n.best < 1e-6 and 0.1 * n.best < k.near:
            k.near = 0.1 * n.best
        if done(n) or at_floor(n):
            end_steps(n, False)
            return
    if (k.idle > INTERIOR_PATIENCE or (k.still >= CLOSE_STILL and k.lowest < close_to()) or n.ip.length < 1e-6
            or n.ip.gap < 1e-24 * n.ip.first_gap):
        end_steps(n, True)


# -- (2) -------------------------------------------------------------------------------------------------------


cdef inline void begin_rounds(newton_t* n, int32_t which, const double* z, int32_t law, double alpha,
                              int32_t inner) noexcept nogil:
    cdef proximal_t* x = &n.rounds[which]
    take(n, x.z, z)
    x.law, x.alpha, x.inner = law, alpha, inner
    x.slowest = 0.1
    x.failures = x.idle = x.stuck = x.free = 0


cdef inline void enter_rounds(newton_t* n, int32_t which, int32_t limit) noexcept nogil:
    """On from where they stand, for `limit` factorisations."""
    cdef proximal_t* x = &n.rounds[which]
    x.last = n.s.factorisations + limit if limit < LIMITLESS - n.s.factorisations else LIMITLESS
    x.free = x.at = 0
    score(n, x.z)
    enter(n, PROXIMAL + SECOND * which)


cdef inline double size_at(newton_t* n, const proximal_t* x, double t) noexcept nogil:
    """|F_c| at trial = z + t dz."""
    cdef int32_t j
    for j in range(n.s.e.m):
        n.trial[j] = n.u[j] + t * n.dz[j]
        n.rest[j] = n.hz[j] + t * n.hdz[j] - n.s.e.g[j] + x.alpha * (n.trial[j] - n.c[j])
    return system_natural(&n.s, n.trial, n.rest, x.law, 0.0, n.f)


cdef inline bint inner_step(newton_t* n, proximal_t* x) noexcept nogil:
    """One Newton step of a round from z in n.u; False where it ends."""
    cdef system_t* s = &n.s
    cdef int32_t j, k, _, m = s.e.m
    cdef double size, bound = 0.0, value, best = 1.0 / 0.0, at = 1.0, t = 1.0
    if x.n == x.inner:
        return False
    for j in range(m):
        n.rest[j] = n.hz[j] - s.e.g[j] + x.alpha * (n.u[j] - n.c[j])
    size = system_natural(s, n.u, n.rest, x.law, x.alpha, n.f)
    x.history[x.n] = size
    x.n += 1
    if (size <= 0.1 * x.history[0] and x.n > 1) or size == 0.0:
        x.solved = 1
        return False
    if spent(n):
        return False
    system_factor(s, OF_NATURAL, x.alpha)
    for j in range(m):
        n.f[j] = -n.f[j]
    solve_natural(s, n.f, n.dz)
    if not all_finite(n.dz, m):
        return False
    system_times(s, n.dz, n.hdz)
    for k in range(x.n - MEMORY if x.n > MEMORY else 0, x.n):
        bound = x.history[k] if x.history[k] > bound else bound
    for _ in range(HALVINGS):
        value = size_at(n, x, t)
        if value < best:
            best, at = value, t
        if value <= (1.0 - 1e-4 * t) * bound:
            break
        t *= 0.5
    for j in range(m):
        n.u[j] += at * n.dz[j]
        n.hz[j] += at * n.hdz[j]
    return score(n, n.u) > n.tol


cdef inline void adapt(proximal_t* x, int32_t used, bint idle) noexcept nogil:
    cdef double fall
    if x.solved:
        x.failures = 0
        fall = 0.05 if used <= 2 else 0.15 if used <= 4 else 0.4 if used <= 8 else 1.0
        fall = x.slowest if x.slowest > fall else fall
        if used <= 1 and x.slowest <= 0.1:
            fall = 2e-3                 # a single step: the pieces are found, and only alpha is in the way
        x.alpha = x.alpha * fall if x.alpha * fall > 1e-12 else 1e-12       # below, a factorisation sees none
        x.slowest = 0.5 * x.slowest if x.slowest > 0.1 else 0.05
        x.idle = x.idle + 1 if x.alpha == 1e-12 and idle else 0
    else:
        x.failures += 1
        x.slowest = 0.2 if x.slowest < 0.2 else 2.0 * x.slowest if x.slowest < 0.35 else 0.7
        x.alpha *= 5.0
    x.stuck = x.idle > 3 or x.failures > 6 or x.alpha > 10.0


cdef inline bint ask(newton_t* n, const proximal_t* x) noexcept nogil:
    """Without a solution rounds walk off along a direction that H does not see: a proof, if the caller finds it one."""
    cdef int32_t j
    cdef double big
    for j in range(n.s.e.m):
        n.direction[j] = x.z[j] - n.c[j]
    big = norm_inf(n.direction, n.s.e.m)
    if not 0.0 < big < 1.0 / 0.0:
        return False
    for j in range(n.s.e.m):            # rounding leaves rows that do not take part slightly on the wrong side
        n.direction[j] = n.direction[j] / big if fabs(n.direction[j]) > 1e-11 * big else 0.0
    n.asked = 1
    return True


cdef inline void go_rounds(newton_t* n, int32_t which) noexcept nogil:
    """A Newton step of a round, until the judge is content, its factorisations are spent, or nothing moves."""
    cdef proximal_t* x = &n.rounds[which]
    cdef int32_t used
    cdef bint idle
    if x.at == 0:
        if done(n) or x.stuck or n.s.factorisations >= x.last:
            leave(n)
            return
        x.before, x.begun = n.best, n.s.factorisations
        x.n = x.solved = 0
        x.at = 1
        take(n, n.c, x.z)
        take(n, n.u, x.z)
        system_times(&n.s, n.u, n.hz)
    if x.at == 1:
        if inner_step(n, x):
            return
        if x.solved or x.history[x.n - 1] <= x.history[0]:
            take(n, x.z, n.u)
        x.at = 2
        if x.law == CONE and x.solved and n.best > 0.5 * x.before and n.best > 1e-8 and ask(n, x):
            return
    x.at = 0
    if n.proven:
        leave(n)
        return
    used = n.s.factorisations - x.begun
    idle = n.best > 0.5 * x.before or n.best == 1.0 / 0.0
    n.counts[N_ROUNDS] += 1
    if n.best > 0.5 * x.before and at_floor(n):
        leave(n)
        return
    adapt(x, used, idle)
    x.free = x.free + 1 if used == 0 else 0
    x.stuck = x.stuck or x.free > FREE


cdef inline void pursue(newton_t* n, int32_t which, int32_t length, double last) noexcept nogil:
    """Rounds, first for `length` factorisations, after which half of `last` is to be reached."""
    n.pursuit.last, n.pursuit.length = last, length
    n.pursuit.which = which
    n.pursuit.at = n.pursuit.stretches = 0
    enter(n, PURSUIT)


cdef inline void go_pursuit(newton_t* n) noexcept nogil:
    """Rounds as long as each stretch halves its residual."""
    cdef pursuit_t* x = &n.pursuit
    cdef double best
    if x.at == 0:
        if done(n) or n.rounds[x.which].stuck or x.stretches == STRETCHES:
            leave(n)
            return
        x.at = 1
        x.stretches += 1
        begin_apart(n)
        enter_rounds(n, x.which, x.length)
        return
    x.at = 0
    best = end_apart(n, NULL)
    if best > 0.5 * x.last or best == 1.0 / 0.0 or at_floor(n):
        leave(n)
        return
    x.last, x.length = best, STRETCH
    n.rounds[x.which].inner = INNER


# -- interior points that Newton steps end -------------------------------------------------------------------------


cdef inline void begin_approach(newton_t* n, int32_t law, int32_t augmented) noexcept nogil:
    begin_progress(n, 1e-5 if augmented else 1e-3)
    n.progress.law, n.progress.augmented = law, augmented
    enter(n, APPROACH)


cdef inline void go_approach(newton_t* n) noexcept nogil:
    """A step, and Newton steps of `law`, until the judge is content or they get nowhere."""
    cdef progress_t* k = &n.progress
    cdef double found
    cdef bint went
    if k.at == 0:
        n.s.augmented = k.augmented
        went = k.steps < APPROACH_STEPS and not done(n) and interior_step(n)
        n.s.augmented = 0
        if not went:
            leave(n)
            return
        k.steps += 1
        if k.law == CONE:
            n.counts[N_AUGMENTED_INTERIOR] += 1
        else:
            n.counts[N_AUGMENTED_DE_SAXCE if k.augmented else N_DE_SAXCE] += 1
        found = score(n, n.ip.z)
        k.idle = 0 if found < 0.5 * k.lowest else k.idle + 1
        if found < k.lowest:
            k.lowest = found
            take(n, k.kept, n.ip.z)
        if found < k.near and not done(n):
            k.near = 0.1 * found
            k.at = 1
            if k.augmented:
                begin_polish(n, n.ip.z, 2, 4)
            else:
                begin_rounds(n, 1, n.ip.z, k.law, found, TRIAL)
                enter_rounds(n, 1, 1)
            return
    if k.at == 1:
        k.at = 0
        if at_floor(n):
            leave(n)
            return
    k.still = k.still + 1 if n.ip.length < 0.05 else 0
    if k.still >= SHORT_STEPS or (k.idle > APPROACH_IDLE and k.lowest < 1e-5) or n.ip.gap < 1e-24 * n.ip.first_gap:
        leave(n)


cdef inline void begin_polish(newton_t* n, const double* z, int32_t patience, int32_t limit) noexcept nogil:
    cdef polish_t* x = &n.polish
    take(n, x.z, z)
    x.best = score(n, z)
    x.worse = 0
    x.patience, x.left = patience, limit
    enter(n, POLISH)


cdef inline void go_polish(newton_t* n) noexcept nogil:
    """A Newton step through the augmented system, until the judge is content or `patience` of them gain nothing."""
    cdef polish_t* x = &n.polish
    cdef int32_t j
    cdef double found
    if x.left == 0 or done(n):
        leave(n)
        return
    x.left -= 1
    n.s.augmented = 1
    with_products(n, x.z, n.rest)
    system_natural(&n.s, x.z, n.rest, n.progress.law, shift_of(), n.f)
    system_factor(&n.s, OF_NATURAL, shift_of())
    n.counts[N_AUGMENTED] += 1
    for j in range(n.s.e.m):
        n.f[j] = -n.f[j]
    solve_refined(&n.s, n.f, n.dz, n.r, n.da)
    n.s.augmented = 0
    for j in range(n.s.e.m):
        x.z[j] += n.dz[j]
    if not all_finite(x.z, n.s.e.m):
        leave(n)
        return
    found = score(n, x.z)
    x.worse = 0 if found < 0.5 * x.best else x.worse + 1
    x.best = found if found < x.best else x.best
    if x.worse >= x.patience or (x.worse and at_floor(n)):
        leave(n)
