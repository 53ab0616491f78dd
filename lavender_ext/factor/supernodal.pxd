"""Sparse factorisation by supernodes: columns of L with one pattern, stored as a dense panel.

    L_J = (N_J - sum over K before J of L_K L_K^T) L_JJ^-T                                              (1)

    P N_JJ' = L_JJ U_JJ,   N_JJ' = N_JJ - sum over K before J of L_K U_K                                (2)
    L_J = (N_J - sum L_K U_KJ) U_JJ^-1 below,   U_J = L_JJ^-1 P (N_J - sum L_JK U_K) beside             (3)

The method is left-looking: the updates of a supernode J by its descendants K are dense products (`tiles.pxd`), which are added
to the rows of J (Ng, Peyton 1993; Davis 2006, chapter 4). A panel (`panels.pxd`) is stored column by column, first the rows of
its own columns, then the rows below. L U has the pattern of the symmetric factor, exchanges rows only within a panel, and
stores the rows of U beside a panel transposed, so that every update is C - A B^T. `sparse.pyx` fills panels from a matrix in
compressed rows, `blocks.pxd` from square blocks.
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memset

from lavender_ext.factor.factors cimport interrupt_t, supernodal_t
from lavender_ext.factor.panels cimport (LU_STRIP, factor_panel_by_cholesky, factor_panel_by_lu, gemm_subtract_lower,
                                         has_passed_after_product)
from lavender_ext.factor.tiles cimport add_vector, axpy_subtract, gemm_subtract_nt


cdef inline bint count_work_and_check_stop(const supernodal_t* f, double work) noexcept nogil:
    """Count `work` multiply-adds; return whether a signal or the deadline ends the factorisation."""
    cdef interrupt_t* c = f.interrupt
    if f.deadline != NULL and f.deadline.passed:
        return True
    if c == NULL:
        return False
    c.work += work
    if c.work > 2e8 and not c.stopped:                  # These multiply-adds take 0.03 s to 0.2 s.
        c.work, c.stopped = 0.0, c.is_requested(c.at)
    return c.stopped


cdef inline int32_t panel_width(const supernodal_t* f, int32_t i) noexcept nogil:
    """Return the number of columns of supernode i."""
    return f.first[i + 1] - f.first[i]


cdef inline int32_t rows_below(const supernodal_t* f, int32_t i) noexcept nogil:
    """Return the number of rows below supernode i."""
    return f.row_ptr[i + 1] - f.row_ptr[i]


cdef inline int64_t supernodal_scratch_size(const supernodal_t* f, bint lu) noexcept nogil:
    """Return the number of doubles for the largest update, for the rows below a panel, and for a strip of `factor_panel_by_lu`."""
    cdef int32_t i, j, run
    cdef int64_t largest = 0, needed
    for i in range(f.supernodes):
        needed = <int64_t>panel_width(f, i) * LU_STRIP if lu else 0
        largest = max(largest, max(needed, <int64_t>rows_below(f, i)))
        run = 0
        for j in range(f.row_ptr[i], f.row_ptr[i + 1]):     # Consecutive rows of one supernode update it together.
            run = run + 1 if j > f.row_ptr[i] and f.supernode_of[f.row_indices[j]] == f.supernode_of[f.row_indices[j - 1]] else 1
            needed = <int64_t>run * (f.row_ptr[i + 1] - j + run - 1)
            largest = max(largest, needed)
    return largest


# -- updates of a supernode by its descendants -------------------------------------------------------------------


cdef inline void add_scratch_to_panel(const supernodal_t* f, int32_t begin, int32_t end, int32_t skipped, int32_t n,
                                      const int32_t* columns, int32_t base, int64_t ld, double* panel) noexcept nogil:
    """Add scratch (end - begin, n) to a panel, at the rows of row_indices[begin:end] and these columns, minus `base`.

    `skipped` is the number of the panel's first rows that `panel` leaves out.
    """
    cdef int32_t row = begin, run_end, j, m = end - begin
    while row < end:
        run_end = row + 1
        while run_end < end and f.local_row[f.row_indices[run_end]] - f.local_row[f.row_indices[row]] == run_end - row:
            run_end += 1
        for j in range(n):
            add_vector(run_end - row, f.scratch + <int64_t>j * m + row - begin,
                       panel + ld * (columns[j] - base) + f.local_row[f.row_indices[row]] - skipped)
        row = run_end


cdef inline void subtract_product(const supernodal_t* f, int32_t m, int32_t n, int32_t k, const double* a, int32_t lda,
                                  const double* b, int32_t ldb, double* c, int64_t ldc) noexcept nogil:
    """Subtract A B^T from C (m, n); with a deadline in strips of columns, until it."""
    cdef int32_t j = 0, columns
    if f.deadline == NULL:
        gemm_subtract_nt(f.wide, m, n, k, a, lda, b, ldb, c, ldc)
        return
    while j < n:
        columns = LU_STRIP if j + LU_STRIP <= n else n - j
        gemm_subtract_nt(f.wide, m, columns, k, a, lda, b + j, ldb, c + j * ldc, ldc)
        if has_passed_after_product(f.deadline, m, columns, k):
            return
        j += columns


cdef inline void subtract_column_runs(const supernodal_t* f, int32_t m, int32_t n, int32_t k, const double* u, int32_t ldu,
                                      const double* a, int32_t lda, const int32_t* columns, int32_t base, double* c,
                                      int32_t ldc) noexcept nogil:
    """Subtract U A^T from columns of C (m rows) in runs of consecutive columns."""
    cdef int32_t j = 0, run_end
    while j < n:
        run_end = j + 1
        while run_end < n and columns[run_end] - columns[j] == run_end - j:
            run_end += 1
        subtract_product(f, m, run_end - j, k, u, ldu, a + j, lda, c + <int64_t>ldc * (columns[j] - base), ldc)
        j = run_end


cdef inline void subtract_descendant(const supernodal_t* f, int32_t i, int32_t k, const int32_t lu) noexcept nogil:
    """Update supernode i by its descendant k, by the rows of k from `next_row` on; `next_row` moves past the columns of i."""
    cdef int32_t q = f.next_row[k], end = f.row_ptr[k + 1], n = 0, base = f.first[i], after = f.first[i + 1]
    cdef int32_t width = panel_width(f, k), below = rows_below(f, k), rows = width + below, m = end - q
    cdef int32_t own = after - base, beside = rows_below(f, i), low, r = q - f.row_ptr[k]
    cdef int64_t ld = own + beside
    cdef double* a = f.values + f.value_offset[k] + width + r
    cdef double* u
    cdef double* panel = f.values + f.value_offset[i]
    cdef const int32_t* columns = f.row_indices + q
    cdef bint is_run
    while q + n < end and f.row_indices[q + n] < after:
        n += 1
    low = f.local_row[f.row_indices[q]]
    is_run = f.local_row[f.row_indices[end - 1]] - low == m - 1         # whether the rows are consecutive in the panel
    f.next_row[k] = q + n
    if not lu:
        if is_run:
            gemm_subtract_lower(f.wide, m, n, width, a, rows, panel + ld * low + low, ld, f.deadline)
        else:
            memset(f.scratch, 0, sizeof(double) * m * n)
            gemm_subtract_lower(f.wide, m, n, width, a, rows, f.scratch, m, f.deadline)
            add_scratch_to_panel(f, q, end, 0, n, columns, base, ld, panel)
        return
    # update of the columns of L (and of the diagonal block of U)
    u = f.upper + f.upper_offset[k] + r
    if is_run:
        subtract_product(f, m, n, width, a, rows, u, below, panel + ld * low + low, ld)
    else:
        memset(f.scratch, 0, sizeof(double) * m * n)
        subtract_product(f, m, n, width, a, rows, u, below, f.scratch, m)
        add_scratch_to_panel(f, q, end, 0, n, columns, base, ld, panel)
    # update of the rows of U
    if m > n:
        panel = f.upper + f.upper_offset[i]
        low = f.local_row[f.row_indices[q + n]]
        if f.local_row[f.row_indices[end - 1]] - low == m - n - 1:
            subtract_column_runs(f, m - n, n, width, u + n, below, a, rows, columns, base, panel + low - own, beside)
        else:
            memset(f.scratch, 0, sizeof(double) * (m - n) * n)
            subtract_product(f, m - n, n, width, u + n, below, a, rows, f.scratch, m - n)
            add_scratch_to_panel(f, q + n, end, own, n, columns, base, beside, panel)


cdef inline void clear_descendant_lists(const supernodal_t* f) noexcept nogil:
    """Begin a factorisation: empty the lists of descendants that update a supernode next."""
    cdef int32_t i
    for i in range(f.supernodes):
        f.head[i] = -1
        f.next_row[i] = f.row_ptr[i]


cdef inline void set_local_rows(const supernodal_t* f, int32_t i) noexcept nogil:
    """Set `local_row` for the positions of supernode i."""
    cdef int32_t k, q
    for k in range(f.first[i], f.first[i + 1]):
        f.local_row[k] = k - f.first[i]
    for q in range(f.row_ptr[i], f.row_ptr[i + 1]):
        f.local_row[f.row_indices[q]] = panel_width(f, i) + q - f.row_ptr[i]


cdef inline void link_descendant(const supernodal_t* f, int32_t i, int32_t q) noexcept nogil:
    """Link supernode i to the later supernode that contains its row q, if there is such a row."""
    cdef int32_t k
    if q < f.row_ptr[i + 1]:
        k = f.supernode_of[f.row_indices[q]]
        f.link[i] = f.head[k]
        f.head[k] = i


# -- factorisation -------------------------------------------------------------------------------------------------


cdef inline void swap_columns(double* u, int32_t n, int32_t ld, const int32_t* swap) noexcept nogil:
    """Exchange columns j and swap[j] of u for j = 0 ... n - 1."""
    cdef int32_t i, j
    cdef double x
    cdef double* y
    cdef double* z
    for j in range(n):
        if swap[j] != j:
            y = u + <int64_t>j * ld
            z = u + <int64_t>swap[j] * ld
            for i in range(ld):
                x = y[i]
                y[i] = z[i]
                z[i] = x


cdef inline int32_t factor_supernode_by_lu(const supernodal_t* f, int32_t width, int32_t below, double* a, double* u,
                                           int32_t* swap, double min_pivot) noexcept nogil:
    """Factor one panel a and its rows u of U, transposed, by (2) and (3); return the number of pivots that are too small."""
    cdef int32_t j, j0 = 0, t, n, rows = width + below
    cdef int32_t lost = factor_panel_by_lu(f.wide, width, rows, width, a, rows, swap, min_pivot, f.scratch, f.deadline)
    if below == 0 or f.deadline != NULL and f.deadline.passed:
        return lost
    swap_columns(u, width, below, swap)
    while j0 < width:                                   # Solve with L.
        n = LU_STRIP if j0 + LU_STRIP <= width else width - j0
        gemm_subtract_nt(f.wide, below, n, j0, u, below, a + j0, rows, u + <int64_t>j0 * below, below)
        if has_passed_after_product(f.deadline, below, n, j0):
            return width
        for j in range(j0 + 1, j0 + n):
            for t in range(j0, j):
                axpy_subtract(below, a[j + <int64_t>t * rows], u + <int64_t>t * below, u + <int64_t>j * below)
        j0 += n
    return lost


cdef inline int32_t factor_supernode(const supernodal_t* f, int32_t i, const int32_t lu, const double* min_pivot,
                                     double min_lu_pivot) noexcept nogil:
    """Factor supernode i, whose entries of N are filled in and whose `local_row` is set; return the number of lost pivots.

    After a request to end, or the deadline, every pivot counts as lost.

    min_pivot (n), by position, is that of `factor_panel_by_cholesky`, or NULL; min_lu_pivot that of `factor_panel_by_lu`.
    """
    cdef int32_t k = f.head[i], after, lost, width = panel_width(f, i), below = rows_below(f, i)
    cdef double* a = f.values + f.value_offset[i]
    while k >= 0:
        after = f.link[k]
        if count_work_and_check_stop(f, <double>panel_width(f, k) * (f.row_ptr[k + 1] - f.next_row[k]) * width):
            return width
        subtract_descendant(f, i, k, lu)
        link_descendant(f, k, f.next_row[k])
        k = after
    if count_work_and_check_stop(f, 0.5 * width * width * (width + below)):
        return width
    if lu:
        lost = factor_supernode_by_lu(f, width, below, a, f.upper + f.upper_offset[i], f.swap + f.first[i], min_lu_pivot)
    else:
        lost = factor_panel_by_cholesky(f.wide, width, width + below, a, min_pivot + f.first[i] if min_pivot != NULL else NULL,
                                        f.deadline)
    link_descendant(f, i, f.row_ptr[i])
    return lost


# -- solves --------------------------------------------------------------------------------------------------------


cdef inline void subtract_three_columns(int32_t n, int32_t columns, const double* a, int64_t lda, const double* t,
                                        double* y) noexcept nogil:
    """Subtract A t from y (n). The products of up to three columns of A are subtracted one after the other."""
    cdef int32_t q
    cdef double t0 = t[0], t1, t2
    cdef const double* b = a + lda
    cdef const double* c = b + lda
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


cdef inline void gemv_subtract_t(int32_t n, int32_t columns, const double* a, int64_t lda, const double* x,
                                 double* y) noexcept nogil:
    """Subtract A^T x from y (columns), with columns of A (n); every sum runs in the order of the rows."""
    cdef int32_t j = 0, q
    cdef double s0, s1, s2, s3, t
    cdef const double* b
    cdef const double* c
    cdef const double* d
    while j + 4 <= columns:
        b, c, d = a + lda, a + 2 * lda, a + 3 * lda
        s0, s1, s2, s3 = y[j], y[j + 1], y[j + 2], y[j + 3]
        for q in range(n):
            t = x[q]
            s0 -= a[q] * t
            s1 -= b[q] * t
            s2 -= c[q] * t
            s3 -= d[q] * t
        y[j], y[j + 1], y[j + 2], y[j + 3] = s0, s1, s2, s3
        a += 4 * lda
        j += 4
    if j + 3 == columns:
        b, c = a + lda, a + 2 * lda
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
        a += lda
        j += 1


cdef inline void solve_lower(const supernodal_t* f, double* y, const int32_t lu) noexcept nogil:
    """Overwrite y (n), in the order of positions, with L^-1 P y."""
    cdef int32_t i, j, q, n, width, below, rows, k
    cdef double t
    cdef double* own
    cdef const double* a
    for i in range(f.supernodes):
        width, below = panel_width(f, i), rows_below(f, i)
        rows = width + below
        own = y + f.first[i]
        a = f.values + f.value_offset[i]
        if lu:
            for j in range(width):
                k = f.swap[f.first[i] + j]
                t = own[k]
                own[k] = own[j]
                own[j] = t
        for q in range(below):
            f.scratch[q] = 0.0
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
            subtract_three_columns(width - j - n, n, a + j + n, rows, own + j, own + j + n)
            subtract_three_columns(below, n, a + width, rows, own + j, f.scratch)
            a += <int64_t>n * rows
            j += n
        for q in range(below):
            y[f.row_indices[f.row_ptr[i] + q]] += f.scratch[q]


cdef inline void solve_upper(const supernodal_t* f, double* y, const int32_t lu) noexcept nogil:
    """Overwrite y (n), in the order of positions, with U^-1 y, or L^-T y."""
    cdef int32_t i, j, q, width, below, rows
    cdef double t
    cdef double* own
    cdef const double* a
    for i in range(f.supernodes - 1, -1, -1):
        width, below = panel_width(f, i), rows_below(f, i)
        rows = width + below
        own = y + f.first[i]
        a = f.values + f.value_offset[i]
        for q in range(below):
            f.scratch[q] = y[f.row_indices[f.row_ptr[i] + q]]
        if lu:
            gemv_subtract_t(below, width, f.upper + f.upper_offset[i], below, f.scratch, own)
        else:
            gemv_subtract_t(below, width, a + width, rows, f.scratch, own)
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


cdef inline void solve_supernodes(const supernodal_t* f, double* y, const int32_t lu) noexcept nogil:
    """Overwrite y (n), in the order of positions, with N^-1 y."""
    solve_lower(f, y, lu)
    solve_upper(f, y, lu)
