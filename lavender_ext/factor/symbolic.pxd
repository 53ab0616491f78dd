"""Analysis of a sparse factor: elimination tree, postorder, patterns of rows and columns, supernodes and their rows."""
from libc.stdint cimport int32_t, int64_t


cdef enum:
    NARROW_SUPERNODE_COLUMNS = 6    # Up to this many columns (or blocks), a supernode may have four times as many stored zeros.


cdef inline void compute_block_elimination_tree(int32_t n, const int32_t* nptr, const int32_t* nind, int32_t* parent,
                                                int32_t* mark, int32_t* row_count, int32_t* column_count) noexcept nogil:
    """Compute the elimination tree of a lower pattern, and the number of off-diagonal entries in each row and column of L."""
    cdef int32_t k, q, j
    for k in range(n):
        parent[k] = -1
        mark[k] = k
        row_count[k] = column_count[k] = 0
        for q in range(nptr[k], nptr[k + 1]):
            j = nind[q]
            while j < k and mark[j] != k:
                if parent[j] < 0:
                    parent[j] = k
                mark[j] = k
                row_count[k] += 1
                column_count[j] += 1
                j = parent[j]


cdef inline void list_factor_rows_by_column(int32_t n, const int32_t* nptr, const int32_t* nind, const int32_t* parent,
                                            int32_t* mark, const int32_t* lptr, int32_t* next_entry,
                                            int32_t* lind) noexcept nogil:
    """List the rows of every column of L below the diagonal, ascending; mark and next_entry (n) are scratch."""
    cdef int32_t k, q, j
    for k in range(n):
        mark[k] = k
        next_entry[k] = lptr[k]
        for q in range(nptr[k], nptr[k + 1]):
            j = nind[q]
            while j < k and mark[j] != k:
                mark[j] = k
                lind[next_entry[j]] = k
                next_entry[j] += 1
                j = parent[j]


cdef inline void find_postorder(int32_t n, const int32_t* parent, int32_t* child, int32_t* sibling, int32_t* stack,
                                int32_t* rank) noexcept nogil:
    """Write to rank (n) the position of each column in a postorder of the tree; roots and siblings keep their order."""
    cdef int32_t i, top, k = 0, root
    for i in range(n):
        child[i] = -1
    for i in range(n - 1, -1, -1):
        if parent[i] >= 0:
            sibling[i] = child[parent[i]]
            child[parent[i]] = i
    for root in range(n):
        if parent[root] >= 0:
            continue
        top = 0
        stack[0] = root
        while top >= 0:
            i = stack[top]
            if child[i] >= 0:
                top += 1
                stack[top] = child[i]
                child[i] = sibling[child[i]]
            else:
                rank[i] = k
                k += 1
                top -= 1


cdef inline void list_permuted_lower_pattern(int32_t n, const int32_t* ptr, const int32_t* neighbour, const int32_t* rank,
                                             const int32_t* order, int32_t* nptr, int32_t* nind) noexcept nogil:
    """List the lower pattern of a graph in an order, with the diagonal last in each row."""
    cdef int32_t k, i, q, to = 0
    for k in range(n):
        nptr[k] = to
        i = order[k]
        for q in range(ptr[i], ptr[i + 1]):
            if rank[neighbour[q]] < k:
                nind[to] = rank[neighbour[q]]
                to += 1
        nind[to] = k
        to += 1
    nptr[n] = to


cdef inline void apply_postorder(int32_t n, const int32_t* ptr, const int32_t* neighbour, int32_t* order, int32_t* rank,
                                 int32_t* nptr, int32_t* nind, int32_t* parent, int32_t* scratch) noexcept nogil:
    """Replace an order of a graph by the postorder of its tree, which keeps the fill, and list the lower pattern in it.

    Columns with one pattern are then adjacent. scratch has 4 n entries; `parent` is the tree of the original order.
    """
    cdef int32_t i, j, k, q, above
    for i in range(n):
        rank[order[i]] = i
    list_permuted_lower_pattern(n, ptr, neighbour, rank, order, nptr, nind)
    for k in range(n):                                  # elimination tree with path compression (Liu 1986)
        parent[k] = scratch[k] = -1
        for q in range(nptr[k], nptr[k + 1]):
            j = nind[q]
            while j >= 0 and j < k:
                above = scratch[j]
                scratch[j] = k
                if above < 0:
                    parent[j] = k
                j = above
    find_postorder(n, parent, scratch, scratch + n, scratch + 2 * n, scratch + 3 * n)
    for i in range(n):
        rank[i] = scratch[3 * n + rank[i]]
    for i in range(n):
        order[rank[i]] = i
    list_permuted_lower_pattern(n, ptr, neighbour, rank, order, nptr, nind)


cdef inline int32_t find_supernodes(int32_t n, const int32_t* lptr, const int32_t* lind, const int32_t* size,
                                    int32_t* first) noexcept nogil:
    """Merge adjacent vertices, each the parent of its predecessor, to supernodes; return the number of supernodes.

    first (n + 1) receives the first vertex of each supernode. A vertex has size (n) columns, or one if that is NULL. It joins the
    supernode before it if the fraction of stored zeros stays within 0.1: with more, products cost more than larger panels save.
    """
    cdef int32_t j, k = 0, q
    cdef double width = 0.0, below, before = 0.0, zeros = 0.0, more_zeros, entries, own
    for j in range(n):
        own = 1.0 if size == NULL else size[j]
        below = lptr[j + 1] - lptr[j]
        if size != NULL:
            below = 0.0
            for q in range(lptr[j], lptr[j + 1]):
                below += size[lind[q]]
        if j > 0 and lptr[j] > lptr[j - 1] and lind[lptr[j - 1]] == j:
            # Every column of the supernode gets the rows below j. The supernode's own rows are stored already.
            more_zeros = zeros + width * (below + own - before)
            entries = 0.5 * (width + own) * (width + own + 1.0) + (width + own) * below
            if more_zeros <= (4.0 if width < NARROW_SUPERNODE_COLUMNS else 1.0) * 0.1 * entries:
                zeros = more_zeros
                width += own
                before = below
                continue
        first[k] = j
        k += 1
        zeros = 0.0
        width = own
        before = below
    first[k] = n
    return k


cdef inline double list_supernode_rows(int32_t supernodes, const int32_t* starts, const int32_t* lptr, const int32_t* lind,
                                       const int32_t* group, int32_t* first, int32_t* supernode_of, int32_t* row_ptr,
                                       int32_t* row_indices, int64_t* value_offset, int64_t* upper_offset) noexcept nogil:
    """Write the pattern of `supernodal_t` from supernodes of vertices; return the multiply-adds of L L^T.

    starts has the position of each vertex's first row, and the number of rows at its end; group is `first` of
    `find_supernodes`.
    """
    cdef int32_t i, j, c, q, k, width, below
    cdef double work = 0.0
    row_ptr[0] = value_offset[0] = upper_offset[0] = 0
    for i in range(supernodes):
        first[i] = starts[group[i]]
        c = row_ptr[i]
        for q in range(lptr[group[i + 1] - 1], lptr[group[i + 1]]):
            for k in range(starts[lind[q]], starts[lind[q] + 1]):
                row_indices[c] = k
                c += 1
        row_ptr[i + 1] = c
        width = starts[group[i + 1]] - first[i]
        below = c - row_ptr[i]
        value_offset[i + 1] = value_offset[i] + <int64_t>width * (width + below)
        upper_offset[i + 1] = upper_offset[i] + <int64_t>width * below
        for j in range(first[i], first[i] + width):
            supernode_of[j] = i
        # The work is half of the sum of the squares of the columns' heights.
        work += width * (0.5 * (<double>below * below + <double>below * width) + <double>width * width / 6.0)
    first[supernodes] = starts[group[supernodes]]
    return work


cdef int32_t order_rows(int32_t n, const int32_t* indptr, const int32_t* indices, int32_t workspace, int32_t* scratch,
                        int64_t* outside, int32_t* begin, int32_t* order, int32_t* size, int32_t* nptr, int32_t* nind,
                        int32_t* parent, int32_t* lptr) noexcept nogil
