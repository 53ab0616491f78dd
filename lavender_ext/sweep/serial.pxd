"""What sweeps of Gauss-Seidel type run over, and one of them: for sweeps alone, and for those that are accelerated."""
from libc.stdint cimport int32_t, int64_t, uint64_t

from lavender_ext.core.csr cimport csr_t
from lavender_ext.core.generalized cimport generalized_t, whitened_gather
from lavender_ext.core.order cimport SYMMETRIC, advance_order
from lavender_ext.core.parts cimport blocks_t
from lavender_ext.core.rows cimport rows_t
from lavender_ext.core.velocity cimport rows_velocity
from lavender_ext.sweep.packed cimport pack_order, packed_t


cdef enum:                      # of a packing
    NOT_YET = 0
    READY = 1
    USELESS = 2


cdef struct packing_t:          # blocks in pairs, made at the first run of sweeps that is long enough
    packed_t packed
    double* room                # `room_of`, or NULL
    int32_t status
    int32_t first               # sweeps of a run that makes it
    int32_t single              # one sweep at a time, since something is done in between
    int32_t backwards           # of these: the order is turned round since they were packed


cdef struct context_t:          # what a sweep needs besides lam
    const blocks_t* blocks
    const csr_t* csr            # NULL over bodies
    const rows_t* rows
    const generalized_t* general        # NULL but for J and M
    double* v                   # M^-1 J^T lam (n_bodies, 6), then room for twelve; of J and M u = Y^T lam (nv)
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


cdef inline bint is_packed(context_t* c, const double* lam, int64_t sweeps) noexcept nogil:
    """Whether blocks stand in pairs; made so for a run of so many sweeps, where it is long enough."""
    cdef packing_t* x = c.packing
    if x == NULL:
        return False
    if x.status == NOT_YET and x.room != NULL and sweeps >= x.first:
        x.backwards = 0
        x.status = READY if pack_order(c.blocks, c.rows, c.order, x.single, x.room, lam, &x.packed) else USELESS
    return x.status == READY


cdef inline void form_velocity(const context_t* c, const double* lam) noexcept nogil:
    """v of lam (m); nothing to do where A is swept."""
    if c.general != NULL:
        whitened_gather(c.general, lam, c.v)
    elif c.n_v > 0:
        rows_velocity(c.blocks, c.rows, lam, c.v)


cdef inline void next_order(context_t* c, bint first) noexcept nogil:
    """Advance the order within order[:split] and order[split:] apart; `first`: no sweep came before."""
    advance_order(c.mode, first, c.order, 0, c.split, c.rng)
    advance_order(c.mode, first, c.order, c.split, c.blocks.n_blocks, c.rng)
    if c.packing != NULL and c.mode == SYMMETRIC and not first:
        c.packing.backwards = 1 - c.packing.backwards


cdef void sweep(context_t* c, const blocks_t* p, bint exact, double* lam, bint first) noexcept nogil


cdef class Sweeps:
    cdef context_t c
    cdef packing_t packing
    cdef object keep, room
    cdef readonly object velocity       # (n + 2, 6) v, then zeros; None over A
    cdef int make_room(self, int64_t sweeps) except -1
