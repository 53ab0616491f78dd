"""Two doubles at once: every operation on both lanes, each rounded as it would be alone.

The vector types of gcc and clang; elsewhere (or with LAVENDER_ONE_LANE) a pair has one lane, and LANES is 1.
Arithmetic is written as on a double.
"""

cdef extern from *:
    """
    #ifndef LAVENDER_PAIR
    #define LAVENDER_PAIR
    #if defined(__GNUC__) && !defined(LAVENDER_ONE_LANE)
    #define LAVENDER_LANES 2
    typedef double lavender_pair __attribute__((vector_size(16)));
    typedef long long lavender_pair_bits __attribute__((vector_size(16)));
    static inline lavender_pair lavender_gather(const double* x, const double* y) {
        return (lavender_pair){*x, *y};
    }
    static inline void lavender_scatter(double* x, double* y, lavender_pair z) {
        *x = z[0];
        *y = z[1];
    }
    static inline lavender_pair lavender_not_below_zero(lavender_pair y) {
        return (lavender_pair)(~(lavender_pair_bits)(y < (lavender_pair){0.0, 0.0}) & (lavender_pair_bits)y);
    }
    static inline int lavender_all_within(lavender_pair s, lavender_pair bound) {
        lavender_pair low = {1e-280, 1e-280}, high = {1e280, 1e280};
        lavender_pair_bits m = (lavender_pair_bits)(s > low) & (lavender_pair_bits)(s < high)
                               & ~(lavender_pair_bits)(s > bound);
        return (m[0] & m[1]) != 0;
    }
    #else
    #define LAVENDER_LANES 1
    typedef double lavender_pair;
    static inline lavender_pair lavender_gather(const double* x, const double* y) { (void)y; return *x; }
    static inline void lavender_scatter(double* x, double* y, lavender_pair z) { (void)y; *x = z; }
    static inline lavender_pair lavender_not_below_zero(lavender_pair y) { return y < 0.0 ? 0.0 : y; }
    static inline int lavender_all_within(lavender_pair s, lavender_pair bound) {
        return s > 1e-280 && s < 1e280 && !(s > bound);
    }
    #endif
    #endif
    """
    int LANES "LAVENDER_LANES"
    ctypedef double pair_t "lavender_pair"
    # (x, y), and back; the first alone where there is one lane
    pair_t gather "lavender_gather"(const double* x, const double* y) noexcept nogil
    void scatter "lavender_scatter"(double* x, double* y, pair_t z) noexcept nogil
    # y, or 0 where y < 0
    pair_t not_below_zero "lavender_not_below_zero"(pair_t y) noexcept nogil
    # 1 where both lanes of s are in (1e-280, 1e280) and not above those of bound
    int all_within "lavender_all_within"(pair_t s, pair_t bound) noexcept nogil
