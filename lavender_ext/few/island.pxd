"""One island's solve, the way of a problem of few rows (`chain.pyx`, `looks.pyx`, `many.pyx`), to its share of the whole.

    tol_i = min(tol E0 / (sqrt(islands) E0_i), tol V0 / V0_i)                                                         (2)
"""
from libc.math cimport INFINITY
from libc.stdint cimport int32_t, uint64_t
from libc.stdlib cimport free
from libc.string cimport memcpy, memset

from lavender_ext.accelerate.accelerated cimport anderson_step, sweep_data_t
from lavender_ext.accelerate.mixing cimport CONTROL, MAX_MEMORY, UNDONE
from lavender_ext.core.block cimport CONE
from lavender_ext.core.csr cimport scan_entries
from lavender_ext.core.generalized cimport whitened_gather
from lavender_ext.core.problem cimport MADE, make_numbers
from lavender_ext.core.velocity cimport rows_velocity
from lavender_ext.few.islands cimport AT_START, BY_PIVOTS, BY_SWEEPS, BY_VELOCITIES, LEFT
from lavender_ext.few.layout cimport BODIES, GENERAL, MATRIX, island_t, view_t
from lavender_ext.few.looks cimport sweeps_left
from lavender_ext.few.many cimport SOLVED, begin, gate_t, job_t, law_of, solve_made, space_t, with_marks, with_numbers
from lavender_ext.judge.measure cimport do_nothing, general_judge, judge_into, reference_of, relative_of
from lavender_ext.judge.score cimport are_numbers, relative, score_rows, score_t
from lavender_ext.judge.watch cimport RUNNING, begin_watch, check, watch_t
from lavender_ext.pivot.principal cimport SMALL
from lavender_ext.pivot.principal cimport SOLVED as PIVOTED
from lavender_ext.pivot.principal cimport (pivoting_t, pivots_correct, pivots_exchange, pivots_factor_all, pivots_on,
                                           pivots_restart, pivots_rounds, pivots_slack, pivots_solve, pivots_solve_free,
                                           pivots_start)


cdef enum:                      # as in chain.pyx
    PIVOT_SWEEPS = 2
    PIVOT_ROUNDS = 32
    CORRECTIONS = 100
    PASSES = 100
    MEMORY = 5
    PATIENCE = 500


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


cdef struct desk_t:             # scratch of one island
    double* zero                # (m) Pi(0)
    double* x                   # (m)
    double* best                # (m)
    double* w                   # (m)
    double* e                   # (m)
    double* v                   # (12 n)
    double* kept                # (3 m) of a watch
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


cdef inline bint shifted(const view_t* t, int32_t kind, const double* begun, const double* start, double tol,
                  pivoting_t* s, const desk_t* o, int32_t* counts, double* relative_) noexcept nogil:
    """`Chain.shifted` of bounded rows."""
    cdef int32_t i = 0, _p
    cdef size_t size = t.p.n_rows * sizeof(double)
    cdef double previous, now, floor, best = INFINITY, best_floor = 0.0, reference = INFINITY
    memcpy(s.x, start, size)
    for _p in range(PASSES):
        memcpy(s.center, s.x, size)
        if s.shift == 0.0:
            pivots_start(s, 1e-10)          # of d, as in chain.pyx
        pivots_restart(s)
        if pivots_rounds(s, PIVOT_ROUNDS) != PIVOTED:
            return False
        clipped(s, o.x)
        now = judged(t, kind, begun, o.x, o, True, &floor)
        previous = INFINITY
        while True:
            if now < best:
                best = now
                best_floor = floor
                memcpy(o.best, o.x, size)
            if not best < INFINITY:
                return False
            if is_good(best, best_floor) or i == CORRECTIONS or not now < 0.5 * previous:
                break
            previous = now
            memcpy(s.center, s.x, size)
            pivots_slack(s)
            pivots_correct(s)
            i += 1
            clipped(s, o.x)
            now = judged(t, kind, begun, o.x, o, True, &floor)
            if not now < previous:
                memcpy(s.x, s.center, size)
        if is_good(best, best_floor) or not best <= 0.5 * reference:
            break
        reference = best
    if not is_good(best, best_floor) or not best <= tol:
        return False
    relative_[0] = best
    counts[0] = s.n_rounds
    counts[2] = i
    counts[3] = s.factorisations
    counts[4] = s.exchanged
    counts[5] = 1
    return True


cdef inline bint pivot(const view_t* t, int32_t kind, const asked_t* k, const double* begun, const double* start, double tol,
                int32_t band, const desk_t* o, int32_t* counts, double* relative_) noexcept nogil:
    """`Chain.pivot`, into `best`; did it end below tol?"""
    cdef pivoting_t s
    cdef int32_t i = 0, swept = 0, done = 1, code
    cdef double previous = INFINITY, now, floor, best, best_floor
    memset(o.marks, 0, 2 * <ssize_t>t.p.n_rows * sizeof(int32_t))
    pivots_on(&s, &t.a, &t.q, band, 1e-13, o.pivots, o.marks)
    if k.linear:
        pivots_factor_all(&s)
        if s.found.small or s.found.negative:
            return False
        pivots_solve_free(&s)
    else:
        code = pivots_solve(&s, start, PIVOT_SWEEPS, PIVOT_ROUNDS, &swept)
        if code == SMALL:
            counts[1] = swept
            return shifted(t, kind, begun, start, tol, &s, o, counts, relative_)
        if code != PIVOTED:
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
    counts[5] = 0
    return True


cdef inline int32_t watched(watch_t* s, const view_t* t, int32_t kind, sweep_data_t* c, double* lam, int32_t n, double tol,
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
        return 24 * t.r.n_joints + 20 * (t.p.n_rows - t.p.ptr[t.r.n_joints]) + 12 * t.p.n_rows
    return t.a.indptr[t.p.n_rows] + 4 * t.p.n_rows


cdef inline ssize_t mixed_room(ssize_t m, ssize_t nv) noexcept nogil:
    return CONTROL + MAX_MEMORY * MAX_MEMORY + 3 * (m + nv) + (1 + 2 * MEMORY) * m + 1


cdef inline double sweep(const view_t* t, int32_t kind, const asked_t* k, const double* begun, double* lam, double before,
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
    begin_watch(&s, begun[0], begun[1], PATIENCE, o.kept, m)
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
    c.keeps = 0
    c.packed = NULL
    c.backwards = 0
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


cdef inline ssize_t numbers_for(ssize_t m, ssize_t nv, ssize_t band) noexcept nogil:
    return 15 * m + 3 * nv + 2 + mixed_room(m, nv) + m * (band + 1) + 1


cdef inline void furnish_desk(desk_t* o, ssize_t m, ssize_t nv, double* x) noexcept nogil:
    """Room for the judge: 12 numbers of each body, or nv + m."""
    o.zero = x
    o.x = x + m
    o.best = x + 2 * m
    o.w = x + 3 * m
    o.e = x + 4 * m
    o.kept = x + 5 * m
    o.v = x + 8 * m
    o.mixed = o.v + 2 * nv + m + 1
    o.velocity = o.mixed + mixed_room(m, nv)
    o.pivots = o.velocity + nv + 1


cdef inline double solve_island(island_t* s, view_t* t, int32_t kind, const asked_t* k, const int32_t* start,
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


cdef inline double solve_trees(island_t* s, view_t* t, const asked_t* k, const int32_t* start, const double* prepared,
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
