"""Coulomb's law as a sequence of convex problems: proximal Newton steps with De Saxce's shift held during each problem.

    F(z) = z - Pi_K(c - (H z - g + phi) / eps) = 0,   Pi_K of the convex law                          (1)

Its solution is a proximal step of weight eps from the centre c on the problem whose normals are lowered by the shift phi
(steps.pxd (1)). H F is the gradient of a convex function of z, z^T H z / 2 + eps |Pi_K(.)|^2 / 2 (Castro, Permenter, Han 2022
minimise it for compliant contacts), so that

    (I + P H / eps) dz = -F,   P the derivative of Pi_K,     t with H dz . F(z + t dz) = 0             (2)

needs a symmetric factor over bodies, and the line search is exact. When |F| in the norm of H is at most the change of c
and phi by the last update,

    c <- Pi_K(.),   phi <- phi(s_t),   s = H z - g                                                      (3)

(Cadoux 2009). At a fixed point of (3), c solves Coulomb's law for every eps. Updates that keep their direction and fall
slowly, as when bodies slide to another contact state, are extrapolated by heavy-ball momentum.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t
from libc.string cimport memset

from lavender_ext.core.block_types cimport CONE, COULOMB
from lavender_ext.core.dot cimport dot
from lavender_ext.core.validate cimport all_finite
from lavender_ext.newton.elements cimport elements_t, invert_and_multiply
from lavender_ext.core.line_search cimport begin_line_search, line_t, narrow_line_search
from lavender_ext.newton.natural_map cimport evaluate_all_natural_maps
from lavender_ext.newton.damped_newton cimport begin_damped_newton, push_damped_newton
from lavender_ext.newton.run cimport (N_SHIFTED, SHIFTED_NEWTON, convex_residual, copy_vector, is_finished,
                                      judge_and_keep_best_point, newton_t, pop_phase, push_phase, shifted_t)
from lavender_ext.newton.steps cimport compute_all_normal_shifts
from lavender_ext.newton.system cimport (NATURAL, factor_newton_system, multiply_system_matrix, solve_natural_map_system)


cdef enum:
    MAX_SHIFTED_STEPS = 20      # Newton steps (2) of one problem (1).
    MANY_SHIFTED_STEPS = 12     # eps doubles if (1) takes this many steps.
    TRIAL_FACTORISATIONS = 4    # Budget of damped Newton under Coulomb's law, at each decade of the residual.
    MAX_FREE_UPDATES = 50       # The phase ends after this many updates (3) in a row without a factorisation.
    SHIFTED_PATIENCE = 200      # The phase ends if so many factorisations do not halve the change (3).
    SLOW_UPDATES = 5            # Momentum begins if this many updates lower the change of phi by less than `slow_ratio`.


cdef inline double first_weight() noexcept nogil:
    """Return the first eps, relative to d; 1e-1 needs more updates (3), 1e-3 more steps (2) of each."""
    return 1e-2


cdef inline double slow_ratio() noexcept nogil:
    """Return the ratio of the change of phi to its value `SLOW_UPDATES` earlier above which momentum is added."""
    return 0.7


cdef inline double momentum() noexcept nogil:
    """Return the fraction of the last update that momentum repeats; 0.95 overshoots, 0.5 is slower on pyramids and walls."""
    return 0.8


cdef inline void begin_shifted_newton(newton_t* n, const double* z, int32_t limit) noexcept nogil:
    """Begin at z, with its own shift if it is closer to a solution of Coulomb's law than to one of the convex law.

    The phase ends after `limit` factorisations, or if SHIFTED_PATIENCE of them do not halve the change (3).
    """
    cdef shifted_t* x = &n.shifted
    cdef int32_t j, m = n.s.e.m
    copy_vector(n, x.z, z)
    copy_vector(n, x.centre, z)
    multiply_system_matrix(&n.s, x.z, x.hz)
    memset(x.shift, 0, m * sizeof(double))
    memset(x.step, 0, m * sizeof(double))
    memset(x.centre_step, 0, m * sizeof(double))
    if judge_and_keep_best_point(n, z) < convex_residual(n, z, x.hz):
        for j in range(m):
            n.slack[j] = x.hz[j] - n.s.e.g[j]
        compute_all_normal_shifts(n.s.e, n.slack, 0.0, x.shift, n.psi)
    x.eps = first_weight()
    x.tolerance = 1e-9 * sqrt(dot(n.s.e.g, n.s.e.g, m))
    x.lowest = 1.0 / 0.0
    x.trial_residual = 1e-2
    x.inner_steps = x.free_updates = x.updates = 0
    x.since, x.last = n.s.factorisations, n.s.factorisations + limit
    push_phase(n, SHIFTED_NEWTON)


cdef inline void evaluate_shifted_map(newton_t* n, double t, bint derived) noexcept nogil:
    """Compute F of (1) at z + t dz into n.r and Pi_K(.) into n.t1; with `derived` also the matrices of (2), P / eps, in n.s."""
    cdef shifted_t* x = &n.shifted
    cdef const elements_t* e = n.s.e
    cdef int32_t i, j, k, l, q, nr
    cdef double a[36]
    for j in range(e.m):
        n.trial[j] = x.centre[j] - (x.hz[j] + (t * n.hdz[j] if t != 0.0 else 0.0) - e.g[j] + x.shift[j]) / x.eps
    memset(n.slack, 0, e.m * sizeof(double))
    evaluate_all_natural_maps(e, n.trial, n.slack, CONE, 0.0, n.f, n.s.p, n.s.einv, NULL)
    for j in range(e.m):
        n.t1[j] = n.trial[j] - n.f[j]
        n.r[j] = x.z[j] + (t * n.dz[j] if t != 0.0 else 0.0) - n.t1[j]
    if not derived:
        return
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        q = e.wptr[i]
        for k in range(nr):
            for l in range(nr):
                n.s.p[q + k * nr + l] /= x.eps
                a[k * nr + l] = n.s.p[q + k * nr + l] * e.theta[j + l]
            a[k * nr + k] += 1.0
        invert_and_multiply(a, n.s.p + q, n.s.einv + q, n.s.v + q, nr)


cdef inline bint update_shift(newton_t* n) noexcept nogil:
    """Update centre and shift by (3) from the solution of (1) in n.t1; return False if the phase ends."""
    cdef shifted_t* x = &n.shifted
    cdef int32_t j, m = n.s.e.m
    cdef double residual, by_shift = 0.0, by_centre = 0.0, along = 0.0, change, factor = 0.0, y
    residual = judge_and_keep_best_point(n, n.t1)
    x.updates += 1
    x.free_updates = x.free_updates + 1 if x.inner_steps == 0 else 0
    if is_finished(n) or x.free_updates > MAX_FREE_UPDATES:
        return False
    for j in range(m):
        n.slack[j] = x.hz[j] - n.s.e.g[j]
    compute_all_normal_shifts(n.s.e, n.slack, 0.0, n.t2, n.psi)
    for j in range(m):
        n.t2[j] -= x.shift[j]
        by_shift += n.t2[j] * n.t2[j]
        along += n.t2[j] * x.step[j]
        y = n.t1[j] - x.centre[j]
        by_centre += y * y
    by_shift, by_centre = sqrt(by_shift), x.eps * sqrt(by_centre)
    change = sqrt(by_shift * by_shift + by_centre * by_centre)
    if not change < 1.0 / 0.0:
        return False
    if change < 0.5 * x.lowest:
        x.lowest, x.since = change, n.s.factorisations
    elif n.s.factorisations - x.since > SHIFTED_PATIENCE:
        return False
    # Momentum on updates that are slow and keep their direction.
    if x.updates > SLOW_UPDATES and along > 0.0 and by_shift > slow_ratio() * x.history[x.updates % SLOW_UPDATES]:
        factor = momentum()
    x.history[x.updates % SLOW_UPDATES] = by_shift
    for j in range(m):
        x.step[j] = n.t2[j] + factor * x.step[j]
        y = x.shift[j] + x.step[j]
        x.shift[j] = y if y > 0.0 else 0.0
        x.centre_step[j] = n.t1[j] - x.centre[j] + factor * x.centre_step[j]
        x.next[j] = x.centre[j] + x.centre_step[j]
    if factor > 0.0:
        memset(n.slack, 0, m * sizeof(double))
        evaluate_all_natural_maps(n.s.e, x.next, n.slack, CONE, 0.0, n.f, n.s.p, n.s.einv, NULL)
        for j in range(m):
            x.next[j] -= n.f[j]
    copy_vector(n, x.centre, x.next)
    x.tolerance = change
    if x.inner_steps >= MANY_SHIFTED_STEPS:
        x.eps = 2.0 * x.eps if x.eps < 0.05 else 0.1
    elif by_centre > 4.0 * by_shift:        # The proximal step lags; an earlier reduction makes piles diverge.
        x.eps = 0.5 * x.eps if x.eps > 2e-4 else 1e-4
    x.inner_steps = 0
    multiply_system_matrix(&n.s, x.z, x.hz)
    if residual < x.trial_residual:
        x.trial_residual = 0.1 * residual
        begin_damped_newton(n, n.t1, COULOMB, 1e-7, TRIAL_FACTORISATIONS)
        push_damped_newton(n, TRIAL_FACTORISATIONS)
    return True


cdef inline double find_line_minimum(newton_t* n, double slope) noexcept nogil:
    """Return t of (2) to a tenth of the slope at t = 0."""
    cdef line_t line
    begin_line_search(&line, slope)
    while True:
        evaluate_shifted_map(n, line.t, False)
        if narrow_line_search(&line, dot(n.hdz, n.r, n.s.e.m)):
            return line.t


cdef inline void step_shifted_newton(newton_t* n) noexcept nogil:
    """Take a Newton step (2), after updates (3) if (1) is solved."""
    cdef shifted_t* x = &n.shifted
    cdef int32_t j, m = n.s.e.m
    cdef double size, slope, t
    if is_finished(n) or n.s.factorisations >= x.last:
        pop_phase(n)
        return
    evaluate_shifted_map(n, 0.0, False)
    multiply_system_matrix(&n.s, n.r, n.hdz)
    size = dot(n.r, n.hdz, m)
    if not size > x.tolerance * x.tolerance or x.inner_steps >= MAX_SHIFTED_STEPS:
        if not update_shift(n):
            pop_phase(n)
        return
    evaluate_shifted_map(n, 0.0, True)
    n.s.law = CONE
    factor_newton_system(&n.s, NATURAL, 1.0)
    n.counts[N_SHIFTED] += 1
    x.inner_steps += 1
    for j in range(m):
        n.r[j] = -n.r[j]
    solve_natural_map_system(&n.s, n.r, n.dz)
    multiply_system_matrix(&n.s, n.dz, n.hdz)
    slope = -dot(n.hdz, n.r, m)
    if not all_finite(n.dz, m):
        pop_phase(n)
        return
    t = find_line_minimum(n, slope)
    for j in range(m):
        x.z[j] += t * n.dz[j]
        x.hz[j] += t * n.hdz[j]
