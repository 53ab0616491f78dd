"""Input validation: the range of the numbers in the arrays of a problem, checked once, so that kernels need no checks.

    |x| <= 1e60             every finite number, and the derived b and d = diag(A)                                     (1)
    x = 0 or x >= 1e-60     masses, inertias, pivots of M, friction coefficients, compliances, the largest |b|         (2)

Other units bring any practical problem into this range without changing its solution. Sums of products of four such
numbers, and their squares, do not overflow float64. A row of A counts as empty if its largest entry is below 1e-60.
"""
from libc.math cimport fabs
from libc.stdint cimport int64_t, uint64_t
from libc.string cimport memcpy


cdef inline double max_magnitude() noexcept nogil:
    """Return the largest valid magnitude (1)."""
    return 1e60


cdef inline double min_magnitude() noexcept nogil:
    """Return the smallest valid nonzero magnitude (2)."""
    return 1e-60


cdef inline bint is_valid_number(double x) noexcept nogil:
    """Return whether x satisfies (1); False for NaN."""
    return fabs(x) <= max_magnitude()


cdef inline bint is_valid_magnitude(double x) noexcept nogil:
    """Return whether x satisfies (1) and (2)."""
    return x == 0.0 or min_magnitude() <= x <= max_magnitude()


cdef inline int64_t find_invalid_number(const double* x, int64_t n) noexcept nogil:
    """Return the index of the first number that violates (1), or -1."""
    cdef int64_t i
    for i in range(n):
        if not is_valid_number(x[i]):
            return i
    return -1


cdef inline int64_t find_invalid_magnitude(const double* x, int64_t n) noexcept nogil:
    """Return the index of the first number that violates (1) or (2), or -1."""
    cdef int64_t i
    for i in range(n):
        if not is_valid_magnitude(x[i]):
            return i
    return -1


cdef inline bint any_magnitude_above(const double* x, int64_t n, double bound) noexcept nogil:
    """Return whether any |x_i| is above `bound` or NaN.

    The bits of |x_i| as an integer grow with |x_i|, and NaN is above infinity. The loop has no branch and never ends early, so
    that compilers vectorise it: almost all arrays are valid.
    """
    cdef int64_t i
    cdef uint64_t limit, bits, exceeds = 0
    memcpy(&limit, &bound, sizeof(double))
    for i in range(n):
        memcpy(&bits, x + i, sizeof(double))
        exceeds |= limit - (bits & <uint64_t>0x7FFFFFFFFFFFFFFF)
    return exceeds >> 63


cdef inline bint has_invalid_number(const double* x, int64_t n) noexcept nogil:
    """Return whether any number violates (1)."""
    return any_magnitude_above(x, n, max_magnitude())


cdef inline double update_max_abs(double maximum, double x) noexcept nogil:
    """Return the larger of `maximum` and |x|; NaN if either is NaN."""
    x = fabs(x)
    return maximum if x <= maximum or maximum != maximum else x


cdef inline double norm_inf(const double* x, int64_t n) noexcept nogil:
    """Return max |x_i|: 0 if n = 0, NaN if any x_i is NaN."""
    cdef int64_t i
    cdef double s = 0.0
    for i in range(n):
        if not fabs(x[i]) <= s:
            s = fabs(x[i])
            if s != s:
                break
    return s


cdef inline bint all_finite(const double* x, int64_t n) noexcept nogil:
    """Return whether x holds neither NaN nor infinity."""
    cdef double s = 0.0, t = 0.0, u = 0.0, v = 0.0      # Each sum stays 0, or becomes NaN after an infinite or NaN entry.
    cdef int64_t i = 0
    while i + 4 <= n:
        s += 0.0 * x[i]
        t += 0.0 * x[i + 1]
        u += 0.0 * x[i + 2]
        v += 0.0 * x[i + 3]
        i += 4
    while i < n:
        s += 0.0 * x[i]
        i += 1
    return (s + t) + (u + v) == 0.0


cdef inline bint is_zero_or_definite_inertia(const double* x, double skew, double shift, double pivot) noexcept nogil:
    """Return whether x (3, 3) is zero or positive definite.

    With s = max |x_ij|, x / s must be symmetric within `skew`, and the pivots of x / s + shift I must be above `pivot`.
    """
    cdef double s = norm_inf(x, 9), p, q, r, a, b, c
    if s == 0.0:
        return True
    if not (fabs(x[3] - x[1]) <= skew * s and fabs(x[6] - x[2]) <= skew * s and fabs(x[7] - x[5]) <= skew * s):
        return False
    q, r, p = x[3] / s, x[6] / s, x[0] / s + shift
    if not p > pivot:
        return False
    a, b, c = x[4] / s + shift - q * (q / p), x[7] / s - r * (q / p), x[8] / s + shift - r * (r / p)
    return a > pivot and c - b * (b / a) > pivot
