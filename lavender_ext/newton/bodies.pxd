"""What Newton's method over bodies factors, from a problem's own arrays: an order of elimination and a panel, in given workspace.

First the memory of the pattern (`index_workspace_size`, `bind_pattern_workspace`, `make_pattern`), then the numbers
(`body_workspace_size`,
`furnish_bodies`), six columns for a body. A host that allocates in between gives the factor's pattern its workspace after
`order_bodies`, and its numbers theirs, of fewer columns, by `factor_workspace_size` and `furnish_factor`.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memset

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport bodies_of, generalized_t, rows_t, view_t
from lavender_ext.factor.blocks cimport factor_t, sparse_t
from lavender_ext.factor.graph cimport eliminate_bodies, pattern_workspace_size
from lavender_ext.factor.symbolic cimport block_pattern, block_tree
from lavender_ext.newton.elements cimport elements_t
from lavender_ext.newton.panel cimport fill_panel, inertia_root
from lavender_ext.newton.run cimport bind_real_workspace, bind_index_workspace, newton_t, own_index, own_workspace_size
from lavender_ext.newton.scaling cimport find_elements, is_known, scaled_t
from lavender_ext.newton.system cimport BODIES


cdef enum:
    MOST_BODIES = 1500          # whose factor has workspace as if it were full
    PARTS = 8                   # arrays of numbers of a factor


cdef inline int64_t index_workspace_size(const blocks_t* p, const rows_t* r) noexcept nogil:
    """Whole numbers that `bind_pattern_workspace` hands out, as if every row were an element; 0 where the method does not apply."""
    cdef int64_t k = p.n_rows, n = r.n_bodies
    if n == 0 or n > MOST_BODIES or k == 0 or not is_known(p):
        return 0
    return order_index(n, k) + n * (n - 1) + 2 + own_index(k)


cdef inline int64_t order_index(int64_t n, int64_t k) noexcept nogil:
    """Of that what `order_bodies` takes for n bodies and k elements."""
    # scratch of an order, six vectors of bodies and their pivots, the pattern of N, elements
    return pattern_workspace_size(n, k) + 12 * (n + 1) + (n + k + 1) + 9 * (k + 1)


cdef struct pattern_t:
    int32_t n                   # bodies
    int32_t k                   # elements
    int32_t* scratch            # `pattern_workspace_size`
    int32_t* parent
    int32_t* mark
    int32_t* nptr
    int32_t* nind
    int32_t* lptr
    int32_t* rptr
    int32_t* lind
    int32_t* rind
    int32_t* pivot
    int32_t* next
    int32_t* group
    int32_t* body
    int32_t* node
    int32_t* slot
    int32_t* turned


cdef inline int32_t* bind_pattern_workspace(pattern_t* a, int32_t* index, int64_t n, int64_t k, int64_t most) noexcept nogil:
    """Places in index, a multiple of 8 bytes, for k elements, and for `most` blocks of L; where the next begins."""
    a.n, a.k = <int32_t>n, <int32_t>k
    a.scratch = index
    a.parent = index + pattern_workspace_size(n, k)
    a.mark = a.parent + n + 1
    a.nptr = a.mark + n + 1
    a.lptr = a.nptr + n + 1
    a.rptr = a.lptr + n + 1
    a.next = a.rptr + n + 1
    a.pivot = a.next + n + 1
    a.nind = a.pivot + 6 * n + 1
    a.group = a.nind + n + k + 1
    a.body = a.group + k + 1
    a.node = a.body + 2 * k
    a.slot = a.node + 2 * k
    a.turned = a.slot + 3 * k
    a.lind = a.turned + k
    a.rind = a.lind + most + 1
    return a.rind + most + 1


cdef inline void bind_bodies(newton_t* s, pattern_t* a, int32_t* index, const blocks_t* p, const rows_t* r) noexcept nogil:
    """Places in index (`index_workspace_size`) for s and a."""
    cdef int64_t n = r.n_bodies
    bind_index_workspace(s, p.n_rows, bind_pattern_workspace(a, index, n, p.n_rows, n * (n - 1) // 2))


cdef inline int64_t order_bodies(pattern_t* a) noexcept nogil:
    """An elimination order of the bodies of a.body (k, 2), and the blocks of N; how many its factor has below."""
    cdef int32_t i
    cdef int64_t below = 0
    eliminate_bodies(a.k, a.body, a.n, a.scratch, a.parent, a.nptr, a.nind, a.node, a.slot, a.turned)
    block_tree(a.n, a.nptr, a.nind, a.parent, a.mark, a.rptr + 1, a.lptr + 1)
    a.lptr[0] = 0
    a.rptr[0] = 0
    for i in range(a.n):
        below += a.lptr[i + 1]
        if below <= 2147483647:
            a.lptr[i + 1] += a.lptr[i]
            a.rptr[i + 1] += a.rptr[i]
    return below


cdef inline void make_pattern(const scaled_t* s, pattern_t* a, const rows_t* r) noexcept nogil:
    """An elimination order of the bodies, the blocks of N and of its factor, of elements that were found."""
    cdef int32_t i
    cdef const int32_t* body
    a.k = s.e.n
    for i in range(a.k):
        body = bodies_of(r, s.block[i])
        a.body[2 * i] = body[0]
        a.body[2 * i + 1] = body[1]
    order_bodies(a)
    block_pattern(a.n, a.nptr, a.nind, a.parent, a.mark, a.lptr, a.rptr, a.scratch, a.lind, a.rind)


cdef inline int64_t factor_workspace_size(const pattern_t* a, int32_t s, bint lu, bint panels, int64_t* size) noexcept nogil:
    """Doubles of the PARTS that `furnish_factor` takes, and of all; lu: L U may be asked for; panels: L stands in some."""
    cdef int64_t i, b = s * s, n = a.n, below = a.lptr[n] * b, all_ = 0
    size[0], size[1], size[2] = n * s, a.nptr[n] * b, a.nptr[n] * b * lu
    size[3], size[4], size[5] = 0 if panels else below, below * lu, n * b
    size[6], size[7] = n * b, n * b * lu
    for i in range(PARTS):
        all_ += size[i]
    return all_


cdef inline int64_t body_workspace_size(const newton_t* s, const pattern_t* a, const blocks_t* p, const rows_t* r) noexcept nogil:
    """Doubles that `furnish_bodies` hands out, after `make_pattern`."""
    cdef int64_t size[PARTS]
    return (12 * <int64_t>p.n_rows + 10 * <int64_t>r.n_bodies + own_workspace_size(p.n_rows, s.sc.small)
            + factor_workspace_size(a, 6, 1, 0, size))


cdef inline int32_t find_groups(elements_t* e, int32_t* group) noexcept nogil:
    """Runs of elements between the same bodies, in group (n + 1)."""
    cdef int32_t k, h = 0
    for k in range(e.n):
        if k == 0 or e.node[2 * k] != e.node[2 * k - 2] or e.node[2 * k + 1] != e.node[2 * k - 1]:
            group[h] = k
            h += 1
    group[h] = e.n
    e.group, e.n_groups = group, h
    return h


cdef inline void narrow_panel(const scaled_t* s, const int32_t* turned, const int32_t* column, int32_t size,
                              double* panel) noexcept nogil:
    """Of a panel (rows, 12) the rows that move and `size` columns of each body, changed over where turned, in place."""
    cdef int32_t i, j, k
    cdef double x[12]
    cdef double* row
    for k in range(s.e.n):
        for j in range(s.e.ptr[k], s.e.ptr[k + 1]):
            row = panel + 12 * <int64_t>s.keep[j]
            for i in range(size):
                x[i] = row[column[i] + (6 if turned[k] else 0)]
                x[size + i] = row[column[i] + (0 if turned[k] else 6)]
            row = panel + 2 * size * <int64_t>j
            for i in range(2 * size):
                row[i] = x[i]


cdef inline void panel_of(const blocks_t* p, const rows_t* r, double* root, double* panel) noexcept nogil:
    """K (rows, 12); root (10 n_bodies) is scratch."""
    cdef int32_t i, n = r.n_bodies
    inertia_root(n, r.inv_inertia, root)
    for i in range(n):
        root[9 * <int64_t>n + i] = sqrt(r.inv_mass[i])
    fill_panel(p, r, root, root + 9 * <int64_t>n, panel)


cdef inline void panel_of_velocities(const blocks_t* p, const generalized_t* g, const int32_t* body, const int32_t* column,
                                     double* panel) noexcept nogil:
    """K (rows, 12) where velocities are those of bodies: column (n), body (n_blocks, 2) of `graph.bodies_in`."""
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


cdef inline void furnish_factor(newton_t* s, const pattern_t* a, double* panel, const int32_t* column, int32_t size,
                                const sparse_t* super, const int64_t* spot, double** x) noexcept nogil:
    """Panel (rows, 12), of each body these columns alone, and the factor in PARTS of zeros; super: its panels."""
    cdef factor_t* f = &s.blocks
    if s.sc.e.m:
        narrow_panel(&s.sc, a.turned, column, size, panel)
    s.s.form, s.s.symmetric, s.s.y = BODIES, 1, x[0]
    s.sc.e.s, s.sc.e.panel, s.sc.e.node, s.sc.e.slot = size, panel, a.node, a.slot
    find_groups(&s.sc.e, a.group)
    f.n, f.s, f.super, f.spot = a.n, size, super, spot
    f.nptr, f.nind, f.rptr, f.rind, f.lptr, f.lind = a.nptr, a.nind, a.rptr, a.rind, a.lptr, a.lind
    f.pivot, f.next = a.pivot, a.next
    f.nval, f.mval, f.lval, f.uval, f.dval, f.work, f.work2 = x[1], x[2], x[3], x[4], x[5], x[6], x[7]


cdef inline void bind_body_workspace(newton_t* s, pattern_t* a, double* real, const view_t* v) noexcept nogil:
    """Everything of s in real (`body_workspace_size`): what every form has, then panel and factor."""
    cdef const blocks_t* p = &v.p
    cdef const rows_t* r = v.r
    cdef int32_t i
    cdef int32_t column[6]
    cdef int64_t size[PARTS]
    cdef double* part[PARTS]
    cdef double* panel
    cdef double* x
    memset(real, 0, own_workspace_size(p.n_rows, s.sc.small) * sizeof(double))
    panel = bind_real_workspace(s, v, real)
    x = panel + 12 * <int64_t>p.n_rows
    for i in range(6):
        column[i] = i
    panel_of(p, r, x, panel)
    x += 10 * <int64_t>r.n_bodies
    memset(x, 0, factor_workspace_size(a, 6, 1, 0, size) * sizeof(double))
    for i in range(PARTS):
        part[i] = x
        x += size[i]
    furnish_factor(s, a, panel, column, 6, NULL, NULL, part)
