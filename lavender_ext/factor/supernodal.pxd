"""Factors by supernodes: columns of one pattern side by side, as one dense panel.

    L_J = (N_J - sum over K below J of L_K L_K^T) L_JJ^-T                                               (1)

Left-looking: what earlier panels K take from J is a dense product (`tiles.pxd`), spread over the rows of J. A panel
is held column by column, its own columns' rows first, then the rows below; 1 / L_jj stands on the diagonal (Ng, Peyton
1993; Davis 2006, chapter 4). `sparse.pyx` has it of any matrix, and L U; here is that of a matrix of blocks.
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memset

from lavender_ext.factor.blocks cimport factor_t, sparse_t
from lavender_ext.factor.panels cimport cholesky_panel, gemm_subtract_lower
from lavender_ext.factor.tiles cimport add_vector, axpy_subtract, gemm_subtract_nt


cdef inline void spread(const sparse_t* f, int32_t from_, int32_t end, int32_t skip, int32_t n, const int32_t* columns,
                        int32_t base, int64_t ld, double* to) noexcept nogil:
    """temp (end - from, n) added to a panel's rows rel - skip and the columns at those places."""
    cdef int32_t row = from_, high, j, m = end - from_
    while row < end:
        high = row + 1
        while high < end and f.rel[f.rows[high]] - f.rel[f.rows[row]] == high - row:
            high += 1
        for j in range(n):
            add_vector(high - row, f.temp + <int64_t>j * m + row - from_,
                to + ld * (columns[j] - base) + f.rel[f.rows[row]] - skip)
        row = high


cdef inline void strip_by_strip(const sparse_t* f, int32_t m, int32_t n, int32_t k, const double* u, int32_t below,
                                const double* a, int32_t rows, const int32_t* columns, int32_t base, double* v,
                                int32_t beside) noexcept nogil:
    # Rows in one run, columns not: each run of columns by itself.
    cdef int32_t j = 0, high
    while j < n:
        high = j + 1
        while high < n and columns[high] - columns[j] == high - j:
            high += 1
        gemm_subtract_nt(f.wide, m, high - j, k, u, below, a + j, rows, v + <int64_t>beside * (columns[j] - base), beside)
        j = high


cdef inline void take_panel(const sparse_t* f, int32_t to, int32_t of, const int32_t lu) noexcept nogil:
    """What the panel `to` is owed by an earlier one, from row `next` of that on."""
    cdef int32_t q = f.next[of], end = f.rptr[of + 1], n = 0, base = f.first[to], after = f.first[to + 1]
    cdef int32_t width = f.first[of + 1] - f.first[of], below = end - f.rptr[of], rows = width + below, m = end - q
    cdef int32_t own = after - base, beside = f.rptr[to + 1] - f.rptr[to], low, r = q - f.rptr[of]
    cdef int64_t ld = own + beside
    cdef double* a = f.val + f.at[of] + width + r
    cdef double* u
    cdef double* v = f.val + f.at[to]
    cdef const int32_t* columns = f.rows + q
    cdef bint run
    while q + n < end and f.rows[q + n] < after:
        n += 1
    low = f.rel[f.rows[q]]
    run = f.rel[f.rows[end - 1]] - low == m - 1         # into the panel as it stands
    if not lu:
        if run:
            gemm_subtract_lower(f.wide, m, n, width, a, rows, v + ld * low + low, ld)
        else:
            memset(f.temp, 0, sizeof(double) * m * n)
            gemm_subtract_lower(f.wide, m, n, width, a, rows, f.temp, m)
            spread(f, q, end, 0, n, columns, base, ld, v)
        f.next[of] = q + n
        return
    u = f.up + f.beside[of] + r
    if run:
        gemm_subtract_nt(f.wide, m, n, width, a, rows, u, below, v + ld * low + low, ld)
    else:
        memset(f.temp, 0, sizeof(double) * m * n)
        gemm_subtract_nt(f.wide, m, n, width, a, rows, u, below, f.temp, m)
        spread(f, q, end, 0, n, columns, base, ld, v)
    if m > n:
        v = f.up + f.beside[to]
        low = f.rel[f.rows[q + n]]
        if f.rel[f.rows[end - 1]] - low == m - n - 1:
            strip_by_strip(f, m - n, n, width, u + n, below, a, rows, columns, base, v + low - own, beside)
        else:
            memset(f.temp, 0, sizeof(double) * (m - n) * n)
            gemm_subtract_nt(f.wide, m - n, n, width, u + n, below, a, rows, f.temp, m - n)
            spread(f, q + n, end, own, n, columns, base, beside, v)
    f.next[of] = q + n


cdef inline void begin_panels(const sparse_t* f) noexcept nogil:
    cdef int32_t i
    for i in range(f.panels):
        f.head[i] = -1
        f.next[i] = f.rptr[i]


cdef inline void place_rows(const sparse_t* f, int32_t i) noexcept nogil:
    # `rel` of panel i
    cdef int32_t k, q
    for k in range(f.first[i], f.first[i + 1]):
        f.rel[k] = k - f.first[i]
    for q in range(f.rptr[i], f.rptr[i + 1]):
        f.rel[f.rows[q]] = f.first[i + 1] - f.first[i] + q - f.rptr[i]


cdef inline void hand_on(const sparse_t* f, int32_t i, int32_t q) noexcept nogil:
    # panel i to the later one in which its row q is, if there is such a row
    cdef int32_t k
    if q < f.rptr[i + 1]:
        k = f.of[f.rows[q]]
        f.link[i] = f.head[k]
        f.head[k] = i


cdef inline void take_panels(const sparse_t* f, int32_t i, const int32_t lu) noexcept nogil:
    """All that panel i is owed by earlier ones, after `place_rows`."""
    cdef int32_t j = f.head[i], after
    while j >= 0:
        after = f.link[j]
        take_panel(f, i, j, lu)
        hand_on(f, j, f.next[j])
        j = after


cdef inline void less_three(int32_t n, int32_t columns, const double* a, int64_t apart, const double* t,
                            double* y) noexcept nogil:
    """y <- y - A t (n) of up to three columns that are `apart` in memory, one after the other."""
    cdef int32_t q
    cdef double t0 = t[0], t1, t2
    cdef const double* b = a + apart
    cdef const double* c = b + apart
    if columns == 3:
        t1, t2 = t[1], t[2]
        for q in range(n):
            y[q] = ((y[q] - t0 * a[q]) - t1 * b[q]) - t2 * c[q]
    elif columns == 2:
        t1 = t[1]
        for q in range(n):
            y[q] = (y[q] - t0 * a[q]) - t1 * b[q]
    else:
        axpy_subtract(n, t0, a, y)


cdef inline void less_products(int32_t n, int32_t columns, const double* a, int64_t apart, const double* x,
                               double* y) noexcept nogil:
    """y <- y - A^T x (columns) for columns of A (n) that are `apart` in memory: some at once, each sum in order."""
    cdef int32_t j = 0, q
    cdef double s0, s1, s2, s3, t
    cdef const double* b
    cdef const double* c
    cdef const double* d
    while j + 4 <= columns:
        b, c, d = a + apart, a + 2 * apart, a + 3 * apart
        s0, s1, s2, s3 = y[j], y[j + 1], y[j + 2], y[j + 3]
        for q in range(n):
            t = x[q]
            s0 -= a[q] * t
            s1 -= b[q] * t
            s2 -= c[q] * t
            s3 -= d[q] * t
        y[j], y[j + 1], y[j + 2], y[j + 3] = s0, s1, s2, s3
        a += 4 * apart
        j += 4
    if j + 3 == columns:
        b, c = a + apart, a + 2 * apart
        s0, s1, s2 = y[j], y[j + 1], y[j + 2]
        for q in range(n):
            t = x[q]
            s0 -= a[q] * t
            s1 -= b[q] * t
            s2 -= c[q] * t
        y[j], y[j + 1], y[j + 2] = s0, s1, s2
        return
    while j < columns:
        s0 = y[j]
        for q in range(n):
            s0 -= a[q] * x[q]
        y[j] = s0
        a += apart
        j += 1


cdef inline void panels_solve(const sparse_t* f, double* y, const int32_t lu) noexcept nogil:
    """y (n) <- the solve in the order of the panels."""
    cdef int32_t i, j, q, n, width, below, rows, k
    cdef double t
    cdef double* own
    cdef const double* a
    for i in range(f.panels):
        width = f.first[i + 1] - f.first[i]
        below = f.rptr[i + 1] - f.rptr[i]
        rows = width + below
        own = y + f.first[i]
        a = f.val + f.at[i]
        if lu:
            for j in range(width):
                k = f.swap[f.first[i] + j]
                t = own[k]
                own[k] = own[j]
                own[j] = t
        for q in range(below):
            f.temp[q] = 0.0
        j = 0
        while j < width:
            n = 3 if j + 3 <= width else width - j
            for k in range(j, j + n):
                t = own[k]
                if not lu:
                    t = t * a[k + <int64_t>(k - j) * rows]
                    own[k] = t
                for q in range(k + 1, j + n):
                    own[q] -= t * a[q + <int64_t>(k - j) * rows]
            less_three(width - j - n, n, a + j + n, rows, own + j, own + j + n)
            less_three(below, n, a + width, rows, own + j, f.temp)
            a += <int64_t>n * rows
            j += n
        for q in range(below):
            y[f.rows[f.rptr[i] + q]] += f.temp[q]
    for i in range(f.panels - 1, -1, -1):
        width = f.first[i + 1] - f.first[i]
        below = f.rptr[i + 1] - f.rptr[i]
        rows = width + below
        own = y + f.first[i]
        a = f.val + f.at[i]
        for q in range(below):
            f.temp[q] = y[f.rows[f.rptr[i] + q]]
        if lu:
            less_products(below, width, f.up + f.beside[i], below, f.temp, own)
        else:
            less_products(below, width, a + width, rows, f.temp, own)
        for j in range(width - 1, -1, -1):
            if lu:
                t = own[j] * a[j + <int64_t>j * rows]
                own[j] = t
                axpy_subtract(j, t, a + <int64_t>j * rows, own)
            else:
                t = own[j]
                for q in range(j + 1, width):
                    t -= a[q + <int64_t>j * rows] * own[q]
                own[j] = t * a[j + <int64_t>j * rows]


cdef inline void sparse_solve(const sparse_t* f, const double* b, double* x) noexcept nogil:
    """x <- (A + shift D)^-1 b after `lav_sparse_factor`; they may be one array."""
    cdef int32_t k
    for k in range(f.n):
        f.y[k] = b[f.order[k]]
        if f.lu:
            f.y[k] *= f.scale[k]
    panels_solve(f, f.y, f.lu)
    for k in range(f.n):
        x[f.order[k]] = f.y[k] * f.scale[k] if f.lu else f.y[k]


cdef inline int32_t super_cholesky(const factor_t* f) noexcept nogil:
    """N = L L^T of the blocks in `nval`; returns the number of pivots lost to rounding."""
    cdef const sparse_t* p = f.super
    cdef int32_t k, q, r, c, i, s = f.s, lost = 0
    cdef int64_t ld, b = s * s
    cdef double* y
    cdef const double* x
    begin_panels(p)
    memset(p.val, 0, sizeof(double) * p.at[p.panels])
    for k in range(f.n):
        for q in range(f.nptr[k], f.nptr[k + 1]):
            i = p.of[s * f.nind[q]]
            ld = p.first[i + 1] - p.first[i] + p.rptr[i + 1] - p.rptr[i]
            y = p.val + f.spot[q]
            x = f.nval + q * b
            for c in range(s):
                for r in range(s):
                    y[r + c * ld] = x[r * s + c]
    for i in range(p.panels):
        place_rows(p, i)
        take_panels(p, i, 0)
        k = p.first[i + 1] - p.first[i]
        lost += cholesky_panel(p.wide, k, k + p.rptr[i + 1] - p.rptr[i], p.val + p.at[i], NULL)
        hand_on(p, i, p.rptr[i])
    return lost
