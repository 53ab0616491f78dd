"""Banded factorisation L D L^T of a symmetric matrix; a dense matrix is a band of width n.

    c[i width + t] = A[i + t, i],  0 <= t < width                      lower half, column by column
    column i:  p_i = c[i, 0],  c[i + s, t - s] -= c[i, s] c[i, t] / p_i   for 1 <= s <= t              (1)

The factor contains 1 / p_i in c[i, 0], and the columns before their division in c[i, t], so that L[i + t, i] =
c[i, t] c[i, 0]. The method is right-looking: one division, one product and one difference separate two pivots.
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.deadline cimport deadline_t, has_passed, reading_interval
from lavender_ext.factor.factors cimport clear_pivot_statistics, pivots_t
from lavender_ext.factor.tiles cimport axpy_subtract


cdef enum:
    # A pivot below -size_i / NEGATIVE_PIVOT_RATIO is negative; rounding of a zero pivot stays above, because zeros are skipped.
    NEGATIVE_PIVOT_RATIO = 100000000


cdef inline double invert_pivot_or_count_it(double p, double size, int32_t i, double tiny, pivots_t* out) noexcept nogil:
    """Return 1 / p of pivot i, or 0 if p is small compared with `size`; count small and negative pivots in `out`."""
    if p < out.least * size:
        out.least = p / size
    if not p > tiny * size:
        if p * NEGATIVE_PIVOT_RATIO < -size:
            out.negative += 1
        else:
            out.small += 1
            if out.first_small < 0:
                out.first_small = i
            return 0.0
    return 1.0 / p


cdef inline void factor_tridiagonal_ldl(int32_t n, double* c, const double* size, double tiny, double* x,
                                        pivots_t* out) noexcept nogil:
    """Factor a tridiagonal matrix by (1) from both ends to the middle row h (twisted factorisation).

    The two chains of divisions are independent. c[2 i] becomes 1 / p_i, and the off-diagonals stay. If x is not NULL, the first
    half of `solve_tridiagonal_ldl` is applied to it while the divisions run.
    """
    cdef int32_t i = 0, j = n - 1, h = n // 2
    cdef double p = c[0], r = c[2 * (n - 1)], off
    while i < h or j > h:
        if i < h:
            p = invert_pivot_or_count_it(p, size[i], i, tiny, out)
            c[2 * i] = p
            off = c[2 * i + 1]
            if x != NULL:
                x[i + 1] -= off * p * x[i]
            p = (c[2 * i + 2] if i + 1 < h else 0.0) - off * off * p
            i += 1
        if j > h:
            r = invert_pivot_or_count_it(r, size[j], j, tiny, out)
            c[2 * j] = r
            off = c[2 * j - 1]
            if x != NULL:
                x[j - 1] -= off * r * x[j]
            r = (c[2 * j - 2] if j - 1 > h else 0.0) - off * off * r
            j -= 1
    # Both chains also subtract from the diagonal of row h. The code below does both subtractions.
    off = c[2 * h]
    if h > 0:
        off += p
    if h < n - 1:
        off += r
    c[2 * h] = invert_pivot_or_count_it(off, size[h], h, tiny, out)


cdef inline void back_substitute_tridiagonal_ldl(int32_t n, const double* c, double* x) noexcept nogil:
    """Apply the second half of `solve_tridiagonal_ldl` to x, from the middle to both ends."""
    cdef int32_t h = n // 2, i = h - 1, j = h + 1
    x[h] *= c[2 * h]
    while i >= 0 or j < n:
        if i >= 0:
            x[i] = x[i] * c[2 * i] - c[2 * i + 1] * c[2 * i] * x[i + 1]
            i -= 1
        if j < n:
            x[j] = x[j] * c[2 * j] - c[2 * j - 1] * c[2 * j] * x[j - 1]
            j += 1


cdef inline void solve_tridiagonal_ldl(int32_t n, const double* c, double* x) noexcept nogil:
    """Overwrite x (n) with the solution of the tridiagonal system of `factor_tridiagonal_ldl`."""
    cdef int32_t i = 0, j = n - 1, h = n // 2
    while i < h or j > h:
        if i < h:
            x[i + 1] -= c[2 * i + 1] * c[2 * i] * x[i]
            i += 1
        if j > h:
            x[j - 1] -= c[2 * j - 1] * c[2 * j] * x[j]
            j -= 1
    back_substitute_tridiagonal_ldl(n, c, x)


cdef inline void factor_band_ldl_columns(int32_t begin, int32_t end, int32_t width, int32_t height, double* c,
                                         const double* size, double tiny, double* x, pivots_t* out) noexcept nogil:
    """Apply (1) to columns begin ... end - 1, of `height` rows, or down to row end - 1 if that is 0.

    If x is not NULL, `forward_substitute_band_ldl` is applied to it as well.
    """
    cdef int32_t i, s, t, last
    cdef double inv
    cdef double* col
    for i in range(begin, end):
        col = c + <int64_t>i * width
        inv = invert_pivot_or_count_it(col[0], size[i], i, tiny, out)
        if inv == 0.0:
            for t in range(width):
                col[t] = 0.0
            continue
        col[0] = inv
        last = height if height > 0 else end - i
        for s in range(1, last):
            axpy_subtract(last - s, col[s] * inv, col + s, col + <int64_t>s * width)
        if x != NULL:
            axpy_subtract(last - 1, x[i] * inv, col + 1, x + i + 1)


cdef inline int32_t full_columns(int32_t n, int32_t width) noexcept nogil:
    """Return the number of columns that have all `width` rows, which come first; 0 if width is 0."""
    return n - width + 1 if n >= width > 0 else 0


cdef inline void factor_band_ldl_before_deadline(int32_t n, int32_t width, double* c, const double* size, double tiny,
                                                 double* x, pivots_t* out, deadline_t* deadline) noexcept nogil:
    """Factor the columns of full height by (1) in pieces, until the deadline; the pivots after it count as small."""
    cdef int32_t i = 0, end, full = full_columns(n, width)
    cdef double cost = 0.4 * width * width              # ns for a column: "band work" of the rates
    cdef int32_t columns = <int32_t>max(1.0, reading_interval() / cost)
    while i < full:
        end = i + columns if i + columns <= full else full
        factor_band_ldl_columns(i, end, width, width, c, size, tiny, x, out)
        if has_passed(deadline, cost * (end - i)):
            out.small += n - end
            return
        i = end
    factor_band_ldl_columns(full, n, width, 0, c, size, tiny, x, out)


cdef inline void factor_band_ldl(int32_t n, int32_t width, double* c, const double* size, double tiny, double* x,
                                 pivots_t* out, deadline_t* deadline) noexcept nogil:
    """Factor by (1); pivots are compared with size (n) > 0. The pivots after the deadline count as small.

    If x is not NULL, the first half of `solve_band_ldl` is applied to it, which is hidden by the latency of the divisions.
    """
    cdef int32_t full = full_columns(n, width)
    clear_pivot_statistics(out)
    if width == 2:
        factor_tridiagonal_ldl(n, c, size, tiny, x, out)
        return
    if deadline != NULL:
        factor_band_ldl_before_deadline(n, width, c, size, tiny, x, out, deadline)
        return
    if width == 6:                                      # Chains of joints with three rows have this width: constant loop bounds.
        factor_band_ldl_columns(0, full, 6, 6, c, size, tiny, x, out)
    else:
        factor_band_ldl_columns(0, full, width, width, c, size, tiny, x, out)
    factor_band_ldl_columns(full, n, width, 0, c, size, tiny, x, out)


cdef inline void forward_substitute_band_ldl(int32_t begin, int32_t end, int32_t width, int32_t height, const double* c,
                                             double* x) noexcept nogil:
    """Overwrite x by forward substitution with columns begin ... end - 1 of L."""
    cdef int32_t i, last
    cdef const double* col
    for i in range(begin, end):
        col = c + <int64_t>i * width
        last = height if height > 0 else end - i
        axpy_subtract(last - 1, x[i] * col[0], col + 1, x + i + 1)


cdef inline void back_substitute_band_ldl(int32_t begin, int32_t end, int32_t width, int32_t height, const double* c,
                                          double* x) noexcept nogil:
    """Overwrite x by back substitution with columns end - 1 ... begin of D L^T."""
    cdef int32_t i, t, last
    cdef double y
    cdef const double* col
    for i in range(end - 1, begin - 1, -1):
        col = c + <int64_t>i * width
        y = x[i]
        last = height if height > 0 else end - i
        for t in range(1, last):
            y -= col[t] * x[i + t]
        x[i] = y * col[0]


cdef inline void back_substitute_all_band_ldl(int32_t n, int32_t width, const double* c, double* x) noexcept nogil:
    """Apply the second half of `solve_band_ldl` to x (n)."""
    cdef int32_t full = full_columns(n, width)
    if width == 2:
        back_substitute_tridiagonal_ldl(n, c, x)
        return
    back_substitute_band_ldl(full, n, width, 0, c, x)
    if width == 6:
        back_substitute_band_ldl(0, full, 6, 6, c, x)
    else:
        back_substitute_band_ldl(0, full, width, width, c, x)


cdef inline void solve_band_ldl(int32_t n, int32_t width, const double* c, double* x) noexcept nogil:
    """Overwrite x (n) with (L D L^T)^-1 x; components of small pivots become 0."""
    cdef int32_t full = full_columns(n, width)
    if width == 2:
        solve_tridiagonal_ldl(n, c, x)
        return
    if width == 6:
        forward_substitute_band_ldl(0, full, 6, 6, c, x)
    else:
        forward_substitute_band_ldl(0, full, width, width, c, x)
    forward_substitute_band_ldl(full, n, width, 0, c, x)
    back_substitute_all_band_ldl(n, width, c, x)
