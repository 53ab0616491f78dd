"""Sweeps of Gauss-Seidel and Jacobi type, on the rows of A, on bodies, or on J and M.

    pgs                   block i, then the next, each on w = A lam - b with the lam of now          (1)
    sequential impulses   the same sweep on v = M^-1 J^T lam: w = J v + c lam - b, A never formed     (2)
    block gauss seidel    as (1) or (2), each block solved exactly (local/gauss_seidel.pyx)
    jacobi                all blocks on the w of before the sweep, each step times omega              (3)
    sor                   lam_i <- lam_i - omega w_i / d_i on free rows                              (4)

Over J and M the sweeps of (1) run on u = Y^T lam: w = Y u + c lam - b. The update of one block is core/block.pxd (1)-(4)
everywhere. Invariant of (2), on entry and after every block: v = M^-1 J^T lam to rounding.
"""
from libc.stdint cimport int32_t, int64_t, uint64_t

import numpy as np

from lavender_ext.core.block cimport relax_normal, relax_row, relax_tangents
from lavender_ext.core.csr cimport csr_dot
from lavender_ext.core.block_types cimport blocks_t, is_rows, get_friction_components, friction_components_t
from lavender_ext.core.problem cimport Data
from lavender_ext.judge.stopping_test cimport CONVERGED, RUNNING, StoppingTest
from lavender_ext.local.gauss_seidel cimport solve_blocks
from lavender_ext.sweep.levels cimport sweep_levels
from lavender_ext.sweep.packed cimport move_impulses, room_of, sweep_records
from lavender_ext.sweep.pgs cimport relax_bodies, relax_general, relax_matrix
from lavender_ext.sweep.serial cimport (NOT_YET, READY, USELESS, WHOLE, context_t, form_velocity, is_packed, may_pack,
                                        next_order, packing_t, safe_damping, sweeps_workspace_size, sweeps_start, sweeps_step)


cdef void sweep(context_t* c, const blocks_t* p, bint exact, double* lam, bint first) noexcept nogil:
    """One sweep over blocks p, those of `c` or with another law."""
    next_order(c, first)
    if WHOLE and exact:
        c.fallbacks += solve_blocks(p, c.csr, c.rows, c.general, c.start, c.g, c.order, lam, c.v)
    elif WHOLE and c.general != NULL:
        relax_general(p, c.general, c.order, lam, c.v)
    elif c.csr != NULL:
        relax_matrix(p, c.csr, c.order, lam)
    elif WHOLE and c.packing != NULL and c.packing.single and c.packing.status == READY:
        sweep_levels(p, c.rows, &c.packing.packed, c.packing.backwards, lam, c.v)
    else:
        relax_bodies(p, c.rows, c.order, lam, c.v)


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
    cdef friction_components_t part
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
            get_friction_components(p, i, &part)
            for g in range(part.n):
                q = j + part.first[g]
                relax_tangents(lam + q, w + q, omega * p.step[q], part.friction_coefficient[g] * lam[j], part.size[g])


cpdef enum:                     # kinds, which Python names too
    SWEEPS
    SOR
    JACOBI


def damping(Data p):
    """Of jacobi over the rows of A."""
    cdef double[::1] root = np.empty(p.blocks.n_rows + 1)
    return safe_damping(&p.blocks, &p.csr, &root[0])


cdef class Sweeps:
    """Sweeps of a problem: its blocks in an order, and the velocities that they keep.

    Parameters
    ----------
    p : Data
    order : (k,) int32
        Turned round or shuffled in place, as `mode` says; empty: row by row, over single rows of A.
    split, mode, rng
        As in `lavender.ordering.Order`.
    kind, omega
        SWEEPS, or SOR or JACOBI with their relaxation.
    exact : bool
        Blocks are solved exactly.
    before : Sweeps, optional
        Of another problem: hands over the workspace of its pairs, and packs no more.
    """

    def __init__(self, Data p, int32_t[::1] order, int split, int mode, uint64_t[::1] rng, int kind=SWEEPS, double omega=1.0,
                 bint exact=False, Sweeps before=None):
        self.x.step = sor_step if kind == SOR else jacobi_step if kind == JACOBI else sweep_step
        self.x.c.omega = omega
        self.lay(p, order, split, mode, rng, exact, exact, 0)
        if before is not None:
            self.for_pairs, before.for_pairs = before.for_pairs, None
            before.x.packing.status = USELESS

    cdef double* lay(self, Data p, int32_t[::1] order, int split, int mode, uint64_t[::1] rng, bint exact, bint prepares,
                     int64_t more) except NULL:
        """Before the first sweep; workspace for so many numbers more. `prepares`: blocks, as some sweeps solve them exactly."""
        cdef context_t* c = &self.x.c
        cdef int32_t[::1] place = np.empty(p.blocks.n_blocks + 1, np.int32) if prepares else None
        cdef int32_t* at = &place[0] if prepares else NULL
        cdef double[::1] workspace
        cdef int64_t n
        self.view = p.view()
        c.order = &order[0] if order.shape[0] else NULL
        c.split, c.mode, c.rng, c.exact = split, mode, &rng[0], exact
        n = sweeps_workspace_size(&self.x, &self.view, at)
        if n < 0:
            raise MemoryError("the prepared numbers of blocks do not fit 32-bit places")
        self.workspace = workspace = np.zeros(n + more)
        self.keep = p, order, rng, place
        sweeps_start(&self.x, &self.view, at, &workspace[0])
        if may_pack(&self.x, &self.view):
            c.packing = &self.x.packing
        return &workspace[0] + n

    cdef double undone(self) noexcept:
        """Blocks so far that fell back."""
        return self.x.c.fallbacks

    def run(self, StoppingTest watch, double[::1] lam, int n, double tol):
        """`n` sweeps in place, or fewer where `watch` ends them, GIL released: (status, sweeps done, `undone`)."""
        cdef int32_t status, done = 0
        cdef double before = self.undone()
        cdef double[::1] workspace
        cdef packing_t* x = self.x.c.packing
        if lam.shape[0] == 0:
            if tol > 0.0:
                return CONVERGED, 0, 0
            return RUNNING, n, 0
        if x != NULL and x.status == NOT_YET and x.workspace == NULL and n + (watch.state.total if x.single else 0) >= x.first:
            if self.for_pairs is None or len(self.for_pairs) < room_of(&self.view.p, self.view.r):
                self.for_pairs = np.empty(room_of(&self.view.p, self.view.r))
            workspace = self.for_pairs
            x.workspace = &workspace[0]
        with nogil:
            status = sweeps_step(&self.x, &watch.state, &watch.view, watch.confirm, &lam[0], n, tol, &done)
        return status, done, int(self.undone() - before)

    def start(self, const double[::1] lam):
        """The velocities of an impulse (m,), where it is another than the last sweep left."""
        if lam.shape[0]:
            form_velocity(&self.x.c, &lam[0])

    def alone(self):
        """One block after the other from here on, with the same bits."""
        self.x.c.packing = NULL

    @property
    def velocity(self):
        """(n + 2, 6) of bodies, then zeros."""
        return self.workspace[:self.x.c.n_v + 12].reshape(-1, 6)

    @property
    def pairs(self):
        """(records, stages); (0, 0) where one block is swept after the other."""
        cdef packing_t* x = &self.x.packing
        if x.status != READY:
            return 0, 0
        return x.packed.pairs, x.packed.stages
