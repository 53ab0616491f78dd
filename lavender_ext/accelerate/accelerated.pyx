"""Accelerated sweeps of Gauss-Seidel type: the fixed-point map is one sweep y = S(x), with step g = x - y.

    nncg      x_k = y_{k-1} + beta_{k-1} p_{k-2},  y_k = S(x_k),  g_k = x_k - y_k,                    (1)
              beta_k = g_k.D g_k / g_{k-1}.D g_{k-1},  p_k = beta_k p_{k-1} - g_k  (p_k = -g_k if beta_k > 1,
              or with `keeps` beta_k = 1 instead while p_{k-1}.D g_k <= 0)                            (3)
    anderson  x_k = Pi(y - sum_i gamma_i (y_i+1 - y_i)),  gamma least squares of f = sum_i gamma_i (f_i+1 - f_i),
              f = D^1/2 (y - x), over the last `memory` sweeps                                        (2)

nncg is the nonsmooth nonlinear conjugate gradient method, anderson is Anderson mixing. D = diag d, with which both methods use
the energy norm. S is a sweep of projected Gauss-Seidel or of exact blocks (local/gauss_seidel.pyx), over A in compressed rows,
over the factored form with v = M^-1 J^T lam, or over J and M with v = Y^T lam. With the symmetric order S is a sweep followed
by the same sweep backwards. The returned iterate is always the result y of a sweep. All sums have a fixed order.

(2) and its safeguards are implemented in accelerate/mixing.pxd. The first `convex` iterations may sweep under the cone law,
which has the same solution as Coulomb's law if all contacts stick. If `convex` is AUTOMATIC and there are MIN_CONVEX_ROWS rows,
anderson sweeps FIRST_LAW_TEST times under Coulomb's law, unless it starts from zero, then under the cone law. At doubling
numbers of iterations it compares the steps f of one sweep of exact blocks under each law, and returns to Coulomb's law for good if

    |f_cone| < 0.5 |f_coulomb|,  |f_coulomb| > 0.8 |f_coulomb of the test before|     contacts slip at the cone solution  (4)
    |f_coulomb| < 0.95 |f_cone|   (0.15 |f_cone| at the first test)                   Coulomb's law is no harder          (5)

Measured: at the first test, |f_coulomb| / |f_cone| is 0.22 to 0.75 in piles that stick, 0.01 to 0.13 in piles of balls that slip,
0.34 to 0.6 in pyramids, and below 0.02 after a warm start with slip. Later, |f_coulomb| falls by 0.01 to 0.6 from test to test
in piles that stick, by 0.85 to 1 in pyramids that slip, and is 1.02 to 1.2 times |f_cone| in towers and walls.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t, uint64_t

from lavender_ext.accelerate.accelerated cimport AUTOMATIC, acceleration_t
from lavender_ext.accelerate.mixing cimport (CONTROL, MAX_MEMORY, UNDONE, clear_mixing_memory, mix_anderson_iterates, mixing_t,
                                             store_evaluation)
from lavender_ext.core.order cimport SYMMETRIC
from lavender_ext.core.block_types cimport CONE, blocks_t
from lavender_ext.core.problem cimport Data
from lavender_ext.core.start cimport is_zero_impulse
from lavender_ext.core.view cimport view_t
from lavender_ext.judge.bounds cimport project_block_on_bounds
from lavender_ext.sweep.serial cimport (Sweeps, compute_sweep_velocities, sweep_over_form, sweep_context_t, sweep_run_t,
                                        count_sweep_velocities)

cdef enum:
    # Number of nncg iterations after which v is recomputed, because rounding errors accumulate in it.
    VELOCITY_REFRESH_INTERVAL = 64

cdef enum:
    MIN_CONVEX_ROWS = 900       # With fewer rows, sweeps under Coulomb's law alone converge nearly as often.
    MAX_CONVEX_ITERATIONS = 512     # Piles that stick need up to 320 iterations under the cone law (57,840 rows).
    FIRST_LAW_TEST = 16         # Sweeps under Coulomb's law before the first test of (5). Easy problems are solved by then.

cdef enum:                      # indices in `control` of nncg
    NORM = 0                    # g.Dg of the last sweep
    RESTARTS = 1                # number of dropped directions p


cdef inline void sweep_once_in_order(acceleration_t* c, double* lam, int32_t first) noexcept nogil:
    """Apply S to lam (m) in place: one sweep, or with the symmetric order one forwards and one backwards."""
    cdef const blocks_t* p = c.sweeps.blocks
    cdef bint exact = c.sweeps.exact
    cdef int32_t k
    if c.convex_begin <= c.iterations < c.convex:
        p = &c.cone
        exact = True
    for k in range(2 if c.sweeps.mode == SYMMETRIC else 1):
        sweep_over_form(c.sweeps, p, exact, lam, first and k == 0)


cdef inline double weighted_dot(const double* d, const double* x, const double* y, int32_t m) noexcept nogil:
    """Return x.D y for x, y and the diagonal d of D (m)."""
    cdef double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0
    cdef int32_t i = 0
    while i + 4 <= m:
        s0 += d[i] * x[i] * y[i]
        s1 += d[i + 1] * x[i + 1] * y[i + 1]
        s2 += d[i + 2] * x[i + 2] * y[i + 2]
        s3 += d[i + 3] * x[i + 3] * y[i + 3]
        i += 4
    while i < m:
        s0 += d[i] * x[i] * y[i]
        i += 1
    return (s0 + s1) + (s2 + s3)


cdef inline double subtract_and_weighted_norm(const double* d, double* x, const double* y, int32_t m) noexcept nogil:
    """Replace x by x - y and return its x.D x, summed as in `weighted_dot`; d, x and y are (m)."""
    cdef double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0
    cdef int32_t i = 0
    while i + 4 <= m:
        x[i] -= y[i]
        x[i + 1] -= y[i + 1]
        x[i + 2] -= y[i + 2]
        x[i + 3] -= y[i + 3]
        s0 += d[i] * x[i] * x[i]
        s1 += d[i + 1] * x[i + 1] * x[i + 1]
        s2 += d[i + 2] * x[i + 2] * x[i + 2]
        s3 += d[i + 3] * x[i + 3] * x[i + 3]
        i += 4
    while i < m:
        x[i] -= y[i]
        s0 += d[i] * x[i] * x[i]
        i += 1
    return (s0 + s1) + (s2 + s3)


cdef inline void extrapolate_nesterov(double* y, double* x, double* p, double beta, int32_t n) noexcept nogil:
    """Set y and x (n) to y + beta p, and p (n) to beta p minus the old x, in one pass."""
    cdef int32_t i
    cdef double q
    for i in range(n):
        q = beta * p[i]
        p[i] = q - x[i]
        q = y[i] + q
        y[i] = q
        x[i] = q


cdef inline double compute_sweep_step(acceleration_t* c, const blocks_t* p, const double* lam) noexcept nogil:
    """Return |f| of one sweep of exact blocks from lam (m) under the law of p. The velocities remain those of lam."""
    cdef int32_t i
    cdef double* x = c.work
    for i in range(p.n_rows):
        x[i] = lam[i]
    sweep_over_form(c.sweeps, p, True, x, False)
    compute_sweep_velocities(c.sweeps, lam)
    return sqrt(subtract_and_weighted_norm(p.d, x, lam, p.n_rows))


cdef public void lav_nncg(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil:
    """Run n iterations (1) of nncg on lam (m) [N s] in place; first_sweep is 1 if no sweep was made before."""
    cdef acceleration_t* c = <acceleration_t*>context
    cdef int32_t m = c.sweeps.blocks.n_rows, n_v = c.sweeps.n_v, i, s
    cdef double* x = c.work                             # x, later g: m entries for lam, then n_v for v
    cdef double* q = c.work + m + n_v                   # beta p, added before the next sweep
    cdef double* p = q + m + n_v
    cdef double* v = c.sweeps.v
    cdef double* control = c.control
    cdef const double* d = c.sweeps.blocks.d
    cdef double norm, beta = 0.0
    for s in range(n):
        if c.iterations > 0 and c.iterations % VELOCITY_REFRESH_INTERVAL == 0:
            compute_sweep_velocities(c.sweeps, lam)
        if s > 0:
            extrapolate_nesterov(lam, x, p, beta, m)
            extrapolate_nesterov(v, x + m, p + m, beta, n_v)
        else:
            for i in range(m):
                lam[i] += q[i]
                x[i] = lam[i]
            for i in range(n_v):
                v[i] += q[m + i]
                x[m + i] = v[i]
        sweep_once_in_order(c, lam, first_sweep and s == 0)
        norm = subtract_and_weighted_norm(d, x, lam, m)
        for i in range(n_v):
            x[m + i] -= v[i]
        beta = norm / control[NORM] if control[NORM] > 0.0 else 0.0
        if not beta <= 1.0:
            if c.keeps and beta > 1.0 and weighted_dot(d, x, p, m) <= 0.0:
                beta = 1.0                              # (3)
            else:
                beta = 0.0
                control[RESTARTS] += 1.0
        control[NORM] = norm
        c.iterations += 1
        if c.iterations == c.convex:
            control[NORM] = 0.0                         # Restart, because the law changes.
    if n > 0:
        for i in range(m + n_v):
            q[i] = beta * p[i]
            p[i] = q[i] - x[i]


cdef public void lav_anderson(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil:
    """Run n iterations (2) of Anderson mixing on lam (m) [N s] in place; first_sweep is 1 if no sweep was made before."""
    cdef acceleration_t* c = <acceleration_t*>context
    cdef const blocks_t* p = c.sweeps.blocks
    cdef int32_t m = p.n_rows, i, s, mixed
    cdef bint is_first, slips
    cdef double coulomb, cone
    cdef double* x = c.work                             # x, later f
    cdef double* root                                   # (m) square roots of d
    cdef mixing_t mixing
    mixing.m = m
    mixing.memory = c.memory
    mixing.control = c.control
    mixing.gram = c.gram
    mixing.v = x + m
    mixing.g = mixing.v + m
    mixing.dv = mixing.g + m
    mixing.dg = mixing.dv + c.memory * m
    root = mixing.dg + c.memory * m
    if c.iterations == 0:
        for i in range(m):
            root[i] = sqrt(p.d[i])
        if c.next_law_test > 0 and is_zero_impulse(p, lam):
            c.convex_begin = 0                          # Nothing is lost of a start.
            c.last_coulomb_step = 1.0 / 0.0
    for s in range(n):
        if c.iterations == c.next_law_test and c.iterations < c.convex:
            # Begin the iterations under the cone law, or end them if (4) or (5) holds.
            is_first = c.iterations == c.convex_begin
            coulomb, cone = compute_sweep_step(c, p, lam), compute_sweep_step(c, &c.cone, lam)
            slips = not is_first and cone < 0.5 * coulomb and coulomb > 0.8 * c.last_coulomb_step
            if slips or coulomb < (0.15 if is_first else 0.95) * cone:
                c.convex = c.iterations
            if is_first != (c.convex == c.iterations):  # The law changes.
                clear_mixing_memory(&mixing)
            c.last_coulomb_step = coulomb
            c.next_law_test = 2 * c.iterations
        # Do not limit sum |gamma|: recorded rockfalls need large sums to reach a residual of 1e-10.
        mixed = mix_anderson_iterates(&mixing, lam, 1.0 / 0.0)
        if mixed:
            for i in range(p.n_blocks):
                project_block_on_bounds(p, i, 1.0, lam)
            compute_sweep_velocities(c.sweeps, lam)
        for i in range(m):
            x[i] = lam[i]
        sweep_once_in_order(c, lam, first_sweep and s == 0)
        for i in range(m):
            x[i] = root[i] * (lam[i] - x[i])
        if not store_evaluation(&mixing, mixed, lam, x):
            compute_sweep_velocities(c.sweeps, lam)
        c.iterations += 1
        if c.iterations == c.convex:
            clear_mixing_memory(&mixing)                             # The law changes, so earlier sweeps are not combined.


cdef void restart_acceleration(void* context, const double* lam) noexcept nogil:
    """Restart from lam (m) [N s] and forget all earlier sweeps; the counts of iterations and restarts are kept."""
    cdef acceleration_t* c = <acceleration_t*>context
    cdef int32_t i, n = c.sweeps.blocks.n_rows + c.sweeps.n_v
    if c.memory == 0:
        c.control[NORM] = 0.0
        for i in range(2 * n):
            c.work[n + i] = 0.0
    else:
        for i in range(CONTROL):
            if i != UNDONE:
                c.control[i] = 0.0
    compute_sweep_velocities(c.sweeps, lam)


cdef int64_t accelerated_workspace_size(int64_t m, int64_t n_v, int64_t memory) noexcept nogil:
    """Return the number of doubles of workspace of a run with m rows, n_v velocities and this memory (0 for nncg)."""
    return 3 * (m + n_v) + (1 + 2 * memory) * m + CONTROL + MAX_MEMORY * MAX_MEMORY


cdef int32_t count_convex_iterations(int32_t m, int32_t convex) noexcept nogil:
    """Return the largest number of iterations under the cone law for m rows and the option `convex`."""
    if convex != AUTOMATIC:
        return convex
    return MAX_CONVEX_ITERATIONS if m >= MIN_CONVEX_ROWS else 0


cdef void start_accelerated_sweeps(sweep_run_t* x, acceleration_t* c, int32_t memory, int32_t convex, int32_t keeps,
                                   double* workspace) noexcept nogil:
    """Accelerate a run of sweeps x that has been started and has made no sweep.

    memory is the number of sweeps that Anderson mixing combines; 0 selects nncg, for which convex is not AUTOMATIC. workspace
    has `accelerated_workspace_size` doubles, all 0.
    """
    cdef sweep_context_t* sweeps = &x.context
    x.step, x.step_context, x.forget = lav_nncg if memory == 0 else lav_anderson, c, restart_acceleration
    c.sweeps, c.cone = sweeps, sweeps.blocks[0]
    c.cone.law = CONE
    c.memory, c.convex, c.keeps, c.iterations = memory, count_convex_iterations(sweeps.blocks.n_rows, convex), keeps, 0
    c.convex_begin = FIRST_LAW_TEST if convex == AUTOMATIC else 0
    c.next_law_test = FIRST_LAW_TEST if convex == AUTOMATIC else -1
    c.work = workspace
    c.gram = workspace + 3 * (sweeps.blocks.n_rows + sweeps.n_v) + (1 + 2 * <int64_t>memory) * sweeps.blocks.n_rows
    c.control = c.gram + MAX_MEMORY * MAX_MEMORY


cdef double count_undone_steps(const acceleration_t* c) noexcept nogil:
    """Return the number of directions that nncg has dropped, or of mixed steps that Anderson mixing has undone."""
    return c.control[RESTARTS if c.memory == 0 else UNDONE]


cdef class AcceleratedSweeps(Sweeps):
    """Accelerated sweeps of a problem. The property `undone` is the number of restarts.

    Parameters
    ----------
    p, order, split, mode, rng, exact
        As in `Sweeps`.
    memory : int
        Number of sweeps that Anderson mixing combines, up to 16; 0 selects nncg.
    convex : int
        Number of iterations at the beginning that use the cone law and solve blocks exactly; -1: automatic (anderson only).
    keeps : bool
        If true, nncg with beta > 1 drops a direction only if it points against the sweep, (3) of the module.
    """

    def __init__(self, Data p, int32_t[::1] order, int split, int mode, uint64_t[::1] rng, bint exact=False, int memory=0,
                 int convex=0, bint keeps=False):
        cdef view_t v = p.get_pointers()
        cdef int64_t n = accelerated_workspace_size(v.p.n_rows, count_sweep_velocities(&v), memory)
        self.x.packing.single = True
        start_accelerated_sweeps(&self.x, &self.acceleration, memory, convex, keeps,
                   self.allocate(p, order, split, mode, rng, exact, exact or count_convex_iterations(v.p.n_rows, convex) > 0, n))

    cdef double undone(self) noexcept:
        """Return the number of restarts."""
        return count_undone_steps(&self.acceleration)
