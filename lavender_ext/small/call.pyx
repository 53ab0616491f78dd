"""Problems with few rows over bodies or A, and islands with few rows: check the start, solve and judge in one call.

    bounded rows   factorisation of A, linear or with bounds, a shift if A is singular, refinement   (pivot/direct.pyx);
                   if exchanges are stuck and another method follows, Lemke's path                   (pivot/lemke.pyx)
    friction       accelerated sweeps, alternating with Newton's method                              (friction.pxd)

Under friction a subproblem is the whole problem, or each island in turn. An island's data is copied out of A or the bodies, and
it is solved to its own relative residual (judge/score.pxd). An island with data identical to the previous one reuses its
result. If the judge's relative residual is above tol, the call returns no result and the caller starts the general solver.
"""
from cpython.exc cimport PyErr_CheckSignals
from libc.math cimport INFINITY
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcmp, memcpy, memset

cimport cython

import numpy as np

from lavender_ext.core.arena cimport arena_t, make_arena, take_doubles, take_integers
from lavender_ext.core.arrays cimport as_double_pointer, make_read_only, ndarray
from lavender_ext.core.deadline cimport deadline_t, get_pointer, has_passed
from lavender_ext.core.csr cimport measure_asymmetry_and_bandwidth
from lavender_ext.core.block_types cimport (CONE, CONTACT_ROLLING, N_FRICTION_ARRAYS, ROUND, blocks_t, get_friction_arrays,
                                            has_independent_rows, bind_friction_arrays)
from lavender_ext.core.problem cimport Data
from lavender_ext.core.method cimport workspace_t
from lavender_ext.core.view cimport get_block_bodies, csr_t, rows_t
from lavender_ext.factor.factors cimport has_wide
from lavender_ext.small.call cimport (N_COUNTS, RESULT_FAILED, RESULT_IS_START, RESULT_SOLVED, Rules, small_problem_t,
                                      small_rules_t, solve_workspaces_t)
from lavender_ext.small.friction cimport friction_run_t, subproblem_t, solve_subproblem, subproblem_work_size
from lavender_ext.small.limits cimport has_only_free_rows
from lavender_ext.driver.host cimport free_workspace, grow_workspace_to
from lavender_ext.small.workspace cimport fits_workspace, grow_workspace_to_arena
from lavender_ext.judge.bounds cimport project_far_excess, project_on_bounds
from lavender_ext.judge.measure cimport (set_zero_impulse, relative_floor_of_score, judge_view, make_judged,
                                         relative_residual_of_score, count_judge_scratch)
from lavender_ext.judge.score cimport make_empty_score
from lavender_ext.local.gauss_seidel cimport prepare_exact_blocks, index_prepared_numbers
from lavender_ext.pivot.direct cimport (PASS, PASS_HALVED, begin_direct_solve, bind_direct_arrays, direct_t,
                                        is_solved_to_rounding, step_direct_solve)
from lavender_ext.pivot.lemke cimport RAY, begin_lemke_solve, bind_lemke_arrays, follow_lemke_paths, lemke_t
from lavender_ext.pivot.principal cimport SMALL_PIVOT

cdef object new = np.empty


cdef enum:
    ACTIVE_SET_SWEEPS = 2       # number of sweeps that predict which rows are free
    MAX_PASS_EXCHANGES = 32     # largest number of rounds of exchanges in one pass
    LEMKE_PIVOTS_PER_ROW = 8    # largest number of pivots of Lemke's paths, per row
    FULL_SWEEP_ROWS = 12        # Islands with at most this many rows get all sweeps before their factorisations.
    MAX_KEPT_DOUBLES = 4096     # A larger workspace is freed after a run, since many problems may be kept for long.
    INTERRUPT_CHECK_WORK = 5000000      # multiply-adds between two checks for Ctrl-C, a few milliseconds


cdef bint are_all_rows_bounded(const blocks_t* p) noexcept nogil:
    """Return whether every row has fixed bounds only, so that there is no friction."""
    cdef int32_t i
    for i in range(p.n_blocks):
        if not has_independent_rows(p, i) and p.ptr[i + 1] - p.ptr[i] > 1:
            return False
    return True


cdef bint derive_small_problem(small_problem_t* s, workspace_t* workspace) noexcept nogil:
    """Compute a small problem's remaining fields in `workspace`, which must stay allocated; return False if memory is exhausted.

    Both views and the residual of the zero impulse are given.
    """
    cdef const blocks_t* p = &s.v.p
    cdef int32_t band[2]
    cdef int64_t n
    s.pivots, s.linear, s.at, s.prepared = are_all_rows_bounded(p), has_only_free_rows(p), NULL, NULL
    s.split = s.v.r.n_joints if s.v.r != NULL else 0
    if not grow_workspace_to(workspace, p.n_blocks + 1 + p.n_rows, 0):
        return False
    if s.pivots:
        s.symmetric = measure_asymmetry_and_bandwidth(s.over.a, s.over.p.d, p.n_rows, workspace.index, band) <= 1e-14
        s.band = max(band[0], band[1]) if s.symmetric else p.n_rows - 1
    elif p.law == CONE or s.v.a != NULL:                # The units of a given matrix may differ within a contact.
        n = <int64_t>index_prepared_numbers(p, workspace.index) + 1
        if not grow_workspace_to(workspace, 0, n):
            return False
        memset(workspace.real, 0, n * sizeof(double))
        prepare_exact_blocks(&s.over, workspace.index, workspace.real)
        s.at, s.prepared = workspace.index, workspace.real
    return True


cdef bint can_use_small_call(const blocks_t* p) noexcept nogil:
    """Return whether this solver supports every block: no round cones, no rolling friction."""
    cdef int32_t i
    for i in range(p.n_blocks):
        if p.kind[i] == ROUND or p.kind[i] == CONTACT_ROLLING:
            return False
    return True


cdef void judge_small_impulse(small_problem_t* s, const double* lam, double* both, double* scratch) noexcept nogil:
    """Judge lam: write w and e to both (2 m), and score, floor and relative residual to s; scratch as `judge_view`."""
    cdef int32_t m = s.v.p.n_rows
    s.score = make_empty_score()
    judge_view(&s.v, lam, both, both + m, scratch, True, &s.score)
    s.floor = relative_floor_of_score(&s.score, s.zero_residual[0], s.zero_residual[1])
    s.relative = relative_residual_of_score(&s.score, both, m, s.zero_residual[0], s.zero_residual[1])


cdef void judge_result_within_bounds(small_problem_t* s, double* own, double tol, double* both, double* scratch) noexcept nogil:
    """Judge the result own (m) after its projection (`project_far_excess`), unless that breaks tol; scratch: m more."""
    cdef int32_t m = s.v.p.n_rows
    cdef bint is_met
    judge_small_impulse(s, own, both, scratch + m)
    is_met = s.relative <= tol
    if not project_far_excess(&s.v.p, own, scratch):
        return
    judge_small_impulse(s, own, both, scratch + m)
    if is_met and not s.relative <= tol:
        memcpy(own, scratch, m * sizeof(double))
        judge_small_impulse(s, own, both, scratch + m)


cdef bint set_start_of_small_problem(small_problem_t* s, const small_rules_t* rules, double* own, bint cold, double tol,
                                     double* both, double* scratch) noexcept nogil:
    """Set the start `own` (m) [N s], the zero impulse if `cold`; return whether it is a solution, which is then judged.

    The start is projected on its bounds. Its residual is checked only if another method follows. A start with a residual
    above that of the zero impulse, or above `warm` for pivots, is replaced by the zero impulse. scratch: m numbers plus
    those of `judge_view`.
    """
    cdef int32_t m = s.v.p.n_rows
    cdef double residual = s.zero_residual[2]
    set_zero_impulse(&s.v.p, scratch, both)
    if cold:
        memcpy(own, scratch, m * sizeof(double))
    else:
        project_on_bounds(&s.v.p, own)
    if not rules.follows:
        return False
    cold = memcmp(own, scratch, m * sizeof(double)) == 0
    if not cold or residual <= tol:
        judge_small_impulse(s, own, both, scratch + m)
        residual = residual if cold else s.relative
    if residual <= tol:
        return True
    if not residual <= (rules.warm if s.pivots else 1.0):
        memcpy(own, scratch, m * sizeof(double))
    return False


cdef inline bint is_direct_solve_converged(const direct_t* t, double tol, bint tol_suffices) noexcept nogil:
    """Return whether the residual is below tol and exchanges have ended or reached rounding.

    With `tol_suffices`, solved bounded rows need not be refined to rounding.
    """
    return t.relative <= tol and (is_solved_to_rounding(t) or (tol_suffices and t.solved and not t.linear))


cdef inline bint run_exchanges(direct_t* t, const double* start, double tol, bint tol_suffices) noexcept nogil:
    """Solve by exchanges into `best`; return whether the result is converged.

    Passes with a shifted matrix end if one does not halve the residual or is stuck, or at the deadline.
    """
    cdef int32_t code
    begin_direct_solve(t, start)
    code = step_direct_solve(t, MAX_PASS_EXCHANGES)
    # If A is singular, passes with a shift follow.
    if t.symmetric and t.state == PASS and (code == SMALL_PIVOT or t.linear):
        code = PASS_HALVED
        while code == PASS_HALVED and not t.s.late:
            code = step_direct_solve(t, MAX_PASS_EXCHANGES)
            if not t.relative < INFINITY:
                return False
    return is_direct_solve_converged(t, tol, tol_suffices)


cdef inline int32_t run_lemke_paths(direct_t* t, double tol, workspace_t* workspace) noexcept nogil:
    """Follow Lemke's paths after stuck exchanges, with exchanges at the end of each.

    Returns the number of pivots, -1 if the residual is above tol.
    """
    cdef lemke_t l
    cdef arena_t arena = make_arena(workspace.real, workspace.index)
    cdef int32_t limit = LEMKE_PIVOTS_PER_ROW * t.s.n
    bind_lemke_arrays(&l, t, &arena)
    if not fits_workspace(workspace, &arena):
        if not grow_workspace_to_arena(workspace, &arena):
            return -1
        bind_lemke_arrays(&l, t, &arena)
    begin_lemke_solve(&l)
    while follow_lemke_paths(&l, limit - l.n_pivots) == RAY:
        pass
    return l.n_pivots if t.relative <= tol else -1


cdef bint solve_by_pivoting(const small_problem_t* s, double* own, double tol, bint follows, deadline_t* deadline,
                            solve_workspaces_t* workspaces, int32_t* counts) noexcept nogil:
    """Solve free or bounded rows by factorisations and exchanges; return whether there is a result.

    counts receives (rounds plus pivots of Lemke's paths, 1 if swept, refinements, factorisations, exchanged rows, shifts, rank of
    a singular linear system or 0, pivots of Lemke's paths). If another method follows, a result below tol is accepted even if it
    is not exact to rounding, and Lemke's paths are followed if exchanges are stuck.
    """
    cdef direct_t t
    cdef arena_t arena = make_arena(workspaces.work.real, workspaces.work.index)
    cdef int32_t path = 0
    cdef bint ended
    t.v, t.e0, t.v0, t.least = s.v, s.zero_residual[0], s.zero_residual[1], 1e-13
    t.linear, t.symmetric, t.sweeps = s.linear, s.symmetric, ACTIVE_SET_SWEEPS
    t.s.a, t.s.p, t.s.band, t.s.order, t.s.linear.tiny = s.over.a, &s.over.p, s.band, NULL, 1e-13
    t.s.deadline, t.s.late = deadline, 0
    bind_direct_arrays(&t, &arena)
    if not fits_workspace(&workspaces.work, &arena):
        if not grow_workspace_to_arena(&workspaces.work, &arena):
            return False
        bind_direct_arrays(&t, &arena)
    # exchanges, then Lemke's paths
    ended = run_exchanges(&t, own, tol, follows)
    if not ended and not has_passed(deadline, 0.0):
        path = run_lemke_paths(&t, tol, &workspaces.more) if follows and not t.linear and not t.solved else -1
    if not ended:
        ended = (path >= 0 and t.relative <= tol) or (has_passed(deadline, 0.0) and t.relative < INFINITY)
    if ended:
        memcpy(own, t.best, t.s.n * sizeof(double))
    path = max(path, 0)
    counts[0], counts[1], counts[2], counts[3] = t.s.n_rounds + path, t.swept != 0, t.refined, t.s.factorisations
    counts[4], counts[5], counts[6], counts[7] = t.s.exchanged, t.shifts, t.rank, path
    return ended


cdef inline void store_work_counts(const friction_run_t* o, int32_t n_subproblems, int32_t* counts) noexcept nogil:
    """Write the counters: longest subproblem, sweeps, undone sweeps, factorisations, factorised subproblems, subproblems."""
    counts[0], counts[1], counts[2] = o.longest, <int32_t>o.swept, <int32_t>o.undone
    counts[3], counts[4], counts[5] = <int32_t>o.factorisations, o.factorised, n_subproblems


cdef bint solve_by_sweeps(const small_problem_t* s, double* own, double tol, int32_t swept, deadline_t* deadline,
                          solve_workspaces_t* workspaces, int32_t* counts) noexcept nogil:
    """Solve contacts as one subproblem, with at most `swept` sweeps before factorisations; counts as in `store_work_counts`."""
    cdef int32_t m = s.v.p.n_rows, n = s.over.r.n_bodies if s.over.r != NULL else 0
    cdef subproblem_t sub
    cdef friction_run_t o = friction_run_t(tol, swept, swept, has_wide(), 0, 0, 0, 0.0, deadline, 0, 0)
    cdef bint good
    if not grow_workspace_to(&workspaces.work, s.v.p.n_blocks, subproblem_work_size(m, n) + m):
        return False
    sub.v, sub.lam, sub.answer, sub.split = s.over, own, workspaces.work.real, s.split
    sub.at, sub.prepared, sub.relative_at_zero = s.at, s.prepared, s.zero_residual[2]
    sub.e0, sub.v0 = s.zero_residual[0], s.zero_residual[1]
    good = solve_subproblem(&sub, &o, &workspaces.more, workspaces.work.real + m, workspaces.work.index)
    memcpy(own, sub.answer, m * sizeof(double))
    store_work_counts(&o, 1, counts)
    return good or has_passed(deadline, 0.0)


cdef int32_t solve_small(small_problem_t* s, const small_rules_t* rules, double* own, bint cold, double tol, deadline_t* deadline,
                         double* both, solve_workspaces_t* workspaces, int32_t* counts) noexcept nogil:
    """Solve and judge from `own` (m) [N s], or from the zero impulse if `cold`, into `own`; return the result code.

    both (2 m) receives the slack and the error of the result, counts the work (`store_work_counts`). At the deadline the
    iterate is the result.
    """
    cdef int64_t m = s.v.p.n_rows, scratch = m + count_judge_scratch(&s.v)
    memset(counts, 0, N_COUNTS * sizeof(int32_t))
    if not grow_workspace_to(&workspaces.work, 0, scratch):
        return RESULT_FAILED
    if set_start_of_small_problem(s, rules, own, cold, tol, both, workspaces.work.real):
        return RESULT_IS_START
    if not (solve_by_pivoting(s, own, tol, rules.follows, deadline, workspaces, counts) if s.pivots
            else solve_by_sweeps(s, own, tol, rules.swept, deadline, workspaces, counts)):
        return RESULT_FAILED
    if not grow_workspace_to(&workspaces.work, 0, scratch):
        return RESULT_FAILED
    judge_result_within_bounds(s, own, tol, both, workspaces.work.real)
    return RESULT_SOLVED if s.pivots or s.relative <= tol or has_passed(deadline, 0.0) else RESULT_FAILED


cdef class Rules:
    """Settings of the calls for small problems: `small_rules_t`."""

    def __init__(self, int rows, int swept, double warm, bint pivots, bint follows):
        self.at.rows, self.at.swept, self.at.warm, self.at.pivots, self.at.follows = rows, swept, warm, pivots, follows


cdef enum:                      # doubles of an island's data
    ROW_DOUBLES = 7             # per row: lower, upper, b, d, nu, step, start
    JOINT_ROW_DOUBLES = 24      # per joint row: J, M^-1 J^T
    CONTACT_ROW_DOUBLES = 6     # per contact row: inv_inertia_arm
    N_SIZES = 5                 # rows, blocks, entries of A, joint rows, joints


cdef struct island_t:           # copied from A or the bodies; its doubles and integers are one contiguous array each
    subproblem_t s
    csr_t a
    rows_t r
    double* numbers
    int32_t* integers
    int64_t n_numbers
    int64_t n_integers


cdef inline void bind_island_arrays(island_t* x, arena_t* arena, const int32_t* size, int32_t n) noexcept nogil:
    """Take the arrays of an island with the given sizes (N_SIZES) and n bodies, and of its result, from an arena.

    n < 0: over A, without joints.
    """
    cdef blocks_t* p = &x.s.v.p
    cdef rows_t* r = &x.r
    cdef int32_t m = size[0], k = size[1], nnz = size[2], mj = size[3], kj = size[4], c = k - kj
    x.numbers, x.integers = take_doubles(arena, 0), take_integers(arena, 0)
    x.n_numbers, x.n_integers = arena.n_real, arena.n_index
    p.n_blocks, p.n_rows, p.islands = k, m, NULL
    p.lower, p.upper, p.b = take_doubles(arena, m), take_doubles(arena, m), take_doubles(arena, m)
    p.d, p.nu = take_doubles(arena, m), take_doubles(arena, m)
    p.step, x.s.lam = take_doubles(arena, m), take_doubles(arena, m)
    bind_friction_arrays(p, take_doubles(arena, N_FRICTION_ARRAYS * k), k)
    p.ptr, p.kind = take_integers(arena, k + 1), take_integers(arena, k)
    x.s.v.a = x.s.v.r = x.s.v.g = NULL
    if n < 0:
        x.a.data, x.a.indptr, x.a.indices = take_doubles(arena, nnz), take_integers(arena, m + 1), take_integers(arena, nnz)
        x.s.v.a = &x.a
    else:
        r.n_bodies, r.n_joints, r.n_contacts = n, kj, c
        r.jac, r.minv_jac = take_doubles(arena, 12 * mj), take_doubles(arena, 12 * mj)
        r.normal, r.tangent = take_doubles(arena, 3 * c), take_doubles(arena, 3 * c)
        r.arm_a, r.arm_b = take_doubles(arena, 3 * c), take_doubles(arena, 3 * c)
        r.coupling, r.inv_inertia_arm = take_doubles(arena, 5 * c), take_doubles(arena, CONTACT_ROW_DOUBLES * (m - mj))
        r.compliance, r.inv_mass, r.inv_inertia = take_doubles(arena, m), take_doubles(arena, n), take_doubles(arena, 9 * n)
        r.joint_body, r.contact_body = take_integers(arena, 2 * kj), take_integers(arena, 2 * c)
        x.s.v.r = r
    x.n_numbers, x.n_integers = arena.n_real - x.n_numbers, arena.n_index - x.n_integers
    x.s.answer = take_doubles(arena, m)


cdef inline void copy_island_blocks(island_t* x, const blocks_t* p, const int32_t* block, const double* lam,
                                    int32_t* place) noexcept nogil:
    """Copy the blocks `block` of the complete problem; place (rows of the problem) receives the row indices in the island."""
    cdef const double* of_row[ROW_DOUBLES]
    cdef const double* of_block[N_FRICTION_ARRAYS]
    cdef blocks_t* own = &x.s.v.p
    cdef int32_t i, j, k, q, row, n = 0
    cdef int32_t* ptr = <int32_t*>own.ptr
    of_row[0], of_row[1], of_row[2], of_row[3], of_row[4], of_row[5] = p.lower, p.upper, p.b, p.d, p.nu, p.step
    of_row[6] = lam
    get_friction_arrays(p, of_block)
    own.law = p.law
    ptr[0] = 0
    for k in range(own.n_blocks):
        i = block[k]
        (<int32_t*>own.kind)[k] = p.kind[i]
        for q in range(N_FRICTION_ARRAYS):
            x.numbers[ROW_DOUBLES * own.n_rows + q * own.n_blocks + k] = of_block[q][i]
        j = p.ptr[i]
        for q in range(ROW_DOUBLES):
            memcpy(x.numbers + q * own.n_rows + n, of_row[q] + j, (p.ptr[i + 1] - j) * sizeof(double))
        for row in range(j, p.ptr[i + 1]):
            place[row] = n
            n += 1
        ptr[k + 1] = n


cdef inline void copy_island_matrix(island_t* x, const blocks_t* p, const csr_t* a, const int32_t* block,
                                    const int32_t* place) noexcept nogil:
    """Copy the entries of A between the island's rows; other entries, zeros of immovable bodies, have a place of -1."""
    cdef int32_t i, k, q, row, at = 0, n = 0
    cdef int32_t* indptr = <int32_t*>x.a.indptr
    indptr[0] = 0
    for k in range(x.s.v.p.n_blocks):
        i = block[k]
        for row in range(p.ptr[i], p.ptr[i + 1]):
            for q in range(a.indptr[row], a.indptr[row + 1]):
                if place[a.indices[q]] >= 0:
                    (<int32_t*>x.a.indices)[at] = place[a.indices[q]]
                    (<double*>x.a.data)[at] = a.data[q]
                    at += 1
            n += 1
            indptr[n] = at


cdef inline int32_t number_island_bodies(const rows_t* r, const int32_t* block, int32_t k, int32_t* number,
                                         int32_t* body) noexcept nogil:
    """Number the bodies of k blocks in the order of appearance, in `body`; `number` is the inverse. Return their count."""
    cdef const int32_t* two
    cdef int32_t i, side, n = 0
    for i in range(k):
        two = get_block_bodies(r, block[i])
        for side in range(2):
            if two[side] >= 0 and number[two[side]] < 0:
                number[two[side]] = n
                body[n] = two[side]
                n += 1
    return n


cdef inline void copy_entry_numbers(const double* to, int64_t n, const double* x, int64_t i) noexcept nogil:
    """Copy entry i of x, which has n numbers for each entry, to `to` (n)."""
    memcpy(<void*>to, x + n * i, n * sizeof(double))


cdef inline void copy_island_bodies(island_t* x, const blocks_t* p, const rows_t* r, const int32_t* block,
                                    const int32_t* number, const int32_t* body) noexcept nogil:
    """Copy the island's joints, contacts and bodies."""
    cdef const blocks_t* own = &x.s.v.p
    cdef const rows_t* y = &x.r
    cdef const int32_t* two
    cdef int32_t i, j, k, m, c, n, first = own.ptr[y.n_joints]
    cdef int32_t* pair
    for k in range(own.n_blocks):
        i, m, n = block[k], own.ptr[k], own.ptr[k + 1] - own.ptr[k]
        j, two, pair = p.ptr[i], get_block_bodies(r, i), <int32_t*>get_block_bodies(y, k)
        for c in range(2):
            pair[c] = number[two[c]] if two[c] >= 0 else -1
        memcpy(<void*>(y.compliance + m), r.compliance + j, n * sizeof(double))
        if k < y.n_joints:
            memcpy(<void*>(y.jac + 12 * m), r.jac + 12 * j, 12 * n * sizeof(double))
            memcpy(<void*>(y.minv_jac + 12 * m), r.minv_jac + 12 * j, 12 * n * sizeof(double))
            continue
        memcpy(<void*>(y.inv_inertia_arm + CONTACT_ROW_DOUBLES * (m - first)),
               r.inv_inertia_arm + CONTACT_ROW_DOUBLES * (j - p.ptr[r.n_joints]),
               CONTACT_ROW_DOUBLES * n * sizeof(double))
        c, i = k - y.n_joints, i - r.n_joints
        copy_entry_numbers(y.normal + 3 * c, 3, r.normal, i)
        copy_entry_numbers(y.tangent + 3 * c, 3, r.tangent, i)
        copy_entry_numbers(y.arm_a + 3 * c, 3, r.arm_a, i)
        copy_entry_numbers(y.arm_b + 3 * c, 3, r.arm_b, i)
        copy_entry_numbers(y.coupling + 5 * c, 5, r.coupling, i)
    for k in range(y.n_bodies):
        copy_entry_numbers(y.inv_mass + k, 1, r.inv_mass, body[k])
        copy_entry_numbers(y.inv_inertia + 9 * k, 9, r.inv_inertia, body[k])


cdef inline bint are_islands_identical(const island_t* x, const island_t* y) noexcept nogil:
    """Return whether two islands have bitwise identical data."""
    return (x.n_numbers == y.n_numbers and x.n_integers == y.n_integers
            and memcmp(x.numbers, y.numbers, x.n_numbers * sizeof(double)) == 0
            and memcmp(x.integers, y.integers, x.n_integers * sizeof(int32_t)) == 0)


cdef inline int32_t count_first_sweeps(const blocks_t* p, int32_t max_sweeps) noexcept nogil:
    """Return the sweeps of an island before its factorisations: fewer for many rows, none under the cone law."""
    if p.n_rows <= FULL_SWEEP_ROWS:
        return max_sweeps
    return 0 if p.law == CONE else max_sweeps * FULL_SWEEP_ROWS // p.n_rows


cdef class Small:
    """A problem with few rows. `data` must hold the residual of the zero impulse; `run` only reads the problem.

    Parameters
    ----------
    data : Data
        Problem for the judge.
    over : Data
        Problem to solve; for bounded rows A in compressed rows.
    """

    cdef readonly Data data
    cdef readonly int count                             # number of islands
    cdef Data over
    cdef small_problem_t at
    cdef workspace_t workspace
    cdef workspace_t kept                               # workspace of the last run, which the next run takes

    def __init__(self, Data data, Data over):
        self.data, self.over, self.count = data, over, 1
        self.at.v, self.at.over = data.get_pointers(), over.get_pointers()
        self.at.zero_residual[0], self.at.zero_residual[1] = data.reference_energy, data.reference_velocity
        self.at.zero_residual[2] = data.relative_at_zero
        if not derive_small_problem(&self.at, &self.workspace):
            raise MemoryError(f"{data.blocks.n_rows} rows")

    def __dealloc__(self):
        free_workspace(&self.workspace)
        free_workspace(&self.kept)

    cdef void exchange_kept_workspace(self, workspace_t* r) noexcept:
        """Exchange a workspace with the kept one, so that no two runs of different threads use the same."""
        with cython.critical_section(self):
            self.kept, r[0] = r[0], self.kept

    def run(self, impulse, double tol, Rules rules, deadline=None):
        """Solve from `impulse` (m,) [N s], or from the zero impulse if it is None.

        Returns (judged result or None if it is above tol, counters or None if `impulse` is the solution). The result at
        the deadline is returned even if it is above tol.
        """
        cdef small_problem_t s = self.at
        cdef solve_workspaces_t workspaces
        cdef int32_t counts[N_COUNTS]
        cdef Py_ssize_t m = s.v.p.n_rows
        cdef ndarray answer = make_read_only(new(m)), both = new(2 * m + 1)
        cdef double* own = <double*>answer.data
        cdef int32_t code
        memset(&workspaces, 0, sizeof(workspaces))
        self.exchange_kept_workspace(&workspaces.work)
        if impulse is not None:
            memcpy(own, as_double_pointer(impulse, m), m * sizeof(double))
        try:
            code = self.run_kernel(&s, &rules.at, own, impulse is None, tol, get_pointer(deadline), <double*>both.data, &workspaces,
                                   counts)
        finally:
            if workspaces.work.n_real <= MAX_KEPT_DOUBLES:
                self.exchange_kept_workspace(&workspaces.work)
            free_workspace(&workspaces.work)
            free_workspace(&workspaces.more)
        judged = make_judged(self.data, answer, both, &s.score, s.relative, s.floor) if code != RESULT_FAILED else None
        return judged, None if code == RESULT_IS_START else tuple([counts[i] for i in range(N_COUNTS)])

    cdef int32_t run_kernel(self, small_problem_t* s, const small_rules_t* rules, double* own, bint cold, double tol,
                            deadline_t* deadline, double* both, solve_workspaces_t* workspaces, int32_t* counts) except -1:
        """Run `solve_small` without the interpreter."""
        with nogil:
            return solve_small(s, rules, own, cold, tol, deadline, both, workspaces, counts)


cdef class Islands(Small):
    """A problem with friction that is solved island by island.

    Parameters
    ----------
    data : Data
        Problem for the judge, which has labelled its islands; there are several.
    over : Data
        The same problem, or A of it.
    """

    cdef object size

    def __init__(self, Data data, Data over):
        Small.__init__(self, data, over)
        cdef const int32_t* ptr = over.blocks.ptr
        cdef const int32_t* label = data.islands_at.label
        cdef int32_t i, q, k = over.blocks.n_blocks, rows, joints = over.rows.n_joints if over.factored else 0
        self.count = data.islands_at.n
        self.size = np.zeros((self.count, N_SIZES), np.int32)
        cdef int32_t[:, ::1] size = self.size
        cdef int32_t[::1] island = np.empty(ptr[k], np.int32)       # of each row
        for i in range(k):
            for q in range(ptr[i], ptr[i + 1]):
                island[q] = label[i]
        for i in range(k):
            rows = ptr[i + 1] - ptr[i]
            size[label[i], 0] += rows
            size[label[i], 1] += 1
            if not over.factored:
                for q in range(over.csr.indptr[ptr[i]], over.csr.indptr[ptr[i + 1]]):
                    size[label[i], 2] += island[over.csr.indices[q]] == label[i]
            if i < joints:
                size[label[i], 3] += rows
                size[label[i], 4] += 1

    cdef int32_t run_kernel(self, small_problem_t* s, const small_rules_t* rules, double* own, bint cold, double tol,
                            deadline_t* deadline, double* both, solve_workspaces_t* workspaces, int32_t* counts) except -1:
        cdef int64_t m = s.v.p.n_rows, scratch = m + count_judge_scratch(&s.v)
        cdef friction_run_t o = friction_run_t(tol, rules.swept, rules.swept, has_wide(), 0, 0, 0, 0.0, deadline, 0, 0)
        cdef bint good
        if not grow_workspace_to(&workspaces.work, 0, scratch):
            raise MemoryError(f"{m} rows")
        if set_start_of_small_problem(s, rules, own, cold, tol, both, workspaces.work.real):
            return RESULT_IS_START
        good = self.solve_islands(own, &o, &workspaces.more)
        memset(counts, 0, N_COUNTS * sizeof(int32_t))
        store_work_counts(&o, self.count, counts)
        if not good:
            return RESULT_FAILED
        judge_result_within_bounds(s, own, tol, both, workspaces.work.real)
        return RESULT_SOLVED if s.relative <= tol or has_passed(deadline, 0.0) else RESULT_FAILED

    cdef bint solve_islands(self, double* own, friction_run_t* o, workspace_t* r) except -1:
        """Solve the islands one after the other from `own` (m) [N s], into `own`; return whether all are solved."""
        cdef const blocks_t* p = &self.over.blocks
        cdef const rows_t* rows = &self.over.rows
        cdef bint over_bodies = self.over.factored
        cdef const int32_t* block = self.data.islands_at.order
        cdef const int32_t[:, ::1] size = self.size     # N_SIZES of each island
        cdef int32_t n_bodies = rows.n_bodies if over_bodies else 0
        cdef int32_t[::1] place = np.full(p.n_rows, -1, np.int32), at, order, integers, number, body
        cdef double[::1] numbers, work
        cdef int32_t i, j, q, m, k, n = -1
        cdef int32_t largest[N_SIZES]
        cdef arena_t counted = make_arena(NULL, NULL), arena
        cdef int64_t swept, read, unchecked = 0
        cdef double factored
        cdef island_t two[2]
        cdef island_t* x
        cdef island_t* last
        cdef bint good = True
        m, k, q, _, _ = self.size.max(axis=0)
        if over_bodies:
            n = min(2 * k, n_bodies)
        # The rows of joints take the most doubles of a row, contacts the most of a block.
        largest[0], largest[1], largest[2], largest[3], largest[4] = m, k, q, m, 0
        bind_island_arrays(&two[0], &counted, largest, n)
        numbers, integers = np.empty(2 * counted.n_real), np.empty(2 * counted.n_index, np.int32)
        work = np.empty(subproblem_work_size(m, max(n, 0)))
        at, order = np.empty(k + 1, np.int32), np.empty(k, np.int32)
        number, body = np.full(n_bodies + 1, -1, np.int32), np.empty(n + 2, np.int32)
        two[1].n_numbers = -1
        with nogil:
            for i in range(self.count):
                # Copy the data of island i.
                x, last = &two[i % 2], &two[1 - i % 2]
                m, k = size[i, 0], size[i, 1]
                if over_bodies:
                    n = number_island_bodies(rows, block, k, &number[0], &body[0])
                arena = make_arena(&numbers[(i % 2) * counted.n_real], &integers[(i % 2) * counted.n_index])
                bind_island_arrays(x, &arena, &size[i, 0], n)
                copy_island_blocks(x, p, block, own, &place[0])
                if over_bodies:
                    copy_island_bodies(x, p, rows, block, &number[0], &body[0])
                else:
                    copy_island_matrix(x, p, &self.over.csr, block, &place[0])
                if are_islands_identical(x, last):
                    memcpy(x.s.answer, last.s.answer, m * sizeof(double))
                else:
                    x.s.split, x.s.at, x.s.prepared, x.s.relative_at_zero = size[i, 4], NULL, NULL, -1.0
                    if p.law == CONE:
                        for j in range(k):
                            at[j] = self.at.at[block[j]]
                        x.s.at, x.s.prepared = &at[0], self.at.prepared
                    o.first = count_first_sweeps(&x.s.v.p, o.max_sweeps)
                    swept, factored = o.swept, o.factored
                    good = solve_subproblem(&x.s, o, r, &work[0], &order[0])
                    if not good:
                        break
                    # Check for Ctrl-C.
                    read = JOINT_ROW_DOUBLES * m if over_bodies else size[i, 2]
                    unchecked += <int64_t>(o.factored - factored) + read * (o.swept - swept)
                    if unchecked > INTERRUPT_CHECK_WORK:
                        unchecked = 0
                        with gil:
                            PyErr_CheckSignals()
                # Write the result back.
                for j in range(k):
                    q = block[j]
                    memcpy(&own[p.ptr[q]], x.s.answer + x.s.v.p.ptr[j], (p.ptr[q + 1] - p.ptr[q]) * sizeof(double))
                    memset(&place[p.ptr[q]], 255, (p.ptr[q + 1] - p.ptr[q]) * sizeof(int32_t))     # -1: in no island
                block += k
        return good
