"""Damped Newton: proximal iterations, each an inner problem that Newton steps solve.

    F_c(z) = z - Pi(z - (H z - g) - alpha (z - c)),   c = z of the last proximal iteration                    (1)

This is the proximal point method (Rockafellar 1976): the inner problem is strongly monotone if H is monotone, and its
Newton steps pass the non-monotone line search of `core/line_search.pxd` (2). alpha falls faster the fewer steps an inner
problem takes, and rises if one fails.

    stage   step                                event                                                        next
    0       move the centre to z                the judge accepts, stuck, limit reached                      end
                                                else                                                         1
    1       Newton step of the inner problem    |F_c| below a tenth of its start, no step or budget left,    2
                                                or the step is not finite
                                                else                                                         1
    2       adapt alpha                         a certificate is proven, or the round-off limit is reached   end
                                                else                                                         0

If a step is not finite, as without a factor (system.pxd), the inner problem fails and alpha rises. Stretches repeat the phase
as long as each of them halves the residual.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport CONE
from lavender_ext.core.line_search cimport is_reduction_sufficient
from lavender_ext.core.validate cimport all_finite, norm_inf
from lavender_ext.judge.best cimport relative_residual_of_best
from lavender_ext.newton.run cimport (DAMPED_NEWTON, DAMPED_STRETCHES, MAX_INNER_STEPS, N_PROXIMAL, UNLIMITED, copy_vector,
                                      damped_newton_t, is_at_roundoff, is_budget_spent, is_finished, judge_and_keep_best_point,
                                      newton_t, pop_phase, push_phase, stretches_t, write_unknown)
from lavender_ext.newton.system cimport (NATURAL, evaluate_system_natural_map, factor_newton_system, multiply_system_matrix,
                                         solve_natural_map_system, system_t)


cdef enum:
    LINE_SEARCH_MEMORY = 6      # Number of earlier steps that the non-monotone line search compares with.
    MAX_STEP_HALVINGS = 7       # Largest number of halvings of one step. After them, the best length is taken.
    MAX_FREE_ITERATIONS = 20    # The phase is stuck after this many iterations in a row without a factorisation.
    STRETCH_FACTORISATIONS = 12     # Length of a stretch: factorisations between two checks that the phase still gains.
    MAX_STRETCHES = 1000        # Largest number of stretches of one phase, whatever the budget.


cdef inline double smallest_alpha() noexcept nogil:
    """Return the smallest proximal weight; a factorisation loses smaller ones to rounding."""
    return 1e-12


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
        for j in range(m):
            n.trial[j] = n.u[j] + t * n.dz[j]
            n.slack[j] = n.hz[j] + t * n.hdz[j] - s.e.g[j] + x.alpha * (n.trial[j] - n.c[j])
        value = evaluate_system_natural_map(s, n.trial, n.slack, x.law, 0.0, n.f)
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


cdef inline void step_damped_newton(newton_t* n) noexcept nogil:
    """Take a Newton step of a proximal iteration. End the phase if the judge accepts, the limit is reached, or it is stuck."""
    cdef damped_newton_t* x = &n.damped
    cdef int32_t factorisations, j
    cdef double big
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
        if x.law == CONE and x.is_solved and n.best > 0.5 * x.earlier_best and n.best > 1e-8:
            # If proximal iterations diverge along a direction y with H y = 0, then y proves that there is no solution.
            for j in range(n.s.e.m):
                n.direction[j] = x.z[j] - n.c[j]
            big = norm_inf(n.direction, n.s.e.m)
            if 0.0 < big < 1.0 / 0.0:
                for j in range(n.s.e.m):                # Rounding leaves rows that do not act slightly beyond their bounds.
                    n.direction[j] = n.direction[j] / big if fabs(n.direction[j]) > 1e-11 * big else 0.0
                n.needs_check = 1
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
    """Begin a damped Newton phase; its first stretch of `length` factorisations must halve `residual`."""
    n.stretches.residual, n.stretches.length = residual, length
    n.stretches.is_running = n.stretches.stretches = 0
    push_phase(n, DAMPED_STRETCHES)


cdef inline void continue_damped_newton_stretches(newton_t* n) noexcept nogil:
    """Continue damped Newton by another stretch if the last stretch halved the residual; else end the phase."""
    cdef stretches_t* x = &n.stretches
    cdef double best, all_phases
    if not x.is_running:
        if is_finished(n) or n.damped.is_stuck or x.stretches == MAX_STRETCHES:
            pop_phase(n)
            return
        x.is_running = 1
        x.stretches += 1
        n.best = 1.0 / 0.0      # A best point of its own, which is compared with earlier points only at the end.
        push_damped_newton(n, x.length)
        return
    x.is_running = 0
    best, all_phases = n.best, relative_residual_of_best(&n.island_best)
    if all_phases < best:                               # Keep the better of this best point and the best impulse of all.
        n.best = all_phases
        write_unknown(n, n.island_best.impulse, n.best_z)
    if best > 0.5 * x.residual or best == 1.0 / 0.0 or is_at_roundoff(n):
        pop_phase(n)
        return
    x.residual, x.length = best, STRETCH_FACTORISATIONS
    n.damped.max_inner_steps = MAX_INNER_STEPS
