"""Cholesky by supernodes: block columns of one pattern side by side, as one dense panel.

    L_J = (N_J - sum over K below J of L_K L_K^T) L_JJ^-T                                               (1)

Left-looking: what earlier panels K take from J is a dense product (`tiles.pxd`), spread over the rows of J. A panel
is held column by column, its own columns' rows first, then the rows below; 1 / L_jj stands on the diagonal (Ng, Peyton
1993; Davis 2006, chapter 4).
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memset

from lavender_ext.factor.blocks cimport factor_t, supernodes_t
from lavender_ext.factor.tiles cimport add, finish, less, take


cdef enum:
    STRIP = 12                  # columns of a product that begin at the same row
    TOGETHER = 3                # columns of a panel that are finished together


cdef inline int32_t dense_panel(int32_t wide, int32_t width, int32_t rows, double* a,
                                const double* least) noexcept nogil:
    """Columns of a panel (rows, width) from what is left of N there; how many pivots were lost to rounding.

    least (width): what a pivot must be above, or NULL: 1e-15 of what stood there before the last columns.
    """
    cdef int32_t j, j0 = 0, t, n, lost = 0
    cdef double x
    cdef double top[3]
    cdef double* y
    while j0 < width:
        n = TOGETHER if j0 + TOGETHER <= width else width - j0
        less(wide, rows - j0, n, j0, a + j0, rows, a + j0, rows, a + j0 + <int64_t>j0 * rows, rows)
        for j in range(n):
            top[j] = a[(j0 + j) + <int64_t>(j0 + j) * rows]
        for j in range(j0, j0 + n):
            y = a + <int64_t>j * rows
            for t in range(j0, j):
                take(j0 + n - j, a[j + <int64_t>t * rows], a + j + <int64_t>t * rows, y + j)
            x = y[j]
            if not x > (1e-15 * top[j - j0] if least == NULL else least[j]):
                lost += 1
                x = 0.0
            else:
                x = 1.0 / sqrt(x)
            y[j] = x
            for t in range(j + 1, j0 + n):
                y[t] *= x
        y = a + j0 + <int64_t>j0 * rows
        if n == 3:
            finish(rows - j0 - 3, y, y + rows, y + 2 * <int64_t>rows)
        else:
            for j in range(n):
                for t in range(j):
                    take(rows - j0 - n, y[j + <int64_t>t * rows], y + n + <int64_t>t * rows, y + n + <int64_t>j * rows)
                for t in range(n, rows - j0):
                    y[t + <int64_t>j * rows] *= y[j + <int64_t>j * rows]
        j0 += TOGETHER
    return lost


cdef inline void less_lower(int32_t wide, int32_t m, int32_t n, int32_t k, const double* a, int64_t lda, double* c,
                            int64_t ldc) noexcept nogil:
    """C (m, n) <- C - A B^T with B the first n rows of A (m, k), on and below the diagonal; above it, little."""
    cdef int32_t j = 0, most
    while j < n:
        most = STRIP if j + STRIP <= n else n - j
        less(wide, m - j, most, k, a + j, lda, a + j, lda, c + j + j * ldc, ldc)
        j += most


cdef inline void take_panel(const factor_t* f, const supernodes_t* p, int32_t to, int32_t of) noexcept nogil:
    """(1) of one earlier panel: rows from `at[of]` on, of which the first `n` blocks are columns of `to`."""
    cdef int32_t s = f.s, i, j, c, q = p.next[of], end = p.rptr[of + 1], n = 0, width, rows, m, row, high, low
    cdef double* a
    cdef double* t
    cdef double* y
    cdef int64_t ld = p.height[to]
    while q + n < end and p.rows[q + n] < p.first[to + 1]:
        n += 1
    width = s * (p.first[of + 1] - p.first[of])
    rows = p.height[of]
    m = s * (end - q)
    a = p.val + p.at[of] + width + s * (q - p.rptr[of])
    low = p.place[p.rows[q]]
    if p.place[p.rows[end - 1]] - low == s * (end - 1 - q):
        # One run of rows: straight into the panel. Above its diagonal stands what nobody reads.
        less_lower(p.wide, m, n * s, width, a, rows, p.val + p.at[to] + ld * low + low, ld)
        p.next[of] = q + n
        return
    memset(p.temp, 0, sizeof(double) * m * n * s)
    less_lower(p.wide, m, n * s, width, a, rows, p.temp, m)
    row = 0
    while row < m:
        i = row // s + q
        low = p.place[p.rows[i]]
        high = row + s
        i += 1
        while i < end and p.place[p.rows[i]] - low == high - row:
            high += s
            i += 1
        for j in range(n):
            for c in range(s):
                y = p.val + p.at[to] + ld * (s * (p.rows[q + j] - p.first[to]) + c) + low
                t = p.temp + <int64_t>(j * s + c) * m + row
                add(high - row, t, y)
        row = high
    p.next[of] = q + n


cdef inline int32_t super_cholesky(const factor_t* f) noexcept nogil:
    """N = L L^T of the blocks in `nval`; returns the number of pivots lost to rounding."""
    cdef const supernodes_t* p = f.super
    cdef int32_t k, q, r, c, i, j, s = f.s, lost = 0, after
    cdef int64_t b = s * s
    cdef double* y
    cdef const double* x
    for i in range(p.n):
        p.head[i] = -1
        p.next[i] = p.rptr[i]
    memset(p.val, 0, sizeof(double) * p.at[p.n])
    for k in range(f.n):
        for q in range(f.nptr[k], f.nptr[k + 1]):
            i = p.of[f.nind[q]]
            y = p.val + p.spot[q]
            x = f.nval + q * b
            for c in range(s):
                for r in range(s):
                    y[r + c * <int64_t>p.height[i]] = x[r * s + c]
    for i in range(p.n):
        for k in range(p.first[i], p.first[i + 1]):
            p.place[k] = s * (k - p.first[i])
        for q in range(p.rptr[i], p.rptr[i + 1]):
            p.place[p.rows[q]] = s * (p.first[i + 1] - p.first[i] + q - p.rptr[i])
        j = p.head[i]
        while j >= 0:
            after = p.link[j]
            take_panel(f, p, i, j)
            if p.next[j] < p.rptr[j + 1]:
                k = p.of[p.rows[p.next[j]]]
                p.link[j] = p.head[k]
                p.head[k] = j
            j = after
        lost += dense_panel(p.wide, s * (p.first[i + 1] - p.first[i]), p.height[i], p.val + p.at[i], NULL)
        if p.rptr[i] < p.rptr[i + 1]:
            k = p.of[p.rows[p.rptr[i]]]
            p.link[i] = p.head[k]
            p.head[k] = i
    return lost


cdef inline void super_solve(const factor_t* f, double* x) noexcept nogil:
    """x <- N^-1 x after `super_cholesky`, x (n, s)."""
    cdef const supernodes_t* p = f.super
    cdef int32_t i, j, q, r, s = f.s, width, rows, below
    cdef double t, t0, t1, t2, u
    cdef double* own
    cdef const double* a
    cdef const double* a1
    cdef const double* a2
    for i in range(p.n):                                # L y = x
        width = s * (p.first[i + 1] - p.first[i])
        rows = p.height[i]
        below = rows - width
        own = x + s * p.first[i]
        a = p.val + p.at[i]
        memset(p.temp, 0, sizeof(double) * below)
        for j in range(width):
            t = own[j] * a[j]
            own[j] = t
            take(width - j - 1, t, a + j + 1, own + j + 1)
            take(below, t, a + width, p.temp)
            a += rows
        for q in range(p.rptr[i], p.rptr[i + 1]):
            for r in range(s):
                x[s * p.rows[q] + r] += p.temp[s * (q - p.rptr[i]) + r]
    for i in range(p.n - 1, -1, -1):                    # L^T x = y
        width = s * (p.first[i + 1] - p.first[i])
        rows = p.height[i]
        below = rows - width
        own = x + s * p.first[i]
        for q in range(p.rptr[i], p.rptr[i + 1]):
            for r in range(s):
                p.temp[s * (q - p.rptr[i]) + r] = x[s * p.rows[q] + r]
        a = p.val + p.at[i] + width
        j = 0
        while j + 3 <= width:                           # three sums beside each other, each in the order of its rows
            a1 = a + rows
            a2 = a1 + rows
            t0 = own[j]
            t1 = own[j + 1]
            t2 = own[j + 2]
            for q in range(below):
                u = p.temp[q]
                t0 -= a[q] * u
                t1 -= a1[q] * u
                t2 -= a2[q] * u
            own[j] = t0
            own[j + 1] = t1
            own[j + 2] = t2
            a = a2 + rows
            j += 3
        while j < width:
            t0 = own[j]
            for q in range(below):
                t0 -= a[q] * p.temp[q]
            own[j] = t0
            a += rows
            j += 1
        for j in range(width - 1, -1, -1):
            a = p.val + p.at[i] + <int64_t>j * rows
            t = own[j]
            for q in range(j + 1, width):
                t -= a[q] * own[q]
            own[j] = t * a[j]
