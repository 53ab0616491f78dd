"""A sparse matrix of any pattern and its factor by dense panels: L L^T, or L U with rows exchanged inside a panel.

    A_JJ' = A_JJ - sum over K below J of L_K U_K,   P A_JJ' = L_JJ U_JJ                                    (1)
    L_J = (A_J - sum L_K U_KJ) U_JJ^-1 below,   U_J = L_JJ^-1 P (A_J - sum L_JK U_K) beside                (2)

Both on the pattern of the symmetric factor, in an order of least degree, rows of one pattern taken as one vertex. A
panel is held column by column, its own columns' rows first, then the rows below; of L U what is beside it transposed,
so that every update is C - A B^T (`tiles.pxd`). 1 / L_jj or 1 / U_jj stands on the diagonal. L U is of
D^-1/2 A D^-1/2: what rows a panel exchanges are of one size, and how small a pivot is shows.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memset

import numpy as np

from lavender_ext.factor.minimum_degree cimport degree_order
from lavender_ext.factor.supernodal cimport dense_panel, less_lower
from lavender_ext.factor.symbolic cimport postorder_of
from lavender_ext.factor.tiles cimport add, has_wide, less, take


cdef enum:
    STRIP = 12                  # columns of a panel of L U that are finished together
    FEW = 6                     # columns of a panel up to which zeros are held for four times the share


ZEROS = 0.1                     # share of a panel that zeros held as numbers may be


cdef public int32_t lav_same_rows(int32_t n, const int32_t* indptr, const int32_t* indices, int32_t* node,
                                  int32_t* first) noexcept nogil:
    """Runs of rows with the same columns: their number, the run of each row, the first row of each."""
    cdef int32_t i, q, count = 0, length
    cdef bint same
    for i in range(n):
        length = indptr[i + 1] - indptr[i]
        same = i > 0 and length == indptr[i] - indptr[i - 1]
        if same:
            for q in range(length):
                if indices[indptr[i] + q] != indices[indptr[i - 1] + q]:
                    same = False
                    break
        if not same:
            first[count] = i
            count += 1
        node[i] = count - 1
    first[count] = n
    return count


cdef public int32_t lav_node_graph(int32_t count, const int32_t* indptr, const int32_t* indices, const int32_t* node,
                                   const int32_t* first, int32_t* ptr, int32_t* near) noexcept nogil:
    """Neighbours of each run of rows, without itself; how many there are in all. Columns ascend."""
    cdef int32_t k, q, j, last, total = 0
    for k in range(count):
        ptr[k] = total
        last = k
        for q in range(indptr[first[k]], indptr[first[k] + 1]):
            j = node[indices[q]]
            if j != last and j != k:
                near[total] = j
                total += 1
                last = j
    ptr[count] = total
    return total


cdef public int32_t lav_is_mirrored(int32_t n, const int32_t* indptr, const int32_t* indices,
                                    int32_t* cursor) noexcept nogil:
    """1 where (i, j) is an entry wherever (j, i) is; columns ascend, cursor (n) is scratch."""
    cdef int32_t i, j, q
    for i in range(n):
        cursor[i] = indptr[i]
    for i in range(n):
        for q in range(indptr[i], indptr[i + 1]):
            j = indices[q]
            if cursor[j] == indptr[j + 1] or indices[cursor[j]] != i:
                return 0                                # rows are gone through in order: entry i of row j is next
            cursor[j] += 1
    return 1


cdef public void lav_lower(int32_t n, const int32_t* ptr, const int32_t* near, const int32_t* rank, const int32_t* order,
                           int32_t* nptr, int32_t* nind) noexcept nogil:
    """Lower pattern of a graph in an order, the diagonal last in each row."""
    cdef int32_t k, i, q, to = 0
    for k in range(n):
        nptr[k] = to
        i = order[k]
        for q in range(ptr[i], ptr[i + 1]):
            if rank[near[q]] < k:
                nind[to] = rank[near[q]]
                to += 1
        nind[to] = k
        to += 1
    nptr[n] = to


cdef inline void tree_of(int32_t n, const int32_t* nptr, const int32_t* nind, int32_t* parent,
                         int32_t* above) noexcept nogil:
    # Elimination tree of a lower pattern, ancestors remembered (Liu 1986); above (n) is scratch.
    cdef int32_t k, q, j, after
    for k in range(n):
        parent[k] = -1
        above[k] = -1
        for q in range(nptr[k], nptr[k + 1]):
            j = nind[q]
            while j >= 0 and j < k:
                after = above[j]
                above[j] = k
                if after < 0:
                    parent[j] = k
                j = after


cdef public int32_t lav_sparse_order(int32_t n, const int32_t* indptr, const int32_t* indices, int32_t room,
                                     int32_t* scratch, int64_t* left, int32_t* begin, int32_t* order, int32_t* size,
                                     int32_t* nptr, int32_t* nind, int32_t* parent, int32_t* lptr) noexcept nogil:
    """Runs of rows with the same columns, in their order of elimination, and how many vertices are below each.

    begin (n + 1): the first row of each run as they stand; order, size (n), nptr (n + 1), nind (nnz / 2 + n + 1),
    parent (n) and lptr (n + 1) belong to the order. scratch has 11 n + 2 + room numbers, room is nnz and n or more; left
    (n). The number of runs, or -1 where the factor has 2^31 entries or more.
    """
    cdef int32_t* node = scratch
    cdef int32_t* gptr = scratch + n                    # n + 1
    cdef int32_t* head = scratch + 2 * n + 1            # n + 1
    cdef int32_t* whole = scratch + 3 * n + 2           # 8 n + 1
    cdef int32_t* near = scratch + 11 * n + 3
    cdef int32_t* rank = node
    cdef int32_t count, i, j, k, q, total
    cdef int64_t below = 0
    count = lav_same_rows(n, indptr, indices, node, begin)
    total = lav_node_graph(count, indptr, indices, node, begin, gptr, near)
    for i in range(count):
        whole[i] = gptr[i]
        size[i] = begin[i + 1] - begin[i]
    whole[count] = total
    degree_order(count, size, room, near, whole, left, head, order)
    # The quotient graph has used up its lists: once more.
    total = lav_node_graph(count, indptr, indices, node, begin, gptr, near)
    for i in range(count):
        rank[order[i]] = i
    lav_lower(count, gptr, near, rank, order, nptr, nind)
    tree_of(count, nptr, nind, parent, whole)
    postorder_of(count, parent, whole, whole + n, whole + 2 * n, whole + 3 * n)
    for i in range(count):
        rank[i] = whole[3 * n + rank[i]]
    for i in range(count):
        order[rank[i]] = i
    lav_lower(count, gptr, near, rank, order, nptr, nind)
    for i in range(count):
        size[i] = begin[order[i] + 1] - begin[order[i]]
    # How many are below each: along the tree from every entry.
    for k in range(count):
        parent[k] = -1
        whole[k] = k
        lptr[k + 1] = 0
        for q in range(nptr[k], nptr[k + 1]):
            j = nind[q]
            while j < k and whole[j] != k:
                if parent[j] < 0:
                    parent[j] = k
                whole[j] = k
                lptr[j + 1] += 1
                j = parent[j]
    lptr[0] = 0
    for k in range(count):
        below += lptr[k + 1]
        if below >= 2147483647:
            return -1
        lptr[k + 1] += lptr[k]
    return count


cdef inline void pattern_of(int32_t n, const int32_t* nptr, const int32_t* nind, const int32_t* parent, int32_t* mark,
                            const int32_t* lptr, int32_t* next, int32_t* lind) noexcept nogil:
    # What is below each vertex, ascending; mark, next (n) are scratch.
    cdef int32_t k, q, j
    for k in range(n):
        mark[k] = k
        next[k] = lptr[k]
        for q in range(nptr[k], nptr[k + 1]):
            j = nind[q]
            while j < k and mark[j] != k:
                mark[j] = k
                lind[next[j]] = k
                next[j] += 1
                j = parent[j]


cdef public int32_t lav_sparse_pattern(int32_t count, const int32_t* nptr, const int32_t* nind, const int32_t* parent,
                                       const int32_t* size, const int32_t* lptr, int32_t* lind, int32_t* scratch,
                                       double share, int32_t* group, int64_t* below) noexcept nogil:
    """Panels of vertices: their number, the first vertex of each in group (count + 1), rows below all of them.

    lind (lptr[count]) gets the vertices below each; scratch (2 count).
    """
    cdef int32_t i, c, q, k
    pattern_of(count, nptr, nind, parent, scratch, lptr, scratch + count, lind)
    k = lav_panels(count, lptr, lind, size, share, group)
    below[0] = 0
    for i in range(k):
        c = group[i + 1] - 1
        for q in range(lptr[c], lptr[c + 1]):
            below[0] += size[lind[q]]
    return k


cdef public int32_t lav_panels(int32_t n, const int32_t* lptr, const int32_t* lind, const int32_t* size, double share,
                               int32_t* first) noexcept nogil:
    """As `lav_supernodes`, of vertices of weights size (n): the number of panels, the first vertex of each."""
    cdef int32_t j, k = 0, q
    cdef double width = 0.0, below, before = 0.0, held = 0.0, more, all_
    for j in range(n):
        below = 0.0
        for q in range(lptr[j], lptr[j + 1]):
            below += size[lind[q]]
        if j > 0 and lptr[j] > lptr[j - 1] and lind[lptr[j - 1]] == j:
            # Every column before gets the rows below j; it has those of its own already.
            more = held + width * (below + size[j] - before)
            all_ = 0.5 * (width + size[j]) * (width + size[j] + 1.0) + (width + size[j]) * below
            if more <= (4.0 * share if width < FEW else share) * all_:
                held = more
                width += size[j]
                before = below
                continue
        first[k] = j
        k += 1
        held = 0.0
        width = size[j]
        before = below
    first[k] = n
    return k


cdef public void lav_sparse_rows(int32_t n, int32_t count, int32_t panels, const int32_t* begin, const int32_t* order,
                                 const int32_t* size, const int32_t* lptr, const int32_t* lind, const int32_t* group,
                                 int32_t* starts, int32_t* by_place, int32_t* place, int32_t* first, int32_t* of,
                                 int32_t* rptr, int32_t* rows, int64_t* at, int64_t* beside,
                                 double* work) noexcept nogil:
    """From vertices to rows, as `sparse_t` has them; work of L L^T; starts (count + 1) is scratch."""
    cdef int32_t i, j, c = 0, q, k, width, below
    for i in range(count):
        starts[i] = c
        for j in range(begin[order[i]], begin[order[i] + 1]):
            by_place[c] = j
            place[j] = c
            c += 1
    starts[count] = n
    rptr[0] = 0
    at[0] = 0
    beside[0] = 0
    work[0] = 0.0
    for i in range(panels):
        first[i] = starts[group[i]]
        c = rptr[i]
        for q in range(lptr[group[i + 1] - 1], lptr[group[i + 1]]):
            for k in range(starts[lind[q]], starts[lind[q] + 1]):
                rows[c] = k
                c += 1
        rptr[i + 1] = c
        width = starts[group[i + 1]] - first[i]
        below = c - rptr[i]
        at[i + 1] = at[i] + <int64_t>width * (width + below)
        beside[i + 1] = beside[i] + <int64_t>width * below
        for j in range(first[i], first[i] + width):
            of[j] = i
        # Half of the sum of the squares of its columns' heights.
        work[0] += width * (0.5 * (<double>below * below + <double>below * width) + <double>width * width / 6.0)
    first[panels] = n


cdef public void lav_sparse_room(int32_t panels, const int32_t* first, const int32_t* of, const int32_t* rptr,
                                 const int32_t* rows, int32_t lu, int64_t* room) noexcept nogil:
    """Room for what one panel takes from another, for the rows below it, and of L U for the tops of a strip."""
    cdef int32_t i, j, run
    cdef int64_t most = 0, needed
    for i in range(panels):
        needed = <int64_t>(first[i + 1] - first[i]) * STRIP if lu else 0
        if rptr[i + 1] - rptr[i] > needed:
            needed = rptr[i + 1] - rptr[i]
        if needed > most:
            most = needed
        run = 0
        for j in range(rptr[i], rptr[i + 1]):
            run = run + 1 if j > rptr[i] and of[rows[j]] == of[rows[j - 1]] else 1
            needed = <int64_t>run * (rptr[i + 1] - j + run - 1)
            if needed > most:
                most = needed
    room[0] = most


cdef public void lav_transpose(int32_t n, const int32_t* indptr, const int32_t* indices, const double* data, int32_t* tptr,
                               int32_t* tind, double* tdata) noexcept nogil:
    """A^T in compressed rows; tptr (n + 2)."""
    cdef int32_t i, q, j
    for i in range(n + 2):
        tptr[i] = 0
    for q in range(indptr[n]):
        tptr[indices[q] + 2] += 1
    for i in range(2, n + 2):
        tptr[i] += tptr[i - 1]
    for i in range(n):
        for q in range(indptr[i], indptr[i + 1]):
            j = indices[q] + 1
            tind[tptr[j]] = i
            tdata[tptr[j]] = data[q]
            tptr[j] += 1


cdef inline int32_t lu_panel(const sparse_t* f, int32_t width, int32_t rows, double* a, double* u, int32_t* swap,
                             double tiny) noexcept nogil:
    """(1), (2) of one panel: columns a (rows, width) with L below, u (rows - width, width) beside; small pivots."""
    cdef int32_t j, j0 = 0, t, n, i, best, lost = 0, below = rows - width
    cdef double x, top
    cdef double* y
    cdef double* z
    while j0 < width:
        n = STRIP if j0 + STRIP <= width else width - j0
        for j in range(j0, j0 + n):
            y = a + <int64_t>j * rows
            for t in range(j0):
                if swap[t] != t:
                    x = y[t]
                    y[t] = y[swap[t]]
                    y[swap[t]] = x
            for t in range(j0):
                take(j0 - t - 1, y[t], a + (t + 1) + <int64_t>t * rows, y + t + 1)
            for t in range(j0):
                f.temp[t * n + j - j0] = y[t]
        less(f.wide, rows - j0, n, j0, a + j0, rows, f.temp, n, a + j0 + <int64_t>j0 * rows, rows)
        for j in range(j0, j0 + n):
            y = a + <int64_t>j * rows
            best = j
            top = fabs(y[j])
            for i in range(j + 1, width):
                if fabs(y[i]) > top:
                    top = fabs(y[i])
                    best = i
            swap[j] = best
            if best != j:
                for t in range(j0 + n):
                    z = a + <int64_t>t * rows
                    x = z[j]
                    z[j] = z[best]
                    z[best] = x
            if top > tiny:
                x = 1.0 / y[j]
            else:
                lost += 1
                x = 0.0
            y[j] = x
            for i in range(j + 1, rows):
                y[i] *= x
            for t in range(j + 1, j0 + n):
                z = a + <int64_t>t * rows
                take(rows - j - 1, z[j], y + j + 1, z + j + 1)
        j0 += n
    if below == 0:
        return lost
    for j in range(width):
        if swap[j] != j:
            y = u + <int64_t>j * below
            z = u + <int64_t>swap[j] * below
            for i in range(below):
                x = y[i]
                y[i] = z[i]
                z[i] = x
    j0 = 0
    while j0 < width:
        n = STRIP if j0 + STRIP <= width else width - j0
        less(f.wide, below, n, j0, u, below, a + j0, rows, u + <int64_t>j0 * below, below)
        for j in range(j0 + 1, j0 + n):
            for t in range(j0, j):
                take(below, a[j + <int64_t>t * rows], u + <int64_t>t * below, u + <int64_t>j * below)
        j0 += n
    return lost


cdef inline void spread(const sparse_t* f, int32_t from_, int32_t end, int32_t skip, int32_t n, const int32_t* columns,
                        int32_t base, int64_t ld, double* to) noexcept nogil:
    """temp (end - from, n) added to a panel's rows rel - skip and the columns at those places."""
    cdef int32_t row = from_, high, j, m = end - from_
    while row < end:
        high = row + 1
        while high < end and f.rel[f.rows[high]] - f.rel[f.rows[row]] == high - row:
            high += 1
        for j in range(n):
            add(high - row, f.temp + <int64_t>j * m + row - from_,
                to + ld * (columns[j] - base) + f.rel[f.rows[row]] - skip)
        row = high


cdef inline void strip_by_strip(const sparse_t* f, int32_t m, int32_t n, int32_t k, const double* u, int32_t below,
                                const double* a, int32_t rows, const int32_t* columns, int32_t base, double* v,
                                int32_t beside) noexcept nogil:
    # Rows in one run, columns not: each run of columns by itself.
    cdef int32_t j = 0, high
    while j < n:
        high = j + 1
        while high < n and columns[high] - columns[j] == high - j:
            high += 1
        less(f.wide, m, high - j, k, u, below, a + j, rows, v + <int64_t>beside * (columns[j] - base), beside)
        j = high


cdef inline void take_panel(const sparse_t* f, int32_t to, int32_t of) noexcept nogil:
    """What the panel `to` is owed by an earlier one, from row `next` of that on."""
    cdef int32_t q = f.next[of], end = f.rptr[of + 1], n = 0, base = f.first[to], after = f.first[to + 1]
    cdef int32_t width = f.first[of + 1] - f.first[of], below = end - f.rptr[of], rows = width + below, m = end - q
    cdef int32_t own = after - base, beside = f.rptr[to + 1] - f.rptr[to], low, r = q - f.rptr[of]
    cdef int64_t ld = own + beside
    cdef double* a = f.val + f.at[of] + width + r
    cdef double* u
    cdef double* v = f.val + f.at[to]
    cdef const int32_t* columns = f.rows + q
    cdef bint run
    while q + n < end and f.rows[q + n] < after:
        n += 1
    low = f.rel[f.rows[q]]
    run = f.rel[f.rows[end - 1]] - low == m - 1         # into the panel as it stands
    if not f.lu:
        if run:
            less_lower(f.wide, m, n, width, a, rows, v + ld * low + low, ld)
        else:
            memset(f.temp, 0, sizeof(double) * m * n)
            less_lower(f.wide, m, n, width, a, rows, f.temp, m)
            spread(f, q, end, 0, n, columns, base, ld, v)
        f.next[of] = q + n
        return
    u = f.up + f.beside[of] + r
    if run:
        less(f.wide, m, n, width, a, rows, u, below, v + ld * low + low, ld)
    else:
        memset(f.temp, 0, sizeof(double) * m * n)
        less(f.wide, m, n, width, a, rows, u, below, f.temp, m)
        spread(f, q, end, 0, n, columns, base, ld, v)
    if m > n:
        v = f.up + f.beside[to]
        low = f.rel[f.rows[q + n]]
        if f.rel[f.rows[end - 1]] - low == m - n - 1:
            strip_by_strip(f, m - n, n, width, u + n, below, a, rows, columns, base, v + low - own, beside)
        else:
            memset(f.temp, 0, sizeof(double) * (m - n) * n)
            less(f.wide, m - n, n, width, u + n, below, a, rows, f.temp, m - n)
            spread(f, q + n, end, own, n, columns, base, beside, v)
    f.next[of] = q + n


cdef inline void fill(const sparse_t* f, int32_t i, const int32_t* indptr, const int32_t* indices, const double* data,
                      const int32_t* tptr, const int32_t* tind, const double* tdata, const double* d,
                      double shift) noexcept nogil:
    """Entries of A + shift D in the columns of panel i and, of L U, beside them."""
    cdef int32_t base = f.first[i], after = f.first[i + 1], c, q, p, row
    cdef int64_t own = after - base, beside = f.rptr[i + 1] - f.rptr[i], ld = own + beside
    cdef double* v = f.val + f.at[i]
    cdef double* u = f.up + f.beside[i]
    cdef double s
    memset(v, 0, sizeof(double) * ld * own)
    if not f.lu:
        for c in range(base, after):
            row = f.order[c]
            for q in range(indptr[row], indptr[row + 1]):
                p = f.place[indices[q]]
                if p >= c:
                    v[f.rel[p]] = data[q]
            v[c - base] += shift * d[row]
            v += ld
        return
    memset(u, 0, sizeof(double) * beside * own)
    for c in range(base, after):
        row = f.order[c]
        s = f.scale[c]
        for q in range(indptr[row], indptr[row + 1]):
            p = f.place[indices[q]]
            if p >= after:
                u[f.rel[p] - own] = s * data[q] * f.scale[p]
        for q in range(tptr[row], tptr[row + 1]):
            p = f.place[tind[q]]
            if p >= base:
                v[f.rel[p]] = f.scale[p] * tdata[q] * s
        v[c - base] += shift
        v += ld
        u += beside


cdef public int32_t lav_sparse_factor(const sparse_t* f, const int32_t* indptr, const int32_t* indices,
                                      const double* data, const int32_t* tptr, const int32_t* tind, const double* tdata,
                                      const double* d, double shift, double tiny) noexcept nogil:
    """Factor A + shift D, D = diag(d) > 0; of L U with A^T beside. How many pivots were at most tiny of d."""
    cdef int32_t i, j, k, q, after, lost = 0
    for k in range(f.n):
        f.scale[k] = 1.0 / sqrt(d[f.order[k]]) if f.lu else tiny * d[f.order[k]]
    for i in range(f.panels):
        f.head[i] = -1
        f.next[i] = f.rptr[i]
    for i in range(f.panels):
        for k in range(f.first[i], f.first[i + 1]):
            f.rel[k] = k - f.first[i]
        for q in range(f.rptr[i], f.rptr[i + 1]):
            f.rel[f.rows[q]] = f.first[i + 1] - f.first[i] + q - f.rptr[i]
        fill(f, i, indptr, indices, data, tptr, tind, tdata, d, shift)
        j = f.head[i]
        while j >= 0:
            after = f.link[j]
            take_panel(f, i, j)
            if f.next[j] < f.rptr[j + 1]:
                k = f.of[f.rows[f.next[j]]]
                f.link[j] = f.head[k]
                f.head[k] = j
            j = after
        k = f.first[i + 1] - f.first[i]
        q = k + f.rptr[i + 1] - f.rptr[i]
        if f.lu:
            lost += lu_panel(f, k, q, f.val + f.at[i], f.up + f.beside[i], f.swap + f.first[i], tiny)
        else:
            lost += dense_panel(f.wide, k, q, f.val + f.at[i], f.scale + f.first[i])
        if f.rptr[i] < f.rptr[i + 1]:
            k = f.of[f.rows[f.rptr[i]]]
            f.link[i] = f.head[k]
            f.head[k] = i
    return lost


cdef public void lav_sparse_solve(const sparse_t* f, const double* b, double* x) noexcept nogil:
    """x <- (A + shift D)^-1 b after `lav_sparse_factor`; they may be one array."""
    sparse_solve(f, b, x)


def is_mirrored(const int32_t[::1] indptr, const int32_t[::1] indices):
    """Whether the pattern of a canonical CSR matrix is symmetric."""
    cdef int32_t n = <int32_t>indptr.shape[0] - 1
    cdef int32_t[::1] cursor = np.empty(n + 1, np.int32)
    if n == 0 or indices.shape[0] == 0:
        return True
    return bool(lav_is_mirrored(n, &indptr[0], &indices[0], &cursor[0]))


def free_part(const int32_t[::1] indptr, const int32_t[::1] indices, const double[::1] data,
              const int32_t[::1] place, int n_free):
    """(indptr, indices, data) of the rows and columns with place >= 0, numbered in order of rows."""
    cdef int32_t i, q, k = 0, n = <int32_t>indptr.shape[0] - 1
    ptr_array = np.zeros(n_free + 1, np.int32)
    cdef int32_t[::1] ptr = ptr_array, idx
    cdef double[::1] val
    for i in range(n):
        if place[i] >= 0:
            for q in range(indptr[i], indptr[i + 1]):
                k += place[indices[q]] >= 0
            ptr[place[i] + 1] = k
    idx_array, val_array = np.empty(k, np.int32), np.empty(k)
    idx, val = idx_array, val_array
    k = 0
    for i in range(n):
        if place[i] >= 0:
            for q in range(indptr[i], indptr[i + 1]):
                if place[indices[q]] >= 0:
                    idx[k] = place[indices[q]]
                    val[k] = data[q]
                    k += 1
    return ptr_array, idx_array, val_array


cdef tuple _analysed(indptr, indices):
    # Numbers of `sparse_t` with room for what a factor notes, places in its values, and the work of L L^T.
    cdef int32_t n = <int32_t>len(indptr) - 1, nnz = <int32_t>len(indices), count, k, room = nnz + nnz // 4 + n + 1
    cdef const int32_t[::1] ptr = indptr, ind = indices
    cdef const int32_t* entries = &ind[0] if nnz else NULL
    cdef int64_t below
    cdef double share = ZEROS, work
    cdef int32_t[::1] scratch = np.empty(19 * n + nnz // 2 + room + 9, np.int32), lind, whole
    cdef int64_t[::1] left = np.empty(2 * n + 2, np.int64), places
    cdef int32_t* begin = &scratch[0]                   # n + 1
    cdef int32_t* order = begin + n + 1
    cdef int32_t* size = order + n
    cdef int32_t* parent = size + n
    cdef int32_t* nptr = parent + n                     # n + 1
    cdef int32_t* lptr = nptr + n + 1                   # n + 1
    cdef int32_t* group = lptr + n + 1                  # n + 1
    cdef int32_t* nind = group + n + 1                  # nnz / 2 + n + 1
    cdef int32_t* s = nind + nnz // 2 + n + 1           # 11 n + 3 + room
    cdef int32_t* first
    cdef int32_t* rptr
    with nogil:
        count = lav_sparse_order(n, &ptr[0], entries, room, s, &left[0], begin, order, size, nptr, nind, parent, lptr)
    if count < 0:
        raise OverflowError("the factor has 2^31 entries or more")
    lind = np.empty(lptr[count] + 1, np.int32)
    with nogil:
        k = lav_sparse_pattern(count, nptr, nind, parent, size, lptr, &lind[0], s, share, group, &below)
    if below >= 2**31:
        raise OverflowError("the factor has 2^31 rows of panels or more")
    whole_array, places_array = np.empty(5 * n + 5 * k + 2 + below, np.int32), np.empty(2 * k + 2, np.int64)
    whole, places = whole_array, places_array
    first = &whole[0] + 5 * n
    rptr = first + k + 1
    with nogil:
        lav_sparse_rows(n, count, k, begin, order, size, lptr, &lind[0], group, s, &whole[0], &whole[0] + n, first,
                        &whole[0] + 2 * n, rptr, rptr + k + 1 + 3 * k, &places[0], &places[0] + k + 1, &work)
    return whole_array, places_array, work


cdef class SparsePanels:
    """The factor of a matrix in canonical compressed rows (n, n), whose pattern is symmetric; n > 0.

    Parameters
    ----------
    indptr, indices : (n + 1,), (nnz,) int32
    lu : bool
        L U; else L L^T of a symmetric matrix, of which the entries at and after the diagonal in the order are read.
    wide : bool
        Four lanes where the machine has them: the same bits.
    like : SparsePanels, optional
        Of the same pattern, whose analysis serves again.
    """

    def __init__(self, indptr, indices, bint lu, bint wide=True, SparsePanels like=None):
        cdef int32_t n = <int32_t>len(indptr) - 1, k
        if n < 1:
            raise ValueError("a matrix of one row or more")
        if like is None:
            whole_array, places, self.half = _analysed(indptr, indices)
        elif like.f.n == n and like.indices.shape[0] == len(indices):
            whole_array, places, self.half = like.keep[0].copy(), like.keep[1], like.half
        else:
            raise ValueError("panels of another matrix")
        k = <int32_t>(len(places) // 2 - 1)
        cdef int32_t[::1] whole = whole_array
        cdef int64_t[::1] places_ = places
        cdef int32_t* order = &whole[0]
        cdef int32_t* place = order + n
        cdef int32_t* of = place + n
        cdef int32_t* swap = of + n
        cdef int32_t* rel = swap + n
        cdef int32_t* first = rel + n                   # k + 1
        cdef int32_t* rptr = first + k + 1              # k + 1
        cdef int32_t* head = rptr + k + 1
        cdef int32_t* link = head + k
        cdef int32_t* next_ = link + k
        cdef int32_t* rows = next_ + k                  # the rest
        cdef int64_t* at = &places_[0]
        cdef int64_t* beside = at + k + 1
        self.work = 2.0 * self.half if lu else self.half
        self.entries = at[k] + (beside[k] if lu else 0)
        self.keep, self.numbers = (whole_array, places), None
        self.indptr, self.indices = indptr, indices
        self.f = sparse_t(
            n, k, wide and has_wide(), lu, order, place, first, of, rptr, rows, at, beside, NULL, NULL, NULL, NULL, NULL,
            swap, rel, head, link, next_)

    cdef _make_room(self):
        # What is counted and never factored holds no numbers.
        cdef int64_t most
        cdef double[::1] numbers
        lav_sparse_room(self.f.panels, self.f.first, self.f.of, self.f.rptr, self.f.rows, self.f.lu, &most)
        numbers = self.numbers = np.empty(self.entries + most + 2 * self.f.n + 1)
        self.f.val = &numbers[0]
        self.f.up = self.f.val + self.f.at[self.f.panels]
        self.f.temp = self.f.val + self.entries
        self.f.scale = self.f.temp + most
        self.f.y = self.f.scale + self.f.n

    def factor(self, const double[::1] data, const double[::1] d, double shift, double tiny):
        """Factor the matrix of these entries with shift D, d (n,) > 0; how many pivots are not above tiny d."""
        cdef const int32_t[::1] ptr = self.indptr, ind = self.indices
        cdef int32_t[::1] tptr, tind
        cdef double[::1] tdata
        cdef int32_t lost
        if data.shape[0] != ind.shape[0] or d.shape[0] != self.f.n:
            raise ValueError("entries of another matrix")
        if data.shape[0] == 0:
            return self.f.n
        if self.numbers is None:
            self._make_room()
        tptr, tind, tdata = np.empty(1, np.int32), np.empty(1, np.int32), np.empty(1)
        if self.f.lu:
            tptr = np.empty(self.f.n + 2, np.int32)
            tind, tdata = np.empty(data.shape[0], np.int32), np.empty(data.shape[0])
        with nogil:
            if self.f.lu:
                lav_transpose(self.f.n, &ptr[0], &ind[0], &data[0], &tptr[0], &tind[0], &tdata[0])
            lost = lav_sparse_factor(&self.f, &ptr[0], &ind[0], &data[0], &tptr[0], &tind[0], &tdata[0], &d[0], shift, tiny)
        return lost

    def solve(self, const double[::1] b):
        """(n,) of the last factor; a new array."""
        out = np.empty(self.f.n)
        cdef double[::1] x = out
        if b.shape[0] != self.f.n or self.numbers is None:
            raise ValueError("of another size, or before a factor")
        with nogil:
            lav_sparse_solve(&self.f, &b[0], &x[0])
        return out

    @property
    def order(self):
        """(n,) row eliminated first, second, ..."""
        return self.keep[0][:self.f.n]
