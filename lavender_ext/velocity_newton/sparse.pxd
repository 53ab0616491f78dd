"""N = L^T D L of an island, kept where L has entries: rows from the last to the first, as M.

A row of Y has entries in a few chains of a tree, so N = I + Y^T V Y couples columns of one panel alone, and
eliminating row k couples those that it has an entry in (`tree_pattern`): without contacts between branches the pattern
is that of M's factor, some 12 entries in a row of an insect; where all meet, L is a full triangle, and costs no more
than a dense one would.

    val     entries left of the diagonal, row by row, then the diagonal
"""
from libc.stdint cimport int32_t

from lavender_ext.core.tree cimport axpy_subtract_2, tree_pattern
from lavender_ext.core.view cimport generalized_t


cdef enum:
    PER_COLUMN = 24             # entries in a row of L for which there is workspace at first,
    MANY = 200                  # of more columns than these: of fewer for all that there may be
    PASSED = 8                  # multiply-adds of a full factor that it costs to pass over a column


cdef inline int32_t per_column(int32_t n) noexcept nogil:
    """Entries in a row of L of n columns for which there is workspace at first."""
    return PER_COLUMN if n > MANY else (n + 1) // 2


cdef inline ssize_t pattern_marks(ssize_t n, ssize_t reached, ssize_t per) noexcept nogil:
    """int32 that `find_pattern` needs for n columns with `per` entries each, of which panels reach so many in all."""
    return (per + 7) * n + reached + 2


cdef inline int32_t find_pattern(const generalized_t* g, int32_t n_islands, const int32_t* iptr, const int32_t* run,
                                 const int32_t* cptr, const int32_t* local, int32_t per, int32_t* w) noexcept nogil:
    """Rows of L of all islands, one after the other, columns as in their island: how many entries, -1 without workspace.

    w (`pattern_marks`) begins with the pointers (n + 1) and the columns; the rest is scratch.
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
    # The last column of a panel has the others in its row; elimination leaves them to those before it.
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
    count = tree_pattern(n, mptr, midx, workspace, lptr, lidx, parent, mark, sibling, child)
    if count < 0:
        return -1
    for i in range(1, n_islands):
        for q in range(lptr[cptr[i]], lptr[cptr[i + 1]]):
            lidx[q] -= cptr[i]
    return count


cdef inline double factor_work(int32_t n, const int32_t* lptr, const int32_t* lidx) noexcept nogil:
    """Multiply-adds of one factor, and PASSED for each column passed over to find those of a row."""
    cdef int32_t k, q, first, end, theirs
    cdef double c, s = 0.0, passed = 0.0
    for k in range(n):
        first = lptr[k]
        end = lptr[k + 1]
        c = end - first
        s += 0.5 * c * (c + 1.0)
        for q in range(first, end):
            theirs = lptr[lidx[q] + 1] - lptr[lidx[q]]
            if theirs != q - first:
                passed += theirs
    return s + PASSED * passed


cdef inline void take_row(double* x, const double* y, double f, int32_t n) noexcept nogil:
    cdef int32_t i
    for i in range(n):
        x[i] -= f * y[i]


cdef inline int32_t place_of(const int32_t* theirs, int32_t column) noexcept nogil:
    """Where a row with these columns has this one, which is among them."""
    cdef int32_t at = 0
    while theirs[at] != column:
        at += 1
    return at


cdef inline int32_t sparse_factor(int32_t n, const int32_t* lptr, const int32_t* lidx, double* val,
                                  double* inv) noexcept nogil:
    """L in place, inv = 1 / D (n); 0 where a pivot is not positive. lptr may begin anywhere in lidx.

    Two rows whose columns are the same but for the upper one's own place are eliminated together: with the bits of one
    after the other, and half of what is read and written.
    """
    cdef int32_t k = n - 1, a, b, j, count, at, i, base = lptr[0]
    cdef double* diag = val + (lptr[n] - base)
    cdef double* row
    cdef double* up
    cdef double* to
    cdef const int32_t* cols
    cdef const int32_t* theirs
    cdef double x, y, f, g, r
    cdef bint two
    while k >= 0:
        if not diag[k] > 0.0:
            return 0
        r = 1.0 / diag[k]
        inv[k] = r
        row = val + (lptr[k] - base)
        up = row
        cols = lidx + lptr[k]
        count = lptr[k + 1] - lptr[k]
        two = count > 0 and cols[count - 1] == k - 1 and lptr[k] - lptr[k - 1] == count - 1
        if two:                                             # row k leaves row k - 1 first
            count -= 1
            up = val + (lptr[k - 1] - base)
            x = row[count]
            f = x * r
            if x != 0.0:
                diag[k - 1] -= f * x
                take_row(up, row, f, count)
                row[count] = f
            k -= 1
            if not diag[k] > 0.0:
                return 0
            inv[k] = 1.0 / diag[k]
        for a in range(count - 1, -1, -1):
            x = row[a]
            y = up[a] if two else 0.0
            if x == 0.0 and y == 0.0:
                continue
            f = x * r
            g = y * inv[k]
            j = cols[a]
            diag[j] = (diag[j] - f * x) - g * y
            to = val + (lptr[j] - base)
            theirs = lidx + lptr[j]
            at = place_of(theirs, cols[0]) if a > 0 else 0
            if lptr[j + 1] - lptr[j] != at + a:             # not the same columns from there on
                for b in range(a):
                    i = cols[b]
                    while theirs[at] != i:
                        at += 1
                    to[at] = (to[at] - f * row[b]) - g * up[b]
            elif two:
                axpy_subtract_2(to + at, row, f, up, g, a)
            else:
                take_row(to + at, row, f, a)
            row[a] = f
            if two:
                up[a] = g
        k -= 1
    return 1
