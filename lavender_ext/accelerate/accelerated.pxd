"""What an accelerated sweep runs over, and its step for a loop under a watch."""
from libc.stdint cimport int32_t, uint64_t

from lavender_ext.core.block cimport blocks_t
from lavender_ext.core.csr cimport csr_t
from lavender_ext.core.generalized cimport generalized_t
from lavender_ext.core.rows cimport rows_t
from lavender_ext.sweep.packed cimport packed_t


cdef struct sweep_data_t:
    const blocks_t* blocks
    const csr_t* csr            # NULL where factored
    const rows_t* rows
    const generalized_t* general        # NULL but for J and M
    const int32_t* start        # prepared blocks, read where `exact` or under the cone law
    const double* g
    int32_t exact               # sweeps over exact blocks, else pgs
    int32_t convex              # iterations under the cone law first
    int32_t turn                # iterations done
    blocks_t cone               # the blocks under the cone law
    int32_t* order
    int32_t split
    int32_t mode
    int32_t memory
    int32_t keeps               # nncg: beta > 1 drops p only where it points against the sweep
    uint64_t* rng
    double* v                   # (nv): of bodies (n_bodies, 6), of J and M; nv = 0 where A is swept
    int32_t nv
    double* control             # (CONTROL) of accelerate/mixing.pxd
    double* gram                # (MAX_MEMORY, MAX_MEMORY)
    double* work                # nncg 3 (m + nv); anderson (4 + 2 memory) m
    const packed_t* packed      # blocks of rows in pairs, level by level, where not exact; else NULL
    int32_t backwards           # the order is turned round since they were packed


cdef public void lav_anderson(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil
