"""Factorisation of a symmetric matrix M (n, n) with an elimination graph that is a tree or nearly one.

    M = L^T D L, L unit lower triangular. Row k is eliminated into the rows before it, k = n - 1 ... 0: each leaf of a
    kinematic tree is eliminated before its ancestors, and there is no fill-in (Featherstone 2008, section 6.5)     (1)

The mass matrix of a problem and the normal matrix of Newton's method over its velocities are factored by `factor_tree_matrix`.
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy

from lavender_ext.core.deadline cimport deadline_t, entry_cost, has_passed
from lavender_ext.core.tree_solve cimport axpy_subtract, axpy_subtract_2
from lavender_ext.core.validate cimport min_magnitude


cdef enum:
    MAX_CHAIN_ROWS = 8          # maximum number of rows of a chain that are eliminated together
    MIN_COLUMNS_FOR_FOUR = 16   # Four rows are subtracted at once if they have at least this many columns, otherwise two.


cdef inline void sort_row_columns(int32_t k, const int32_t* mark, int32_t count, int32_t* cols) noexcept nogil:
    """Sort cols (count), the columns of row k, in ascending order; mark[j] is k for these columns and no other j < k.

    The columns are sorted by insertion, or collected by scanning the marks if that is cheaper.
    """
    cdef int32_t i = 1, j, x, first
    while i < count and cols[i - 1] < cols[i]:              # Rows of a tree are already sorted.
        i += 1
    if i >= count:
        return
    first = cols[0]
    for j in range(i, count):
        first = min(first, cols[j])
    if <int64_t>count * count > 4 * <int64_t>(k - first):   # The left side estimates the cost of insertion.
        i = 0
        for j in range(first, k):
            if mark[j] == k:
                cols[i] = j
                i += 1
        return
    while i < count:
        x = cols[i]
        j = i - 1
        while j >= 0 and cols[j] > x:
            cols[j + 1] = cols[j]
            j -= 1
        cols[j + 1] = x
        i += 1


cdef inline int32_t find_tree_factor_pattern(int32_t n, const int32_t* mptr, const int32_t* midx, int32_t workspace,
                                             int32_t* lptr, int32_t* lidx, int32_t* parent, int32_t* mark, int32_t* next_child,
                                             int32_t* first_child) noexcept nogil:
    """Compute the pattern of L from the lower triangle of M; return the number of entries, -1 if `workspace` is too small.

    Rows are computed from the last to the first. Row k has the entries of row k of M and those that the elimination of the
    rows with last column k adds. Rows are written from the end of `lidx` backwards, and finally moved to its front.
    """
    cdef int32_t k, q, c, j, at = workspace, start, end
    for k in range(n):
        mark[k] = first_child[k] = -1
    for k in range(n - 1, -1, -1):
        end = at
        mark[k] = k
        for q in range(mptr[k + 1] - 1, mptr[k] - 1, -1):   # backwards, so that the row becomes ascending
            j = midx[q]
            if j < k and mark[j] != k:
                mark[j] = k
                at -= 1
                if at < 0:
                    return -1
                lidx[at] = j
        c = first_child[k]
        while c >= 0:
            for q in range(lptr[c] + parent[c] - 1, lptr[c] - 1, -1):   # parent holds the row length until the end
                j = lidx[q]
                if mark[j] != k:
                    mark[j] = k
                    at -= 1
                    if at < 0:
                        return -1
                    lidx[at] = j
            c = next_child[c]
        start = at
        sort_row_columns(k, mark, end - start, lidx + start)
        lptr[k] = start
        parent[k] = end - start
        if end > start:
            j = lidx[end - 1]
            next_child[k] = first_child[j]
            first_child[j] = k
    for k in range(n):
        lptr[k] -= at
    lptr[n] = workspace - at
    for q in range(at, workspace):
        lidx[q - at] = lidx[q]
    for k in range(n):
        parent[k] = lidx[lptr[k + 1] - 1] if lptr[k + 1] > lptr[k] else -1
    return lptr[n]


cdef inline int32_t factor_tree(int32_t n, const int32_t* mptr, const int32_t* midx, const double* mval, const int32_t* lptr,
                                const int32_t* lidx, double* lval, double* pivot, double* inv_pivot) noexcept nogil:
    """Compute L and 1 / D of (1) for a mass matrix; return -1, or the row of a pivot that is too small."""
    cdef int32_t k, q, j, first, count, at
    # copy M into the pattern of L
    for k in range(n):
        at = lptr[k]
        first = mptr[k]
        count = mptr[k + 1] - first - 1
        if lptr[k + 1] - at == count >= 0 and midx[first + count] == k:     # no fill-in
            memcpy(lval + at, mval + first, count * sizeof(double))
            pivot[k] = inv_pivot[k] = mval[first + count]   # M_kk, until its row is eliminated
            continue
        pivot[k] = inv_pivot[k] = 0.0
        for q in range(at, lptr[k + 1]):
            lval[q] = 0.0
        for q in range(first, mptr[k + 1]):
            j = midx[q]
            if j == k:
                pivot[k] = inv_pivot[k] = mval[q]
            elif j < k:
                while lidx[at] != j:
                    at += 1
                lval[at] = mval[q]
    # A pivot must exceed four roundings of M_kk.
    return factor_tree_matrix(n, lptr, lidx, lval, pivot, inv_pivot, 8.8817841970012523e-16, NULL)


cdef inline int32_t factor_tree_matrix(int32_t n, const int32_t* lptr, const int32_t* lidx, double* lval, double* pivot,
                                       double* inv_pivot, double min_pivot, deadline_t* deadline) noexcept nogil:
    """Overwrite M in the pattern of L with L, D and 1 / D of (1); return -1, or the row of a pivot that is too small.

    At the deadline, the row that comes next is returned.

    lptr indexes both lidx and lval. `pivot` and `inv_pivot` contain the diagonal of M. A pivot is too small if it is at most
    `min_pivot` M_kk, or below `min_magnitude`. Consecutive rows of a chain, which have the same columns except themselves,
    are eliminated together. This gives the same bits as one after the other with less memory traffic.
    """
    cdef int32_t k = n - 1, a, first, count, s, t
    cdef double* row[MAX_CHAIN_ROWS]
    # eliminate chains of rows from the last
    while k >= 0:
        first, count, s = lptr[k], lptr[k + 1] - lptr[k], 1
        while s < MAX_CHAIN_ROWS and s <= count and lidx[first + count - s] == k - s and lptr[k - s + 1] - lptr[k - s] == count - s:
            s += 1
        for t in range(s):
            row[t] = lval + lptr[k - t]
        # rows of the chain among each other
        for t in range(s):
            eliminate_chain_rows(lptr, lidx, lval, pivot, inv_pivot, k, k - t, count - t, row, t)
            if not (pivot[k - t] > min_pivot * inv_pivot[k - t] and pivot[k - t] >= min_magnitude()):
                return k - t
            inv_pivot[k - t] = 1.0 / pivot[k - t]           # It has held M_kk until now.
        # the other rows
        for a in range(count - s, -1, -1):
            eliminate_chain_rows(lptr, lidx, lval, pivot, inv_pivot, k, lidx[first + a], a, row, s)
        # 2.92 ns: a multiply-add of a factor over velocities, "sparse velocities" of the rates.
        if deadline != NULL and has_passed(deadline, 0.5 * s * count * (entry_cost() + 2.92 * count)):
            return k
        k -= s
    return -1


cdef inline void eliminate_chain_rows(const int32_t* lptr, const int32_t* lidx, double* lval, double* pivot,
                                      const double* inv_pivot, int32_t k, int32_t j, int32_t count, double** row,
                                      int32_t s) noexcept nogil:
    """Eliminate the s rows k, k - 1 ... of a chain from row j, which is their column number `count`.

    Their `count` columns before that one are subtracted from row j.
    """
    cdef int32_t b, t, at = lptr[j], first = lptr[k]
    cdef double x
    cdef double z[MAX_CHAIN_ROWS]
    cdef bint are_zero = True
    for t in range(s):
        are_zero = are_zero and row[t][count] == 0.0
    if are_zero:                                            # Rows of contacts that do not push have no entries.
        return
    for t in range(s):
        z[t] = row[t][count] * inv_pivot[k - t]
        pivot[j] -= z[t] * row[t][count]
    if count > 0:
        while lidx[at] != lidx[first]:
            at += 1
    if lptr[j + 1] - at == count:                           # Row j has exactly these columns.
        subtract_row_combination(lval + at, row, z, s, count)
    else:
        for b in range(count):
            while lidx[at] != lidx[first + b]:
                at += 1
            x = lval[at]
            for t in range(s):
                x -= z[t] * row[t][b]
            lval[at] = x
    for t in range(s):
        row[t][count] = z[t]


cdef inline void subtract_row_combination(double* x, double** row, const double* z, int32_t s, int32_t n) noexcept nogil:
    """Subtract z_0 row_0 + z_1 row_1 + ... (s rows) from x (n)."""
    cdef int32_t t = 0
    while t + 4 <= s and n >= MIN_COLUMNS_FOR_FOUR:
        axpy_subtract_4(x, row[t], z[t], row[t + 1], z[t + 1], row[t + 2], z[t + 2], row[t + 3], z[t + 3], n)
        t += 4
    while t + 2 <= s:
        axpy_subtract_2(x, row[t], z[t], row[t + 1], z[t + 1], n)
        t += 2
    if t < s:
        axpy_subtract(x, row[t], z[t], n)


cdef inline void axpy_subtract_4(double* x, const double* l, double f, const double* u, double g, const double* v, double h,
                                 const double* w, double k, int32_t n) noexcept nogil:
    """Subtract f l, g u, h v, then k w from x (n)."""
    cdef int32_t i
    for i in range(n):
        x[i] = (((x[i] - f * l[i]) - g * u[i]) - h * v[i]) - k * w[i]
