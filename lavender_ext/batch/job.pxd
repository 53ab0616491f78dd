"""One problem by J and M, by A or by bodies, without the interpreter: what is worked out of it, its solve, its judgement.

The kernels of a single solve in their order, so the same bits and counts. Workspace is the caller's, and the next problem takes it.
What does not end below tol on the judge's own measure, has an empty row that b asks for or is counted to cost more than is
asked for, is left to the caller.
"""
from libc.stdint cimport int32_t, int64_t
from libc.math cimport INFINITY, NAN, fabs, sqrt
from libc.string cimport memset

from lavender_ext.core.assemble cimport lav_assemble, lav_body_blocks, lav_expand_rows
from lavender_ext.core.door cimport first_outside
from lavender_ext.core.method cimport MORE, REACHED, NEEDS_WORKSPACE, options_t, workspace_t, said_t
from lavender_ext.core.islands cimport islands_index
from lavender_ext.core.parts cimport CONE, blocks_t, is_rows, islands_t
from lavender_ext.core.problem cimport MADE, lav_rows_diagonal, made_t, make_numbers, matrix_numbers
from lavender_ext.core.view cimport csr_t, generalized_t, rows_t, view_t
from lavender_ext.driver.driver cimport NEWTON, lav_workspace_size, lav_start, lav_step
from lavender_ext.factor.tiles cimport has_wide
from lavender_ext.judge.measure cimport (above_floor_of, set_zero_impulse, floor_of, general_score, judge_zero_impulse, refine_view,
                                         relative_of, scratch_of)
from lavender_ext.judge.score cimport new_score, score_t
from lavender_ext.judge.slack cimport general_slack
from lavender_ext.small.call cimport (COUNTS, ENDED, KEPT, are_bounded, few_rules_t, few_t, has_call, lay_few, rooms_t,
                                      run_few)
from lavender_ext.small.limits cimport allowed, cost_of, limits_t, step_cost, work_within
from lavender_ext.small.workspace cimport has_workspace_size
from lavender_ext.batch.world cimport BESIDE, LEFT, READY, STARTED, TRIED, rows_of
from lavender_ext.velocity_newton.soft cimport is_soft


cdef enum:
    STEPS = 128                 # of newton for each island
    # Counted in readings of all entries, fitted to 500 drawn problems; within 1.4 times what nine of ten take.
    READ = 10                   # what is worked out and judged
    FORMED = 3                  # N, beside half of its counted factor
    LINE = 11                   # each row of an evaluation along a line
    LOOKS = 3                   # evaluations of a step


cdef struct job_t:
    blocks_t p
    bint general                # by J and M,
    bint factored               # by bodies; else by A
    generalized_t g
    csr_t a
    rows_t r
    const double* dense         # A (m, m), of which `a` is to be made
    int64_t row                 # numbers from one row of it to the next
    made_t made                 # of the data, or of this call
    bint known                  # it is this problem's
    double begin[3]             # E0, V0, relative residual of the zero impulse; E0 < 0: not known
    islands_t islands           # what p.islands points to, if this call found them
    double* by_island           # NULL, or (n, 2) for `score_t.by_island`
    int32_t cold                # 1: from doing nothing, else from lam as it is
    double most                 # ns that it may cost as counted, then what it has come to is the result; inf: to the end
    bint solved
    bint spent                  # what it might cost is
    int32_t counts[COUNTS]      # steps, factorisations, rounds, evaluations; or as of `run_few`
    double* lam                 # (m)
    double* both                # (2 m + 1) w, e
    const double* push          # (n) M^-1 J^T lam of the judge, not of A; in workspace that the next world takes
    score_t score
    double relative, floor, above_floor
    double float64_relative     # of the first pass; NaN if it was not refined


cdef struct few_rooms_t:        # of one thread
    workspace_t islands              # of `begin`
    workspace_t made                 # A, d, nu and step
    workspace_t formed               # of `form_matrix`
    workspace_t kept                 # of `lay_few`
    rooms_t call


cdef inline bint begin(job_t* j, view_t* v, workspace_t* islands, double* w) noexcept nogil:
    """E0, V0 and the relative residual of the zero impulse, with islands in that workspace; False without memory for it.

    v: the view of the job's data; w (3 m + `scratch_of`) is scratch.
    """
    cdef ssize_t m = j.p.n_rows
    if not has_workspace_size(islands, islands_index(v), 2 * <int64_t>j.p.n_blocks):
        return False
    judge_zero_impulse(v, islands.index, &j.islands, islands.real, w + 2 * m, w, w + m, w + 3 * m, j.begin)
    j.p.islands = v.p.islands
    return True


cdef inline double spent_by(const job_t* j, const limits_t* l, double work, int32_t factored, double lines) noexcept nogil:
    """What so many factorisations and evaluations along lines are counted to have cost, with what is read before and after [ns]."""
    cdef double once = step_cost(&j.p, &j.g, l, 0.0)
    return (READ + FORMED * factored) * once + 0.5 * factored * l.work * work + LINE * l.entry * j.p.n_rows * lines


cdef inline int32_t step_within(job_t* j, const view_t* v, const options_t* o, const workspace_t* r,
                                const limits_t* l) noexcept nogil:
    """Steps for as long as what they did is counted to cost less than `most` of the job: `spent` where it is not over then.

    Those that factor nothing are cheap, so it is asked again for as many as what is left is for if each did.
    """
    cdef said_t said = said_t(0, 0, 0, 0, 0.0, NULL, NULL)
    cdef int32_t code = MORE
    cdef double each = spent_by(j, l, r.work, 1, LOOKS) - spent_by(j, l, r.work, 0, 0.0), fit = 1.0
    while code == MORE and fit >= 1.0:
        fit = (j.most - spent_by(j, l, r.work, said.factorisations, said.evaluations)) / each
        code = lav_step(v, o, r, <int32_t>max(fit, 0.0) if fit < o.budget else o.budget, j.lam, &said)
    j.counts[0], j.counts[1], j.counts[2], j.counts[3] = said.work, said.factorisations, said.rounds, said.evaluations
    j.spent = code == MORE
    return code


cdef inline bint settle_empty_rows(const job_t* j, double tol) noexcept nogil:
    """Rows of zeros at the bound that b asks for, as `decide_empty_rows` of lavender/solving/outcome.py.

    0 where that is infinite and b alone is above tol, or where A_ii is 0 only because products of small numbers vanish.
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
            if p.b[k] == 0.0 or (not is_rows(p, i) and k > p.ptr[i]):
                continue                                # asks nothing: tangents and spin have bounds of mu lambda_n
            if p.b[k] < 0.0 and p.law == CONE and not is_rows(p, i) and p.ptr[i + 1] - p.ptr[i] > 1:
                continue                                # a normal that separates bears friction of a contact that slides
            bound = p.upper[k] if p.b[k] > 0.0 else p.lower[k]
            if fabs(bound) < INFINITY:
                j.lam[k] = bound
            elif fabs(p.b[k]) * sqrt(p.nu[k] / p.d[k]) > tol * j.begin[1]:
                return False
    return True


cdef inline int64_t judging_size(const job_t* j) noexcept nogil:
    """Numbers of scratch of `judge_job`."""
    cdef view_t v = view_t(j.p, NULL, NULL, &j.g)
    return j.g.n + scratch_of(&v)


cdef inline void judge_job(job_t* j, double tol, double* x) noexcept nogil:
    """The judge's pass over lam, refined for `tol`, with what it pushes kept; x (`judging_size`) is scratch."""
    cdef view_t v = view_t(j.p, NULL, NULL, &j.g)
    cdef int32_t m = j.p.n_rows
    j.score = new_score()
    j.score.by_island = j.by_island
    general_slack(&j.p, &j.g, j.lam, x, j.both)
    general_score(&j.p, &j.g, j.lam, j.both, j.both + m, x + j.g.n, &j.score)
    j.push = x
    j.relative = relative_of(&j.score, j.both, m, j.begin[0], j.begin[1])
    j.float64_relative = NAN
    if refine_view(&v, j.lam, j.both, j.both + m, x + j.g.n, j.begin[0], j.begin[1], tol, j.relative, &j.score):
        j.float64_relative = j.relative
        j.relative = relative_of(&j.score, j.both, m, j.begin[0], j.begin[1])
    j.floor = floor_of(&j.score, j.begin[0], j.begin[1])
    j.above_floor = above_floor_of(&j.score, j.relative, j.floor)


cdef inline bint has_numbers(job_t* j) noexcept nogil:
    """d, Y and what goes with them, worked out now unless they are known; within the door?"""
    if not j.known:
        j.known = make_numbers(&j.p, &j.g, &j.made) == MADE
    return j.known and first_outside(j.p.d, j.p.n_rows) < 0


cdef inline void solve_job(job_t* j, workspace_t* workspace, workspace_t* islands, const limits_t* limits,
                           double tol) noexcept nogil:
    cdef view_t v
    cdef options_t o = options_t(NEWTON, STEPS, 0, 0, has_wide(), tol, 0.0, 0.0, limits.values, 0.0)
    cdef workspace_t r
    cdef int32_t m = j.p.n_rows, code = NEEDS_WORKSPACE
    cdef bint soft
    j.counts[0] = j.counts[1] = j.counts[2] = j.counts[3] = 0
    if not has_numbers(j):
        return
    if not has_workspace_size(workspace, 0, 3 * <ssize_t>m + j.g.n):
        return
    v = view_t(j.p, NULL, NULL, &j.g)
    if j.begin[0] < 0.0 and not begin(j, &v, islands, workspace.real):
        return
    soft = is_soft(&j.p, &j.g)
    o.work = work_within(&j.p, &j.g, limits, soft)
    if not o.work > 0.0:
        return
    lav_workspace_size(&v, &o, &r)
    while code == NEEDS_WORKSPACE and not r.laid:
        if not has_workspace_size(workspace, r.n_index, 0):
            return
        r.index = workspace.index
        code = lav_start(&v, &o, &r, j.lam)
    if code != NEEDS_WORKSPACE or cost_of(&j.p, &j.g, limits, r.work, soft) > allowed(&j.p, &j.g, limits, r.islands, soft):
        return
    if not has_workspace_size(workspace, 0, r.n_real):
        return
    r.real = workspace.real
    o.budget = <int32_t>min(<double>STEPS * r.islands, limits.steps)
    o.e0, o.v0 = j.begin[0], j.begin[1]
    if j.cold:
        set_zero_impulse(&j.p, j.lam, j.both)
    if j.made.n_empty and not settle_empty_rows(j, tol):
        return
    lav_start(&v, &o, &r, j.lam)
    code = step_within(j, &v, &o, &r, limits)
    if code != REACHED and not j.spent:
        return
    if not has_workspace_size(workspace, 0, judging_size(j)):
        return
    judge_job(j, tol, workspace.real)
    j.solved = j.relative <= tol


cdef inline bint make_matrix(job_t* j, workspace_t* workspace) noexcept nogil:
    """A in compressed rows, d, nu and step in `workspace`."""
    cdef int64_t m = j.p.n_rows, entries = m * m + BESIDE if j.dense != NULL else 0
    cdef double* x
    cdef int32_t* empty
    if not has_workspace_size(workspace, 2 * (m + 1) + entries, 3 * (m + 1) + entries):
        return False
    x, empty = workspace.real, workspace.index
    if j.dense != NULL:
        j.a.indptr, j.a.indices, j.a.data = empty + m + 1, empty + 2 * (m + 1), x + 3 * (m + 1)
        rows_of(j.dense, j.row, j.p.n_rows, j.p.n_rows, <int32_t*>j.a.indptr, <int32_t*>j.a.indices, <double*>j.a.data)
    j.p.d, j.p.nu, j.p.step = x, x + m + 1, x + 2 * (m + 1)
    j.made.n_empty = matrix_numbers(&j.p, &j.a, x, x + m + 1, x + 2 * (m + 1), empty)
    return True


cdef inline bint make_bodies(job_t* j, workspace_t* workspace) noexcept nogil:
    """d, nu, step, M^-1 J^T of joints, coupling and swing of contacts in `workspace`; within the door?"""
    cdef int64_t m = j.p.n_rows, joints = j.p.ptr[j.r.n_joints], c = j.r.n_contacts
    cdef int64_t n = 3 * (m + 1) + 12 * joints + 5 * c + 6 * (m - joints)
    cdef double* x
    cdef double* of_joints
    if not has_workspace_size(workspace, m + 1, n):
        return False
    x, of_joints = workspace.real, workspace.real + 3 * (m + 1)
    memset(x, 0, n * sizeof(double))
    j.p.d, j.p.nu, j.p.step = x, x + m + 1, x + 2 * (m + 1)
    j.r.minv_jac, j.r.coupling, j.r.swing = of_joints, of_joints + 12 * joints, of_joints + 12 * joints + 5 * c
    j.made.n_empty = lav_rows_diagonal(&j.p, &j.r, x, x + m + 1, x + 2 * (m + 1), workspace.index, of_joints,
                                       of_joints + 12 * joints,
                                       of_joints + 12 * joints + 5 * c)
    return first_outside(j.p.d, m) < 0


cdef inline bint form_matrix(job_t* j, few_t* s, workspace_t* workspace) noexcept nogil:
    """A of bodies in `workspace`, to be solved in their stead: d of its own, and nu of theirs."""
    cdef int64_t m = j.p.n_rows, k = j.p.n_blocks, most
    cdef int32_t* start
    cdef int32_t* blocks
    cdef int32_t* near
    cdef int32_t* ptr
    cdef double* x
    if not has_workspace_size(workspace, j.r.n_bodies + 6 * k + 3 * m + m * m + 7, 3 * (m + 1) + 24 * m + m * m + 1):
        return False
    start, x = workspace.index, workspace.real
    blocks = start + j.r.n_bodies + 1
    near = blocks + 2 * k + 1
    ptr = near + 4 * k + 2 + m
    lav_body_blocks(&j.p, &j.r, start, blocks, &most)
    j.a.indptr, j.a.indices, j.a.data = ptr, ptr + 2 * (m + 1), x + 3 * (m + 1) + 24 * m
    lav_expand_rows(&j.p, &j.r, x + 3 * (m + 1), x + 3 * (m + 1) + 12 * m)
    lav_assemble(&j.p, &j.r, x + 3 * (m + 1), x + 3 * (m + 1) + 12 * m, start, blocks, near, near + 2 * k + 1, near + 4 * k + 2,
                 ptr, <int32_t*>j.a.indices, <double*>j.a.data)
    s.over = view_t(j.p, &j.a, NULL, NULL)
    s.over.p.d, s.over.p.nu, s.over.p.step = x, j.p.nu, x + 2 * (m + 1)
    matrix_numbers(&s.over.p, &j.a, x, x + m + 1, x + 2 * (m + 1), ptr + m + 1)
    return True


cdef inline view_t view_of(job_t* j) noexcept nogil:
    """As the judge reads it."""
    cdef view_t v = view_t(j.p, NULL, NULL, NULL)
    if j.general:
        v.g = &j.g
    elif j.factored:
        v.r = &j.r
    else:
        v.a = &j.a
    return v


cdef inline bint prepare_few(job_t* j, few_t* s, few_rooms_t* rooms) noexcept nogil:
    """What is worked out of A or bodies before a solve or the judge; False where it is left to the caller, as are empty rows."""
    cdef int64_t m = j.p.n_rows
    if not j.known:
        j.known = make_bodies(j, &rooms.made) if j.factored else make_matrix(j, &rooms.made)
    if not j.known or j.made.n_empty:
        return False
    s.v = view_of(j)
    if j.begin[0] < 0.0:
        if not has_workspace_size(&rooms.call.work, 0, 3 * m + scratch_of(&s.v)):
            return False
        if not begin(j, &s.v, &rooms.islands, rooms.call.work.real):
            return False
    s.over = s.v
    s.begin[0], s.begin[1], s.begin[2] = j.begin[0], j.begin[1], j.begin[2]
    return j.begin[2] >= 0.0


cdef inline void found_by(job_t* j, const few_t* s) noexcept nogil:
    j.score, j.relative, j.floor, j.float64_relative = s.score, s.relative, s.floor, NAN
    j.above_floor = above_floor_of(&s.score, s.relative, s.floor)


cdef inline int32_t solve_few(job_t* j, few_rooms_t* rooms, const few_rules_t* rules, double tol) noexcept nogil:
    """A or bodies by the call of few rows; LEFT, TRIED, STARTED or READY."""
    cdef few_t s
    cdef int32_t code
    cdef bint pivots = are_bounded(&j.p)
    if j.p.n_rows > rules.rows or not has_call(&j.p) or not (rules.pivots if pivots else rules.follows):
        return LEFT
    if not prepare_few(j, &s, rooms) or (pivots and j.factored and not form_matrix(j, &s, &rooms.formed)):
        return LEFT
    if not lay_few(&s, &rooms.kept):
        return LEFT
    code = run_few(&s, rules, j.lam, j.cold, tol, j.most, j.both, &rooms.call, j.counts)
    found_by(j, &s)
    j.push = rooms.call.work.real + (j.p.n_rows if code == KEPT else 0)
    if code != KEPT and code != ENDED:
        return TRIED
    return LEFT if not s.relative <= tol else STARTED if code == KEPT else READY
