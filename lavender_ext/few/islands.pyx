"""Islands taken apart and solved in one compiled call: each is laid out as a problem of its own, and goes the way of one.

    blocks of an island, stably sorted by its label, renumbered; so are their rows, bodies, columns of A or velocities  (1)
    share of the tolerance:  tol_i = min(tol E0 / (sqrt(islands) E0_i), tol V0 / V0_i)                              (2)

What is derived of a block alone (d, nu, step, couplings, M^-1 J^T, entries of A, rows of M's factor) is copied from the
whole, to the bit what the island alone would derive. Then as with few rows (`chain.pyx`, `many.pyx`): a start that is a
solution is the result; else pivots where A is symmetric and each row has constant bounds, sweeps with looks at what
they promise elsewhere (`looks.pyx`), Newton's method over J and M. What does not end below (2) on the judge's own
measure is left to the caller. An island whose numbers and start are those of one before, to the bit, has its answer.
"""
from libc.math cimport INFINITY
from libc.stdint cimport int32_t, uint64_t
from libc.stdlib cimport free
from libc.string cimport memcmp, memcpy, memset

import numpy as np

from lavender_ext.accelerate.accelerated cimport anderson_step, sweep_data_t
from lavender_ext.accelerate.mixing cimport CONTROL, MAX_MEMORY, UNDONE
from lavender_ext.core.block cimport CONE, blocks_t
from lavender_ext.core.csr cimport csr_t
from lavender_ext.core.generalized cimport generalized_t, whitened_gather
from lavender_ext.core.problem cimport MADE, Data, make_numbers
from lavender_ext.core.rows cimport rows_t
from lavender_ext.core.velocity cimport rows_velocity
from lavender_ext.few.looks cimport sweeps_left
from lavender_ext.few.many cimport (SOLVED, Gate, begin, gate_t, job_t, law_of, solve_made, space_t, with_marks,
                                    with_numbers)
from lavender_ext.judge.measure cimport do_nothing, general_judge, judge_into, reference_of, relative_of
from lavender_ext.judge.score cimport are_numbers, relative, score_rows, score_t
from lavender_ext.judge.watch cimport RUNNING, check, watch_t
from lavender_ext.pivot.principal cimport SOLVED as PIVOTED
from lavender_ext.pivot.principal cimport (pivoting_t, pivots_correct, pivots_exchange, pivots_factor_all, pivots_on,
                                           pivots_slack, pivots_solve, pivots_solve_free, scan_entries)


cpdef enum:                     # how an island ended
    LEFT = 0                    # it is the caller's
    AT_START = 1                # its start is a solution
    BY_PIVOTS = 2
    BY_SWEEPS = 3
    BY_VELOCITIES = 4

cdef enum:                      # how A is given
    MATRIX = 0
    BODIES = 1
    GENERAL = 2

cdef enum:                      # as in chain.pyx
    PIVOT_SWEEPS = 2
    PIVOT_ROUNDS = 32
    CORRECTIONS = 100
    MEMORY = 5
    PATIENCE = 500


cdef struct island_t:
    int32_t first               # place of its first block in `order`
    int32_t row                 # and of its first row in `rows`
    int32_t n_blocks
    int32_t n_rows
    int32_t n_moving            # bodies, velocities
    int32_t n_joints
    int32_t n_joint_rows
    int32_t n_entries           # of A in compressed rows, or of J
    int32_t n_lower             # entries of L left of the diagonal
    int32_t chosen              # it is to be solved here
    int32_t twin                # the island before that has the same bytes, -1
    int32_t end
    int32_t counts[5]
    ssize_t numbers             # where its numbers begin, and how many
    ssize_t n_numbers
    ssize_t marks               # and its int32
    ssize_t n_marks
    double relative             # residual that it ended with


cdef struct view_t:             # one island as the kernels read it
    blocks_t p
    blocks_t q                  # with d, nu and step of A in compressed rows
    csr_t a
    rows_t r
    generalized_t g
    double* lam                 # (m) where it starts


cdef struct asked_t:
    double tol
    double energy               # tol E0 / sqrt(islands) [sqrt J]
    double velocity             # tol V0 [m/s]
    double warm                 # relative residual from which pivots start where the island stands
    int32_t n                   # iterations of sweeps at most
    int32_t pivots              # rows have constant bounds
    int32_t linear              # or none
    int32_t symmetric           # A is, by construction
    int32_t sweeps              # are tried
    int32_t exact               # blocks are solved exactly
    int32_t few                 # rows up to which any band is factored,
    int32_t narrow              # and half bandwidth where one of more rows is
    double band                 # ns of its factors for each row and (half bandwidth)^2,
    double at_once              # and at most
    double work                 # ns of a sweep for each multiply-add,
    double row                  # and each row
    int32_t look                # sweeps before the first look
    double each                 # ns of what else there is, for each row
    double hope                 # share of it that sweeps may take without promising an end,
    double believed             # times that sweeps may take, whatever they promise


# -- an island's arrays ----------------------------------------------------------------------------------


cdef inline void sizes(island_t* s, int32_t kind, bint also) noexcept nogil:
    """How many numbers and int32 the island needs; `also`: A in compressed rows beside bodies."""
    cdef ssize_t m = s.n_rows, k = s.n_blocks, n = s.n_moving, c = s.n_blocks - s.n_joints, mj = s.n_joint_rows
    s.n_numbers = 4 * m + 2 * k
    s.n_marks = 2 * k + 1
    if kind != GENERAL:
        s.n_numbers += 3 * m
    if kind == BODIES:
        s.n_numbers += 24 * mj + 17 * c + 6 * (m - mj) + 10 * n + m
        s.n_marks += 2 * k
    if kind == MATRIX or also:
        s.n_numbers += s.n_entries + (3 * m if also else 0)
        s.n_marks += m + 1 + s.n_entries
    if kind == GENERAL:
        s.n_numbers += m + s.n_entries + s.n_lower + 2 * n
        s.n_marks += m + 1 + s.n_entries + n + 1 + s.n_lower + n
    s.n_marks += s.n_marks & 1                          # whole words


cdef inline void point(const island_t* s, int32_t kind, bint also, int32_t law, double* x, int32_t* w,
                       view_t* v) noexcept nogil:
    cdef ssize_t m = s.n_rows, k = s.n_blocks, n = s.n_moving, c = s.n_blocks - s.n_joints, mj = s.n_joint_rows
    cdef blocks_t* p = &v.p
    cdef rows_t* r = &v.r
    cdef generalized_t* g = &v.g
    p.n_blocks = s.n_blocks
    p.n_rows = s.n_rows
    p.law = law
    v.lam = x
    p.b = x + m
    p.lower = x + 2 * m
    p.upper = x + 3 * m
    p.mu = x + 4 * m
    p.patch_radius = p.mu + k
    x += 4 * m + 2 * k
    p.ptr = w
    p.kind = w + k + 1
    w += 2 * k + 1
    p.d = p.nu = p.step = NULL
    if kind != GENERAL:
        p.d = x
        p.nu = x + m
        p.step = x + 2 * m
        x += 3 * m
    if kind == BODIES:
        r.n_bodies = s.n_moving
        r.n_joints = s.n_joints
        r.n_contacts = <int32_t>c
        r.jac = x
        r.minv_jac = x + 12 * mj
        x += 24 * mj
        r.normal = x
        r.tangent = x + 3 * c
        r.arm_a = x + 6 * c
        r.arm_b = x + 9 * c
        r.coupling = x + 12 * c
        x += 17 * c
        r.swing = x
        x += 6 * (m - mj)
        r.inv_mass = x
        r.inv_inertia = x + n
        x += 10 * n
        r.compliance = x
        x += m
        r.joint_body = w
        r.contact_body = w + 2 * s.n_joints
        w += 2 * k
    v.q = p[0]
    if kind == MATRIX or also:
        v.a.data = x
        x += s.n_entries
        v.a.indptr = w
        v.a.indices = w + m + 1
        w += m + 1 + s.n_entries
        if also:
            v.q.d = x
            v.q.nu = x + m
            v.q.step = x + 2 * m
    if kind == GENERAL:
        g.n = s.n_moving
        g.m = s.n_rows
        g.compliance = x
        g.jval = x + m
        x += m + s.n_entries
        g.lval = x
        x += s.n_lower
        g.inv_pivot = x
        g.root = x + n
        g.jptr = w
        g.jidx = w + m + 1
        w += m + 1 + s.n_entries
        g.lptr = w
        g.lidx = w + n + 1
        g.parent = w + n + 1 + s.n_lower


cdef inline void take(const double* x, int32_t n, const double* out) noexcept nogil:
    # into an array of this module's that the kernels only read
    cdef double* to = <double*>out
    cdef int32_t i
    for i in range(n):
        to[i] = x[i]


cdef inline void fill_csr(const blocks_t* p, const csr_t* a, const island_t* s, const int32_t* order, const int32_t* place,
                          view_t* v) noexcept nogil:
    cdef int32_t q, i, j, t, row = 0, at = 0
    cdef int32_t* indptr = <int32_t*>v.a.indptr
    cdef int32_t* indices = <int32_t*>v.a.indices
    cdef double* data = <double*>v.a.data
    indptr[0] = 0
    for q in range(s.first, s.first + s.n_blocks):
        i = order[q]
        for j in range(p.ptr[i], p.ptr[i + 1]):
            for t in range(a.indptr[j], a.indptr[j + 1]):
                indices[at] = place[a.indices[t]]
                data[at] = a.data[t]
                at += 1
            row += 1
            indptr[row] = at


cdef inline void fill_bodies(const blocks_t* p, const rows_t* r, const island_t* s, const int32_t* order,
                             const int32_t* number, const int32_t* moving, view_t* v) noexcept nogil:
    """`moving` (n_moving): the island's bodies; `number` of each body in its island."""
    cdef int32_t q, i, c, n, h, b, at, row = 0, mj = s.n_joint_rows, first = p.ptr[r.n_joints]
    cdef int32_t* joint_body = <int32_t*>v.r.joint_body
    cdef int32_t* contact_body = <int32_t*>v.r.contact_body
    for q in range(s.n_blocks):
        i = order[s.first + q]
        n = p.ptr[i + 1] - p.ptr[i]
        take(r.compliance + p.ptr[i], n, v.r.compliance + row)
        if i < r.n_joints:
            take(r.jac + 12 * p.ptr[i], 12 * n, v.r.jac + 12 * row)
            take(r.minv_jac + 12 * p.ptr[i], 12 * n, v.r.minv_jac + 12 * row)
            for h in range(2):
                b = r.joint_body[2 * i + h]
                joint_body[2 * q + h] = number[b] if b >= 0 else -1
        else:
            c = i - r.n_joints
            at = q - s.n_joints
            take(r.normal + 3 * c, 3, v.r.normal + 3 * at)
            take(r.tangent + 3 * c, 3, v.r.tangent + 3 * at)
            take(r.arm_a + 3 * c, 3, v.r.arm_a + 3 * at)
            take(r.arm_b + 3 * c, 3, v.r.arm_b + 3 * at)
            take(r.coupling + 5 * c, 5, v.r.coupling + 5 * at)
            take(r.swing + 6 * (p.ptr[i] - first), 6 * n, v.r.swing + 6 * (row - mj))
            for h in range(2):
                b = r.contact_body[2 * c + h]
                contact_body[2 * at + h] = number[b] if b >= 0 else -1
        row += n
    for q in range(s.n_moving):
        take(r.inv_mass + moving[q], 1, v.r.inv_mass + q)
        take(r.inv_inertia + 9 * <ssize_t>moving[q], 9, v.r.inv_inertia + 9 * q)


cdef inline void fill_trees(const blocks_t* p, const generalized_t* g, const island_t* s, const int32_t* order,
                            const int32_t* number, const int32_t* moving, view_t* v) noexcept nogil:
    cdef int32_t q, i, j, t, row = 0, at = 0
    cdef int32_t* jptr = <int32_t*>v.g.jptr
    cdef int32_t* jidx = <int32_t*>v.g.jidx
    cdef int32_t* lptr = <int32_t*>v.g.lptr
    cdef int32_t* lidx = <int32_t*>v.g.lidx
    cdef int32_t* parent = <int32_t*>v.g.parent
    cdef double* jval = <double*>v.g.jval
    cdef double* lval = <double*>v.g.lval
    jptr[0] = 0
    for q in range(s.first, s.first + s.n_blocks):
        i = order[q]
        take(g.compliance + p.ptr[i], p.ptr[i + 1] - p.ptr[i], v.g.compliance + row)
        for j in range(p.ptr[i], p.ptr[i + 1]):
            for t in range(g.jptr[j], g.jptr[j + 1]):
                jidx[at] = number[g.jidx[t]]
                jval[at] = g.jval[t]
                at += 1
            row += 1
            jptr[row] = at
    lptr[0] = 0
    at = 0
    for q in range(s.n_moving):
        i = moving[q]
        for t in range(g.lptr[i], g.lptr[i + 1]):
            lidx[at] = number[g.lidx[t]]
            lval[at] = g.lval[t]
            at += 1
        lptr[q + 1] = at
        parent[q] = number[g.parent[i]] if g.parent[i] >= 0 else -1
        take(g.inv_pivot + i, 1, v.g.inv_pivot + q)
        take(g.root + i, 1, v.g.root + q)


cdef inline void fill_blocks(const blocks_t* p, const blocks_t* of_matrix, const double* start, const island_t* s,
                             const int32_t* order, view_t* v) noexcept nogil:
    cdef int32_t q, i, j, n, row = 0
    cdef int32_t* ptr = <int32_t*>v.p.ptr
    cdef int32_t* kind = <int32_t*>v.p.kind
    ptr[0] = 0
    for q in range(s.n_blocks):
        i = order[s.first + q]
        j = p.ptr[i]
        n = p.ptr[i + 1] - j
        kind[q] = p.kind[i]
        take(p.mu + i, 1, v.p.mu + q)
        take(p.patch_radius + i, 1, v.p.patch_radius + q)
        take(start + j, n, v.lam + row)
        take(p.b + j, n, v.p.b + row)
        take(p.lower + j, n, v.p.lower + row)
        take(p.upper + j, n, v.p.upper + row)
        if v.p.d != NULL:
            take(p.d + j, n, v.p.d + row)
            take(p.nu + j, n, v.p.nu + row)
            take(p.step + j, n, v.p.step + row)
        if of_matrix != NULL:
            take(of_matrix.d + j, n, v.q.d + row)
            take(of_matrix.nu + j, n, v.q.nu + row)
            take(of_matrix.step + j, n, v.q.step + row)
        row += n
        ptr[q + 1] = row


cdef inline uint64_t hashed(const void* x, ssize_t words, uint64_t seed) noexcept nogil:
    """Four running products over 64-bit words."""
    cdef const uint64_t* w = <const uint64_t*>x
    cdef uint64_t a = seed, b = seed + 1, c = seed + 2, d = seed + 3, prime = <uint64_t>0x9E3779B97F4A7C15ULL
    cdef ssize_t i = 0
    while i + 4 <= words:
        a = (((a << 5) | (a >> 59)) ^ w[i]) * prime
        b = (((b << 5) | (b >> 59)) ^ w[i + 1]) * prime
        c = (((c << 5) | (c >> 59)) ^ w[i + 2]) * prime
        d = (((d << 5) | (d >> 59)) ^ w[i + 3]) * prime
        i += 4
    while i < words:
        a = (((a << 5) | (a >> 59)) ^ w[i]) * prime
        i += 1
    a = (a ^ (b >> 17)) * prime
    a = (a ^ (c >> 23)) * prime
    a = (a ^ (d >> 29)) * prime
    return a ^ (a >> 32)


# -- an island's solve -----------------------------------------------------------------------------------


cdef struct desk_t:             # scratch of one island
    double* zero                # (m) Pi(0)
    double* x                   # (m)
    double* best                # (m)
    double* w                   # (m)
    double* e                   # (m)
    double* v                   # (12 n)
    double* kept                # (m) of a watch
    double* mixed               # of Anderson's
    double* velocity            # (6 n)
    double* pivots
    int32_t* marks              # (max(2 m, k))


cdef inline double judged(const view_t* t, int32_t kind, const double* begun, const double* lam, const desk_t* o,
                          bint floor, double* floor_out) noexcept nogil:
    cdef score_t s = score_t(0.0, 0.0, 0.0, 0.0, -1, 1)
    if kind == GENERAL:
        general_judge(&t.p, &t.g, lam, o.w, o.e, o.v, floor, &s)
    else:
        judge_into(&t.p, &t.a, &t.r, kind == BODIES, lam, o.w, o.e, o.v, floor, &s)
    floor_out[0] = relative(s.floor_energy, s.floor_velocity, begun[0], begun[1])
    return relative_of(&s, o.w, t.p.n_rows, begun[0], begun[1])


cdef inline void do_nothing_well(const view_t* t, int32_t kind, const desk_t* o, double* begun) noexcept nogil:
    """E0, V0 and the relative residual of doing nothing, which stands in `zero`."""
    cdef score_t s = score_t(0.0, 0.0, 0.0, 0.0, -1, 1)
    cdef bint moves = do_nothing(&t.p, o.zero, o.w)
    if not moves:
        score_rows(&t.p, o.zero, o.w, o.e, &s)
    else:
        judge_into(&t.p, &t.a, &t.r, kind == BODIES, o.zero, o.w, o.e, o.v, False, &s)
        s.finite = s.finite and are_numbers(o.w, t.p.n_rows)
    reference_of(&t.p, &s, moves, False, begun)


cdef inline double share_of(const asked_t* k, const double* begun) noexcept nogil:
    """(2)"""
    cdef double a = k.energy / begun[0] if begun[0] > 0.0 else INFINITY
    cdef double b = k.velocity / begun[1] if begun[1] > 0.0 else INFINITY
    a = a if a < b else b
    if not a < INFINITY:
        return k.tol
    return a if a < 1.0 else 1.0


cdef inline bint is_good(double relative_, double floor) noexcept nogil:
    # As in chain.pyx.
    floor = floor if floor < 1e-6 else 1e-6
    return relative_ <= (floor if floor > 1e-13 else 1e-13)


cdef inline void clipped(const pivoting_t* s, double* out) noexcept nogil:
    cdef int32_t i
    cdef double v
    for i in range(s.n):
        v = s.x[i]
        out[i] = s.p.lower[i] if v < s.p.lower[i] else (s.p.upper[i] if v > s.p.upper[i] else v)


cdef bint pivot(const view_t* t, int32_t kind, const asked_t* k, const double* begun, const double* start, double tol,
                int32_t band, const desk_t* o, int32_t* counts, double* relative_) noexcept nogil:
    """`Chain.pivot`, into `best`; did it end below tol?"""
    cdef pivoting_t s
    cdef int32_t i = 0, swept = 0, done = 1
    cdef double previous = INFINITY, now, floor, best, best_floor
    memset(o.marks, 0, 2 * <ssize_t>t.p.n_rows * sizeof(int32_t))
    pivots_on(&s, &t.a, &t.q, band, 1e-13, o.pivots, o.marks)
    if k.linear:
        pivots_factor_all(&s)
        if s.found.small or s.found.negative:
            return False
        pivots_solve_free(&s)
    else:
        if pivots_solve(&s, start, PIVOT_SWEEPS, PIVOT_ROUNDS, &swept) != PIVOTED:
            return False
        done = s.n_rounds
    clipped(&s, o.best)
    now = judged(t, kind, begun, o.best, o, True, &floor)
    best = now
    best_floor = floor
    if not is_good(best, best_floor):
        pivots_slack(&s)
        while i < CORRECTIONS and not is_good(best, best_floor) and now < 0.5 * previous:
            previous = now
            pivots_correct(&s)
            pivots_slack(&s)
            i += 1
            if pivots_exchange(&s):
                return False
            clipped(&s, o.x)
            now = judged(t, kind, begun, o.x, o, True, &floor)
            if now < best:
                best = now
                best_floor = floor
                memcpy(o.best, o.x, t.p.n_rows * sizeof(double))
    if not is_good(best, best_floor) or not best <= tol:
        return False
    relative_[0] = best
    counts[0] = done
    counts[1] = swept
    counts[2] = i
    counts[3] = s.factorisations
    counts[4] = s.exchanged
    return True


cdef int32_t watched(watch_t* s, const view_t* t, int32_t kind, sweep_data_t* c, double* lam, int32_t n, double tol,
                     int32_t* done) noexcept nogil:
    """`Watch.run`."""
    cdef int32_t step, status
    done[0] = 0
    while done[0] < n:
        step = n - done[0]
        if s.total == s.check_at:
            status = check(s, &t.p, &t.a, &t.r, &t.g if kind == GENERAL else NULL, kind == BODIES, lam, tol)
            if status != RUNNING:
                return status
        if s.check_at - s.total < step:
            step = s.check_at - s.total
        anderson_step(c, lam, s.total == 0, step)
        done[0] += step
        s.total += step
    return RUNNING


cdef inline double work_of(const view_t* t, int32_t kind) noexcept nogil:
    """`Data.work`"""
    if kind == GENERAL:
        return 2 * t.g.pval[t.g.n_panels] + 4 * t.p.n_rows
    if kind == BODIES:
        return 24 * t.r.n_joints + 60 * t.r.n_contacts + 12 * t.p.n_rows
    return t.a.indptr[t.p.n_rows] + 4 * t.p.n_rows


cdef inline ssize_t mixed_room(ssize_t m, ssize_t nv) noexcept nogil:
    return CONTROL + MAX_MEMORY * MAX_MEMORY + 3 * (m + nv) + (1 + 2 * MEMORY) * m + 1


cdef double sweep(const view_t* t, int32_t kind, const asked_t* k, const double* begun, double* lam, double before,
                  double tol, double least, double hope, const int32_t* start, const double* prepared, const desk_t* o,
                  int32_t* counts) noexcept nogil:
    """Looks as in `looks.pyx`, on `lam` in place; the relative residual that it ended with.

    Sweeps go on while what they promise costs no more than `least`; a share `hope` of that is theirs whatever they promise.
    """
    cdef watch_t s
    cdef sweep_data_t c
    cdef uint64_t rng = 0
    cdef int32_t m = t.p.n_rows, i, status, last = 0, total = 0, sweeps, first
    cdef int32_t nv = 6 * t.r.n_bodies if kind == BODIES else t.g.n if kind == GENERAL else 0
    cdef double per = k.work * work_of(t, kind) + k.row * m, now, floor
    memset(o.mixed, 0, mixed_room(m, nv) * sizeof(double))
    s.total = s.check_at = s.last_at = 0
    s.last = INFINITY
    s.best_at = -1
    s.patience = PATIENCE
    s.best_relative = INFINITY
    s.start = 0.0
    s.start_energy = begun[0]
    s.start_velocity = begun[1]
    s.best = o.kept
    s.w = o.w
    s.e = o.e
    s.v = o.v
    c.blocks = &t.p
    c.csr = NULL
    c.rows = &t.r
    c.general = NULL
    if kind == MATRIX:
        c.csr = &t.a
    elif kind == GENERAL:
        c.general = &t.g
    c.start = start
    c.g = prepared
    c.exact = k.exact
    c.convex = 0
    c.turn = 0
    c.cone = t.p
    c.cone.law = CONE
    c.order = o.marks
    c.split = 0
    c.mode = 0
    c.memory = MEMORY
    c.rng = &rng
    c.v = o.velocity
    c.nv = nv
    c.control = o.mixed
    c.gram = o.mixed + CONTROL
    c.work = c.gram + MAX_MEMORY * MAX_MEMORY
    for i in range(t.p.n_blocks):
        o.marks[i] = i
    if kind == GENERAL:
        whitened_gather(&t.g, lam, o.velocity)
    elif nv > 0:
        rows_velocity(&t.p, &t.r, lam, o.velocity)
    first = k.look
    sweeps = first if first < k.n else k.n
    while True:
        status = watched(&s, t, kind, &c, lam, sweeps, tol, &last)
        total += last
        now = judged(t, kind, begun, lam, o, False, &floor)
        if now <= tol or status != RUNNING or total >= k.n or total * per > k.believed * least or (
                total * per > hope * least and sweeps_left(last, before, now, tol) * per > least):
            break
        before = now
        sweeps = total // 2 if total // 2 > first else first
        if sweeps > k.n - total:
            sweeps = k.n - total
    counts[0] = counts[1] = total
    counts[2] = <int32_t>c.control[UNDONE]
    return now


cdef ssize_t numbers_for(ssize_t m, ssize_t nv, ssize_t band) noexcept nogil:
    return 13 * m + 3 * nv + 2 + mixed_room(m, nv) + m * (band + 1) + 1


cdef void furnish_desk(desk_t* o, ssize_t m, ssize_t nv, double* x) noexcept nogil:
    """Room for the judge: 12 numbers of each body, or nv + m."""
    o.zero = x
    o.x = x + m
    o.best = x + 2 * m
    o.w = x + 3 * m
    o.e = x + 4 * m
    o.kept = x + 5 * m
    o.v = x + 6 * m
    o.mixed = o.v + 2 * nv + m + 1
    o.velocity = o.mixed + mixed_room(m, nv)
    o.pivots = o.velocity + nv + 1


cdef double solve_island(island_t* s, view_t* t, int32_t kind, const asked_t* k, const int32_t* start,
                         const double* prepared, space_t* room, double* out) noexcept nogil:
    """An island given by bodies or by A, into `out` (m), which may be better than where it stood even where it is left.

    What that took at a guess [ns].
    """
    cdef desk_t o
    cdef int32_t m = s.n_rows, nv = 6 * s.n_moving if kind == BODIES else 0, band = -1
    cdef int32_t bands[2]
    cdef double gap[2]
    cdef double begun[3]
    cdef double before, tol, now, floor, cost
    cdef ssize_t marks = 2 * <ssize_t>m if 2 * m > s.n_blocks else s.n_blocks
    s.end = LEFT
    memcpy(out, t.lam, m * sizeof(double))
    if not with_marks(room, marks + 1):
        return 0.0
    if k.pivots:
        scan_entries(&t.a, m, room.marks, bands, gap)
        band = bands[0] if bands[0] > bands[1] else bands[1]
        if not (k.symmetric or gap[1] == 0.0 or gap[0] / gap[1] <= 1e-14):
            band = -1
        elif m > k.few and (band + 1 > k.narrow or k.band * m * (band + 1.0) * (band + 1.0) > k.at_once):
            band = -1
    if not with_numbers(room, numbers_for(m, nv, band if band > 0 else 0)):
        return 0.0
    furnish_desk(&o, m, nv, room.numbers)
    o.marks = room.marks
    do_nothing_well(t, kind, &o, begun)
    tol = share_of(k, begun)
    before = judged(t, kind, begun, t.lam, &o, False, &floor)
    s.relative = before
    cost = 2e3 + 50.0 * m
    if before <= tol:
        s.end = AT_START
        return cost
    if band >= 0:
        cost += 6.0 * m * (30.0 + 0.4 * (band + 1.0) * (band + 1.0))
        if pivot(t, kind, k, begun, t.lam if before <= k.warm else o.zero, tol, band, &o, s.counts, &s.relative):
            memcpy(out, o.best, m * sizeof(double))
            s.end = BY_PIVOTS
            return cost
    if not k.sweeps or not before < INFINITY:
        return cost
    memcpy(o.x, t.lam, m * sizeof(double))
    now = sweep(t, kind, k, begun, o.x, before, tol, k.each * m, k.hope, start, prepared, &o, s.counts)
    cost += s.counts[0] * (k.work * work_of(t, kind) + k.row * m)
    if now < before:
        s.relative = now
        memcpy(out, o.x, m * sizeof(double))
    if now <= tol:
        s.end = BY_SWEEPS
    return cost


cdef double solve_trees(island_t* s, view_t* t, const asked_t* k, const int32_t* start, const double* prepared,
                        const gate_t* gate, double most, space_t* room, double* out) noexcept nogil:
    """The same of an island given by J and M."""
    cdef job_t j
    cdef desk_t o
    cdef int32_t m = s.n_rows, nv = s.n_moving
    cdef double tol, before, now, floor, newton, cost = 20e3
    s.end = LEFT
    memcpy(out, t.lam, m * sizeof(double))
    memset(&j, 0, sizeof(job_t))
    j.p = t.p
    j.g = t.g
    if not with_numbers(room, numbers_for(m, nv, 0)) or not with_marks(room, s.n_blocks + 1) \
            or make_numbers(&j.p, &j.g, &j.made) != MADE:
        return 0.0
    t.p = j.p
    t.g = j.g
    furnish_desk(&o, m, nv, room.numbers)
    o.marks = room.marks
    begin(&j, room.numbers)
    tol = share_of(k, j.begin)
    before = judged(t, GENERAL, j.begin, t.lam, &o, False, &floor)
    s.relative = before
    j.law = law_of(&j.p)
    newton = gate.count[j.law] * (gate.row[j.law] * m + gate.factor[j.law] * nv * (<double>nv * nv) /
                                  (3.0 if j.law == 2 else 6.0))
    if before <= tol:
        s.end = AT_START
    elif k.sweeps and not k.exact:                      # under the cone law Newton's steps are few, and sweeps dear
        memcpy(out, t.lam, m * sizeof(double))
        now = sweep(t, GENERAL, k, j.begin, out, before, tol, newton, 0.0, start, prepared, &o, s.counts)
        cost += s.counts[0] * (k.work * work_of(t, GENERAL) + k.row * m)
        if now <= tol:
            s.end = BY_SWEEPS
            s.relative = now
        else:
            memcpy(out, t.lam, m * sizeof(double))
    if s.end == LEFT:
        j.lam = out
        j.both = out + m
        solve_made(&j, room, gate, tol, most)
        memcpy(s.counts, j.counts, sizeof(j.counts))
        cost += newton * j.counts[1] / gate.count[j.law]
        if j.end == SOLVED:
            s.end = BY_VELOCITIES
            s.relative = j.relative
        else:
            memcpy(out, t.lam, m * sizeof(double))
    free(j.made.marks)
    free(j.made.numbers)
    return cost


# -- all of them -----------------------------------------------------------------------------------------


cdef class Islands:
    """The islands of a problem that are chosen, laid out one after the other; `run` solves them.

    Parameters
    ----------
    data : Data
        What the judge reads, prepared, its error of doing nothing known.
    matrix : Data or None
        A in compressed rows of a problem given by bodies, where pivots are asked for.
    label : (k,) int32
        Island of each block, numbered from 0.
    wanted : (count,) int32
        Other than 0: it is to be solved here.
    start : (m,) N s
        Where they stand.
    prepared : (start (k,), numbers) or None
        Of `gauss_seidel.prepare`, where blocks are solved exactly.
    """

    cdef Data data, matrix
    cdef object keep
    cdef island_t* at
    cdef int32_t* order         # (k) blocks by island
    cdef int32_t* rows          # (m) rows by island
    cdef int32_t* begun         # (k) places of their prepared numbers
    cdef int32_t* table         # places of islands by their bytes
    cdef double* numbers
    cdef int32_t* marks
    cdef const double* prepared
    cdef double[::1] lam        # (m) by island
    cdef int32_t kind
    cdef bint also
    cdef space_t room
    cdef readonly int count, n_blocks
    cdef int next, mask

    def __init__(self, Data data, Data matrix, const int32_t[::1] label, const int32_t[::1] wanted,
                 const double[::1] start, prepared):
        cdef int32_t k = data.blocks.n_blocks, m = data.blocks.n_rows, n, i, j, h, b, q, t, count, size = 1
        cdef ssize_t numbers = 0, marks = 0
        cdef const blocks_t* p = &data.blocks
        cdef const csr_t* a = NULL
        cdef island_t* s
        cdef view_t v
        cdef double[::1] all_numbers, g
        cdef int32_t[::1] all_marks, whole, places, table
        cdef const double* x = &start[0]
        count = self.count = <int>wanted.shape[0]
        self.n_blocks = k
        self.data, self.matrix = data, matrix
        self.kind = GENERAL if data.is_general else BODIES if data.factored else MATRIX
        self.also = matrix is not None and self.kind == BODIES
        n = data.general.n if data.is_general else data.rows.n_bodies if data.factored else 0
        if self.kind == MATRIX:
            a = &data.csr
        elif self.also:
            a = &matrix.csr
        at = np.zeros((count + 1) * sizeof(island_t) // 8 + 1)
        whole = np.empty(2 * k + 2 * m + 3 * n + count + 8, np.int32)
        while size < 2 * count:
            size *= 2
        table = np.full(size, -1, np.int32)
        all_numbers = at
        self.at = <island_t*>&all_numbers[0]
        self.order = &whole[0]
        self.begun = self.order + k
        self.rows = self.begun + k
        self.table = &table[0]
        self.mask = size - 1
        self.lam = np.empty(3 * m + 2)                  # w and e of the judge behind the last
        places = whole[2 * k + m:]
        cdef int32_t* place = &places[0]                # (m) of each row in its island
        cdef int32_t* number = place + m                # (n) of each body or velocity in its island
        cdef int32_t* of = number + n                   # (n) its island
        cdef int32_t* moving = of + n                   # (n) bodies or velocities by island
        cdef int32_t* first = moving + n                # (count + 1) the first of each island
        self.keep = [at, whole, table]
        with nogil:
            for i in range(n):
                of[i] = -1
            for i in range(k):
                self.at[label[i]].n_blocks += 1
            j = 0
            for i in range(count):
                self.at[i].first = j
                j += self.at[i].n_blocks
                self.at[i].n_blocks = 0
                self.at[i].twin = -1
                self.at[i].chosen = wanted[i] != 0
            for i in range(k):                          # a stable counting sort, and what each island holds
                s = &self.at[label[i]]
                self.order[s.first + s.n_blocks] = i
                s.n_blocks += 1
                for j in range(p.ptr[i], p.ptr[i + 1]):
                    place[j] = s.n_rows
                    s.n_rows += 1
                    if a != NULL:
                        s.n_entries += a.indptr[j + 1] - a.indptr[j]
                    if data.is_general:
                        s.n_entries += data.general.jptr[j + 1] - data.general.jptr[j]
                        for q in range(data.general.jptr[j], data.general.jptr[j + 1]):
                            of[data.general.jidx[q]] = label[i]
                if self.kind == BODIES:
                    if i < data.rows.n_joints:
                        s.n_joints += 1
                        s.n_joint_rows += p.ptr[i + 1] - p.ptr[i]
                    for h in range(2):
                        b = data.rows.joint_body[2 * i + h] if i < data.rows.n_joints else \
                            data.rows.contact_body[2 * (i - data.rows.n_joints) + h]
                        if b >= 0:
                            of[b] = label[i]
            if data.is_general:
                for i in range(n - 1, -1, -1):          # to the root, and down to whom no row touches
                    t = data.general.parent[i]
                    if t >= 0 and of[i] >= 0:
                        of[t] = of[i]
                for i in range(n):
                    t = data.general.parent[i]
                    if t >= 0 and of[i] < 0:
                        of[i] = of[t]
            for i in range(n):
                if of[i] >= 0:
                    s = &self.at[of[i]]
                    number[i] = s.n_moving
                    s.n_moving += 1
                    if data.is_general:
                        s.n_lower += data.general.lptr[i + 1] - data.general.lptr[i]
            j = h = 0
            for i in range(count):
                s = &self.at[i]
                first[i] = j
                j += s.n_moving
                s.row = h
                h += s.n_rows
                s.end = LEFT
                if s.chosen:
                    sizes(s, self.kind, self.also)
                    s.numbers = numbers
                    s.marks = marks
                    numbers += s.n_numbers
                    marks += s.n_marks
            for i in range(n):
                if of[i] >= 0:
                    moving[first[of[i]] + number[i]] = i
            for i in range(k):
                s = &self.at[label[i]]
                for j in range(p.ptr[i], p.ptr[i + 1]):
                    self.rows[s.row + place[j]] = j
        all_numbers = np.empty(numbers + 1)
        all_marks = np.zeros(marks + 2, np.int32)
        self.numbers = &all_numbers[0]
        self.marks = &all_marks[0]
        self.keep += [all_numbers, all_marks]
        if prepared is not None:
            places, g = prepared
            self.prepared = &g[0]
            self.keep += [g]
            for i in range(k):
                self.begun[i] = places[self.order[i]]
        with nogil:
            for i in range(count):
                s = &self.at[i]
                if not s.chosen:
                    continue
                point(s, self.kind, self.also, p.law, self.numbers + s.numbers, self.marks + s.marks, &v)
                fill_blocks(p, &matrix.blocks if self.also else NULL, x, s, self.order, &v)
                if a != NULL:
                    fill_csr(p, a, s, self.order, place, &v)
                if self.kind == BODIES:
                    fill_bodies(p, &data.rows, s, self.order, number, moving + first[i], &v)
                elif self.kind == GENERAL:
                    fill_trees(p, &data.general, s, self.order, number, moving + first[i], &v)

    def __dealloc__(self):
        free(self.room.numbers)
        free(self.room.marks)

    cdef int32_t same(self, int32_t i) noexcept nogil:
        """An island before i whose bytes are the same, -1 where there is none, and i is then known."""
        cdef island_t* s = &self.at[i]
        cdef island_t* o
        cdef uint64_t h = hashed(self.numbers + s.numbers, s.n_numbers, <uint64_t>s.n_rows)
        h = hashed(self.marks + s.marks, s.n_marks // 2, h)
        cdef int32_t slot = <int32_t>(h & <uint64_t>self.mask)
        while self.table[slot] >= 0:
            o = &self.at[self.table[slot]]
            if o.n_numbers == s.n_numbers and o.n_marks == s.n_marks and o.n_rows == s.n_rows \
                    and o.n_joints == s.n_joints and o.n_moving == s.n_moving and o.n_entries == s.n_entries \
                    and memcmp(self.marks + o.marks, self.marks + s.marks, s.n_marks * sizeof(int32_t)) == 0 \
                    and memcmp(self.numbers + o.numbers, self.numbers + s.numbers,
                               s.n_numbers * sizeof(double)) == 0:
                return self.table[slot]
            slot = (slot + 1) & self.mask
        self.table[slot] = i
        return -1

    def run(self, asked, Gate gate, double most, double limit, double[::1] impulse):
        """Solve from where the last call ended, as long as that takes at a guess at most `limit` [ns]; is there more?

        `asked` as `asked_t`; of what is solved, and of what came nearer, the impulse goes into `impulse` (m,).
        """
        cdef asked_t k
        cdef island_t* s
        cdef island_t* o
        cdef view_t v
        cdef double spent = 0.0
        cdef double* lam = &self.lam[0]
        cdef int32_t j
        cdef const int32_t* begun = NULL
        (k.tol, k.energy, k.velocity, k.warm, k.n, k.pivots, k.linear, k.symmetric, k.sweeps, k.exact, k.few, k.narrow,
         k.band, k.at_once, k.work, k.row, k.look, k.each, k.hope, k.believed) = asked
        with nogil:
            while self.next < self.count and spent < limit:
                s = &self.at[self.next]
                if s.chosen:
                    s.twin = self.same(self.next)
                    if s.twin >= 0:
                        o = &self.at[s.twin]
                        s.end = o.end
                        s.relative = o.relative
                        memcpy(s.counts, o.counts, sizeof(s.counts))
                        memcpy(lam + s.row, lam + o.row, s.n_rows * sizeof(double))
                        spent += 1e3
                    else:
                        point(s, self.kind, self.also, self.data.blocks.law, self.numbers + s.numbers,
                              self.marks + s.marks, &v)
                        if self.prepared != NULL:
                            begun = self.begun + s.first
                        if self.kind == GENERAL:
                            spent += solve_trees(s, &v, &k, begun, self.prepared, &gate.at, most, &self.room,
                                                 lam + s.row)
                        else:
                            spent += solve_island(s, &v, self.kind, &k, begun, self.prepared, &self.room,
                                                  lam + s.row)
                    for j in range(s.row, s.row + s.n_rows):
                        impulse[self.rows[j]] = lam[j]
                self.next += 1
        return self.next < self.count

    def report(self):
        """(count, 8) int32: how each island ended, its counts (5), rows, 1 where it is the copy of another's."""
        cdef int32_t i, j
        found = np.zeros((self.count, 8), np.int32)
        cdef int32_t[:, ::1] out = found
        for i in range(self.count):
            out[i, 0] = self.at[i].end
            for j in range(5):
                out[i, 1 + j] = self.at[i].counts[j]
            out[i, 6] = self.at[i].n_rows
            out[i, 7] = self.at[i].twin >= 0
        return found
