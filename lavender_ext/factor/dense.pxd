"""Dense factorisations: N = L L^T of a symmetric positive definite matrix, and P N^T = L U of any square matrix.

    L_J = (N_J - sum over K before J of L_K L_K^T) L_JJ^-T                                              (1)
    N_22 <- N_22 - L_21 U_12                                                                            (2)

J and K are panels of PANEL_COLUMNS columns. (1) subtracts the earlier panels from a panel before it is factored, (2) subtracts
each panel from all later columns. Every sum has one order, so that all lane widths give the same bits. Pivots of (2) are the
largest entries of their columns.
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.deadline cimport deadline_t
from lavender_ext.core.dot cimport dot
from lavender_ext.factor.panels cimport (LU_STRIP, factor_panel_by_cholesky, gemm_subtract_lower, gemm_subtract_nonzeros,
                                         factor_panel_by_lu, has_passed_after_product, swap_entries)
from lavender_ext.factor.tiles cimport axpy_subtract


cdef enum:
    PANEL_COLUMNS = 48          # Columns of a panel of a dense factor: 48 columns of 300 rows fit the second-level cache.


cdef inline int64_t panel_offset(int32_t n, int32_t k) noexcept nogil:
    """Return the offset of the panel of L that begins with column k; earlier panels have n, n - PANEL_COLUMNS, ... rows."""
    return <int64_t>k * n - <int64_t>PANEL_COLUMNS * (k // PANEL_COLUMNS) * (k // PANEL_COLUMNS - 1) // 2 * PANEL_COLUMNS


cdef inline int32_t dense_cholesky(int32_t wide, int32_t n, const double* a, const double* min_pivot, double* l,
                                   deadline_t* deadline) noexcept nogil:
    """Write the factor (1) of a symmetric a (n, n) to l; return the number of lost pivots.

    l has `cholesky_workspace_size` of `linear.pxd`. The entries of a at and after the diagonal of each row are read. 1 / L_jj
    is stored on the diagonal. A pivot is lost if it does not exceed min_pivot (n); its column of L is zero. If min_pivot is
    NULL, pivots must be positive, and the factorisation ends with the first panel that loses one. It ends at the deadline, too,
    and the other pivots count as lost.
    """
    cdef int32_t k, p, j, t, w, lost = 0
    cdef double zero[PANEL_COLUMNS]
    cdef const double* bound = zero
    cdef double* panel
    for j in range(PANEL_COLUMNS):
        zero[j] = 0.0
    k = 0
    while k < n:
        w = PANEL_COLUMNS if k + PANEL_COLUMNS <= n else n - k
        panel = l + panel_offset(n, k)
        # Copy the columns of the panel.
        for j in range(w):
            for t in range(j, n - k):
                panel[<int64_t>j * (n - k) + t] = a[<int64_t>(k + j) * n + k + t]
            for t in range(j):
                panel[<int64_t>j * (n - k) + t] = 0.0
        # Subtract the earlier panels.
        p = 0
        while p < k:
            gemm_subtract_lower(wide, n - k, w, PANEL_COLUMNS, l + panel_offset(n, p) + (k - p), n - p, panel, n - k,
                                deadline)
            p += PANEL_COLUMNS
        if min_pivot != NULL:
            bound = min_pivot + k
        lost += factor_panel_by_cholesky(wide, w, n - k, panel, bound, deadline)
        if deadline != NULL and deadline.passed:
            return lost + n - k
        if lost and min_pivot == NULL:
            return lost
        k += PANEL_COLUMNS
    return lost


cdef inline void dense_cholesky_solve(int32_t n, const double* l, double* x) noexcept nogil:
    """Overwrite x (n) with N^-1 x after `dense_cholesky`."""
    cdef int32_t k = 0, j, w, rows
    cdef const double* a
    while k < n:
        w = PANEL_COLUMNS if k + PANEL_COLUMNS <= n else n - k
        rows = n - k
        a = l + panel_offset(n, k)
        for j in range(w):
            x[k + j] *= a[j]
            axpy_subtract(rows - j - 1, x[k + j], a + j + 1, x + k + j + 1)
            a += rows
        k += PANEL_COLUMNS
    while k > 0:
        k -= PANEL_COLUMNS
        w = PANEL_COLUMNS if k + PANEL_COLUMNS <= n else n - k
        rows = n - k
        for j in range(w - 1, -1, -1):
            a = l + panel_offset(n, k) + <int64_t>j * rows + j
            x[k + j] = (x[k + j] - dot(a + 1, x + k + j + 1, rows - j - 1)) * a[0]


cdef inline int32_t dense_lu(int32_t wide, int32_t n, double* a, int32_t* swap, double min_pivot,
                             deadline_t* deadline) noexcept nogil:
    """Overwrite N (n, n), row-major, with the factors of P N^T = L U; return the number of lost pivots.

    a then contains L and U by columns, 1 / U_jj on the diagonal, and swap (n) the exchanges. A pivot is lost if it is not finite
    or does not exceed min_pivot; the factorisation ends with the first panel that loses one, or at the deadline.
    """
    cdef int32_t k = 0, j, j0, t, w, columns, lost
    cdef double* y
    cdef double upper[PANEL_COLUMNS * LU_STRIP]
    while k < n:
        w = PANEL_COLUMNS if k + PANEL_COLUMNS <= n else n - k
        lost = factor_panel_by_lu(wide, w, n - k, n - k, a + <int64_t>k * (n + 1), n, swap + k, min_pivot, upper, deadline)
        if lost:
            return lost
        # Exchange the rows of the earlier columns.
        for j in range(k):
            swap_entries(a + <int64_t>j * n + k, w, swap + k)
        # Exchange the rows of the later columns, solve for their rows of U, and subtract (2).
        j0 = k + w
        while j0 < n:
            columns = LU_STRIP if j0 + LU_STRIP <= n else n - j0
            for j in range(columns):
                y = a + <int64_t>(j0 + j) * n + k
                swap_entries(y, w, swap + k)
                for t in range(w):
                    if y[t] != 0.0:
                        axpy_subtract(w - t - 1, y[t], a + <int64_t>(k + t) * n + k + t + 1, y + t + 1)
                    upper[t * columns + j] = y[t]
            gemm_subtract_nonzeros(wide, n - k - w, columns, w, a + <int64_t>k * n + k + w, n, upper,
                                   a + <int64_t>j0 * n + k + w, n)
            if has_passed_after_product(deadline, n - k - w, columns, w):
                return n - k
            j0 += columns
        for t in range(k, k + w):
            swap[t] += k
        k += w
    return 0


cdef inline void dense_lu_solve(int32_t n, const double* a, const int32_t* swap, double* x) noexcept nogil:
    """Overwrite x (n) with N^-1 x after `dense_lu`: solve U^T y = x, then L^T z = y; the result is P^T z."""
    cdef int32_t k
    cdef double t
    for k in range(n):
        x[k] = (x[k] - dot(a + <int64_t>k * n, x, k)) * a[<int64_t>k * (n + 1)]
    for k in range(n - 1, -1, -1):
        x[k] -= dot(a + <int64_t>k * n + k + 1, x + k + 1, n - k - 1)
    for k in range(n - 1, -1, -1):
        t = x[k]
        x[k] = x[swap[k]]
        x[swap[k]] = t


cdef inline void dense_lu_solve_transposed(int32_t n, const double* a, const int32_t* swap, double* x) noexcept nogil:
    """Overwrite x (n) with N^-T x after `dense_lu`: apply P, then solve with L and U."""
    cdef int32_t k
    swap_entries(x, n, swap)
    for k in range(n):
        axpy_subtract(n - k - 1, x[k], a + <int64_t>k * n + k + 1, x + k + 1)
    for k in range(n - 1, -1, -1):
        x[k] *= a[<int64_t>k * (n + 1)]
        axpy_subtract(k, x[k], a + <int64_t>k * n, x)
