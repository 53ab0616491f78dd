"""The state of one solve by Newton's method: phases, vectors, budget, and the best point.

`judge_and_keep_best_point` compares points by the judge's relative residual. The active phases form a stack. A call of the
phase on top does at most one factorisation, except for requests of a certificate, so that the caller can check a clock
in between.
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy, memset

from lavender_ext.core.arena cimport arena_t, take_doubles, take_integers, has_memory
from lavender_ext.core.block_types cimport COULOMB, blocks_t
from lavender_ext.core.view cimport csr_t, generalized_t, rows_t, view_t
from lavender_ext.factor.linear cimport linear_t
from lavender_ext.judge.best cimport (best_t, best_workspace_size, bind_best, copy_score_without_islands, store_better_islands,
                                      relative_residual_of_best)
from lavender_ext.judge.measure cimport residual_above_floor, relative_floor_of_score, judge_view, relative_residual_of_score
from lavender_ext.judge.score cimport make_empty_score, relative_residual, score_t
from lavender_ext.newton.cones cimport CONE_SCALING_SIZE
from lavender_ext.newton.interior cimport interior_t
from lavender_ext.newton.natural_map cimport compute_convex_residual
from lavender_ext.newton.scaling cimport bind_element_indices, scale_elements, scaled_t
from lavender_ext.newton.system cimport has_passed_after_part, multiply_system_matrix, system_t


cdef enum:                      # phases
    PLAN_CONVEX = 0             # plan.pxd
    PLAN_COULOMB = 1
    ACTIVE_SET = 2              # active_set.pxd
    INTERIOR_POINT = 3          # interior_phases.pxd
    INTERIOR_WITH_NEWTON = 4
    AUGMENTED_NEWTON = 5
    DAMPED_NEWTON = 6           # damped_newton.pxd
    DAMPED_STRETCHES = 7
    PATH = 8                    # path.pxd
    FLOW = 9                    # flow.pxd

cdef enum:                      # counters
    N_ACTIVE_SET = 0
    N_REFINEMENTS = 1
    N_INTERIOR = 2
    N_PROXIMAL = 3
    N_DE_SAXCE = 4
    N_AUGMENTED_INTERIOR = 5
    N_AUGMENTED_NEWTON = 6
    N_PATH = 7
    N_FLOW = 8
    N_COUNTED = 9

cdef enum:
    MAX_PHASE_DEPTH = 8         # Phases nest at most four deep.
    N_VECTORS = 28              # vectors (m) of `bind_values`
    UNLIMITED = 2147483647      # limit of factorisations that no phase reaches
    MAX_INNER_STEPS = 20        # Newton steps of one proximal iteration; more rarely end it.


cdef struct problem_t:          # the problem as the judge reads it
    blocks_t p
    const csr_t* a              # the matrix, or NULL
    const rows_t* r             # bodies, or NULL
    const generalized_t* g      # J and M, or NULL
    double e0                   # sqrt J; of islands the smallest reference, so that no own estimate is too low for one
    double v0                   # m/s
    double* w                   # (rows)
    double* error               # (rows)
    double* x                   # (12 bodies | velocities + rows)


cdef struct active_set_t:
    double* z
    double* hz
    double* best_z              # z with the lowest residual, not yet scored unless `is_scored`
    double best
    int32_t* bound              # (m) the bound that is active on each row: -1, 0 or 1
    int32_t is_scored
    int32_t first_changes       # rows whose active bound changed in the first exchange
    int32_t exchanges
    int32_t fewest_changes
    int32_t stalled             # exchanges since the number of changed rows was lowest


cdef struct progress_t:         # progress of an interior point's steps
    double* best_z
    double lowest               # relative residual of best_z
    double trial_residual       # Newton steps or exchanges are tried below this relative residual
    int32_t idle                # steps since the residual or the gap halved
    int32_t stalled             # steps since the residual halved, or short steps in a row
    int32_t steps
    int32_t trial_runs          # a trial is on the stack
    int32_t bounded_rows        # the problem has bounded rows alone
    int32_t augmented           # steps of the cone law on the augmented system
    int32_t is_counted          # Coulomb's law: the contacts that slide fast have been counted


cdef struct augmented_newton_t:
    double* z
    double best
    int32_t failed              # steps in a row that did not halve the residual
    int32_t steps_left


cdef struct damped_newton_t:    # state of the proximal iterations
    double* z
    double history[MAX_INNER_STEPS]     # |F_c| at each inner step
    double alpha                # proximal weight
    double min_factor           # alpha is multiplied by at least this factor; failures raise it
    double earlier_best         # best residual when the iteration began
    int32_t law
    int32_t max_inner_steps
    int32_t failures
    int32_t idle                # iterations without progress at the smallest alpha
    int32_t is_stuck
    int32_t stage               # stage of a proximal iteration: 0 begin, 1 inner steps, 2 end
    int32_t inner_steps
    int32_t is_solved           # the inner problem is solved
    int32_t first               # factorisations when the iteration began
    int32_t last                # factorisations at which the phase ends
    int32_t free_iterations     # iterations in a row without a factorisation


cdef struct stretches_t:        # a damped Newton phase that continues as long as each stretch of it halves the residual
    double residual             # residual at the start of the stretch, which must halve it
    int32_t is_running          # whether a stretch has begun and not ended
    int32_t length              # factorisations of one stretch
    int32_t stretches


cdef struct path_t:             # a path of smoothed problems
    double* z                   # the last point
    double l                    # log tau of the last point
    double* t                   # z part of the tangent
    double tl                   # log tau part of the tangent
    double* b                   # -F_z^-1 F_tau of the last factor
    double* saved_z[2]          # the two points to which the path can return
    double* saved_t[2]
    double saved_l[2]
    double saved_tl[2]
    double saved_h[2]
    double size                 # root mean square of g
    double eps                  # compliance
    double start                # first log tau
    double h                    # length of a step (h of path.pxd)
    double next                 # log tau of the point that is corrected
    double speed                # rate of the parameter along the tangent
    double change               # largest change of a coordinate by the last correction; infinite before the first correction
    double first_change         # largest change of a coordinate by the first correction of a point
    double tolerance            # a point is on the curve if its correction changes the coordinates by less
    double trial_residual       # a damped Newton phase is tried below this relative residual
    int32_t stage
    int32_t parameter           # coordinate that parametrises the next step
    int32_t sign                # sign of det F_z; 0: not known
    int32_t halvings            # consecutive halvings of the step
    int32_t steps_since_return
    int32_t factors             # factorisations for the present point
    int32_t raises              # number of times that the first tau was raised
    int32_t n_saved
    double lowest               # lowest residual, up to a factor of two
    int32_t since               # factorisations at the last such progress
    int32_t last                # factorisations at which the path ends


cdef struct flow_t:             # implicit Euler steps of the proximal flow
    double* z
    double* hz                  # H z
    double* centre              # c
    double* saved_z             # z at the end of the last solved step
    double eps                  # proximal weight
    double move                 # eps |Pi_K(u) - c| of the last evaluation
    double trial_residual       # damped Newton is tried below this relative residual
    double lowest               # lowest residual, up to a factor of two
    int32_t inner_steps         # Newton steps of this Euler step
    int32_t since               # factorisations at the last such progress
    int32_t patience            # the phase ends if so many factorisations do not halve the residual
    int32_t last                # factorisations at which the phase ends


cdef struct newton_t:           # bound to its workspace; it must not move
    system_t s
    scaled_t sc
    linear_t linear             # matrix of s, unless a host provides it
    problem_t problem
    double tol
    int32_t budget              # factorisations
    int32_t stop                # the caller has no time left
    int32_t needs_check         # the caller must check whether `direction` is a certificate
    int32_t proven              # `direction` is a certificate
    int32_t is_cold             # the start is the zero impulse
    int32_t has_augmented       # the caller can factor the augmented system
    int32_t stage               # state of the plan (plan.pxd)
    int32_t mostly_slides       # Coulomb's law: many contacts slide at the convex point
    int32_t keeps_matrix        # the caller starts again with the same A: a formed H stays
    int32_t has_matrix          # H is formed
    int32_t counts[N_COUNTED]
    int32_t stack[MAX_PHASE_DEPTH]
    int32_t depth
    double best                 # relative residual of best_z
    double above_floor          # the part of the last judged residual that rounding does not explain
    double* best_z
    double* direction
    best_t island_best          # the best impulse of each island
    double* lam                 # (rows)
    double* certificate         # (rows) `direction` as an impulse
    double* f                   # value of the natural map
    double* r                   # right-hand side
    double* da                  # affine direction
    double* dz
    double* t1
    double* t2
    double* u
    double* psi
    double* c                   # centre of a proximal iteration
    double* hz
    double* hdz
    double* trial
    double* slack               # s = H z - g
    interior_t ip
    active_set_t active
    progress_t progress
    augmented_newton_t augmented
    damped_newton_t damped
    stretches_t stretches
    path_t path
    flow_t flow


# -- workspace -------------------------------------------------------------------------------------------------------


cdef inline void bind_indices(newton_t* n, arena_t* a) noexcept nogil:
    """Take the integer arrays for the problem that is judged."""
    cdef int64_t m = n.problem.p.n_rows
    bind_element_indices(&n.sc, m, a)
    n.active.bound, n.linear.swap, n.s.free = take_integers(a, m), take_integers(a, m), take_integers(a, m)


cdef inline void bind_values(newton_t* n, int64_t small, bint clear, arena_t* a) noexcept nogil:
    """Take the judge's arrays, the elements, the vectors, and small matrices of `small` entries in all.

    With `clear` those that must begin with zeros are set to 0. The caller then calls `scale_problem` and sets `form`,
    `symmetric` and the fields of the form.
    """
    cdef path_t* p = &n.path
    cdef flow_t* f = &n.flow
    cdef scaled_t* s = &n.sc
    cdef const problem_t* o = &n.problem
    cdef int64_t m = o.p.n_rows, first
    cdef double* best
    cdef double** at[N_VECTORS]
    cdef int32_t i
    # the judge's arrays for the problem that is judged
    n.lam, n.certificate = take_doubles(a, m), take_doubles(a, m)
    n.problem.w, n.problem.error = take_doubles(a, m), take_doubles(a, m)
    best = take_doubles(a, best_workspace_size(m, <int64_t>o.p.n_blocks + 1))
    n.problem.x = take_doubles(a, m + (12 * <int64_t>o.r.n_bodies if o.r != NULL else o.g.n if o.g != NULL else 0))
    if has_memory(a):
        bind_best(&n.island_best, &n.problem.p, best)
        n.island_best.by_energy = 1                     # Only solved islands are combined.
    first = a.n_real
    # the elements, for up to m rows
    s.fixed, s.scale, s.speed = take_doubles(a, m), take_doubles(a, m), take_doubles(a, m)
    s.e.theta, s.e.g, s.e.lower, s.e.upper = take_doubles(a, m), take_doubles(a, m), take_doubles(a, m), take_doubles(a, m)
    s.e.reach, s.e.scaling = take_doubles(a, m), take_doubles(a, CONE_SCALING_SIZE * m)
    at[0], at[1], at[2], at[3] = &n.best_z, &n.s.t, &n.s.q, &n.direction
    at[4], at[5], at[6], at[7] = &n.f, &n.r, &n.da, &n.dz
    at[8], at[9], at[10], at[11] = &n.t1, &n.t2, &n.u, &n.psi
    at[12], at[13], at[14], at[15] = &n.c, &n.hz, &n.hdz, &n.trial
    at[16], at[17], at[18], at[19] = &n.slack, &n.ip.z, &n.ip.u1, &n.ip.u2
    at[20], at[21], at[22], at[23] = &n.ip.hz, &n.ip.unbounded_z, &n.active.z, &n.active.hz
    at[24], at[25], at[26], at[27] = &n.active.best_z, &n.progress.best_z, &n.augmented.z, &n.damped.z
    for i in range(N_VECTORS):
        at[i][0] = take_doubles(a, m)
    n.s.v, n.s.einv, n.s.p, n.s.pair, n.s.bt = (take_doubles(a, small), take_doubles(a, small), take_doubles(a, small),
                                                take_doubles(a, small), take_doubles(a, small))
    if clear:
        memset(a.real + first, 0, (a.n_real - first) * sizeof(double))
    if o.p.law == COULOMB:                              # Paths and Euler steps set their vectors before they read them.
        p.z, p.t, p.b = take_doubles(a, m), take_doubles(a, m), take_doubles(a, m)
        p.saved_z[0], p.saved_z[1] = take_doubles(a, m), take_doubles(a, m)
        p.saved_t[0], p.saved_t[1] = take_doubles(a, m), take_doubles(a, m)
        f.z, f.hz, f.centre, f.saved_z = take_doubles(a, m), take_doubles(a, m), take_doubles(a, m), take_doubles(a, m)


cdef inline void scale_problem(newton_t* n, const view_t* v) noexcept nogil:
    """Scale the elements that `index_unfixed_elements` found, and reset the system."""
    scale_elements(&n.sc, v, n.problem.w, n.problem.x)
    if n.sc.e.n == n.sc.e.m:                            # Bounded rows alone.
        n.s.bt = NULL
    n.s.e, n.s.linear = &n.sc.e, &n.linear
    n.s.others = NULL
    n.s.augmented = n.s.factorisations = 0


# -- the stack of phases -----------------------------------------------------------------------------------------------


cdef inline void push_phase(newton_t* n, int32_t phase) noexcept nogil:
    """Put a phase on the stack."""
    n.stack[n.depth] = phase
    n.depth += 1


cdef inline void pop_phase(newton_t* n) noexcept nogil:
    """End the phase on top of the stack."""
    n.depth -= 1


# -- points ----------------------------------------------------------------------------------------------------------


cdef inline void copy_vector(const newton_t* n, double* to, const double* x) noexcept nogil:
    """Copy x (m)."""
    memcpy(to, x, n.s.e.m * sizeof(double))


cdef inline void compute_slack(newton_t* n, const double* z, double* slack) noexcept nogil:
    """Compute s = H z - g."""
    cdef int32_t j
    multiply_system_matrix(&n.s, z, slack)
    for j in range(n.s.e.m):
        slack[j] -= n.s.e.g[j]


cdef inline void write_impulse(const newton_t* n, const double* z, double* lam) noexcept nogil:
    """Write the impulse lambda (rows) that belongs to z."""
    cdef int32_t j
    memcpy(lam, n.sc.fixed, n.problem.p.n_rows * sizeof(double))
    for j in range(n.s.e.m):
        lam[n.sc.keep[j]] = z[j] * n.sc.scale[j]


cdef inline void write_unknown(const newton_t* n, const double* lam, double* z) noexcept nogil:
    """Write the unknown z (m) that belongs to the impulse lam (rows) [N s]."""
    cdef int32_t j
    for j in range(n.s.e.m):
        z[j] = lam[n.sc.keep[j]] / n.sc.scale[j]


# -- residuals -------------------------------------------------------------------------------------------------------


cdef inline double judge_point(newton_t* n, const double* z, bint floor) noexcept nogil:
    """Return the judge's relative residual of z; with `floor` write the part above the round-off limit to n.above_floor."""
    cdef score_t s = make_empty_score()
    cdef const problem_t* o = &n.problem
    cdef view_t v = view_t(o.p, o.a, o.r, o.g)
    cdef double residual
    write_impulse(n, z, n.lam)
    s.by_island = n.island_best.now
    judge_view(&v, n.lam, o.w, o.error, o.x, floor, &s)
    residual = relative_residual_of_score(&s, o.w, o.p.n_rows, o.e0, o.v0)
    copy_score_without_islands(&n.island_best, &o.p, &s, residual)
    n.above_floor = residual_above_floor(&s, residual, relative_floor_of_score(&s, o.e0, o.v0)) if floor and s.finite else residual
    return residual


cdef inline double judge_and_keep_best_point(newton_t* n, const double* z) noexcept nogil:
    """Judge z and return its residual. Keep z if it is the best point so far, and keep the best impulse of each island.

    The best impulses of the islands together may be within tol before a single point is.
    """
    cdef double residual = judge_point(n, z, False), combined
    cdef view_t v = view_t(n.problem.p, n.problem.a, n.problem.r, n.problem.g)
    has_passed_after_part(&n.s)
    if residual < n.best:
        n.best = residual
        copy_vector(n, n.best_z, z)
    if store_better_islands(&n.island_best, &v, n.lam, n.problem.w, n.tol) and n.island_best.n > 1 and not n.best <= n.tol:
        combined = relative_residual_of_best(&n.island_best)
        if combined <= n.tol:
            n.best = combined
            write_unknown(n, n.island_best.impulse, n.best_z)
    return residual


cdef inline double convex_residual(newton_t* n, const double* z, const double* hz) noexcept nogil:
    """Return the relative residual of the convex law from hz = H z, without the judge."""
    cdef double energy, velocity
    compute_convex_residual(n.s.e, z, hz, n.sc.speed, &energy, &velocity)
    return relative_residual(energy, velocity, n.problem.e0, n.problem.v0)


cdef inline bint is_budget_spent(const newton_t* n) noexcept nogil:
    """Return whether no further factorisation is allowed."""
    return n.s.factorisations >= n.budget or n.stop


cdef inline bint is_finished(const newton_t* n) noexcept nogil:
    """Return whether the best point is within tol, a certificate is proven, or the budget is spent."""
    return n.best <= n.tol or n.proven or is_budget_spent(n)


cdef inline bint is_at_roundoff(newton_t* n) noexcept nogil:
    """Return whether rounding explains the excess of the best point's residual over tol, in each island."""
    if n.best > 1e-5:                                   # Rounding cannot be the only cause of a larger residual.
        return False
    judge_point(n, n.best_z, True)
    return n.above_floor <= n.tol


cdef inline bint is_over(newton_t* n) noexcept nogil:
    """Return whether no further phase is needed."""
    return is_finished(n) or is_at_roundoff(n)


# -- the best point --------------------------------------------------------------------------------------------------
