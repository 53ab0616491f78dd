"""Two doubles at once: every operation on both lanes, each rounded as it would be alone.

The vector types of gcc and clang; elsewhere (or with LAVENDER_ONE_LANE) a pair has one lane, and LANES is 1.
Arithmetic is written as on a double.
"""

from libc.stdint cimport int64_t


cdef extern from *:
    """
    #ifndef LAVENDER_PAIR
    #define LAVENDER_PAIR
    #define lavender_at(x, offset) ((double*)((char*)(x) + (offset)))
    #if defined(__GNUC__) && !defined(LAVENDER_ONE_LANE)
    #define LAVENDER_LANES 2
    #define lavender_both(x) lavender_of((x), (x))
    #define LAVENDER_INLINE static inline __attribute__((always_inline))
    typedef double lavender_pair __attribute__((vector_size(16)));
    typedef long long lavender_pair_bits __attribute__((vector_size(16)));
    LAVENDER_INLINE lavender_pair lavender_of(double x, double y) {
        const lavender_pair z = {x, y};
        return z;
    }
    static inline lavender_pair lavender_gather(const double* x, const double* y) { return lavender_of(*x, *y); }
    typedef double lavender_near __attribute__((vector_size(16), aligned(8)));
    LAVENDER_INLINE void lavender_gather_six(const double* x, const double* y, lavender_pair* z) {
        for (int k = 0; k < 6; k += 2) {
            const lavender_near a = *(const lavender_near*)(x + k), b = *(const lavender_near*)(y + k);
            z[k] = lavender_of(a[0], b[0]);
            z[k + 1] = lavender_of(a[1], b[1]);
        }
    }
    static inline void lavender_scatter(double* x, double* y, lavender_pair z) {
        *x = z[0];
        *y = z[1];
    }
    LAVENDER_INLINE void lavender_scatter_six(double* x, double* y, const lavender_pair* z) {
        for (int k = 0; k < 6; k += 2) {
            *(lavender_near*)(x + k) = lavender_of(z[k][0], z[k + 1][0]);
            *(lavender_near*)(y + k) = lavender_of(z[k][1], z[k + 1][1]);
        }
    }
    static inline lavender_pair lavender_not_below_zero(lavender_pair y) {
        return (lavender_pair)(~(lavender_pair_bits)(y < lavender_both(0.0)) & (lavender_pair_bits)y);
    }
    static inline lavender_pair lavender_select(lavender_pair_bits m, lavender_pair x, lavender_pair y) {
        return (lavender_pair)((m & (lavender_pair_bits)x) | (~m & (lavender_pair_bits)y));
    }
    static inline lavender_pair lavender_clip(lavender_pair x, lavender_pair low, lavender_pair high) {
    #ifdef __SSE2__
        /* min(a, b) is a < b ? a : b, and max likewise: where one is NaN, or both are zeros, b */
        return __builtin_ia32_maxpd(low, __builtin_ia32_minpd(high, x));
    #endif
        return lavender_select((lavender_pair_bits)(x < low), low,
                               lavender_select((lavender_pair_bits)(x > high), high, x));
    }
    static inline int lavender_all_within(lavender_pair s, lavender_pair bound) {
        lavender_pair_bits m = (lavender_pair_bits)(s > bound);
        return (m[0] | m[1]) == 0;
    }
    static inline int lavender_any_beyond(lavender_pair x, lavender_pair bound) {
        lavender_pair_bits m = (lavender_pair_bits)(x > bound) | (lavender_pair_bits)(x < -bound);
        return (m[0] | m[1]) != 0;
    }
    #else
    #define LAVENDER_LANES 1
    #define lavender_both(x) (x)
    typedef double lavender_pair;
    static inline lavender_pair lavender_gather(const double* x, const double* y) { (void)y; return *x; }
    static inline void lavender_gather_six(const double* x, const double* y, lavender_pair* z) {
        (void)y;
        for (int k = 0; k < 6; k++) z[k] = x[k];
    }
    static inline void lavender_scatter(double* x, double* y, lavender_pair z) { (void)y; *x = z; }
    static inline void lavender_scatter_six(double* x, double* y, const lavender_pair* z) {
        (void)y;
        for (int k = 0; k < 6; k++) x[k] = z[k];
    }
    static inline lavender_pair lavender_not_below_zero(lavender_pair y) { return y < 0.0 ? 0.0 : y; }
    static inline lavender_pair lavender_clip(lavender_pair x, lavender_pair low, lavender_pair high) {
        return x < low ? low : x > high ? high : x;
    }
    static inline int lavender_all_within(lavender_pair s, lavender_pair bound) { return !(s > bound); }
    static inline int lavender_any_beyond(lavender_pair x, lavender_pair bound) { return x > bound || x < -bound; }
    #endif
    #endif
    """
    int LANES "LAVENDER_LANES"
    ctypedef double pair_t "lavender_pair"
    pair_t both "lavender_both"(double x) noexcept nogil
    # (x, y), and back; the first alone where there is one lane
    pair_t gather "lavender_gather"(const double* x, const double* y) noexcept nogil
    void scatter "lavender_scatter"(double* x, double* y, pair_t z) noexcept nogil
    double* at "lavender_at"(double* x, int64_t bytes) noexcept nogil
    # (x[k], y[k]) into z (6), and back
    void gather_six "lavender_gather_six"(const double* x, const double* y, pair_t* z) noexcept nogil
    void scatter_six "lavender_scatter_six"(double* x, double* y, const pair_t* z) noexcept nogil
    # `clip` of core/block.pxd in each lane
    pair_t clip_pair "lavender_clip"(pair_t x, pair_t low, pair_t high) noexcept nogil
    # y, or 0 where y < 0
    pair_t not_below_zero "lavender_not_below_zero"(pair_t y) noexcept nogil
    # whether |x| > bound in some lane
    int any_beyond "lavender_any_beyond"(pair_t x, pair_t bound) noexcept nogil
    # whether no lane of s is above that of bound
    int all_within "lavender_all_within"(pair_t s, pair_t bound) noexcept nogil
