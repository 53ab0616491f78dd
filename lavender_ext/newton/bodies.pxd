"""Newton's method over bodies from a problem's own arrays: elements, an order of elimination, a panel, all in given room.

First what the pattern needs (`index_room`, `lay_pattern`, `make_pattern`), then, with it, the numbers (`real_room`,
`lay_bodies`). Every row moves; six columns stand for a body.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t, uint64_t

from lavender_ext.core.block cimport CONTACT, CONTACT_ROLLING, CONTACT_SPIN as SPIN, ROW, blocks_t, ends_apart
from lavender_ext.core.rows cimport rows_t
from lavender_ext.factor.blocks cimport factor_t
from lavender_ext.factor.graph cimport body_order, lower_pattern
from lavender_ext.factor.symbolic cimport block_pattern, block_tree
from lavender_ext.newton.cones cimport KEPT
from lavender_ext.newton.elements cimport elements_t
from lavender_ext.newton.panel cimport fill_panel, inertia_root
from lavender_ext.newton.run cimport VECTORS, lay_vectors, newton_t
from lavender_ext.newton.system cimport BODIES


cdef enum:
    MOST_BODIES = 1500          # whose neighbours bits hold


cdef struct bodies_t:           # what a `newton_t` over bodies points into
    elements_t e
    factor_t f


cdef inline int32_t count_elements(const blocks_t* p, int32_t* small) noexcept nogil:
    # bounded rows and contacts; small: entries of their small matrices
    cdef int32_t i, nr, n = 0
    small[0] = 0
    for i in range(p.n_blocks):
        nr = p.ptr[i + 1] - p.ptr[i]
        if p.kind[i] == ROW or nr == 1:
            n += nr
            small[0] += nr
        else:
            n += 1
            small[0] += nr * nr
    return n


cdef inline int64_t index_room(const blocks_t* p, const rows_t* r) noexcept nogil:
    """Whole numbers that `lay_pattern` hands out; 0 where a walk does not apply."""
    cdef int32_t small
    cdef int64_t k = count_elements(p, &small), n = r.n_bodies
    cdef int32_t i
    for i in range(p.n_blocks):
        if p.kind[i] == CONTACT_ROLLING:
            return 0
    if n == 0 or n > MOST_BODIES or k == 0:
        return 0
    # neighbours twice, eight vectors of bodies and their pivots, the pattern of N and of L, elements, sides of rows
    return 4 * n * ((n + 63) // 64) + 16 * (n + 1) + (n + k + 1) + n * (n - 1) + 2 + 13 * (k + 1) + p.n_rows


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
    int32_t* ptr
    int32_t* kind
    int32_t* wptr
    int32_t* group
    int32_t* body
    int32_t* node
    int32_t* slot
    int32_t* turned
    int32_t* side
    int32_t k                   # elements
    int32_t small


cdef inline void lay_pattern(pattern_t* a, int32_t* index, const blocks_t* p, const rows_t* r) noexcept nogil:
    """Places in index (`index_room`), which begins at a multiple of 8 bytes."""
    cdef int64_t n = r.n_bodies, words = (n + 63) // 64
    a.k = count_elements(p, &a.small)
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
    a.lind = a.nind + n + a.k + 1
    a.rind = a.lind + n * (n - 1) // 2 + 1
    a.ptr = a.rind + n * (n - 1) // 2 + 1
    a.kind = a.ptr + a.k + 1
    a.wptr = a.kind + a.k + 1
    a.group = a.wptr + a.k + 1
    a.body = a.group + a.k + 1
    a.node = a.body + 2 * a.k
    a.slot = a.node + 2 * a.k
    a.turned = a.slot + 3 * a.k
    a.side = a.turned + a.k


cdef inline void make_pattern(pattern_t* a, const blocks_t* p, const rows_t* r) noexcept nogil:
    """Elements, an elimination order of the bodies, the blocks of N and of its factor."""
    cdef int32_t i, j, k = 0, c, nr, n = r.n_bodies
    cdef const int32_t* body
    a.ptr[0] = 0
    a.wptr[0] = 0
    for i in range(p.n_blocks):
        j = p.ptr[i]
        nr = p.ptr[i + 1] - j
        c = i - r.n_joints
        body = r.joint_body + 2 * i if c < 0 else r.contact_body + 2 * c
        if p.kind[i] == ROW or nr == 1:
            for c in range(nr):
                a.kind[k] = ROW
                a.ptr[k + 1] = j + c + 1
                a.wptr[k + 1] = a.wptr[k] + 1
                a.body[2 * k] = body[0]
                a.body[2 * k + 1] = body[1]
                k += 1
        else:
            a.kind[k] = SPIN if ends_apart(p.kind[i]) else CONTACT
            a.ptr[k + 1] = j + nr
            a.wptr[k + 1] = a.wptr[k] + nr * nr
            a.body[2 * k] = body[0]
            a.body[2 * k + 1] = body[1]
            k += 1
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
    return (12 * m + 9 * m + VECTORS * m + 12 * n + 5 * <int64_t>a.small + 2 * <int64_t>a.k + 2 * KEPT * <int64_t>a.k + 16 * n
            + 36 * (2 * <int64_t>a.nptr[n] + 2 * <int64_t>a.lptr[n] + 3 * n))


cdef inline void lay_bodies(newton_t* s, bodies_t* w, const pattern_t* a, double* real, const blocks_t* p,
                            const rows_t* r) noexcept nogil:
    """System, problem, vectors, elements and factor of s in real (`real_room`): panel, scale, g, theta, bounds, cones."""
    cdef int32_t i, j, k, n = r.n_bodies, m = p.n_rows, h, last = -1, soft = 0
    cdef int64_t b
    cdef double x
    cdef double* panel = real
    cdef double* theta = panel + 12 * <int64_t>m
    cdef double* g = theta + m
    cdef double* lower = g + m
    cdef double* upper = lower + m
    cdef double* at = upper + m
    cdef double* spin = at + a.k
    cdef double* scaling = spin + a.k
    cdef double* root = scaling + 2 * KEPT * <int64_t>a.k
    cdef double* root_mass = root + 9 * n
    cdef double* rest = root_mass + n
    cdef double* scale = rest
    cdef double* speed = scale + m
    lay_vectors(s, speed + m, m)
    s.s.y = speed + m + VECTORS * <int64_t>m
    s.s.p = s.s.y + 6 * n
    s.s.einv = s.s.p + a.small
    s.s.v = s.s.einv + a.small
    s.s.pair = s.s.v + a.small
    s.s.bt = s.s.pair + a.small
    s.lam = s.s.bt + a.small
    s.problem.w, s.problem.error, s.problem.x = s.lam + m, s.lam + 2 * m, s.lam + 3 * m
    rest = s.problem.x + 12 * n
    s.problem.p, s.problem.r = p[0], r                  # null is not of one type: a pair of two would have none
    s.problem.a = NULL
    s.problem.g = NULL
    s.keep = NULL
    s.fixed = NULL
    s.scale, s.speed, s.s.e, s.s.f = scale, speed, &w.e, &w.f
    s.s.others = NULL
    s.s.form, s.s.symmetric, s.s.wide, s.s.augmented, s.s.factorisations = BODIES, 1, 0, 0, 0
    s.exchange.side = a.side
    s.without = 0
    inertia_root(n, r.inv_inertia, root)
    for i in range(n):
        root_mass[i] = sqrt(r.inv_mass[i])
    fill_panel(p, r, root, root_mass, panel)
    k = 0
    for i in range(p.n_blocks):
        for j in range(p.ptr[i], p.ptr[i + 1]):
            scale[j] = 1.0 / sqrt(p.d[j])
            speed[j] = sqrt(p.nu[j] * p.d[j]) * scale[j]
            soft += r.compliance[j] != 0.0
            g[j] = p.b[j] * scale[j]
            theta[j] = r.compliance[j] * scale[j] * scale[j]
            lower[j] = p.lower[j] / scale[j] if p.kind[i] == ROW else 0.0
            upper[j] = p.upper[j] / scale[j] if p.kind[i] == ROW else 1.0 / 0.0
    for k in range(a.k):
        at[k] = 0.0
        spin[k] = 0.0
    k = 0
    for i in range(p.n_blocks):
        j = p.ptr[i]
        if p.kind[i] == ROW or p.ptr[i + 1] - j == 1:
            k += p.ptr[i + 1] - j
            continue
        at[k] = p.mu[i] * scale[j] / scale[j + 1]
        if ends_apart(p.kind[i]):
            h = p.ptr[i + 1] - 1
            spin[k] = p.mu[i] * p.patch_radius[i] * scale[j] / scale[h]
        k += 1
    h = 0
    for k in range(a.k):
        # the larger place first, as the pattern has it
        if a.turned[k]:
            for j in range(a.ptr[k], a.ptr[k + 1]):
                for i in range(6):
                    x = panel[12 * <int64_t>j + i]
                    panel[12 * <int64_t>j + i] = panel[12 * <int64_t>j + 6 + i]
                    panel[12 * <int64_t>j + 6 + i] = x
        if last < 0 or a.node[2 * k] != a.node[2 * last] or a.node[2 * k + 1] != a.node[2 * last + 1]:
            a.group[h] = k
            h += 1
        last = k
    a.group[h] = a.k
    w.e = elements_t(a.k, m, 6, a.ptr, a.kind, a.wptr, a.node, a.slot, h, a.group, panel, theta, g, lower, upper, at, spin,
                     scaling, 2, NULL)
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
    if a.k == m or soft:                                # B is for rigid cones
        s.s.bt = NULL
