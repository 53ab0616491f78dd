"""Declarations of accelerated sweeps (`accelerated.pyx`): data, workspace size, start and step, usable without Python."""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.sweep.serial cimport Sweeps, sweep_context_t, sweep_run_t


cdef enum:
    AUTOMATIC = -1              # value of `convex`: sweep under the cone law unless (4) or (5) of accelerated.pyx holds


cdef struct acceleration_t:
    sweep_context_t* sweeps     # the sweep S; it reads prepared blocks if blocks are solved exactly or under the cone law
    blocks_t cone               # the blocks under the cone law
    int32_t convex_begin        # first iteration under the cone law
    int32_t convex              # first iteration after those under the cone law
    int32_t next_law_test       # iteration at which (4) and (5) of accelerated.pyx are tested next; -1: never
    double last_coulomb_step    # |f_coulomb| of the last test of (4)
    int32_t iterations          # number of iterations done so far
    int32_t memory
    int32_t keeps               # nncg with beta > 1: 1 to drop p only if it points against the sweep, (3) of accelerated.pyx
    double* control             # (CONTROL) state, by the indices of accelerate/mixing.pxd, or of accelerated.pyx for nncg
    double* gram                # (MAX_MEMORY, MAX_MEMORY) inner products of the differences of f in (2), for anderson
    double* work                # workspace: 3 (m + n_v) doubles for nncg, (4 + 2 memory) m for anderson


cdef public void lav_nncg(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil
cdef public void lav_anderson(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil
cdef void restart_acceleration(void* context, const double* lam) noexcept nogil
cdef double count_undone_steps(const acceleration_t* c) noexcept nogil
cdef int32_t count_convex_iterations(int32_t m, int32_t convex) noexcept nogil
cdef int64_t accelerated_workspace_size(int64_t m, int64_t n_v, int64_t memory) noexcept nogil
cdef void start_accelerated_sweeps(sweep_run_t* x, acceleration_t* c, int32_t memory, int32_t convex, int32_t keeps,
                                   double* workspace) noexcept nogil


cdef class AcceleratedSweeps(Sweeps):
    cdef acceleration_t acceleration
