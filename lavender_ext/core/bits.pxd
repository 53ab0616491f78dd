"""Sets of at most 64 numbers as bits."""
from libc.stdint cimport int32_t, uint64_t


cdef extern from *:
    """
    #ifndef LAVENDER_BITS
    #define LAVENDER_BITS
    #if defined(__GNUC__)
    #define lavender_lowest(x) __builtin_ctzll(x)
    #else
    static int lavender_lowest(unsigned long long x) {
        int n = 0;
        while (!(x >> n & 1)) n++;
        return n;
    }
    #endif
    #endif
    """
    int32_t lowest "lavender_lowest"(uint64_t x) noexcept nogil     # x is not empty
