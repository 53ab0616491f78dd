"""Problems with few rows over bodies or A, and islands with few rows: check the start, solve and judge in one call.

    bounded rows   factorisation of A, linear or with bounds, a shift if A is singular, refinement   (pivot/direct.pyx);
                   if exchanges are stuck and another method follows, Lemke's path                   (pivot/lemke.pyx)
    friction       accelerated sweeps, then Newton's method if these are slow                        (friction.pxd)

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
from lavender_ext.core.arrays cimport C_CONTIGUOUS, DOUBLE, as_double_pointer, has_element_type, make_read_only, ndarray
from lavender_ext.core.blocks cimport Blocks
from lavender_ext.core.checks cimport make_instance
from lavender_ext.core.deadline cimport deadline_t, get_pointer, has_passed, read_clock
from lavender_ext.core.csr cimport measure_asymmetry_and_bandwidth
from lavender_ext.core.block_types cimport CONE, CONTACT_ROLLING, ROUND, blocks_t, has_independent_rows, islands_t
from lavender_ext.core.problem cimport Data
from lavender_ext.core.method cimport workspace_t
from lavender_ext.core.validate cimport all_finite
from lavender_ext.core.view cimport csr_t
from lavender_ext.factor.factors cimport has_wide
from lavender_ext.small.call cimport (N_COUNTS, RESULT_FAILED, RESULT_IS_START, RESULT_SOLVED, Rules, small_problem_t,
                                      small_rules_t, solve_workspaces_t)
from lavender_ext.small.friction cimport friction_run_t, subproblem_t, solve_subproblem, subproblem_work_size
from lavender_ext.small.island cimport are_islands_identical, copy_island, island_index_t, island_t
from lavender_ext.small.limits cimport has_only_free_rows
from lavender_ext.host cimport free_workspace, grow_workspace_to
from lavender_ext.small.workspace cimport fits_workspace, grow_workspace_to_arena
from lavender_ext.judge.bounds cimport project_far_excess, project_on_bounds
from lavender_ext.judge.measure cimport (Judged, choose_start, count_start_scratch, judge_view, make_judged,
                                         relative_floor_of_score, relative_residual_of_score, set_zero_impulse)
from lavender_ext.judge.score cimport make_empty_score
from lavender_ext.local.gauss_seidel cimport prepare_exact_blocks, index_prepared_numbers
from lavender_ext.pivot.direct cimport (PASS, PASS_HALVED, begin_direct_solve, bind_direct_arrays, direct_t,
                                        is_solved_to_rounding, step_direct_solve)
from lavender_ext.pivot.lemke cimport EXCHANGES, RAY, begin_lemke_solve, bind_lemke_arrays, follow_lemke_paths, lemke_t
from lavender_ext.pivot.principal cimport SMALL_PIVOT

cdef object new = np.empty


cdef enum:
    ACTIVE_SET_SWEEPS = 2       # number of sweeps that predict which rows are free
    MAX_PASS_EXCHANGES = 32     # largest number of rounds of exchanges in one pass
    LEMKE_PIVOTS_PER_ROW = 8    # largest number of pivots of Lemke's paths, per row
    MAX_KEPT_DOUBLES = 4096     # A larger workspace is freed after a run, since many problems may be kept for long.
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

    Pivots that no other method follows begin as `choose_start` of judge/measure.pyx decides. If another method follows, a start
    with a residual above that of the zero impulse, or above `warm` for pivots, is replaced by the zero impulse. scratch
    (`count_start_scratch`).
    """
    cdef int32_t m = s.v.p.n_rows
    cdef double residual = s.zero_residual[2]
    set_zero_impulse(&s.v.p, scratch, both)
    if cold:
        memcpy(own, scratch, m * sizeof(double))
    elif not rules.follows:
        choose_start(&s.v, s.symmetric, s.zero_residual, tol, own, scratch)
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
    if not residual <= (rules.warm_residual if s.pivots else 1.0):
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


cdef bint solve_by_sweeps(const small_problem_t* s, const small_rules_t* rules, double* own, double tol, deadline_t* deadline,
                          solve_workspaces_t* workspaces, int32_t* counts) noexcept nogil:
    """Solve contacts as one subproblem; counts as in `store_work_counts`."""
    cdef int32_t m = s.v.p.n_rows, n = s.over.r.n_bodies if s.over.r != NULL else 0
    cdef subproblem_t sub
    cdef friction_run_t o = friction_run_t(rules, tol, rules.call_sweeps, has_wide(), 0, 0, 0, 0.0, deadline, 0, 0)
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


cdef inline int32_t count_first_sweeps(const blocks_t* p, const small_rules_t* rules) noexcept nogil:
    """Return the sweeps of an island before its factorisations: fewer for many rows, none under the cone law."""
    if p.n_rows <= rules.call_island_rows:
        return rules.call_sweeps
    return 0 if p.law == CONE else rules.call_sweeps * rules.call_island_rows // p.n_rows


cdef bint solve_by_islands(const small_problem_t* s, const small_rules_t* rules, double* own, double tol, deadline_t* deadline,
                           solve_workspaces_t* workspaces, int32_t* counts) except -1 nogil:
    """Solve contacts island by island from `own` (m) [N s], until one is above tol; counts as in `store_work_counts`."""
    cdef const blocks_t* p = &s.over.p
    cdef const islands_t* islands = s.v.p.islands
    cdef const csr_t* a = s.over.a
    cdef int32_t i, j, q, rows, m = 0, k = 0, n_bodies = s.over.r.n_bodies if a == NULL else 0
    cdef int64_t entries = 0, count, numbers, integers, work, unchecked = 0
    cdef friction_run_t o = friction_run_t(rules, tol, rules.call_sweeps, has_wide(), 0, 0, 0, 0.0, deadline, 0, 0), before
    cdef island_index_t z
    cdef arena_t arena
    cdef const int32_t* block
    cdef int32_t* at
    cdef int32_t* order
    cdef double* scratch
    cdef island_t two[2]
    cdef island_t* x
    cdef bint good = True
    # workspace of the largest island
    for i in range(islands.n):
        rows = count = 0
        for j in range(islands.ptr[i], islands.ptr[i + 1]):
            q = islands.order[j]
            rows += p.ptr[q + 1] - p.ptr[q]
            count += a.indptr[p.ptr[q + 1]] - a.indptr[p.ptr[q]] if a != NULL else 0
        m, k, entries = max(m, rows), max(k, islands.ptr[i + 1] - islands.ptr[i]), max(entries, count)
    numbers, integers = ISLAND_ROW_DOUBLES * m + ISLAND_BLOCK_DOUBLES * k + entries, m + 4 * k + 2 + entries
    work = subproblem_work_size(m, min(2 * k, n_bodies))
    if not grow_workspace_to(&workspaces.work, 2 * integers + m + p.n_rows + 5 * k + n_bodies, 2 * numbers + work):
        return False
    arena = make_arena(workspaces.work.real, workspaces.work.index)
    z.row, z.place = take_integers(&arena, m), take_integers(&arena, p.n_rows)
    z.contact, z.body, z.number = take_integers(&arena, k), take_integers(&arena, 2 * k), take_integers(&arena, n_bodies)
    order, at, scratch = take_integers(&arena, k), take_integers(&arena, k), take_doubles(&arena, work)
    memset(z.place, 255, p.n_rows * sizeof(int32_t))    # -1
    memset(z.number, 255, n_bodies * sizeof(int32_t))
    for i in range(islands.n):
        # copy of the island
        block, k, x = islands.order + islands.ptr[i], islands.ptr[i + 1] - islands.ptr[i], &two[i % 2]
        copy_island(x, &s.over, own, block, k, &z, make_arena(arena.real + arena.n_real + (i % 2) * numbers,
                                                              arena.index + arena.n_index + (i % 2) * integers))
        # solution
        if i > 0 and are_islands_identical(x, &two[1 - i % 2]):
            memcpy(x.s.answer, two[1 - i % 2].s.answer, x.s.v.p.n_rows * sizeof(double))
        else:
            x.s.at, x.s.prepared, x.s.relative_at_zero = NULL, NULL, -1.0
            if p.law == CONE:
                for j in range(k):
                    at[j] = s.at[block[j]]
                x.s.at, x.s.prepared = at, s.prepared
            o.max_sweeps = count_first_sweeps(&x.s.v.p, rules)
            before = o
            good = solve_subproblem(&x.s, &o, &workspaces.more, scratch, order)
            unchecked += <int64_t>(o.factored - before.factored)
            unchecked += (o.swept - before.swept) * (x.a.indptr[x.s.v.p.n_rows] if a != NULL else 24 * x.s.v.p.n_rows)
            if unchecked > INTERRUPT_CHECK_WORK:
                unchecked = 0
                with gil:
                    PyErr_CheckSignals()
        # result
        for j in range(k):
            q = block[j]
            memcpy(own + p.ptr[q], x.s.answer + x.s.v.p.ptr[j], (p.ptr[q + 1] - p.ptr[q]) * sizeof(double))
            memset(z.place + p.ptr[q], 255, (p.ptr[q + 1] - p.ptr[q]) * sizeof(int32_t))
        if not good:
            break
    store_work_counts(&o, islands.n, counts)
    return good or has_passed(deadline, 0.0)


cdef int32_t solve_small(small_problem_t* s, const small_rules_t* rules, double* own, bint cold, double tol, deadline_t* deadline,
                         double* both, solve_workspaces_t* workspaces, int32_t* counts) except -1 nogil:
    """Solve and judge from `own` (m) [N s], or from the zero impulse if `cold`, into `own`; return the result code.

    both (2 m) receives the slack and the error of the result, counts the work (`store_work_counts`). At the deadline the
    iterate is the result.
    """
    cdef int64_t scratch = count_start_scratch(&s.v)
    memset(counts, 0, N_COUNTS * sizeof(int32_t))
    if not grow_workspace_to(&workspaces.work, 0, scratch):
        return RESULT_FAILED
    if set_start_of_small_problem(s, rules, own, cold, tol, both, workspaces.work.real):
        return RESULT_IS_START
    if not (solve_by_pivoting(s, own, tol, rules.follows, deadline, workspaces, counts) if s.pivots
            else solve_by_islands(s, rules, own, tol, deadline, workspaces, counts) if s.by_island
            else solve_by_sweeps(s, rules, own, tol, deadline, workspaces, counts)):
        return RESULT_FAILED
    if not grow_workspace_to(&workspaces.work, 0, scratch):
        return RESULT_FAILED
    judge_result_within_bounds(s, own, tol, both, workspaces.work.real)
    return RESULT_SOLVED if s.pivots or s.relative <= tol or has_passed(deadline, 0.0) else RESULT_FAILED


cdef class Rules:
    """Settings of the calls for small problems, `small_rules_t`, from `DECISIONS` of lavender/solvers/decisions.py."""

    def __init__(self, decisions, bint pivots, bint follows):
        self.at = small_rules_t(decisions.small_rows, decisions.call_sweeps, decisions.call_island_rows,
                                decisions.call_factorisations, decisions.call_extrapolation, decisions.warm_residual, pivots,
                                follows)


cdef class Small:
    """A problem with few rows. `data` must hold the residual of the zero impulse; `run` only reads the problem.

    Parameters
    ----------
    data : Data
        Problem for the judge.
    over : Data
        Problem to solve; for bounded rows A in compressed rows.
    by_island : bool
        Whether to solve the islands one by one, which the judge has labelled; there are several, with friction.
    """

    cdef readonly Data data
    cdef Data over
    cdef small_problem_t at
    cdef workspace_t workspace
    cdef workspace_t kept                               # workspace of the last run, which the next run takes

    def __init__(self, Data data, Data over, bint by_island=False):
        self.data, self.over, self.at.by_island = data, over, by_island
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
        cdef bint cold = impulse is None
        cdef deadline_t* until = get_pointer(deadline)
        memset(&workspaces, 0, sizeof(workspaces))
        self.exchange_kept_workspace(&workspaces.work)
        if not cold:
            memcpy(own, as_double_pointer(impulse, m), m * sizeof(double))
        try:
            with nogil:
                code = solve_small(&s, &rules.at, own, cold, tol, until, <double*>both.data, &workspaces, counts)
        finally:
            if workspaces.work.n_real <= MAX_KEPT_DOUBLES:
                self.exchange_kept_workspace(&workspaces.work)
            free_workspace(&workspaces.work)
            free_workspace(&workspaces.more)
        judged = make_judged(self.data, answer, both, &s.score, s.relative, s.floor) if code != RESULT_FAILED else None
        return judged, None if code == RESULT_IS_START else tuple([counts[i] for i in range(N_COUNTS)])


# [s] A limit of at least this does not end the call of few rows, which `solve_general` may repeat if the call fails.
cdef double MIN_LONG_LIMIT = 0.1
cdef tuple NO_CALL = (None, None, None, None), LAWS_OF_ROWS = ("linear", "lcp")
cdef object Problem, Solution, CONVERGED, compute_postponed_fields, make_residual, get_zero_impulse_reference
cdef object solve_new_generalized_problem, name_start


def bind_types(types):
    """Set the classes and functions that `solve_compiled` needs; this package does not import them."""
    global Problem, Solution, CONVERGED, compute_postponed_fields, make_residual, get_zero_impulse_reference
    global solve_new_generalized_problem, name_start
    (Problem, Solution, CONVERGED, compute_postponed_fields, make_residual, get_zero_impulse_reference,
     solve_new_generalized_problem, name_start) = types


cdef bint is_plain_start(impulse, Py_ssize_t m) noexcept:
    """Return whether a start is a contiguous array (m,) of finite numbers, which needs no conversion."""
    if type(impulse) is not ndarray:
        return False
    cdef ndarray x = <ndarray>impulse
    return (x.nd == 1 and x.dimensions[0] == m and x.flags & C_CONTIGUOUS and has_element_type(x, DOUBLE)
            and all_finite(<const double*>x.data, m))


def solve_compiled(problem, spec, impulse, tol, deadline=None):
    """Solve and judge a problem by the compiled call of a solver, unless the call does not accept the problem.

    Parameters
    ----------
    problem : Problem
    spec : SolverSpec
    impulse : (m,) N s, or None
    tol : float, -
    deadline : Deadline, optional
        Time at which the call ends with the iterate so far.

    Returns
    -------
    tuple
        Solution, or None if there is no result within tol; judged result or None; work counts, None if no call was made or
        the start is the result; start (m,) of the call or None.
    """
    small, solution, view = spec.small, None, problem.derived.view
    if small is None or not spec.builtin or not isinstance(tol, float) or not 0.0 < <double>tol < INFINITY:
        return NO_CALL
    if view is not None:
        if small.limits is None or (<Data>view).has_ellipse:
            return NO_CALL
    elif (not (small.pivots if problem.law in LAWS_OF_ROWS else small.hands_over) or problem.has_singular_program
            or len(problem.b) > (<Rules>small.rules).at.small_rows or (<Blocks>problem.cones._blocks).has_ellipse):
        # Islands of larger problems may take long, so `Prepared` solves them between checks of the clock.
        return NO_CALL
    began, first = read_clock(), impulse
    if impulse is None:
        first = problem.guess
    elif not is_plain_start(impulse, len(problem.b)):
        first = problem.make_start(impulse)
    if view is not None and (<Data>view).blocks.n_rows:
        judged, counts = solve_new_generalized_problem(view, first, tol, small.limits, deadline)
        if judged is None and (<Data>view).reference_energy < 0.0:      # The reference of a row needs v*.
            get_zero_impulse_reference(problem)
            judged, counts = solve_new_generalized_problem(view, first, tol, small.limits, deadline)
    else:
        judged, counts = small.solve_and_judge(problem, first, tol, deadline)
    if judged is not None and (<Judged>judged).relative <= <double>tol and (<Judged>judged).roundoff_floor <= <double>tol:
        kept = first if first is None or impulse is None else first.copy()      # The caller may change the array later.
        fields = {
            "impulse": (<Judged>judged).impulse, "status": CONVERGED, "tol": tol, "setup_time": 0.0,
            "solve_time": read_clock() - began, "_late_residual": (make_residual, (problem, judged)),
            "_rest": (compute_postponed_fields, (problem, spec, judged, counts, kept, CONVERGED)),
        }
        if first is not None:
            fields["start"] = name_start(problem.guess, impulse)
        solution = make_instance(Solution, fields)
    return solution, judged, counts, first


def make_solve(solve_general, solve_after_call, dict registered):
    """Return `lavender.solve`: the compiled call if all arguments have their defaults, otherwise `solve_general`.

    `solve_after_call` solves a problem that the call did not solve.
    """
    def solve(problem, solver="auto", *surplus, impulse=None, tol=1e-6, velocity_tol=None, max_iter=None, time_limit=None,
              history=False, callback=None, **options):
        if (velocity_tol is None and max_iter is None and callback is None and history is False and not options
                and not surplus and type(problem) is Problem and type(tol) is float and type(solver) is str):
            spec = registered.get(solver)
            if time_limit is None and spec is not None:
                solution, _, counts, _ = solve_compiled(problem, spec, impulse, tol)
                return solution if solution is not None else solve_after_call(problem, spec, impulse, tol, counts)
            if spec is not None and type(time_limit) is float and time_limit >= MIN_LONG_LIMIT and spec.small is not None \
                    and len(problem.b) <= (<Rules>spec.small.rules).at.small_rows:
                solution = solve_compiled(problem, spec, impulse, tol)[0]
                if solution is not None:
                    return solution
        return solve_general(problem, solver, *surplus, impulse=impulse, tol=tol, velocity_tol=velocity_tol, max_iter=max_iter,
                             time_limit=time_limit, history=history, callback=callback, **options)

    return solve
