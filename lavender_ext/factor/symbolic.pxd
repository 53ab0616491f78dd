"""An order of elimination and the lower pattern in it, its tree and postorder, and the pattern of its factor."""
from libc.stdint cimport int32_t


cdef inline void block_tree(int32_t n, const int32_t* nptr, const int32_t* nind, int32_t* parent, int32_t* mark,
                            int32_t* row_count, int32_t* column_count) noexcept nogil:
    """Elimination tree of the lower pattern, and how many blocks each row and column of L holds."""
    cdef int32_t k, q, j
    for k in range(n):
        parent[k] = -1
        mark[k] = k
        row_count[k] = 0
        column_count[k] = 0
        for q in range(nptr[k], nptr[k + 1]):
            j = nind[q]
            while j < k and mark[j] != k:
                if parent[j] < 0:
                    parent[j] = k
                mark[j] = k
                row_count[k] += 1
                column_count[j] += 1
                j = parent[j]


cdef inline void column_pattern(int32_t n, const int32_t* nptr, const int32_t* nind, const int32_t* parent, int32_t* mark,
                                const int32_t* lptr, int32_t* next, int32_t* lind) noexcept nogil:
    """Rows of every column of L, ascending; mark, next (n) are scratch."""
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


cdef inline void block_pattern(int32_t n, const int32_t* nptr, const int32_t* nind, const int32_t* parent, int32_t* mark,
                               const int32_t* lptr, const int32_t* rptr, int32_t* next, int32_t* lind,
                               int32_t* rind) noexcept nogil:
    """Rows of every column of L, and columns of every row, both ascending."""
    cdef int32_t j, k, p
    column_pattern(n, nptr, nind, parent, mark, lptr, next, lind)
    for k in range(n):
        next[k] = rptr[k]
    for j in range(n):
        for p in range(lptr[j], lptr[j + 1]):
            k = lind[p]
            rind[next[k]] = j
            next[k] += 1


cdef inline void postorder_of(int32_t n, const int32_t* parent, int32_t* child, int32_t* sibling, int32_t* stack,
                              int32_t* rank) noexcept nogil:
    """rank (n): place of each column after its children and beside them; roots, and siblings, in their order."""
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


cdef inline void lower_of(int32_t n, const int32_t* ptr, const int32_t* near, const int32_t* rank, const int32_t* order,
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


cdef inline void postordered(int32_t n, const int32_t* ptr, const int32_t* near, int32_t* order, int32_t* rank, int32_t* nptr,
                             int32_t* nind, int32_t* parent, int32_t* scratch) noexcept nogil:
    """An order of a graph with columns of one pattern beside each other, which keeps the fill, and the lower pattern in it.

    scratch (4 n); `parent` is the tree of the order as it came.
    """
    cdef int32_t i
    for i in range(n):
        rank[order[i]] = i
    lower_of(n, ptr, near, rank, order, nptr, nind)
    tree_of(n, nptr, nind, parent, scratch)
    postorder_of(n, parent, scratch, scratch + n, scratch + 2 * n, scratch + 3 * n)
    for i in range(n):
        rank[i] = scratch[3 * n + rank[i]]
    for i in range(n):
        order[rank[i]] = i
    lower_of(n, ptr, near, rank, order, nptr, nind)
