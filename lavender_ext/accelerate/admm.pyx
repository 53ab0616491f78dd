"""Proximal splitting on the bounds or cones of all blocks, in the metric of d, with Anderson mixing.

With x = D^1/2 lam, B = D^-1/2 A D^-1/2, c = D^-1/2 b, cones K in the same scale, one vector u carries all:

    z = Pi_K(u),   y = rho (u - z)                  (Moreau: y in the normal cone of K at z)
    s = a |y_t| + a_s |y_s| on normals (Coulomb: De Saxce's shift, a = mu sqrt(d_t / d_n)), else 0
    (B + rho) x = c - s + rho z - y                                                               (1)
    u <- u + alpha (x - z)                          then accelerate/mixing.pxd

At rest x = z: B z - c + s + y = 0. The shift comes in once both imbalances below are at most 1e-3 (or
after 200 iterations), that is from the convex answer: where contacts stick that is the answer, elsewhere a
start. (1) is solved with a factorisation made by the caller: Cholesky of a dense matrix, L L^T or L U by panels
(`factor/sparse.pyx`), or those of I + K^T diag(1 / (theta + rho)) K over bodies where B = K K^T + diag(theta):

    x = E (r - K t),  (I + K^T E K) t = K^T E r,  E = diag(1 / (theta + rho))                     (2)

At 20 iterations, then after every quarter more of them (20 at least), rho is weighed by its imbalances,

    primal = |x - z| / |max(|x|, |z|)|,   dual = rho |z - z before| / |max(|y|, |c|)|                  (3)

Where sqrt(primal / dual) is outside 1/3 .. 3 the kernel stops and asks for a factorisation with rho times
that; u then becomes z + y / rho.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t

import numpy as np

from lavender_ext.accelerate.mixing cimport CONTROL, MAX_MEMORY, UNDONE, forget, mix, mixing_t, take
from lavender_ext.core.block cimport (CONE, CONTACT_ROLLING, ROUND, ROW, blocks_t, clip, ends_apart, n_tangents, norm2,
                                      rolling_section, round_group, round_section, round_share)
from lavender_ext.core.generalized cimport dot
from lavender_ext.core.problem cimport Data
from lavender_ext.factor.blocks cimport sparse_t
from lavender_ext.factor.sparse cimport SparsePanels
from lavender_ext.factor.supernodal cimport sparse_solve


cdef enum:
    DENSE = 0
    PANELS = 1
    BODIES = 2

cdef enum:
    RHO_EVERY = 20              # iterations between weighings of rho at first, later a quarter of those done
    CONVEX_AT_MOST = 200        # iterations without the shift


cdef struct factor_t:           # of B + rho, or of the body form
    int32_t kind
    int32_t n                   # its order
    const double* dense         # (n, n) Cholesky, row by row, lower
    const sparse_t* panels
    const int32_t* k_ptr        # K by rows (BODIES)
    const int32_t* k_col
    const double* k_val
    const double* e             # (m) E


cdef struct admm_t:
    const blocks_t* blocks
    const double* root          # (m) sqrt d
    const double* c             # (m)
    double rho
    double alpha
    double* u                   # (m)
    double* z                   # (m)
    double* y                   # (m)
    double* x                   # (m)
    double* g                   # (m)
    double* before              # (m) z of the iteration before
    double* work                # (n) of BODIES
    double* turn                # (4) iterations done; u was mixed; iterations at the next weighing; the shift is on


cdef inline void solve_dense(const factor_t* f, double* x) noexcept nogil:
    # x (n) <- matrix^-1 x
    cdef int32_t i, j, n = f.n
    cdef double s
    cdef const double* row
    for i in range(n):
        row = f.dense + <int64_t>n * i
        x[i] = (x[i] - dot(row, x, i)) / row[i]
    i = n - 1
    while i >= 0:
        row = f.dense + <int64_t>n * i
        s = x[i] / row[i]
        x[i] = s
        for j in range(i):
            x[j] -= row[j] * s
        i -= 1


cdef inline void solve_shifted(const factor_t* f, int32_t m, double* x, double* t) noexcept nogil:
    # (1): x (m) <- (B + rho)^-1 x; t (n) is scratch of BODIES
    cdef int32_t i, k
    cdef double s
    if f.kind == DENSE:
        solve_dense(f, x)
        return
    if f.kind == PANELS:
        sparse_solve(f.panels, x, x)
        return
    for i in range(f.n):
        t[i] = 0.0
    for i in range(m):
        s = f.e[i] * x[i]
        for k in range(f.k_ptr[i], f.k_ptr[i + 1]):
            t[f.k_col[k]] += f.k_val[k] * s
    sparse_solve(f.panels, t, t)
    for i in range(m):
        s = x[i]
        for k in range(f.k_ptr[i], f.k_ptr[i + 1]):
            s -= f.k_val[k] * t[f.k_col[k]]
        x[i] = f.e[i] * s


cdef inline void project_round(int32_t n, const double* root, double mu, const double* u, double* z) noexcept nogil:
    """The same of a round cone of n rows; core/block.pxd (8)."""
    cdef double t[3]
    cdef double a[3]
    cdef double r = 0.0, size = 0.0
    cdef int32_t i, g, zone
    t[0] = t[1] = t[2] = 0.0
    a[0] = a[1] = a[2] = 0.0
    for i in range(1, n):
        g = round_group(i)
        t[g] = norm2(t[g], u[i])
        a[g] = mu * root[i] / root[0]
    zone = round_section(t, a, u[0], &r, &size)
    z[0] = (u[0] if u[0] > 0.0 else 0.0) + r if zone == 0 else (u[0] if zone > 0 else 0.0)
    for i in range(1, n):
        z[i] = (round_share(a[round_group(i)], r, u[0]) if zone == 0 else (1.0 if zone > 0 else 0.0)) * u[i]


cdef inline void project_rolling(const blocks_t* p, const double* root, int32_t i, const double* u, double* z) noexcept nogil:
    # the same of a contact that resists rolling: parts g of one or two rows
    cdef int32_t j = p.ptr[i], n = p.ptr[i + 1] - j, g, k, q
    cdef double a[3]
    cdef double t[3]
    cdef double bound[3]
    cdef double f
    openings(p, root, i, a)
    for g in range(3):
        q = 1 if g == 0 else 3 if g == 1 else n - 2
        t[g] = norm2(u[j + q], u[j + q + 1]) if g != 1 else fabs(u[j + q]) if n == 6 else 0.0
    z[j] = rolling_section(a, t, u[j], bound)
    for g in range(3):
        f = bound[g] / t[g] if t[g] > bound[g] else 1.0
        q = 1 if g == 0 else 3 if g == 1 else n - 2
        for k in range(j + q, j + q + (2 if g != 1 else n - 5)):
            z[k] = f * u[k]


cdef inline void openings(const blocks_t* p, const double* root, int32_t i, double* a) noexcept nogil:
    # a_g of the tangents, of the spin (0 without), of what rolls
    cdef int32_t j = p.ptr[i], n = p.ptr[i + 1] - j
    a[0] = p.mu[i] * root[j + 1] / root[j]
    a[1] = p.mu[i] * p.patch_radius[i] * root[j + 3] / root[j] if n == 6 else 0.0
    a[2] = p.rolling[i] * root[j + n - 2] / root[j]


cdef inline void project_block(const blocks_t* p, const double* root, int32_t i, const double* u,
                               double* z) noexcept nogil:
    """z = Pi_K(u) of one block, u, z whole scaled vectors; core/block.pxd (7)."""
    cdef int32_t j = p.ptr[i], n = p.ptr[i + 1] - j, k, nt
    cdef double at, as_, t, s, c
    if p.kind[i] == ROW:
        for k in range(j, j + n):
            z[k] = clip(u[k], p.lower[k] * root[k], p.upper[k] * root[k])
        return
    if p.kind[i] == ROUND:
        project_round(n, root + j, p.mu[i], u + j, z + j)
        return
    if p.kind[i] == CONTACT_ROLLING:
        project_rolling(p, root, i, u, z)
        return
    nt = n_tangents(p.kind[i], n)
    at = p.mu[i] * root[j + 1] / root[j] if nt > 0 else 0.0
    as_ = p.mu[i] * p.patch_radius[i] * root[j + n - 1] / root[j] if ends_apart(p.kind[i]) else 0.0
    t = norm2(u[j + 1], u[j + 2]) if nt == 2 else (fabs(u[j + 1]) if nt == 1 else 0.0)
    c = fabs(u[j + n - 1]) if ends_apart(p.kind[i]) else 0.0
    s = u[j] if u[j] > 0.0 else 0.0
    if (u[j] + at * t) / (1.0 + at * at) > s:
        s = (u[j] + at * t) / (1.0 + at * at)
    if ends_apart(p.kind[i]):
        if (u[j] + as_ * c) / (1.0 + as_ * as_) > s:
            s = (u[j] + as_ * c) / (1.0 + as_ * as_)
        if (u[j] + at * t + as_ * c) / (1.0 + at * at + as_ * as_) > s:
            s = (u[j] + at * t + as_ * c) / (1.0 + at * at + as_ * as_)
        z[j + n - 1] = clip(u[j + n - 1], -as_ * s, as_ * s)
    z[j] = s
    c = at * s / t if t > at * s else 1.0
    for k in range(j + 1, j + 1 + nt):
        z[k] = c * u[k]


cdef inline double shift(const blocks_t* p, const double* root, int32_t i, const double* y) noexcept nogil:
    # s of the normal of contact i
    cdef int32_t j = p.ptr[i], n = p.ptr[i + 1] - j, nt = n_tangents(p.kind[i], n)
    cdef double s = 0.0
    cdef double a[3]
    if p.kind[i] == CONTACT_ROLLING:
        openings(p, root, i, a)
        s = a[0] * norm2(y[j + 1], y[j + 2]) + a[2] * norm2(y[j + n - 2], y[j + n - 1])
        return s + a[1] * fabs(y[j + 3]) if n == 6 else s
    if nt > 0:
        s = p.mu[i] * root[j + 1] / root[j] * (norm2(y[j + 1], y[j + 2]) if nt == 2 else fabs(y[j + 1]))
    if ends_apart(p.kind[i]):
        s += p.mu[i] * p.patch_radius[i] * root[j + n - 1] / root[j] * fabs(y[j + n - 1])
    return s


cdef inline double imbalance(const admm_t* c, double* primal, double* dual) noexcept nogil:
    # |x - z| and rho |z - z before|, each over the size of its vectors; the larger of both.
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


cdef inline double weighed(const admm_t* c) noexcept nogil:
    # The rho that the last iteration asks for, or the present one.
    cdef double primal, dual, s
    imbalance(c, &primal, &dual)
    if not primal > 0.0:
        return c.rho
    s = clip(sqrt(primal / dual) if dual > 0.0 else 10.0, 0.1, 10.0)
    s = clip(s * c.rho, 1e-9, 1e4)
    return s if s > 3.0 * c.rho or 3.0 * s < c.rho else c.rho


cdef public double lav_admm(admm_t* c, const factor_t* f, const mixing_t* mixing, double* lam,
                            int32_t* n) noexcept nogil:
    """At most n iterations; n is what is left on return. Returns 0, or the rho that should be factored next."""
    cdef const blocks_t* p = c.blocks
    cdef int32_t m = p.n_rows, i, mixed
    cdef double rho = c.rho, primal, dual
    while n[0] > 0:
        n[0] -= 1
        mixed = c.turn[1] > 0.0
        for i in range(p.n_blocks):
            project_block(p, c.root, i, c.u, c.z)
        for i in range(m):
            c.y[i] = rho * (c.u[i] - c.z[i])
            c.x[i] = c.c[i] + rho * c.z[i] - c.y[i]
        if p.law != CONE and c.turn[3] > 0.0:
            for i in range(p.n_blocks):
                if p.kind[i] != ROW:
                    c.x[p.ptr[i]] -= shift(p, c.root, i, c.y)
        solve_shifted(f, m, c.x, c.work)
        c.turn[0] += 1.0
        for i in range(m):
            c.g[i] = c.alpha * (c.x[i] - c.z[i])
            c.u[i] += c.g[i]
        if not take(mixing, mixed, c.u, c.g):
            c.turn[1] = 0.0
            continue
        if c.turn[3] == 0.0 and (c.turn[0] >= CONVEX_AT_MOST or imbalance(c, &primal, &dual) <= 1e-3):
            c.turn[3] = 1.0
            forget(mixing)
        if c.turn[0] >= c.turn[2]:
            if c.turn[2] > 0.0:
                rho = weighed(c)
            c.turn[2] = c.turn[0] + (0.25 * c.turn[0] if c.turn[0] > 4.0 * RHO_EVERY else RHO_EVERY)
        for i in range(m):
            c.before[i] = c.z[i]
            lam[i] = c.z[i] / c.root[i]
        if rho != c.rho:
            for i in range(m):
                c.u[i] = c.z[i] + c.y[i] / rho
            forget(mixing)
            c.turn[1] = 0.0
            return rho
        c.turn[1] = mix(mixing, c.u)
    return 0.0


cdef public void lav_admm_start(const blocks_t* p, const double* lam, const double* w, const double* root, double rho,
                                double* u, double* y) noexcept nogil:
    """u (m) of a start: lam, its slack w; y (m) is scratch."""
    cdef int32_t i
    for i in range(p.n_rows):
        y[i] = -w[i] / root[i]
    for i in range(p.n_rows):
        u[i] = y[i]
    if p.law != CONE:
        for i in range(p.n_blocks):
            if p.kind[i] != ROW:
                u[p.ptr[i]] -= shift(p, root, i, y)
    for i in range(p.n_rows):
        u[i] = root[i] * lam[i] + u[i] / rho


def allocate(Data p, int memory):
    """Zeroed vectors of a run: (control, gram, turn, work)."""
    if not 0 <= memory <= MAX_MEMORY:
        raise ValueError(f"memory is {memory}; 0 to {MAX_MEMORY} is needed")
    return (np.zeros(CONTROL), np.zeros(MAX_MEMORY * MAX_MEMORY), np.zeros(4),
            np.zeros((8 + 2 * memory) * p.blocks.n_rows + 1))


def start(Data p, const double[::1] lam, const double[::1] w, const double[::1] root, double rho, space):
    """u of an impulse and its slack: z + y / rho with y = -(w + s) in the scale of u."""
    cdef double[::1] v = space[3]
    cdef Py_ssize_t m = p.blocks.n_rows
    lav_admm_start(&p.blocks, &lam[0], &w[0], &root[0], rho, &v[0], &v[m])


def run(Data p, double[::1] lam, int n, double rho, double alpha, int memory, space, const double[::1] root,
        const double[::1] c, factor):
    """At most `n` iterations in place, GIL released: (iterations done, 0 or the rho to factor next, undone so far).

    factor: (kind, order, arrays) with the arrays that `factor_t` names, in its order; None where a kind has none.
    """
    cdef admm_t run
    cdef factor_t f
    cdef mixing_t mixing
    cdef Py_ssize_t m = p.blocks.n_rows
    cdef int32_t left = n
    cdef double wanted
    cdef double[::1] control = space[0], gram = space[1], turn = space[2], v = space[3]
    cdef double[::1] work
    cdef const double[:, ::1] dense
    cdef const double[::1] k_val, e
    cdef const int32_t[::1] k_ptr, k_col
    cdef SparsePanels panels
    f.kind = factor[0]
    f.n = factor[1]
    if f.kind == DENSE:
        dense = factor[2][0]
        f.dense = &dense[0, 0]
    else:
        panels = factor[2][0]
        f.panels = &panels.f
        if f.kind == BODIES:
            k_ptr, k_col, k_val, e = factor[2][1:]
            f.k_ptr, f.k_col, f.k_val, f.e = &k_ptr[0], &k_col[0], &k_val[0], &e[0]
    work = np.empty(f.n + 1)
    run.blocks = &p.blocks
    run.root = &root[0]
    run.c = &c[0]
    run.rho = rho
    run.alpha = alpha
    run.u, run.z, run.y, run.x, run.g, run.before = &v[0], &v[m], &v[2 * m], &v[3 * m], &v[4 * m], &v[5 * m]
    run.work = &work[0]
    run.turn = &turn[0]
    mixing.m = <int32_t>m
    mixing.memory = memory
    mixing.control = &control[0]
    mixing.gram = &gram[0]
    mixing.v, mixing.g, mixing.dv = &v[6 * m], &v[7 * m], &v[8 * m]
    mixing.dg = mixing.dv + memory * m
    with nogil:
        wanted = lav_admm(&run, &f, &mixing, &lam[0], &left)
    return n - left, wanted, int(control[UNDONE])
