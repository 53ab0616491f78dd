"""What a pattern alone tells of a factor: elimination trees, patterns of block factors, panels, their rows and places.

Of a sparse matrix rows of one pattern are taken as one vertex, in an order of least degree; of a matrix of blocks each
block column is one, as they stand.
"""
from libc.stdint cimport int32_t, int64_t

import numpy as np

from lavender_ext.factor.minimum_degree cimport degree_order
from lavender_ext.factor.symbolic cimport block_tree, column_pattern, postordered


cdef enum:
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


cdef public int32_t lav_sparse_order(int32_t n, const int32_t* indptr, const int32_t* indices, int32_t workspace,
                                     int32_t* scratch, int64_t* left, int32_t* begin, int32_t* order, int32_t* size,
                                     int32_t* nptr, int32_t* nind, int32_t* parent, int32_t* lptr) noexcept nogil:
    """Runs of rows with the same columns, in their order of elimination, and how many vertices are below each.

    begin (n + 1): the first row of each run as they stand; order, size (n), nptr (n + 1), nind (nnz / 2 + n + 1),
    parent (n) and lptr (n + 1) belong to the order. scratch has 11 n + 2 + workspace numbers, workspace is nnz and n or more; left
    (n). The number of runs, or -1 where the factor has 2^31 entries or more.
    """
    cdef int32_t* node = scratch
    cdef int32_t* gptr = scratch + n                    # n + 1
    cdef int32_t* head = scratch + 2 * n + 1            # n + 1
    cdef int32_t* whole = scratch + 3 * n + 2           # 8 n + 1
    cdef int32_t* near = scratch + 11 * n + 3
    cdef int32_t* rank = node
    cdef int32_t count, i, k, total
    cdef int64_t below = 0
    count = lav_same_rows(n, indptr, indices, node, begin)
    total = lav_node_graph(count, indptr, indices, node, begin, gptr, near)
    for i in range(count):
        whole[i] = gptr[i]
        size[i] = begin[i + 1] - begin[i]
    whole[count] = total
    degree_order(count, size, workspace, near, whole, left, head, order)
    # The quotient graph has used up its lists: once more.
    total = lav_node_graph(count, indptr, indices, node, begin, gptr, near)
    postordered(count, gptr, near, order, rank, nptr, nind, parent, whole)
    for i in range(count):
        size[i] = begin[order[i] + 1] - begin[order[i]]
    block_tree(count, nptr, nind, parent, whole, whole + n, lptr + 1)
    lptr[0] = 0
    for k in range(count):
        below += lptr[k + 1]
        if below >= 2147483647:
            return -1
        lptr[k + 1] += lptr[k]
    return count


cdef public int32_t lav_sparse_pattern(int32_t count, const int32_t* nptr, const int32_t* nind, const int32_t* parent,
                                       const int32_t* size, const int32_t* lptr, int32_t* lind, int32_t* scratch,
                                       double share, int32_t* group, int64_t* below) noexcept nogil:
    """Panels of vertices: their number, the first vertex of each in group (count + 1), rows below all of them.

    lind (lptr[count]) gets the vertices below each; scratch (2 count).
    """
    cdef int32_t i, c, q, k
    column_pattern(count, nptr, nind, parent, scratch, lptr, scratch + count, lind)
    k = lav_panels(count, lptr, lind, size, FEW, share, group)
    below[0] = 0
    for i in range(k):
        c = group[i + 1] - 1
        for q in range(lptr[c], lptr[c + 1]):
            below[0] += size[lind[q]]
    return k


cdef public int32_t lav_panels(int32_t n, const int32_t* lptr, const int32_t* lind, const int32_t* size, int32_t few,
                               double share, int32_t* first) noexcept nogil:
    """Panels of neighbouring vertices, each the parent of the one before: their number, `first` of each (n + 1).

    size (n): columns of a vertex. One joins the panel before it where its pattern is that panel's, or where the zeros that
    are then held as numbers are at most `share` of the panel (panels up to `few` columns: four times as many).
    """
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
            if more <= (4.0 * share if width < few else share) * all_:
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


cdef public void lav_panel_rows(int32_t n, int32_t count, int32_t panels, const int32_t* begin, const int32_t* order,
                                 const int32_t* lptr, const int32_t* lind, const int32_t* group, int32_t* starts,
                                 int32_t* by_place, int32_t* place, int32_t* first, int32_t* of,
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


def analysed(indptr, indices):
    """(numbers, places in the values, work of L L^T) of `sparse_t`, for a matrix whose pattern is symmetric."""
    cdef int32_t n = <int32_t>len(indptr) - 1, nnz = <int32_t>len(indices), count, k, workspace = nnz + nnz // 4 + n + 1
    cdef const int32_t[::1] ptr = indptr, ind = indices
    cdef const int32_t* entries = &ind[0] if nnz else NULL
    cdef int64_t below
    cdef double work, share = ZEROS
    cdef int32_t[::1] scratch = np.empty(19 * n + nnz // 2 + workspace + 9, np.int32), lind, whole
    cdef int64_t[::1] left = np.empty(2 * n + 2, np.int64), places
    cdef int32_t* begin = &scratch[0]                   # n + 1
    cdef int32_t* order = begin + n + 1
    cdef int32_t* size = order + n
    cdef int32_t* parent = size + n
    cdef int32_t* nptr = parent + n                     # n + 1
    cdef int32_t* lptr = nptr + n + 1                   # n + 1
    cdef int32_t* group = lptr + n + 1                  # n + 1
    cdef int32_t* nind = group + n + 1                  # nnz / 2 + n + 1
    cdef int32_t* s = nind + nnz // 2 + n + 1           # 11 n + 3 + workspace
    cdef int32_t* first
    cdef int32_t* rptr
    with nogil:
        count = lav_sparse_order(n, &ptr[0], entries, workspace, s, &left[0], begin, order, size, nptr, nind, parent, lptr)
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
        lav_panel_rows(n, count, k, begin, order, lptr, &lind[0], group, s, &whole[0], &whole[0] + n, first,
                        &whole[0] + 2 * n, rptr, rptr + k + 1 + 3 * k, &places[0], &places[0] + k + 1, &work)
    return whole_array, places_array, work


def block_panels(const int32_t[::1] nptr, const int32_t[::1] nind, const int32_t[::1] lptr, const int32_t[::1] lind, int s,
                 int few, double share):
    """As `analysed` of a lower block pattern as it stands, blocks of s rows; before it the place of each block in the values.

    lptr, lind: the blocks of its factor by columns; few: blocks.
    """
    cdef int32_t n = <int32_t>nptr.shape[0] - 1, i, j, q, k, p, below = 0
    cdef int32_t[::1] group = np.empty(n + 1, np.int32), one = np.ones(n + 1, np.int32), whole
    cdef int32_t[::1] begin = s * np.arange(n + 1, dtype=np.int32), order = np.arange(n + 1, dtype=np.int32)
    cdef int32_t[::1] starts = np.empty(n + 1, np.int32)
    cdef int64_t[::1] places, spot = np.empty(nind.shape[0] + 1, np.int64)
    cdef int32_t* of
    cdef int32_t* first
    cdef int32_t* rptr
    cdef int32_t* rows
    cdef double work
    k = lav_panels(n, &lptr[0], &lind[0], &one[0], few, share, &group[0])
    for i in range(k):
        below += s * (lptr[group[i + 1]] - lptr[group[i + 1] - 1])
    whole_array, places_array = np.empty(5 * n * s + 5 * k + 2 + below, np.int32), np.empty(2 * k + 2, np.int64)
    whole, places = whole_array, places_array
    of = &whole[0] + 2 * n * s
    first = of + 3 * n * s
    rptr = first + k + 1
    rows = rptr + 4 * k + 1
    lav_panel_rows(n * s, n, k, &begin[0], &order[0], &lptr[0], &lind[0], &group[0], &starts[0], &whole[0],
                   &whole[0] + n * s, first, of, rptr, rows, &places[0], &places[0] + k + 1, &work)
    for j in range(n):
        for q in range(nptr[j], nptr[j + 1]):
            i = of[s * nind[q]]
            p = s * j - first[i]
            if s * j >= first[i + 1]:
                p = rptr[i]
                while rows[p] != s * j:
                    p += 1
                p += first[i + 1] - first[i] - rptr[i]
            spot[q] = places[i] + p + <int64_t>(s * nind[q] - first[i]) * (first[i + 1] - first[i] + rptr[i + 1] - rptr[i])
    return spot.base, whole_array, places_array, work
