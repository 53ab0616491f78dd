"""A few contacts, or one island of contacts: accelerated sweeps, then Newton's method if they are slow.

One call solves a subproblem over A or over bodies in the caller's workspace.
"""
from libc.stdint cimport int32_t, int64_t, uint64_t
from libc.string cimport memcmp, memcpy, memset

from lavender_ext.accelerate.accelerated cimport acceleration_t, lav_anderson
from lavender_ext.accelerate.mixing cimport CONTROL, MAX_MEMORY, UNDONE
from lavender_ext.core.deadline cimport deadline_t, has_passed
from lavender_ext.core.method cimport MORE, NEEDS_WORKSPACE, info_t, options_t, workspace_t
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport view_t
from lavender_ext.driver.driver cimport NEWTON, lav_analyse, lav_start, lav_step
from lavender_ext.host cimport grow_workspace_to
from lavender_ext.judge.measure cimport set_zero_impulse, find_reference, judge_view, relative_residual_of_score
from lavender_ext.judge.score cimport make_empty_score, score_t
from lavender_ext.small.call cimport small_rules_t
from lavender_ext.sweep.serial cimport compute_sweep_velocities, sweep_context_t


cdef enum:
    MIXING_MEMORY = 5           # number of sweeps that Anderson mixing combines
    MIN_CHECK_INTERVAL = 4      # Sweeps before the first check of the residual. Later checks follow after half as many as are done.
    SWEEP_NS_PER_ROW = 15       # estimated cost of a sweep with its mixing [ns] per row of A; in addition 1 ns per entry of A
    SWEEP_NS_PER_BODY_ROW = 32  # estimated cost of a sweep with its mixing [ns] per row over bodies


cdef struct subproblem_t:
    view_t v                    # problem over A or over bodies
    double* lam                 # (m) N s, start
    double* answer              # (m) N s, result
    int32_t split               # number of joint blocks, which are swept before the contacts
    const int32_t* at           # offsets into `prepared` if blocks are solved exactly (`prepare_exact_blocks`), else NULL
    const double* prepared
    double relative_at_zero     # relative residual of the zero impulse; -1: not known, which is the case for an island
    double e0                   # energy error of the zero impulse, the reference, sqrt J
    double v0                   # velocity error of the zero impulse, the reference, m/s


cdef struct friction_run_t:     # settings and counters of a run over one or several subproblems
    const small_rules_t* rules
    double tol
    int32_t max_sweeps          # largest number of sweeps of one subproblem, before the first factorisation
    int32_t wide
    int64_t swept               # counters over all subproblems
    int64_t undone
    int64_t factorisations
    double factored             # multiply-adds of the factorisations
    deadline_t* deadline        # time at which the run ends with its iterate, or NULL
    int32_t factorised          # number of subproblems that used factorisations
    int32_t longest             # largest number of sweeps plus factorisations of one subproblem


cdef struct subproblem_run_t:      # state of one subproblem
    subproblem_t* s
    friction_run_t* o
    workspace_t* r              # workspace of Newton's method
    double e0                   # reference of the subproblem, sqrt J
    double v0                   # m/s
    double* swept               # (m) N s, iterate of the sweeps
    double* w                   # (m)
    double* error               # (m)
    double* scratch             # (12 n_bodies)
    sweep_context_t sweeps
    acceleration_t c
    options_t options
    workspace_t workspace
    info_t info
    double sweep                # estimated cost of a sweep, ns


cdef inline int64_t subproblem_work_size(int64_t m, int64_t n_bodies) noexcept nogil:
    """Return the number of doubles of scratch of `solve_subproblem`."""
    return (7 + 2 * MIXING_MEMORY) * m + 18 * n_bodies + CONTROL + MAX_MEMORY * MAX_MEMORY + 1


cdef inline void bind_subproblem_arrays(subproblem_run_t* t, double* work, int32_t* order, uint64_t* rng) noexcept nogil:
    """Bind the arrays to work (`subproblem_work_size`) and order (k)."""
    cdef const view_t* v = &t.s.v
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
    t.sweeps.order, t.sweeps.rng, t.sweeps.split = order, rng, t.s.split
    t.sweeps.exact, t.sweeps.start, t.sweeps.prepared = t.s.at != NULL, t.s.at, t.s.prepared


cdef inline double judge_subproblem_impulse(subproblem_run_t* t, const double* lam) noexcept nogil:
    """Return the relative residual of lam (m) [N s], relative to the subproblem's zero impulse."""
    cdef const view_t* v = &t.s.v
    cdef score_t score = make_empty_score()
    judge_view(v, lam, t.w, t.error, t.scratch, False, &score)
    return relative_residual_of_score(&score, t.w, v.p.n_rows, t.e0, t.v0)


cdef inline bint predicts_convergence(double before, double now, double tol, int32_t rounds) noexcept nogil:
    """Return whether the last check's reduction, repeated `rounds` times, brings the residual to tol."""
    cdef double reduction = now / before
    cdef int32_t _
    for _ in range(rounds):
        now *= reduction
        if now <= tol:
            return True
    return False


cdef inline double run_sweeps(subproblem_run_t* t, double now) noexcept nogil:
    """Sweep from the relative residual `now` of `swept`, and return the new one.

    The sweeps end early if the extrapolated residual does not reach tol.
    """
    cdef double before, tol = t.o.tol
    cdef int32_t step = MIN_CHECK_INTERVAL, max_sweeps = t.o.max_sweeps
    while now > tol and t.c.iterations < max_sweeps and not has_passed(t.o.deadline, step * t.sweep):
        before = now
        lav_anderson(&t.c, t.swept, t.c.iterations == 0, step)
        now = judge_subproblem_impulse(t, t.swept)
        step = t.c.iterations // 2 if t.c.iterations // 2 > MIN_CHECK_INTERVAL else MIN_CHECK_INTERVAL
        if not predicts_convergence(before, now, tol, t.o.rules.call_extrapolation * (max_sweeps - t.c.iterations) // step):
            break
    return now


cdef inline double run_newton(subproblem_run_t* t) noexcept nogil:
    """Run up to `call_factorisations` of Newton's method from `answer`, and return the relative residual."""
    cdef int32_t how
    t.info.work = t.info.factorisations = 0
    how = lav_analyse(&t.s.v, &t.options, &t.workspace, t.r, grow_workspace_to)
    if how == NEEDS_WORKSPACE:
        how = lav_start(&t.s.v, &t.options, &t.workspace, t.s.answer, t.r, grow_workspace_to)
    if how != MORE:
        return 1.0 / 0.0
    lav_step(&t.s.v, &t.options, &t.workspace, t.o.rules.call_factorisations, t.s.answer, &t.info)
    return judge_subproblem_impulse(t, t.s.answer)


cdef inline bint solve_subproblem(subproblem_t* s, friction_run_t* o, workspace_t* r, double* work, int32_t* order) noexcept nogil:
    """Solve a subproblem from `lam` into `answer`; return whether its relative residual is at most `tol`."""
    cdef score_t score_at_zero = make_empty_score()
    cdef subproblem_run_t t
    cdef uint64_t rng
    cdef blocks_t* p = &s.v.p
    cdef double now = s.relative_at_zero
    cdef double zero_residual[3]
    t.s, t.o, t.r = s, o, r
    bind_subproblem_arrays(&t, work, order, &rng)
    # reference: the residual of the zero impulse
    set_zero_impulse(p, s.answer, t.w)
    zero_residual[0], zero_residual[1], zero_residual[2] = s.e0, s.v0, now
    if now < 0.0:
        judge_view(&s.v, s.answer, t.w, t.error, t.scratch, False, &score_at_zero)
        find_reference(p, s.answer, t.w, t.error, zero_residual)
        if zero_residual[2] <= o.tol:
            return True                                 # the zero impulse is a solution
    t.e0, t.v0 = zero_residual[0], zero_residual[1]
    # residual of the start
    memcpy(t.swept, s.lam, p.n_rows * sizeof(double))
    compute_sweep_velocities(&t.sweeps, t.swept)
    t.info.factorisations = 0
    if memcmp(t.swept, s.answer, p.n_rows * sizeof(double)) != 0:
        now = judge_subproblem_impulse(&t, t.swept)
    else:
        now = zero_residual[2]
    t.sweep = SWEEP_NS_PER_ROW * p.n_rows + (s.v.a.indptr[p.n_rows] if s.v.a != NULL else SWEEP_NS_PER_BODY_ROW * p.n_rows)
    # sweeps, then Newton's method
    now = run_sweeps(&t, now)
    if now <= o.tol or now < 1.0:
        memcpy(s.answer, t.swept, p.n_rows * sizeof(double))
    if now > o.tol and not has_passed(o.deadline, 0.0):
        o.factorised += 1
        t.options = options_t(NEWTON, o.rules.call_factorisations, 0, 0, o.wide, o.tol, t.e0, t.v0, 1.0 / 0.0, 0.0,
                              o.deadline, NULL)
        now = run_newton(&t)
    # counters
    o.swept += t.c.iterations
    o.undone += <int64_t>t.c.control[UNDONE]
    o.factorisations += t.info.factorisations
    o.factored += t.info.factorisations * (<double>p.n_rows * p.n_rows * p.n_rows)
    if t.c.iterations + t.info.factorisations > o.longest:
        o.longest = t.c.iterations + t.info.factorisations
    # after the deadline the better of both iterates is the result
    if (now > o.tol and has_passed(o.deadline, 0.0)
            and not judge_subproblem_impulse(&t, s.answer) <= judge_subproblem_impulse(&t, t.swept)):
        memcpy(s.answer, t.swept, p.n_rows * sizeof(double))
    return now <= o.tol
