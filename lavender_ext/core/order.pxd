"""Declarations of `order.pyx`: the order of blocks in the next sweep, their levels from the ground, and greedy colours.

An order is a permutation of block numbers (int32). GIVEN keeps it, SYMMETRIC reverses it before every sweep except the
first, and RANDOM shuffles it before every sweep with SplitMix64 (Steele, Lea, Flood 2014), so that a seed gives the same
sweeps on every machine.
"""
from libc.stdint cimport int32_t, uint64_t


cpdef enum:
    GIVEN = 0
    SYMMETRIC = 1
    RANDOM = 2


cdef inline uint64_t next_random(uint64_t* state) noexcept nogil:
    """Return the next 64 random bits of SplitMix64."""
    cdef uint64_t z
    state[0] = state[0] + <uint64_t>0x9E3779B97F4A7C15ULL
    z = state[0]
    z = (z ^ (z >> 30)) * <uint64_t>0xBF58476D1CE4E5B9ULL
    z = (z ^ (z >> 27)) * <uint64_t>0x94D049BB133111EBULL
    return z ^ (z >> 31)


cdef void reverse_blocks(int32_t* order, int32_t first, int32_t end) noexcept nogil
cdef void update_sweep_order(int32_t mode, int32_t first_sweep, int32_t* order, int32_t first, int32_t end,
                             uint64_t* rng) noexcept nogil
cdef int32_t find_block_levels(int32_t n_blocks, const int32_t* body, int32_t n_bodies, int32_t* level,
                               int32_t* out) noexcept nogil
cdef void sort_blocks_by_level(int32_t n_blocks, const int32_t* level, int32_t n_levels, int32_t* start,
                               int32_t* order) noexcept nogil
cdef int32_t color_blocks_by_bodies(int32_t n_blocks, const int32_t* body, int32_t n_bodies, bint by_pair, uint64_t* used,
                                    int32_t* color) noexcept nogil
