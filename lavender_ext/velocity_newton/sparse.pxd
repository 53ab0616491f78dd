"""The pattern of N = L^T D L of an island, which is factored from the last row to the first, as M (`core/tree.pxd`).

A row of Y has entries in a few chains of a tree, so N = I + Y^T V Y couples columns of the same panel only, and
eliminating row k couples the columns of its entries (`find_tree_factor_pattern`). Without contacts between branches the pattern is
that of the factor of M (about 12 entries in a row for an insect). If all columns are coupled, L is a full triangle and
takes the work of a dense factor.

    val     the entries left of the diagonal, row by row, then the diagonal
"""
from libc.stdint cimport int32_t

from lavender_ext.core.tree cimport find_tree_factor_pattern
from lavender_ext.core.view cimport generalized_t


cdef enum:
    FIRST_ROW_ENTRIES = 24      # Entries per row of L in the first workspace, if there are more than MAX_DENSE_COLUMNS columns.
    MAX_DENSE_COLUMNS = 200     # Up to this many columns the first workspace holds a full triangle.
    COLUMN_SEARCH_WORK = 8      # Skipping one column in the search for a row's places takes the time of this many multiply-adds.


cdef inline int32_t initial_entries_per_row(int32_t n) noexcept nogil:
    """Return the entries per row of L, of n columns, that the first workspace provides."""
    return FIRST_ROW_ENTRIES if n > MAX_DENSE_COLUMNS else (n + 1) // 2


cdef inline ssize_t pattern_index_size(ssize_t n, ssize_t reached, ssize_t per) noexcept nogil:
    """Return the number of int32 that `find_pattern` uses: n columns, `per` entries per row, `reached` columns of panels."""
    return (per + 7) * n + reached + 2


cdef inline int32_t find_pattern(const generalized_t* g, int32_t n_islands, const int32_t* iptr, const int32_t* run,
                                 const int32_t* cptr, const int32_t* local, int32_t per, int32_t* w) noexcept nogil:
    """Write the rows of L of all islands, columns numbered within the island; return the entries, or -1 if w is too small.

    w (`pattern_index_size`) receives the row pointers (n + 1) and the columns; its other entries are scratch.
    """
    cdef int32_t n = cptr[n_islands], workspace = per * g.n, i, a, b, q, k, base, first, end, most, count
    cdef int32_t* lptr = w
    cdef int32_t* lidx = w + n + 1
    cdef int32_t* mptr = lidx + workspace
    cdef int32_t* parent = mptr + n + 1
    cdef int32_t* mark = parent + n
    cdef int32_t* sibling = mark + n
    cdef int32_t* child = sibling + n
    cdef int32_t* midx = child + n
    cdef const int32_t* cols
    for k in range(n + 1):
        mptr[k] = 0
    # The row of a panel's last column has entries in its other columns; elimination adds the entries among these.
    for i in range(n_islands):
        base = cptr[i]
        for a in range(iptr[i], iptr[i + 1]):
            for b in range(run[2 * a], run[2 * a + 1]):
                first = g.pcol[b]
                end = g.pcol[b + 1]
                if end > first + 1:
                    mptr[base + local[g.cols[end - 1]] + 1] += end - first - 1
    for k in range(n):
        mptr[k + 1] += mptr[k]
        mark[k] = mptr[k]
    for i in range(n_islands):
        base = cptr[i]
        for a in range(iptr[i], iptr[i + 1]):
            for b in range(run[2 * a], run[2 * a + 1]):
                first = g.pcol[b]
                end = g.pcol[b + 1] - 1
                if end <= first:
                    continue
                cols = g.cols
                most = base + local[cols[end]]
                count = mark[most]
                for q in range(first, end):
                    midx[count] = base + local[cols[q]]
                    count += 1
                mark[most] = count
    count = find_tree_factor_pattern(n, mptr, midx, workspace, lptr, lidx, parent, mark, sibling, child)
    if count < 0:
        return -1
    for i in range(1, n_islands):
        for q in range(lptr[cptr[i]], lptr[cptr[i + 1]]):
            lidx[q] -= cptr[i]
    return count


cdef inline double count_mass_factor_work(int32_t n, const int32_t* lptr, const int32_t* lidx) noexcept nogil:
    """Return the multiply-adds of one factor, plus COLUMN_SEARCH_WORK for each column that the search for places skips."""
    cdef int32_t k, q, first, end, theirs
    cdef double c, s = 0.0, skipped = 0.0
    for k in range(n):
        first = lptr[k]
        end = lptr[k + 1]
        c = end - first
        s += 0.5 * c * (c + 1.0)
        for q in range(first, end):
            theirs = lptr[lidx[q] + 1] - lptr[lidx[q]]
            if theirs != q - first:
                skipped += theirs
    return s + COLUMN_SEARCH_WORK * skipped
