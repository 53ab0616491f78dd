"""Products of dense columns: C <- C - A B^T in tiles, in which dense and supernodal factorisations spend their time.

Lanes are rows of C. The sum runs over the columns of A and B in their order, and each product is rounded before it is
subtracted, so that all lane widths give the same bits. `wide` selects four or eight lanes in one instruction (AVX2, AVX-512),
which `has_wide` of `factors.pxd` reports. Large products copy blocks of A and B to contiguous memory, which they read several
times from the caches (Goto, van de Geijn 2008). With LAVENDER_ONE_LANE, and for other compilers than gcc and clang, the loops
have no lanes.
"""
from libc.stdint cimport int32_t


cdef extern from *:
    r"""
    #ifndef LAVENDER_TILES
    #define LAVENDER_TILES
    /* Below 16384 entries, A stays in the caches, and copies cost more than they save. */
    #define LAVENDER_IS_LARGE(m, n, k) ((n) >= 12 && (k) >= 24 && (double)(m) * (k) >= 16384.0)
    #if defined(__GNUC__) && !defined(LAVENDER_ONE_LANE)
    #define LAVENDER_RESTRICT __restrict__
    #define LAVENDER_INLINE static inline __attribute__((always_inline))
    typedef double lavender_oct __attribute__((vector_size(64), aligned(8), may_alias));
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
    /* Compute 4 n values of the sum of `combine_rows` in registers. */
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
    #define LAVENDER_RESTRICT
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
    LAVENDER_INLINE void lavender_gemm_rest(const int columns, int m, int k, const double* a, long long lda,
                                       const double* b, long long ldb, double* c, long long ldc) {
        for (int i = 0; i < m; i++)
            for (int j = 0; j < columns; j++) {
                double sum = c[j * ldc + i];
                for (int t = 0; t < k; t++) sum -= a[t * lda + i] * b[t * ldb + j];
                c[j * ldc + i] = sum;
            }
    }
    /* Nine registers hold 3 LANES rows of three columns; the remaining columns are computed one by one. */
    #define LAVENDER_STRIP(TILE, LANES, COLUMNS)                                                                   \
        i = 0;                                                                                                    \
        for (; i + 3 * LANES <= m; i += 3 * LANES) TILE(3, COLUMNS, k, a + i, lda, b + j, ldb, c + j * ldc + i, ldc);\
        for (; i + LANES <= m; i += LANES) TILE(1, COLUMNS, k, a + i, lda, b + j, ldb, c + j * ldc + i, ldc);      \
        lavender_gemm_rest(COLUMNS, m - i, k, a + i, lda, b + j, ldb, c + j * ldc + i, ldc);
    #define LAVENDER_GEMM(TILE, LANES)                                                                            \
        int i, j = 0;                                                                                             \
        for (; j + 3 <= n; j += 3) { LAVENDER_STRIP(TILE, LANES, 3) }                                             \
        for (; j < n; j++) { LAVENDER_STRIP(TILE, LANES, 1) }
    #define LAVENDER_COMBINE_ROWS(SUM)                                                                                  \
        for (; n >= 24; n -= 24, rows += 24, out += 24) SUM(6, count, rows, at, x, out);                          \
        for (; n >= 12; n -= 12, rows += 12, out += 12) SUM(3, count, rows, at, x, out);                          \
        for (; n >= 4; n -= 4, rows += 4, out += 4) SUM(1, count, rows, at, x, out);
    static void lavender_combine_rows_narrow(int n, int count, const double* rows, const int* at, const double* x,
                                        double* out) {
        LAVENDER_COMBINE_ROWS(lavender_sum_2)
    }
    static void lavender_gemm_narrow(int m, int n, int k, const double* a, long long lda, const double* b,
                                     long long ldb, double* c, long long ldc) {
        LAVENDER_GEMM(lavender_tile_2, 2)
    }
    #if defined(__GNUC__) && defined(__x86_64__) && !defined(LAVENDER_ONE_LANE)
    /* A product in blocks: DEPTH columns of A and B, WIDTH rows of B, and 2 LANES rows of A, all contiguous. A tile of
     * 2 LANES rows and COLUMNS columns of C is in registers; tiles at the edge of C are copied. */
    #define LAVENDER_BLOCKED_GEMM(NAME, T, COLUMNS, TARGET)                                                       \
    TARGET static inline __attribute__((always_inline)) void NAME##_tile(int k, const double* a, const double* b, double* c, \
                                                                         long long ldc) {                         \
        enum { LANES = sizeof(T) / sizeof(double), WIDTH = 48 };                                                  \
        T sum[2 * COLUMNS];                                                                                       \
        for (int j = 0; j < COLUMNS; j++)                                                                         \
            for (int i = 0; i < 2; i++) sum[2 * j + i] = *(T*)(c + j * ldc + LANES * i);                          \
        for (int t = 0; t < k; t++, a += 2 * LANES, b += WIDTH) {                                                 \
            const T first = *(const T*)a, second = *(const T*)(a + LANES);                                        \
            for (int j = 0; j < COLUMNS; j++) {                                                                   \
                sum[2 * j] -= first * b[j];                                                                       \
                sum[2 * j + 1] -= second * b[j];                                                                  \
            }                                                                                                     \
        }                                                                                                         \
        for (int j = 0; j < COLUMNS; j++)                                                                         \
            for (int i = 0; i < 2; i++) *(T*)(c + j * ldc + LANES * i) = sum[2 * j + i];                          \
    }                                                                                                             \
    TARGET static void NAME(int m, int n, int k, const double* a, long long lda, const double* b, long long ldb,  \
                            double* c, long long ldc) {                                                           \
        enum { ROWS = 2 * sizeof(T) / sizeof(double), WIDTH = 48, DEPTH = 128 };                                  \
        double rows[ROWS * DEPTH], columns[WIDTH * DEPTH], edge[ROWS * COLUMNS];                                  \
        for (int j0 = 0; j0 < n; j0 += WIDTH)                                                                     \
            for (int t0 = 0; t0 < k; t0 += DEPTH) {                                                               \
                const int width = n - j0 < WIDTH ? n - j0 : WIDTH, depth = k - t0 < DEPTH ? k - t0 : DEPTH;       \
                for (int t = 0; t < depth; t++) {                                                                 \
                    for (int j = 0; j < width; j++) columns[WIDTH * t + j] = b[(t0 + t) * ldb + j0 + j];          \
                    for (int j = width; j < WIDTH && j % COLUMNS; j++) columns[WIDTH * t + j] = 0.0;              \
                }                                                                                                 \
                for (int i0 = 0; i0 < m; i0 += ROWS) {                                                            \
                    const int height = m - i0 < ROWS ? m - i0 : ROWS;                                             \
                    for (int t = 0; t < depth; t++) {                                                             \
                        const double* source = a + (t0 + t) * lda + i0;                                           \
                        if (height == ROWS)                                                                       \
                            for (int i = 0; i < ROWS; i++) rows[ROWS * t + i] = source[i];                        \
                        else                                                                                      \
                            for (int i = 0; i < ROWS; i++) rows[ROWS * t + i] = i < height ? source[i] : 0.0;     \
                    }                                                                                             \
                    for (int j = 0; j < width; j += COLUMNS) {                                                    \
                        double* out = c + (j0 + j) * ldc + i0;                                                    \
                        const int count = width - j < COLUMNS ? width - j : COLUMNS;                              \
                        if (height == ROWS && count == COLUMNS) {                                                 \
                            NAME##_tile(depth, rows, columns + j, out, ldc);                                      \
                            continue;                                                                             \
                        }                                                                                         \
                        for (int q = 0; q < COLUMNS; q++)                                                         \
                            for (int i = 0; i < ROWS; i++)                                                        \
                                edge[ROWS * q + i] = q < count && i < height ? out[q * ldc + i] : 0.0;            \
                        NAME##_tile(depth, rows, columns + j, edge, ROWS);                                        \
                        for (int q = 0; q < count; q++)                                                           \
                            for (int i = 0; i < height; i++) out[q * ldc + i] = edge[ROWS * q + i];               \
                    }                                                                                             \
                }                                                                                                 \
            }                                                                                                     \
    }
    LAVENDER_BLOCKED_GEMM(lavender_blocked_gemm_8, lavender_oct, 8, __attribute__((target("avx512f"))))
    LAVENDER_BLOCKED_GEMM(lavender_blocked_gemm_4, lavender_quad, 6, __attribute__((target("avx2"))))
    __attribute__((target("avx2"))) static void lavender_gemm_wide(int m, int n, int k, const double* a, long long lda,
                                                                   const double* b, long long ldb, double* c,
                                                                   long long ldc) {
        LAVENDER_GEMM(lavender_tile_4, 4)
    }
    __attribute__((target("avx2"))) static void lavender_combine_rows_wide(int n, int count, const double* rows,
                                                                      const int* at, const double* x, double* out) {
        LAVENDER_COMBINE_ROWS(lavender_sum_4)
    }
    #else
    #define lavender_gemm_wide lavender_gemm_narrow
    #define lavender_combine_rows_wide lavender_combine_rows_narrow
    #endif
    static inline void lavender_gemm(int wide, int m, int n, int k, const double* a, long long lda, const double* b,
                                     long long ldb, double* c, long long ldc) {
        if (k == 0) return;
    #if defined(__GNUC__) && defined(__x86_64__) && !defined(LAVENDER_ONE_LANE)
        if (wide && LAVENDER_IS_LARGE(m, n, k)) {
            if (wide == 2) lavender_blocked_gemm_8(m, n, k, a, lda, b, ldb, c, ldc);
            else lavender_blocked_gemm_4(m, n, k, a, lda, b, ldb, c, ldc);
            return;
        }
    #endif
        if (wide) lavender_gemm_wide(m, n, k, a, lda, b, ldb, c, ldc);
        else lavender_gemm_narrow(m, n, k, a, lda, b, ldb, c, ldc);
    }
    static inline void lavender_combine_rows(int wide, int n, int count, const double* rows, const int* at, const double* x,
                                        double* out) {
        if (wide) lavender_combine_rows_wide(n, count, rows, at, x, out);
        else lavender_combine_rows_narrow(n, count, rows, at, x, out);
    }
    static inline void lavender_axpy_subtract(int n, double alpha, const double* x, double* y) {
        for (int i = 0; i < n; i++) y[i] -= alpha * x[i];
    }
    static inline void lavender_solve_three_columns(int n, double* LAVENDER_RESTRICT x, double* LAVENDER_RESTRICT y,
                                                    double* LAVENDER_RESTRICT z) {
        const double a = x[0], b = x[1], c = x[2], d = y[1], e = y[2], f = z[2];
        for (int i = 3; i < n + 3; i++) {
            const double p = x[i] * a, q = (y[i] - b * p) * d;
            x[i] = p;
            y[i] = q;
            z[i] = ((z[i] - c * p) - e * q) * f;
        }
    }
    static inline void lavender_add_vector(int n, const double* x, double* y) {
        for (int i = 0; i < n; i++) y[i] += x[i];
    }
    #endif
    """
    # Subtract A B^T from C (m, n), with A (m, k) and B (n, k); lda, ldb and ldc are the distances of their columns.
    void gemm_subtract_nt "lavender_gemm"(int wide, int m, int n, int k, const double* a, long long lda, const double* b,
                                          long long ldb, double* c, long long ldc) noexcept nogil
    # Return whether `gemm_subtract_nt` copies blocks of its matrices.
    bint is_large_product "LAVENDER_IS_LARGE"(int m, int n, int k) noexcept nogil
    # Write to out (n) the sum over i of x_i times the row that begins at rows + at_i; n is a multiple of 4.
    void combine_rows "lavender_combine_rows"(int wide, int n, int count, const double* rows, const int32_t* at, const double* x,
                                              double* out) noexcept nogil
    # Subtract alpha x from y (n).
    void axpy_subtract "lavender_axpy_subtract"(int n, double alpha, const double* x, double* y) noexcept nogil
    # Add x to y (n).
    void add_vector "lavender_add_vector"(int n, const double* x, double* y) noexcept nogil
    # Solve X L^T = A for rows 3 ... n + 2 of the three columns x, y, z, whose rows 0 ... 2 contain L with 1 / L_jj.
    void solve_three_columns "lavender_solve_three_columns"(int n, double* x, double* y, double* z) noexcept nogil
