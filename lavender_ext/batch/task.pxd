"""Setup, solve and judgement of one problem by J and M, by A or by bodies, without the interpreter.

The kernels run in the order of a single solve, with the same bits and counters. The workspaces are the caller's and are reused
for the next problem. A problem is deferred to the caller if the judge's relative residual is above tol, if an empty row
violates its target, or if the estimated cost is above the limit.
"""
from libc.stdint cimport int32_t, int64_t
from libc.math cimport INFINITY, fabs
from libc.string cimport memcmp, memcpy

from lavender_ext.core.arena cimport arena_t, has_memory, make_arena, take_doubles, take_integers
from lavender_ext.core.assemble cimport lav_form_delassus_matrix, lav_list_blocks_of_bodies
from lavender_ext.core.validate cimport find_invalid_number
from lavender_ext.core.deadline cimport has_passed
from lavender_ext.core.method cimport MORE, REACHED, NEEDS_WORKSPACE, info_t, options_t, workspace_t
from lavender_ext.core.islands cimport island_workspace_integers
from lavender_ext.core.block_types cimport CONE, blocks_t, has_independent_rows
from lavender_ext.core.problem cimport (DERIVED, compute_derived_numbers_of_jacobian, derive_row_numbers,
                                        lav_compute_csr_diagonal)
from lavender_ext.core.view cimport csr_t, view_t
from lavender_ext.driver.driver cimport NEWTON, lav_analyse, lav_start, lav_step
from lavender_ext.factor.factors cimport has_wide
from lavender_ext.host cimport grow_workspace_to
from lavender_ext.judge.measure cimport choose_start, count_judge_scratch, count_start_scratch, judge_zero_impulse, set_zero_impulse
from lavender_ext.small.call cimport (are_all_rows_bounded, can_use_small_call, derive_small_problem, judge_task,
                                      judge_task_within_bounds, solve_small)
from lavender_ext.small.limits cimport (estimate_newton_cost_terms, limits_t, max_factorisation_work,
                                        max_newton_cost, newton_cost_t)
from lavender_ext.small.task cimport (BOUND, COUNT_EVALUATIONS, COUNT_FACTORISATIONS, COUNT_ITERATIONS,
                                      COUNT_ROUNDS, FORMED, GIVEN_START, ISLANDS, NUMBERS, RESULT_FAILED,
                                      RESULT_IS_START, RESULT_SOLVED, WORK,
                                      count_task_scratch, grow_workspace_to_arena, small_rules_t, task_t)
from lavender_ext.batch.lanes cimport is_solved_in_one_lane, solve_in_one_lane
from lavender_ext.batch.world cimport THIN_PADDING, LEFT, READY, STARTED, TRIED, compress_dense_rows
from lavender_ext.velocity_newton.soft cimport needs_no_proximal_terms


cdef enum:
    NEWTON_STEPS_PER_ISLAND = 128


cdef inline bint derive_row_numbers_of_task(task_t* j, workspace_t* workspace) noexcept nogil:
    """Compute d, nu, step and other numbers of A or of bodies in `workspace`; return False without memory."""
    cdef int64_t m = j.v.p.n_rows, entries = m * m + THIN_PADDING
    cdef arena_t arena = make_arena(NULL, NULL)
    cdef int32_t _pass
    for _pass in range(2):                              # The first pass counts the numbers.
        if j.dense != NULL:
            j.a = csr_t(take_integers(&arena, m + 1), take_integers(&arena, entries), take_doubles(&arena, entries))
            if has_memory(&arena):
                compress_dense_rows(j.dense, m, j.v.p.n_rows, j.v.p.n_rows, <int32_t*>j.a.indptr, <int32_t*>j.a.indices,
                                    <double*>j.a.data)
        j.made.n_empty = derive_row_numbers(&j.v.p, j.v.a, &j.r if j.v.r != NULL else NULL, &arena)
        if not has_memory(&arena) and not grow_workspace_to_arena(workspace, &arena):
            return False
    return True


cdef inline bint form_matrix_of_bodies(task_t* j, workspace_t* workspace) noexcept nogil:
    """Form A of bodies in `workspace`, to be solved instead of them, with its own d and the bodies' nu."""
    cdef int64_t m = j.v.p.n_rows, k = j.v.p.n_blocks, n_entries
    cdef int32_t* start
    cdef int32_t* blocks
    cdef int32_t* scratch
    cdef double* jac
    cdef arena_t arena = make_arena(NULL, NULL)
    cdef int32_t _pass
    for _pass in range(2):                              # The first pass counts the numbers.
        start, blocks = take_integers(&arena, j.v.r.n_bodies + 1), take_integers(&arena, 2 * k + 1)
        scratch, jac = take_integers(&arena, 4 * k + 2 + m), take_doubles(&arena, 24 * m)
        j.a = csr_t(take_integers(&arena, m + 1), take_integers(&arena, m * m + 1), take_doubles(&arena, m * m + 1))
        j.over = view_t(j.v.p, &j.a, NULL, NULL)
        j.over.p.d, j.over.p.nu = take_doubles(&arena, m + 1), take_doubles(&arena, m + 1)
        j.over.p.step = take_doubles(&arena, m + 1)
        if not has_memory(&arena) and not grow_workspace_to_arena(workspace, &arena):
            return False
    lav_list_blocks_of_bodies(&j.v.p, j.v.r, start, blocks, &n_entries)
    lav_form_delassus_matrix(&j.v.p, j.v.r, start, blocks, jac, scratch, <int32_t*>j.a.indptr, <int32_t*>j.a.indices,
                             <double*>j.a.data)
    lav_compute_csr_diagonal(&j.over.p, &j.a, scratch)
    j.over.p.nu = j.v.p.nu
    return True


cdef inline bint prepare_task(task_t* j, workspace_t* workspaces) noexcept nogil:
    """Compute the derived numbers and the residual of the zero impulse (E0, V0, islands) unless they are known.

    Returns False if memory is exhausted, if d is not in the valid range, if v* is needed (`compute_terms`), or if a problem
    without J and M has empty rows.
    """
    cdef workspace_t* islands = &workspaces[ISLANDS]
    cdef int64_t m = j.v.p.n_rows
    cdef double* w
    if not j.has_derived:
        j.has_derived = (derive_row_numbers_of_task(j, &workspaces[NUMBERS]) if j.v.g == NULL
                         else compute_derived_numbers_of_jacobian(&j.v.p, &j.g, &j.made) == DERIVED)
    if not j.has_derived or find_invalid_number(j.v.p.d, m) >= 0 or (j.v.g == NULL and j.made.n_empty):
        return False
    if j.zero_residual[0] < 0.0:
        if not (grow_workspace_to(&workspaces[WORK], 0, 3 * m + count_judge_scratch(&j.v))
                and grow_workspace_to(islands, island_workspace_integers(&j.v), 3 * <int64_t>j.v.p.n_blocks)):
            return False
        w = workspaces[WORK].real
        if judge_zero_impulse(&j.v, islands.index, &j.islands, islands.real, j.made.empty if j.made.n_empty > 0 else NULL, NULL,
                              NULL, w + 2 * m, w, w + m, w + 3 * m, j.zero_residual):
            j.zero_residual[0], j.v.p.islands = -1.0, NULL
    return j.zero_residual[0] >= 0.0 and (j.v.g != NULL or j.zero_residual[2] >= 0.0)


cdef inline bint set_impulse_of_empty_rows(const task_t* j) noexcept nogil:
    """Set empty rows of J to the bound that b requires, like `decide_empty_rows` of lavender/solving/finish.py.

    Returns False if that bound is infinite, or if A_ii is 0 only by underflow.
    """
    cdef const blocks_t* p = &j.v.p
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


cdef inline int32_t solve_generalized_task(task_t* j, workspace_t* workspaces, const limits_t* limits) noexcept nogil:
    """Solve and judge a prepared task of J and M by Newton's method, if its estimated cost is within the limits.

    Returns RESULT_SOLVED, also for an iterate at the deadline, or RESULT_FAILED.
    """
    cdef options_t o = options_t(NEWTON, NEWTON_STEPS_PER_ISLAND, 0, 0, has_wide(), j.tol, j.zero_residual[0], j.zero_residual[1],
                                 limits.values, 0.0, j.deadline, NULL)
    cdef info_t info = info_t(0, 0, 0, 0, 0.0, NULL, NULL)
    cdef workspace_t* workspace = &workspaces[WORK]
    cdef workspace_t r
    cdef const blocks_t* p = &j.v.p
    cdef newton_cost_t cost
    cdef bint soft, is_late
    cdef int32_t code
    cdef size_t size = p.n_rows * sizeof(double)
    cdef double* start
    if not grow_workspace_to(&workspaces[GIVEN_START], 0, 2 * <int64_t>p.n_rows):
        return RESULT_FAILED
    start = workspaces[GIVEN_START].real
    memcpy(start, j.lam, size)
    if limits.lanes != 0.0 and not j.failed_in_lanes and j.made.n_empty == 0 \
            and is_solved_in_one_lane(p, &j.g, j.zero_residual):
        if solve_in_one_lane(p, &j.g, j.zero_residual, j.tol, not j.cold, workspace, j.lam, j.counts) \
                and grow_workspace_to(workspace, 0, count_task_scratch(j)):
            judge_task(j, workspace.real)
            if j.solved:
                return RESULT_SOLVED
        memcpy(j.lam, start, size)
    # cost limits, workspace
    soft = needs_no_proximal_terms(p, &j.g)
    cost = estimate_newton_cost_terms(p, &j.g, limits)
    o.work = max_factorisation_work(p, &j.g, limits, &cost, soft)
    if not o.work > 0.0:
        return RESULT_FAILED
    if lav_analyse(&j.v, &o, &r, workspace, grow_workspace_to) != NEEDS_WORKSPACE \
            or cost.fixed + cost.per_work * r.work > max_newton_cost(p, &j.g, limits, r.islands, soft):
        return RESULT_FAILED
    # start and empty rows
    o.budget = <int32_t>min(<double>NEWTON_STEPS_PER_ISLAND * r.islands, limits.steps)
    if j.cold:
        set_zero_impulse(p, j.lam, j.slack_error)
    elif not grow_workspace_to(workspace, 0, count_start_scratch(&j.v)):
        return RESULT_FAILED
    else:
        choose_start(&j.v, True, j.zero_residual, j.tol, j.lam, workspace.real)
    if j.made.n_empty and not set_impulse_of_empty_rows(j):
        return RESULT_FAILED
    # steps, judgement
    if lav_start(&j.v, &o, &r, j.lam, workspace, grow_workspace_to) != MORE:
        return RESULT_FAILED
    code = lav_step(&j.v, &o, &r, o.budget, j.lam, &info)
    j.counts[COUNT_ITERATIONS] += info.work
    j.counts[COUNT_FACTORISATIONS], j.counts[COUNT_ROUNDS] = info.factorisations, info.rounds
    j.counts[COUNT_EVALUATIONS] = info.evaluations
    is_late = has_passed(j.deadline, 0.0)
    if (code != REACHED and not is_late) or not grow_workspace_to(workspace, 0, count_task_scratch(j) + p.n_rows):
        return RESULT_FAILED
    if code == REACHED and info.work == 0 and not j.cold and memcmp(j.lam, start, size):
        # Scaling has rounded a start that may be a solution within its bounds: return it if it is one.
        memcpy(start + p.n_rows, j.lam, size)
        memcpy(j.lam, start, size)
        judge_task_within_bounds(j, workspace.real)
        if j.solved:
            return RESULT_SOLVED
        memcpy(j.lam, start + p.n_rows, size)
    judge_task_within_bounds(j, workspace.real)
    return RESULT_SOLVED if j.solved or is_late else RESULT_FAILED


cdef inline int32_t solve_task(task_t* j, workspace_t* workspaces, const limits_t* limits,
                               const small_rules_t* rules) noexcept nogil:
    """Solve and judge a task; return its status LEFT, TRIED, STARTED or READY."""
    cdef int32_t code
    cdef bint pivots
    if j.v.g != NULL:
        if prepare_task(j, workspaces):
            solve_generalized_task(j, workspaces, limits)
        # Without a reference no solver has run; the single call computes it.
        return READY if j.solved else TRIED if j.zero_residual[0] >= 0.0 else LEFT
    pivots = are_all_rows_bounded(&j.v.p)
    if j.v.p.n_rows > rules.small_rows or not can_use_small_call(&j.v.p) or not (rules.pivots if pivots else rules.follows):
        return LEFT
    if not prepare_task(j, workspaces):
        return LEFT
    j.over = j.v
    if (pivots and j.v.r != NULL and not form_matrix_of_bodies(j, &workspaces[FORMED])) \
            or not derive_small_problem(j, &workspaces[BOUND]):
        return LEFT
    code = solve_small(j, rules, workspaces)
    return TRIED if code == RESULT_FAILED else LEFT if not j.solved else STARTED if code == RESULT_IS_START else READY
