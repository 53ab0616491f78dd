"""Pairs of doubles: arithmetic on two numbers at once, with the same rounding as on single numbers.

A pair is a vector of gcc and clang, and arithmetic is written as on a double. Other compilers, and builds with
LAVENDER_ONE_LANE, have pairs of one number; LANES is the number of numbers in a pair.
"""
from libc.stdint cimport int64_t


cdef extern from *:
    """
    #ifndef LAVENDER_PAIR
    #define LAVENDER_PAIR
    #define lavender_byte_offset(x, offset) ((double*)((char*)(x) + (offset)))
    #if defined(__GNUC__) && !defined(LAVENDER_ONE_LANE)
    #define LAVENDER_LANES 2
    #define lavender_broadcast(x) lavender_make((x), (x))
    #define LAVENDER_INLINE static inline __attribute__((always_inline))
    typedef double lavender_pair __attribute__((vector_size(16)));
    typedef long long lavender_pair_bits __attribute__((vector_size(16)));
    LAVENDER_INLINE lavender_pair lavender_make(double x, double y) {
        const lavender_pair z = {x, y};
        return z;
    }
    static inline lavender_pair lavender_load_pair(const double* x, const double* y) { return lavender_make(*x, *y); }
    typedef double lavender_unaligned __attribute__((vector_size(16), aligned(8)));
    LAVENDER_INLINE void lavender_load_six(const double* x, const double* y, lavender_pair* z) {
        for (int k = 0; k < 6; k += 2) {
            const lavender_unaligned a = *(const lavender_unaligned*)(x + k), b = *(const lavender_unaligned*)(y + k);
            z[k] = lavender_make(a[0], b[0]);
            z[k + 1] = lavender_make(a[1], b[1]);
        }
    }
    static inline void lavender_store_pair(double* x, double* y, lavender_pair z) {
        *x = z[0];
        *y = z[1];
    }
    LAVENDER_INLINE void lavender_store_six(double* x, double* y, const lavender_pair* z) {
        for (int k = 0; k < 6; k += 2) {
            *(lavender_unaligned*)(x + k) = lavender_make(z[k][0], z[k + 1][0]);
            *(lavender_unaligned*)(y + k) = lavender_make(z[k][1], z[k + 1][1]);
        }
    }
    static inline lavender_pair lavender_clip_at_zero(lavender_pair y) {
        return (lavender_pair)(~(lavender_pair_bits)(y < lavender_broadcast(0.0)) & (lavender_pair_bits)y);
    }
    static inline lavender_pair lavender_select(lavender_pair_bits m, lavender_pair x, lavender_pair y) {
        return (lavender_pair)((m & (lavender_pair_bits)x) | (~m & (lavender_pair_bits)y));
    }
    static inline lavender_pair lavender_clip(lavender_pair x, lavender_pair low, lavender_pair high) {
    #ifdef __SSE2__
        /* minpd(a, b) is a < b ? a : b, and maxpd likewise: the result is b if one is NaN or both are zeros. */
        return __builtin_ia32_maxpd(low, __builtin_ia32_minpd(high, x));
    #endif
        return lavender_select((lavender_pair_bits)(x < low), low,
                               lavender_select((lavender_pair_bits)(x > high), high, x));
    }
    static inline int lavender_all_within(lavender_pair s, lavender_pair bound) {
        lavender_pair_bits m = (lavender_pair_bits)(s > bound);
        return (m[0] | m[1]) == 0;
    }
    static inline int lavender_any_outside(lavender_pair x, lavender_pair bound) {
        lavender_pair_bits m = (lavender_pair_bits)(x > bound) | (lavender_pair_bits)(x < -bound);
        return (m[0] | m[1]) != 0;
    }
    #else
    #define LAVENDER_LANES 1
    #define lavender_broadcast(x) (x)
    typedef double lavender_pair;
    static inline lavender_pair lavender_load_pair(const double* x, const double* y) { (void)y; return *x; }
    static inline void lavender_load_six(const double* x, const double* y, lavender_pair* z) {
        (void)y;
        for (int k = 0; k < 6; k++) z[k] = x[k];
    }
    static inline void lavender_store_pair(double* x, double* y, lavender_pair z) { (void)y; *x = z; }
    static inline void lavender_store_six(double* x, double* y, const lavender_pair* z) {
        (void)y;
        for (int k = 0; k < 6; k++) x[k] = z[k];
    }
    static inline lavender_pair lavender_clip_at_zero(lavender_pair y) { return y < 0.0 ? 0.0 : y; }
    static inline lavender_pair lavender_clip(lavender_pair x, lavender_pair low, lavender_pair high) {
        return x < low ? low : x > high ? high : x;
    }
    static inline int lavender_all_within(lavender_pair s, lavender_pair bound) { return !(s > bound); }
    static inline int lavender_any_outside(lavender_pair x, lavender_pair bound) { return x > bound || x < -bound; }
    #endif
    #endif
    """
    int LANES "LAVENDER_LANES"
    # The C type is a vector of two doubles. Cython is told `float`, so that a fused type can distinguish it from double.
    ctypedef float pair_t "lavender_pair"
    # Return (x, x).
    pair_t broadcast "lavender_broadcast"(double x) noexcept nogil
    # Return (*x, *y), or *x if a pair has one number.
    pair_t load_pair "lavender_load_pair"(const double* x, const double* y) noexcept nogil
    # Store the numbers of z at x and y.
    void store_pair "lavender_store_pair"(double* x, double* y, pair_t z) noexcept nogil
    # Return x advanced by a number of bytes.
    double* byte_offset "lavender_byte_offset"(double* x, int64_t bytes) noexcept nogil
    # Load the pairs (x[k], y[k]) into z (6).
    void load_six "lavender_load_six"(const double* x, const double* y, pair_t* z) noexcept nogil
    # Store the pairs z (6) to x (6) and y (6).
    void store_six "lavender_store_six"(double* x, double* y, const pair_t* z) noexcept nogil
    # Apply `clip` of core/block.pxd to each number.
    pair_t clip_pair "lavender_clip"(pair_t x, pair_t low, pair_t high) noexcept nogil
    # Replace negative numbers by 0.
    pair_t clip_at_zero "lavender_clip_at_zero"(pair_t y) noexcept nogil
    # Return whether |x| > bound in at least one number.
    int any_outside "lavender_any_outside"(pair_t x, pair_t bound) noexcept nogil
    # Return whether s <= bound, or one of them is NaN, in every number.
    int all_within "lavender_all_within"(pair_t s, pair_t bound) noexcept nogil
