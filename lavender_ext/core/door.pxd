"""Numbers at the door: what the arrays of a problem may hold, checked once, so that no kernel guards against more.

    |x| <= 1e60             every finite number, and what follows from them: b, and d = diag(A)         (1)
    x = 0 or x >= 1e-60     masses, inertias, M's pivots, mu, reaches, compliances, the largest |b|     (2)

The same problem in other units has other numbers and the same answer, so no user needs more. Sums of products of four such
numbers, and their squares, stay within float64. A row of A whose largest entry is below 1e-60 counts as empty.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t, int64_t


cdef inline double most() noexcept nogil:
    return 1e60


cdef inline double least() noexcept nogil:
    return 1e-60


cdef inline bint is_number(double x) noexcept nogil:
    return fabs(x) <= most()                            # (1); NaN is none


cdef inline bint is_size(double x) noexcept nogil:
    return x == 0.0 or least() <= x <= most()           # (1), (2)


cdef inline int64_t first_outside(const double* x, int64_t n) noexcept nogil:
    """The first number that (1) excludes, or -1."""
    cdef int64_t i
    for i in range(n):
        if not is_number(x[i]):
            return i
    return -1


cdef inline int64_t first_unsized(const double* x, int64_t n) noexcept nogil:
    """The first number that (1) or (2) excludes, or -1."""
    cdef int64_t i
    for i in range(n):
        if not is_size(x[i]):
            return i
    return -1


cdef inline bint is_beyond(const double* x, int64_t n, double bound) noexcept nogil:
    """Whether any of these numbers is larger than the bound in size; without a branch, so that compilers take several at once."""
    cdef int64_t i
    cdef int found = 0
    for i in range(n):
        found |= fabs(x[i]) > bound
    return found


cdef inline bint has_outside(const double* x, int64_t n) noexcept nogil:
    """Whether (1) excludes any; to the end without a branch: nearly all are inside."""
    cdef int64_t i
    cdef double limit = most()
    cdef int32_t out = 0
    for i in range(n):
        out |= not fabs(x[i]) <= limit
    return out


cdef inline double widest(double so_far, double x) noexcept nogil:
    """The larger of |x| and what was largest so far; NaN stays."""
    x = fabs(x)
    return so_far if x <= so_far or so_far != so_far else x


cdef inline double largest(const double* x, int64_t n) noexcept nogil:
    """max |x_i|: 0 of none, NaN where one is."""
    cdef int64_t i
    cdef double s = 0.0
    for i in range(n):
        if not fabs(x[i]) <= s:
            s = fabs(x[i])
            if s != s:
                break
    return s


cdef inline bint all_finite(const double* x, int64_t n) noexcept nogil:
    """Whether x holds neither NaN nor infinity."""
    cdef double s = 0.0, t = 0.0, u = 0.0, v = 0.0      # stay 0, or become NaN
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


cdef inline bint are_pairs(const int32_t* pair, int64_t k, int32_t n, bint moves) noexcept nogil:
    """Whether (k, 2) names bodies from -1, static, to n - 1, none twice in a pair; `moves`: nor two static ones."""
    cdef int64_t i
    cdef int32_t a, b
    for i in range(k):
        a, b = pair[2 * i], pair[2 * i + 1]
        if not -1 <= a < n or not -1 <= b < n or a == b and (moves or a >= 0):
            return False
    return True


cdef inline bint is_frame(const double* n, const double* t, double off) noexcept nogil:
    """Whether two vectors are orthogonal and their squares 1, all to `off`."""
    cdef double nn = n[0] * n[0] + n[1] * n[1] + n[2] * n[2], tt = t[0] * t[0] + t[1] * t[1] + t[2] * t[2]
    return (fabs(nn - 1.0) <= off and fabs(tt - 1.0) <= off
            and fabs(n[0] * t[0] + n[1] * t[1] + n[2] * t[2]) <= off)


cdef inline bint is_definite(const double* x, double skew, double shift, double pivot) noexcept nogil:
    """Whether (3, 3) is 0, or divided by its largest entry s symmetric to `skew`, the pivots of x / s + shift above `pivot`."""
    cdef double s = largest(x, 9), p, q, r, a, b, c
    if s == 0.0:
        return True
    if not (fabs(x[3] - x[1]) <= skew * s and fabs(x[6] - x[2]) <= skew * s and fabs(x[7] - x[5]) <= skew * s):
        return False
    q, r, p = x[3] / s, x[6] / s, x[0] / s + shift
    if not p > pivot:
        return False
    a, b, c = x[4] / s + shift - q * (q / p), x[7] / s - r * (q / p), x[8] / s + shift - r * (r / p)
    return a > pivot and c - b * (b / a) > pivot
