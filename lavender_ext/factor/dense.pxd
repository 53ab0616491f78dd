"""Dense factors by tiles: N = L L^T in panels of columns, and P N^T = L U of a matrix that is not symmetric.

    L_J = (N_J - sum over K before J of L_K L_K^T) L_JJ^-T                                              (1)
    N_22 <- N_22 - L_21 U_12                                                                            (2)

(1) takes the earlier panels from one before it is finished (`supernodal.pxd`), (2) goes ahead with every panel. Sums
run in one order at every width: the same bits everywhere.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.dot cimport dot
from lavender_ext.factor.supernodal cimport dense_panel, less_lower
from lavender_ext.factor.tiles cimport less, take


cdef enum:
    PANEL = 48                  # columns


cdef inline int64_t panel_at(int32_t n, int32_t k) noexcept nogil:
    # first value of the panel that begins with column k: earlier ones are PANEL columns of n, n - PANEL, ... rows
    return <int64_t>k * n - <int64_t>PANEL * (k // PANEL) * (k // PANEL - 1) // 2 * PANEL


cdef inline int64_t cholesky_workspace_size(int32_t n) noexcept nogil:
    """Values of L in its panels."""
    cdef int32_t k = n - 1 - (n - 1) % PANEL if n > 0 else 0
    return panel_at(n, k) + <int64_t>(n - k) * (n - k)


cdef inline int32_t dense_cholesky(int32_t wide, int32_t n, const double* a, const double* least, double* l) noexcept nogil:
    """(1) of a symmetric a (n, n) into l (`cholesky_workspace_size`), 1 / L_jj on its diagonal; how many pivots are lost.

    These are not above least (n) and leave a column of zeros; where that is NULL, not positive, and the first is the last.
    """
    cdef int32_t k, p, j, t, w, lost = 0
    cdef double zero[PANEL]
    cdef const double* bar = zero
    cdef double* to
    for j in range(PANEL):
        zero[j] = 0.0
    k = 0
    while k < n:
        w = PANEL if k + PANEL <= n else n - k
        to = l + panel_at(n, k)
        for j in range(w):
            for t in range(j, n - k):
                to[<int64_t>j * (n - k) + t] = a[<int64_t>(k + j) * n + k + t]
            for t in range(j):
                to[<int64_t>j * (n - k) + t] = 0.0
        p = 0
        while p < k:
            less_lower(wide, n - k, w, PANEL, l + panel_at(n, p) + (k - p), n - p, to, n - k)
            p += PANEL
        if least != NULL:
            bar = least + k
        lost += dense_panel(wide, w, n - k, to, bar)
        if lost and least == NULL:
            return lost
        k += PANEL
    return lost


cdef inline void dense_cholesky_solve(int32_t n, const double* l, double* x) noexcept nogil:
    """x <- N^-1 x after `dense_cholesky`."""
    cdef int32_t k = 0, j, w, rows
    cdef const double* a
    while k < n:
        w = PANEL if k + PANEL <= n else n - k
        rows = n - k
        a = l + panel_at(n, k)
        for j in range(w):
            x[k + j] *= a[j]
            take(rows - j - 1, x[k + j], a + j + 1, x + k + j + 1)
            a += rows
        k += PANEL
    while k > 0:
        k -= PANEL
        w = PANEL if k + PANEL <= n else n - k
        rows = n - k
        for j in range(w - 1, -1, -1):
            a = l + panel_at(n, k) + <int64_t>j * rows + j
            x[k + j] = (x[k + j] - dot(a + 1, x + k + j + 1, rows - j - 1)) * a[0]


cdef inline int32_t lu_panel(int32_t n, int32_t k, int32_t w, double* a, int32_t* swap) noexcept nogil:
    # columns k to k + w, the largest pivot of each; rows are exchanged inside the panel alone
    cdef int32_t i, j, t, best
    cdef double x, big
    cdef double* y
    for j in range(k, k + w):
        y = a + <int64_t>j * n
        for t in range(k, j):
            take(n - t - 1, y[t], a + <int64_t>t * n + t + 1, y + t + 1)
        best = j
        big = fabs(y[j])
        for i in range(j + 1, n):
            if fabs(y[i]) > big:
                big = fabs(y[i])
                best = i
        swap[j] = best
        if not 0.0 < big < 1.0 / 0.0:
            return 0
        if best != j:
            for t in range(k, k + w):
                x = a[<int64_t>t * n + j]
                a[<int64_t>t * n + j] = a[<int64_t>t * n + best]
                a[<int64_t>t * n + best] = x
        x = 1.0 / y[j]
        for i in range(j + 1, n):
            y[i] *= x
    return 1


cdef inline int32_t dense_lu(int32_t wide, int32_t n, double* a, int32_t* swap, double* workspace) noexcept nogil:
    """P N^T = L U in place of N (n, n), row-major, that is N^T by columns; workspace (PANEL n); 0 where a pivot is lost."""
    cdef int32_t k = 0, j, t, w, rest
    cdef double x
    cdef double* y
    while k < n:
        w = PANEL if k + PANEL <= n else n - k
        if not lu_panel(n, k, w, a, swap):
            return 0
        rest = n - k - w
        for j in range(n):
            if k <= j < k + w:
                continue
            y = a + <int64_t>j * n
            for t in range(k, k + w):
                if swap[t] != t:
                    x = y[t]
                    y[t] = y[swap[t]]
                    y[swap[t]] = x
            if j > k:
                for t in range(k, k + w):
                    take(k + w - t - 1, y[t], a + <int64_t>t * n + t + 1, y + t + 1)
                    workspace[<int64_t>(t - k) * rest + (j - k - w)] = y[t]
        if rest > 0:
            less(wide, rest, rest, w, a + <int64_t>k * n + k + w, n, workspace, rest, a + <int64_t>(k + w) * n + k + w, n)
        k += w
    return 1


cdef inline void dense_lu_solve(int32_t n, const double* a, const int32_t* swap, double* x) noexcept nogil:
    """x <- N^-1 x after `dense_lu`: U^T y = x, L^T z = y, x = P^T z."""
    cdef int32_t k
    cdef double t
    for k in range(n):
        x[k] = (x[k] - dot(a + <int64_t>k * n, x, k)) / a[<int64_t>k * n + k]
    for k in range(n - 1, -1, -1):
        x[k] -= dot(a + <int64_t>k * n + k + 1, x + k + 1, n - k - 1)
    for k in range(n - 1, -1, -1):
        t = x[k]
        x[k] = x[swap[k]]
        x[swap[k]] = t


cdef inline void dense_lu_solve_back(int32_t n, const double* a, const int32_t* swap, double* x) noexcept nogil:
    """x <- N^-T x after `dense_lu`: P, L, U."""
    cdef int32_t k
    cdef double t
    for k in range(n):
        t = x[k]
        x[k] = x[swap[k]]
        x[swap[k]] = t
    for k in range(n):
        take(n - k - 1, x[k], a + <int64_t>k * n + k + 1, x + k + 1)
    for k in range(n - 1, -1, -1):
        x[k] /= a[<int64_t>k * n + k]
        take(k, x[k], a + <int64_t>k * n, x)
