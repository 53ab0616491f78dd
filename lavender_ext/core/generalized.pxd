"""Generalised coordinates: J (m, nv) and M (nv, nv), known by the factor of M and by the whitened Jacobian.

    M = L^T D L, the factor of `core/tree.pxd`                                                              (1)
    Y = J L^-1 D^-1/2,   J M^-1 J^T = Y Y^T                                                                 (2)
    w = J x + compliance lambda - b,   M x = J^T lambda                                                     (3)

A row of Y has entries in the columns of its row of J and in their ancestors, the rows that (1) reaches from them.
Rows that stand together and reach the same columns share a panel: one list of columns, values row by row.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, uint64_t

from lavender_ext.core.bits cimport lowest
from lavender_ext.core.dot cimport dot
from lavender_ext.core.tree cimport ldl_solve, take_from, take_two
from lavender_ext.core.view cimport generalized_t


cdef enum:
    PANEL_ROWS = 16             # most rows of a panel, unless one block has more
    NEAR = 64                   # columns of a panel that are copied together where several rows need them


cdef inline void tree_solve(const generalized_t* g, double* x) noexcept nogil:
    """x <- M^-1 x."""
    ldl_solve(g.n, g.lptr, g.lidx, g.lval, g.inv_pivot, x)


# -- J ---------------------------------------------------------------------------------------------------


cdef inline void jac_push(const generalized_t* g, const double* lam, double* x) noexcept nogil:
    """x = J^T lam (n)."""
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


cdef inline double jac_row(const generalized_t* g, int32_t i, const double* x) noexcept nogil:
    cdef int32_t q, first = g.jptr[i], end = g.jptr[i + 1]
    cdef const int32_t* jidx = g.jidx
    cdef const double* jval = g.jval
    cdef double s = 0.0
    for q in range(first, end):
        s += jval[q] * x[jidx[q]]
    return s


# -- Y ---------------------------------------------------------------------------------------------------


cdef inline int32_t reached(const generalized_t* g, int32_t first, int32_t last, int32_t stamp, int32_t before,
                            int32_t* mark, int32_t* out, int32_t* same) noexcept nogil:
    """Columns that rows [first, last) reach, unsorted, into out (n); how many. `same`: of those, marked `before`."""
    cdef int32_t q, k, count = 0, hits = 0
    for q in range(g.jptr[last] - 1, g.jptr[first] - 1, -1):
        k = g.jidx[q]
        while k >= 0 and mark[k] != stamp:
            hits += mark[k] == before
            mark[k] = stamp
            out[count] = k
            count += 1
            k = g.parent[k]
    same[0] = hits
    return count


cdef inline void sort_falling(int32_t* x, int32_t n) noexcept nogil:
    """Ascending order of what comes in a few falling runs."""
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


cdef inline int32_t few_panels(const generalized_t* g, int32_t n_blocks, const int32_t* ptr, uint64_t* above,
                               int32_t* prow, int32_t* pcol, int32_t* pval, int32_t* cols, int32_t workspace,
                               int32_t* n_cols, double* n_values) noexcept nogil:
    """`panel_pattern` of at most 64 velocities, sets of columns as bits; above (n) is scratch."""
    cdef int32_t i, q, k, first, last, count = 0, before = -1, at = 0, n = 0, nv = g.n, end, entries, odd
    cdef const int32_t* jptr = g.jptr
    cdef const int32_t* jidx = g.jidx
    cdef const int32_t* parent = g.parent
    cdef uint64_t on = 0, held = 0, left
    cdef double values = 0.0
    prow[0] = 0
    pcol[0] = 0
    pval[0] = 0
    for k in range(nv):                                 # a column and those that it reaches, which come before it
        above[k] = <uint64_t>1 << k
        if parent[k] >= 0:
            above[k] |= above[parent[k]]
    for i in range(n_blocks):
        first = ptr[i]
        last = ptr[i + 1]
        end = jptr[last]
        entries = end - jptr[first]
        odd = entries - before                          # 0 where it has the entries of the block before
        for q in range(jptr[first], end if odd == 0 else 0):
            odd |= jidx[q] ^ jidx[q - entries]
        if odd:
            on = 0
            for q in range(jptr[first], end):
                on |= above[jidx[q]]
        before = entries
        if n > 0 and on == held and last - prow[n - 1] <= PANEL_ROWS:
            prow[n] = last                              # the panel grows
        else:
            if at + nv > workspace:
                return -1
            count = 0
            left = on
            while left:
                cols[at + count] = lowest(left)
                count += 1
                left &= left - 1
            at += count
            held = on
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


cdef inline int32_t panel_pattern(const generalized_t* g, int32_t n_blocks, const int32_t* ptr, int32_t* mark,
                                  int32_t* prow, int32_t* pcol, int32_t* pval, int32_t* cols, int32_t workspace,
                                  int32_t* n_cols, double* n_values) noexcept nogil:
    """Panels of consecutive blocks that reach the same columns; how many, or -1 where `workspace` columns do not suffice.

    mark (2 n) is scratch, aligned to 8 bytes; of n_cols and n_values the caller makes arrays.
    """
    cdef int32_t i, first, last, count, same, before = -1, held = 0, at = 0, n = 0, stamp = 0
    cdef int32_t* out = mark + g.n
    if g.n <= 64:
        return few_panels(g, n_blocks, ptr, <uint64_t*>mark, prow, pcol, pval, cols, workspace, n_cols, n_values)
    n_values[0] = 0.0
    prow[0] = 0
    pcol[0] = 0
    pval[0] = 0
    for i in range(g.n):
        mark[i] = -1
    for i in range(n_blocks):
        first = ptr[i]
        last = ptr[i + 1]
        count = reached(g, first, last, stamp, before, mark, out, &same)
        n_values[0] += <double>count * (last - first)
        if n > 0 and count == held and same == count and last - prow[n - 1] <= PANEL_ROWS:
            prow[n] = last                                  # the panel grows
        else:
            if at + count > workspace:
                return -1
            sort_falling(out, count)
            for same in range(count):
                cols[at + same] = out[same]
            at += count
            held = count
            n += 1
            prow[n] = last
            pcol[n] = at
        pval[n] = pval[n - 1] + count * (last - prow[n - 1])
        if n_values[0] >= 2147483647.0:
            break
        before = stamp
        stamp += 1
    n_cols[0] = at
    return n


cdef inline void panel_whiten(const generalized_t* g, int32_t panel, int32_t* place, double* y) noexcept nogil:
    """Rows of Y of one panel: L^T y = J^T on its columns, then D^-1/2. place (n) is scratch."""
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
            a -= 1                                          # two with every column before them: the bits of one by one
            u = g.lval + lptr[cols[a]]
            for _i in range(rows):
                top = x[a + 1]
                low = x[a] - l[a] * top
                take_two(x, l, top, u, low, a)
                x[a + 1] = top * z
                x[a] = low * root[cols[a]]
                x += nc
        elif count == a:
            for _i in range(rows):
                take_from(x, l, x[a], a)
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
    # Two running sums, as in `near_dot`: whoever reads a row of Y gets the same bits.
    cdef int32_t a = 0
    cdef double s0 = 0.0, s1 = 0.0
    while a + 2 <= n:
        s0 += y[a] * x[cols[a]]
        s1 += y[a + 1] * x[cols[a + 1]]
        a += 2
    if a < n:
        s0 += y[a] * x[cols[a]]
    return s0 + s1


cdef inline double near_dot(const double* y, const double* x, int32_t n) noexcept nogil:
    # `indexed_dot` of what stands together.
    cdef int32_t a = 0
    cdef double s0 = 0.0, s1 = 0.0
    while a + 2 <= n:
        s0 += y[a] * x[a]
        s1 += y[a + 1] * x[a + 1]
        a += 2
    if a < n:
        s0 += y[a] * x[a]
    return s0 + s1


cdef inline void panel_times(const generalized_t* g, int32_t panel, const double* x, double* out) noexcept nogil:
    """out (m) = Y x on the rows of a panel."""
    cdef int32_t i, first = g.prow[panel], end = g.prow[panel + 1], nc = g.pcol[panel + 1] - g.pcol[panel]
    cdef const int32_t* cols = g.cols + g.pcol[panel]
    cdef const double* y = g.y + g.pval[panel]
    cdef double near[NEAR]
    if end - first > 2 and nc <= NEAR:
        for i in range(nc):
            near[i] = x[cols[i]]
        for i in range(first, end):
            out[i] = near_dot(y, near, nc)
            y += nc
        return
    for i in range(first, end):
        out[i] = indexed_dot(y, cols, x, nc)
        y += nc


cdef inline double whitened_dot(const generalized_t* g, int32_t panel, int32_t row, const double* x) noexcept nogil:
    """Y_row x, with the bits of `panel_times`."""
    cdef int32_t nc = g.pcol[panel + 1] - g.pcol[panel]
    return indexed_dot(g.y + g.pval[panel] + <ssize_t>(row - g.prow[panel]) * nc, g.cols + g.pcol[panel], x, nc)


cdef inline void whitened_push(const generalized_t* g, int32_t panel, int32_t row, double change, double* x) noexcept nogil:
    """x (n) += Y_row^T change."""
    cdef int32_t a, nc = g.pcol[panel + 1] - g.pcol[panel]
    cdef const int32_t* cols = g.cols + g.pcol[panel]
    cdef const double* y = g.y + g.pval[panel] + <ssize_t>(row - g.prow[panel]) * nc
    if change != 0.0:
        for a in range(nc):
            x[cols[a]] += y[a] * change


cdef inline void whitened_gather(const generalized_t* g, const double* lam, double* x) noexcept nogil:
    """x (n) = Y^T lam."""
    cdef int32_t a
    for a in range(g.n):
        x[a] = 0.0
    for a in range(g.n_panels):
        panel_push(g, a, lam, x)


cdef inline void panel_push(const generalized_t* g, int32_t panel, const double* lam, double* x) noexcept nogil:
    """x (n) += Y^T lam of the rows of a panel."""
    cdef int32_t i, a, first = g.prow[panel], end = g.prow[panel + 1], nc = g.pcol[panel + 1] - g.pcol[panel]
    cdef const int32_t* cols = g.cols + g.pcol[panel]
    cdef const double* y = g.y + g.pval[panel]
    cdef double near[NEAR]
    if end - first > 2 and nc <= NEAR:
        while first < end and lam[first] == 0.0:
            first += 1
            y += nc
        if first == end:
            return
        for a in range(nc):
            near[a] = x[cols[a]]
        for i in range(first, end):
            if lam[i] != 0.0:
                give_to(near, y, lam[i], nc)
            y += nc
        for a in range(nc):
            x[cols[a]] = near[a]
        return
    for i in range(first, end):
        if lam[i] != 0.0:
            for a in range(nc):
                x[cols[a]] += y[a] * lam[i]
        y += nc


cdef inline void give_to(double* x, const double* y, double z, int32_t n) noexcept nogil:
    cdef int32_t i
    for i in range(n):
        x[i] += y[i] * z


cdef inline void panel_push_size(const generalized_t* g, int32_t panel, const double* lam, double* x) noexcept nogil:
    """x (n) += |Y|^T |lam| of the rows of a panel."""
    cdef int32_t i, a, first = g.prow[panel], end = g.prow[panel + 1], nc = g.pcol[panel + 1] - g.pcol[panel]
    cdef const int32_t* cols = g.cols + g.pcol[panel]
    cdef const double* y = g.y + g.pval[panel]
    for i in range(first, end):
        if lam[i] != 0.0:
            for a in range(nc):
                x[cols[a]] += fabs(y[a] * lam[i])
        y += nc


cdef inline void panel_size(const generalized_t* g, int32_t panel, const double* x, double* out) noexcept nogil:
    """out (m) = |Y| x on the rows of a panel, x >= 0."""
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
    """|H^-1|, H = M scaled to a diagonal of ones, from two solves by M's factor: a lower bound, in general within a factor of 3.

    The first has the right-hand side of +-1 that makes L^-T times it large (Cline, Moler, Stewart and Wilkinson 1979); the
    second shows by how much H^-1 stretches its result. At least 1; x (2 n) is scratch.
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
    tree_solve(g, x)
    for i in range(n):
        x[i] *= s[i]
    second = sqrt(dot(x, x, n))
    first = first / sqrt(<double>n)
    if not second > first:
        second = first
    return second if second > 1.0 else 1.0


cdef inline double get_condition(const generalized_t* g, double* x) noexcept nogil:
    """The estimate that is stored with the factor, or a new one; x (2 n) is scratch."""
    return g.condition if g.condition > 0.0 else estimate_condition(g, x)


cdef inline double bound_condition(const generalized_t* g) noexcept nogil:
    """At least |H^-1|, far above it if n is large: e / det H, as the other eigenvalues have a sum below n."""
    cdef int32_t i
    cdef double det = 1.0
    for i in range(g.n):
        det *= g.inv_pivot[i] * g.mval[g.mptr[i + 1] - 1]
    return 2.72 * det


cdef class Operator:
    cdef generalized_t g                # without panels and compliance
    cdef readonly int failed            # the row of M whose pivot is not positive, or -1
    cdef readonly object jac            # (indptr, indices, data) of J
    cdef readonly object mass           # the same of the lower triangle of M
    cdef list keep

    cdef bint has_pattern(self, int32_t n, const int32_t* mptr, const int32_t* midx)
