"""Sweeps of Gauss-Seidel type, accelerated: one sweep y = S(x) is the map, g = x - y its step.

    nncg      x_k = y_{k-1} + beta_{k-1} p_{k-2},  y_k = S(x_k),  g_k = x_k - y_k,                    (1)
              beta_k = g_k.D g_k / g_{k-1}.D g_{k-1},  p_k = beta_k p_{k-1} - g_k  (p_k = -g_k where beta_k > 1)
              or, where it keeps p, beta_k = 1 there while p_{k-1}.D g_k <= 0                         (3)
    anderson  x_k = Pi(y - sum_i gamma_i (y_i+1 - y_i)),  gamma least squares of f = sum_i gamma_i (f_i+1 - f_i),
              f = D^1/2 (y - x), over the last `memory` sweeps                                        (2)

D = diag d, so that both work in energy. S is a sweep of pgs or of exact blocks (local/gauss_seidel.pxd), over A in
compressed rows, over the factored form with v = M^-1 J^T lam, or over J and M with v = Y^T lam; with the symmetric
order a sweep and the same sweep backwards. An iterate that is shown is always a swept one, y. All sums run in a fixed
order.

(2) and its safeguards are those of accelerate/mixing.pxd. The first `convex` iterations may sweep under the cone law:
where contacts stick, its answer is Coulomb's.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t, uint64_t

import numpy as np

from lavender_ext.accelerate.accelerated cimport sweep_data_t
from lavender_ext.accelerate.mixing cimport CONTROL, MAX_MEMORY, UNDONE, forget, mix, mixing_t, take
from lavender_ext.core.block cimport CONE, CONTACT_ROLLING, ROW, blocks_t, clip, n_apart, n_tangents, norm2
from lavender_ext.core.generalized cimport whitened_gather
from lavender_ext.core.order cimport RANDOM, SYMMETRIC, advance_order
from lavender_ext.core.problem cimport Data
from lavender_ext.core.rows cimport relax_rows_block
from lavender_ext.core.velocity cimport rows_velocity
from lavender_ext.judge.watch cimport CONVERGED, RUNNING, STALLED, Watch, begins_again
from lavender_ext.local.gauss_seidel cimport solve_csr_block, solve_general_block, solve_rows_block
from lavender_ext.sweep.levels cimport sweep_levels
from lavender_ext.sweep.packed cimport pack_order, packed_t, room_of
from lavender_ext.sweep.pgs cimport relax_csr_block, relax_general_block

cdef enum:
    REFRESH = 64                # iterations of nncg after which v is formed anew: rounding adds up in it

cdef enum:
    AGAIN = 64                  # sweeps that a stalled run has from its best, begun anew

cdef enum:                      # places in control of nncg
    NORM = 0                    # g.Dg of the last sweep
    RESTARTS = 1                # p dropped


cdef inline void sweep(sweep_data_t* c, double* lam, int32_t first) noexcept nogil:
    cdef const blocks_t* p = c.blocks
    cdef int32_t i, q, k, exact = c.exact or c.turn < c.convex
    if c.turn < c.convex:
        p = &c.cone
    for k in range(2 if c.mode == SYMMETRIC else 1):
        advance_order(c.mode, first and k == 0, c.order, 0, c.split, c.rng)
        advance_order(c.mode, first and k == 0, c.order, c.split, p.n_blocks, c.rng)
        if c.mode == SYMMETRIC and not (first and k == 0):
            c.backwards = 1 - c.backwards
        if c.general != NULL:
            for q in range(p.n_blocks):
                i = c.order[q]
                if exact:
                    solve_general_block(p, c.general, i, c.g + c.start[i], lam, c.v)
                else:
                    relax_general_block(p, c.general, i, lam, c.v)
        elif c.csr != NULL:
            if not exact:
                for q in range(p.n_blocks):
                    relax_csr_block(p, c.csr, c.order[q], lam)
            else:
                for q in range(p.n_blocks):
                    i = c.order[q]
                    solve_csr_block(p, c.csr, i, c.g + c.start[i], lam)
        elif c.packed != NULL and not exact:
            sweep_levels(p, c.rows, c.packed, c.backwards, lam, c.v)
        elif not exact:
            for q in range(p.n_blocks):
                relax_rows_block(p, c.rows, c.order[q], lam, c.v)
        else:
            for q in range(p.n_blocks):
                i = c.order[q]
                solve_rows_block(p, c.rows, i, c.g + c.start[i], lam, c.v)


cdef inline void form_velocity(const sweep_data_t* c, const double* lam) noexcept nogil:
    # nothing to do where A is swept
    if c.general != NULL:
        whitened_gather(c.general, lam, c.v)
    elif c.nv > 0:
        rows_velocity(c.blocks, c.rows, lam, c.v)


cdef inline void project_block(const blocks_t* p, int32_t i, double* lam) noexcept nogil:
    """lam of block i into its bounds, normal first."""
    cdef int32_t j = p.ptr[i], n = p.ptr[i + 1] - j, k, nt
    cdef double bound, size
    if p.kind[i] == ROW:
        for k in range(j, j + n):
            lam[k] = clip(lam[k], p.lower[k], p.upper[k])
        return
    if lam[j] < 0.0:
        lam[j] = 0.0
    bound = p.mu[i] * lam[j]
    nt = n_tangents(p.kind[i], n)
    if nt > 0:
        size = norm2(lam[j + 1], lam[j + 2]) if nt >= 2 else fabs(lam[j + 1])
        for k in range(3, 1 + nt):                      # of a round cone
            size = norm2(size, lam[j + k])
        if size > bound:
            size = bound / size
            for k in range(1, 1 + nt):
                lam[j + k] *= size
    if n_apart(p.kind[i], n) & 1:
        bound = bound * p.patch_radius[i]
        lam[j + 1 + nt] = clip(lam[j + 1 + nt], -bound, bound)
    if p.kind[i] == CONTACT_ROLLING:
        bound = p.rolling[i] * lam[j]
        size = norm2(lam[j + n - 2], lam[j + n - 1])
        if size > bound:
            lam[j + n - 2] *= bound / size
            lam[j + n - 1] *= bound / size


cdef inline double energy(const double* d, const double* x, const double* y, int32_t m) noexcept nogil:
    """x.D y."""
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


cdef inline double step_energy(const double* d, double* x, const double* y, int32_t m) noexcept nogil:
    """x <- x - y; x.D x of that, summed as `energy`."""
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


cdef inline void follow(double* y, double* x, double* p, double beta, int32_t n) noexcept nogil:
    """p <- beta p - x, then y <- y + beta p of before and x <- y, in one pass."""
    cdef int32_t i
    cdef double q
    for i in range(n):
        q = beta * p[i]
        p[i] = q - x[i]
        q = y[i] + q
        y[i] = q
        x[i] = q


cdef public void lav_nncg(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil:
    """n iterations of (1)."""
    cdef sweep_data_t* c = <sweep_data_t*>context
    cdef int32_t m = c.blocks.n_rows, i, s
    cdef double* x = c.work                             # x, then g; behind lam's part that of v
    cdef double* q = c.work + m + c.nv                  # beta p, to be added
    cdef double* p = q + m + c.nv
    cdef double* control = c.control
    cdef const double* d = c.blocks.d
    cdef double norm, beta = 0.0
    for s in range(n):
        if c.turn > 0 and c.turn % REFRESH == 0:
            form_velocity(c, lam)
        if s > 0:
            follow(lam, x, p, beta, m)
            follow(c.v, x + m, p + m, beta, c.nv)
        else:
            for i in range(m):
                lam[i] += q[i]
                x[i] = lam[i]
            for i in range(c.nv):
                c.v[i] += q[m + i]
                x[m + i] = c.v[i]
        sweep(c, lam, first_sweep and s == 0)
        norm = step_energy(d, x, lam, m)
        for i in range(c.nv):
            x[m + i] -= c.v[i]
        beta = norm / control[NORM] if control[NORM] > 0.0 else 0.0
        if not beta <= 1.0:
            if c.keeps and beta > 1.0 and energy(d, x, p, m) <= 0.0:
                beta = 1.0                              # (3)
            else:
                beta = 0.0
                control[RESTARTS] += 1.0
        control[NORM] = norm
        c.turn += 1
        if c.turn == c.convex:
            control[NORM] = 0.0                         # another map: start anew
    if n > 0:
        for i in range(m + c.nv):
            q[i] = beta * p[i]
            p[i] = q[i] - x[i]


cdef public void lav_anderson(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil:
    """n iterations of (2)."""
    cdef sweep_data_t* c = <sweep_data_t*>context
    cdef int32_t m = c.blocks.n_rows, i, s, mixed
    cdef double* x = c.work                             # x, later f
    cdef const double* d = c.blocks.d
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
    if c.turn == 0:
        for i in range(m):
            root[i] = sqrt(d[i])
    for s in range(n):
        mixed = mix(&mixing, lam)
        if mixed:
            for i in range(c.blocks.n_blocks):
                project_block(c.blocks, i, lam)
            form_velocity(c, lam)
        for i in range(m):
            x[i] = lam[i]
        sweep(c, lam, first_sweep and s == 0)
        for i in range(m):
            x[i] = root[i] * (lam[i] - x[i])
        if not take(&mixing, mixed, lam, x):
            form_velocity(c, lam)
        c.turn += 1
        if c.turn == c.convex:
            forget(&mixing)                             # another map


cdef inline void forget_all(sweep_data_t* c, const double* lam) noexcept nogil:
    """As before the first iteration, from lam (m), but for the counts."""
    cdef int32_t i, m = c.blocks.n_rows
    if c.memory == 0:
        c.control[NORM] = 0.0
        for i in range(2 * (m + c.nv)):
            c.work[m + c.nv + i] = 0.0
    else:
        for i in range(CONTROL):
            if i != UNDONE:
                c.control[i] = 0.0
    form_velocity(c, lam)


cdef enum:
    FEWEST = 24                 # blocks: below, a sweep costs less than to find pairs
    FIRST = 16                  # sweeps of a run that packs, with all before: packing costs two to four


cdef class Pairs:
    """Blocks of rows in pairs, level by level, for accelerated sweeps in a fixed order; made once these are many.

    wanted : without it none are made, and the bits are the same.
    """
    cdef packed_t packed
    cdef object keep
    cdef bint asked, ready
    cdef int32_t backwards

    def __init__(self, bint wanted=True):
        self.asked = not wanted

    cdef void make(self, Data p, const int32_t[::1] order, int split, int mode, const double* lam):
        cdef double[::1] room
        self.asked = True
        self.backwards = 0
        if mode == RANDOM or not p.factored or p.blocks.n_blocks < FEWEST or split != p.rows.n_joints:
            return
        self.keep = room = np.empty(room_of(&p.blocks, &p.rows))
        self.ready = pack_order(&p.blocks, &p.rows, &order[0], 1, &room[0], lam, &self.packed)

    @property
    def count(self):
        """Pairs; 0 where blocks are swept one after the other."""
        return self.packed.pairs if self.ready else 0


def allocate(Data p, int memory):
    """Zeroed (control, gram, work, v) for a run, and its pairs; memory 0 is nncg."""
    cdef Py_ssize_t m = p.blocks.n_rows, nv = p.general.n if p.is_general else 6 * p.rows.n_bodies if p.factored else 0
    if not 0 <= memory <= MAX_MEMORY:
        raise ValueError(f"memory is {memory}; 0 to {MAX_MEMORY} is needed")
    return (np.zeros(CONTROL), np.zeros(MAX_MEMORY * MAX_MEMORY), np.zeros(3 * (m + nv) + (1 + 2 * memory) * m + 1),
            np.zeros((nv // 6 + 2, 6)), Pairs())


def run(Data p, Watch watch, double[::1] lam, int n, double tol, int memory, prepared, bint exact, int convex, space,
        int32_t[::1] order, int split, int mode, uint64_t[::1] rng, bint keeps=False):
    """`n` iterations in place under `watch`, GIL released: (status, iterations, sweeps, restarts so far).

    prepared is (start, numbers) of gauss_seidel.prepare, or None where neither `exact` nor `convex` asks for it;
    space comes from `allocate`, v in it holding M^-1 J^T lam.
    """
    cdef sweep_data_t c
    cdef int32_t status, done = 0, more = 0
    cdef double[::1] control = space[0], gram = space[1], work = space[2], g
    cdef double[:, ::1] v = space[3]
    cdef int32_t[::1] start
    cdef Pairs pairs = space[4]
    if lam.shape[0] == 0:
        if tol > 0.0:
            return CONVERGED, 0, 0, 0
        return RUNNING, n, n, 0
    c.blocks = &p.blocks
    c.csr = NULL if p.factored else &p.csr
    c.rows = &p.rows
    c.general = &p.general if p.is_general else NULL
    c.start = NULL
    c.g = NULL
    c.exact = exact
    c.convex = convex
    c.turn = watch.state.total
    c.cone = p.blocks
    c.cone.law = CONE
    if prepared is not None:
        start, g = prepared
        c.start = &start[0]
        c.g = &g[0]
    c.order = &order[0]
    c.split = split
    c.mode = mode
    c.memory = memory
    c.keeps = keeps
    c.rng = &rng[0]
    c.v = &v[0, 0]
    c.nv = p.general.n if p.is_general else 6 * p.rows.n_bodies if p.factored else 0
    c.packed = NULL
    if not exact and not pairs.asked and c.turn + <int64_t>n >= FIRST:
        pairs.make(p, order, split, mode, &lam[0])
    if pairs.ready:
        c.packed = &pairs.packed
    c.backwards = pairs.backwards
    c.control = &control[0]
    c.gram = &gram[0]
    c.work = &work[0]
    with nogil:
        status = watch.run(lav_nncg if memory == 0 else lav_anderson, &c, &lam[0], n, tol, &done)
        while status == STALLED and begins_again(&watch.state, AGAIN):
            forget_all(&c, &lam[0])
            status = watch.run(lav_nncg if memory == 0 else lav_anderson, &c, &lam[0], n - done, tol, &more)
            done += more
    pairs.backwards = c.backwards
    return status, done, done * (2 if mode == SYMMETRIC else 1), int(control[RESTARTS if memory == 0 else UNDONE])
