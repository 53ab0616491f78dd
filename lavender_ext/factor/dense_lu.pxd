"""Dense LU, N = P L U, with the largest pivot of each column (1); inner loops run along a row."""
from libc.math cimport fabs
from libc.stdint cimport int32_t

from lavender_ext.core.dot cimport dot
from lavender_ext.factor.tiles cimport take


cdef inline int32_t lu_factor(int32_t n, double* a, int32_t* swap) noexcept nogil:
    """(1) in place, rows exchanged with `swap`; 0 where a pivot is zero or not finite."""
    cdef int32_t k, i, j, best
    cdef double big, t, inv
    cdef double* row
    cdef double* other
    for k in range(n):
        best = k
        big = fabs(a[<ssize_t>k * n + k])
        for i in range(k + 1, n):
            t = fabs(a[<ssize_t>i * n + k])
            if t > big:
                big = t
                best = i
        if not 0.0 < big < 1.0 / 0.0:
            return 0
        swap[k] = best
        row = a + <ssize_t>k * n
        if best != k:
            other = a + <ssize_t>best * n
            for j in range(n):
                t = row[j]
                row[j] = other[j]
                other[j] = t
        inv = 1.0 / row[k]
        for i in range(k + 1, n):
            other = a + <ssize_t>i * n
            if other[k] != 0.0:
                other[k] *= inv
                take(n - k - 1, other[k], row + k + 1, other + k + 1)
    return 1


cdef inline void lu_solve(int32_t n, const double* a, const int32_t* swap, double* x) noexcept nogil:
    cdef int32_t k
    cdef double t
    for k in range(n):
        t = x[swap[k]]
        x[swap[k]] = x[k]
        x[k] = t
    for k in range(n):
        x[k] -= dot(a + <ssize_t>k * n, x, k)
    for k in range(n - 1, -1, -1):
        x[k] = (x[k] - dot(a + <ssize_t>k * n + k + 1, x + k + 1, n - k - 1)) / a[<ssize_t>k * n + k]
