"""Sets of the integers 0 to 63 as bits of a word."""
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
    int32_t lowest "lavender_lowest"(uint64_t x) noexcept nogil     # index of the lowest set bit of x; x must not be 0
