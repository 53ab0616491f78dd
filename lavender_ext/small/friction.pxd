"""A few contacts, or one island of contacts: accelerated sweeps, then Newton's method if they are slow.

One call solves a subproblem over A or over bodies in the caller's workspace.
"""
from libc.math cimport INFINITY
from libc.stdint cimport int32_t, int64_t, uint64_t
from libc.string cimport memcmp, memcpy, memset

from lavender_ext.accelerate.accelerated cimport acceleration_t, lav_anderson
from lavender_ext.accelerate.mixing cimport CONTROL, MAX_MEMORY, UNDONE
from lavender_ext.core.deadline cimport has_passed
from lavender_ext.core.method cimport MORE, NEEDS_WORKSPACE, info_t, options_t, workspace_t
from lavender_ext.core.view cimport view_t
from lavender_ext.driver.driver cimport NEWTON, lav_analyse, lav_start, lav_step
from lavender_ext.factor.factors cimport has_wide
from lavender_ext.host cimport grow_workspace_to
from lavender_ext.judge.measure cimport set_zero_impulse, find_reference, judge_view, relative_residual_of_score
from lavender_ext.judge.score cimport make_empty_score, score_t
from lavender_ext.small.task cimport small_rules_t, task_t
from lavender_ext.sweep.serial cimport compute_sweep_velocities, sweep_context_t


cdef enum:
    MIXING_MEMORY = 5           # number of sweeps that Anderson mixing combines
    MIN_CHECK_INTERVAL = 4      # Sweeps before the first check of the residual. Later checks follow after half as many as are done.
    SWEEP_NS_PER_ROW = 15       # estimated cost of a sweep with its mixing [ns] per row of A; in addition 1 ns per entry of A
    SWEEP_NS_PER_BODY_ROW = 32  # estimated cost of a sweep with its mixing [ns] per row over bodies

cdef enum:                      # counters of a run over one or several subproblems
    LONGEST = 0                 # sweeps plus factorisations of the subproblem with the largest number of them
    SWEEPS = 1
    UNDONE_SWEEPS = 2
    FACTORISATIONS = 3
    FACTORISED = 4              # subproblems that used factorisations
    SUBPROBLEMS = 5


cdef struct subproblem_run_t:   # state of one subproblem
    task_t* j
    double* swept               # (m) N s, iterate of the sweeps
    double* w                   # (m)
    double* error               # (m)
    double* scratch             # (12 n_bodies)
    sweep_context_t sweeps
    acceleration_t c


cdef inline int64_t subproblem_work_size(int64_t m, int64_t n_bodies) noexcept nogil:
    """Return the number of doubles of scratch of `solve_subproblem`."""
    return (7 + 2 * MIXING_MEMORY) * m + 18 * n_bodies + CONTROL + MAX_MEMORY * MAX_MEMORY + 1


cdef inline void bind_subproblem_arrays(subproblem_run_t* t, double* work, int32_t* order, uint64_t* rng) noexcept nogil:
    """Bind the arrays to work (`subproblem_work_size`) and order (k)."""
    cdef const view_t* v = &t.j.v
    cdef int64_t m = v.p.n_rows, n = v.r.n_bodies if v.r != NULL else 0
    cdef int32_t i
    t.swept, t.w, t.error, t.scratch = work, work + m, work + 2 * m, work + 3 * m
    work += 3 * m + 12 * n
    memset(&t.c, 0, sizeof(t.c))
    memset(&t.sweeps, 0, sizeof(t.sweeps))
    t.sweeps.v, t.c.control, t.c.gram = work, work + 6 * n, work + 6 * n + CONTROL
    t.c.work = t.c.gram + MAX_MEMORY * MAX_MEMORY
    memset(t.c.control, 0, (CONTROL + MAX_MEMORY * MAX_MEMORY) * sizeof(double))
    for i in range(v.p.n_blocks):
        order[i] = i
    rng[0] = 0
    t.c.sweeps, t.c.memory = &t.sweeps, MIXING_MEMORY
    t.sweeps.blocks, t.sweeps.csr, t.sweeps.rows, t.sweeps.n_v = &v.p, v.a, v.r, <int32_t>(6 * n)
    t.sweeps.order, t.sweeps.rng, t.sweeps.split = order, rng, t.j.split
    t.sweeps.exact, t.sweeps.start, t.sweeps.prepared = t.j.at != NULL, t.j.at, t.j.prepared


cdef inline double judge_subproblem_impulse(subproblem_run_t* t, const double* lam) noexcept nogil:
    """Return the relative residual of lam (m) [N s], relative to the subproblem's zero impulse."""
    cdef const view_t* v = &t.j.v
    cdef score_t score = make_empty_score()
    judge_view(v, lam, t.w, t.error, t.scratch, False, &score)
    return relative_residual_of_score(&score, t.w, v.p.n_rows, t.j.zero_residual[0], t.j.zero_residual[1])


cdef inline double run_sweeps(subproblem_run_t* t, double now, int32_t max_sweeps, int32_t extrapolation,
                              double sweep_ns) noexcept nogil:
    """Sweep from the relative residual `now` of `swept`, and return the new one.

    The sweeps end early if the last check's reduction, repeated for the remaining checks times `extrapolation`, does not reach tol.
    """
    cdef double before, predicted, tol = t.j.tol
    cdef int32_t rounds, step = MIN_CHECK_INTERVAL
    while now > tol and t.c.iterations < max_sweeps and not has_passed(t.j.deadline, step * sweep_ns):
        before = now
        lav_anderson(&t.c, t.swept, t.c.iterations == 0, step)
        now = predicted = judge_subproblem_impulse(t, t.swept)
        step = max(t.c.iterations // 2, MIN_CHECK_INTERVAL)
        rounds = extrapolation * (max_sweeps - t.c.iterations) // step
        while predicted > tol and rounds > 0:
            predicted *= now / before
            rounds -= 1
        if not predicted <= tol:
            break
    return now


cdef inline bint solve_subproblem(task_t* j, const double* start, const small_rules_t* rules, int32_t max_sweeps, workspace_t* more,
                                  double* work, int32_t* order, int32_t* counts) noexcept nogil:
    """Solve a subproblem from `start` (m) [N s], which may be `lam`, into `lam`; return whether its residual is at most tol.

    The residual of the zero impulse is computed first if it is not known (-1), which is the case for an island. At most
    `max_sweeps` sweeps precede the first factorisation. The work is added to counts (`LONGEST`, ...).
    """
    cdef score_t score_at_zero = make_empty_score()
    cdef subproblem_run_t t
    cdef uint64_t rng
    cdef int32_t m = j.v.p.n_rows
    cdef options_t options = options_t(NEWTON, rules.call_factorisations, 0, 0, has_wide(), j.tol, 0.0, 0.0, INFINITY, 0.0,
                                       j.deadline, NULL)
    cdef info_t info = info_t(0, 0, 0, 0, 0.0, NULL, NULL)
    cdef workspace_t r
    cdef double now
    t.j = j
    bind_subproblem_arrays(&t, work, order, &rng)
    memcpy(t.swept, start, m * sizeof(double))
    # reference: the residual of the zero impulse
    set_zero_impulse(&j.v.p, j.lam, t.w)
    if j.zero_residual[2] < 0.0:
        judge_view(&j.v, j.lam, t.w, t.error, t.scratch, False, &score_at_zero)
        find_reference(&j.v.p, j.lam, t.w, t.error, j.zero_residual)
        if j.zero_residual[2] <= j.tol:
            return True                                 # the zero impulse is a solution
    # residual of the start
    compute_sweep_velocities(&t.sweeps, t.swept)
    now = j.zero_residual[2]
    if memcmp(t.swept, j.lam, m * sizeof(double)) != 0:
        now = judge_subproblem_impulse(&t, t.swept)
    # sweeps
    now = run_sweeps(&t, now, max_sweeps, rules.call_extrapolation,
                     SWEEP_NS_PER_ROW * m + j.v.a.indptr[m] if j.v.a != NULL
                     else (SWEEP_NS_PER_ROW + SWEEP_NS_PER_BODY_ROW) * m)
    if now <= j.tol or now < 1.0:
        memcpy(j.lam, t.swept, m * sizeof(double))
    # Newton's method
    if now > j.tol and not has_passed(j.deadline, 0.0):
        counts[FACTORISED] += 1
        options.e0, options.v0, now = j.zero_residual[0], j.zero_residual[1], INFINITY
        if lav_analyse(&j.v, &options, &r, more, grow_workspace_to) == NEEDS_WORKSPACE \
                and lav_start(&j.v, &options, &r, j.lam, more, grow_workspace_to) == MORE:
            lav_step(&j.v, &options, &r, options.budget, j.lam, &info)
            now = judge_subproblem_impulse(&t, j.lam)
    # counters
    counts[SWEEPS] += t.c.iterations
    counts[UNDONE_SWEEPS] += <int32_t>t.c.control[UNDONE]
    counts[FACTORISATIONS] += info.factorisations
    counts[LONGEST] = max(counts[LONGEST], t.c.iterations + info.factorisations)
    # after the deadline the better of both iterates is the result
    if (now > j.tol and has_passed(j.deadline, 0.0)
            and not judge_subproblem_impulse(&t, j.lam) <= judge_subproblem_impulse(&t, t.swept)):
        memcpy(j.lam, t.swept, m * sizeof(double))
    return now <= j.tol
