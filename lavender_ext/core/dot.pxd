"""The product of two vectors."""
from libc.stdint cimport int32_t


cdef inline double dot(const double* x, const double* y, int32_t n) noexcept nogil:
    """Return x^T y of n numbers, in four running sums: a fixed order of additions."""
    cdef double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0
    cdef int32_t i = 0
    while i + 4 <= n:
        s0 += x[i] * y[i]
        s1 += x[i + 1] * y[i + 1]
        s2 += x[i + 2] * y[i + 2]
        s3 += x[i + 3] * y[i + 3]
        i += 4
    while i < n:
        s0 += x[i] * y[i]
        i += 1
    return (s0 + s1) + (s2 + s3)
