"""One solve by Newton's method: its vectors, its budget, its best point, where it stands between two steps.

A point counts by the judge's relative residual alone (`score`). Phases stand on a stack and are taken one factorisation
at a time, so that whoever asked can look at a clock in between.
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy, memset

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport csr_t, generalized_t, rows_t, view_t
from lavender_ext.factor.blocks cimport block_matrix_t
from lavender_ext.judge.best cimport best_workspace_size, best_t, bind_best, note_score, relative_of_best, see_impulse
from lavender_ext.judge.measure cimport above_floor_of, floor_of, judge_view, relative_of
from lavender_ext.judge.score cimport new_score, relative, score_t, smallest_reference
from lavender_ext.newton.natural_map cimport convex_error
from lavender_ext.newton.scaling cimport (bind_element_workspace, bind_scaling_workspace, scale_elements, scaled_index,
                                          scaled_real, scaled_t)
from lavender_ext.newton.system cimport system_t, system_times


cdef enum:                      # phases
    PLAN_CONVEX = 0             # what is tried when (plan.pxd)
    PLAN_COULOMB = 1
    EXCHANGES = 2               # phases.pxd
    INTERIOR = 3
    PROXIMAL = 4
    PURSUIT = 5
    APPROACH = 6
    POLISH = 7
    DE_SAXCE = 8
    RELAXED = 9
    PATH = 10                   # path.pxd
    SECOND = 16                  # PROXIMAL + SECOND of the second rounds

cdef enum:                      # what is counted
    N_EXCHANGES = 0
    N_REFINED = 1
    N_INTERIOR = 2
    N_ROUNDS = 3
    N_DE_SAXCE = 4
    N_RELAXED = 5
    N_AUGMENTED_INTERIOR = 6
    N_AUGMENTED_DE_SAXCE = 7
    N_AUGMENTED = 8
    N_PATH = 9
    N_COUNTED = 10

cdef enum:
    DEEP = 8                    # of the stack
    VECTORS = 31                # (m) of `bind_vector_workspace`
    INNER = 20                  # Newton steps of one proximal round at most


cdef struct problem_t:          # as the judge reads it
    blocks_t p
    const csr_t* a              # or NULL,
    const rows_t* r             # or NULL,
    const generalized_t* g      # or NULL
    double e0                   # reference of the solver's own estimates, sqrt J: with islands the smallest of these
    double v0                   # m/s
    double* w                   # (rows)
    double* error               # (rows)
    double* x                   # (12 bodies | velocities + rows)


cdef struct interior_t:         # an interior point
    double* z
    double* u1                  # duals
    double* u2
    double* hz                  # H z
    double* everything          # nearly H z = g on every row
    double delta                # proximal weight
    double share                # of phi's derivative; 0: the convex law
    double degree               # cones
    double gap                  # G z . u / degree before the last step
    double lowest_gap           # before that
    double first_gap
    double length               # of it
    double energy               # |F| after it, the judge's energy error (convex law)
    double velocity             # the judge's velocity error


cdef struct exchange_t:
    double* z
    double* hz
    double* kept
    double best
    int32_t* side               # bound that a row rests on by its natural map
    int32_t judged
    int32_t first               # rows that changed in the first exchange
    int32_t done
    int32_t fewest
    int32_t still


cdef struct progress_t:             # of the steps of an interior point
    double* kept                # its best z
    double lowest
    double near                 # relative residual from which Newton steps are asked
    int32_t idle
    int32_t still
    int32_t steps
    int32_t at
    int32_t rows                # bounded rows alone
    int32_t law                 # of the Newton steps
    int32_t augmented


cdef struct polish_t:
    double* z
    double best
    int32_t worse
    int32_t patience
    int32_t left                # steps


cdef struct proximal_t:         # proximal point rounds
    double* z
    double history[INNER]
    double alpha
    double slowest              # alpha falls at most by this factor; closer to 1 after a failure
    double before               # best residual when the round began
    int32_t law
    int32_t inner
    int32_t failures
    int32_t idle
    int32_t stuck
    int32_t at
    int32_t n                   # of history
    int32_t solved
    int32_t begun               # factorisations when the round began,
    int32_t last                # and at which it ends
    int32_t free                # rounds in a row that cost no factorisation


cdef struct pursuit_t:
    double last
    int32_t at
    int32_t which
    int32_t length              # factorisations of a stretch
    int32_t stretches


cdef struct tries_t:            # De Saxce's interior point
    int32_t at
    int32_t augmented
    int32_t second              # of two shares of phi's derivative


cdef struct path_t:             # through smoothed problems, in vectors of other phases
    double* z                   # the last point,
    double l                    # log tau there,
    double* t                   # and the tangent
    double tl
    double* old                 # the tangent before
    double old_l
    double* b                   # -F_z^-1 F_tau of the last factor
    double* mark[2]             # the points before that,
    double* mark_t[2]           # with their tangents
    double mark_l[2]
    double mark_tl[2]
    double mark_h[2]
    double wide                 # tau of friction over that of normals
    double size                 # of g
    double eps                  # compliance
    double start                # first log tau
    double h                    # length of a step
    double before               # of the last one
    double next                 # log tau of the point that is corrected
    double speed                # of the parameter along the tangent
    double found                # what its first correction changed
    double previous             # the last; below 0: it is given up
    double exact                # corrections below this leave a point on the curve
    double near                 # relative residual from which Newton steps are tried
    int32_t at
    int32_t which               # coordinate that is the parameter
    int32_t sign                # of the determinant, 0: not known
    int32_t bends               # the tangent before is known
    int32_t shorter             # times in a row
    int32_t clean               # steps since a return
    int32_t used                # factors of this point
    int32_t raised              # first tau, so often
    int32_t marks               # points to which it can return
    int32_t paths               # begun
    int32_t last                # factorisations at which it ends


cdef struct newton_t:           # may not move once it is furnished
    system_t s
    scaled_t sc
    block_matrix_t blocks       # N of s over bodies, and its factor
    problem_t problem
    double tol
    int32_t budget              # factorisations
    int32_t stop                # the caller has no more time
    int32_t asked               # whether `direction` proves that there is no solution
    int32_t proven              # it does
    int32_t cold                # begun from doing nothing
    int32_t loops               # the augmented system can be asked for
    int32_t without             # bits of phases that are left out
    int32_t at                  # of the plan
    int32_t relaxed_at
    int32_t set_aside
    int32_t counts[N_COUNTED]
    int32_t stack[DEEP]
    int32_t depth
    double best                 # relative residual of best_z
    double aside                # a best point that is no start for what comes
    double before               # the best point apart from that of a phase of its own
    double above_floor          # of the point that was judged last: what of its residual rounding does not explain
    double relaxed              # residual at which the convex problem is given up
    double* best_z
    double* aside_z
    double* before_z
    double* direction
    best_t kept                 # the best impulse of each island, of all that were scored
    double* lam                 # (rows)
    double* proof               # (rows) `direction` as an impulse
    double* f
    double* r
    double* da
    double* dz
    double* t1
    double* t2
    double* u
    double* psi
    double* c                   # centre of a round
    double* hz
    double* hdz
    double* trial
    double* rest
    interior_t ip
    exchange_t exchange
    progress_t progress
    polish_t polish
    proximal_t rounds[2]        # the first, which go on in the end; any other
    pursuit_t pursuit
    tries_t tries
    path_t path


# -- places in the caller's workspace -----------------------------------------------------------------------------------


cdef inline void aim(newton_t* n, const blocks_t* p, const csr_t* a, const rows_t* r, const generalized_t* g) noexcept nogil:
    """The problem that is judged, by one of a, r, g."""
    n.problem.p, n.problem.a, n.problem.r, n.problem.g = p[0], a, r, g


cdef inline int64_t judge_workspace_size(const blocks_t* p, const rows_t* r, const generalized_t* g) noexcept nogil:
    """Doubles that `bind_judge_workspace` hands out."""
    cdef int64_t m = p.n_rows, own = 4 * m + best_workspace_size(m, <int64_t>p.n_blocks + 1)
    if r != NULL:
        return own + 12 * <int64_t>r.n_bodies
    return own + (g.n + m if g != NULL else 0)


cdef inline double* bind_judge_workspace(newton_t* n, double* workspace) noexcept nogil:
    """What the judge writes to, of `aim`; what is behind it."""
    cdef int64_t m = n.problem.p.n_rows
    n.lam, n.proof = workspace, workspace + m
    n.problem.w, n.problem.error = workspace + 2 * m, workspace + 3 * m
    n.problem.x = workspace + 4 * m + best_workspace_size(m, n.problem.p.n_blocks + 1)
    bind_best(&n.kept, &n.problem.p, workspace + 4 * m)
    return workspace + judge_workspace_size(&n.problem.p, n.problem.r, n.problem.g)


cdef inline int64_t own_index(int64_t m) noexcept nogil:
    """Whole numbers that `bind_index_workspace` hands out, of m rows."""
    return scaled_index(m) + 3 * m


cdef inline void bind_index_workspace(newton_t* n, int64_t m, int32_t* index) noexcept nogil:
    bind_element_workspace(&n.sc, m, index)
    index += scaled_index(m)
    n.exchange.side, n.s.swap, n.s.free = index, index + m, index + 2 * m


cdef inline int64_t own_workspace_size(int64_t m, int64_t small) noexcept nogil:
    """Doubles that `furnish` hands out, of m rows and so many entries of small matrices."""
    return scaled_real(m) + VECTORS * m + 5 * small


cdef inline void bind_vector_workspace(newton_t* n, double* workspace, int64_t m) noexcept nogil:
    """Places in workspace (VECTORS m)."""
    cdef double** at[VECTORS]
    cdef int32_t i
    at[0], at[1], at[2], at[3] = &n.best_z, &n.aside_z, &n.before_z, &n.direction
    at[4], at[5], at[6], at[7] = &n.f, &n.r, &n.da, &n.dz
    at[8], at[9], at[10], at[11] = &n.t1, &n.t2, &n.u, &n.psi
    at[12], at[13], at[14], at[15] = &n.c, &n.hz, &n.hdz, &n.trial
    at[16], at[17], at[18], at[19] = &n.rest, &n.ip.z, &n.ip.u1, &n.ip.u2
    at[20], at[21], at[22], at[23] = &n.ip.hz, &n.ip.everything, &n.exchange.z, &n.exchange.hz
    at[24], at[25], at[26], at[27] = &n.exchange.kept, &n.progress.kept, &n.polish.z, &n.rounds[0].z
    at[28], at[29], at[30] = &n.rounds[1].z, &n.s.t, &n.s.q
    for i in range(VECTORS):
        at[i][0] = workspace + i * m


cdef inline double* bind_real_workspace(newton_t* n, const view_t* v, double* workspace) noexcept nogil:
    """Elements (`find_elements`) scaled, with vectors and small matrices, in workspace of zeros; what is behind.

    What factors is still to come: form, symmetric and what belongs to the form.
    """
    cdef int64_t rows = n.problem.p.n_rows, small = n.sc.small
    cdef double* x = workspace + scaled_real(rows)
    bind_scaling_workspace(&n.sc, rows, workspace)
    scale_elements(&n.sc, v, n.problem.w, n.problem.x)
    bind_vector_workspace(n, x, rows)
    x += VECTORS * rows
    n.s.v, n.s.einv, n.s.p, n.s.pair, n.s.bt = x, x + small, x + 2 * small, x + 3 * small, x + 4 * small
    if n.sc.e.n == n.sc.e.m:                            # bounded rows alone
        n.s.bt = NULL
    n.s.e, n.s.f = &n.sc.e, &n.blocks
    n.s.others = NULL
    n.s.wide = n.s.augmented = n.s.factorisations = n.without = 0
    return x + 5 * small


# -- the best point ------------------------------------------------------------------------------------------------


cdef inline void take(newton_t* n, double* to, const double* x) noexcept nogil:
    memcpy(to, x, n.s.e.m * sizeof(double))


cdef inline void enter(newton_t* n, int32_t phase) noexcept nogil:
    """The phase goes on top; one that is left out has ended."""
    if n.without >> (phase % SECOND) & 1:
        return
    n.stack[n.depth] = phase
    n.depth += 1


cdef inline void leave(newton_t* n) noexcept nogil:
    n.depth -= 1


cdef inline void impulse_of(const newton_t* n, const double* z, double* lam) noexcept nogil:
    """lambda (rows) of z."""
    cdef int32_t j
    memcpy(lam, n.sc.fixed, n.problem.p.n_rows * sizeof(double))
    for j in range(n.s.e.m):
        lam[n.sc.keep[j]] = z[j] * n.sc.scale[j]


cdef inline void unknown_of(const newton_t* n, const double* lam, double* z) noexcept nogil:
    """z of lambda (rows)."""
    cdef int32_t j
    for j in range(n.s.e.m):
        z[j] = lam[n.sc.keep[j]] / n.sc.scale[j]


cdef inline const double* proof_of(newton_t* n) noexcept nogil:
    """`direction` on all rows."""
    cdef int32_t j
    memset(n.proof, 0, n.problem.p.n_rows * sizeof(double))
    for j in range(n.s.e.m):
        n.proof[n.sc.keep[j]] = n.direction[j] * n.sc.scale[j]
    return n.proof


cdef inline void set_reference(problem_t* o, double e0, double v0) noexcept nogil:
    """The reference of estimates over all rows: e0, v0, or with islands the smallest of theirs, so that none looks solved early."""
    o.e0, o.v0 = e0, v0
    smallest_reference(&o.p, &o.e0, &o.v0)


cdef inline double judged(newton_t* n, const double* z, bint floor) noexcept nogil:
    """The judge's relative residual of z; what of it rounding does not explain into n.above_floor."""
    cdef score_t s = new_score()
    cdef const problem_t* o = &n.problem
    cdef view_t v = view_t(o.p, o.a, o.r, o.g)
    cdef double found
    impulse_of(n, z, n.lam)
    s.by_island = n.kept.now
    judge_view(&v, n.lam, o.w, o.error, o.x, floor, &s)
    found = relative_of(&s, o.w, o.p.n_rows, o.e0, o.v0)
    note_score(&n.kept, &o.p, &s, found)
    n.above_floor = above_floor_of(&s, found, floor_of(&s, o.e0, o.v0)) if floor and s.finite else found
    return found


cdef inline double score(newton_t* n, const double* z) noexcept nogil:
    """The same; the best point is kept, and the best impulse of each island. Together these may be within tol sooner."""
    cdef double found = judged(n, z, False), kept
    if found < n.best:
        n.best = found
        take(n, n.best_z, z)
    if see_impulse(&n.kept, &n.problem.p, n.lam, n.tol) and n.kept.n > 1 and not n.best <= n.tol:
        kept = relative_of_best(&n.kept)
        if kept <= n.tol:
            n.best = kept
            unknown_of(n, n.kept.impulse, n.best_z)
    return found


cdef inline double relative_at(newton_t* n, const double* z, const double* hz) noexcept nogil:
    """The judge's residual of the convex law from hz = H z."""
    cdef double energy, velocity
    convex_error(n.s.e, z, hz, n.sc.speed, &energy, &velocity)
    return relative(energy, velocity, n.problem.e0, n.problem.v0)


cdef inline bint spent(const newton_t* n) noexcept nogil:
    return n.s.factorisations >= n.budget or n.stop


cdef inline bint done(const newton_t* n) noexcept nogil:
    return n.best <= n.tol or n.proven or spent(n)


cdef inline bint at_floor(newton_t* n) noexcept nogil:
    """Whether rounding explains what the best point is above tol, in each island."""
    if n.best > 1e-5:
        return False
    judged(n, n.best_z, True)
    return n.above_floor <= n.tol


cdef inline void put_aside(newton_t* n, double best, const double* z) noexcept nogil:
    """Go on with an earlier best point; the one of now counts again in the end."""
    if n.best < best:
        n.set_aside = 1
        n.aside = n.best
        take(n, n.aside_z, n.best_z)
        n.best = best
        take(n, n.best_z, z)


cdef inline void take_back(newton_t* n) noexcept nogil:
    """The best of all."""
    if n.set_aside and n.aside < n.best:
        n.best = n.aside
        take(n, n.best_z, n.aside_z)


cdef inline void begin_apart(newton_t* n) noexcept nogil:
    """A phase judged by its own progress begins."""
    n.before = n.best
    take(n, n.before_z, n.best_z)
    n.best = 1.0 / 0.0


cdef inline double end_apart(newton_t* n, double* z) noexcept nogil:
    """Its lowest residual, and its z where z is not NULL; the better point is the best again."""
    cdef double best = n.best
    if z != NULL:
        take(n, z, n.best_z)
    if n.before <= best:
        n.best = n.before
        take(n, n.best_z, n.before_z)
    return best


cdef inline void with_products(newton_t* n, const double* z, double* rest) noexcept nogil:
    """s = H z - g into rest."""
    cdef int32_t j
    system_times(&n.s, z, rest)
    for j in range(n.s.e.m):
        rest[j] -= n.s.e.g[j]
