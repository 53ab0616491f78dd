"""The phases of Newton's method, one factorisation at a time: active-set exchanges, interior points, damped Newton.

    active set      F(z) = z - Pi(z - (H z - g)) = 0,   (I - P + P H) dz = -F                                 (1)
    damped Newton   F_c(z) = z - Pi(z - (H z - g) - alpha (z - c)),   c = z of the last proximal iteration    (2)

An exchange solves the rows inside their bounds; rows with the wrong sign then change their active bound. This is the
primal-dual active set method (Qi, Sun 1993; Hintermueller, Ito, Kunisch 2002). If rows depend on each other it may
cycle. It ends if the contraction of the number of rows c_k that change their bound predicts more steps than an interior
point takes, or if c_k does not fall:

    k log(c_k) / log(c_0 / c_k)         exchanges left after the k-th                                         (3)

Damped Newton is the proximal point method (Rockafellar 1976): the inner problem is strongly monotone if H is monotone,
and its Newton steps pass a non-monotone line search on |F_c| (Grippo, Lampariello, Lucidi 1986). alpha falls faster the
fewer steps an inner problem takes, and rises if one fails.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t
from libc.string cimport memset

from lavender_ext.core.block_projection cimport classify_active_bound
from lavender_ext.core.validate cimport all_finite, norm_inf
from lavender_ext.core.block_types cimport CONE
from lavender_ext.judge.score cimport relative_residual
from lavender_ext.newton.cones cimport cone_gap, cone_size, has_lower_bound, has_upper_bound, load_cone_variable
from lavender_ext.newton.elements cimport elements_t, is_row
from lavender_ext.newton.line_search cimport is_reduction_sufficient
from lavender_ext.newton.run cimport (ACTIVE_SET, AUGMENTED_NEWTON, DAMPED_NEWTON, DAMPED_STRETCHES, INTERIOR_POINT,
                                      INTERIOR_WITH_NEWTON, MAX_INNER_STEPS, N_ACTIVE_SET, N_AUGMENTED_DE_SAXCE,
                                      N_AUGMENTED_INTERIOR, N_AUGMENTED_NEWTON, N_DE_SAXCE, N_INTERIOR, N_PROXIMAL, PLAN_COULOMB,
                                      active_set_t, augmented_newton_t, begin_separate_best, compute_slack,
                                      convex_residual, copy_vector, damped_newton_t, end_separate_best, is_at_roundoff,
                                      is_budget_spent, is_finished, newton_t, pop_phase, progress_t, push_phase,
                                      judge_and_keep_best_point, stretches_t)
from lavender_ext.newton.steps cimport compute_all_normal_shifts, take_interior_point_step
from lavender_ext.newton.system cimport (BARRIER, NATURAL, solve_natural_map_system, solve_natural_map_system_refined,
                                         factor_newton_system, evaluate_system_natural_map,
                                         solve_newton_system, system_t, multiply_system_matrix)


cdef enum:                      # active set
    TYPICAL_INTERIOR_STEPS = 12     # Exchanges end if (3) predicts more steps than an interior point usually takes.
    MAX_STALLED_EXCHANGES = 4       # Exchanges end if this many in a row do not lower the number of rows that change their bound.

cdef enum:                      # interior points
    MAX_INTERIOR_STEPS = 1000       # Limit of one convex interior point, whatever the budget.
    MAX_IDLE_INTERIOR_STEPS = 15    # An interior point ends if this many steps halve neither residual nor gap.
    MAX_STALLED_INTERIOR_STEPS = 3  # Below `roundoff_residual` an interior point ends if this many steps do not halve the residual.
    CERTIFICATE_REFINEMENTS = 3     # Solves of (4) with the same factor.
    MAX_CERTIFICATE_FACTORS = 4     # Factors of (4); each factor has fewer elements than the one before.
    CONE_END_FACTORISATIONS = 12    # Budget of the damped Newton phase that ends an interior point of cones.
    MAX_HYBRID_STEPS = 60           # Limit of an interior point with Newton trials; more steps rarely help.
    MAX_SHORT_STEPS = 4             # Such an interior point ends after this many short steps in a row: the path has turned back.
    TRIAL_INNER_STEPS = 2           # Newton steps of one attempt to end De Saxce's interior point.
    AUGMENTED_TRIAL_STEPS = 4       # Newton steps on the augmented system in one attempt.
    MAX_FAILED_AUGMENTED_STEPS = 2  # An attempt ends if this many steps in a row do not halve the residual.

cdef enum:                      # damped Newton
    LINE_SEARCH_MEMORY = 6      # Number of earlier steps that the non-monotone line search compares with.
    MAX_STEP_HALVINGS = 7       # Largest number of halvings of one step. After them, the best length is taken.
    MAX_FREE_ITERATIONS = 20    # The phase is stuck after this many iterations in a row without a factorisation.
    STRETCH_FACTORISATIONS = 12     # Length of a stretch: factorisations between two checks that the phase still gains.
    MAX_STRETCHES = 1000        # Largest number of stretches of one phase, whatever the budget.
    UNLIMITED = 2147483647


cdef inline double roundoff_residual() noexcept nogil:
    """Return the relative residual below which rounding may stall an interior point."""
    return 1e-6


cdef inline double slip_residual() noexcept nogil:
    """Return the residual of the convex law below which an interior point's z is judged under Coulomb's law."""
    return 1e-5


cdef inline double early_slip_residual() noexcept nogil:
    """Return the residual of the convex law below which fast sliding is counted; larger ones count contacts that will stick."""
    return 0.03


cdef inline double early_slip_speed() noexcept nogil:
    """Return the shift of a normal above which sliding is fast, relative to the largest entry of g."""
    return 1e-2


cdef inline double max_early_sliding_fraction() noexcept nogil:
    """Return the fraction of contacts that slide fast above which an interior point of the convex law ends under Coulomb's law.

    Below `early_slip_residual`, piles that shifted Newton solves have up to 2 %; balls in motion 15 % and more.
    """
    return 0.1


cdef inline double short_step() noexcept nogil:
    """Return the step length of an interior point below which a step counts as short."""
    return 0.05


cdef inline double smallest_gap_ratio() noexcept nogil:
    """Return the gap, relative to its maximum, below which an interior point ends because rounding dominates its scaling."""
    return 1e-24


cdef inline double exchange_weight() noexcept nogil:
    """Return the weight eps in the matrix of an exchange. It keeps dependent rows solvable; refinement removes its effect."""
    return 1e-9


cdef inline double augmented_shift() noexcept nogil:
    """Return the shift of the augmented system's rows, relative to d. Squared singular values below it count as zero."""
    return 1e-14


cdef inline double smallest_alpha() noexcept nogil:
    """Return the smallest proximal weight; a factorisation loses smaller ones to rounding."""
    return 1e-12


# -- (1) active set ----------------------------------------------------------------------------------------------------


cdef inline void store_active_bounds(const elements_t* e, const double* z, const double* hz, int32_t* bound) noexcept nogil:
    """Store the bound that is active on each row: -1, 0 or 1."""
    cdef int32_t j
    for j in range(e.m):
        bound[j] = classify_active_bound(z[j] - hz[j] + e.g[j], e.lower[j], e.upper[j])


cdef inline int32_t count_active_bound_changes(const elements_t* e, const double* z, const double* hz,
                                               const int32_t* bound) noexcept nogil:
    """Return the number of rows whose active bound differs from the stored one."""
    cdef int32_t j, changed = 0
    for j in range(e.m):
        changed += classify_active_bound(z[j] - hz[j] + e.g[j], e.lower[j], e.upper[j]) != bound[j]
    return changed


cdef inline void begin_active_set(newton_t* n, const double* z) noexcept nogil:
    """Begin exchanges from z."""
    cdef active_set_t* x = &n.active
    copy_vector(n, x.z, z)
    copy_vector(n, x.best_z, z)
    multiply_system_matrix(&n.s, x.z, x.hz)
    x.best = convex_residual(n, x.z, x.hz)
    x.is_scored = x.first_changes = x.exchanges = x.stalled = 0
    x.fewest_changes = UNLIMITED
    push_phase(n, ACTIVE_SET)


cdef inline bint exchange_rows(newton_t* n) noexcept nogil:
    """Make one exchange of the active set; return False if the new z is not finite."""
    cdef active_set_t* x = &n.active
    cdef int32_t j
    cdef bint finite
    for j in range(n.s.e.m):
        n.slack[j] = x.hz[j] - n.s.e.g[j]
    store_active_bounds(n.s.e, x.z, x.hz, x.bound)
    evaluate_system_natural_map(&n.s, x.z, n.slack, CONE, exchange_weight(), n.f)
    factor_newton_system(&n.s, NATURAL, exchange_weight())
    for j in range(n.s.e.m):
        n.f[j] = -n.f[j]
    solve_natural_map_system_refined(&n.s, n.f, n.dz, n.r, n.da)
    finite = all_finite(n.dz, n.s.e.m)
    if finite:
        for j in range(n.s.e.m):
            x.z[j] += n.dz[j]
        multiply_system_matrix(&n.s, x.z, x.hz)
    return finite


cdef inline bint predicts_too_many_exchanges(int32_t first, int32_t now, int32_t exchanges) noexcept nogil:
    """Return whether (3) predicts more exchanges than an interior point takes steps."""
    cdef double a = 1.0, b = 1.0
    cdef int32_t _
    if exchanges == 0 or now <= 1:
        return False
    if now >= first:
        return True
    for _ in range(exchanges):
        a *= now
    for _ in range(TYPICAL_INTERIOR_STEPS):
        b *= <double>first / now
    return a > b


cdef inline void end_active_set(newton_t* n) noexcept nogil:
    """Judge the best z and end the phase."""
    if not n.active.is_scored:
        judge_and_keep_best_point(n, n.active.best_z)
    pop_phase(n)


cdef inline void step_active_set(newton_t* n) noexcept nogil:
    """Make one exchange. End the phase if the judge accepts, no row changes, or (3) predicts too many exchanges."""
    cdef active_set_t* x = &n.active
    cdef double residual
    cdef int32_t changed
    cdef bint gains
    if x.best <= n.tol and not x.is_scored:
        x.is_scored = 1
        if judge_and_keep_best_point(n, x.best_z) <= n.tol:
            pop_phase(n)
            return
    if is_finished(n):
        end_active_set(n)
        return
    n.counts[N_ACTIVE_SET] += 1
    if not exchange_rows(n):
        end_active_set(n)
        return
    residual = convex_residual(n, x.z, x.hz)
    gains = residual < 0.5 * x.best
    if residual < x.best:
        x.best, x.is_scored = residual, 0
        copy_vector(n, x.best_z, x.z)
    changed = count_active_bound_changes(n.s.e, x.z, x.hz, x.bound)
    x.stalled = 0 if changed < x.fewest_changes else x.stalled + 1
    x.fewest_changes = changed if changed < x.fewest_changes else x.fewest_changes
    # With the same active rows, further exchanges only remove the effect of eps; they continue while that lowers the residual.
    if x.best > n.tol and (not gains if changed == 0 else x.stalled >= MAX_STALLED_EXCHANGES
                           or predicts_too_many_exchanges(x.first_changes, changed, x.exchanges)):
        end_active_set(n)
        return
    if not gains and n.tol < x.best < 1e-5:
        x.is_scored = 1
        judge_and_keep_best_point(n, x.best_z)
        if is_at_roundoff(n):
            pop_phase(n)
            return
    x.first_changes = x.first_changes if x.first_changes else changed
    x.exchanges += 1


# -- interior points of the convex law -----------------------------------------------------------------------------------


cdef inline void reset_interior_progress(newton_t* n, double trial_residual) noexcept nogil:
    """Reset the progress of an interior point; trials begin below the relative residual `trial_residual`."""
    cdef progress_t* k = &n.progress
    k.lowest = 1.0 / 0.0
    k.trial_residual = trial_residual
    k.idle = k.stalled = k.steps = k.trial_runs = k.augmented = k.is_counted = 0
    copy_vector(n, k.best_z, n.ip.z)


cdef inline void begin_interior_steps(newton_t* n, bint bounded_rows) noexcept nogil:
    """Begin steps from the point of `begin_interior_point`; bounded_rows: all elements of the problem are bounded rows."""
    reset_interior_progress(n, 1e-2)
    n.progress.bounded_rows = bounded_rows
    push_phase(n, INTERIOR_POINT)


cdef inline bint ray_leaves_bounds(const elements_t* e, int32_t i, const double* y) noexcept nogil:
    """Return whether the ray along y leaves the bounds or a cone of element i."""
    cdef int32_t g
    cdef double x[4]
    if is_row(e, i):
        return ((y[e.ptr[i]] < 0.0 and has_lower_bound(e, e.ptr[i]))
                or (y[e.ptr[i]] > 0.0 and has_upper_bound(e, e.ptr[i])))
    for g in range(e.part[i], e.part[i + 1]):
        load_cone_variable(e, i, g, y, x)
        if cone_gap(x, cone_size(e, g)) < 0.0:
            return True
    return False


cdef inline void clear_direction_of_element(newton_t* n, int32_t i) noexcept nogil:
    """Set `direction` and the weights of element i to 0."""
    cdef int32_t k
    memset(n.direction + n.s.e.ptr[i], 0, (n.s.e.ptr[i + 1] - n.s.e.ptr[i]) * sizeof(double))
    for k in range(n.s.e.wptr[i], n.s.e.wptr[i + 1]):
        n.s.v[k] = 0.0
        if n.s.bt != NULL:
            n.s.bt[k] = 0.0


cdef inline void find_interior_certificate(newton_t* n) noexcept nogil:
    """Compute a direction from a diverging interior point and request a check of it.

    If there is no solution, the interior point diverges along the null space of H. A certificate is the y with H y = 0
    that is nearest to z in the metric of the cones,

        y <- y - (H + W)^-1 H y,   W z = u                                                                (4)

    with W of the last step. Elements whose z does not exceed its dual u are fixed, and so are those whose bounds y leaves.
    """
    cdef system_t* s = &n.s
    cdef const elements_t* e = s.e
    cdef int32_t i, j, _, n_fixed = 1, factors_left = MAX_CERTIFICATE_FACTORS
    if not norm_inf(n.ip.hz, e.m) < 1e-3 * norm_inf(n.ip.z, e.m):
        return
    copy_vector(n, n.direction, n.ip.z)
    for i in range(e.n):
        j = e.ptr[i]
        if (not fabs(n.ip.z[j]) > fabs(n.ip.u1[j]) or s.v[e.wptr[i]] * 0.0 != 0.0
                or (is_row(e, i) and has_lower_bound(e, j) and has_upper_bound(e, j))):
            clear_direction_of_element(n, i)
    while n_fixed and factors_left and not is_budget_spent(n):
        factors_left -= 1
        factor_newton_system(s, BARRIER, 0.0)
        for _ in range(CERTIFICATE_REFINEMENTS):
            multiply_system_matrix(s, n.direction, n.slack)
            solve_newton_system(s, BARRIER, n.slack, n.trial)
            for j in range(e.m):
                n.direction[j] -= n.trial[j]
        n_fixed = 0
        for i in range(e.n):
            if ray_leaves_bounds(e, i, n.direction):
                clear_direction_of_element(n, i)
                n_fixed += 1
    n.needs_check = n_fixed == 0


cdef inline double compute_sliding_fraction(newton_t* n, const double* z, double slow) noexcept nogil:
    """Return the fraction of the loaded contacts whose shift at z is above `slow`, relative to the largest entry of g."""
    cdef const elements_t* e = n.s.e
    cdef double load = 0.0, size = 0.0
    cdef int32_t i, j, loaded = 0, sliding = 0
    compute_slack(n, z, n.slack)
    compute_all_normal_shifts(e, n.slack, 0.0, n.t2, n.psi)
    for j in range(e.m):
        size = fabs(e.g[j]) if fabs(e.g[j]) > size else size
    for i in range(e.n):
        j = e.ptr[i]
        load = z[j] if not is_row(e, i) and z[j] > load else load
    for i in range(e.n):
        j = e.ptr[i]
        if not is_row(e, i) and z[j] > 1e-6 * load:
            loaded += 1
            sliding += n.t2[j] > slow * size
    return <double>sliding / loaded if loaded else 1.0


cdef inline void end_interior_steps(newton_t* n, bint may_continue) noexcept nogil:
    """Judge the best z and end the phase.

    On cones, damped Newton follows close to the solution, and else the search for a certificate.
    """
    cdef progress_t* k = &n.progress
    pop_phase(n)
    if k.lowest < n.best:
        judge_and_keep_best_point(n, k.best_z)
    if n.stack[0] == PLAN_COULOMB:                      # Shifted Newton follows.
        return
    if may_continue and not k.bounded_rows and k.lowest < roundoff_residual() and not is_finished(n) and not is_at_roundoff(n):
        begin_damped_newton(n, k.best_z, CONE, k.lowest, MAX_INNER_STEPS)
        push_damped_newton(n, CONE_END_FACTORISATIONS)
    elif not k.bounded_rows and k.lowest >= roundoff_residual() and not is_finished(n):
        find_interior_certificate(n)


cdef inline void step_interior_point(newton_t* n) noexcept nogil:
    """Take an interior point step. Each time the residual falls by a factor of ten, exchange bounded rows."""
    cdef progress_t* k = &n.progress
    cdef double residual
    cdef bint gains
    if not k.trial_runs:
        if k.steps == MAX_INTERIOR_STEPS or is_finished(n) or not take_interior_point_step(n):
            end_interior_steps(n, True)
            return
        k.steps += 1
        n.counts[N_INTERIOR] += 1
        residual = relative_residual(n.ip.energy, n.ip.velocity, n.problem.e0, n.problem.v0)
        gains = residual < 0.5 * k.lowest
        k.idle = 0 if gains or n.ip.gap < 0.5 * n.ip.min_gap else k.idle + 1
        k.stalled = 0 if gains else k.stalled + 1
        if residual < k.lowest:
            k.lowest = residual
            copy_vector(n, k.best_z, n.ip.z)
        if residual <= n.tol and judge_and_keep_best_point(n, n.ip.z) <= n.tol:
            end_interior_steps(n, False)
            return
        # Under Coulomb's law the phase ends if the convex problem is solved and contacts slip, or if many of them will.
        if n.stack[0] == PLAN_COULOMB:
            if residual < early_slip_residual() and not k.is_counted:
                k.is_counted = 1
                n.mostly_slides = compute_sliding_fraction(n, n.ip.z, early_slip_speed()) > max_early_sliding_fraction()
            if n.mostly_slides or (residual < slip_residual() and residual < 0.01 * judge_and_keep_best_point(n, n.ip.z)):
                end_interior_steps(n, False)
                return
        if k.bounded_rows and residual < k.trial_residual:
            k.trial_residual = 0.1 * residual
            k.trial_runs = 1
            begin_active_set(n, n.ip.z)
            return
    else:
        k.trial_runs = 0
        if n.best < roundoff_residual() and 0.1 * n.best < k.trial_residual:
            k.trial_residual = 0.1 * n.best
        if is_finished(n) or is_at_roundoff(n):
            end_interior_steps(n, False)
            return
    if (k.idle > MAX_IDLE_INTERIOR_STEPS or (k.stalled >= MAX_STALLED_INTERIOR_STEPS and k.lowest < roundoff_residual())
            or n.ip.length < 1e-6 or n.ip.gap < smallest_gap_ratio() * n.ip.max_gap):
        end_interior_steps(n, True)


# -- (2) damped Newton -----------------------------------------------------------------------------------------------------


cdef inline void begin_damped_newton(newton_t* n, const double* z, int32_t law, double alpha,
                                     int32_t max_inner_steps) noexcept nogil:
    """Set the start and the proximal weight of a damped Newton phase."""
    cdef damped_newton_t* x = &n.damped
    copy_vector(n, x.z, z)
    x.law, x.alpha, x.max_inner_steps = law, alpha, max_inner_steps
    x.min_factor = 0.1
    x.failures = x.idle = x.is_stuck = x.free_iterations = 0


cdef inline void push_damped_newton(newton_t* n, int32_t limit) noexcept nogil:
    """Put damped Newton on the stack of phases, for at most `limit` further factorisations."""
    cdef damped_newton_t* x = &n.damped
    x.last = n.s.factorisations + limit if limit < UNLIMITED - n.s.factorisations else UNLIMITED
    x.free_iterations = x.stage = 0
    judge_and_keep_best_point(n, x.z)
    push_phase(n, DAMPED_NEWTON)


cdef inline double compute_trial_residual_norm(newton_t* n, const damped_newton_t* x, double t) noexcept nogil:
    """Return |F_c| at z + t dz, which is written to `trial`."""
    cdef int32_t j
    for j in range(n.s.e.m):
        n.trial[j] = n.u[j] + t * n.dz[j]
        n.slack[j] = n.hz[j] + t * n.hdz[j] - n.s.e.g[j] + x.alpha * (n.trial[j] - n.c[j])
    return evaluate_system_natural_map(&n.s, n.trial, n.slack, x.law, 0.0, n.f)


cdef inline bint take_inner_newton_step(newton_t* n, damped_newton_t* x) noexcept nogil:
    """Take a Newton step of the inner problem from z in n.u; return False if the inner problem ends."""
    cdef system_t* s = &n.s
    cdef int32_t j, k, _, m = s.e.m
    cdef double size, bound = 0.0, value, best = 1.0 / 0.0, at = 1.0, t = 1.0
    if x.inner_steps == x.max_inner_steps:
        return False
    # Value and derivative of F_c.
    for j in range(m):
        n.slack[j] = n.hz[j] - s.e.g[j] + x.alpha * (n.u[j] - n.c[j])
    size = evaluate_system_natural_map(s, n.u, n.slack, x.law, x.alpha, n.f)
    x.history[x.inner_steps] = size
    x.inner_steps += 1
    if (size <= 0.1 * x.history[0] and x.inner_steps > 1) or size == 0.0:
        x.is_solved = 1
        return False
    if is_budget_spent(n):
        return False
    # Newton direction.
    factor_newton_system(s, NATURAL, x.alpha)
    for j in range(m):
        n.f[j] = -n.f[j]
    solve_natural_map_system(s, n.f, n.dz)
    if not all_finite(n.dz, m):
        return False
    multiply_system_matrix(s, n.dz, n.hdz)
    # Non-monotone line search.
    for k in range(x.inner_steps - LINE_SEARCH_MEMORY if x.inner_steps > LINE_SEARCH_MEMORY else 0, x.inner_steps):
        bound = x.history[k] if x.history[k] > bound else bound
    for _ in range(MAX_STEP_HALVINGS):
        value = compute_trial_residual_norm(n, x, t)
        if value < best:
            best, at = value, t
        if is_reduction_sufficient(value, t, bound):
            break
        t *= 0.5
    for j in range(m):
        n.u[j] += at * n.dz[j]
        n.hz[j] += at * n.hdz[j]
    return judge_and_keep_best_point(n, n.u) > n.tol


cdef inline void adapt_proximal_weight(damped_newton_t* x, int32_t factorisations, bint idle) noexcept nogil:
    """Lower the proximal weight after a solved inner problem, or raise it after a failure.

    The factors are larger for inner problems with few factorisations. After a single step the active pieces are known,
    and alpha falls at once to its minimum.
    """
    cdef double factor
    if x.is_solved:
        x.failures = 0
        factor = 0.05 if factorisations <= 2 else 0.15 if factorisations <= 4 else 0.4 if factorisations <= 8 else 1.0
        factor = x.min_factor if x.min_factor > factor else factor
        if factorisations <= 1 and x.min_factor <= 0.1:
            factor = 2e-3
        x.alpha = x.alpha * factor if x.alpha * factor > smallest_alpha() else smallest_alpha()
        x.min_factor = 0.5 * x.min_factor if x.min_factor > 0.1 else 0.05
        x.idle = x.idle + 1 if x.alpha == smallest_alpha() and idle else 0
    else:
        x.failures += 1
        x.min_factor = 0.2 if x.min_factor < 0.2 else 2.0 * x.min_factor if x.min_factor < 0.35 else 0.7
        x.alpha *= 5.0
    x.is_stuck = x.idle > 3 or x.failures > 6 or x.alpha > 10.0


cdef inline bint request_certificate_check(newton_t* n, const damped_newton_t* x) noexcept nogil:
    """Write the change of z to `direction` and request a check; return False if it is 0 or not finite.

    If there is no solution, proximal iterations diverge along a direction y with H y = 0, which proves it.
    """
    cdef int32_t j
    cdef double big
    for j in range(n.s.e.m):
        n.direction[j] = x.z[j] - n.c[j]
    big = norm_inf(n.direction, n.s.e.m)
    if not 0.0 < big < 1.0 / 0.0:
        return False
    for j in range(n.s.e.m):            # Rounding leaves rows that do not act slightly beyond their bounds.
        n.direction[j] = n.direction[j] / big if fabs(n.direction[j]) > 1e-11 * big else 0.0
    n.needs_check = 1
    return True


cdef inline void step_damped_newton(newton_t* n) noexcept nogil:
    """Take a Newton step of a proximal iteration. End the phase if the judge accepts, the limit is reached, or it is stuck."""
    cdef damped_newton_t* x = &n.damped
    cdef int32_t factorisations
    cdef bint idle
    # Begin a proximal iteration.
    if x.stage == 0:
        if is_finished(n) or x.is_stuck or n.s.factorisations >= x.last:
            pop_phase(n)
            return
        x.earlier_best, x.first = n.best, n.s.factorisations
        x.inner_steps = x.is_solved = 0
        x.stage = 1
        copy_vector(n, n.c, x.z)
        copy_vector(n, n.u, x.z)
        multiply_system_matrix(&n.s, n.u, n.hz)
    # Take a step of its inner problem.
    if x.stage == 1:
        if take_inner_newton_step(n, x):
            return
        if x.is_solved or x.history[x.inner_steps - 1] <= x.history[0]:
            copy_vector(n, x.z, n.u)
        x.stage = 2
        if (x.law == CONE and x.is_solved and n.best > 0.5 * x.earlier_best and n.best > 1e-8
                and request_certificate_check(n, x)):
            return
    # End the iteration; the caller has checked a direction.
    x.stage = 0
    if n.proven:
        pop_phase(n)
        return
    factorisations = n.s.factorisations - x.first
    idle = n.best > 0.5 * x.earlier_best or n.best == 1.0 / 0.0
    n.counts[N_PROXIMAL] += 1
    if n.best > 0.5 * x.earlier_best and is_at_roundoff(n):
        pop_phase(n)
        return
    adapt_proximal_weight(x, factorisations, idle)
    x.free_iterations = x.free_iterations + 1 if factorisations == 0 else 0
    x.is_stuck = x.is_stuck or x.free_iterations > MAX_FREE_ITERATIONS


cdef inline void begin_damped_newton_stretches(newton_t* n, int32_t length, double residual) noexcept nogil:
    """Begin a damped Newton phase whose first stretch of `length` factorisations must halve `residual`."""
    n.stretches.residual, n.stretches.length = residual, length
    n.stretches.is_running = n.stretches.stretches = 0
    push_phase(n, DAMPED_STRETCHES)


cdef inline void continue_damped_newton_stretches(newton_t* n) noexcept nogil:
    """Continue damped Newton by another stretch if the last stretch halved the residual; else end the phase."""
    cdef stretches_t* x = &n.stretches
    cdef double best
    if not x.is_running:
        if is_finished(n) or n.damped.is_stuck or x.stretches == MAX_STRETCHES:
            pop_phase(n)
            return
        x.is_running = 1
        x.stretches += 1
        begin_separate_best(n)
        push_damped_newton(n, x.length)
        return
    x.is_running = 0
    best = end_separate_best(n, NULL)
    if best > 0.5 * x.residual or best == 1.0 / 0.0 or is_at_roundoff(n):
        pop_phase(n)
        return
    x.residual, x.length = best, STRETCH_FACTORISATIONS
    n.damped.max_inner_steps = MAX_INNER_STEPS


# -- interior points with Newton trials ------------------------------------------------------------------------------------


cdef inline void begin_interior_with_newton(newton_t* n, int32_t law, int32_t augmented) noexcept nogil:
    """Begin steps of De Saxce's interior point, or of an augmented one, with attempts to finish by Newton steps of `law`."""
    reset_interior_progress(n, 1e-5 if augmented else 1e-3)
    n.progress.law, n.progress.augmented = law, augmented
    push_phase(n, INTERIOR_WITH_NEWTON)


cdef inline void step_interior_with_newton(newton_t* n) noexcept nogil:
    """Take an interior point step. Each time the residual falls by a factor of ten, attempt to finish by Newton steps."""
    cdef progress_t* k = &n.progress
    cdef double residual
    cdef bint succeeded
    if not k.trial_runs:
        n.s.augmented = k.augmented
        succeeded = k.steps < MAX_HYBRID_STEPS and not is_finished(n) and take_interior_point_step(n)
        n.s.augmented = 0
        if not succeeded:
            pop_phase(n)
            return
        k.steps += 1
        if k.law == CONE:
            n.counts[N_AUGMENTED_INTERIOR] += 1
        else:
            n.counts[N_AUGMENTED_DE_SAXCE if k.augmented else N_DE_SAXCE] += 1
        residual = judge_and_keep_best_point(n, n.ip.z)
        k.idle = 0 if residual < 0.5 * k.lowest else k.idle + 1
        if residual < k.lowest:
            k.lowest = residual
            copy_vector(n, k.best_z, n.ip.z)
        if residual < k.trial_residual and not is_finished(n):
            k.trial_residual = 0.1 * residual
            k.trial_runs = 1
            if k.augmented:
                begin_augmented_newton(n, n.ip.z)
            else:
                begin_damped_newton(n, n.ip.z, k.law, residual, TRIAL_INNER_STEPS)
                push_damped_newton(n, 1)
            return
    else:
        k.trial_runs = 0
        if is_at_roundoff(n):
            pop_phase(n)
            return
    k.stalled = k.stalled + 1 if n.ip.length < short_step() else 0
    if (k.stalled >= MAX_SHORT_STEPS or (k.idle > MAX_IDLE_INTERIOR_STEPS and k.lowest < 1e-5)
            or n.ip.gap < smallest_gap_ratio() * n.ip.max_gap):
        pop_phase(n)


cdef inline void begin_augmented_newton(newton_t* n, const double* z) noexcept nogil:
    """Begin Newton steps on the augmented system from z."""
    cdef augmented_newton_t* x = &n.augmented
    copy_vector(n, x.z, z)
    x.best = judge_and_keep_best_point(n, z)
    x.failed = 0
    x.steps_left = AUGMENTED_TRIAL_STEPS
    push_phase(n, AUGMENTED_NEWTON)


cdef inline void step_augmented_newton(newton_t* n) noexcept nogil:
    """Take a Newton step on the augmented system. End the phase if the judge accepts or steps do not lower the residual."""
    cdef augmented_newton_t* x = &n.augmented
    cdef int32_t j
    cdef double residual
    if x.steps_left == 0 or is_finished(n):
        pop_phase(n)
        return
    x.steps_left -= 1
    n.s.augmented = 1
    compute_slack(n, x.z, n.slack)
    evaluate_system_natural_map(&n.s, x.z, n.slack, n.progress.law, augmented_shift(), n.f)
    factor_newton_system(&n.s, NATURAL, augmented_shift())
    n.counts[N_AUGMENTED_NEWTON] += 1
    for j in range(n.s.e.m):
        n.f[j] = -n.f[j]
    solve_natural_map_system_refined(&n.s, n.f, n.dz, n.r, n.da)
    n.s.augmented = 0
    for j in range(n.s.e.m):
        x.z[j] += n.dz[j]
    if not all_finite(x.z, n.s.e.m):
        pop_phase(n)
        return
    residual = judge_and_keep_best_point(n, x.z)
    x.failed = 0 if residual < 0.5 * x.best else x.failed + 1
    x.best = residual if residual < x.best else x.best
    if x.failed >= MAX_FAILED_AUGMENTED_STEPS or (x.failed and is_at_roundoff(n)):
        pop_phase(n)
