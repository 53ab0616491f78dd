"""Phases of interior points: of the convex law, of De Saxce's form, and on the augmented system.

`steps.pxd` has the equations and takes each step; `interior.pxd` limits its length. A phase repeats them and decides when
to stop or to try to finish by another method:

    phase                  step              event                                               next
    INTERIOR_POINT         interior point    residual within tol                                 end
                                             residual fell tenfold, bounded rows                 exchanges, then on
                                             Coulomb's law: solved but slips, or many slip       end
                                             idle, stalled, short step, or a step fails          damped Newton or the
                                                                                                 certificate search
    INTERIOR_WITH_NEWTON   interior point    residual fell tenfold                               damped Newton, or
                                                                                                 AUGMENTED_NEWTON, then on
                                             idle, short steps, or a step fails                  end
    AUGMENTED_NEWTON       Newton            accepted, or two steps without halving              end

A step fails if it is not finite, or if a pivot fails and the gap is not finite (`take_interior_point_step`).
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t
from libc.string cimport memset

from lavender_ext.core.block cimport euclidean_norm
from lavender_ext.core.block_types cimport CONE, COULOMB
from lavender_ext.core.validate cimport all_finite, norm_inf
from lavender_ext.judge.score cimport relative_residual
from lavender_ext.newton.active_set cimport begin_active_set
from lavender_ext.newton.cones cimport cone_gap, cone_size, has_lower_bound, has_upper_bound, load_cone_variable
from lavender_ext.newton.damped_newton cimport begin_damped_newton, push_damped_newton
from lavender_ext.newton.elements cimport elements_t, is_row
from lavender_ext.newton.run cimport (AUGMENTED_NEWTON, INTERIOR_POINT, INTERIOR_WITH_NEWTON, MAX_INNER_STEPS,
                                      N_AUGMENTED_INTERIOR, N_AUGMENTED_NEWTON, N_DE_SAXCE, N_INTERIOR,
                                      PLAN_COULOMB, augmented_newton_t, compute_slack, copy_vector, is_at_roundoff,
                                      is_budget_spent, is_finished, judge_and_keep_best_point, newton_t, pop_phase, progress_t,
                                      push_phase)
from lavender_ext.newton.steps cimport compute_all_normal_shifts, take_interior_point_step
from lavender_ext.newton.system cimport (BARRIER, NATURAL, evaluate_system_natural_map, factor_newton_system,
                                         multiply_system_matrix, solve_natural_map_system_refined, solve_newton_system,
                                         system_t)


cdef enum:
    MAX_INTERIOR_STEPS = 1000       # Limit of one convex interior point, whatever the budget.
    MAX_IDLE_INTERIOR_STEPS = 15    # An interior point ends if this many steps halve neither residual nor gap.
    MAX_STALLED_INTERIOR_STEPS = 3  # Below `roundoff_residual` an interior point ends if this many steps do not halve the residual.
    CERTIFICATE_REFINEMENTS = 3     # Solves of (1) with the same factor.
    MAX_CERTIFICATE_FACTORS = 4     # Factors of (1); each factor has fewer elements than the one before.
    CONE_END_FACTORISATIONS = 12    # Budget of the damped Newton phase that ends an interior point of cones.
    MAX_HYBRID_STEPS = 60           # Limit of an interior point with Newton trials; more steps rarely help.
    MAX_SHORT_STEPS = 4             # Such an interior point ends after this many short steps in a row: the path has turned back.
    TRIAL_INNER_STEPS = 2           # Newton steps of one attempt to end De Saxce's interior point.
    AUGMENTED_TRIAL_STEPS = 4       # Newton steps on the augmented system in one attempt.
    MAX_FAILED_AUGMENTED_STEPS = 2  # An attempt ends if this many steps in a row do not halve the residual.


cdef inline double roundoff_residual() noexcept nogil:
    """Return the relative residual below which rounding may stall an interior point."""
    return 1e-6


cdef inline double smallest_gap_ratio() noexcept nogil:
    """Return the gap, relative to its maximum, below which an interior point ends because rounding dominates its scaling."""
    return 1e-24


cdef inline double augmented_shift() noexcept nogil:
    """Return the shift of the augmented system's rows, relative to d. Squared singular values below it count as zero."""
    return 1e-14


# -- the convex law ----------------------------------------------------------------------------------------------------


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

        y <- y - (H + W)^-1 H y,   W z = u                                                                (1)

    with W of the last step. Elements with a z that does not exceed its dual u are fixed, and so are elements if y leaves their
    bounds.
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


cdef inline double compute_fraction_near_sliding(const elements_t* e, const double* z) noexcept nogil:
    """Return the fraction of the loaded contacts with a friction component of at least 0.95 of its bound at z."""
    cdef double load = 0.0
    cdef int32_t i, j, g, contacts = 0, loaded = 0, near = 0
    cdef bint is_near
    for i in range(e.n):
        if not is_row(e, i):
            contacts += 1
            load += z[e.ptr[i]]
    for i in range(e.n):
        j = e.ptr[i]
        if not is_row(e, i) and z[j] * contacts > 1e-3 * load:
            is_near = False
            for g in range(e.part[i], e.part[i + 1]):
                is_near = is_near or euclidean_norm(z + e.first[g], e.size[g]) > 0.95 * e.reach[g] * z[j]
            loaded += 1
            near += is_near
    return <double>near / loaded if loaded else 1.0


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
            # Contacts whose normals shift by 1e-2 of the largest entry of g slide fast: up to 2 % of piles that Euler steps from
            # here solve, 15 % and more of balls in motion. At larger residuals, contacts that will stick count, too.
            if residual < 0.03 and not k.is_counted:
                k.is_counted = 1
                n.mostly_slides = compute_sliding_fraction(n, n.ip.z, 1e-2) > 0.1
            if n.mostly_slides or (residual < 1e-5 and residual < 0.01 * judge_and_keep_best_point(n, n.ip.z)):
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


# -- with Newton trials ------------------------------------------------------------------------------------------------


cdef inline void begin_interior_with_newton(newton_t* n, int32_t augmented) noexcept nogil:
    """Begin steps of De Saxce's interior point, or of the augmented one, with attempts to finish by Newton steps."""
    reset_interior_progress(n, 1e-5 if augmented else 1e-3)
    n.progress.augmented = augmented
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
        n.counts[N_AUGMENTED_INTERIOR if k.augmented else N_DE_SAXCE] += 1
        residual = judge_and_keep_best_point(n, n.ip.z)
        k.idle = 0 if residual < 0.5 * k.lowest else k.idle + 1
        if residual < k.lowest:
            k.lowest = residual
            copy_vector(n, k.best_z, n.ip.z)
        if residual < k.trial_residual and not is_finished(n):
            k.trial_residual = 0.1 * residual
            k.trial_runs = 1
            if k.augmented:
                copy_vector(n, n.augmented.z, n.ip.z)
                n.augmented.best, n.augmented.failed, n.augmented.steps_left = residual, 0, AUGMENTED_TRIAL_STEPS
                push_phase(n, AUGMENTED_NEWTON)
            else:
                begin_damped_newton(n, n.ip.z, COULOMB, residual, TRIAL_INNER_STEPS)
                push_damped_newton(n, 1)
            return
    else:
        k.trial_runs = 0
        if is_at_roundoff(n):
            pop_phase(n)
            return
    k.stalled = k.stalled + 1 if n.ip.length < 0.05 else 0      # short steps
    if (k.stalled >= MAX_SHORT_STEPS or (k.idle > MAX_IDLE_INTERIOR_STEPS and k.lowest < 1e-5)
            or n.ip.gap < smallest_gap_ratio() * n.ip.max_gap):
        pop_phase(n)


cdef inline void step_augmented_newton(newton_t* n) noexcept nogil:
    """Take a Newton step on the augmented system. End the phase if the judge accepts or steps do not lower the residual."""
    cdef augmented_newton_t* x = &n.augmented
    cdef int32_t j, law = COULOMB if n.problem.p.law == COULOMB else CONE
    cdef double residual
    if x.steps_left == 0 or is_finished(n):
        pop_phase(n)
        return
    x.steps_left -= 1
    n.s.augmented = 1
    compute_slack(n, x.z, n.slack)
    evaluate_system_natural_map(&n.s, x.z, n.slack, law, augmented_shift(), n.f)
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
