"""What Newton's method tries when.

Bounded rows: exchanges from the warm start and from the solution of H z = g; of bodies and sparse matrices proximal rounds,
as long as they get anywhere, which pass rows that depend on each other; an interior point, exchanges at each of its decades.
Cones: interior points with two weights. What these leave: the augmented system of bodies, proximal rounds.

Coulomb friction: proximal rounds on the Alart-Curnier map from the start, as long as they get anywhere; De Saxce's
interior point, ended by rounds; a path of smoothed problems, but for closed loops of joints; De Saxce's with less of phi's
derivative; closed loops through the augmented system; rounds from the answer of the convex relaxation, then from nothing;
more paths; and the first rounds again for what is left of the budget.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t
from libc.string cimport memset

from lavender_ext.core.method cimport CERTIFICATE, ROUNDOFF_LIMIT, MORE, REACHED, SPENT, STUCK
from lavender_ext.core.block_types cimport CONE, COULOMB
from lavender_ext.core.start cimport is_zero_impulse
from lavender_ext.judge.score cimport relative
from lavender_ext.newton.cones cimport is_high, is_low
from lavender_ext.newton.phases cimport (FIRST, LIMITLESS, STRETCH, begin_approach, begin_exchanges, begin_rounds, begin_steps,
                                         enter_rounds, go_approach, go_exchange, go_interior, go_polish, go_pursuit,
                                         go_rounds, pursue, shift_of)
from lavender_ext.newton.path cimport PATHS, begin_path, go_path
from lavender_ext.newton.run cimport (APPROACH, DE_SAXCE, EXCHANGES, INNER, INTERIOR, N_COUNTED, N_REFINED, N_RELAXED, PATH,
                                      PLAN_CONVEX, PLAN_COULOMB, POLISH, PROXIMAL, PURSUIT, RELAXED, SECOND, at_floor,
                                      begin_apart, done, end_apart, enter, leave, newton_t, put_aside, score, spent, take,
                                      take_back, tries_t, unknown_of, with_products)
from lavender_ext.newton.steps cimport begin_interior, delta_of, has_free_rows, interior_step
from lavender_ext.newton.system cimport BODIES, DENSE, OF_BARRIER, system_factor, system_natural, system_solve, system_times


cdef enum:
    REFINEMENTS = 3             # of a first point,
    MORE_REFINEMENTS = 20       # and with another factor of rows that all hold
    RELAXED_STEPS = 30          # of the convex problem that rounds start from, at most
    LARGEST_AUGMENTED = 10000   # rows, up to which one factorisation stays well below 0.2 s


cdef inline double share_of(const tries_t* x) noexcept nogil:
    """Of phi's derivative: the nearer to 1, the faster an interior point ends; further below it passes more folds.

    Closed loops begin below: no rounds follow their augmented system.
    """
    return 0.95 if x.augmented == x.second else 0.7


cdef inline double first_gain() noexcept nogil:
    """Residual over that of the start after FIRST factorisations, above which rounds give way to an interior point."""
    return 0.9


cdef inline double cone_delta() noexcept nogil:
    """Proximal weight on cones: their scaling spans more than that of rows, and what N loses to rounding is 2^-53 over
    it (measured on a redundant pyramid: 3e-8 is the end at 1e-10, 4e-10 at 1e-8, and 1e-6 costs a step more)."""
    return 1e-8


cdef inline bint over(newton_t* n) noexcept nogil:
    return done(n) or at_floor(n)


# -- bounded rows and cones --------------------------------------------------------------------------------------


cdef inline void refine(newton_t* n, double* z, int32_t most, double contraction) noexcept nogil:
    """z + (H + W)^-1 (g - H z) with the last factor, while that contracts what is left."""
    cdef int32_t j, _, m = n.s.e.m
    cdef double size = 0.0, before, found = 1.0 / 0.0, fast, x
    with_products(n, z, n.r)
    for j in range(m):
        size += n.r[j] * n.r[j]
    size = sqrt(size)
    for _ in range(most):
        system_solve(&n.s, OF_BARRIER, n.r, n.dz)
        for j in range(m):
            z[j] -= n.dz[j]
        n.counts[N_REFINED] += 1
        with_products(n, z, n.r)
        before = size
        size = fast = 0.0
        for j in range(m):
            size += n.r[j] * n.r[j]
            x = n.sc.speed[j] * (n.r[j] if n.r[j] > 0.0 else -n.r[j])
            fast = x if x > fast else fast
        size = sqrt(size)                               # |F| where every row still holds
        found = relative(size, fast, n.problem.e0, n.problem.v0)
        if not size < contraction * before or found <= 1e-3 * n.tol:
            break
    if found <= n.tol:
        score(n, z)


cdef inline bint all_hold(newton_t* n, const double* z, bint free) noexcept nogil:
    """No row has a bound (`free`), or all are inside theirs."""
    cdef int32_t j
    for j in range(n.s.e.m):
        if free and (is_low(n.s.e, j) or is_high(n.s.e, j)):
            return False
        if not n.s.e.lower[j] <= z[j] <= n.s.e.upper[j]:
            return False
    return True


cdef inline void begin_rows(newton_t* n) noexcept nogil:
    """The first point of an interior point; H z = g on every row is refined where all of them hold."""
    cdef int32_t j
    cdef double* z = n.ip.everything
    cdef bint linear
    begin_interior(n, delta_of(), 0.0)
    linear = all_hold(n, z, True)
    if not linear and (n.s.form == BODIES or not all_hold(n, z, False)):
        return
    # The weight of the first point goes away with the factor that is there; another costs more.
    take(n, n.trial, z)
    refine(n, n.trial, REFINEMENTS, 0.1)
    if linear and not done(n):
        # Rows that nearly depend on each other feel that weight: with next to none a factor is less exact, and
        # refinement mends that.
        for j in range(n.s.e.m):
            n.s.v[j] = 1.0 / (n.s.e.theta[j] + 1e-12)
        system_factor(&n.s, OF_BARRIER, 0.0)
        system_solve(&n.s, OF_BARRIER, n.s.e.g, n.trial)
        refine(n, n.trial, MORE_REFINEMENTS, 1.0)


cdef inline void exchanges_apart(newton_t* n, const double* z) noexcept nogil:
    """What these leave unfinished is no start for what follows."""
    n.before = n.best
    take(n, n.before_z, n.best_z)
    begin_exchanges(n, z)


cdef inline void go_ends(newton_t* n) noexcept nogil:
    """Where bounded rows and cones stop short, from `at` 10 on."""
    if n.at == 10:
        n.at = 12
        if n.best < 1e-3 and n.loops:                   # near-dependent rows may be what is in the way
            n.at = 11
            n.s.augmented = 1
            begin_interior(n, shift_of(), 0.0)
            n.s.augmented = 0
            begin_approach(n, CONE, 1)
        return
    if n.at == 11:
        n.at = 12
        if at_floor(n):
            n.at = 13
            return
    if n.at == 12 and not done(n):
        n.at = 13
        begin_rounds(n, 1, n.best_z, CONE, 1e-3, INNER)
        enter_rounds(n, 1, LIMITLESS)
        return
    take_back(n)
    leave(n)


cdef inline void go_convex(newton_t* n) noexcept nogil:
    cdef int32_t at = n.at
    if at >= 10:
        go_ends(n)
        return
    n.at += 1
    if n.s.e.n < n.s.e.m:                               # cones: two weights, where the first itself is in the way
        if at > 0 and over(n):
            n.at = 13
        elif at == 2:
            n.at = 10
        else:
            begin_interior(n, cone_delta() if at == 0 else delta_of(), 0.0)
            begin_steps(n, False)
    elif at == 0:
        if not n.cold:
            exchanges_apart(n, n.best_z)
    elif at == 1:
        if not n.cold and not done(n):
            put_aside(n, n.before, n.before_z)
        if over(n):
            n.at = 13
        else:
            begin_rows(n)
            if not done(n):
                exchanges_apart(n, n.ip.everything)
    elif at == 2:
        if done(n):
            n.at = 13
        else:
            put_aside(n, n.before, n.before_z)
            if n.s.form != DENSE:
                begin_rounds(n, 1, n.best_z, CONE, 1e-3, INNER)
                pursue(n, 1, STRETCH, 1.0 / 0.0)
    elif at == 3 and not over(n):
        begin_steps(n, True)
    else:
        n.at = 13 if over(n) else 10
        if n.at == 10:
            take_back(n)


# -- Coulomb friction --------------------------------------------------------------------------------------------


cdef inline void begin_de_saxce(newton_t* n, int32_t augmented, int32_t second) noexcept nogil:
    n.tries.at = 0
    n.tries.augmented, n.tries.second = augmented, second
    enter(n, DE_SAXCE)


cdef inline void go_de_saxce(newton_t* n) noexcept nogil:
    """An interior point, ended by Newton's method on the Alart-Curnier map."""
    cdef tries_t* x = &n.tries
    cdef double best
    if x.at == 0:
        x.at = 1
        n.s.augmented = x.augmented
        begin_interior(n, shift_of() if x.augmented else delta_of(), share_of(x))
        n.s.augmented = 0
        begin_approach(n, COULOMB, x.augmented)
        return
    best = n.progress.lowest if x.at == 1 else end_apart(n, n.progress.kept)
    if over(n):
        leave(n)
        return
    if x.augmented or x.at == 3 or (not x.second and x.at == 1 and best > 1e-2):    # far from an end: no rounds
        if x.second or not x.augmented:
            leave(n)
        x.at = 0
        x.second = 1
        return
    begin_rounds(n, 1, n.progress.kept, COULOMB, best if best < (1e-3 if x.at == 1 else 1e-7) else
                 (1e-3 if x.at == 1 else 1e-7), 10 if x.at == 1 else 12)
    begin_apart(n)
    enter_rounds(n, 1, 15 if x.at == 1 else 12)
    x.at += 1


cdef inline void begin_relaxed(newton_t* n) noexcept nogil:
    begin_interior(n, delta_of(), 0.0)
    memset(n.trial, 0, n.s.e.m * sizeof(double))
    with_products(n, n.trial, n.rest)
    n.relaxed = 1e-4 * system_natural(&n.s, n.trial, n.rest, CONE, 0.0, n.f)
    n.relaxed_at = 0
    enter(n, RELAXED)


cdef inline void go_relaxed(newton_t* n) noexcept nogil:
    """A step of the convex problem; from its answer, rounds."""
    if n.relaxed_at < RELAXED_STEPS and not done(n) and interior_step(n):
        n.relaxed_at += 1
        n.counts[N_RELAXED] += 1
        score(n, n.ip.z)
        if n.ip.energy > n.relaxed:
            return
    leave(n)
    if not done(n):
        begin_rounds(n, 1, n.ip.z, COULOMB, 1e-3, INNER)
        pursue(n, 1, STRETCH, 1.0 / 0.0)


cdef inline void go_coulomb(newton_t* n) noexcept nogil:
    cdef int32_t at = n.at
    # Loops of joints, whose rows nearly depend on each other; known without what solves their augmented system.
    cdef bint closed = n.s.form == BODIES and n.s.e.m <= LARGEST_AUGMENTED and has_free_rows(n)
    n.at += 1
    if at > 0 and over(n):
        at = 9
    if at == 0:
        take(n, n.aside_z, n.best_z)
        begin_rounds(n, 0, n.best_z, COULOMB, 1e-5, FIRST)     # (1e-4 to 1e-7: 2,030 to 2,530 factors of 68)
        pursue(n, 0, FIRST, 2.0 * first_gain() * n.best)
    elif at == 1:
        begin_de_saxce(n, 0, 0)
    elif at == 2:                                       # stick and slip that fold the way to a solution
        if not closed:
            begin_path(n)
    elif at == 3:
        begin_de_saxce(n, 0, 1)
    elif at == 4:
        if n.loops and closed:
            begin_de_saxce(n, 1, 0)
    elif at == 5:
        begin_relaxed(n)
    elif at == 6:                                       # a start that is near no solution may be worse than none
        if not n.cold:
            memset(n.trial, 0, n.s.e.m * sizeof(double))
            begin_rounds(n, 0, n.trial, COULOMB, 1e-5, FIRST)
            pursue(n, 0, FIRST, 2.0 * first_gain())
    elif at == 7:
        if n.path.paths < PATHS:
            n.at = at
            begin_path(n)
    elif at == 8:
        begin_rounds(n, 0, n.aside_z, COULOMB, 1e-5, INNER)     # they were cut short: anew, from the start
        enter_rounds(n, 0, LIMITLESS)
    else:
        leave(n)


# -- turns -------------------------------------------------------------------------------------------------------


cdef inline void go(newton_t* n) noexcept nogil:
    """One factorisation of the phase on top, or its end."""
    cdef int32_t phase = n.stack[n.depth - 1]
    if phase == PLAN_CONVEX:
        go_convex(n)
    elif phase == PLAN_COULOMB:
        go_coulomb(n)
    elif phase == EXCHANGES:
        go_exchange(n)
    elif phase == INTERIOR:
        go_interior(n)
    elif phase == PURSUIT:
        go_pursuit(n)
    elif phase == APPROACH:
        go_approach(n)
    elif phase == POLISH:
        go_polish(n)
    elif phase == DE_SAXCE:
        go_de_saxce(n)
    elif phase == RELAXED:
        go_relaxed(n)
    elif phase == PATH:
        go_path(n)
    else:
        go_rounds(n, phase // SECOND)


cdef inline void newton_start(newton_t* n, const double* lam) noexcept nogil:
    """From lam (rows), with problem, system, tol and budget given."""
    cdef int32_t i
    n.stop = n.asked = n.proven = n.at = n.set_aside = n.depth = n.path.paths = 0
    n.s.augmented = n.s.factorisations = 0
    for i in range(N_COUNTED):
        n.counts[i] = 0
    n.best = 1.0 / 0.0
    n.above_floor = 1.0 / 0.0
    n.kept.seen = 0
    n.loops = n.s.form == BODIES and n.s.others != NULL and n.s.e.m <= LARGEST_AUGMENTED
    n.cold = is_zero_impulse(&n.problem.p, lam)
    unknown_of(n, lam, n.trial)
    take(n, n.best_z, n.trial)
    score(n, n.trial)
    if not done(n):
        enter(n, PLAN_COULOMB if n.problem.p.law == COULOMB and n.s.e.n < n.s.e.m else PLAN_CONVEX)


cdef inline int32_t newton_step(newton_t* n, int32_t work) noexcept nogil:
    """`work` factorisations more at least, where there is as much to do; how it stands."""
    cdef int32_t last = n.s.factorisations + work
    n.asked = 0
    while n.depth > 0 and not n.asked and (n.stop or n.s.factorisations < last):
        go(n)
    if n.asked:
        return CERTIFICATE
    if n.depth > 0:
        return MORE
    if n.best <= n.tol:
        return REACHED
    if at_floor(n):
        return ROUNDOFF_LIMIT
    return SPENT if spent(n) else STUCK
