"""Analysis of a sparse matrix for factorisation: rows of one pattern, an order of minimum degree, supernodes.

Consecutive rows with the same columns are one vertex; its size is the number of these rows.
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.factor.minimum_degree cimport minimum_degree_order
from lavender_ext.factor.symbolic cimport apply_postorder, compute_block_elimination_tree


cdef int32_t find_equal_rows(int32_t n, const int32_t* indptr, const int32_t* indices, int32_t* vertex,
                             int32_t* first) noexcept nogil:
    """Group consecutive rows with the same columns to vertices: write the vertex of each row.

    `first` (n + 1) receives the first row of each vertex, then n.

    Return the number of vertices.
    """
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
        vertex[i] = count - 1
    first[count] = n
    return count


cdef int32_t find_vertex_graph(int32_t count, const int32_t* indptr, const int32_t* indices, const int32_t* vertex,
                               const int32_t* first, int32_t* ptr, int32_t* neighbour) noexcept nogil:
    """List the neighbours of each vertex, without itself; return the length of all lists. Columns must ascend."""
    cdef int32_t k, q, j, last, total = 0
    for k in range(count):
        ptr[k] = total
        last = k
        for q in range(indptr[first[k]], indptr[first[k] + 1]):
            j = vertex[indices[q]]
            if j != last and j != k:
                neighbour[total] = j
                total += 1
                last = j
    ptr[count] = total
    return total


cdef int32_t order_rows(int32_t n, const int32_t* indptr, const int32_t* indices, int32_t workspace, int32_t* scratch,
                        int64_t* outside, int32_t* begin, int32_t* order, int32_t* size, int32_t* nptr, int32_t* nind,
                        int32_t* parent, int32_t* lptr) noexcept nogil:
    """Order the vertices of a symmetric pattern for elimination, and count the columns of L.

    begin (n + 1) receives the first row of each vertex as they stand; order, size (n), nptr (n + 1), nind (nnz / 2 + n + 1),
    parent (n) and lptr (n + 1) belong to the order. scratch has 11 n + 3 + workspace entries, where workspace is at least
    nnz + nnz / 4 + n; outside has n entries. Return the number of vertices, or -1 if L has 2^31 entries or more.
    """
    cdef int32_t* vertex = scratch
    cdef int32_t* graph_ptr = scratch + n               # n + 1
    cdef int32_t* head = scratch + 2 * n + 1            # n + 1
    cdef int32_t* integers = scratch + 3 * n + 2        # 8 n + 1
    cdef int32_t* neighbour = scratch + 11 * n + 3
    cdef int32_t* rank = vertex
    cdef int32_t count, i, k, total
    cdef int64_t below = 0
    count = find_equal_rows(n, indptr, indices, vertex, begin)
    total = find_vertex_graph(count, indptr, indices, vertex, begin, graph_ptr, neighbour)
    for i in range(count):
        integers[i] = graph_ptr[i]
        size[i] = begin[i + 1] - begin[i]
    integers[count] = total
    minimum_degree_order(count, size, workspace, neighbour, integers, outside, head, order)
    # The order has overwritten the lists of the graph.
    total = find_vertex_graph(count, indptr, indices, vertex, begin, graph_ptr, neighbour)
    apply_postorder(count, graph_ptr, neighbour, order, rank, nptr, nind, parent, integers)
    for i in range(count):
        size[i] = begin[order[i] + 1] - begin[order[i]]
    compute_block_elimination_tree(count, nptr, nind, parent, integers, integers + n, lptr + 1)
    lptr[0] = 0
    for k in range(count):
        below += lptr[k + 1]
        if below >= 2147483647:
            return -1
        lptr[k + 1] += lptr[k]
    return count
