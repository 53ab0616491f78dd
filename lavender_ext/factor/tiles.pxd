"""C <- C - A B^T on dense columns, tile by tile: the loop in which a supernodal factor spends its time.

Lanes run over rows of C, the sum over columns of A and B in their order, each product rounded before it is subtracted:
every width gives the same bits. `combine` adds rows of a matrix in the same way. `wide` asks for four lanes in one
instruction (AVX2), which the caller has found. With LAVENDER_ONE_LANE, and for other compilers than gcc and clang, plain loops.
"""
from libc.stdint cimport int32_t


cdef extern from *:
    """
    #ifndef LAVENDER_TILES
    #define LAVENDER_TILES
    #if defined(__GNUC__) && !defined(LAVENDER_ONE_LANE)
    #define LAVENDER_OWN __restrict__
    #define LAVENDER_INLINE static inline __attribute__((always_inline))
    typedef double lavender_quad __attribute__((vector_size(32), aligned(8), may_alias));
    typedef double lavender_two __attribute__((vector_size(16), aligned(8), may_alias));
    #define LAVENDER_TILE(NAME, T)                                                                                \
    LAVENDER_INLINE void NAME(const int count, const int columns, int k, const double* a, long long lda,          \
                              const double* b, long long ldb, double* c, long long ldc) {                        \
        enum { LANES = sizeof(T) / sizeof(double) };                                                              \
        T sum[9];                                                                                                 \
        for (int j = 0; j < columns; j++)                                                                         \
            for (int i = 0; i < count; i++) sum[3 * j + i] = *(T*)(c + j * ldc + LANES * i);                      \
        for (int t = 0; t < k; t++, a += lda, b += ldb)                                                           \
            for (int j = 0; j < columns; j++) {                                                                   \
                const double x = b[j];                                                                            \
                for (int i = 0; i < count; i++) sum[3 * j + i] -= *(const T*)(a + LANES * i) * x;                 \
            }                                                                                                     \
        for (int j = 0; j < columns; j++)                                                                         \
            for (int i = 0; i < count; i++) *(T*)(c + j * ldc + LANES * i) = sum[3 * j + i];                      \
    }
    LAVENDER_TILE(lavender_tile_4, lavender_quad)
    LAVENDER_TILE(lavender_tile_2, lavender_two)
    /* 4 n values of the sum, in registers */
    #define LAVENDER_SUM(NAME, T)                                                                                 \
    LAVENDER_INLINE void NAME(const int n, int count, const double* rows, const int* at, const double* x,         \
                              double* out) {                                                                      \
        enum { LANES = sizeof(T) / sizeof(double), PARTS = 4 / LANES };                                           \
        const T zero = {0.0};                                                                                     \
        T sum[PARTS * 6];                                                                                         \
        for (int i = 0; i < n * PARTS; i++) sum[i] = zero;                                                        \
        for (int t = 0; t < count; t++) {                                                                         \
            const double* a = rows + at[t];                                                                       \
            const double f = x[t];                                                                                \
            for (int i = 0; i < n * PARTS; i++) sum[i] += *(const T*)(a + LANES * i) * f;                         \
        }                                                                                                         \
        for (int i = 0; i < n * PARTS; i++) *(T*)(out + LANES * i) = sum[i];                                      \
    }
    LAVENDER_SUM(lavender_sum_4, lavender_quad)
    LAVENDER_SUM(lavender_sum_2, lavender_two)
    #else
    #define LAVENDER_OWN
    #define LAVENDER_INLINE static
    #define LAVENDER_TILE(NAME, LANES)                                                                            \
    LAVENDER_INLINE void NAME(const int count, const int columns, int k, const double* a, long long lda,          \
                              const double* b, long long ldb, double* c, long long ldc) {                        \
        for (int t = 0; t < k; t++)                                                                               \
            for (int j = 0; j < columns; j++)                                                                     \
                for (int i = 0; i < LANES * count; i++) c[j * ldc + i] -= a[t * lda + i] * b[t * ldb + j];        \
    }
    LAVENDER_TILE(lavender_tile_4, 4)
    LAVENDER_TILE(lavender_tile_2, 2)
    #define lavender_sum_4 lavender_sum_2
    LAVENDER_INLINE void lavender_sum_2(const int n, int count, const double* rows, const int* at, const double* x,
                                        double* out) {
        for (int i = 0; i < 4 * n; i++) out[i] = 0.0;
        for (int t = 0; t < count; t++)
            for (int i = 0; i < 4 * n; i++) out[i] += rows[at[t] + i] * x[t];
    }
    #endif
    LAVENDER_INLINE void lavender_rest(const int columns, int m, int k, const double* a, long long lda,
                                       const double* b, long long ldb, double* c, long long ldc) {
        for (int i = 0; i < m; i++)
            for (int j = 0; j < columns; j++) {
                double sum = c[j * ldc + i];
                for (int t = 0; t < k; t++) sum -= a[t * lda + i] * b[t * ldb + j];
                c[j * ldc + i] = sum;
            }
    }
    /* Three columns at a time, of which nine registers hold 3 LANES rows; then one. */
    #define LAVENDER_STRIP(TILE, LANES, COLUMNS)                                                                   \
        i = 0;                                                                                                    \
        for (; i + 3 * LANES <= m; i += 3 * LANES) TILE(3, COLUMNS, k, a + i, lda, b + j, ldb, c + j * ldc + i, ldc);\
        for (; i + LANES <= m; i += LANES) TILE(1, COLUMNS, k, a + i, lda, b + j, ldb, c + j * ldc + i, ldc);      \
        lavender_rest(COLUMNS, m - i, k, a + i, lda, b + j, ldb, c + j * ldc + i, ldc);
    #define LAVENDER_LESS(TILE, LANES)                                                                            \
        int i, j = 0;                                                                                             \
        for (; j + 3 <= n; j += 3) { LAVENDER_STRIP(TILE, LANES, 3) }                                             \
        for (; j < n; j++) { LAVENDER_STRIP(TILE, LANES, 1) }
    #define LAVENDER_COMBINE(SUM)                                                                                  \
        for (; n >= 24; n -= 24, rows += 24, out += 24) SUM(6, count, rows, at, x, out);                          \
        for (; n >= 12; n -= 12, rows += 12, out += 12) SUM(3, count, rows, at, x, out);                          \
        for (; n >= 4; n -= 4, rows += 4, out += 4) SUM(1, count, rows, at, x, out);
    static void lavender_combine_narrow(int n, int count, const double* rows, const int* at, const double* x,
                                        double* out) {
        LAVENDER_COMBINE(lavender_sum_2)
    }
    static void lavender_less_narrow(int m, int n, int k, const double* a, long long lda, const double* b,
                                     long long ldb, double* c, long long ldc) {
        LAVENDER_LESS(lavender_tile_2, 2)
    }
    #if defined(__GNUC__) && defined(__x86_64__) && !defined(LAVENDER_ONE_LANE)
    __attribute__((target("avx2"))) static void lavender_less_wide(int m, int n, int k, const double* a, long long lda,
                                                                   const double* b, long long ldb, double* c,
                                                                   long long ldc) {
        LAVENDER_LESS(lavender_tile_4, 4)
    }
    __attribute__((target("avx2"))) static void lavender_combine_wide(int n, int count, const double* rows,
                                                                      const int* at, const double* x, double* out) {
        LAVENDER_COMBINE(lavender_sum_4)
    }
    #define LAVENDER_HAS_WIDE() (__builtin_cpu_supports("avx2") ? 1 : 0)
    #else
    #define lavender_less_wide lavender_less_narrow
    #define lavender_combine_wide lavender_combine_narrow
    #define LAVENDER_HAS_WIDE() 0
    #endif
    static inline void lavender_less(int wide, int m, int n, int k, const double* a, long long lda, const double* b,
                                     long long ldb, double* c, long long ldc) {
        if (wide) lavender_less_wide(m, n, k, a, lda, b, ldb, c, ldc);
        else lavender_less_narrow(m, n, k, a, lda, b, ldb, c, ldc);
    }
    static inline void lavender_combine(int wide, int n, int count, const double* rows, const int* at, const double* x,
                                        double* out) {
        if (wide) lavender_combine_wide(n, count, rows, at, x, out);
        else lavender_combine_narrow(n, count, rows, at, x, out);
    }
    /* y <- y - x a (n) */
    static inline void lavender_take(int n, double x, const double* a, double* y) {
        for (int i = 0; i < n; i++) y[i] -= x * a[i];
    }
    /* Rows 3 to n + 2 of three columns, l^-1 of whose first three rows they still want; 1 / l on the diagonal. */
    static inline void lavender_finish(int n, double* LAVENDER_OWN x, double* LAVENDER_OWN y, double* LAVENDER_OWN z) {
        const double a = x[0], b = x[1], c = x[2], d = y[1], e = y[2], f = z[2];
        for (int i = 3; i < n + 3; i++) {
            const double p = x[i] * a, q = (y[i] - b * p) * d;
            x[i] = p;
            y[i] = q;
            z[i] = ((z[i] - c * p) - e * q) * f;
        }
    }
    /* y <- y + a (n) */
    static inline void lavender_add(int n, const double* a, double* y) {
        for (int i = 0; i < n; i++) y[i] += a[i];
    }
    #endif
    """
    # C (m, n) <- C - A B^T with A (m, k), B (n, k); columns are lda, ldb, ldc apart
    void less "lavender_less"(int wide, int m, int n, int k, const double* a, long long lda, const double* b,
                              long long ldb, double* c, long long ldc) noexcept nogil
    # out (n) = sum of x_i times the row that begins at at_i; n a multiple of 4
    void combine "lavender_combine"(int wide, int n, int count, const double* rows, const int32_t* at, const double* x,
                                    double* out) noexcept nogil
    void take "lavender_take"(int n, double x, const double* a, double* y) noexcept nogil
    int has_wide "LAVENDER_HAS_WIDE"() noexcept nogil
    void add "lavender_add"(int n, const double* a, double* y) noexcept nogil
    void finish "lavender_finish"(int n, double* x, double* y, double* z) noexcept nogil
