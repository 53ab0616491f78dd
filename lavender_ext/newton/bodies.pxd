"""Build the elimination order and the panel K of Newton's method over bodies, in workspace that the caller provides.

`order_bodies` needs `index_workspace_size`. The pattern of the factor then needs `factor_index_size`, its values
`body_workspace_size`, with six columns for each body. A caller that allocates after the ordering may bind fewer columns.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memset

from lavender_ext.core.block_types cimport COULOMB, blocks_t
from lavender_ext.core.view cimport get_block_bodies, generalized_t, rows_t, view_t
from lavender_ext.factor.graph cimport order_bodies_and_list_block_rows, pattern_workspace_size
from lavender_ext.factor.linear cimport (BLOCKS, NO_FACTOR, bind_block_factor, block_factor_index_size, block_factor_size,
                                         block_pattern_index_size)
from lavender_ext.factor.symbolic cimport compute_block_elimination_tree
from lavender_ext.newton.elements cimport elements_t
from lavender_ext.newton.panel cimport compute_panel, factor_inertia
from lavender_ext.newton.run cimport (bind_index_workspace, bind_real_workspace, method_index_size, method_real_size,
                                      newton_t)
from lavender_ext.newton.scaling cimport is_problem_supported, scaled_t
from lavender_ext.newton.system cimport BODIES


cdef inline int64_t index_workspace_size(const blocks_t* p, const rows_t* r) noexcept nogil:
    """Return the number of int32 for `order_bodies` if every row were an element; 0 if the method does not apply."""
    cdef int64_t k = p.n_rows, n = r.n_bodies
    if n == 0 or k == 0 or not is_problem_supported(p):
        return 0
    return order_index_size(n, k) + method_index_size(k) + 1


cdef inline int64_t factor_index_size(int64_t n, int64_t blocks, int64_t below) noexcept nogil:
    """Return the number of int32 for the factor of n bodies. N has `blocks` blocks, and L has `below` off-diagonal blocks."""
    return block_pattern_index_size(n, 6, blocks, below) + block_factor_index_size(n, 6)


cdef inline int64_t order_index_size(int64_t n, int64_t k) noexcept nogil:
    """Return the number of int32 of `index_workspace_size` that the elimination order of n bodies and k elements uses."""
    # Scratch of the elimination order, four vectors over the bodies, the pattern of N, and the elements.
    return pattern_workspace_size(n, k) + 4 * (n + 1) + (n + k + 1) + 9 * (k + 1)


cdef struct pattern_t:
    int32_t n                   # bodies
    int32_t k                   # elements
    int32_t* scratch            # `pattern_workspace_size`
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


cdef inline int32_t* bind_pattern_workspace(pattern_t* a, int32_t* index, int64_t n, int64_t k) noexcept nogil:
    """Bind the pattern of n bodies and k elements to `index` (aligned to 8 bytes); return the first unused int32."""
    a.n, a.k = <int32_t>n, <int32_t>k
    a.scratch = index
    a.parent = index + pattern_workspace_size(n, k)
    a.mark = a.parent + n + 1
    a.nptr = a.mark + n + 1
    a.lptr = a.nptr + n + 1
    a.nind = a.lptr + n + 1
    a.group = a.nind + n + k + 1
    a.body = a.group + k + 1
    a.node = a.body + 2 * k
    a.slot = a.node + 2 * k
    a.swapped = a.slot + 3 * k
    return index + order_index_size(n, k)


cdef inline void bind_bodies(newton_t* s, pattern_t* a, int32_t* index, const blocks_t* p, const rows_t* r) noexcept nogil:
    """Bind the integers of s and a to `index` (`index_workspace_size` int32)."""
    bind_index_workspace(s, p.n_rows, bind_pattern_workspace(a, index, r.n_bodies, p.n_rows))


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


cdef inline int64_t order_elements(const scaled_t* s, pattern_t* a, const rows_t* r) noexcept nogil:
    """Order the bodies of the elements that `index_unfixed_elements` found; return the off-diagonal blocks of L."""
    cdef int32_t i
    cdef const int32_t* body
    a.k = s.e.n
    for i in range(a.k):
        body = get_block_bodies(r, s.block[i])
        a.body[2 * i] = body[0]
        a.body[2 * i + 1] = body[1]
    return order_bodies(a)


cdef inline bint needs_lu(const newton_t* s, const blocks_t* p) noexcept nogil:
    """Return whether N may lack symmetry: under Coulomb's law with friction."""
    return p.law == COULOMB and s.sc.e.n < s.sc.e.m


cdef inline int64_t body_workspace_size(const newton_t* s, const blocks_t* p, const rows_t* r) noexcept nogil:
    """Return the number of doubles that `bind_body_workspace` assigns, after `analyse_blocks`."""
    return (12 * <int64_t>p.n_rows + 10 * <int64_t>r.n_bodies + method_real_size(p.n_rows, s.sc.small) + 6 * <int64_t>r.n_bodies
            + block_factor_size(&s.linear.blocks, needs_lu(s, p)))


cdef inline int32_t group_elements_by_bodies(elements_t* e, int32_t* group) noexcept nogil:
    """List the groups of consecutive elements between the same two bodies in group (n + 1); return the number of groups."""
    cdef int32_t k, h = 0
    for k in range(e.n):
        if k == 0 or e.node[2 * k] != e.node[2 * k - 2] or e.node[2 * k + 1] != e.node[2 * k - 1]:
            group[h] = k
            h += 1
    group[h] = e.n
    e.group, e.n_groups = group, h
    return h


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


cdef inline void bind_panel_and_factor(newton_t* s, const pattern_t* a, double* panel, const int32_t* column, int32_t size,
                             bint lu, int32_t wide, int32_t* index, double* y, double* real) noexcept nogil:
    """Bind the panel (rows, 12), with these columns of each body, and the factor after `analyse_blocks`.

    index has `block_factor_index_size`, y n size, real `block_factor_size`.
    """
    if s.sc.e.m:
        remove_fixed_rows_and_columns(&s.sc, a.swapped, column, size, panel)
    s.s.form, s.s.symmetric, s.s.y = BODIES, 1, y
    s.sc.e.s, s.sc.e.panel, s.sc.e.node, s.sc.e.slot = size, panel, a.node, a.slot
    group_elements_by_bodies(&s.sc.e, a.group)
    s.linear.kind, s.linear.n, s.linear.factored = BLOCKS, s.linear.blocks.factor.n, NO_FACTOR
    bind_block_factor(&s.linear.blocks, lu, wide, index, real)


cdef inline void bind_body_workspace(newton_t* s, pattern_t* a, double* real, const view_t* v, int32_t wide,
                                     int32_t* index) noexcept nogil:
    """Bind all values of s in real (`body_workspace_size`), and the factor's integers in index (`block_factor_index_size`)."""
    cdef const blocks_t* p = &v.p
    cdef const rows_t* r = v.r
    cdef int32_t i
    cdef int32_t column[6]
    cdef double* panel
    cdef double* x
    memset(real, 0, method_real_size(p.n_rows, s.sc.small) * sizeof(double))
    panel = bind_real_workspace(s, v, real)
    x = panel + 12 * <int64_t>p.n_rows
    for i in range(6):
        column[i] = i
    form_panel(p, r, x, panel)
    x += 10 * <int64_t>r.n_bodies
    bind_panel_and_factor(s, a, panel, column, 6, needs_lu(s, p), wide, index, x, x + 6 * <int64_t>r.n_bodies)
