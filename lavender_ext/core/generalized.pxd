"""Generalised coordinates: J (m, nv) and M (nv, nv), represented by the factor of M and the whitened Jacobian Y.

    M = L^T D L, the factor of `core/tree.pxd`                                                              (1)
    Y = J L^-1 D^-1/2,   J M^-1 J^T = Y Y^T                                                                 (2)
    w = J x + compliance lambda - b,   M x = J^T lambda                                                     (3)

A row of Y has entries in the columns of its row of J and in their ancestors in the elimination tree of (1). Consecutive rows
with the same columns form a panel: one list of columns, values stored row by row.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, uint64_t

from lavender_ext.core.bits cimport lowest
from lavender_ext.core.dot cimport dot
from lavender_ext.core.tree cimport solve_tree_factor, axpy_subtract, axpy_subtract_2
from lavender_ext.core.view cimport generalized_t


cdef enum:
    PANEL_ROWS = 16             # A panel has at most this many rows, unless a single block has more.
    # The entries of x on the columns of a panel are copied to a contiguous array if the panel has at most this many columns
    # and more than two rows.
    MAX_GATHERED_COLUMNS = 64


cdef inline void solve_mass_matrix(const generalized_t* g, double* x) noexcept nogil:
    """Overwrite x (n) with M^-1 x."""
    solve_tree_factor(g.n, g.lptr, g.lidx, g.lval, g.inv_pivot, x)


# -- J ---------------------------------------------------------------------------------------------------


cdef inline void multiply_jacobian_transpose(const generalized_t* g, const double* lam, double* x) noexcept nogil:
    """Compute x (n) = J^T lam."""
    cdef int32_t i, q, first, end, m = g.m
    cdef const int32_t* jptr = g.jptr
    cdef const int32_t* jidx = g.jidx
    cdef const double* jval = g.jval
    cdef double s
    for i in range(g.n):
        x[i] = 0.0
    for i in range(m):
        s = lam[i]
        if s != 0.0:
            first = jptr[i]
            end = jptr[i + 1]
            for q in range(first, end):
                x[jidx[q]] += jval[q] * s


cdef inline double multiply_jacobian_row(const generalized_t* g, int32_t i, const double* x) noexcept nogil:
    """Return row i of J times x."""
    cdef int32_t q, first = g.jptr[i], end = g.jptr[i + 1]
    cdef const int32_t* jidx = g.jidx
    cdef const double* jval = g.jval
    cdef double s = 0.0
    for q in range(first, end):
        s += jval[q] * x[jidx[q]]
    return s


# -- Y ---------------------------------------------------------------------------------------------------


cdef inline int32_t collect_panel_columns(const generalized_t* g, int32_t first, int32_t last, int32_t stamp, int32_t previous,
                                    int32_t* mark, int32_t* out, int32_t* same) noexcept nogil:
    """List the columns of Y in rows [first, last), unsorted, in out (n); return their number.

    The columns are marked with `stamp`. `same` receives the number of them that were marked `previous`.
    """
    cdef int32_t q, k, count = 0, n_same = 0
    for q in range(g.jptr[last] - 1, g.jptr[first] - 1, -1):
        k = g.jidx[q]
        while k >= 0 and mark[k] != stamp:
            n_same += mark[k] == previous
            mark[k] = stamp
            out[count] = k
            count += 1
            k = g.parent[k]
    same[0] = n_same
    return count


cdef inline void sort_descending_runs(int32_t* x, int32_t n) noexcept nogil:
    """Sort x (n) ascending; x should consist of a few descending runs."""
    cdef int32_t i, j, t
    for i in range(n // 2):
        t = x[i]
        x[i] = x[n - 1 - i]
        x[n - 1 - i] = t
    for i in range(1, n):
        t = x[i]
        j = i - 1
        while j >= 0 and x[j] > t:
            x[j + 1] = x[j]
            j -= 1
        x[j + 1] = t


cdef inline int32_t find_panel_pattern_by_bits(const generalized_t* g, int32_t n_blocks, const int32_t* ptr, uint64_t* ancestors,
                               int32_t* prow, int32_t* pcol, int32_t* pval, int32_t* cols, int32_t workspace,
                               int32_t* n_cols, double* n_values) noexcept nogil:
    """Compute `find_panel_pattern` for at most 64 velocities, with column sets as bits; ancestors (n) is scratch."""
    cdef int32_t i, q, k, first, last, count = 0, previous_entries = -1, at = 0, n = 0, nv = g.n, end, entries, differs
    cdef const int32_t* jptr = g.jptr
    cdef const int32_t* jidx = g.jidx
    cdef const int32_t* parent = g.parent
    cdef uint64_t columns = 0, panel_columns = 0, remaining
    cdef double values = 0.0
    prow[0] = 0
    pcol[0] = 0
    pval[0] = 0
    # each column and its ancestors, which come before it
    for k in range(nv):
        ancestors[k] = <uint64_t>1 << k
        if parent[k] >= 0:
            ancestors[k] |= ancestors[parent[k]]
    for i in range(n_blocks):
        first = ptr[i]
        last = ptr[i + 1]
        end = jptr[last]
        entries = end - jptr[first]
        # zero if the block has the same columns as the previous block
        differs = entries - previous_entries
        for q in range(jptr[first], end if differs == 0 else 0):
            differs |= jidx[q] ^ jidx[q - entries]
        if differs:
            columns = 0
            for q in range(jptr[first], end):
                columns |= ancestors[jidx[q]]
        previous_entries = entries
        if n > 0 and columns == panel_columns and last - prow[n - 1] <= PANEL_ROWS:
            prow[n] = last                              # append to the panel
        else:
            if at + nv > workspace:
                return -1
            count = 0
            remaining = columns
            while remaining:
                cols[at + count] = lowest(remaining)
                count += 1
                remaining &= remaining - 1
            at += count
            panel_columns = columns
            n += 1
            prow[n] = last
            pcol[n] = at
        values += <double>count * (last - first)
        pval[n] = pval[n - 1] + count * (last - prow[n - 1])
        if values >= 2147483647.0:
            break
    n_cols[0] = at
    n_values[0] = values
    return n


cdef inline int32_t find_panel_pattern(const generalized_t* g, int32_t n_blocks, const int32_t* ptr, int32_t* mark,
                                  int32_t* prow, int32_t* pcol, int32_t* pval, int32_t* cols, int32_t workspace,
                                  int32_t* n_cols, double* n_values) noexcept nogil:
    """Group consecutive blocks with the same columns of Y into panels; return the number of panels.

    The result is -1 if `workspace` columns do not suffice. mark (2 n) is scratch, aligned to 8 bytes. n_cols and n_values
    receive the number of columns of all panels and the number of values of Y.
    """
    cdef int32_t i, first, last, count, same, previous = -1, panel_columns = 0, at = 0, n = 0, stamp = 0
    cdef int32_t* out = mark + g.n
    if g.n <= 64:
        return find_panel_pattern_by_bits(g, n_blocks, ptr, <uint64_t*>mark, prow, pcol, pval, cols, workspace, n_cols, n_values)
    n_values[0] = 0.0
    prow[0] = 0
    pcol[0] = 0
    pval[0] = 0
    for i in range(g.n):
        mark[i] = -1
    for i in range(n_blocks):
        first = ptr[i]
        last = ptr[i + 1]
        count = collect_panel_columns(g, first, last, stamp, previous, mark, out, &same)
        n_values[0] += <double>count * (last - first)
        if n > 0 and count == panel_columns and same == count and last - prow[n - 1] <= PANEL_ROWS:
            prow[n] = last                                  # append to the panel
        else:
            if at + count > workspace:
                return -1
            sort_descending_runs(out, count)
            for same in range(count):
                cols[at + same] = out[same]
            at += count
            panel_columns = count
            n += 1
            prow[n] = last
            pcol[n] = at
        pval[n] = pval[n - 1] + count * (last - prow[n - 1])
        if n_values[0] >= 2147483647.0:
            break
        previous = stamp
        stamp += 1
    n_cols[0] = at
    return n


cdef inline void whiten_panel(const generalized_t* g, int32_t panel, int32_t* place, double* y) noexcept nogil:
    """Compute the rows of Y of one panel: solve L^T y = J^T on its columns, then scale by D^-1/2. place (n) is scratch."""
    cdef int32_t first = g.prow[panel], rows = g.prow[panel + 1] - first, c0 = g.pcol[panel]
    cdef int32_t nc = g.pcol[panel + 1] - c0, a, k, q, i, _i, p, count, end, before
    cdef const int32_t* cols = g.cols + c0
    cdef const int32_t* jptr = g.jptr + first
    cdef const int32_t* jidx = g.jidx
    cdef const double* jval = g.jval
    cdef const int32_t* lptr = g.lptr
    cdef const int32_t* lidx
    cdef const double* l
    cdef const double* u
    cdef const double* root = g.root
    cdef double z, top, low
    cdef double* x
    for a in range(nc):
        place[cols[a]] = a
    for i in range(rows * nc):
        y[i] = 0.0
    for i in range(rows):
        x = y + i * nc
        end = jptr[i + 1]
        for q in range(jptr[i], end):
            x[place[jidx[q]]] = jval[q]
    a = nc - 1
    while a >= 0:
        k = cols[a]
        before = lptr[k]
        count = lptr[k + 1] - before
        l = g.lval + before
        z = root[k]
        x = y
        if count == a > 0 and lptr[cols[a - 1] + 1] - lptr[cols[a - 1]] == a - 1:
            # two dense columns at once, with the same bits as one after the other
            a -= 1
            u = g.lval + lptr[cols[a]]
            for _i in range(rows):
                top = x[a + 1]
                low = x[a] - l[a] * top
                axpy_subtract_2(x, l, top, u, low, a)
                x[a + 1] = top * z
                x[a] = low * root[cols[a]]
                x += nc
        elif count == a:
            for _i in range(rows):
                axpy_subtract(x, l, x[a], a)
                x[a] *= z
                x += nc
        else:
            lidx = g.lidx + before
            for _i in range(rows):
                if x[a] != 0.0:
                    for p in range(count):
                        x[place[lidx[p]]] -= l[p] * x[a]
                    x[a] *= z
                x += nc
        a -= 1


cdef inline double indexed_dot(const double* y, const int32_t* cols, const double* x, int32_t n) noexcept nogil:
    """Return sum_a y_a x[cols_a] in two running sums, with the bits of `contiguous_dot`."""
    cdef int32_t a = 0
    cdef double s0 = 0.0, s1 = 0.0
    while a + 2 <= n:
        s0 += y[a] * x[cols[a]]
        s1 += y[a + 1] * x[cols[a + 1]]
        a += 2
    if a < n:
        s0 += y[a] * x[cols[a]]
    return s0 + s1


cdef inline double contiguous_dot(const double* y, const double* x, int32_t n) noexcept nogil:
    """Return y^T x of contiguous vectors, with the bits of `indexed_dot`."""
    cdef int32_t a = 0
    cdef double s0 = 0.0, s1 = 0.0
    while a + 2 <= n:
        s0 += y[a] * x[a]
        s1 += y[a + 1] * x[a + 1]
        a += 2
    if a < n:
        s0 += y[a] * x[a]
    return s0 + s1


cdef inline void multiply_whitened_panel(const generalized_t* g, int32_t panel, const double* x, double* out) noexcept nogil:
    """Compute out (m) = Y x on the rows of a panel."""
    cdef int32_t i, first = g.prow[panel], end = g.prow[panel + 1], nc = g.pcol[panel + 1] - g.pcol[panel]
    cdef const int32_t* cols = g.cols + g.pcol[panel]
    cdef const double* y = g.y + g.pval[panel]
    cdef double gathered[MAX_GATHERED_COLUMNS]
    if end - first > 2 and nc <= MAX_GATHERED_COLUMNS:
        for i in range(nc):
            gathered[i] = x[cols[i]]
        for i in range(first, end):
            out[i] = contiguous_dot(y, gathered, nc)
            y += nc
        return
    for i in range(first, end):
        out[i] = indexed_dot(y, cols, x, nc)
        y += nc


cdef inline double whitened_row_dot(const generalized_t* g, int32_t panel, int32_t row, const double* x) noexcept nogil:
    """Return Y_row x, with the bits of `multiply_whitened_panel`."""
    cdef int32_t nc = g.pcol[panel + 1] - g.pcol[panel]
    return indexed_dot(g.y + g.pval[panel] + <ssize_t>(row - g.prow[panel]) * nc, g.cols + g.pcol[panel], x, nc)


cdef inline void add_scaled_whitened_row(const generalized_t* g, int32_t panel, int32_t row, double change,
                                         double* x) noexcept nogil:
    """Add Y_row^T change to x (n)."""
    cdef int32_t a, nc = g.pcol[panel + 1] - g.pcol[panel]
    cdef const int32_t* cols = g.cols + g.pcol[panel]
    cdef const double* y = g.y + g.pval[panel] + <ssize_t>(row - g.prow[panel]) * nc
    if change != 0.0:
        for a in range(nc):
            x[cols[a]] += y[a] * change


cdef inline void multiply_whitened_transpose(const generalized_t* g, const double* lam, double* x) noexcept nogil:
    """Compute x (n) = Y^T lam."""
    cdef int32_t a
    for a in range(g.n):
        x[a] = 0.0
    for a in range(g.n_panels):
        add_panel_transpose_product(g, a, lam, x)


cdef inline void add_panel_transpose_product(const generalized_t* g, int32_t panel, const double* lam, double* x) noexcept nogil:
    """Add Y^T lam of the rows of a panel to x (n)."""
    cdef int32_t i, a, first = g.prow[panel], end = g.prow[panel + 1], nc = g.pcol[panel + 1] - g.pcol[panel]
    cdef const int32_t* cols = g.cols + g.pcol[panel]
    cdef const double* y = g.y + g.pval[panel]
    cdef double gathered[MAX_GATHERED_COLUMNS]
    if end - first > 2 and nc <= MAX_GATHERED_COLUMNS:
        while first < end and lam[first] == 0.0:
            first += 1
            y += nc
        if first == end:
            return
        for a in range(nc):
            gathered[a] = x[cols[a]]
        for i in range(first, end):
            if lam[i] != 0.0:
                axpy_add(gathered, y, lam[i], nc)
            y += nc
        for a in range(nc):
            x[cols[a]] = gathered[a]
        return
    for i in range(first, end):
        if lam[i] != 0.0:
            for a in range(nc):
                x[cols[a]] += y[a] * lam[i]
        y += nc


cdef inline void axpy_add(double* x, const double* y, double z, int32_t n) noexcept nogil:
    """Add z y to x (n)."""
    cdef int32_t i
    for i in range(n):
        x[i] += y[i] * z


cdef inline void add_abs_panel_transpose_product(const generalized_t* g, int32_t panel, const double* lam,
                                                 double* x) noexcept nogil:
    """Add |Y|^T |lam| of the rows of a panel to x (n)."""
    cdef int32_t i, a, first = g.prow[panel], end = g.prow[panel + 1], nc = g.pcol[panel + 1] - g.pcol[panel]
    cdef const int32_t* cols = g.cols + g.pcol[panel]
    cdef const double* y = g.y + g.pval[panel]
    for i in range(first, end):
        if lam[i] != 0.0:
            for a in range(nc):
                x[cols[a]] += fabs(y[a] * lam[i])
        y += nc


cdef inline void multiply_abs_whitened_panel(const generalized_t* g, int32_t panel, const double* x, double* out) noexcept nogil:
    """Compute out (m) = |Y| x on the rows of a panel, for x >= 0."""
    cdef int32_t i, a, first = g.prow[panel], end = g.prow[panel + 1], nc = g.pcol[panel + 1] - g.pcol[panel]
    cdef const int32_t* cols = g.cols + g.pcol[panel]
    cdef const double* y = g.y + g.pval[panel]
    cdef double s
    for i in range(first, end):
        s = 0.0
        for a in range(nc):
            s += fabs(y[a]) * x[cols[a]]
        out[i] = s
        y += nc


# -- the condition of M ------------------------------------------------------------------------------


cdef inline double estimate_condition(const generalized_t* g, double* x) noexcept nogil:
    """Estimate |H^-1| of H = M scaled to a unit diagonal, from two solves with the factor of M.

    The result is a lower bound of |H^-1|, in general within a factor of 3, and at least 1. The first solve has a right-hand
    side of +-1 chosen to make L^-T times it large (Cline, Moler, Stewart and Wilkinson 1979). The second measures by how much
    H^-1 stretches the result of the first. x (2 n) is scratch.
    """
    cdef int32_t i, q, n = g.n
    cdef double* s = x + n                              # S^-1
    cdef double first, second
    for i in range(n):
        s[i] = sqrt(g.mval[g.mptr[i + 1] - 1])
        x[i] = 0.0
    for i in range(n - 1, -1, -1):                      # L^T z = S^-1 (+-1)
        x[i] += s[i] if x[i] >= 0.0 else -s[i]
        for q in range(g.lptr[i], g.lptr[i + 1]):
            x[g.lidx[q]] -= g.lval[q] * x[i]
    for i in range(n):                                  # D, then L x = z
        x[i] *= g.inv_pivot[i]
        for q in range(g.lptr[i], g.lptr[i + 1]):
            x[i] -= g.lval[q] * x[g.lidx[q]]
    for i in range(n):
        x[i] *= s[i]
    first = sqrt(dot(x, x, n))
    if not 0.0 < first < 1.0 / 0.0:
        return 1.0 / 0.0 if n else 1.0
    for i in range(n):
        x[i] = s[i] * (x[i] / first)
    solve_mass_matrix(g, x)
    for i in range(n):
        x[i] *= s[i]
    second = sqrt(dot(x, x, n))
    first = first / sqrt(<double>n)
    if not second > first:
        second = first
    return second if second > 1.0 else 1.0


cdef inline double get_condition(const generalized_t* g, double* x) noexcept nogil:
    """Return the estimate stored with the factor, or a new one; x (2 n) is scratch."""
    return g.condition if g.condition > 0.0 else estimate_condition(g, x)


cdef inline double bound_condition_by_determinant(const generalized_t* g) noexcept nogil:
    """Return the upper bound e / det H of |H^-1|, which follows from trace H = n and is very loose for large n."""
    cdef int32_t i
    cdef double det = 1.0
    for i in range(g.n):
        det *= g.inv_pivot[i] * g.mval[g.mptr[i + 1] - 1]
    return 2.72 * det


cdef class Operator:
    cdef generalized_t g                # without panels and compliance
    cdef readonly int failed            # the row of M with a pivot that is not positive, or -1
    cdef readonly object jac            # (indptr, indices, data) of J
    cdef readonly object mass           # the same of the lower triangle of M
    cdef list keep

    cdef bint has_pattern(self, int32_t n, const int32_t* mptr, const int32_t* midx)
