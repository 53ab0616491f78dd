"""Setup, solve and judgement of one problem by J and M, by A or by bodies, without the interpreter.

The kernels run in the order of a single solve, with the same bits and counters. The workspace is the caller's and is reused
for the next problem. A problem is deferred to the caller if the judge's relative residual is above tol, if an empty row
violates its target, or if the estimated cost is above the limit.
"""
from libc.stdint cimport int32_t, int64_t
from libc.math cimport INFINITY, NAN, fabs, sqrt
from libc.string cimport memcpy

from lavender_ext.core.arena cimport arena_t, has_memory, make_arena, take_doubles, take_integers
from lavender_ext.core.assemble cimport lav_form_delassus_matrix, lav_list_blocks_of_bodies
from lavender_ext.core.validate cimport find_invalid_number
from lavender_ext.core.deadline cimport deadline_t, has_passed
from lavender_ext.core.method cimport MORE, REACHED, NEEDS_WORKSPACE, info_t, options_t, workspace_t
from lavender_ext.core.islands cimport island_workspace_integers
from lavender_ext.core.block_types cimport CONE, blocks_t, has_independent_rows, islands_t
from lavender_ext.core.problem cimport (DERIVED, compute_derived_numbers_of_jacobian, derive_row_numbers, derived_t,
                                        lav_compute_csr_diagonal)
from lavender_ext.core.view cimport csr_t, generalized_t, rows_t, view_t
from lavender_ext.driver.driver cimport NEWTON, lav_analyse, lav_start, lav_step
from lavender_ext.factor.factors cimport has_wide
from lavender_ext.host cimport grow_workspace_to
from lavender_ext.judge.bounds cimport project_far_excess
from lavender_ext.judge.measure cimport (choose_start, count_judge_scratch, count_start_scratch, judge_zero_impulse,
                                         refine_reported_view, relative_floor_of_score, relative_residual_of_score,
                                         residual_above_floor, score_given_generalized_slack, set_zero_impulse)
from lavender_ext.judge.score cimport make_empty_score, score_t
from lavender_ext.judge.slack cimport compute_generalized_slack
from lavender_ext.small.call cimport (N_COUNTS, RESULT_IS_START, RESULT_SOLVED, are_all_rows_bounded, derive_small_problem,
                                      small_problem_t, small_rules_t, solve_small, solve_workspaces_t, can_use_small_call)
from lavender_ext.small.limits cimport (estimate_newton_cost_terms, limits_t, max_factorisation_work,
                                        max_newton_cost, newton_cost_t)
from lavender_ext.small.workspace cimport grow_workspace_to_arena
from lavender_ext.batch.lanes cimport is_solved_in_one_lane, solve_in_one_lane
from lavender_ext.batch.world cimport THIN_PADDING, LEFT, READY, STARTED, TRIED, compress_dense_rows
from lavender_ext.velocity_newton.soft cimport needs_no_proximal_terms


cdef enum:
    NEWTON_STEPS_PER_ISLAND = 128


cdef struct task_t:
    blocks_t p
    bint general                # given by J and M
    bint factored               # given by bodies; if neither, by A
    generalized_t g
    csr_t a
    rows_t r
    const double* dense         # A (m, m), to be converted to `a`
    int64_t row                 # stride of its rows
    derived_t made                 # derived numbers, of the data object or of this call
    bint has_derived            # `made` is valid for this problem
    double zero_residual[3]     # E0, V0, relative residual of the zero impulse; E0 < 0: not known
    islands_t islands           # target of p.islands, if this call computed the islands
    double* by_island           # NULL, or the array (islands, 2) that `score_t.by_island` points to
    bint failed_in_lanes        # lanes have not solved the task: a lane alone has the same result
    int32_t cold                # 1: start from the zero impulse, 0: from lam
    deadline_t* deadline        # time at which the present iterate is the result, or NULL
    bint solved
    bint is_late                # the deadline has ended the steps
    int32_t counts[N_COUNTS]    # steps, factorisations, exchanges, evaluations; or as in `solve_small`
    double* lam                 # (m) N s
    double* slack_error         # (2 m + 1) w, e
    const double* push          # (n) M^-1 J^T lam, not for A; in workspace that the next world reuses
    score_t score
    double relative, floor, above_floor
    double float64_relative     # relative residual of the first pass; NaN if it was not refined


cdef struct task_workspaces_t:  # workspaces of one thread
    workspace_t islands         # workspace of `judge_zero_impulse_of_task`
    workspace_t made            # A, d, nu and step
    workspace_t formed          # workspace of `form_matrix_of_bodies`
    workspace_t bound           # workspace of `derive_small_problem`
    solve_workspaces_t call     # workspaces of `solve_small`


cdef inline view_t make_judge_view(task_t* j) noexcept nogil:
    """Return the view of the task's data for the judge."""
    cdef view_t v = view_t(j.p, NULL, NULL, NULL)
    if j.general:
        v.g = &j.g
    elif j.factored:
        v.r = &j.r
    else:
        v.a = &j.a
    return v


cdef inline bint judge_zero_impulse_of_task(task_t* j, workspace_t* islands, double* w) noexcept nogil:
    """Judge the zero impulse for E0, V0, its relative residual and the islands, unless they are known.

    Returns False if memory is exhausted or if v* is needed (`compute_terms`). w (3 m + `count_judge_scratch`) is scratch.
    """
    cdef view_t v = make_judge_view(j)
    cdef ssize_t m = j.p.n_rows
    if j.zero_residual[0] >= 0.0:
        return True
    if not grow_workspace_to(islands, island_workspace_integers(&v), 3 * <int64_t>j.p.n_blocks):
        return False
    if judge_zero_impulse(&v, islands.index, &j.islands, islands.real, j.made.empty if j.made.n_empty > 0 else NULL, NULL, NULL,
                          w + 2 * m, w, w + m, w + 3 * m, j.zero_residual):
        j.zero_residual[0] = -1.0
        return False
    j.p.islands = v.p.islands
    return True


cdef inline bint set_impulse_of_empty_rows(const task_t* j) noexcept nogil:
    """Set empty rows of J to the bound that b requires, like `decide_empty_rows` of lavender/solving/finish.py.

    Returns False if that bound is infinite, or if A_ii is 0 only by underflow.
    """
    cdef const blocks_t* p = &j.p
    cdef int32_t i, k, q
    cdef double bound
    for i in range(p.n_blocks):
        for k in range(p.ptr[i], p.ptr[i + 1]):
            if not j.made.empty[k]:
                continue
            for q in range(j.g.jptr[k], j.g.jptr[k + 1]):
                if j.g.jval[q] != 0.0:
                    return False
            if p.b[k] == 0.0 or (not has_independent_rows(p, i) and k > p.ptr[i]):
                continue                                # b = 0 requires no impulse; mu lambda_n bounds friction rows.
            if p.b[k] < 0.0 and p.law == CONE and not has_independent_rows(p, i) and p.ptr[i + 1] - p.ptr[i] > 1:
                # Keep the impulse: under the cone law, a sliding contact may have a normal impulse although its normal separates.
                continue
            bound = p.upper[k] if p.b[k] > 0.0 else p.lower[k]
            if fabs(bound) < INFINITY:
                j.lam[k] = bound
            else:
                return False
    return True


cdef inline int64_t judge_task_workspace_size(task_t* j) noexcept nogil:
    """Return the number of doubles of scratch of `judge_task`."""
    cdef view_t v = make_judge_view(j)
    return j.g.n + count_judge_scratch(&v)


cdef inline void judge_task(task_t* j, double tol, double* x) noexcept nogil:
    """Judge lam, refined for `tol`, and store M^-1 J^T lam in `push`; x (`judge_task_workspace_size`) is scratch."""
    cdef view_t v = make_judge_view(j)
    cdef int32_t m = j.p.n_rows
    j.score = make_empty_score()
    j.score.by_island = j.by_island
    compute_generalized_slack(&j.p, &j.g, j.lam, x, j.slack_error)
    score_given_generalized_slack(&j.p, &j.g, j.lam, j.slack_error, j.slack_error + m, x + j.g.n, &j.score)
    j.push = x
    j.relative = relative_residual_of_score(&j.score, j.slack_error, m, j.zero_residual[0], j.zero_residual[1])
    j.float64_relative = NAN
    if refine_reported_view(&v, j.lam, j.slack_error, j.slack_error + m, x + j.g.n, j.zero_residual[0], j.zero_residual[1], tol,
                            j.relative, &j.score):
        j.float64_relative = j.relative
        j.relative = relative_residual_of_score(&j.score, j.slack_error, m, j.zero_residual[0], j.zero_residual[1])
    j.floor = relative_floor_of_score(&j.score, j.zero_residual[0], j.zero_residual[1])
    j.above_floor = residual_above_floor(&j.score, j.relative, j.floor)


cdef inline bint compute_missing_derived_numbers(task_t* j) noexcept nogil:
    """Compute the derived numbers d, Y unless they are known; return whether they are in the valid range."""
    if not j.has_derived:
        j.has_derived = compute_derived_numbers_of_jacobian(&j.p, &j.g, &j.made) == DERIVED
    return j.has_derived and find_invalid_number(j.p.d, j.p.n_rows) < 0


cdef inline void solve_task(task_t* j, workspace_t* workspace, workspace_t* islands, const limits_t* limits,
                            double tol) noexcept nogil:
    """Solve and judge a task of J and M by Newton's method, if its estimated cost is within the limits."""
    cdef view_t v
    cdef options_t o = options_t(NEWTON, NEWTON_STEPS_PER_ISLAND, 0, 0, has_wide(), tol, 0.0, 0.0, limits.values, 0.0,
                                 j.deadline, NULL)
    cdef info_t info = info_t(0, 0, 0, 0, 0.0, NULL, NULL)
    cdef workspace_t r
    cdef int32_t m = j.p.n_rows, code
    cdef newton_cost_t cost
    cdef bint soft
    j.counts[0] = j.counts[1] = j.counts[2] = j.counts[3] = 0
    if not compute_missing_derived_numbers(j):
        return
    if not grow_workspace_to(workspace, 0, 3 * <ssize_t>m + j.g.n):
        return
    # residual of the zero impulse
    if not judge_zero_impulse_of_task(j, islands, workspace.real):
        return
    if limits.lanes != 0.0 and j.cold and not j.failed_in_lanes and j.made.n_empty == 0 \
            and is_solved_in_one_lane(&j.p, &j.g, j.zero_residual):
        j.counts[0] = j.counts[1] = solve_in_one_lane(&j.p, &j.g, j.zero_residual, tol, workspace, j.lam)
        if j.counts[0] >= 0 and grow_workspace_to(workspace, 0, judge_task_workspace_size(j)):
            judge_task(j, tol, workspace.real)
            j.solved = j.relative <= tol and j.floor <= tol
        if j.solved:
            return
        j.counts[0] = j.counts[1] = 0
    v = make_judge_view(j)
    # cost limits, workspace
    soft = needs_no_proximal_terms(&j.p, &j.g)
    cost = estimate_newton_cost_terms(&j.p, &j.g, limits)
    o.work = max_factorisation_work(&j.p, &j.g, limits, &cost, soft)
    if not o.work > 0.0:
        return
    code = lav_analyse(&v, &o, &r, workspace, grow_workspace_to)
    if code != NEEDS_WORKSPACE or cost.fixed + cost.per_work * r.work > max_newton_cost(&j.p, &j.g, limits, r.islands, soft):
        return
    # start and empty rows
    o.budget = <int32_t>min(<double>NEWTON_STEPS_PER_ISLAND * r.islands, limits.steps)
    o.e0, o.v0 = j.zero_residual[0], j.zero_residual[1]
    if j.cold:
        set_zero_impulse(&j.p, j.lam, j.slack_error)
    elif not grow_workspace_to(workspace, 0, count_start_scratch(&v)):
        return
    else:
        choose_start(&v, True, j.zero_residual, tol, j.lam, workspace.real)
    if j.made.n_empty and not set_impulse_of_empty_rows(j):
        return
    # steps, judgement
    if lav_start(&v, &o, &r, j.lam, workspace, grow_workspace_to) != MORE:
        return
    code = lav_step(&v, &o, &r, o.budget, j.lam, &info)
    j.counts[0], j.counts[1], j.counts[2], j.counts[3] = info.work, info.factorisations, info.rounds, info.evaluations
    j.is_late = has_passed(j.deadline, 0.0)
    if code != REACHED and not j.is_late:
        return
    if not grow_workspace_to(workspace, 0, judge_task_workspace_size(j) + m):
        return
    judge_task(j, tol, workspace.real + m)
    code = j.relative <= tol
    if project_far_excess(&j.p, j.lam, workspace.real):  # Unless that breaks tol.
        judge_task(j, tol, workspace.real + m)
        if code and not j.relative <= tol:
            memcpy(j.lam, workspace.real, m * sizeof(double))
            judge_task(j, tol, workspace.real + m)
    j.solved = j.relative <= tol and j.floor <= tol


cdef inline bint derive_row_numbers_of_task(task_t* j, workspace_t* workspace) noexcept nogil:
    """Compute d, nu, step and other numbers of A or of bodies in `workspace`; return whether d is in the valid range."""
    cdef int64_t m = j.p.n_rows, entries = m * m + THIN_PADDING
    cdef arena_t arena = make_arena(NULL, NULL)
    cdef int32_t _pass
    for _pass in range(2):                              # The first pass counts the numbers.
        if j.dense != NULL:
            j.a = csr_t(take_integers(&arena, m + 1), take_integers(&arena, entries), take_doubles(&arena, entries))
            if has_memory(&arena):
                compress_dense_rows(j.dense, j.row, j.p.n_rows, j.p.n_rows, <int32_t*>j.a.indptr, <int32_t*>j.a.indices,
                                    <double*>j.a.data)
        j.made.n_empty = derive_row_numbers(&j.p, NULL if j.factored else &j.a, &j.r if j.factored else NULL, &arena)
        if not has_memory(&arena) and not grow_workspace_to_arena(workspace, &arena):
            return False
    return find_invalid_number(j.p.d, j.p.n_rows) < 0


cdef inline bint form_matrix_of_bodies(task_t* j, small_problem_t* s, workspace_t* workspace) noexcept nogil:
    """Form A of bodies in `workspace`, to be solved instead of them, with its own d and the bodies' nu."""
    cdef int64_t m = j.p.n_rows, k = j.p.n_blocks, n_entries
    cdef int32_t* start
    cdef int32_t* blocks
    cdef int32_t* scratch
    cdef double* jac
    cdef arena_t arena = make_arena(NULL, NULL)
    cdef int32_t _pass
    for _pass in range(2):                              # The first pass counts the numbers.
        start, blocks = take_integers(&arena, j.r.n_bodies + 1), take_integers(&arena, 2 * k + 1)
        scratch, jac = take_integers(&arena, 4 * k + 2 + m), take_doubles(&arena, 24 * m)
        j.a = csr_t(take_integers(&arena, m + 1), take_integers(&arena, m * m + 1), take_doubles(&arena, m * m + 1))
        s.over = view_t(j.p, &j.a, NULL, NULL)
        s.over.p.d, s.over.p.nu = take_doubles(&arena, m + 1), take_doubles(&arena, m + 1)
        s.over.p.step = take_doubles(&arena, m + 1)
        if not has_memory(&arena) and not grow_workspace_to_arena(workspace, &arena):
            return False
    lav_list_blocks_of_bodies(&j.p, &j.r, start, blocks, &n_entries)
    lav_form_delassus_matrix(&j.p, &j.r, start, blocks, jac, scratch, <int32_t*>j.a.indptr, <int32_t*>j.a.indices,
                             <double*>j.a.data)
    lav_compute_csr_diagonal(&s.over.p, &j.a, scratch)
    s.over.p.nu = j.p.nu
    return True


cdef inline bint prepare_task_for_small_call(task_t* j, small_problem_t* s, task_workspaces_t* workspaces) noexcept nogil:
    """Set up a task of A or of bodies for a solve or for the judge; return False to defer it, for example with empty rows."""
    cdef int64_t m = j.p.n_rows
    if not j.has_derived:
        j.has_derived = derive_row_numbers_of_task(j, &workspaces.made)
    if not j.has_derived or j.made.n_empty:
        return False
    s.v = make_judge_view(j)
    if not (grow_workspace_to(&workspaces.call.work, 0, 3 * m + count_judge_scratch(&s.v))
            and judge_zero_impulse_of_task(j, &workspaces.islands, workspaces.call.work.real)):
        return False
    s.v.p, s.by_island = j.p, False
    s.over = s.v
    s.zero_residual[0], s.zero_residual[1], s.zero_residual[2] = j.zero_residual[0], j.zero_residual[1], j.zero_residual[2]
    return j.zero_residual[2] >= 0.0


cdef inline void copy_small_judgement(task_t* j, const small_problem_t* s) noexcept nogil:
    """Copy the judge's result of the small problem s to the task j."""
    j.score, j.relative, j.floor, j.float64_relative = s.score, s.relative, s.floor, NAN
    j.above_floor = residual_above_floor(&s.score, s.relative, s.floor)


cdef inline int32_t solve_small_task(task_t* j, task_workspaces_t* workspaces, const small_rules_t* rules,
                                     double tol) noexcept nogil:
    """Solve a task of A or of bodies by the call for small problems; return its status LEFT, TRIED, STARTED or READY."""
    cdef small_problem_t s
    cdef int32_t code
    cdef bint pivots = are_all_rows_bounded(&j.p)
    if j.p.n_rows > rules.small_rows or not can_use_small_call(&j.p) or not (rules.pivots if pivots else rules.follows):
        return LEFT
    if (not prepare_task_for_small_call(j, &s, workspaces)
            or (pivots and j.factored and not form_matrix_of_bodies(j, &s, &workspaces.formed))):
        return LEFT
    if not derive_small_problem(&s, &workspaces.bound):
        return LEFT
    code = solve_small(&s, rules, j.lam, j.cold, tol, j.deadline, j.slack_error, &workspaces.call, j.counts)
    copy_small_judgement(j, &s)
    j.push = workspaces.call.work.real + j.p.n_rows
    if code != RESULT_IS_START and code != RESULT_SOLVED:
        return TRIED
    return LEFT if not (s.relative <= tol and s.floor <= tol) else STARTED if code == RESULT_IS_START else READY
