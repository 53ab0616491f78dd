"""A few contacts, or an island of them: accelerated sweeps, and where these are slow Newton's method, in turns.

One call solves a part over A or over bodies, in workspace that the caller has. Factors go on where they stood; so do sweeps.
"""
from libc.stdint cimport int32_t, int64_t, uint64_t
from libc.string cimport memcmp, memcpy, memset

from lavender_ext.accelerate.accelerated cimport lav_anderson, sweep_data_t
from lavender_ext.accelerate.mixing cimport CONTROL, MAX_MEMORY, UNDONE
from lavender_ext.core.method cimport CERTIFICATE, MORE, NEEDS_WORKSPACE, options_t, workspace_t, said_t
from lavender_ext.core.parts cimport CONE, blocks_t
from lavender_ext.core.view cimport csr_t, view_t
from lavender_ext.driver.driver cimport NEWTON, lav_workspace_size, lav_start, lav_step
from lavender_ext.small.workspace cimport has_workspace_size
from lavender_ext.judge.measure cimport set_zero_impulse, find_reference, judge_view, relative_of
from lavender_ext.judge.score cimport new_score, score_t
from lavender_ext.sweep.serial cimport context_t, form_velocity


cdef enum:
    MEMORY = 5                  # sweeps that are combined
    FIRST = 4                   # before the first check
    SHORT = 12                  # factorisations before sweeps have AGAIN times as many as before them; of each in the mean,
    AGAIN = 8
    STEPS = 120                 # and in all
    HOPED = 4                   # times the rounds left, that what the last one gained may promise an end in
    SWEPT_ROW = 15              # ns of a sweep with its mixing for each row, beside one for each entry of A,
    SWEPT_BODIES = 32           # and as many for each row over bodies
    FACTOR_ROW = 150            # ns of a factorisation and the steps with it for each row,
    CUBED = 10                  # and one for so many of all rows cubed


cdef struct part_t:
    view_t v                    # over A or bodies
    double* lam                 # (m) N s, where it starts
    double* answer              # (m)
    int32_t split               # blocks before it are swept before the others: joints, contacts
    const int32_t* at           # of blocks that are solved exactly, as gauss_seidel.prepare has them; else NULL
    const double* prepared
    double nothing              # relative residual of the zero impulse if the part is the whole, else -1
    double e0                   # and its reference, sqrt J
    double v0                   # m/s


cdef struct ask_t:
    double tol
    int32_t most                # sweeps, an eighth of all,
    int32_t first               # and before the first factors
    int32_t wide
    int64_t swept               # what was done in all
    int64_t undone
    int64_t factorisations
    double factored             # multiply-adds of them
    double left                 # ns that may still be spent, as counted below; inf without a limit
    int32_t driven              # parts that asked for factors
    int32_t longest             # sweeps and factorisations of one part


cdef struct turns_t:            # of one part
    part_t* s
    ask_t* o
    workspace_t* r                   # of Newton's method
    double e0                   # the part's reference, sqrt J
    double v0                   # m/s
    double* swept               # (m) N s
    double* w                   # (m)
    double* error               # (m)
    double* scratch             # (12 n_bodies)
    context_t sweeps
    sweep_data_t c
    options_t options
    workspace_t workspace
    said_t said
    int32_t how
    double sweep                # ns of one sweep and
    double factor               # of one factorisation with its steps, counted: no clock is read here


cdef inline int64_t work_of(int64_t m, int64_t n_bodies) noexcept nogil:
    return (7 + 2 * MEMORY) * m + 18 * n_bodies + CONTROL + MAX_MEMORY * MAX_MEMORY + 1


cdef inline void lay_turns(turns_t* t, double* work, int32_t* order, uint64_t* rng) noexcept nogil:
    """Places in work (`work_of`) and order (k)."""
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
    t.c.sweeps, t.c.memory = &t.sweeps, MEMORY
    t.sweeps.blocks, t.sweeps.csr, t.sweeps.rows, t.sweeps.n_v = &v.p, v.a, v.r, <int32_t>(6 * n)
    t.sweeps.order, t.sweeps.rng, t.sweeps.split = order, rng, t.s.split
    t.sweeps.exact, t.sweeps.start, t.sweeps.g = t.s.at != NULL, t.s.at, t.s.prepared


cdef inline double spent(const turns_t* t) noexcept nogil:
    """ns of this part so far."""
    return t.c.turn * t.sweep + t.said.factorisations * t.factor


cdef inline double found_at(turns_t* t, const double* lam) noexcept nogil:
    cdef const view_t* v = &t.s.v
    cdef score_t found = new_score()
    judge_view(v, lam, t.w, t.error, t.scratch, False, &found)
    return relative_of(&found, t.w, v.p.n_rows, t.e0, t.v0)


cdef inline bint promises(double before, double now, double tol, int32_t rounds) noexcept nogil:
    """Does what the last round gained bring the residual to tol in so many more?"""
    cdef double fall = now / before
    cdef int32_t _
    for _ in range(rounds):
        now *= fall
        if now <= tol:
            return True
    return False


cdef inline double sweep_on(turns_t* t, double now, int32_t most, bint hoping) noexcept nogil:
    """Sweeps of `swept`, whose residual is `now`, up to `most` in all; its relative residual then.

    `hoping`: as long as they promise an end within that.
    """
    cdef double before, tol = t.o.tol
    cdef int32_t step = FIRST
    while now > tol and t.c.turn < most and spent(t) < t.o.left:
        before = now
        lav_anderson(&t.c, t.swept, t.c.turn == 0, step)
        now = found_at(t, t.swept)
        step = t.c.turn // 2 if t.c.turn // 2 > FIRST else FIRST
        if hoping and not promises(before, now, tol, HOPED * (most - t.c.turn) // step):
            break
    return now


cdef inline bint begin_newton(turns_t* t) noexcept nogil:
    """Newton's method from `answer`; is there workspace for it?"""
    cdef workspace_t* r = t.r
    t.how = 0
    if not lav_workspace_size(&t.s.v, &t.options, &t.workspace):
        return False
    t.said.factorisations = 0
    while True:
        if not has_workspace_size(r, t.workspace.n_index, t.workspace.n_real):
            return False
        t.workspace.index, t.workspace.real = r.index, r.real
        t.how = lav_start(&t.s.v, &t.options, &t.workspace, t.s.answer)
        if t.how != NEEDS_WORKSPACE:
            return t.how == MORE


cdef inline double step_newton(turns_t* t, int32_t steps) noexcept nogil:
    """So many factorisations, or its end; the relative residual of `answer`."""
    cdef double fit = (t.o.left - spent(t)) / t.factor
    cdef int32_t last = t.said.factorisations + (steps if fit > steps else <int32_t>max(fit, 0.0))
    while t.said.factorisations < last and (t.how == MORE or t.how == CERTIFICATE):
        t.how = lav_step(&t.s.v, &t.options, &t.workspace, last - t.said.factorisations, t.s.answer, &t.said)
    return found_at(t, t.s.answer)


cdef inline double factor_in_turns(turns_t* t) noexcept nogil:
    """From where sweeps gave way; no more, once there are as many factors as there may be."""
    cdef double now
    if not begin_newton(t):
        return 1.0 / 0.0
    now = step_newton(t, SHORT)
    if now > t.o.tol and spent(t) < t.o.left:
        now = sweep_on(t, found_at(t, t.swept), AGAIN * t.o.most, t.s.v.p.law == CONE)
        if now > t.o.tol:
            return step_newton(t, STEPS)
        memcpy(t.s.answer, t.swept, t.s.v.p.n_rows * sizeof(double))
    return now


cdef inline bint solve_part(part_t* s, ask_t* o, workspace_t* r, double* work, int32_t* order) noexcept nogil:
    """From `lam` into `answer`; is its relative residual at most `tol`?"""
    cdef score_t nothing = new_score()
    cdef turns_t t
    cdef uint64_t rng
    cdef blocks_t* p = &s.v.p
    cdef double now = s.nothing
    cdef double begun[3]
    t.s, t.o, t.r = s, o, r
    lay_turns(&t, work, order, &rng)
    set_zero_impulse(p, s.answer, t.w)
    begun[0], begun[1], begun[2] = s.e0, s.v0, now
    if now < 0.0:
        judge_view(&s.v, s.answer, t.w, t.error, t.scratch, False, &nothing)
        find_reference(p, s.answer, t.w, t.error, begun)
        if begun[2] <= o.tol:
            return True                                 # the zero impulse is a solution
    t.e0, t.v0 = begun[0], begun[1]
    memcpy(t.swept, s.lam, p.n_rows * sizeof(double))
    form_velocity(&t.sweeps, t.swept)
    t.said.factorisations = 0
    if memcmp(t.swept, s.answer, p.n_rows * sizeof(double)) != 0:
        now = found_at(&t, t.swept)
    else:
        now = begun[2]
    t.sweep = SWEPT_ROW * p.n_rows + (s.v.a.indptr[p.n_rows] if s.v.a != NULL else SWEPT_BODIES * p.n_rows)
    t.factor = FACTOR_ROW * p.n_rows + <double>p.n_rows ** 3 / CUBED
    now = sweep_on(&t, now, o.first, True)
    if now <= o.tol or now < 1.0:
        memcpy(s.answer, t.swept, p.n_rows * sizeof(double))
    if now > o.tol and spent(&t) < o.left:
        o.driven += 1
        t.options = options_t(NEWTON, STEPS, 0, 0, o.wide, o.tol, t.e0, t.v0, 1.0 / 0.0)
        now = factor_in_turns(&t)
    o.swept += t.c.turn
    o.undone += <int64_t>t.c.control[UNDONE]
    o.factorisations += t.said.factorisations
    o.factored += t.said.factorisations * (<double>p.n_rows * p.n_rows * p.n_rows)
    if t.c.turn + t.said.factorisations > o.longest:
        o.longest = t.c.turn + t.said.factorisations
    o.left -= spent(&t)
    if now > o.tol and not o.left > 0.0 and not found_at(&t, s.answer) <= found_at(&t, t.swept):
        memcpy(s.answer, t.swept, p.n_rows * sizeof(double))
    return now <= o.tol
