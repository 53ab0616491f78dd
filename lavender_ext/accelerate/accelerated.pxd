"""Data of accelerated sweeps, and their step for a loop with a stopping test."""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.accelerate.mixing cimport CONTROL, MAX_MEMORY
from lavender_ext.core.block_types cimport CONE, blocks_t
from lavender_ext.sweep.serial cimport Sweeps, context_t, sweeping_t


cdef struct sweep_data_t:
    context_t* sweeps           # prepared blocks are read if sweeps are exact or under the cone law
    blocks_t cone               # the blocks under the cone law
    int32_t convex              # number of first iterations under the cone law
    int32_t turn                # number of iterations done
    int32_t memory
    int32_t keeps               # nncg: beta > 1 drops p only if p points against the sweep
    double* control             # (CONTROL) of accelerate/mixing.pxd
    double* gram                # (MAX_MEMORY, MAX_MEMORY)
    double* work                # nncg 3 (m + n_v); anderson (4 + 2 memory) m


cdef public void lav_nncg(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil
cdef public void lav_anderson(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil
cdef void forget_all(void* context, const double* lam) noexcept nogil
cdef double undone_of(const sweep_data_t* c) noexcept nogil


cdef inline int64_t accelerated_workspace_size(int64_t m, int64_t n_v, int64_t memory) noexcept nogil:
    """Return the number of doubles of a run."""
    return 3 * (m + n_v) + (1 + 2 * memory) * m + CONTROL + MAX_MEMORY * MAX_MEMORY


cdef inline void accelerate(sweeping_t* x, sweep_data_t* c, int32_t memory, int32_t convex, int32_t keeps,
                            double* workspace) noexcept nogil:
    """Turn a started run of sweeps x into an accelerated one, before its first iteration.

    memory = 0 is nncg. workspace (`accelerated_workspace_size`) must be zero-initialised.
    """
    cdef context_t* sweeps = &x.c
    x.step, x.of, x.forget = lav_nncg if memory == 0 else lav_anderson, c, forget_all
    c.sweeps, c.cone = sweeps, sweeps.blocks[0]
    c.cone.law = CONE
    c.memory, c.convex, c.keeps, c.turn = memory, convex, keeps, 0
    c.work = workspace
    c.gram = workspace + 3 * (sweeps.blocks.n_rows + sweeps.n_v) + (1 + 2 * <int64_t>memory) * sweeps.blocks.n_rows
    c.control = c.gram + MAX_MEMORY * MAX_MEMORY


cdef class AcceleratedSweeps(Sweeps):
    cdef sweep_data_t fast
