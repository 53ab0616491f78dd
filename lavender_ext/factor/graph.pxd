"""An elimination order of bodies, and the pattern of the matrix over them in that order.

Bodies with a common block are neighbours. Bodies are ordered by minimum degree (`minimum_degree.pxd`), such that columns of the
factor with the same pattern are adjacent. If the factor takes much work, nested dissection (`dissection.pxd`) orders them if its
factor takes less.
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy

from lavender_ext.factor.minimum_degree cimport minimum_degree_order
from lavender_ext.factor.dissection cimport order_by_dissection
from lavender_ext.factor.symbolic cimport apply_postorder, compute_block_elimination_tree


cdef inline double count_block_products(int32_t n, const int32_t* nptr, const int32_t* nind, int32_t* scratch) noexcept nogil:
    """Return the number of products of blocks in the factor of a lower pattern; scratch has 4 n entries."""
    cdef int32_t i
    cdef int32_t* column_count = scratch + 3 * n
    cdef double work = 0.0
    compute_block_elimination_tree(n, nptr, nind, scratch, scratch + n, scratch + 2 * n, column_count)
    for i in range(n):
        work += 0.5 * column_count[i] * <double>column_count[i]
    return work


cdef inline int64_t order_workspace_size(int64_t n, int64_t neighbours) noexcept nogil:
    """Return the number of int32 of scratch for `order_graph`, aligned to 8 bytes."""
    return 13 * n + 2 + neighbours + neighbours // 4


cdef inline void order_graph(int32_t n, const int32_t* ptr, const int32_t* near, int32_t* scratch, int32_t* order,
                             int32_t* rank, int32_t* nptr, int32_t* nind, int32_t* parent) noexcept nogil:
    """Compute an elimination order (n) of the vertices of a graph, the rank (n) of each, and the lower pattern in this order.

    near[ptr[i]:ptr[i + 1]] are the neighbours of i, without i. scratch has `order_workspace_size`, nind half as many entries as
    near plus n.
    """
    cdef int64_t* outside = <int64_t*>scratch
    cdef int32_t* integers = scratch + 2 * n            # 8 n + 1
    cdef int32_t* head = integers + 8 * n + 1           # n + 1
    cdef int32_t* size = head + n + 1
    cdef int32_t* lists = size + n                      # remaining integers of `scratch`
    cdef int32_t i
    cdef double work
    for i in range(n):
        size[i] = 1
    memcpy(integers, ptr, (n + 1) * sizeof(int32_t))
    if ptr[n]:                                          # `near` may be NULL if there are no neighbours.
        memcpy(lists, near, ptr[n] * sizeof(int32_t))
    minimum_degree_order(n, size, ptr[n] + ptr[n] // 4 + n, lists, integers, outside, head, order)
    apply_postorder(n, ptr, near, order, rank, nptr, nind, parent, integers)
    work = count_block_products(n, nptr, nind, scratch)
    # 7e5 products of blocks of 6 rows are 1.5e8 multiply-adds, which take 17 ms. Nested dissection takes 4 ms for such a pile of
    # 512 bodies, and saves 0.1 of the work; for 1,000, 4,096 and 8,000 bodies it saves 0.26, 0.53 and 0.64.
    if work < 7e5:
        return
    memcpy(scratch + 12 * n, order, n * sizeof(int32_t))
    order_by_dissection(n, ptr, near, rank, scratch, order)
    apply_postorder(n, ptr, near, order, rank, nptr, nind, parent, scratch)
    if count_block_products(n, nptr, nind, scratch) >= work:
        memcpy(order, scratch + 12 * n, n * sizeof(int32_t))
        apply_postorder(n, ptr, near, order, rank, nptr, nind, parent, scratch)


cdef inline int64_t pattern_workspace_size(int64_t n, int64_t k) noexcept nogil:
    """Return the number of int32 of scratch for `order_bodies_and_list_block_rows` of n bodies and k blocks, aligned to 8 bytes."""
    return order_workspace_size(n, 2 * k) + 3 * n + 1 + 2 * k


cdef inline void find_neighbours(int32_t k, const int32_t* body, int32_t n, int32_t* mark, int32_t* ptr,
                                 int32_t* near) noexcept nogil:
    """List the neighbours of body i, each once, in near[ptr[i]:ptr[i + 1]]; near has 2 k entries, mark (n) is scratch."""
    cdef int32_t i, a, b, q, to = 0, first = 0
    for i in range(n + 1):
        ptr[i] = 0
    for i in range(k):
        a = body[2 * i]
        b = body[2 * i + 1]
        if a >= 0 and b >= 0 and a != b:
            ptr[a + 1] += 1
            ptr[b + 1] += 1
    for i in range(n):
        ptr[i + 1] += ptr[i]
        mark[i] = ptr[i]
    for i in range(k):
        a = body[2 * i]
        b = body[2 * i + 1]
        if a >= 0 and b >= 0 and a != b:
            near[mark[a]] = b
            near[mark[b]] = a
            mark[a] += 1
            mark[b] += 1
    for i in range(n):
        mark[i] = -1
    for i in range(n):
        b = ptr[i + 1]
        for q in range(first, b):
            if mark[near[q]] != i:
                mark[near[q]] = i
                near[to] = near[q]
                to += 1
        first = b
        ptr[i + 1] = to


cdef inline void order_bodies_and_list_block_rows(int32_t k, const int32_t* body, int32_t n, int32_t* scratch, int32_t* parent,
                                  int32_t* nptr, int32_t* nind, int32_t* node, int32_t* slot, int32_t* swapped) noexcept nogil:
    """Order the bodies of blocks (k, 2), -1 if static, and list the lower block rows of the matrix over them in that order.

    node (k, 2) receives the ranks of each block's bodies, the larger first, slot (k, 3) its entries first-first, second-second
    and first-second, swapped (k) whether its bodies are exchanged. parent is (n), nptr (n + 1), nind (n + k); scratch has
    `pattern_workspace_size`.
    """
    cdef int32_t* order = scratch + order_workspace_size(n, 2 * k)
    cdef int32_t* rank = order + n
    cdef int32_t* ptr = rank + n                        # n + 1
    cdef int32_t* near = ptr + n + 1                    # 2 k
    cdef int32_t i, r, a, b, q
    find_neighbours(k, body, n, rank, ptr, near)
    order_graph(n, ptr, near, scratch, order, rank, nptr, nind, parent)
    for i in range(k):
        a = rank[body[2 * i]] if body[2 * i] >= 0 else -1
        b = rank[body[2 * i + 1]] if body[2 * i + 1] >= 0 else -1
        swapped[i] = a < b
        if a < b:
            r = a
            a = b
            b = r
        node[2 * i] = a
        node[2 * i + 1] = b
        slot[3 * i] = slot[3 * i + 1] = slot[3 * i + 2] = 0
        if a < 0:
            continue
        slot[3 * i] = nptr[a + 1] - 1
        if b >= 0:
            slot[3 * i + 1] = nptr[b + 1] - 1
            for q in range(nptr[a], nptr[a + 1]):
                if nind[q] == b:
                    slot[3 * i + 2] = q
