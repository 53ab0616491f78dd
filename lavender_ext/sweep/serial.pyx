"""Sweeps of Gauss-Seidel and Jacobi type over the rows of A, over bodies, or over J and M.

    pgs                   block after block, each with w = A lam - b of the current lam                (1)
    sequential impulses   (1) with w = J v + c lam - b, v = M^-1 J^T lam; A is never formed            (2)
    block gauss seidel    (1) or (2) with each block solved exactly (local/gauss_seidel.pyx)
    jacobi                all blocks with the w of before the sweep, and steps multiplied by omega     (3)
    sor                   (1) with steps multiplied by omega, over A; on bounded rows and cones it is projected     (4)

Over J and M the sweeps of (1) use u = Y^T lam: w = Y u + c lam - b. All methods use the update of a block of core/block.pxd
(1)-(3). Invariant of (2), on entry and after every block: v = M^-1 J^T lam to rounding.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t, uint64_t

import numpy as np

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.csr cimport csr_row_dot
from lavender_ext.core.generalized cimport multiply_whitened_transpose
from lavender_ext.core.order cimport GIVEN, SYMMETRIC, update_sweep_order
from lavender_ext.core.problem cimport Data
from lavender_ext.core.velocity cimport compute_velocity_change
from lavender_ext.core.view cimport csr_t, view_t
from lavender_ext.judge.stopping_test cimport (CONVERGED, RUNNING, STALLED, StoppingTest, check_start, restart_if_stalled,
                                               run_until_stop, stopping_test_t)
from lavender_ext.local.gauss_seidel cimport prepare_exact_blocks, index_prepared_numbers, sweep_exact_blocks
from lavender_ext.sweep.packed cimport (MAX_PACKED_BLOCKS, copy_packed_impulses, pack_blocks_in_order,
                                        packed_workspace_size_of_blocks, sweep_records)
from lavender_ext.sweep.pgs cimport (sweep_bodies, sweep_matrix_sor, sweep_generalized, sweep_csr_once, sweep_bounded_rows,
                                     sweep_jacobi)
from lavender_ext.sweep.serial cimport (ALL_SWEEPS, MIN_PACKED_BLOCKS, NOT_PACKED, NOT_WORTH_PACKING, PACKED, packing_t,
                                        sweep_context_t, sweep_run_t)


cdef enum:
    MIN_SWEEPS_TO_PACK = 8      # Blocks are packed in runs of at least this many sweeps; packing costs two to four sweeps.
    MIN_SWEEPS_TO_PACK_MANY = 16    # Smallest run for packing if sweeps are called one by one, or from MANY_BLOCKS blocks on.
    MANY_BLOCKS = 4000          # The records of this many blocks do not fit the second-level cache.
    RESTART_SWEEPS = 64         # Number of sweeps of a stalled run after its restart from the best iterate.


cdef bint pack_blocks_of_long_run(sweep_context_t* c, const double* lam, int64_t sweeps) noexcept nogil:
    """Pack the blocks if a run of `sweeps` sweeps is long enough for that; return whether the blocks are packed."""
    cdef packing_t* x = c.packing
    if not ALL_SWEEPS or x == NULL:
        return False
    if x.status == NOT_PACKED and x.workspace != NULL and sweeps >= x.min_sweeps:
        x.backwards = False
        x.status = PACKED if pack_blocks_in_order(c.blocks, c.rows, c.order, x.single, x.workspace, lam,
                                                  &x.packed) else NOT_WORTH_PACKING
    return x.status == PACKED


cdef void compute_sweep_velocities(const sweep_context_t* c, const double* lam) noexcept nogil:
    """Compute the velocities v of lam (m). Sweeps over A have no velocities."""
    if c.general != NULL:
        multiply_whitened_transpose(c.general, lam, c.v)
    elif c.n_v > 0:
        compute_velocity_change(c.blocks, c.rows, lam, c.v)


cdef double compute_jacobi_damping(const blocks_t* p, const csr_t* a, double* scratch) noexcept nogil:
    """Return min(1, 1.6 / max_i sum_j |A_ij| sqrt(s_i s_j)) with the steps s, a safe omega of Jacobi; scratch (m)."""
    cdef double largest_sum = 0.0, row_sum
    cdef int32_t i, q
    for i in range(p.n_rows):
        scratch[i] = sqrt(p.step[i])
    for i in range(p.n_rows):
        row_sum = 0.0
        for q in range(a.indptr[i], a.indptr[i + 1]):
            row_sum += fabs(a.data[q]) * scratch[a.indices[q]]
        row_sum *= scratch[i]
        if row_sum > largest_sum:
            largest_sum = row_sum
    return 1.6 / largest_sum if 1.6 < largest_sum else 1.0


cdef bint can_pack_blocks(const sweep_run_t* x, const view_t* v) noexcept nogil:
    """Return whether blocks may be packed: over bodies, in an order that does not change, or is reversed between single sweeps."""
    cdef const sweep_context_t* c = &x.context
    cdef bint single = x.packing.single
    if v.r == NULL or c.exact or not (c.mode == GIVEN or (single and c.mode == SYMMETRIC)):
        return False
    if single and c.split != v.r.n_joints:
        return False
    return MIN_PACKED_BLOCKS <= v.p.n_blocks <= MAX_PACKED_BLOCKS


cdef int32_t count_sweep_velocities(const view_t* v) noexcept nogil:
    """Return the number of velocities that sweeps over the problem v store."""
    return v.g.n if v.g != NULL else 6 * v.r.n_bodies if v.r != NULL else 0


cdef int64_t sweeps_workspace_size(sweep_run_t* x, const view_t* v, int32_t* start) noexcept nogil:
    """Return the number of doubles of workspace of a run over v, -1 if an index does not fit int32.

    start (k) receives the first index of each prepared block; NULL if no block is solved exactly.
    """
    cdef sweep_context_t* c = &x.context
    cdef double n = index_prepared_numbers(&v.p, start) + 1 if ALL_SWEEPS and start != NULL else 0.0
    c.blocks, c.csr, c.rows, c.general, c.n_v = &v.p, v.a, v.r, v.g, count_sweep_velocities(v)
    return c.n_v + 12 + <int64_t>n if n < 2147483647.0 else -1


cdef void start_sweeps(sweep_run_t* x, const view_t* v, const int32_t* start, double* workspace) noexcept nogil:
    """Start a run in workspace (`sweeps_workspace_size`, zero-initialised)."""
    cdef sweep_context_t* c = &x.context
    c.v = workspace
    if ALL_SWEEPS and start != NULL:
        c.start, c.prepared = start, workspace + c.n_v + 12
        prepare_exact_blocks(v, start, workspace + c.n_v + 12)
    x.packing.min_sweeps = (MIN_SWEEPS_TO_PACK_MANY if x.packing.single or v.p.n_blocks >= MANY_BLOCKS
                            else MIN_SWEEPS_TO_PACK)
    if x.step_context == NULL:
        x.step_context = c


cdef int32_t run_sweeps(sweep_run_t* x, stopping_test_t* test, const view_t* v, const view_t* confirm, double* lam, int32_t n,
                        double tol, int32_t* done) noexcept nogil:
    """Run n sweeps, or fewer if a check stops them; write their number to `done` and return the status."""
    cdef int32_t status, more
    x.context.w = test.e                                # The stopping test needs its errors only during checks.
    if test.total == 0:
        status = check_start(test, v, confirm, lam, tol)
        if status != RUNNING:
            done[0] = 0
            return status
        compute_sweep_velocities(&x.context, lam)
    if x.packing.single:
        pack_blocks_of_long_run(&x.context, lam, <int64_t>test.total + n)
    status = run_until_stop(test, v, confirm, x.step, x.step_context, lam, n, tol, done)
    while status == STALLED and x.forget != NULL and restart_if_stalled(test, RESTART_SWEEPS):
        x.forget(x.step_context, lam)
        status = run_until_stop(test, v, confirm, x.step, x.step_context, lam, n - done[0], tol, &more)
        done[0] += more
    return status


cdef void sweep_over_form(sweep_context_t* c, const blocks_t* p, bint exact, double* lam, bint first) noexcept nogil:
    """Run one sweep over the blocks p, which are the blocks of `c`, possibly with another law; first: no sweep was made before."""
    cdef int32_t i
    # Compute all slacks before the sweep (3).
    if c.method == JACOBI:
        for i in range(p.n_rows):
            c.w[i] = csr_row_dot(c.csr, i, lam) - p.b[i]
        sweep_jacobi(p, c.w, c.omega, lam)
        return
    # Reverse or shuffle the order.
    update_sweep_order(c.mode, first, c.order, 0, c.split, c.rng)
    update_sweep_order(c.mode, first, c.order, c.split, c.blocks.n_blocks, c.rng)
    if c.packing != NULL and c.mode == SYMMETRIC and not first:
        c.packing.backwards = not c.packing.backwards
    # Sweep over the blocks.
    if c.method == SOR:
        sweep_matrix_sor(p, c.csr, c.omega, c.order, lam)
    elif ALL_SWEEPS and exact:
        c.fallbacks += sweep_exact_blocks(p, c.csr, c.rows, c.general, c.start, c.prepared, c.order, lam, c.v)
    elif ALL_SWEEPS and c.general != NULL:
        sweep_generalized(p, c.general, c.order, lam, c.v)
    elif c.csr != NULL and c.order == NULL:
        sweep_bounded_rows(p, c.csr, lam)
    elif c.csr != NULL:
        sweep_csr_once(p, c.csr, c.order, lam)
    elif ALL_SWEEPS and c.packing != NULL and c.packing.single and c.packing.status == PACKED:
        sweep_records(p, c.rows, &c.packing.packed, 1, c.packing.backwards, lam, c.v)
    else:
        sweep_bodies(p, c.rows, c.order, p.n_blocks, lam, c.v)


cdef void run_sweep_chunk(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil:
    """Run n sweeps; packed blocks give the same bits."""
    cdef sweep_context_t* c = <sweep_context_t*>context
    cdef int32_t s
    if pack_blocks_of_long_run(c, lam, n) and n >= c.packing.packed.n_stages:
        copy_packed_impulses(c.blocks, c.order, &c.packing.packed, True, lam)
        sweep_records(c.blocks, c.rows, &c.packing.packed, n, False, lam, c.v)
        copy_packed_impulses(c.blocks, c.order, &c.packing.packed, False, lam)
        return
    for s in range(n):
        sweep_over_form(c, c.blocks, c.exact, lam, first_sweep and s == 0)


def jacobi_damping_of_matrix(Data p):
    """Return the relaxation factor omega [-] of Jacobi's method over the rows of A, from `compute_jacobi_damping`."""
    cdef double[::1] scratch = np.empty(p.blocks.n_rows + 1)
    return compute_jacobi_damping(&p.blocks, &p.csr, &scratch[0])


cdef class Sweeps:
    """Sweeps of a problem: its blocks in an order, and the velocities of its impulses.

    Parameters
    ----------
    p : Data
    order : (k,) int32
        Reversed or shuffled in place, according to `mode`. Empty: row by row, over single rows of A.
    split, mode, rng
        As in `lavender.ordering.Order`.
    method, omega
        SWEEPS, SOR or JACOBI, and the relaxation factor [-] of SOR and JACOBI.
    exact : bool
        Solve blocks exactly.
    before : Sweeps, optional
        Sweeps of another problem. Its packing workspace is taken over, and it packs no more.
    """

    def __init__(self, Data p, int32_t[::1] order, int split, int mode, uint64_t[::1] rng, int method=SWEEPS, double omega=1.0,
                 bint exact=False, Sweeps before=None):
        self.x.step = run_sweep_chunk
        self.x.context.method, self.x.context.omega = method, omega
        self.allocate(p, order, split, mode, rng, exact, exact, 0)
        if before is not None:
            self.packing_workspace, before.packing_workspace = before.packing_workspace, None
            before.x.packing.status = NOT_WORTH_PACKING

    cdef double* allocate(self, Data p, int32_t[::1] order, int split, int mode, uint64_t[::1] rng, bint exact,
                          bint prepares_blocks, int64_t extra) except NULL:
        """Allocate the workspace, start the run, and return the address of `extra` additional doubles of workspace.

        With `prepares_blocks`, blocks may be solved exactly.
        """
        cdef sweep_context_t* c = &self.x.context
        cdef int32_t[::1] start = np.empty(p.blocks.n_blocks + 1, np.int32) if prepares_blocks else None
        cdef int32_t* first = &start[0] if prepares_blocks else NULL
        cdef double[::1] workspace
        cdef int64_t n
        self.view = p.get_pointers()
        c.order = &order[0] if order.shape[0] else NULL
        c.split, c.mode, c.rng, c.exact = split, mode, &rng[0], exact
        n = sweeps_workspace_size(&self.x, &self.view, first)
        if n < 0:
            raise MemoryError("the prepared blocks have 2^31 numbers or more, which 32-bit indices cannot number")
        self.workspace = workspace = np.zeros(n + extra)
        self.references = p, order, rng, start
        start_sweeps(&self.x, &self.view, first, &workspace[0])
        if can_pack_blocks(&self.x, &self.view):
            c.packing = &self.x.packing
        return &workspace[0] + n

    cdef double undone(self) noexcept:
        """Return the number of blocks so far that used the fallback."""
        return self.x.context.fallbacks

    def run(self, StoppingTest watch, double[::1] lam, int n, double tol):
        """Run `n` sweeps in place without the GIL, or fewer if `watch` stops them; return (status, sweeps done, `undone`)."""
        cdef int32_t status, done = 0
        cdef double before = self.undone()
        cdef double[::1] workspace
        cdef packing_t* x = self.x.context.packing
        if lam.shape[0] == 0:
            if tol > 0.0:
                return CONVERGED, 0, 0
            return RUNNING, n, 0
        if (x != NULL and x.status == NOT_PACKED and x.workspace == NULL
                and n + (watch.state.total if x.single else 0) >= x.min_sweeps):
            if (self.packing_workspace is None
                    or len(self.packing_workspace) < packed_workspace_size_of_blocks(&self.view.p, self.view.r)):
                self.packing_workspace = np.empty(packed_workspace_size_of_blocks(&self.view.p, self.view.r))
            workspace = self.packing_workspace
            x.workspace = &workspace[0]
        with nogil:
            status = run_sweeps(&self.x, &watch.state, &watch.view, watch.confirm, &lam[0], n, tol, &done)
        return status, done, int(self.undone() - before)

    def start(self, const double[::1] lam):
        """Compute the velocities of an impulse (m,) that is not the result of the last sweep."""
        if lam.shape[0]:
            compute_sweep_velocities(&self.x.context, &lam[0])

    def disable_packing(self):
        """Sweep over single blocks from now on, with the same bits."""
        self.x.context.packing = NULL

    @property
    def velocity(self):
        """(n_bodies + 2, 6) velocities of bodies, then zeros."""
        return self.workspace[:self.x.context.n_v + 12].reshape(-1, 6)

    @property
    def records(self):
        """(number of records, number of stages) of packed blocks, (0, 0) if blocks are not packed."""
        cdef packing_t* x = &self.x.packing
        if x.status != PACKED:
            return 0, 0
        return x.packed.n_records, x.packed.n_stages
