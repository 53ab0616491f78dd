"""Methods of sweeps, accelerated or not, as workspace, start and step on plain structs, for any host.

    sweeping_t x                its order, how it sweeps, and `pack`: the host's
    sweeps_workspace_size(&x, &v, place)  -> float64 of a run over v
    sweeps_start(&x, &v, place, workspace)
    sweeps_step(&x, &watch, &v, ...) -> how it stands after so many sweeps
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t, uint64_t

from lavender_ext.core.generalized cimport whitened_transpose_times
from lavender_ext.core.order cimport GIVEN, SYMMETRIC, advance_order
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.problem cimport Data
from lavender_ext.core.velocity cimport rows_velocity
from lavender_ext.core.view cimport csr_t, generalized_t, rows_t, view_t
from lavender_ext.judge.stopping_test cimport STALLED, begins_again, sweep_t, stopping_test_t, run_until_stop
from lavender_ext.local.gauss_seidel cimport prepare_blocks, prepared_sizes
from lavender_ext.sweep.packed cimport MOST, pack_order, packed_t


cdef extern from *:
    """
    #ifdef LAV_SWEEPS_ONLY
    #define LAVENDER_WHOLE 0
    #else
    #define LAVENDER_WHOLE 1
    #endif
    """
    int WHOLE "LAVENDER_WHOLE"  # 0 in the small build of the C library: one block after the other, none exactly


cdef enum:
    FEWEST = 24                 # blocks: below, calls cost more than sweeps
    FIRST = 8                   # sweeps of the run that packs: packing costs two to four
    FIRST_FAR = 16              # from FAR blocks, whose records leave the second-level cache; of sweeps one at a time
    FAR = 4000
    AGAIN = 64                  # sweeps that a stalled run has from its best, begun anew


cdef enum:                      # of a packing
    NOT_YET = 0
    READY = 1
    USELESS = 2


cdef struct packing_t:          # blocks in pairs, made at the first run of sweeps that is long enough
    packed_t packed
    double* workspace                # `room_of`, or NULL
    int32_t status
    int32_t first               # sweeps of a run that makes it
    int32_t single              # one sweep at a time, since something is done in between
    int32_t backwards           # of these: the order is turned round since they were packed


cdef struct context_t:          # what a sweep needs besides lam
    const blocks_t* blocks
    const csr_t* csr            # NULL over bodies
    const rows_t* rows
    const generalized_t* general        # NULL but for J and M
    double* v                   # M^-1 J^T lam (n_bodies, 6), then workspace for twelve; of J and M u = Y^T lam (nv)
    int32_t n_v                 # numbers of v; 0 over A
    int32_t split               # blocks before it are swept before the others: joints, contacts
    int32_t mode
    int32_t* order              # (k); NULL: every block is one row, as it stands
    uint64_t* rng
    packing_t* packing          # NULL: one block after the other
    int32_t exact               # every block is solved exactly, else relaxed
    const int32_t* start        # (k) places in g of blocks that are
    const double* g
    double fallbacks            # blocks without an exact answer, relaxed instead
    double omega                # of sor and jacobi
    double* w                   # (m) of jacobi


ctypedef void (*forget_t)(void* context, const double* lam) noexcept nogil


cdef struct sweeping_t:
    context_t c                 # of the host: order, split, mode, rng, exact, omega
    packing_t packing           # `single`
    sweep_t step
    void* of                    # its context
    forget_t forget             # what was remembered, before a stalled run begins again; NULL


cdef inline bint is_packed(context_t* c, const double* lam, int64_t sweeps) noexcept nogil:
    """Whether blocks stand in pairs; made so for a run of so many sweeps, where it is long enough."""
    cdef packing_t* x = c.packing
    if not WHOLE or x == NULL:
        return False
    if x.status == NOT_YET and x.workspace != NULL and sweeps >= x.first:
        x.backwards = 0
        x.status = READY if pack_order(c.blocks, c.rows, c.order, x.single, x.workspace, lam, &x.packed) else USELESS
    return x.status == READY


cdef inline void form_velocity(const context_t* c, const double* lam) noexcept nogil:
    """v of lam (m); nothing to do where A is swept."""
    if c.general != NULL:
        whitened_transpose_times(c.general, lam, c.v)
    elif c.n_v > 0:
        rows_velocity(c.blocks, c.rows, lam, c.v)


cdef inline void next_order(context_t* c, bint first) noexcept nogil:
    """Advance the order within order[:split] and order[split:] apart; `first`: no sweep came before."""
    advance_order(c.mode, first, c.order, 0, c.split, c.rng)
    advance_order(c.mode, first, c.order, c.split, c.blocks.n_blocks, c.rng)
    if c.packing != NULL and c.mode == SYMMETRIC and not first:
        c.packing.backwards = 1 - c.packing.backwards


cdef inline double safe_damping(const blocks_t* p, const csr_t* a, double* root) noexcept nogil:
    """min(1, 1.6 / max_i sum_j |A_ij| sqrt(s_i s_j)) of jacobi, s the steps; root (m) is scratch."""
    cdef double most = 0.0, sum
    cdef int32_t i, q
    for i in range(p.n_rows):
        root[i] = sqrt(p.step[i])
    for i in range(p.n_rows):
        sum = 0.0
        for q in range(a.indptr[i], a.indptr[i + 1]):
            sum += fabs(a.data[q]) * root[a.indices[q]]
        sum *= root[i]
        if sum > most:
            most = sum
    return 1.6 / most if 1.6 < most else 1.0


cdef inline bint may_pack(const sweeping_t* x, const view_t* v) noexcept nogil:
    """Whether pairs of blocks gain: over bodies, in an order that stays, or is turned round where sweeps are single."""
    cdef const context_t* c = &x.c
    cdef bint stays = c.mode == GIVEN or (x.packing.single and c.mode == SYMMETRIC)
    if v.r == NULL or c.exact or not stays or (x.packing.single and c.split != v.r.n_joints):
        return False
    return FEWEST <= v.p.n_blocks <= MOST


cdef inline int32_t velocities_of(const view_t* v) noexcept nogil:
    """Numbers of v."""
    return v.g.n if v.g != NULL else 6 * v.r.n_bodies if v.r != NULL else 0


cdef inline int64_t sweeps_workspace_size(sweeping_t* x, const view_t* v, int32_t* place) noexcept nogil:
    """Numbers of a run over v, -1 where places do not reach; place (k): of what blocks have prepared, NULL: none is exact."""
    cdef context_t* c = &x.c
    cdef double n = prepared_sizes(&v.p, place) + 1 if WHOLE and place != NULL else 0.0
    c.blocks, c.csr, c.rows, c.general, c.n_v = &v.p, v.a, v.r, v.g, velocities_of(v)
    return c.n_v + 12 + <int64_t>n if n < 2147483647.0 else -1


cdef inline void sweeps_start(sweeping_t* x, const view_t* v, const int32_t* place, double* workspace) noexcept nogil:
    """In workspace (`sweeps_workspace_size`, zeroed)."""
    cdef context_t* c = &x.c
    c.v = workspace
    if WHOLE and place != NULL:
        c.start, c.g = place, workspace + c.n_v + 12
        prepare_blocks(v, place, workspace + c.n_v + 12)
    x.packing.first = FIRST_FAR if x.packing.single or v.p.n_blocks >= FAR else FIRST
    if x.of == NULL:
        x.of = c


cdef inline int32_t sweeps_step(sweeping_t* x, stopping_test_t* s, const view_t* v, const view_t* confirm, double* lam, int32_t n,
                                double tol, int32_t* done) noexcept nogil:
    """n sweeps, fewer where a check ends them; counts them in `done`."""
    cdef int32_t status, more
    x.c.w = s.e                                         # which a watch does not need between sweeps
    if s.total == 0:
        form_velocity(&x.c, lam)
    if x.packing.single:
        is_packed(&x.c, lam, <int64_t>s.total + n)
    status = run_until_stop(s, v, confirm, x.step, x.of, lam, n, tol, done)
    while status == STALLED and x.forget != NULL and begins_again(s, AGAIN):
        x.forget(x.of, lam)
        status = run_until_stop(s, v, confirm, x.step, x.of, lam, n - done[0], tol, &more)
        done[0] += more
    return status


cdef void sweep(context_t* c, const blocks_t* p, bint exact, double* lam, bint first) noexcept nogil


cdef class Sweeps:
    cdef sweeping_t x
    cdef view_t view
    cdef object keep, workspace, for_pairs
    cdef double* lay(self, Data p, int32_t[::1] order, int split, int mode, uint64_t[::1] rng, bint exact, bint prepares,
                     int64_t more) except NULL
    cdef double undone(self) noexcept
