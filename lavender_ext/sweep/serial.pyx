"""Sweeps of Gauss-Seidel and Jacobi type, on the rows of A or on the factored form.

    pgs                   block i, then the next, each on w = A lam - b with the lam of now          (1)
    sequential impulses   the same sweep on v = M^-1 J^T lam: w = J v + c lam - b, A never formed     (2)
    jacobi                all blocks on the w of before the sweep, each step times omega              (3)
    sor                   lam_i <- lam_i - omega w_i / d_i on free rows                              (4)

The update of one block is core/block.pxd (1)-(4) everywhere. Invariant of (2), on entry and after every
block: v = M^-1 J^T lam to rounding.
"""
from libc.stdint cimport int32_t, int64_t, uint64_t

import numpy as np

from lavender_ext.core.block cimport (CONTACT_ROLLING, ROW, blocks_t, n_apart, n_tangents, relax_normal,
                                      relax_row, relax_tangents)
from lavender_ext.core.csr cimport csr_dot, csr_t
from lavender_ext.core.generalized cimport generalized_t
from lavender_ext.core.order cimport advance_order
from lavender_ext.core.problem cimport Data
from lavender_ext.core.rows cimport relax_rows_block, rows_t
from lavender_ext.judge.watch cimport CONVERGED, RUNNING, Watch, sweep_t
from lavender_ext.sweep.packed cimport MOST, move_impulses, pack_order, packed_t, room_of, sweep_records
from lavender_ext.sweep.pgs cimport relax_csr_block, relax_general_block


cdef public void lav_impulse_sweeps(const blocks_t* p, const rows_t* r, double* lam, double* v, int32_t* order,
                                    int32_t split, int32_t mode, uint64_t* rng, int32_t first_sweep, int32_t n) noexcept nogil:
    """n sweeps of (2), order as in next_order; v (n_bodies, 6)."""
    cdef int32_t s, i
    for s in range(n):
        advance_order(mode, first_sweep and s == 0, order, 0, split, rng)
        advance_order(mode, first_sweep and s == 0, order, split, p.n_blocks, rng)
        for i in range(p.n_blocks):
            relax_rows_block(p, r, order[i], lam, v)


cdef enum:
    FEWEST = 24                 # blocks: below, calls cost more than sweeps
    FIRST = 8                   # sweeps of the run that packs: packing costs two to four
    FIRST_FAR = 16              # from FAR blocks, whose records leave the second-level cache
    FAR = 4000


cdef enum:                      # of a packing
    NOT_YET = 0
    READY = 1
    USELESS = 2


cdef struct packing_t:          # blocks in pairs, made at the first run of sweeps that is long enough
    packed_t packed
    double* room
    int32_t status
    int32_t first               # sweeps of a run that makes it


cdef inline int32_t impulse_sweeps_packed(const blocks_t* p, const rows_t* r, double* lam, double* v, const int32_t* order,
                                          packing_t* x, int32_t n) noexcept nogil:
    """n sweeps of (2) with the same bits, or 0 and none where one block after the other is faster; v (n_bodies + 2, 6),
    behind the last body zeros."""
    if x.status == NOT_YET and n >= x.first:
        x.status = READY if pack_order(p, r, order, 0, x.room, lam, &x.packed) else USELESS
    if x.status != READY or n < x.packed.stages:
        return 0
    move_impulses(p, order, &x.packed, 0, lam)
    sweep_records(p, r, &x.packed, n, lam, v)
    move_impulses(p, order, &x.packed, 1, lam)
    return 1


cdef struct context_t:          # what a sweep needs besides lam
    const blocks_t* blocks
    const csr_t* csr
    const rows_t* rows
    const generalized_t* general        # NULL where A is swept
    double omega
    double* scratch             # (m) Jacobi; (n_bodies, 6) velocity of sequential impulses; (nv) u
    int32_t* order
    int32_t split
    int32_t mode
    uint64_t* rng
    packing_t* packing          # NULL: one block after the other


cdef inline void next_order(context_t* c, int32_t first_sweep) noexcept nogil:
    """Advance order (k) within order[:split] and order[split:] apart; `first_sweep` says that none came before."""
    advance_order(c.mode, first_sweep, c.order, 0, c.split, c.rng)
    advance_order(c.mode, first_sweep, c.order, c.split, c.blocks.n_blocks, c.rng)


cdef void pgs_step(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil:
    """n sweeps of (1); over J and M u (nv) = Y^T lam is in scratch."""
    cdef context_t* c = <context_t*>context
    cdef const blocks_t* p = c.blocks
    cdef int32_t s, i
    for s in range(n):
        if c.order == NULL:                             # every block is one row, as it stands: without the lookups
            for i in range(p.n_rows):
                lam[i] = relax_row(lam[i], csr_dot(c.csr, i, lam) - p.b[i], p.step[i], p.lower[i], p.upper[i])
            continue
        next_order(c, first_sweep and s == 0)
        if c.general == NULL:
            for i in range(p.n_blocks):
                relax_csr_block(p, c.csr, c.order[i], lam)
        else:
            for i in range(p.n_blocks):
                relax_general_block(p, c.general, c.order[i], lam, c.scratch)


cdef void sor_step(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil:
    """n sweeps of (4) over free rows."""
    cdef context_t* c = <context_t*>context
    cdef const blocks_t* p = c.blocks
    cdef int32_t s, i, q
    for s in range(n):
        next_order(c, first_sweep and s == 0)
        for i in range(p.n_blocks):
            for q in range(p.ptr[c.order[i]], p.ptr[c.order[i] + 1]):
                lam[q] = lam[q] - c.omega * p.step[q] * (csr_dot(c.csr, q, lam) - p.b[q])


cdef void jacobi_step(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil:
    """n sweeps of (3); scratch (m) holds w."""
    cdef context_t* c = <context_t*>context
    cdef const blocks_t* p = c.blocks
    cdef double* w = c.scratch
    cdef int32_t _s, i, j, q, nt, end
    cdef double bound, omega = c.omega
    for _s in range(n):
        for i in range(p.n_rows):
            w[i] = csr_dot(c.csr, i, lam) - p.b[i]
        for i in range(p.n_blocks):
            j = p.ptr[i]
            end = p.ptr[i + 1]
            if p.kind[i] == ROW:
                for q in range(j, end):
                    lam[q] = relax_row(lam[q], w[q], omega * p.step[q], p.lower[q], p.upper[q])
                continue
            nt = n_tangents(p.kind[i], end - j)
            lam[j] = relax_normal(lam[j], w[j], omega * p.step[j])
            bound = p.mu[i] * lam[j]
            if nt > 0:
                relax_tangents(lam + j + 1, w + j + 1, omega * p.step[j + 1], bound, nt)
            if n_apart(p.kind[i], end - j) & 1:
                q = j + 1 + nt
                bound = p.patch_radius[i] * bound
                lam[q] = relax_row(lam[q], w[q], omega * p.step[q], -bound, bound)
            if p.kind[i] == CONTACT_ROLLING:
                q = end - 2
                relax_tangents(lam + q, w + q, omega * p.step[q], p.rolling[i] * lam[j], 2)


cdef void impulse_step(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil:
    cdef context_t* c = <context_t*>context
    if c.packing != NULL and impulse_sweeps_packed(c.blocks, c.rows, lam, c.scratch, c.order, c.packing, n):
        return
    lav_impulse_sweeps(c.blocks, c.rows, lam, c.scratch, c.order, c.split, c.mode, c.rng, first_sweep, n)


PGS, SOR, JACOBI, IMPULSES = range(4)


cdef class Packing:
    """Blocks of `p` in pairs, for sequential impulses in one fixed order.

    Made at the first run of sweeps that is long enough; `before`, of another problem, hands over its room.
    """
    cdef packing_t state
    cdef object keep

    def __init__(self, Data p, Packing before=None):
        cdef int64_t size = room_of(&p.blocks, &p.rows)
        cdef double[::1] room
        self.keep = None
        if before is not None:
            self.keep, before.keep = before.keep, None
            before.state.status = USELESS
        if self.keep is None or len(self.keep) < size:
            self.keep = np.empty(size)
        room = self.keep
        self.state.room = &room[0]
        self.state.first = FIRST if p.blocks.n_blocks < FAR else FIRST_FAR
        self.state.status = NOT_YET

    @property
    def shape(self):
        """(records, stages); (0, 0) where nothing is packed."""
        if self.state.status != READY:
            return 0, 0
        return self.state.packed.pairs, self.state.packed.stages


def may_pack(Data p):
    """Whether there are as many blocks over bodies as gain by packing."""
    return bool(p.factored and FEWEST <= p.blocks.n_blocks <= MOST)


def run(int kind, Data p, Watch watch, double[::1] lam, int n, double tol, int32_t[::1] order, int split, int mode,
        uint64_t[::1] rng, double omega=1.0, double[::1] scratch=None, Packing packing=None):
    """`n` sweeps in place under `watch`, GIL released: (status, sweeps done).

    kind is PGS, SOR, JACOBI or IMPULSES; an empty order means row by row, for PGS over single rows.
    `packing`, of this `p` and `order`, makes impulses pack; scratch is then (n_bodies + 2, 6).
    """
    cdef context_t c
    cdef int32_t status, done = 0
    cdef sweep_t step = pgs_step
    if lam.shape[0] == 0:
        if tol > 0.0:
            return CONVERGED, 0
        return RUNNING, n
    if kind == 1:
        step = sor_step
    elif kind == 2:
        step = jacobi_step
    elif kind == 3:
        step = impulse_step
    c.blocks = &p.blocks
    c.csr = &p.csr
    c.rows = &p.rows
    c.general = &p.general if p.is_general else NULL
    c.omega = omega
    c.scratch = &scratch[0] if scratch is not None else NULL
    c.order = &order[0] if order.shape[0] else NULL
    c.split = split
    c.mode = mode
    c.rng = &rng[0]
    c.packing = NULL
    if packing is not None:
        c.packing = &packing.state
    with nogil:
        status = watch.run(step, &c, &lam[0], n, tol, &done)
    return status, done
