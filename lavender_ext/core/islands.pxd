"""Islands: sets of blocks that no other block can influence.

Two blocks are connected if they share a moving body, a kinematic tree of M or a non-zero entry of A. An island is a connected
component of blocks. A block that touches no moving body is an island of its own; a body moves if its inverse mass or an entry
of its inverse inertia is not 0. Components are found by union-find with
path halving; islands are numbered in the order of their first block.
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.order cimport sort_blocks_by_level
from lavender_ext.core.block_types cimport blocks_t, islands_t
from lavender_ext.core.roots cimport find_root
from lavender_ext.core.view cimport get_moving_body, csr_t, generalized_t, rows_t, view_t


cdef inline int32_t merge_components(int32_t* parent, int32_t i, int32_t j) noexcept nogil:
    """Connect the components of i and j; return 1 if these were different. The smaller of their roots stays a root."""
    i = find_root(parent, i)
    j = find_root(parent, j)
    if i < j:
        parent[j] = i
    else:
        parent[i] = j
    return i != j


cdef inline int32_t merge_with_first_at(int32_t* first, int32_t place, int32_t i, int32_t* parent) noexcept nogil:
    """Connect block i with the first block seen at `place`; return 1 if that merged two components."""
    if first[place] < 0:
        first[place] = i
        return 0
    return merge_components(parent, first[place], i)


cdef inline int32_t connect_blocks_by_bodies(const rows_t* r, int32_t k, int32_t* parent, int32_t* first) noexcept nogil:
    """Connect k blocks that share a moving body; return the number of components. first (n_bodies) is scratch."""
    cdef int32_t i, side, body, count = k
    for body in range(r.n_bodies):
        first[body] = -1
    for i in range(k):
        for side in range(2):
            body = get_moving_body(r, i, side)
            if body >= 0:
                count -= merge_with_first_at(first, body, i, parent)
    return count


cdef inline int32_t connect_blocks_by_matrix(const blocks_t* p, const csr_t* a, int32_t* parent, int32_t* block) noexcept nogil:
    """Connect blocks that share a nonzero entry of A; return the number of components. block (m) is scratch."""
    cdef int32_t i, j, q, count = p.n_blocks
    for i in range(p.n_blocks):
        for j in range(p.ptr[i], p.ptr[i + 1]):
            block[j] = i
    for i in range(p.n_blocks):
        for j in range(p.ptr[i], p.ptr[i + 1]):
            for q in range(a.indptr[j], a.indptr[j + 1]):
                if block[a.indices[q]] != i and a.data[q] != 0.0:
                    count -= merge_components(parent, i, block[a.indices[q]])
        if count == 1:
            break
    return count


cdef inline int32_t connect_blocks_by_trees(const blocks_t* p, const generalized_t* g, int32_t* parent,
                                            int32_t* first) noexcept nogil:
    """Connect blocks with a common root of a tree of M in their panels; return the number of components. first (n) is scratch."""
    cdef int32_t i, q, trees = 0, count = p.n_blocks
    for i in range(g.n):
        first[i] = -1
        trees += g.parent[i] < 0
    for i in range(p.n_blocks):
        for q in range(g.pcol[g.home[i]], g.pcol[g.home[i] + 1]):
            if g.parent[g.cols[q]] < 0:
                count -= merge_with_first_at(first, g.cols[q], i, parent)
                if trees == 1:
                    break
    return count


cdef inline int64_t island_workspace_integers(const view_t* v) noexcept nogil:
    """Return the number of int32 that `find_islands` needs."""
    cdef int64_t k = v.p.n_blocks
    cdef int64_t scratch = v.g.n if v.g != NULL else v.r.n_bodies if v.r != NULL else v.p.n_rows
    return 4 * k + 1 + scratch


cdef inline int32_t find_islands(const view_t* v, int32_t* index, islands_t* out) noexcept nogil:
    """Return the number of islands; if there are several, `out` receives them.

    The arrays of `out` are in `index` (`island_workspace_integers`).
    """
    cdef int32_t i, k = v.p.n_blocks, count
    cdef int32_t* label = index
    cdef int32_t* order = index + k
    cdef int32_t* ptr = order + k
    cdef int32_t* parent = ptr + k + 1
    if k <= 1:
        return 1
    for i in range(k):
        parent[i] = i
    if v.g != NULL:
        count = connect_blocks_by_trees(&v.p, v.g, parent, parent + k)
    elif v.r != NULL:
        count = connect_blocks_by_bodies(v.r, k, parent, parent + k)
    else:
        count = connect_blocks_by_matrix(&v.p, v.a, parent, parent + k)
    if count == 1:
        return 1
    count = 0
    for i in range(k):
        if find_root(parent, i) == i:
            label[i] = count
            count += 1
        else:
            label[i] = label[find_root(parent, i)]
    sort_blocks_by_level(k, label, count, ptr, order)
    out.n, out.label, out.ptr, out.order = count, label, ptr, order
    out.terms = NULL
    return count
