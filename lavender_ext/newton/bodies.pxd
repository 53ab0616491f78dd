"""Build the elimination order and the panel K of Newton's method over bodies, in workspace that the caller provides.

`order_bodies` needs `bind_pattern`. The sizes of the factor's pattern and of its values follow from the order. A caller that
allocates after the ordering may bind fewer than six columns for each body.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.arena cimport arena_t, take_integers
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport generalized_t, rows_t
from lavender_ext.factor.graph cimport order_bodies_and_list_block_rows, pattern_workspace_size
from lavender_ext.factor.linear cimport BLOCKS, NO_FACTOR
from lavender_ext.factor.symbolic cimport compute_block_elimination_tree
from lavender_ext.newton.elements cimport elements_t
from lavender_ext.newton.panel cimport compute_panel, factor_inertia
from lavender_ext.newton.run cimport newton_t
from lavender_ext.newton.scaling cimport scaled_t
from lavender_ext.newton.system cimport BODIES


cdef struct pattern_t:
    int32_t n                   # bodies
    int32_t k                   # elements
    int32_t* scratch            # `pattern_workspace_size` of graph.pxd
    int32_t* parent
    int32_t* mark
    int32_t* nptr
    int32_t* nind
    int32_t* lptr
    int32_t* group
    int32_t* body
    int32_t* node
    int32_t* slot
    int32_t* swapped


cdef inline void bind_pattern(pattern_t* a, int64_t n, int64_t k, arena_t* arena) noexcept nogil:
    """Take the arrays for the elimination order of n bodies and k elements; the arena's integers are aligned to 8 bytes."""
    a.n, a.k = <int32_t>n, <int32_t>k
    a.scratch = take_integers(arena, pattern_workspace_size(n, k))
    a.parent, a.mark, a.nptr, a.lptr = (take_integers(arena, n + 1), take_integers(arena, n + 1), take_integers(arena, n + 1),
                                        take_integers(arena, n + 1))
    a.nind, a.group = take_integers(arena, n + k + 1), take_integers(arena, k + 1)
    a.body, a.node, a.slot = take_integers(arena, 2 * k), take_integers(arena, 2 * k), take_integers(arena, 3 * k)
    a.swapped = take_integers(arena, k)


cdef inline int64_t order_bodies(pattern_t* a) noexcept nogil:
    """Order the bodies of a.body (k, 2) for elimination, and list the blocks of N; return the off-diagonal blocks of L."""
    cdef int32_t i
    cdef int64_t below = 0
    order_bodies_and_list_block_rows(a.k, a.body, a.n, a.scratch, a.parent, a.nptr, a.nind, a.node, a.slot, a.swapped)
    compute_block_elimination_tree(a.n, a.nptr, a.nind, a.parent, a.mark, a.scratch, a.lptr + 1)
    a.lptr[0] = 0
    for i in range(a.n):
        below += a.lptr[i + 1]
        if below <= 2147483647:
            a.lptr[i + 1] += a.lptr[i]
    return below


cdef inline void remove_fixed_rows_and_columns(const scaled_t* s, const int32_t* swapped, const int32_t* column, int32_t size,
                              double* panel) noexcept nogil:
    """Compress a panel (rows, 12) in place: keep the rows that are not fixed, and `size` columns of each body.

    The two bodies of an element are exchanged if `swapped`.
    """
    cdef int32_t i, j, k
    cdef double x[12]
    cdef double* row
    for k in range(s.e.n):
        for j in range(s.e.ptr[k], s.e.ptr[k + 1]):
            row = panel + 12 * <int64_t>s.keep[j]
            for i in range(size):
                x[i] = row[column[i] + (6 if swapped[k] else 0)]
                x[size + i] = row[column[i] + (0 if swapped[k] else 6)]
            row = panel + 2 * size * <int64_t>j
            for i in range(2 * size):
                row[i] = x[i]


cdef inline void form_panel(const blocks_t* p, const rows_t* r, double* root, double* panel) noexcept nogil:
    """Compute K (rows, 12) of bodies; root (10 n_bodies) is scratch."""
    cdef int32_t i, n = r.n_bodies
    factor_inertia(n, r.inv_inertia, root)
    for i in range(n):
        root[9 * <int64_t>n + i] = sqrt(r.inv_mass[i])
    compute_panel(p, r, root, root + 9 * <int64_t>n, panel)


cdef inline void form_velocity_panel(const blocks_t* p, const generalized_t* g, const int32_t* body, const int32_t* column,
                                     double* panel) noexcept nogil:
    """Compute K (rows, 12) from J and M whose velocities belong to bodies: column (n), body (n_blocks, 2)."""
    cdef int32_t i, j, q, c, b, nc
    cdef const double* y
    cdef double* row
    for i in range(p.n_blocks):
        b = g.home[i]
        nc = g.pcol[b + 1] - g.pcol[b]
        for j in range(p.ptr[i], p.ptr[i + 1]):
            y = g.y + g.pval[b] + <int64_t>(j - g.prow[b]) * nc
            row = panel + 12 * <int64_t>j
            for q in range(nc):
                c = column[g.cols[g.pcol[b] + q]]
                row[c % 6 + (0 if c // 6 == body[2 * i] else 6)] = y[q] / sqrt(p.d[j])


cdef inline void use_panel(newton_t* s, const pattern_t* a, double* panel, const int32_t* column, int32_t size,
                           double* y) noexcept nogil:
    """Use the panel (rows, 12) with these columns of each body; y (n size) is scratch. The factor is bound separately."""
    cdef elements_t* e = &s.sc.e
    cdef int32_t k, h = 0
    if e.m:
        remove_fixed_rows_and_columns(&s.sc, a.swapped, column, size, panel)
    s.s.form, s.s.symmetric, s.s.y = BODIES, 1, y
    e.s, e.panel, e.node, e.slot, e.group = size, panel, a.node, a.slot, a.group
    for k in range(e.n):
        if k == 0 or e.node[2 * k] != e.node[2 * k - 2] or e.node[2 * k + 1] != e.node[2 * k - 1]:
            a.group[h] = k
            h += 1
    a.group[h], e.n_groups = e.n, h
    s.linear.kind, s.linear.n, s.linear.factored = BLOCKS, s.linear.blocks.factor.n, NO_FACTOR
