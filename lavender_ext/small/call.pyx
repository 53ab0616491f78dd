"""Problems with few rows over bodies or A, and islands with few rows: check the start, solve and judge in one call.

    bounded rows   factorisation of A, linear or with bounds, a shift if A is singular, refinement   (pivot/direct.pyx);
                   if exchanges are stuck and another method follows, Lemke's path                   (pivot/lemke.pyx)
    friction       accelerated sweeps, then Newton's method if these are slow                        (friction.pxd)

Under friction a subproblem is the whole problem, or each island in turn. An island's data is copied out of A or the bodies, and
it is solved to its own relative residual (judge/score.pxd). An island with data identical to the previous one reuses its
result. If the judge's relative residual is above tol, the call returns no result and the caller starts the general solver.
"""
from cpython.exc cimport PyErr_CheckSignals
from libc.math cimport INFINITY, NAN
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcmp, memcpy, memset

from lavender_ext.core.arena cimport arena_t, make_arena, take_doubles, take_integers
from lavender_ext.core.deadline cimport has_passed
from lavender_ext.core.csr cimport measure_asymmetry_and_bandwidth
from lavender_ext.core.block_types cimport CONE, CONTACT_ROLLING, ROUND, blocks_t, has_independent_rows, islands_t
from lavender_ext.core.method cimport workspace_t
from lavender_ext.core.view cimport csr_t
from lavender_ext.small.friction cimport FACTORISATIONS, SUBPROBLEMS, SWEEPS, solve_subproblem, subproblem_work_size
from lavender_ext.small.island cimport are_islands_identical, copy_island, island_index_t, island_t
from lavender_ext.small.limits cimport has_only_free_rows
from lavender_ext.host cimport grow_workspace_to
from lavender_ext.small.task cimport (MORE, N_COUNTS, RESULT_FAILED, RESULT_IS_START, RESULT_SOLVED, WORK, count_task_scratch,
                                      fits_workspace, grow_workspace_to_arena, small_rules_t, task_t)
from lavender_ext.judge.bounds cimport project_far_excess, project_on_bounds
from lavender_ext.judge.measure cimport (choose_start, count_start_scratch, judge_view, refine_reported_view,
                                         relative_floor_of_score, relative_residual_of_score, residual_above_floor,
                                         score_given_generalized_slack, set_zero_impulse)
from lavender_ext.judge.score cimport make_empty_score
from lavender_ext.judge.slack cimport compute_generalized_slack
from lavender_ext.local.gauss_seidel cimport prepare_exact_blocks, index_prepared_numbers
from lavender_ext.pivot.direct cimport (PASS, PASS_HALVED, begin_direct_solve, bind_direct_arrays, direct_t,
                                        is_solved_to_rounding, step_direct_solve)
from lavender_ext.pivot.lemke cimport EXCHANGES, RAY, begin_lemke_solve, bind_lemke_arrays, follow_lemke_paths, lemke_t
from lavender_ext.pivot.principal cimport SMALL_PIVOT


cdef enum:
    ACTIVE_SET_SWEEPS = 2       # number of sweeps that predict which rows are free
    MAX_PASS_EXCHANGES = 32     # largest number of rounds of exchanges in one pass
    LEMKE_PIVOTS_PER_ROW = 8    # largest number of pivots of Lemke's paths, per row
    INTERRUPT_CHECK_WORK = 5000000      # multiply-adds between two checks for Ctrl-C, a few milliseconds
    ISLAND_ROW_DOUBLES = 33     # Doubles of a copied island per row, if all are rows of joints: 8, J, M^-1 J^T and the result,
    ISLAND_BLOCK_DOUBLES = 40   # and per block, if every block is a contact between two bodies that no other block has.


cdef bint are_all_rows_bounded(const blocks_t* p) noexcept nogil:
    """Return whether every row has fixed bounds only, so that there is no friction."""
    cdef int32_t i
    for i in range(p.n_blocks):
        if not has_independent_rows(p, i) and p.ptr[i + 1] - p.ptr[i] > 1:
            return False
    return True


cdef bint derive_small_problem(task_t* j, workspace_t* workspace) noexcept nogil:
    """Compute the remaining fields of a small problem in `workspace`, which must stay allocated; return False without memory.

    The views and the residual of the zero impulse are given.
    """
    cdef const blocks_t* p = &j.v.p
    cdef int32_t band[2]
    cdef int64_t n
    j.pivots, j.linear, j.at, j.prepared = are_all_rows_bounded(p), has_only_free_rows(p), NULL, NULL
    j.split = j.v.r.n_joints if j.v.r != NULL else 0
    if not grow_workspace_to(workspace, p.n_blocks + 1 + p.n_rows, 0):
        return False
    if j.pivots:
        j.symmetric = measure_asymmetry_and_bandwidth(j.over.a, j.over.p.d, p.n_rows, workspace.index, band) <= 1e-14
        j.band = max(band[0], band[1]) if j.symmetric else p.n_rows - 1
    elif p.law == CONE or j.v.a != NULL:                # The units of a given matrix may differ within a contact.
        n = <int64_t>index_prepared_numbers(p, workspace.index) + 1
        if not grow_workspace_to(workspace, 0, n):
            return False
        memset(workspace.real, 0, n * sizeof(double))
        prepare_exact_blocks(&j.v, workspace.index, workspace.real)
        j.at, j.prepared = workspace.index, workspace.real
    return True


cdef bint can_use_small_call(const blocks_t* p) noexcept nogil:
    """Return whether this solver supports every block: no round cones, no rolling friction."""
    cdef int32_t i
    for i in range(p.n_blocks):
        if p.kind[i] == ROUND or p.kind[i] == CONTACT_ROLLING:
            return False
    return True


cdef void judge_task(task_t* j, double* scratch) noexcept nogil:
    """Judge lam, refined for tol; scratch (`count_task_scratch`) begins with M^-1 J^T lam over J and M, which is `push`."""
    cdef int32_t m = j.v.p.n_rows
    cdef double* w = j.slack_error
    cdef double e0 = j.zero_residual[0], v0 = j.zero_residual[1]
    j.score = make_empty_score()
    j.score.by_island = j.by_island
    j.push = scratch
    if j.v.g != NULL:
        scratch += j.v.g.n
        compute_generalized_slack(&j.v.p, j.v.g, j.lam, scratch - j.v.g.n, w)
        score_given_generalized_slack(&j.v.p, j.v.g, j.lam, w, w + m, scratch, &j.score)
    else:
        judge_view(&j.v, j.lam, w, w + m, scratch, True, &j.score)
    j.float64_relative = NAN
    j.relative = relative_residual_of_score(&j.score, w, m, e0, v0)
    if refine_reported_view(&j.v, j.lam, w, w + m, scratch, e0, v0, j.tol, j.relative, &j.score):
        j.float64_relative = j.relative
        j.relative = relative_residual_of_score(&j.score, w, m, e0, v0)
    j.floor = relative_floor_of_score(&j.score, e0, v0)
    j.above_floor = residual_above_floor(&j.score, j.relative, j.floor)
    j.solved = j.relative <= j.tol and j.floor <= j.tol


cdef void judge_task_within_bounds(task_t* j, double* scratch) noexcept nogil:
    """Judge lam after its projection (`project_far_excess`), unless that breaks tol; scratch: m more."""
    cdef int32_t m = j.v.p.n_rows
    cdef bint is_met
    judge_task(j, scratch + m)
    is_met = j.relative <= j.tol
    if project_far_excess(&j.v.p, j.lam, scratch):
        judge_task(j, scratch + m)
        if is_met and not j.relative <= j.tol:
            memcpy(j.lam, scratch, m * sizeof(double))
            judge_task(j, scratch + m)


cdef inline int32_t run_lemke_paths(direct_t* t, double tol, workspace_t* workspace) noexcept nogil:
    """Follow Lemke's paths after stuck exchanges, with exchanges at the end of each.

    Returns the number of pivots, -1 if the residual is above tol.
    """
    cdef lemke_t l
    cdef arena_t arena = make_arena(workspace.real, workspace.index)
    cdef int32_t limit = LEMKE_PIVOTS_PER_ROW * t.s.n, code = RAY
    bind_lemke_arrays(&l, t, &arena)
    if not fits_workspace(workspace, &arena):
        if not grow_workspace_to_arena(workspace, &arena):
            return -1
        bind_lemke_arrays(&l, t, &arena)
    begin_lemke_solve(&l)
    while code == RAY or code == EXCHANGES:
        code = follow_lemke_paths(&l, limit - l.n_pivots)
    return l.n_pivots if t.relative <= tol else -1


cdef bint solve_by_pivoting(task_t* j, bint follows, workspace_t* workspaces) noexcept nogil:
    """Solve free or bounded rows by factorisations and exchanges; return whether there is a result.

    j.counts receives (rounds plus pivots of Lemke's paths, 1 if swept, refinements, factorisations, exchanged rows, shifts, rank
    of a singular linear system or 0, pivots of Lemke's paths). If another method follows, a result below tol is accepted even if
    it is not exact to rounding, and Lemke's paths are followed if exchanges are stuck.
    """
    cdef direct_t t
    cdef arena_t arena = make_arena(workspaces[WORK].real, workspaces[WORK].index)
    cdef int32_t code, path = 0
    cdef bint ended
    t.v, t.e0, t.v0, t.least = j.v, j.zero_residual[0], j.zero_residual[1], 1e-13
    t.linear, t.symmetric, t.sweeps = j.linear, j.symmetric, ACTIVE_SET_SWEEPS
    t.s.a, t.s.p, t.s.band, t.s.order, t.s.linear.tiny = j.over.a, &j.over.p, j.band, NULL, 1e-13
    t.s.deadline, t.s.late = j.deadline, 0
    bind_direct_arrays(&t, &arena)
    if not fits_workspace(&workspaces[WORK], &arena):
        if not grow_workspace_to_arena(&workspaces[WORK], &arena):
            return False
        bind_direct_arrays(&t, &arena)
    # exchanges; passes with a shifted matrix follow if A is singular, until one does not halve the residual or is stuck
    begin_direct_solve(&t, j.lam)
    code = step_direct_solve(&t, MAX_PASS_EXCHANGES)
    if t.symmetric and t.state == PASS and (code == SMALL_PIVOT or t.linear):
        code = PASS_HALVED
        while code == PASS_HALVED and not t.s.late:
            code = step_direct_solve(&t, MAX_PASS_EXCHANGES)
            if not t.relative < INFINITY:
                break
    # With another method, solved bounded rows need not be refined to rounding.
    ended = t.relative <= j.tol and (is_solved_to_rounding(&t) or (follows and t.solved and not t.linear))
    # Lemke's paths
    if not ended and not has_passed(j.deadline, 0.0):
        path = run_lemke_paths(&t, j.tol, &workspaces[MORE]) if follows and not t.linear and not t.solved else -1
    if not ended:
        ended = (path >= 0 and t.relative <= j.tol) or (has_passed(j.deadline, 0.0) and t.relative < INFINITY)
    if ended:
        memcpy(j.lam, t.best, t.s.n * sizeof(double))
    path = max(path, 0)
    j.counts[0], j.counts[1], j.counts[2], j.counts[3] = t.s.n_rounds + path, t.swept != 0, t.refined, t.s.factorisations
    j.counts[4], j.counts[5], j.counts[6], j.counts[7] = t.s.exchanged, t.shifts, t.rank, path
    return ended


cdef bint solve_by_islands(task_t* j, const small_rules_t* rules, workspace_t* workspaces) except -1 nogil:
    """Solve contacts island by island from lam, until one is above tol; j.counts as in `solve_subproblem`."""
    cdef const blocks_t* p = &j.v.p
    cdef const islands_t* islands = j.v.p.islands
    cdef const csr_t* a = j.v.a
    cdef workspace_t* r = &workspaces[WORK]
    cdef int32_t i, c, q, rows, sweeps, m = 0, k = 0, n_bodies = j.v.r.n_bodies if a == NULL else 0
    cdef int64_t entries = 0, count, numbers, integers, work
    cdef double unchecked = 0.0
    cdef int32_t before[N_COUNTS]
    cdef island_index_t z
    cdef arena_t arena
    cdef const int32_t* block
    cdef int32_t* at
    cdef int32_t* order
    cdef double* scratch
    cdef island_t two[2]
    cdef island_t* x
    cdef bint good = True
    j.counts[SUBPROBLEMS] = islands.n
    # workspace of the largest island
    for i in range(islands.n):
        rows = count = 0
        for c in range(islands.ptr[i], islands.ptr[i + 1]):
            q = islands.order[c]
            rows += p.ptr[q + 1] - p.ptr[q]
            count += a.indptr[p.ptr[q + 1]] - a.indptr[p.ptr[q]] if a != NULL else 0
        m, k, entries = max(m, rows), max(k, islands.ptr[i + 1] - islands.ptr[i]), max(entries, count)
    numbers, integers = ISLAND_ROW_DOUBLES * m + ISLAND_BLOCK_DOUBLES * k + entries, m + 4 * k + 2 + entries
    work = subproblem_work_size(m, min(2 * k, n_bodies))
    if not grow_workspace_to(r, 2 * integers + m + p.n_rows + 5 * k + n_bodies, 2 * numbers + work):
        return False
    arena = make_arena(r.real, r.index)
    z.row, z.place = take_integers(&arena, m), take_integers(&arena, p.n_rows)
    z.contact, z.body, z.number = take_integers(&arena, k), take_integers(&arena, 2 * k), take_integers(&arena, n_bodies)
    order, at, scratch = take_integers(&arena, k), take_integers(&arena, k), take_doubles(&arena, work)
    memset(z.place, 255, p.n_rows * sizeof(int32_t))    # -1
    memset(z.number, 255, n_bodies * sizeof(int32_t))
    for i in range(islands.n):
        # copy of the island
        block, k, x = islands.order + islands.ptr[i], islands.ptr[i + 1] - islands.ptr[i], &two[i % 2]
        copy_island(x, &j.v, j.lam, block, k, &z, make_arena(arena.real + arena.n_real + (i % 2) * numbers,
                                                                arena.index + arena.n_index + (i % 2) * integers))
        m = x.s.v.p.n_rows
        # solution
        if i > 0 and are_islands_identical(x, &two[1 - i % 2]):
            memcpy(x.s.lam, two[1 - i % 2].s.lam, m * sizeof(double))
        else:
            x.s.tol, x.s.deadline, x.s.at, x.s.prepared = j.tol, j.deadline, NULL, j.prepared
            x.s.zero_residual[2] = -1.0
            if p.law == CONE:
                for c in range(k):
                    at[c] = j.at[block[c]]
                x.s.at = at
            # Islands with many rows are swept less often, and under the cone law never.
            sweeps = rules.call_sweeps
            if m > rules.call_island_rows:
                sweeps = 0 if p.law == CONE else sweeps * rules.call_island_rows // m
            memcpy(before, j.counts, sizeof(before))
            good = solve_subproblem(&x.s, x.start, rules, sweeps, &workspaces[MORE], scratch, order, j.counts)
            unchecked += (j.counts[FACTORISATIONS] - before[FACTORISATIONS]) * <double>m * m * m
            unchecked += (j.counts[SWEEPS] - before[SWEEPS]) * <double>(x.s.a.indptr[m] if a != NULL else 24 * m)
            if unchecked > INTERRUPT_CHECK_WORK:
                unchecked = 0.0
                with gil:
                    PyErr_CheckSignals()
        # result
        for c in range(k):
            q = block[c]
            memcpy(j.lam + p.ptr[q], x.s.lam + x.s.v.p.ptr[c], (p.ptr[q + 1] - p.ptr[q]) * sizeof(double))
            memset(z.place + p.ptr[q], 255, (p.ptr[q + 1] - p.ptr[q]) * sizeof(int32_t))
        if not good:
            break
    return good or has_passed(j.deadline, 0.0)


cdef int32_t solve_small(task_t* j, const small_rules_t* rules, workspace_t* workspaces) except -1 nogil:
    """Solve and judge from lam, or from the zero impulse if `cold`; return the result code. j.counts receives the work.

    Pivots that no other method follows begin as `choose_start` of judge/measure.pyx decides. If another method follows, a start
    that is a solution is the result, and a start with a residual above that of the zero impulse, or above `warm_residual` for
    pivots, is replaced by the zero impulse. At the deadline the iterate is the result.
    """
    cdef int64_t size = max(count_start_scratch(&j.v), j.v.p.n_rows + count_task_scratch(j))
    cdef int32_t m = j.v.p.n_rows
    cdef double residual = j.zero_residual[2]
    cdef workspace_t* work = &workspaces[WORK]
    cdef double* zero
    cdef bint is_zero, is_solved
    memset(j.counts, 0, sizeof(j.counts))
    if not grow_workspace_to(work, 0, size):
        return RESULT_FAILED
    # start
    zero = work.real
    set_zero_impulse(&j.v.p, zero, j.slack_error)
    if j.cold:
        memcpy(j.lam, zero, m * sizeof(double))
    elif not rules.follows:
        choose_start(&j.v, j.symmetric, j.zero_residual, j.tol, j.lam, zero)
    else:
        project_on_bounds(&j.v.p, j.lam)
    if rules.follows:
        is_zero = memcmp(j.lam, zero, m * sizeof(double)) == 0
        if not is_zero or residual <= j.tol:
            judge_task(j, zero + m)
            residual = residual if is_zero else j.relative
        if residual <= j.tol:
            return RESULT_IS_START
        if not residual <= (rules.warm_residual if j.pivots else 1.0):
            memcpy(j.lam, zero, m * sizeof(double))
    # solution; contacts are one subproblem unless islands are solved one by one
    if j.pivots:
        is_solved = solve_by_pivoting(j, rules.follows, workspaces)
    elif j.solves_islands:
        is_solved = solve_by_islands(j, rules, workspaces)
    else:
        j.counts[SUBPROBLEMS] = 1
        is_solved = grow_workspace_to(work, j.v.p.n_blocks, subproblem_work_size(m, j.v.r.n_bodies if j.v.r != NULL else 0)) \
            and (solve_subproblem(j, j.lam, rules, rules.call_sweeps, &workspaces[MORE], work.real, work.index, j.counts)
                 or has_passed(j.deadline, 0.0))
    if not is_solved or not grow_workspace_to(work, 0, size):
        return RESULT_FAILED
    judge_task_within_bounds(j, work.real)
    return RESULT_SOLVED if j.pivots or j.relative <= j.tol or has_passed(j.deadline, 0.0) else RESULT_FAILED
