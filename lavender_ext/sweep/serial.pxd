"""Runs of sweeps, accelerated or not, as workspace size, start and step on plain structs, usable without Python.

    sweep_run_t x                         the caller sets order, split, mode, rng, exact, method, omega and packing.single
    sweeps_workspace_size(&x, &v, start)  number of doubles of workspace of a run over v
    start_sweeps(&x, &v, start, workspace)
    run_sweeps(&x, &test, &v, ...)        sweeps up to a number, or until the stopping test ends them
"""
from libc.stdint cimport int32_t, int64_t, uint64_t

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.problem cimport Data
from lavender_ext.core.view cimport csr_t, generalized_t, rows_t, view_t
from lavender_ext.judge.stopping_test cimport sweep_t, stopping_test_t
from lavender_ext.sweep.packed cimport packed_t


cdef extern from *:
    """
    #ifdef LAV_SWEEPS_ONLY
    #define LAVENDER_ALL_SWEEPS 0
    #else
    #define LAVENDER_ALL_SWEEPS 1
    #endif
    """
    int ALL_SWEEPS "LAVENDER_ALL_SWEEPS"    # 0 in the small build of the C library: no pairs, exact blocks, J and M


cdef enum:
    MIN_PACKED_BLOCKS = 24      # Problems with fewer blocks are not packed: calls would cost more than sweeps.

cpdef enum:                     # methods
    SWEEPS                      # projected Gauss-Seidel, or exact blocks
    SOR
    JACOBI

cdef enum:                      # status of a packing
    NOT_PACKED = 0
    PACKED = 1
    NOT_WORTH_PACKING = 2


cdef struct packing_t:          # blocks in pairs, which are packed in the first run that is long enough
    packed_t packed
    double* workspace           # (`packed_workspace_size`) memory of the records, or NULL
    int32_t status
    int32_t min_sweeps          # Blocks are packed in the first run of at least this many sweeps.
    bint single                 # The run calls one sweep at a time, because the caller does something between sweeps.
    bint backwards              # if `single`: the order is the reverse of the packed one


cdef struct sweep_context_t:    # everything that a sweep needs except lam
    const blocks_t* blocks
    const csr_t* csr            # Exactly one of csr, rows and general is not NULL.
    const rows_t* rows
    const generalized_t* general
    double* v                   # bodies: M^-1 J^T lam (n_bodies, 6) and 12 doubles for static bodies; J and M: Y^T lam (nv)
    int32_t n_v                 # number of velocities, 0 over A
    int32_t split               # order[:split] and order[split:] are reversed or shuffled separately: joints, contacts
    int32_t mode                # GIVEN | SYMMETRIC | RANDOM
    int32_t* order              # (k) or NULL: every block is one row of A, in the given order
    uint64_t* rng
    packing_t* packing          # NULL: blocks are not packed
    bint exact                  # Every block is solved exactly instead of relaxed.
    const int32_t* start        # (k) first index in `prepared` of each block, if blocks may be solved exactly
    const double* prepared      # diagonal blocks, prepared by local/gauss_seidel.pyx
    double fallbacks            # number of blocks without an exact solution, which were relaxed instead
    int32_t method              # SWEEPS | SOR | JACOBI
    double omega                # relaxation factor of SOR and JACOBI
    double* w                   # (m) slacks before the sweep, for JACOBI


ctypedef void (*forget_t)(void* context, const double* lam) noexcept nogil


cdef struct sweep_run_t:
    sweep_context_t context
    packing_t packing
    sweep_t step                # runs sweeps with `step_context`
    void* step_context
    forget_t forget             # clears the memory of an accelerated run, before a stalled run restarts; NULL: no restart


cdef int32_t count_sweep_velocities(const view_t* v) noexcept nogil
cdef void compute_sweep_velocities(const sweep_context_t* c, const double* lam) noexcept nogil
cdef double compute_jacobi_damping(const blocks_t* p, const csr_t* a, double* scratch) noexcept nogil
cdef bint can_pack_blocks(const sweep_run_t* x, const view_t* v) noexcept nogil
cdef int64_t sweeps_workspace_size(sweep_run_t* x, const view_t* v, int32_t* start) noexcept nogil
cdef void start_sweeps(sweep_run_t* x, const view_t* v, const int32_t* start, double* workspace) noexcept nogil
cdef int32_t run_sweeps(sweep_run_t* x, stopping_test_t* test, const view_t* v, const view_t* confirm, double* lam, int32_t n,
                        double tol, int32_t* done) noexcept nogil
cdef void sweep_over_form(sweep_context_t* c, const blocks_t* p, bint exact, double* lam, bint first) noexcept nogil
cdef void run_sweep_chunk(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil


cdef class Sweeps:
    cdef sweep_run_t x
    cdef view_t view
    cdef object references, workspace, packing_workspace
    cdef double* allocate(self, Data p, int32_t[::1] order, int split, int mode, uint64_t[::1] rng, bint exact,
                          bint prepares_blocks, int64_t extra) except NULL
    cdef double undone(self) noexcept
