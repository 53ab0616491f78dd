"""Error of an engine's acceleration in one world: (1) of lavender/io/engine_motion.py, without the interpreter.

With the exact impulses lambda, the engine's own impulses f and velocity change c, and u = 2^-53, row i has

    error [m/s]      J_i (c - M^-1 J^T lambda)                                                                     (1)
    rounding [m/s]   u (|J_i| (|c| + 2 |v*|) + |b_i| + R_i |f_i|) + the error of lambda itself                     (2)

Both are measured by E and V, divided by the weight sqrt(nu d) of the row (`measure_error` of judge/measure.pyx).
"""
from libc.math cimport INFINITY, fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.arena cimport arena_t, has_memory, make_arena, take_doubles
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.generalized cimport (multiply_jacobian_row, multiply_jacobian_transpose,
                                            solve_mass_matrix)
from lavender_ext.core.method cimport workspace_t
from lavender_ext.core.validate cimport all_finite
from lavender_ext.judge.score cimport make_empty_score, relative_residual, score_t, unit_roundoff
from lavender_ext.judge.tally cimport (add_block_error, add_island_to_score, get_block_in_order, index_of_island_begin,
                                       index_of_island_end, make_empty_tally, tally_t)
from lavender_ext.small.task cimport MORE, grow_workspace_to_arena, task_t


cdef struct motion_t:           # an engine's step
    const double* impulse       # (m) N s
    const double* change        # (n) m/s, dt (a - a0)
    const double* compliance    # (m) 1/kg


cdef struct motion_error_t:
    double energy, velocity, relative, floor, above_floor
    double push                 # N s, |e| of the worst row
    int32_t worst


cdef inline void measure_row_errors(const blocks_t* p, const double* zero, const double* e, double* by_island,
                                    tally_t* total) noexcept nogil:
    """Measure errors e (m) [N s] of all rows, and the relative residual of each island in by_island (2 n)."""
    cdef score_t score = make_empty_score()
    cdef tally_t t
    cdef int32_t i, a, n = p.islands.n if p.islands != NULL else 1
    total[0] = make_empty_tally()
    score.by_island = by_island
    for i in range(n):
        t = make_empty_tally()
        for a in range(index_of_island_begin(p, i), index_of_island_end(p, i)):
            add_block_error(p, get_block_in_order(p.islands.order if p.islands != NULL else NULL, a), e, &t)
        add_island_to_score(p, i, e, e, &t, NULL, total, &score)
    if p.islands == NULL:
        by_island[0] = relative_residual(sqrt(total.energy), sqrt(total.fast) if total.fast > 0.0 else 0.0,
                                         zero[0], zero[1])


cdef inline bint judge_motion(task_t* j, const double* free, const motion_t* x, double max_stiff_ratio,
                              double max_excused, workspace_t* workspaces, motion_error_t* out) noexcept nogil:
    """Judge a motion by the exact impulses j.lam, which `judge_task` has judged; free (n) is v*.

    Returns False if rows are so stiff that forces have no digits, or without memory; the caller then judges the world alone.
    """
    cdef const blocks_t* p = &j.v.p
    cdef int32_t m = p.n_rows, n = j.g.n, i, q, k, _pass, islands = p.islands.n if p.islands != NULL else 1, at = 0
    cdef arena_t arena = make_arena(NULL, NULL)
    cdef double* delta
    cdef double* moved
    cdef double* e
    cdef double* r
    cdef double* own
    cdef double* rounds
    cdef double terms, weight
    cdef tally_t total, of_rounding
    for _pass in range(2):                              # The first pass counts the numbers.
        delta, moved, e, r = (take_doubles(&arena, n), take_doubles(&arena, n), take_doubles(&arena, m),
                              take_doubles(&arena, m))
        own, rounds = take_doubles(&arena, 2 * islands), take_doubles(&arena, 2 * islands)
        if not has_memory(&arena) and not grow_workspace_to_arena(&workspaces[MORE], &arena):
            return False
    if not (all_finite(x.impulse, m) and all_finite(x.change, n)):
        return False
    for i in range(m):
        if x.compliance[i] > 0.0 and p.d[i] > 0.0 and x.compliance[i] / p.d[i] <= max_stiff_ratio:
            return False
    multiply_jacobian_transpose(&j.g, j.lam, delta)
    solve_mass_matrix(&j.g, delta)
    for k in range(n):
        delta[k] = x.change[k] - delta[k]
        moved[k] = fabs(x.change[k]) + 2.0 * fabs(free[k])
    for i in range(m):
        terms = 0.0
        for q in range(j.g.jptr[i], j.g.jptr[i + 1]):
            terms += fabs(j.g.jval[q]) * moved[j.g.jidx[q]]
        terms = (terms + fabs(p.b[i])) + x.compliance[i] * fabs(x.impulse[i])
        weight = sqrt(p.nu[i]) * sqrt(p.d[i])
        r[i] = unit_roundoff() * terms + weight * fabs(j.slack_error[m + i])
        e[i] = multiply_jacobian_row(&j.g, i, delta)
        weight = weight if weight > 0.0 else INFINITY
        e[i] /= weight
        r[i] /= weight
    measure_row_errors(p, j.zero_residual, e, own, &total)
    measure_row_errors(p, j.zero_residual, r, rounds, &of_rounding)
    out.above_floor = 0.0
    for i in range(islands):
        if own[2 * i] > own[2 * at]:
            at = i
        if not (own[2 * i] <= 2.0 * rounds[2 * i] < INFINITY and own[2 * i] <= max_excused):
            out.above_floor = max(out.above_floor, own[2 * i])
    out.energy, out.velocity = sqrt(total.energy), sqrt(total.fast) if total.fast > 0.0 else 0.0
    out.relative, out.floor, out.worst = own[2 * at], rounds[2 * at], total.worst
    out.push = fabs(e[total.worst]) if total.worst >= 0 else 0.0
    return True
