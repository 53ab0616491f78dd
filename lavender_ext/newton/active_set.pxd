"""Active-set exchanges on bounded rows: Newton's method on the natural map.

    F(z) = z - Pi(z - (H z - g)) = 0,   (I - P + P H) dz = -F                                                 (1)

An exchange solves the rows inside their bounds; rows with the wrong sign then change their active bound. This is the
primal-dual active set method (Qi, Sun 1993; Hintermueller, Ito, Kunisch 2002). If rows depend on each other it may
cycle. It ends if the contraction of the number of rows c_k that change their bound predicts more steps than an interior
point takes, or if c_k does not fall:

    k log(c_k) / log(c_0 / c_k)         exchanges left after the k-th                                         (2)

    state              event                                                                next
    exchange           the judge accepts, no row changes and the residual does not halve    end
                       (2) is too large, c_k has stalled, z is not finite, no budget        end
                       else                                                                 exchange

The step has the length 1. The weight eps keeps the matrix regular if a row depends on others; a z that is not finite, as
without a factor (system.pxd), ends the phase.
"""
from libc.stdint cimport int32_t

from lavender_ext.core.block_projection cimport classify_active_bound
from lavender_ext.core.block_types cimport CONE
from lavender_ext.core.validate cimport all_finite
from lavender_ext.newton.elements cimport elements_t
from lavender_ext.newton.run cimport (ACTIVE_SET, N_ACTIVE_SET, UNLIMITED, active_set_t, convex_residual, copy_vector,
                                      is_at_roundoff, is_finished, judge_and_keep_best_point, newton_t, pop_phase, push_phase)
from lavender_ext.newton.system cimport (NATURAL, evaluate_system_natural_map, factor_newton_system, multiply_system_matrix,
                                         solve_natural_map_system_refined)


cdef enum:
    TYPICAL_INTERIOR_STEPS = 12     # Exchanges end if (2) predicts more steps than an interior point usually takes.
    MAX_STALLED_EXCHANGES = 4       # Exchanges end if this many in a row do not lower the number of rows that change their bound.


cdef inline double exchange_weight() noexcept nogil:
    """Return the weight eps in the matrix of an exchange. It keeps dependent rows solvable; refinement removes its effect."""
    return 1e-9


cdef inline int32_t store_active_bounds(active_set_t* x, const elements_t* e) noexcept nogil:
    """Store the bound that is active on each row, -1, 0 or 1; return the number of rows whose bound has changed."""
    cdef int32_t j, bound, changed = 0
    for j in range(e.m):
        bound = classify_active_bound(x.z[j] - x.hz[j] + e.g[j], e.lower[j], e.upper[j])
        changed += bound != x.bound[j]
        x.bound[j] = bound
    return changed


cdef inline void begin_active_set(newton_t* n, const double* z) noexcept nogil:
    """Begin exchanges from z."""
    cdef active_set_t* x = &n.active
    copy_vector(n, x.z, z)
    copy_vector(n, x.best_z, z)
    multiply_system_matrix(&n.s, x.z, x.hz)
    x.best = convex_residual(n, x.z, x.hz)
    store_active_bounds(x, n.s.e)
    x.is_scored = x.first_changes = x.exchanges = x.stalled = 0
    x.fewest_changes = UNLIMITED
    push_phase(n, ACTIVE_SET)


cdef inline bint predicts_too_many_exchanges(int32_t first, int32_t now, int32_t exchanges) noexcept nogil:
    """Return whether (2) predicts more exchanges than an interior point takes steps."""
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
    """Make one exchange. End the phase if the judge accepts, no row changes, or (2) predicts too many exchanges."""
    cdef active_set_t* x = &n.active
    cdef double residual
    cdef int32_t changed, j
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
    for j in range(n.s.e.m):
        n.slack[j] = x.hz[j] - n.s.e.g[j]
    evaluate_system_natural_map(&n.s, x.z, n.slack, CONE, exchange_weight(), n.f)
    factor_newton_system(&n.s, NATURAL, exchange_weight())
    for j in range(n.s.e.m):
        n.f[j] = -n.f[j]
    solve_natural_map_system_refined(&n.s, n.f, n.dz, n.r, n.da)
    if not all_finite(n.dz, n.s.e.m):
        end_active_set(n)
        return
    for j in range(n.s.e.m):
        x.z[j] += n.dz[j]
    multiply_system_matrix(&n.s, x.z, x.hz)
    residual = convex_residual(n, x.z, x.hz)
    gains = residual < 0.5 * x.best
    if residual < x.best:
        x.best, x.is_scored = residual, 0
        copy_vector(n, x.best_z, x.z)
    changed = store_active_bounds(x, n.s.e)
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
