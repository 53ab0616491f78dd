"""A dense factorisation in the order that leaves a tree's branches apart: from the last row to the first.

    N = L^T D L, the lower triangle row by row; what is zero in a row, or before its first entry, costs nothing      (1)

Inner loops run along a row, so that lanes of any width give the same bits.
"""
from libc.stdint cimport int32_t

from lavender_ext.core.generalized cimport dot
from lavender_ext.factor.dense_lu cimport take


cdef inline void take4(double* x, const double* a, const double* b, const double* c, const double* d, double f,
                       double g, double h, double k, int32_t n) noexcept nogil:
    cdef int32_t i
    for i in range(n):
        x[i] = (((x[i] - f * a[i]) - g * b[i]) - h * c[i]) - k * d[i]


cdef inline int32_t ltdl_factor(int32_t n, double* a, double* inv, int32_t* begin) noexcept nogil:
    """(1) in place, inv = 1 / D (n); 0 where a pivot is not positive. Four rows are eliminated at a time.

    begin (n) is scratch: the first column of a row that is not zero, which elimination moves to that of the row taken.
    """
    cdef int32_t k = n - 1, i, j, b, s
    cdef double f, g, h, l
    cdef double* r0
    cdef double* r1
    cdef double* r2
    cdef double* r3
    cdef double* x
    for i in range(n):
        r0 = a + <ssize_t>i * n
        j = 0
        while j < i and r0[j] == 0.0:
            j += 1
        begin[i] = j
    while k >= 0:
        b = 4 if k >= 3 else k + 1
        for i in range(k, k - b, -1):                   # within the rows that go together
            r0 = a + <ssize_t>i * n
            if not r0[i] > 0.0:
                return 0
            inv[i] = 1.0 / r0[i]
            s = begin[i]
            for j in range(i - 1, k - b, -1):
                if r0[j] != 0.0:
                    take(a + <ssize_t>j * n + s, r0 + s, r0[j] * inv[i], j + 1 - s)
                    if s < begin[j]:
                        begin[j] = s
        if b == 4:
            r0 = a + <ssize_t>k * n
            r1 = r0 - n
            r2 = r1 - n
            r3 = r2 - n
            s = begin[k]
            for i in range(k - 3, k):
                if begin[i] < s:
                    s = begin[i]
            for i in range(s, k - 3):
                f = r0[i] * inv[k]
                g = r1[i] * inv[k - 1]
                h = r2[i] * inv[k - 2]
                l = r3[i] * inv[k - 3]
                x = a + <ssize_t>i * n
                if g == 0.0 and h == 0.0 and l == 0.0:
                    if f == 0.0:
                        continue
                    take(x + s, r0 + s, f, i + 1 - s)
                else:
                    take4(x + s, r0 + s, r1 + s, r2 + s, r3 + s, f, g, h, l, i + 1 - s)
                if s < begin[i]:
                    begin[i] = s
        for i in range(k, k - b, -1):
            r0 = a + <ssize_t>i * n
            for j in range(begin[i], i):
                r0[j] *= inv[i]
        k -= b
    return 1


cdef inline void ltdl_solve(int32_t n, const double* a, const double* inv, double* x) noexcept nogil:
    cdef int32_t k
    for k in range(n - 1, -1, -1):                      # L^T z = x
        if x[k] != 0.0:
            take(x, a + <ssize_t>k * n, x[k], k)
    for k in range(n):                                  # D, then L x = z
        x[k] = x[k] * inv[k] - dot(a + <ssize_t>k * n, x, k)
