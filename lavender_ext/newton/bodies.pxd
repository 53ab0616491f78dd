"""Newton's method over bodies from a problem's own arrays: elements, an order of elimination, a panel, all in given room.

First what the pattern needs (`index_room`, `lay_pattern`, `make_pattern`), then, with it, the numbers (`real_room`,
`lay_bodies`). Six columns stand for a body.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t, uint64_t
from libc.string cimport memmove

from lavender_ext.core.block cimport blocks_t
from lavender_ext.core.rows cimport rows_t
from lavender_ext.factor.blocks cimport factor_t
from lavender_ext.factor.graph cimport body_order, lower_pattern
from lavender_ext.factor.symbolic cimport block_pattern, block_tree
from lavender_ext.newton.panel cimport fill_panel, inertia_root
from lavender_ext.newton.run cimport VECTORS, lay_vectors, newton_t
from lavender_ext.newton.scaling cimport (find_elements, is_known, lay_elements, lay_numbers, scale_elements, scaled_index,
                                          scaled_real, scaled_t)
from lavender_ext.newton.system cimport BODIES


cdef enum:
    MOST_BODIES = 1500          # whose neighbours bits hold


cdef struct bodies_t:           # what a `newton_t` over bodies points into
    scaled_t s
    factor_t f


cdef inline int64_t index_room(const blocks_t* p, const rows_t* r) noexcept nogil:
    """Whole numbers that `lay_pattern` hands out, as if every row were an element; 0 where a walk does not apply."""
    cdef int64_t k = p.n_rows, n = r.n_bodies
    if n == 0 or n > MOST_BODIES or k == 0 or not is_known(p):
        return 0
    # neighbours twice, eight vectors of bodies and their pivots, the pattern of N and of L, elements, sides of rows
    return (4 * n * ((n + 63) // 64) + 16 * (n + 1) + (n + k + 1) + n * (n - 1) + 2 + scaled_index(k) + 9 * (k + 1)
            + p.n_rows)


cdef struct pattern_t:
    uint64_t* near
    uint64_t* given
    int32_t* degree
    int32_t* rank
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
    int32_t* side
    scaled_t s


cdef inline void lay_pattern(pattern_t* a, int32_t* index, const blocks_t* p, const rows_t* r) noexcept nogil:
    """Places in index (`index_room`), which begins at a multiple of 8 bytes."""
    cdef int64_t n = r.n_bodies, words = (n + 63) // 64, k = p.n_rows
    a.near = <uint64_t*>index
    a.given = a.near + n * words
    a.degree = index + 4 * n * words
    a.rank = a.degree + n + 1
    a.parent = a.rank + n + 1
    a.mark = a.parent + n + 1
    a.nptr = a.mark + n + 1
    a.lptr = a.nptr + n + 1
    a.rptr = a.lptr + n + 1
    a.next = a.rptr + n + 1
    a.pivot = a.next + n + 1
    a.nind = a.pivot + 6 * n + 1
    a.lind = a.nind + n + k + 1
    a.rind = a.lind + n * (n - 1) // 2 + 1
    lay_elements(&a.s, k, a.rind + n * (n - 1) // 2 + 1)
    a.group = a.rind + n * (n - 1) // 2 + 1 + scaled_index(k)
    a.body = a.group + k + 1
    a.node = a.body + 2 * k
    a.slot = a.node + 2 * k
    a.turned = a.slot + 3 * k
    a.side = a.turned + k


cdef inline void make_pattern(pattern_t* a, const blocks_t* p, const rows_t* r) noexcept nogil:
    """Elements, an elimination order of the bodies, the blocks of N and of its factor."""
    cdef int32_t i, c, k, n = r.n_bodies
    cdef const int32_t* body
    find_elements(&a.s, p, NULL, r)
    k = a.s.e.n
    for i in range(k):
        c = a.s.block[i] - r.n_joints
        body = r.joint_body + 2 * a.s.block[i] if c < 0 else r.contact_body + 2 * c
        a.body[2 * i] = body[0]
        a.body[2 * i + 1] = body[1]
    body_order(k, a.body, n, (n + 63) // 64, a.near, a.given, a.degree, a.rank)
    lower_pattern(k, a.body, n, (n + 63) // 64, a.given, a.rank, a.degree, a.nptr, a.nind, a.node, a.slot, a.turned)
    block_tree(n, a.nptr, a.nind, a.parent, a.mark, a.rptr + 1, a.lptr + 1)
    a.lptr[0] = 0
    a.rptr[0] = 0
    for i in range(n):
        a.lptr[i + 1] += a.lptr[i]
        a.rptr[i + 1] += a.rptr[i]
    block_pattern(n, a.nptr, a.nind, a.parent, a.mark, a.lptr, a.rptr, a.degree, a.lind, a.rind)


cdef inline int64_t real_room(const pattern_t* a, const blocks_t* p, const rows_t* r) noexcept nogil:
    """Doubles that `lay_bodies` hands out, after `make_pattern`."""
    cdef int64_t n = r.n_bodies, m = p.n_rows
    return (12 * m + scaled_real(m) + (VECTORS + 3) * m + 28 * n + 5 * <int64_t>a.s.small
            + 36 * (2 * <int64_t>a.nptr[n] + 2 * <int64_t>a.lptr[n] + 3 * n))


cdef inline void keep_rows(const pattern_t* a, double* panel) noexcept nogil:
    """Of the panel the rows that move, the larger place first, as the pattern has it."""
    cdef int32_t i, j, k
    cdef double x
    cdef double* row
    for k in range(a.s.e.n):
        for j in range(a.s.e.ptr[k], a.s.e.ptr[k + 1]):
            row = panel + 12 * <int64_t>j
            if a.s.keep[j] != j:
                memmove(row, panel + 12 * <int64_t>a.s.keep[j], 12 * sizeof(double))
            for i in range(6 if a.turned[k] else 0):
                x = row[i]
                row[i] = row[6 + i]
                row[6 + i] = x


cdef inline void lay_bodies(newton_t* s, bodies_t* w, pattern_t* a, double* real, const blocks_t* p,
                            const rows_t* r) noexcept nogil:
    """System, problem, vectors, elements and factor of s in real (`real_room`): panel, scale, g, theta, bounds, cones."""
    cdef int32_t i, k, n = r.n_bodies, m = p.n_rows, h = 0, last = -1, soft = 0
    cdef int64_t b
    cdef double* panel = real
    cdef double* root = panel + 12 * <int64_t>m
    cdef double* root_mass = root + 9 * n
    cdef double* rest = root_mass + n
    lay_numbers(&a.s, m, rest)
    rest += scaled_real(m)
    lay_vectors(s, rest, m)
    s.s.y = rest + VECTORS * <int64_t>m
    s.s.p = s.s.y + 6 * n
    s.s.einv = s.s.p + a.s.small
    s.s.v = s.s.einv + a.s.small
    s.s.pair = s.s.v + a.s.small
    s.s.bt = s.s.pair + a.s.small
    s.lam = s.s.bt + a.s.small
    s.problem.w, s.problem.error, s.problem.x = s.lam + m, s.lam + 2 * m, s.lam + 3 * m
    rest = s.problem.x + 12 * n
    s.problem.p, s.problem.r = p[0], r                  # null has no type of its own: not one of a pair
    s.problem.a = NULL
    s.problem.g = NULL
    scale_elements(&a.s, p, NULL, r, s.problem.w, s.problem.x)
    w.s = a.s
    s.keep = NULL
    s.fixed = NULL
    if not a.s.whole:
        s.keep, s.fixed = w.s.keep, w.s.fixed
    s.scale, s.speed = w.s.scale, w.s.speed
    s.s.e, s.s.f = &w.s.e, &w.f
    s.s.others = NULL
    s.s.form, s.s.symmetric, s.s.wide, s.s.augmented, s.s.factorisations = BODIES, 1, 0, 0, 0
    s.exchange.side = a.side
    s.without = 0
    inertia_root(n, r.inv_inertia, root)
    for i in range(n):
        root_mass[i] = sqrt(r.inv_mass[i])
    fill_panel(p, r, root, root_mass, panel)
    keep_rows(a, panel)
    for i in range(a.s.e.m):
        soft += a.s.e.theta[i] != 0.0
    for k in range(a.s.e.n):
        if last < 0 or a.node[2 * k] != a.node[2 * last] or a.node[2 * k + 1] != a.node[2 * last + 1]:
            a.group[h] = k
            h += 1
        last = k
    a.group[h] = a.s.e.n
    w.s.e.s, w.s.e.panel = 6, panel
    w.s.e.node, w.s.e.slot, w.s.e.group, w.s.e.n_groups = a.node, a.slot, a.group, h
    b = 36 * <int64_t>a.nptr[n]
    w.f.n = n
    w.f.s = 6
    w.f.nptr = a.nptr
    w.f.nind = a.nind
    w.f.rptr = a.rptr
    w.f.rind = a.rind
    w.f.lptr = a.lptr
    w.f.lind = a.lind
    w.f.nval = rest
    w.f.mval = w.f.nval + b
    w.f.lval = w.f.mval + b
    w.f.uval = w.f.lval + 36 * <int64_t>a.lptr[n]
    w.f.dval = w.f.uval + 36 * <int64_t>a.lptr[n]
    w.f.work = w.f.dval + 36 * n
    w.f.work2 = w.f.work + 36 * n
    w.f.pivot = a.pivot
    w.f.next = a.next
    w.f.super = NULL
    for i in range(72 * n):
        w.f.work[i] = 0.0
    if a.s.e.n == a.s.e.m or soft:                      # B is for rigid cones
        s.s.bt = NULL
