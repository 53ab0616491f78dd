"""Compute the panels of Y = J L^-1 D^-1/2 (`generalized.pxd`): their columns, then their values."""
from libc.stdint cimport int32_t, uint64_t

from lavender_ext.core.bits cimport lowest
from lavender_ext.core.tree_solve cimport axpy_subtract, axpy_subtract_2
from lavender_ext.core.view cimport generalized_t


cdef enum:
    PANEL_ROWS = 16             # A panel has at most this many rows, unless a single block has more.


cdef inline int32_t collect_panel_columns(const generalized_t* g, int32_t first, int32_t last, int32_t stamp, int32_t previous,
                                          int32_t* mark, int32_t* out, int32_t* same) noexcept nogil:
    """List the columns of Y in rows [first, last), unsorted, in out (n); return their number.

    mark (n) receives `stamp` at these columns. `same` receives the number of these columns that had the mark `previous`.
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


cdef inline int32_t find_panel_pattern_by_bits(const generalized_t* g, int32_t n_blocks, const int32_t* ptr,
                                               uint64_t* ancestors, int32_t* prow, int32_t* pcol, int32_t* pval, int32_t* cols,
                                               int32_t workspace, int32_t* n_cols, double* n_values) noexcept nogil:
    """Do what `find_panel_pattern` does for at most 64 velocities, with bit sets of columns; ancestors (n) is scratch."""
    cdef int32_t i, q, k, first, last, count = 0, previous_entries = -1, at = 0, n = 0, nv = g.n, end, entries, differs
    cdef const int32_t* jptr = g.jptr
    cdef const int32_t* jidx = g.jidx
    cdef const int32_t* parent = g.parent
    cdef uint64_t columns = 0, panel_columns = 0, remaining
    cdef double values = 0.0
    prow[0] = pcol[0] = pval[0] = 0
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
    prow[0] = pcol[0] = pval[0] = 0
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
            # Eliminate two dense columns at once, with the same bits as one after the other.
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
