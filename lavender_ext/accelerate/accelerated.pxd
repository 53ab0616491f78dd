"""What an accelerated sweep runs over, and its step for a loop under a watch."""
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport blocks_t
from lavender_ext.sweep.serial cimport context_t


cdef struct sweep_data_t:
    context_t* sweeps           # prepared blocks are read where these are exact, or under the cone law
    blocks_t cone               # the blocks under the cone law
    int32_t convex              # iterations under the cone law first
    int32_t turn                # iterations done
    int32_t memory
    int32_t keeps               # nncg: beta > 1 drops p only where it points against the sweep
    double* control             # (CONTROL) of accelerate/mixing.pxd
    double* gram                # (MAX_MEMORY, MAX_MEMORY)
    double* work                # nncg 3 (m + n_v); anderson (4 + 2 memory) m


cdef public void lav_anderson(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil
