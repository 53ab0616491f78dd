"""Solving with a sparse factor by dense panels, which `sparse.pyx` makes."""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.factor.tiles cimport take


cdef struct sparse_t:
    int32_t n                   # rows
    int32_t panels
    int32_t wide                # 1 where four lanes are one instruction
    int32_t lu
    const int32_t* order        # (n) row at each place
    const int32_t* place        # (n) place of each row
    const int32_t* first        # (panels + 1) places
    const int32_t* of           # (n) panel of a place
    const int32_t* rptr         # (panels + 1) places below a panel, ascending
    const int32_t* rows
    const int64_t* at           # (panels + 1) of a panel in `val`,
    const int64_t* beside       # (panels + 1) and of what is beside it in `up`
    double* val
    double* up                  # L U only
    double* temp                # what one panel takes from another, at most, or STRIP rows of one
    double* scale               # (n) L U: of each place; else the least pivot of each
    double* y                   # (n)
    int32_t* swap               # (n) L U: the place within the panel that came here
    int32_t* rel                # (n) row of a place in the present panel
    int32_t* head               # (panels) panels that take from a panel next
    int32_t* link               # (panels)
    int32_t* next               # (panels) first row not yet taken


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
        take(n, t0, a, y)


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


cdef inline void sparse_solve(const sparse_t* f, const double* b, double* x) noexcept nogil:
    """x <- (A + shift D)^-1 b after `lav_sparse_factor`; they may be one array."""
    cdef int32_t i, j, q, n, width, below, rows, k
    cdef double t
    cdef double* own
    cdef const double* a
    for k in range(f.n):
        f.y[k] = b[f.order[k]]
        if f.lu:
            f.y[k] *= f.scale[k]
    for i in range(f.panels):
        width = f.first[i + 1] - f.first[i]
        below = f.rptr[i + 1] - f.rptr[i]
        rows = width + below
        own = f.y + f.first[i]
        a = f.val + f.at[i]
        if f.lu:
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
                if not f.lu:
                    t = t * a[k + <int64_t>(k - j) * rows]
                    own[k] = t
                for q in range(k + 1, j + n):
                    own[q] -= t * a[q + <int64_t>(k - j) * rows]
            less_three(width - j - n, n, a + j + n, rows, own + j, own + j + n)
            less_three(below, n, a + width, rows, own + j, f.temp)
            a += <int64_t>n * rows
            j += n
        for q in range(below):
            f.y[f.rows[f.rptr[i] + q]] += f.temp[q]
    for i in range(f.panels - 1, -1, -1):
        width = f.first[i + 1] - f.first[i]
        below = f.rptr[i + 1] - f.rptr[i]
        rows = width + below
        own = f.y + f.first[i]
        a = f.val + f.at[i]
        for q in range(below):
            f.temp[q] = f.y[f.rows[f.rptr[i] + q]]
        if f.lu:
            less_products(below, width, f.up + f.beside[i], below, f.temp, own)
        else:
            less_products(below, width, a + width, rows, f.temp, own)
        for j in range(width - 1, -1, -1):
            if f.lu:
                t = own[j] * a[j + <int64_t>j * rows]
                own[j] = t
                take(j, t, a + <int64_t>j * rows, own)
            else:
                t = own[j]
                for q in range(j + 1, width):
                    t -= a[q + <int64_t>j * rows] * own[q]
                own[j] = t * a[j + <int64_t>j * rows]
    for k in range(f.n):
        x[f.order[k]] = f.y[k] * f.scale[k] if f.lu else f.y[k]


cdef class SparsePanels:
    cdef sparse_t f
    cdef object keep, numbers, indptr, indices
    cdef double half                                    # multiply-adds of L L^T, roughly,
    cdef readonly double work                           # and of the factor
    cdef readonly int64_t entries                       # numbers it holds

    cdef _make_room(self)
