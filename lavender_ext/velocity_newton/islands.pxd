"""Where Newton's method over generalised velocities stands: islands of trees, and its arrays in workspace that the caller has.

Panels that share a column, directly or through others, are an island: its velocities move no row of another.
"""
from libc.stdint cimport int32_t

from lavender_ext.core.order cimport sort_by_level
from lavender_ext.core.block_types cimport CONE, COULOMB, blocks_t, has_friction, is_rows
from lavender_ext.core.roots cimport root_of
from lavender_ext.core.view cimport generalized_t
from lavender_ext.velocity_newton.flow cimport flow_t, row_end, row_from
from lavender_ext.velocity_newton.sparse cimport factor_work, find_pattern, pattern_marks


cdef inline void join_trees(const generalized_t* g, int32_t* up) noexcept nogil:
    """up (n): the root of each column's tree, and roots of trees that a panel joins."""
    cdef int32_t b, q, r, k, i, end, n = g.n, trees = 0
    cdef const int32_t* parent = g.parent
    cdef const int32_t* cols = g.cols
    for i in range(n):
        k = parent[i]
        if k < 0:
            trees += 1
            up[i] = i
        else:
            up[i] = up[k]                               # which stands before it
    for b in range(g.n_panels):
        end = g.pcol[b + 1]
        if end > g.pcol[b] and trees > 1:
            r = root_of(up, cols[g.pcol[b]])
            for q in range(g.pcol[b] + 1, end):
                if parent[cols[q]] >= 0:                # its root is in the panel as well
                    continue
                k = root_of(up, cols[q])
                if r < k:
                    up[k] = r
                elif k < r:
                    up[r] = k
                    r = k


cdef inline int32_t find_islands(const blocks_t* p, const generalized_t* g, int32_t* up, int32_t* label, int32_t* iptr,
                                 int32_t* run, int32_t* cptr, int32_t* icols, int32_t* local, int32_t* pblock,
                                 int32_t* vptr, int32_t* most) noexcept nogil:
    """Islands: panels that share no column, directly or through others, in the order of their first panel.

    up (n) and label (max(n, n_panels)) are scratch; what is found stands in arrays as `flow_t` has them (iptr and cptr
    with workspace for n_panels + 1). most (4): columns of the largest island, of the widest panel, rows x columns of the
    largest panel, and its rows. A panel without columns is an island of its own.
    """
    cdef int32_t b, q, r, i, n = 0, size, nc, rows, end, panels = g.n_panels, at
    cdef const int32_t* cols = g.cols
    cdef const int32_t* ptr = p.ptr
    join_trees(g, up)
    i = 0
    most[0] = most[1] = most[2] = most[3] = 0
    for b in range(panels):
        while ptr[i] < g.prow[b]:
            i += 1
        pblock[b] = i
        nc = g.pcol[b + 1] - g.pcol[b]
        rows = g.prow[b + 1] - g.prow[b]
        if nc > most[1]:
            most[1] = nc
        if rows * nc > most[2]:
            most[2] = rows * nc
        if rows > most[3]:
            most[3] = rows
    pblock[panels] = p.n_blocks
    at = 0
    for i in range(p.n_blocks):
        vptr[i] = at
        size = ptr[i + 1] - ptr[i]
        at += size if is_rows(p, i) else size * size
    vptr[p.n_blocks] = at
    for i in range(g.n):
        local[i] = -1
    # `local` numbers the islands by their root, until it numbers columns
    for b in range(panels):
        if g.pcol[b + 1] == g.pcol[b]:
            label[b] = n
            n += 1
            continue
        r = root_of(up, cols[g.pcol[b]])
        if local[r] < 0:
            local[r] = n
            n += 1
        label[b] = local[r]
    for i in range(n + 1):
        iptr[i] = 0
    for b in range(panels):                             # a run begins where the panel before is of another island
        if b == 0 or label[b] != label[b - 1]:
            iptr[label[b] + 1] += 1
    for i in range(n):
        iptr[i + 1] += iptr[i]
    for b in range(panels):
        i = label[b]
        if b == 0 or i != label[b - 1]:
            run[2 * iptr[i]] = b
            iptr[i] += 1
        run[2 * iptr[i] - 1] = b + 1
    for i in range(n, 0, -1):
        iptr[i] = iptr[i - 1]
    iptr[0] = 0
    # columns of each island, ascending: those of its panels
    for i in range(g.n):
        local[i] = -1
    for b in range(panels):
        end = g.pcol[b + 1]
        for q in range(g.pcol[b], end):
            local[cols[q]] = label[b]
    sort_by_level(g.n, local, n, cptr, icols)
    for b in range(n):
        if cptr[b + 1] - cptr[b] > most[0]:
            most[0] = cptr[b + 1] - cptr[b]
        for i in range(cptr[b], cptr[b + 1]):
            local[icols[i]] = i - cptr[b]
    return n


cdef enum:
    ADDED = 5                   # multiply-adds of a factor that one counts for where N is put together


cdef struct need_t:             # what the islands of a problem ask for
    int32_t most[4]             # as `find_islands` tells
    int32_t rows                # of the island that has most of those that are few, and three more
    int32_t crowded             # L has more than `per` entries in a row: settle again, with more
    double values               # of N, of the island that has most; its factor has as many
    double formed               # of A and Y^T, of the island that has most
    double work                 # multiply-adds of N and of its factors, of all islands
    double idle                 # entries of L of those that are few, which nobody factors, at most


cdef inline bint count_few(const flow_t* f, int32_t island, need_t* need) noexcept nogil:
    """Has A less work than N? Then what it asks for is counted, else the work of N without its factor.

    By multiply-adds of one step of three, half of the rows pushing; constants fitted to dense rows and to trees.
    """
    cdef int32_t a, b
    cdef bint few
    cdef double rows = 0.0, values = 0.0, normal = 0.0, added = 0.0, formed, size = f.cptr[island + 1] - f.cptr[island], v, nc
    for a in range(f.iptr[island], f.iptr[island + 1]):
        rows += row_end(f, a) - row_from(f, a)
        for b in range(f.run[2 * a], f.run[2 * a + 1]):
            v = f.g.pval[b + 1] - f.g.pval[b]
            nc = f.g.pcol[b + 1] - f.g.pcol[b]
            values += v
            added += ADDED * 0.5 * v * nc
            normal += nc * (28.0 + 2.0 * nc + 0.5 * v)
    formed = rows * (values / 6.0 + (rows + rows * rows / 24.0 if f.plain else 3.0 * rows + rows * rows / 6.0))
    few = f.plain or (f.law != COULOMB and rows <= size)    # `swap` has workspace for these
    if not few or formed > normal or rows * (rows + size) > 1e9:
        need.work += added
        return False
    need.work += formed
    need.idle += 0.5 * size * size
    rows += 3.0
    if rows * rows > need.values:
        need.values = rows * rows
    if rows * (rows + size) > need.formed:
        need.formed = rows * (rows + size)
    if rows > need.rows:
        need.rows = <int32_t>rows
    return True


cdef inline ssize_t marks_of(const blocks_t* p, const generalized_t* g, int32_t per) noexcept nogil:
    """int32 that `settle` needs, with workspace for `per` entries in a row of L."""
    cdef ssize_t n = g.n, panels = g.n_panels
    return (3 * n + (n if n > panels else panels) + 6 * panels + 5 * <ssize_t>p.n_rows + g.pcol[panels] + p.n_blocks + 8
            + pattern_marks(n, g.pcol[panels], per))


cdef inline void settle(flow_t* f, const blocks_t* p, const generalized_t* g, int32_t per, int32_t* w,
                        need_t* need) noexcept nogil:
    """Islands of a problem, in w (`marks_of`), and where L of each has entries."""
    cdef ssize_t n = g.n, panels = g.n_panels, at = n + (n if n > panels else panels)
    cdef int32_t i, size
    cdef int32_t* few
    cdef double values
    cdef const int32_t* lptr
    f.p = p[0]
    f.law = p.law if has_friction(p) else CONE          # where nothing rubs, the convex problem is the whole
    f.p.law = f.law
    f.share = 1e-4 if not has_friction(p) else (3e-2 if f.law == COULOMB else 3e-3)
    f.g = g
    f.iptr = w + at
    f.cptr = w + at + panels + 1
    f.run = w + at + 2 * panels + 2
    f.pblock = w + at + 4 * panels + 2
    at += 5 * panels + 3
    f.icols = w + at
    f.local = w + at + n
    f.vptr = w + at + 2 * n
    at += 2 * n + p.n_blocks + 1
    f.listed = w + at
    f.places, f.columns = f.listed + p.n_rows, f.listed + 2 * <ssize_t>p.n_rows
    f.picks, f.home = f.columns + p.n_rows, f.columns + 2 * <ssize_t>p.n_rows
    f.reached = f.home + p.n_rows
    at += 5 * <ssize_t>p.n_rows + g.pcol[panels]
    few = w + at
    f.few = few
    at += panels
    f.n_islands = find_islands(p, g, w, w + n, <int32_t*>f.iptr, <int32_t*>f.run, <int32_t*>f.cptr,
                               <int32_t*>f.icols, <int32_t*>f.local, <int32_t*>f.pblock, <int32_t*>f.vptr, need.most)
    f.swap = w                                          # scratch of before
    f.wait.island = -1
    f.plain = True
    for i in range(p.n_blocks):
        if not is_rows(p, i):
            f.plain = False
            break
    f.sparse = False
    need.values = need.work = need.formed = need.idle = 0.0
    need.crowded = need.rows = 0
    for i in range(f.n_islands):
        few[i] = count_few(f, i, need)
        f.sparse = f.sparse or not few[i]
    if not f.sparse:
        return
    need.crowded = find_pattern(g, f.n_islands, f.iptr, f.run, f.cptr, f.local, per, w + at) < 0
    f.lptr = w + at
    f.lidx = w + at + f.cptr[f.n_islands] + 1
    for i in range(0 if need.crowded else f.n_islands):
        if few[i]:
            continue
        size = f.cptr[i + 1] - f.cptr[i]
        lptr = f.lptr + f.cptr[i]
        values = lptr[size] - lptr[0] + size
        if f.law == COULOMB:                            # whole, since its own N lacks symmetry
            values = <double>size * size
            need.work += values * size / 3.0
        elif size > 0:
            need.work += factor_work(size, lptr, f.lidx)
        if values > need.values:
            need.values = values


cdef inline ssize_t numbers_of(const flow_t* f, const need_t* need) noexcept nogil:
    """float64 that `furnish` needs."""
    cdef ssize_t size = max(need.most[0], need.rows), values = <ssize_t>need.values
    return (4 * max(<ssize_t>f.g.n, <ssize_t>f.p.n_rows) + 15 * <ssize_t>f.p.n_rows + 2 * <ssize_t>f.vptr[f.p.n_blocks]
            + 2 * values + 2 * size + need.most[2] + need.most[1] + need.most[3] + 1 + <ssize_t>need.formed + 2 * need.rows)


cdef inline void bind_real_workspace(flow_t* f, const need_t* need, double* x) noexcept nogil:
    """Arrays of the iterate, of V and of N in x (`numbers_of`)."""
    cdef ssize_t m = f.p.n_rows, n = max(<ssize_t>f.g.n, m), nv = f.vptr[f.p.n_blocks]
    cdef ssize_t size = max(need.most[0], need.rows), values = <ssize_t>need.values
    f.y = x
    f.u = x + n
    f.grad = x + 2 * n
    f.step = x + 3 * n
    x += 4 * n
    f.theta = x
    f.rho = x + m
    f.s = x + 2 * m
    f.q = x + 3 * m
    f.phi = x + 4 * m
    f.center = x + 5 * m
    f.lam = x + 6 * m
    f.trial = x + 7 * m
    f.best = x + 8 * m
    f.first_best = x + 9 * m
    f.w = x + 10 * m
    f.e = x + 11 * m
    f.soft = x + 12 * m
    f.aside = x + 13 * m
    f.root = x + 14 * m
    x += 15 * m
    f.v = x
    f.held = x + nv
    x += 2 * nv
    f.normal = x
    f.factor = x + values
    x += 2 * values
    f.inv = x
    f.local_rhs = x + size
    f.turned = x + 2 * size
    f.line = x + 2 * size + need.most[2]
    x += 2 * size + need.most[2] + need.most[1] + need.most[3] + 1
    f.sum = x
    f.across = x + 2 * need.rows
    f.a = NULL


cdef inline void aim_at(flow_t* f, double tol, int32_t steps, double reference_energy, double reference_velocity) noexcept nogil:
    """The relative residual asked of each island, and the reference of a problem that is one; counts start at zero."""
    f.tol, f.reference_energy, f.reference_velocity = tol, reference_energy, reference_velocity
    f.steps = steps
    f.wait.island = -1
    f.factorisations = f.rounds = f.evaluations = 0
