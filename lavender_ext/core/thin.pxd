"""Extract the nonzeros of a row with their columns: eight at a time (AVX-512) if the processor supports it, else one by one."""
from libc.stdint cimport int32_t


cdef extern from *:
    """
    #if defined(__GNUC__) && defined(__x86_64__) && !defined(LAVENDER_ONE_LANE)
    #include <immintrin.h>
    __attribute__((target("avx512f,avx512vl,popcnt"))) static int lavender_thin_wide(int n, const double* x,
                                                                                     const int* col, int* idx,
                                                                                     double* val) {
        const __m256i step = _mm256_set1_epi32(8);
        __m256i at = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
        int q = 0;
        for (int j = 0; j < n; j += 8, at = _mm256_add_epi32(at, step)) {
            const __mmask8 in = n - j < 8 ? (__mmask8)((1 << (n - j)) - 1) : 255;
            const __m512d a = _mm512_maskz_loadu_pd(in, x + j);
            const __mmask8 on = _mm512_mask_cmp_pd_mask(in, a, _mm512_setzero_pd(), _CMP_NEQ_UQ);
            const __m256i c = col ? _mm256_maskz_loadu_epi32(in, col + j) : at;
            _mm512_storeu_pd(val + q, _mm512_maskz_compress_pd(on, a));
            _mm256_storeu_si256((__m256i*)(idx + q), _mm256_maskz_compress_epi32(on, c));
            q += __builtin_popcount(on);
        }
        return q;
    }
    #define LAVENDER_THIN_WIDE() (__builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512f"))
    #else
    #define LAVENDER_THIN_WIDE() 0
    #define lavender_thin_wide(n, x, col, idx, val) 0
    #endif
    static int lavender_thin(int n, const double* x, const int* col, int* idx, double* val) {
        int q = 0;
        if (LAVENDER_THIN_WIDE()) return lavender_thin_wide(n, x, col, idx, val);
        for (int j = 0; j < n; j++) {                   /* branch-free: the pattern is unpredictable */
            idx[q] = col ? col[j] : j;
            val[q] = x[j];
            q += x[j] != 0.0;
        }
        return q;
    }
    """
    # Copies the nonzeros of x (n) and their columns (col NULL: 0, 1 ...) to val and idx, both of size n + 8; returns their number.
    int32_t thin "lavender_thin"(int32_t n, const double* x, const int32_t* col, int32_t* idx, double* val) noexcept nogil
