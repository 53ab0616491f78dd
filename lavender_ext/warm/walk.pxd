"""Proximal Newton walks on a factored problem, whole: `lavender/solvers/_newton/proximal.py` without Python.

    F_c(z) = z - Pi(z - (H z - g) - alpha (z - c)),   c = z of the last round                      (1)

z = D^1/2 lam; a round takes Newton steps on (1), Pi that of Alart and Curnier, until |F_c| is a tenth of what it was,
each passed by a non-monotone line search (Grippo, Lampariello, Lucidi 1986). alpha falls the faster the shorter the
rounds are, and rises where one fails. A point counts by the judge's residual alone.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t, uint64_t

from lavender_ext.core.block cimport CONTACT, CONTACT_ROLLING, CONTACT_SPIN as SPIN, ROW, blocks_t, ends_apart
from lavender_ext.core.rows cimport relax_rows_block, rows_t
from lavender_ext.core.velocity cimport rows_velocity
from lavender_ext.factor.blocks cimport factor_t
from lavender_ext.factor.graph cimport body_order, lower_pattern
from lavender_ext.factor.lu cimport block_lu, block_lu_solve
from lavender_ext.factor.symbolic cimport block_pattern, block_tree
from lavender_ext.newton.cones cimport KEPT
from lavender_ext.newton.elements cimport MAP_AUGMENTED, element_times, elements_t
from lavender_ext.newton.natural_map cimport natural
from lavender_ext.newton.normal_matrix cimport normal_matrix
from lavender_ext.newton.panel cimport fill_panel, inertia_root, to_bodies, to_rows
from lavender_ext.warm.start cimport MOST_SWEEPS, UNDECIDED, WALKED, judged, scored, start_errors, warm_t


cdef enum:
    INNER_STEPS = 20            # Newton steps of a round at most
    MEMORY = 6                  # steps that the line search looks back
    HALVINGS = 7                # of one step
    FREE = 20                   # rounds in a row without a factorisation
    FIRST_STEPS = 20            # factorisations of the first walk
    NEXT_STEPS = 40             # of each that follows
    WALKS = 4
    MOST_BODIES = 1500          # whose neighbours bits hold
    SMALL = 64                  # rows up to which the first weight is smaller, from `LARGE` on it is larger
    LARGE = 1000


cdef struct walk_t:
    elements_t e
    factor_t f
    double* scale               # (m) D^-1/2
    double* z                   # (m)
    double* c                   # (m) centre of the round
    double* map                 # (m) F
    double* hz                  # (m)
    double* dz                  # (m)
    double* hdz                 # (m)
    double* trial               # (m)
    double* s                   # (m)
    double* t                   # (m)
    double* q                   # (m)
    double* best_z              # (m)
    double* y                   # (6 n)
    double* p                   # (small matrices)
    double* einv
    double* v
    double best                 # relative residual of best_z
    double tol
    double e0                   # errors of doing nothing
    double v0
    int32_t last                # factorisations at which the walk ends


# -- memory: first what the pattern needs, then, with it, the numbers ------------------------------------------


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
    # neighbours twice, eight vectors of bodies and their pivots, the pattern of N and of L, elements
    return 4 * n * ((n + 63) // 64) + 16 * (n + 1) + (n + k + 1) + n * (n - 1) + 2 + 13 * (k + 1)


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
    """Doubles that `lay_numbers` hands out, after `make_pattern`."""
    cdef int64_t n = r.n_bodies, m = p.n_rows
    return (12 * m + 12 * m + 3 * <int64_t>a.small + 2 * <int64_t>a.k + 2 * KEPT * <int64_t>a.k + 16 * n
            + 36 * (2 * <int64_t>a.nptr[n] + 2 * <int64_t>a.lptr[n] + 3 * n) + 4 * m)


cdef inline void lay_numbers(walk_t* w, const pattern_t* a, double* real, const blocks_t* p, const rows_t* r) noexcept nogil:
    """Elements and factor in real (`real_room`): panel, scale, g, theta, bounds, cones."""
    cdef int32_t i, j, k, n = r.n_bodies, m = p.n_rows, h, last = -1
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
    w.scale = rest
    w.z = w.scale + m
    w.c = w.z + m
    w.map = w.c + m
    w.hz = w.map + m
    w.dz = w.hz + m
    w.hdz = w.dz + m
    w.trial = w.hdz + m
    w.s = w.trial + m
    w.t = w.s + m
    w.q = w.t + m
    w.best_z = w.q + m
    w.y = w.best_z + m
    w.p = w.y + 6 * n
    w.einv = w.p + a.small
    w.v = w.einv + a.small
    rest = w.v + a.small
    inertia_root(n, r.inv_inertia, root)
    for i in range(n):
        root_mass[i] = sqrt(r.inv_mass[i])
    fill_panel(p, r, root, root_mass, panel)
    k = 0
    for i in range(p.n_blocks):
        for j in range(p.ptr[i], p.ptr[i + 1]):
            w.scale[j] = 1.0 / sqrt(p.d[j])
            g[j] = p.b[j] * w.scale[j]
            theta[j] = r.compliance[j] * w.scale[j] * w.scale[j]
            lower[j] = p.lower[j] / w.scale[j] if p.kind[i] == ROW else 0.0
            upper[j] = p.upper[j] / w.scale[j] if p.kind[i] == ROW else 1.0 / 0.0
    for k in range(a.k):
        at[k] = 0.0
        spin[k] = 0.0
    k = 0
    for i in range(p.n_blocks):
        j = p.ptr[i]
        if p.kind[i] == ROW or p.ptr[i + 1] - j == 1:
            k += p.ptr[i + 1] - j
            continue
        at[k] = p.mu[i] * w.scale[j] / w.scale[j + 1]
        if ends_apart(p.kind[i]):
            h = p.ptr[i + 1] - 1
            spin[k] = p.mu[i] * p.patch_radius[i] * w.scale[j] / w.scale[h]
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


# -- the walk --------------------------------------------------------------------------------------------------


cdef inline void times(walk_t* w, const double* x, double* out) noexcept nogil:
    # H x
    cdef int32_t j
    to_bodies(&w.e, w.f.n, x, w.y)
    to_rows(&w.e, w.y, out)
    for j in range(w.e.m):
        out[j] += w.e.theta[j] * x[j]


cdef inline void factor(walk_t* w, warm_t* s) noexcept nogil:
    s.factorisations += 1
    normal_matrix(&w.e, w.v, &w.f, 1)
    block_lu(&w.f)


cdef inline void solve_natural(walk_t* w, const double* rhs, double* out) noexcept nogil:
    # (I - P + P (H + eps))^-1 rhs; rhs is not out
    cdef int32_t j
    element_times(&w.e, w.einv, rhs, w.t)
    to_bodies(&w.e, w.f.n, w.t, w.y)
    block_lu_solve(&w.f, w.y)
    to_rows(&w.e, w.y, w.q)
    element_times(&w.e, w.p, w.q, w.t)
    for j in range(w.e.m):
        w.t[j] = rhs[j] - w.t[j]
    element_times(&w.e, w.einv, w.t, out)


cdef inline int32_t all_finite(const double* x, int32_t n) noexcept nogil:
    cdef int32_t j
    cdef double total = 0.0
    for j in range(n):
        total += x[j] - x[j]
    return total == 0.0


cdef inline double score(const blocks_t* p, const rows_t* r, warm_t* s, walk_t* w, const double* z, double* lam,
                         double* v) noexcept nogil:
    """The judge's relative residual of z; the best is kept. lam, v are those of z."""
    cdef int32_t j
    cdef double x
    for j in range(w.e.m):
        lam[j] = z[j] * w.scale[j]
    x = judged(p, r, s, lam, v, w.e0, w.v0)
    if x < w.best:
        w.best = x
        for j in range(w.e.m):
            w.best_z[j] = z[j]
    return x


cdef inline int32_t done(const walk_t* w, const warm_t* s) noexcept nogil:
    return w.best <= w.tol or s.factorisations >= w.last


cdef inline double size_at(walk_t* w, double t, double alpha) noexcept nogil:
    """|F_c| at trial = z + t dz."""
    cdef int32_t j
    for j in range(w.e.m):
        w.trial[j] = w.z[j] + t * w.dz[j]
        w.s[j] = w.hz[j] + t * w.hdz[j] - w.e.g[j] + alpha * (w.trial[j] - w.c[j])
    return natural(&w.e, w.trial, w.s, MAP_AUGMENTED, 0.0, w.map, w.p, NULL, NULL)


cdef inline int32_t walk_round(const blocks_t* p, const rows_t* r, warm_t* s, walk_t* w, double alpha, double* lam,
                               double* v) noexcept nogil:
    """One round of (1) from z; whether it was solved. z moves where |F_c| did not grow."""
    cdef int32_t j, k, _, _h, n = 0, solved = 0
    cdef double size, bound, value, best, step, t
    cdef double history[INNER_STEPS]
    times(w, w.z, w.hz)
    for j in range(w.e.m):
        w.c[j] = w.z[j]
    for _ in range(INNER_STEPS):
        for j in range(w.e.m):
            w.s[j] = w.hz[j] - w.e.g[j] + alpha * (w.z[j] - w.c[j])
        size = natural(&w.e, w.z, w.s, MAP_AUGMENTED, alpha, w.map, w.p, w.einv, w.v)
        history[n] = size
        n += 1
        if (size <= 0.1 * history[0] and n > 1) or size == 0.0:
            solved = 1
            break
        if s.factorisations >= w.last:
            break
        factor(w, s)
        for j in range(w.e.m):
            w.map[j] = -w.map[j]
        solve_natural(w, w.map, w.dz)
        if not all_finite(w.dz, w.e.m):
            break
        times(w, w.dz, w.hdz)
        bound = 0.0
        for k in range(n - MEMORY if n > MEMORY else 0, n):
            bound = history[k] if history[k] > bound else bound
        best = 1.0 / 0.0
        step = 1.0
        t = 1.0
        for _h in range(HALVINGS):
            value = size_at(w, t, alpha)
            if value < best:
                best = value
                step = t
            if value <= (1.0 - 1e-4 * t) * bound:
                break
            t *= 0.5
        for j in range(w.e.m):
            w.z[j] += step * w.dz[j]
            w.hz[j] += step * w.hdz[j]
        if score(p, r, s, w, w.z, lam, v) <= w.tol:
            break
    if not solved and not history[n - 1] <= history[0]:
        for j in range(w.e.m):
            w.z[j] = w.c[j]
    return solved


cdef inline void walk(const blocks_t* p, const rows_t* r, warm_t* s, walk_t* w, double alpha, int32_t limit, double* lam,
                      double* v) noexcept nogil:
    """Rounds from z until the judge is content, `limit` factorisations are spent, or nothing moves."""
    cdef int32_t begun, used, solved, failures = 0, idle = 0, free = 0
    cdef double before, slowest = 0.1, fall
    w.last = s.factorisations + limit
    score(p, r, s, w, w.z, lam, v)
    while not done(w, s):
        before = w.best
        begun = s.factorisations
        solved = walk_round(p, r, s, w, alpha, lam, v)
        used = s.factorisations - begun
        if solved:
            failures = 0
            fall = 0.05 if used <= 2 else 0.15 if used <= 4 else 0.4 if used <= 8 else 1.0
            fall = slowest if slowest > fall else fall
            if used <= 1 and slowest <= 0.1:
                fall = 2e-3             # a single step: the pieces are found, and only alpha is in the way
            alpha = alpha * fall if alpha * fall > 1e-12 else 1e-12
            slowest = 0.5 * slowest if slowest > 0.1 else 0.05
            idle = idle + 1 if alpha == 1e-12 and w.best > 0.5 * before else 0
        else:
            failures += 1
            slowest = 0.2 if slowest < 0.2 else 2.0 * slowest if slowest < 0.35 else 0.7
            alpha *= 5.0
        free = free + 1 if used == 0 else 0
        if idle > 3 or failures > 6 or alpha > 10.0 or free > FREE:
            return


cdef inline void take_best(const rows_t* r, const blocks_t* p, const walk_t* w, double* lam, double* v) noexcept nogil:
    cdef int32_t j
    for j in range(w.e.m):
        lam[j] = w.best_z[j] * w.scale[j]
    rows_velocity(p, r, lam, v)


cdef inline int32_t solve_with_walks(const blocks_t* p, const rows_t* r, warm_t* s, walk_t* w, double tol, double* lam,
                                     double* v) noexcept nogil:
    """What `warm_solve` has left undecided, also from lam = 0: walks, 64 sweeps from the best between them.

    UNDECIDED where none met tol: lam is then the best that was scored.
    """
    cdef int32_t i, j, k, _
    cdef double alpha
    if not start_errors(p, &w.e0, &w.v0):
        return UNDECIDED
    w.tol = tol
    w.best = 1.0 / 0.0
    alpha = 1e-5 if p.n_rows <= SMALL else 1e-3 if p.n_rows < LARGE else 1e-2
    for k in range(WALKS):
        if k > 0:
            take_best(r, p, w, lam, v)
            for _ in range(MOST_SWEEPS):
                for i in range(p.n_blocks):
                    relax_rows_block(p, r, i, lam, v)
            s.sweeps += MOST_SWEEPS
            alpha = 1e-3 if k == 1 else 1e-2 if k == 2 else 1e-1
        for j in range(p.n_rows):
            w.z[j] = lam[j] / w.scale[j]
        walk(p, r, s, w, alpha, FIRST_STEPS if k == 0 else NEXT_STEPS, lam, v)
        if w.best <= tol:
            break
    take_best(r, p, w, lam, v)
    s.relative = scored(p, r, s, lam, v, w.e0, w.v0)
    return WALKED if w.best <= tol else UNDECIDED
