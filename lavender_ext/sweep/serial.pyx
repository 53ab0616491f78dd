"""Sweeps of Gauss-Seidel and Jacobi type, on the rows of A, on bodies, or on J and M.

    pgs                   block i, then the next, each on w = A lam - b with the lam of now          (1)
    sequential impulses   the same sweep on v = M^-1 J^T lam: w = J v + c lam - b, A never formed     (2)
    block gauss seidel    as (1) or (2), each block solved exactly (local/gauss_seidel.pxd)
    jacobi                all blocks on the w of before the sweep, each step times omega              (3)
    sor                   lam_i <- lam_i - omega w_i / d_i on free rows                              (4)

Over J and M the sweeps of (1) run on u = Y^T lam: w = Y u + c lam - b. The update of one block is core/block.pxd (1)-(4)
everywhere. Invariant of (2), on entry and after every block: v = M^-1 J^T lam to rounding.
"""
from libc.stdint cimport int32_t, int64_t, uint64_t

import numpy as np

from lavender_ext.core.block cimport relax_normal, relax_row, relax_tangents
from lavender_ext.core.csr cimport csr_dot
from lavender_ext.core.parts cimport blocks_t, is_rows, parts_of, parts_t
from lavender_ext.core.problem cimport Data
from lavender_ext.judge.watch cimport CONVERGED, RUNNING, Watch, sweep_t
from lavender_ext.local.gauss_seidel cimport solve_blocks
from lavender_ext.sweep.levels cimport sweep_levels
from lavender_ext.sweep.packed cimport MOST, move_impulses, room_of, sweep_records
from lavender_ext.sweep.pgs cimport relax_bodies, relax_general, relax_matrix
from lavender_ext.sweep.serial cimport NOT_YET, READY, USELESS, context_t, form_velocity, is_packed, next_order


cdef enum:
    FEWEST = 24                 # blocks: below, calls cost more than sweeps
    FIRST = 8                   # sweeps of the run that packs: packing costs two to four
    FIRST_FAR = 16              # from FAR blocks, whose records leave the second-level cache; of sweeps one at a time
    FAR = 4000


cdef void sweep(context_t* c, const blocks_t* p, bint exact, double* lam, bint first) noexcept nogil:
    """One sweep over blocks p, those of `c` or with another law."""
    next_order(c, first)
    if exact:
        c.fallbacks += solve_blocks(p, c.csr, c.rows, c.general, c.start, c.g, c.order, lam, c.v)
    elif c.general != NULL:
        relax_general(p, c.general, c.order, 0, p.n_blocks, lam, c.v)
    elif c.csr != NULL:
        relax_matrix(p, c.csr, c.order, 0, p.n_blocks, lam)
    elif c.packing != NULL and c.packing.single and c.packing.status == READY:
        sweep_levels(p, c.rows, &c.packing.packed, c.packing.backwards, lam, c.v)
    else:
        relax_bodies(p, c.rows, c.order, 0, p.n_blocks, lam, c.v)


cdef void sweep_step(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil:
    """n sweeps of (1) or (2), over exact blocks or not; in pairs with the same bits."""
    cdef context_t* c = <context_t*>context
    cdef int32_t s
    if is_packed(c, lam, n) and n >= c.packing.packed.stages:
        move_impulses(c.blocks, c.order, &c.packing.packed, 0, lam)
        sweep_records(c.blocks, c.rows, &c.packing.packed, n, lam, c.v)
        move_impulses(c.blocks, c.order, &c.packing.packed, 1, lam)
        return
    for s in range(n):
        sweep(c, c.blocks, c.exact, lam, first_sweep and s == 0)


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
    """n sweeps of (3); w (m) is scratch."""
    cdef context_t* c = <context_t*>context
    cdef const blocks_t* p = c.blocks
    cdef double* w = c.w
    cdef int32_t _s, i, j, g, q
    cdef double omega = c.omega
    cdef parts_t part
    for _s in range(n):
        for i in range(p.n_rows):
            w[i] = csr_dot(c.csr, i, lam) - p.b[i]
        for i in range(p.n_blocks):
            j = p.ptr[i]
            if is_rows(p, i):
                for q in range(j, p.ptr[i + 1]):
                    lam[q] = relax_row(lam[q], w[q], omega * p.step[q], p.lower[q], p.upper[q])
                continue
            lam[j] = relax_normal(lam[j], w[j], omega * p.step[j])
            parts_of(p, i, &part)
            for g in range(part.n):
                q = j + part.first[g]
                relax_tangents(lam + q, w + q, omega * p.step[q], part.reach[g] * lam[j], part.size[g])


SWEEPS, SOR, JACOBI = range(3)


def may_pack(Data p):
    """Whether there are as many blocks over bodies as gain by standing in pairs."""
    return bool(p.factored and FEWEST <= p.blocks.n_blocks <= MOST)


cdef class Sweeps:
    """What sweeps of a problem run over: its blocks in an order, and the velocities that they keep.

    Parameters
    ----------
    p : Data
    order : (k,) int32
        Turned round or shuffled in place, as `mode` says; empty: row by row, over single rows of A.
    split, mode, rng
        As in `lavender.ordering.Order`.
    prepared : tuple, optional
        (start, numbers) of `gauss_seidel.prepare`, for blocks that are solved exactly.
    exact : bool
        They all are; else in the first sweeps of `accelerated.run` alone.
    packs : bool
        In pairs, from a run on that is long enough; the order is the same in each sweep, or turned round.
    single : bool
        Something is done between two sweeps: pairs are of one.
    before : Sweeps, optional
        Of another problem: hands over the room of its pairs, and packs no more.
    """

    def __init__(self, Data p, int32_t[::1] order, int split, int mode, uint64_t[::1] rng, prepared=None,
                 bint exact=False, bint packs=False, bint single=False, Sweeps before=None):
        cdef int32_t[::1] start
        cdef double[::1] g
        cdef double[:, ::1] v
        cdef context_t* c = &self.c
        self.keep = p, order, rng, prepared
        c.blocks = &p.blocks
        if p.is_general:
            c.general = &p.general
            c.n_v = p.general.n
        elif p.factored:
            c.rows = &p.rows
            c.n_v = 6 * p.rows.n_bodies
        else:
            c.csr = &p.csr
        if c.n_v > 0:
            self.velocity = v = np.zeros((c.n_v // 6 + 2, 6))
            c.v = &v[0, 0]
        c.split = split
        c.mode = mode
        c.order = &order[0] if order.shape[0] else NULL
        c.rng = &rng[0]
        c.exact = exact
        if prepared is not None:
            start, g = prepared
            c.start = &start[0]
            c.g = &g[0]
        self.packing.single = single
        self.packing.first = FIRST_FAR if single or p.blocks.n_blocks >= FAR else FIRST
        if packs:
            c.packing = &self.packing
        if before is not None:
            self.room, before.room = before.room, None
            before.packing.status = USELESS

    cdef int make_room(self, int64_t sweeps) except -1:
        """Room of pairs, where so many sweeps in a run make them."""
        cdef int64_t size
        cdef double[::1] room
        cdef packing_t* x = self.c.packing
        if x != NULL and x.status == NOT_YET and x.room == NULL and sweeps >= x.first:
            size = room_of(self.c.blocks, self.c.rows)
            if self.room is None or len(self.room) < size:
                self.room = np.empty(size)
            room = self.room
            x.room = &room[0]
        return 0

    def start(self, const double[::1] lam):
        """The velocities of an impulse (m,), where it is another than the last sweep left."""
        if lam.shape[0]:
            form_velocity(&self.c, &lam[0])

    @property
    def pairs(self):
        """(records, stages); (0, 0) where one block is swept after the other."""
        if self.packing.status != READY:
            return 0, 0
        return self.packing.packed.pairs, self.packing.packed.stages


def run(int kind, Sweeps x, Watch watch, double[::1] lam, int n, double tol, double omega=1.0):
    """`n` sweeps in place under `watch`, GIL released: (status, sweeps done, blocks that fell back).

    kind is SWEEPS, SOR or JACOBI. Before the first sweep the velocities of lam are formed; later ones keep them.
    """
    cdef int32_t status, done = 0
    cdef double[::1] w
    cdef sweep_t step = sweep_step
    if lam.shape[0] == 0:
        if tol > 0.0:
            return CONVERGED, 0, 0
        return RUNNING, n, 0
    if kind == 1:
        step = sor_step
    elif kind == 2:
        step = jacobi_step
        w = np.empty(lam.shape[0])
        x.c.w = &w[0]
    x.c.omega = omega
    x.c.fallbacks = 0.0
    x.make_room(n)
    with nogil:
        if watch.state.total == 0:
            form_velocity(&x.c, &lam[0])
        status = watch.run(step, &x.c, &lam[0], n, tol, &done)
    return status, done, int(x.c.fallbacks)
