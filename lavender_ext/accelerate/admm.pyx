"""Proximal splitting on the bounds or cones of all blocks, in the metric of d, with Anderson mixing.

With x = D^1/2 lam, B = D^-1/2 A D^-1/2, c = D^-1/2 b, cones K in the same scale, one vector u carries all:

    z = Pi_K(u),   y = rho (u - z)                  (Moreau: y in the normal cone of K at z)
    s = a |y_t| + a_s |y_s| on normals (Coulomb: De Saxce's shift, a = mu sqrt(d_t / d_n)), else 0
    (B + rho) x = c - s + rho z - y                                                               (1)
    u <- u + alpha (x - z)                          then accelerate/mixing.pxd

At a fixed point x = z and B z - c + s + y = 0. If contacts stick, the convex solution without the shift is the solution. A run
without the shift adds it when contacts slip at the convex solution, that is, when the norm of s is large relative to the
imbalances (3) of the convex iteration:

    |s| / |max(|y|, |c|)| > SLIP_RATIO max(primal, dual)                                          (4)

In piles that stick, the ratio stays below 8, since |s| falls with the imbalances. It passes 15 within 10 to 100 iterations if
contacts slip. Earlier, the shift hinders the convex iteration, which then stalls at 1e-3 to 1e-2. (1) is solved with a
factorisation that the caller computes (`factor/linear.pxd`), over bodies that of I + K^T diag(1 / (theta + rho)) K, where
B = K K^T + diag(theta), or without a factor by conjugate gradients (accelerate/body_solve.pxd):

    x = E (r - K t),  (I + K^T E K) t = K^T E r,  E = diag(1 / (theta + rho))                     (2)

At 20 iterations, then whenever their number has grown by a quarter (at least 20), rho is updated from its imbalances,

    primal = |x - z| / |max(|x|, |z|)|,   dual = rho |z - z before| / |max(|y|, |c|)|                  (3)

If sqrt(primal / dual) is outside 1/3 .. 3, the kernel stops and returns rho times that ratio, for which the caller computes a
new factorisation; u then becomes z + y / rho.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t

import numpy as np

from lavender_ext.accelerate.body_solve cimport body_solve_t, compute_body_inverses, solve_body_system, BODY_SIZE
from lavender_ext.accelerate.mixing cimport (CONTROL, MAX_MEMORY, UNDONE, clear_mixing_memory, mix_anderson_iterates, mixing_t,
                                             store_evaluation)
from lavender_ext.core.block cimport (clip, euclidean_norm, norm2, index_of_row_group, classify_in_round_cone,
                                      compute_round_cone_scale, project_cone_normal)
from lavender_ext.core.block_types cimport (CONE, blocks_t, is_round_cone_contact, has_independent_rows,
                                            get_friction_components, friction_components_t)
from lavender_ext.core.problem cimport Data
from lavender_ext.factor.linear cimport LinearSystem, solve_linear_system, linear_t
from lavender_ext.judge.reference cimport is_strictly_inactive_contact, is_strictly_inactive_row


cdef enum:
    RHO_UPDATE_INTERVAL = 20    # Iterations before the first update of rho; later updates follow after a quarter of those done.
    SLIP_RATIO = 15             # With 8, piles that stick get the shift too early; with 30, piles that slip get it too late.
    # c of a block that is inactive at zero impulse is limited to this multiple of the largest c of the other blocks. With a smaller
    # limit, a block that becomes active would have a wrong c. Above 1e6, rho and the mixing lose digits of the other blocks to
    # rounding (tested with |b| up to 1e60).
    MAX_INACTIVE_RATIO = 10000


cdef struct factor_t:           # factor of B + rho, or of the body form (2), or conjugate gradients on (2)
    linear_t* linear
    body_solve_t* body          # conjugate gradients in place of `linear`, or NULL
    const int32_t* k_ptr        # K by rows if the factor is over bodies; otherwise NULL
    const int32_t* k_col
    const double* k_val
    const double* e             # (m) diagonal of E in (2)


cdef struct admm_t:
    const blocks_t* blocks
    double* root                # (m) sqrt(d)
    double* c                   # (m)
    double rho
    double alpha
    double* u                   # (m)
    double* z                   # (m)
    double* y                   # (m)
    double* x                   # (m)
    double* g                   # (m)
    double* before              # (m) z of the previous iteration
    double* work                # (velocities) scratch of a solve over bodies
    double done                 # number of iterations
    double next                 # number of iterations at the next update of rho
    int32_t mixed               # 1 if u was mixed
    int32_t shifted             # 1 if the shift is on
    mixing_t mixing


cdef inline void solve_shifted_system(const factor_t* f, int32_t m, double* x, double* t) noexcept nogil:
    """Overwrite x (m) with (B + rho)^-1 x (1); t (velocities) is scratch over bodies."""
    cdef int32_t i, k
    cdef double s
    if f.k_ptr == NULL:
        solve_linear_system(f.linear, x)
        return
    for i in range(f.body.n if f.body != NULL else f.linear.n):
        t[i] = 0.0
    for i in range(m):
        s = f.e[i] * x[i]
        for k in range(f.k_ptr[i], f.k_ptr[i + 1]):
            t[f.k_col[k]] += f.k_val[k] * s
    if f.body != NULL:
        solve_body_system(f.body, t)
        t = f.body.t
    else:
        solve_linear_system(f.linear, t)
    for i in range(m):
        s = x[i]
        for k in range(f.k_ptr[i], f.k_ptr[i + 1]):
            s -= f.k_val[k] * t[f.k_col[k]]
        x[i] = f.e[i] * s


cdef inline void project_round_cone(int32_t n, const double* root, double mu, const double* u, double* z) noexcept nogil:
    """Compute z = Pi_K(u) of a round cone of n rows by core/block.pxd (8)."""
    cdef double t[3]
    cdef double a[3]
    cdef double r = 0.0, size = 0.0
    cdef int32_t i, g, zone
    t[0] = t[1] = t[2] = 0.0
    a[0] = a[1] = a[2] = 0.0
    for i in range(1, n):
        g = index_of_row_group(i)
        t[g] = norm2(t[g], u[i])
        a[g] = mu * root[i] / root[0]
    zone = classify_in_round_cone(t, a, u[0], &r, &size)
    z[0] = (u[0] if u[0] > 0.0 else 0.0) + r if zone == 0 else (u[0] if zone > 0 else 0.0)
    for i in range(1, n):
        z[i] = (compute_round_cone_scale(a[index_of_row_group(i)], r, u[0]) if zone == 0 else (1.0 if zone > 0 else 0.0)) * u[i]


cdef inline void scale_friction_components(const blocks_t* p, const double* root, int32_t i, const double* x,
                                           friction_components_t* q, double* t) noexcept nogil:
    """Write the friction components of contact i to q, with coefficients in the scale of x, and |x_g| of each to t."""
    cdef int32_t j = p.ptr[i], g
    get_friction_components(p, i, q)
    for g in range(q.n):
        q.friction_coefficient[g] = q.friction_coefficient[g] * root[j + q.first[g]] / root[j]
        t[g] = euclidean_norm(x + j + q.first[g], q.size[g])


cdef inline void project_scaled_block(const blocks_t* p, const double* root, int32_t i, const double* u,
                                      double* z) noexcept nogil:
    """Compute z = Pi_K(u) of block i by core/block.pxd (7); u and z are scaled vectors of all rows."""
    cdef int32_t j = p.ptr[i], end = p.ptr[i + 1], k, g
    cdef friction_components_t q
    cdef double t[3]
    cdef double s
    if has_independent_rows(p, i):
        for k in range(j, end):
            z[k] = clip(u[k], p.lower[k] * root[k], p.upper[k] * root[k])
        return
    if is_round_cone_contact(p, i):
        project_round_cone(end - j, root + j, p.mu[i], u + j, z + j)
        return
    scale_friction_components(p, root, i, u, &q, t)
    z[j] = s = project_cone_normal(q.n, q.friction_coefficient, t, u[j])
    for g in range(q.n):
        for k in range(j + q.first[g], j + q.first[g] + q.size[g]):
            z[k] = q.friction_coefficient[g] * s / t[g] * u[k] if t[g] > q.friction_coefficient[g] * s else u[k]


cdef inline double compute_friction_shift_of_normal(const blocks_t* p, const double* root, int32_t i,
                                                    const double* y) noexcept nogil:
    """Return De Saxce's shift s of the normal of contact i, from y (m) of all rows."""
    cdef friction_components_t q
    cdef double t[3]
    cdef double s = 0.0
    cdef int32_t g
    scale_friction_components(p, root, i, y, &q, t)
    for g in range(q.n):
        s += q.friction_coefficient[g] * t[g]
    return s


cdef inline double compute_residual_imbalance(const admm_t* c, double* primal, double* dual) noexcept nogil:
    """Write both imbalances (3) to `primal` and `dual`, and return the larger value."""
    cdef int32_t i, m = c.blocks.n_rows
    cdef double x = 0.0, y = 0.0, s, t
    primal[0] = dual[0] = 0.0
    for i in range(m):
        s = c.x[i] - c.z[i]
        t = c.z[i] - c.before[i]
        primal[0] += s * s
        dual[0] += t * t
        s = c.x[i] * c.x[i]
        t = c.z[i] * c.z[i]
        x += s if s > t else t
        s = c.y[i] * c.y[i]
        t = c.c[i] * c.c[i]
        y += s if s > t else t
    primal[0] = sqrt(primal[0] / x) if x > 0.0 else 0.0
    dual[0] = c.rho * sqrt(dual[0] / y) if y > 0.0 else 0.0
    return primal[0] if primal[0] > dual[0] else dual[0]


cdef inline bint is_slip_established(const admm_t* c) noexcept nogil:
    """Return whether the convex iteration has converged to a point where contacts slip, by (4)."""
    cdef double shift = 0.0, y = 0.0, s, t, primal, dual, imbalance = compute_residual_imbalance(c, &primal, &dual)
    cdef int32_t i
    cdef const blocks_t* p = c.blocks
    for i in range(p.n_blocks):
        if not has_independent_rows(p, i):
            s = compute_friction_shift_of_normal(p, c.root, i, c.y)
            shift += s * s
    for i in range(p.n_rows):
        s = c.y[i] * c.y[i]
        t = c.c[i] * c.c[i]
        y += s if s > t else t
    return imbalance * SLIP_RATIO < sqrt(shift / y) if y > 0.0 else False


cdef public double lav_admm_workspace_size(int32_t m, int32_t memory) noexcept nogil:
    """Return the number of doubles of workspace of a run, as a double since some callers cannot receive 64-bit integers."""
    return (10.0 + 2.0 * memory) * m + CONTROL + MAX_MEMORY * MAX_MEMORY


cdef public void lav_begin_admm(admm_t* c, const blocks_t* p, int32_t memory, double rho, double alpha,
                                double* workspace) noexcept nogil:
    """Initialise a run over p before its first iteration; workspace (`lav_admm_workspace_size`) must be zero-initialised."""
    cdef int64_t m = p.n_rows
    cdef int32_t i
    c.blocks = p
    c.rho, c.alpha = rho, alpha
    c.done = c.next = 0.0
    c.mixed = c.shifted = 0
    c.root, c.c, c.u, c.z, c.y = workspace, workspace + m, workspace + 2 * m, workspace + 3 * m, workspace + 4 * m
    c.x, c.g, c.before = workspace + 5 * m, workspace + 6 * m, workspace + 7 * m
    c.work = NULL
    c.mixing.m, c.mixing.memory = <int32_t>m, memory
    c.mixing.v, c.mixing.g, c.mixing.dv = workspace + 8 * m, workspace + 9 * m, workspace + 10 * m
    c.mixing.dg = c.mixing.dv + memory * m
    c.mixing.control = c.mixing.dg + memory * m
    c.mixing.gram = c.mixing.control + CONTROL
    for i in range(p.n_rows):
        c.root[i] = sqrt(p.d[i])
        c.c[i] = p.b[i] / c.root[i]
        c.x[i] = -p.b[i]
    limit_scale_of_inactive_blocks(p, c.x, c.c)


cdef inline bint is_strictly_inactive_block(const blocks_t* p, int32_t i, const double* w) noexcept nogil:
    """Return whether block i is strictly inactive at zero impulse, as in judge/reference.pxd, with slack w (m) [m/s]."""
    cdef int32_t k
    if not has_independent_rows(p, i):
        return is_strictly_inactive_contact(p, i, w)
    for k in range(p.ptr[i], p.ptr[i + 1]):
        if not is_strictly_inactive_row(p, k, 0.0, w[k]):
            return False
    return True


cdef inline void limit_scale_of_inactive_blocks(const blocks_t* p, const double* w, double* c) noexcept nogil:
    """Limit c of blocks that are inactive at zero impulse, with slack w (m), to MAX_INACTIVE_RATIO times the largest other c.

    The c of a joint limit that is far away would otherwise determine rho and the rounding errors of the active rows.
    """
    cdef double size = 0.0, own
    cdef int32_t i, k
    for i in range(p.n_blocks):
        if not is_strictly_inactive_block(p, i, w):
            for k in range(p.ptr[i], p.ptr[i + 1]):
                size = fabs(c[k]) if fabs(c[k]) > size else size
    if not size > 0.0:
        return
    for i in range(p.n_blocks):
        own = 0.0
        for k in range(p.ptr[i], p.ptr[i + 1]):
            own = fabs(c[k]) if fabs(c[k]) > own else own
        if own > MAX_INACTIVE_RATIO * size and is_strictly_inactive_block(p, i, w):
            for k in range(p.ptr[i], p.ptr[i + 1]):
                c[k] *= MAX_INACTIVE_RATIO * size / own


cdef public double lav_admm(admm_t* c, const factor_t* f, double* lam, int32_t* n) noexcept nogil:
    """Run at most n iterations from c into lam (m) [N s]; n receives the number of remaining iterations.

    Return 0, or the new rho if the kernel has stopped early for a new factorisation.
    """
    cdef const blocks_t* p = c.blocks
    cdef int32_t m = p.n_rows, i, mixed
    cdef double rho = c.rho, primal, dual
    while n[0] > 0:
        n[0] -= 1
        mixed = c.mixed
        for i in range(p.n_blocks):
            project_scaled_block(p, c.root, i, c.u, c.z)
        for i in range(m):
            c.y[i] = rho * (c.u[i] - c.z[i])
            c.x[i] = c.c[i] + rho * c.z[i] - c.y[i]
        if p.law != CONE and c.shifted:
            for i in range(p.n_blocks):
                if not has_independent_rows(p, i):
                    c.x[p.ptr[i]] -= compute_friction_shift_of_normal(p, c.root, i, c.y)
        solve_shifted_system(f, m, c.x, c.work)
        c.done += 1.0
        for i in range(m):
            c.g[i] = c.alpha * (c.x[i] - c.z[i])
            c.u[i] += c.g[i]
        if not store_evaluation(&c.mixing, mixed, c.u, c.g):
            c.mixed = 0
            continue
        if p.law != CONE and not c.shifted and is_slip_established(c):
            c.shifted = 1
            clear_mixing_memory(&c.mixing)
        if c.done >= c.next:
            if c.next > 0.0:                            # Make the imbalances (3) equal, unless their ratio is small.
                compute_residual_imbalance(c, &primal, &dual)
            if c.next > 0.0 and primal > 0.0:
                rho = clip(sqrt(primal / dual) if dual > 0.0 else 10.0, 0.1, 10.0)
                rho = clip(rho * c.rho, 1e-9, 1e4)
                rho = rho if rho > 3.0 * c.rho or 3.0 * rho < c.rho else c.rho
            c.next = c.done + (0.25 * c.done if c.done > 4.0 * RHO_UPDATE_INTERVAL else RHO_UPDATE_INTERVAL)
        for i in range(m):
            c.before[i] = c.z[i]
            lam[i] = c.z[i] / c.root[i]
        if rho != c.rho:
            for i in range(m):
                c.u[i] = c.z[i] + c.y[i] / rho
            clear_mixing_memory(&c.mixing)
            c.mixed = 0
            return rho
        # Limit sum |gamma| to 1e4: otherwise impulses on linearly dependent rows reach 1e15. Limits of 1e3 and 1e5 also work.
        c.mixed = mix_anderson_iterates(&c.mixing, c.u, 1e4)
    return 0.0


cdef public void lav_admm_start(admm_t* c, const double* lam, const double* w) noexcept nogil:
    """Compute u = z + y / rho from a start lam and its slack w (m), so that a solution is a fixed point.

    y is -w in the scale of u. With the shift, y is -(w + s); the run begins with the shift if the start is closer to a solution of
    Coulomb's law than to a solution of the cone law.
    """
    cdef const blocks_t* p = c.blocks
    cdef int32_t i
    cdef double cone, coulomb = 0.0
    for i in range(p.n_rows):
        c.y[i] = -w[i] / c.root[i]
        if c.c[i] != p.b[i] / c.root[i]:                # c was reduced by `limit_scale_of_inactive_blocks`
            c.y[i] = c.c[i] - (w[i] + p.b[i]) / c.root[i]
        c.x[i] = c.root[i] * lam[i]
    cone = compute_start_residual(c)
    if p.law != CONE:
        for i in range(p.n_rows):
            c.before[i] = c.y[i]
        for i in range(p.n_blocks):
            if not has_independent_rows(p, i):
                c.y[p.ptr[i]] -= compute_friction_shift_of_normal(p, c.root, i, c.y)
        coulomb = compute_start_residual(c)
        c.shifted = coulomb < 0.15 * cone
        if not c.shifted:
            for i in range(p.n_rows):
                c.y[i] = c.before[i]
    for i in range(p.n_rows):
        c.u[i] = c.x[i] + c.y[i] / c.rho
        c.before[i] = 0.0


cdef inline double compute_start_residual(admm_t* c) noexcept nogil:
    """Return |x - Pi_K(x + y)|, which is 0 at a solution of the law with this y."""
    cdef int32_t i
    cdef double total = 0.0
    for i in range(c.blocks.n_rows):
        c.u[i] = c.x[i] + c.y[i]
    for i in range(c.blocks.n_blocks):
        project_scaled_block(c.blocks, c.root, i, c.u, c.z)
    for i in range(c.blocks.n_rows):
        total += (c.x[i] - c.z[i]) * (c.x[i] - c.z[i])
    return sqrt(total)


cdef class BodySolve:
    """Conjugate gradients on (2), in place of a factor.

    Parameters
    ----------
    k_ptr, k_col, k_val : (m + 1,), (entries,), (entries,) array
        K by rows.
    e : (m,) array
        Diagonal of E in (2).
    n : int
        Number of velocities, six for each body.
    before : BodySolve, optional
        Conjugate gradients for another E; its last solution is the first start.
    """
    cdef body_solve_t f
    cdef object keep
    cdef double[::1] workspace

    def __init__(self, const int32_t[::1] k_ptr, const int32_t[::1] k_col, const double[::1] k_val, const double[::1] e, int n,
                 BodySolve before=None):
        self.keep = k_ptr, k_col, k_val, e
        self.f.m, self.f.n = <int32_t>len(e), n
        self.f.k_ptr, self.f.k_col, self.f.k_val, self.f.e = &k_ptr[0], &k_col[0], &k_val[0], &e[0]
        self.workspace = np.zeros((BODY_SIZE + 4) * <Py_ssize_t>n)
        self.f.t = &self.workspace[0]
        self.f.residual, self.f.direction, self.f.product = self.f.t + n, self.f.t + 2 * n, self.f.t + 3 * n
        self.f.inverse = self.f.t + 4 * n
        if before is not None:
            self.workspace[:n] = before.workspace[:n]
            self.f.iterations = before.f.iterations
        with nogil:
            compute_body_inverses(&self.f)

    @property
    def iterations(self):
        """Sum of the iterations of all solves, including its predecessors."""
        return int(self.f.iterations)


cdef class Splitting:
    """A run of proximal splitting over a problem, with factorisations that the caller computes.

    Parameters
    ----------
    p : Data
        The problem.
    memory : int
        Number of iterations that Anderson mixing combines, 0 to MAX_MEMORY.
    rho, alpha : float
        First penalty rho and over-relaxation alpha of the module's iteration [-].
    """
    cdef admm_t c
    cdef object keep

    def __init__(self, Data p, int memory, double rho, double alpha):
        cdef double[::1] workspace
        if not 0 <= memory <= MAX_MEMORY:
            raise ValueError(f"memory is {memory}; 0 to {MAX_MEMORY} is needed")
        workspace = np.zeros(<Py_ssize_t>lav_admm_workspace_size(p.blocks.n_rows, memory))
        self.keep = p, workspace
        lav_begin_admm(&self.c, &p.blocks, memory, rho, alpha, &workspace[0])

    @property
    def rho(self):
        """Penalty rho [-] of the matrix B + rho that the caller must have factored for the next `run`."""
        return self.c.rho

    @property
    def undone(self):
        """Number of mixed steps that were undone."""
        return int(self.c.mixing.control[UNDONE])

    def start(self, const double[::1] lam, const double[::1] w):
        """Start from an impulse lam (m,) [N s] and its slack w (m,) [m/s]."""
        if lam.shape[0]:
            lav_admm_start(&self.c, &lam[0], &w[0])

    def run(self, double[::1] lam, int n, factor):
        """Run at most `n` iterations without the GIL, write the impulse to `lam` (m,) [N s], and return the number of iterations.

        If `rho` has changed afterwards, the next call needs a new factor. `factor` is a tuple: a `LinearSystem` or a `BodySolve`,
        and over bodies also the arrays of `factor_t` in its order.
        """
        cdef factor_t f
        cdef int32_t remaining = n
        cdef double new_rho
        cdef double[::1] work
        cdef const double[::1] k_val, e
        cdef const int32_t[::1] k_ptr, k_col
        cdef LinearSystem linear
        cdef BodySolve body
        f.linear, f.body, f.k_ptr = NULL, NULL, NULL
        if len(factor) > 1:
            k_ptr, k_col, k_val, e = factor[1:]
            f.k_ptr, f.k_col, f.k_val, f.e = &k_ptr[0], &k_col[0], &k_val[0], &e[0]
        if isinstance(factor[0], BodySolve):
            body = factor[0]
            f.body = &body.f
            work = np.empty(body.f.n)
        else:
            linear = factor[0]
            f.linear = &linear.f
            work = np.empty(linear.f.n + 1)
        self.c.work = &work[0]
        with nogil:
            new_rho = lav_admm(&self.c, &f, &lam[0], &remaining)
        if new_rho > 0.0:
            self.c.rho = new_rho
        return n - remaining
