"""Factorisation of one dense panel: its columns, with the rows of L below them.

    [L_1; L_2] L_1^T = [A_1; A_2]              `factor_panel_by_cholesky`                                         (1)
    P [A_1; A_2] = [L_1; L_2] U_1              `factor_panel_by_lu`, L_1 unit lower triangular                    (2)

A panel is stored column by column; its first `width` rows are those of its own columns. The reciprocals 1 / L_jj of (1) and
1 / U_jj of (2) are stored on the diagonal. Dense and sparse factorisations consist of panels (`dense.pxd`, `supernodal.pxd`).
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.deadline cimport deadline_t, entry_cost, has_passed, product_cost
from lavender_ext.factor.tiles cimport axpy_subtract, gemm_subtract_nt, is_large_product, solve_three_columns


cdef enum:
    CHOLESKY_STRIP = 3          # number of columns of (1) that are finished together: the width of a tile of `gemm_subtract_nt`
    CHOLESKY_BLOCK = 48         # number of columns of (1) from which earlier blocks are subtracted together
    LU_STRIP = 12               # number of columns of (2) that are finished together: the width of four tiles


cdef inline bint has_passed_after_product(deadline_t* deadline, double m, double n, double k) noexcept nogil:
    """Count a product of (m, k) and (k, n) that is added to a matrix; return whether the deadline has passed."""
    return deadline != NULL and has_passed(deadline, m * n * (entry_cost() + product_cost() * k))


cdef inline void gemm_subtract_lower(int32_t wide, int32_t m, int32_t n, int32_t k, const double* a, int64_t lda, double* c,
                                     int64_t ldc, deadline_t* deadline) noexcept nogil:
    """Subtract A B^T from C (m, n) on and below its diagonal, until the deadline; B is the first n rows of A (m, k).

    Entries above the diagonal are changed within strips of LU_STRIP columns, or of CHOLESKY_BLOCK columns of a large product.
    """
    cdef int32_t j = 0, columns
    cdef int32_t strip = CHOLESKY_BLOCK if n > LU_STRIP and m >= 4 * n and is_large_product(m, n, k) else LU_STRIP
    while j < n:
        columns = strip if j + strip <= n else n - j
        gemm_subtract_nt(wide, m - j, columns, k, a + j, lda, a + j, lda, c + j + j * ldc, ldc)
        if has_passed_after_product(deadline, m - j, columns, k):
            return
        j += columns


cdef inline int32_t factor_panel_by_cholesky(int32_t wide, int32_t width, int32_t rows, double* a, const double* min_pivot,
                                             deadline_t* deadline) noexcept nogil:
    """Factor the panel a (rows, width) by (1) in place; return the number of pivots that are too small.

    The pivots after the deadline count as too small. A pivot must exceed min_pivot (width), or, if that is NULL, 1e-15 of its value
    before the last strip. The column of L of a pivot that is too small is zero.
    """
    cdef int32_t j, j0 = 0, t, n, lost = 0, block = 0
    cdef double x
    cdef double diagonal[CHOLESKY_STRIP]
    cdef double* y
    while j0 < width:
        n = CHOLESKY_STRIP if j0 + CHOLESKY_STRIP <= width else width - j0
        # Subtract the earlier columns: first those of earlier blocks, then those of this block.
        if j0 == block + CHOLESKY_BLOCK:
            block = j0
            gemm_subtract_lower(wide, rows - j0, CHOLESKY_BLOCK if j0 + CHOLESKY_BLOCK <= width else width - j0, j0,
                                a + j0, rows, a + j0 + <int64_t>j0 * rows, rows, deadline)
        gemm_subtract_nt(wide, rows - j0, n, j0 - block, a + j0 + <int64_t>block * rows, rows, a + j0 + <int64_t>block * rows,
                         rows, a + j0 + <int64_t>j0 * rows, rows)
        if has_passed_after_product(deadline, rows - j0, n, j0 - block):
            return width - j0
        for j in range(n):
            diagonal[j] = a[(j0 + j) + <int64_t>(j0 + j) * rows]
        # Factor the diagonal block.
        for j in range(j0, j0 + n):
            y = a + <int64_t>j * rows
            for t in range(j0, j):
                axpy_subtract(j0 + n - j, a[j + <int64_t>t * rows], a + j + <int64_t>t * rows, y + j)
            x = y[j]
            if not x > (1e-15 * diagonal[j - j0] if min_pivot == NULL else min_pivot[j]):
                lost += 1
                x = 0.0
            else:
                x = 1.0 / sqrt(x)
            y[j] = x
            for t in range(j + 1, j0 + n):
                y[t] *= x
        # Solve for the rows below.
        y = a + j0 + <int64_t>j0 * rows
        if n == 3:
            solve_three_columns(rows - j0 - 3, y, y + rows, y + 2 * <int64_t>rows)
        else:
            for j in range(n):
                for t in range(j):
                    axpy_subtract(rows - j0 - n, y[j + <int64_t>t * rows], y + n + <int64_t>t * rows, y + n + <int64_t>j * rows)
                for t in range(n, rows - j0):
                    y[t + <int64_t>j * rows] *= y[j + <int64_t>j * rows]
        j0 += CHOLESKY_STRIP
    return lost


cdef inline void gemm_subtract_nonzeros(int32_t wide, int32_t m, int32_t n, int32_t k, const double* a, int64_t lda,
                                        const double* b, double* c, int64_t ldc) noexcept nogil:
    """Subtract A B^T from C (m, n), with B (n, k) of leading dimension n; zeros of B are skipped if they are the majority."""
    cdef int32_t t, j, nonzeros = 0
    for t in range(k * n):
        nonzeros += b[t] != 0.0
    if 2 * nonzeros >= k * n:
        gemm_subtract_nt(wide, m, n, k, a, lda, b, n, c, ldc)
        return
    for j in range(n):
        for t in range(k):
            if b[t * n + j] != 0.0:
                axpy_subtract(m, b[t * n + j], a + t * lda, c + j * ldc)


cdef inline void swap_entries(double* y, int32_t n, const int32_t* swap) noexcept nogil:
    """Exchange y[t] and y[swap[t]] for t = 0 ... n - 1."""
    cdef int32_t t
    cdef double x
    for t in range(n):
        if swap[t] != t:
            x = y[t]
            y[t] = y[swap[t]]
            y[swap[t]] = x


cdef inline int32_t factor_panel_by_lu(int32_t wide, int32_t width, int32_t rows, int32_t candidates, double* a, int64_t lda,
                                       int32_t* swap, double min_pivot, double* scratch, deadline_t* deadline) noexcept nogil:
    """Factor the panel a (rows, width) by (2) in place; return the number of pivots that are too small.

    The pivots after the deadline count as too small. The pivot of a column is its largest entry among the first `candidates` rows,
    whose exchange is written to swap (width). It must be finite and exceed min_pivot; otherwise its column of L is zero. scratch
    has LU_STRIP width doubles.
    """
    cdef int32_t j, j0 = 0, t, n, i, best, lost = 0
    cdef double x, largest
    cdef double* y
    cdef double* z
    while j0 < width:
        n = LU_STRIP if j0 + LU_STRIP <= width else width - j0
        # Exchange the rows of the strip, solve for its rows of U, and subtract the earlier columns.
        for j in range(j0, j0 + n if j0 else 0):
            y = a + j * lda
            swap_entries(y, j0, swap)
            for t in range(j0):
                if y[t] != 0.0:
                    axpy_subtract(j0 - t - 1, y[t], a + (t + 1) + t * lda, y + t + 1)
                scratch[t * n + j - j0] = y[t]
        gemm_subtract_nonzeros(wide, rows - j0, n, j0, a + j0, lda, scratch, a + j0 + j0 * lda, lda)
        if has_passed_after_product(deadline, rows - j0, n, j0):
            return width - j0
        # Factor the strip.
        for j in range(j0, j0 + n):
            y = a + j * lda
            best = j
            largest = fabs(y[j])
            for i in range(j + 1, candidates):
                if fabs(y[i]) > largest:
                    largest = fabs(y[i])
                    best = i
            swap[j] = best
            if best != j:
                for t in range(j0 + n):
                    z = a + t * lda
                    x = z[j]
                    z[j] = z[best]
                    z[best] = x
            if min_pivot < largest < 1.0 / 0.0:
                x = 1.0 / y[j]
            else:
                lost += 1
                x = 0.0
            y[j] = x
            for i in range(j + 1, rows):
                y[i] *= x
            for t in range(j + 1, j0 + n):
                z = a + t * lda
                if z[j] != 0.0:
                    axpy_subtract(rows - j - 1, z[j], y + j + 1, z + j + 1)
        j0 += n
    return lost
