"""Bounded rows to rounding: principal pivoting, refined and judged, and what follows where it does not end there.

    rounds     of principal.pyx; what they end at is refined, x_F <- x_F - A_FF^-1 w_F, while that halves the residual
    passes     rounds on A + s D around the last answer c, where A is singular on the free rows: a fixed point
               solves A itself                                                                            (1)
    descent    where rounds are stuck, instead of them, along falling s:

        phi(x) = 1/2 x.A x - b.x + s/2 |x - c|_D^2,  grad phi = w                                         (2)
        x <- P(x - t A_FF^-1 w_F),  F: rows off their bounds, or whose w pushes them off                  (3)
        t = 1, 1/2, ... until phi falls by 1e-4 of what w promises                                        (4)

Bertsekas 1982. (3) is monotone, so no set comes back: what pivoting lacks on a nearly singular A. `direct_turn` leads
from one to the other: a call does at most as many rounds as it is asked for, and the host looks at its clock in between.
"""
from libc.math cimport INFINITY
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy

import numpy as np

from lavender_ext.core.block cimport clip
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.problem cimport Data
from lavender_ext.core.view cimport csr_t, view_t
from lavender_ext.judge.measure cimport above_floor_of, floor_of, judge_view, judged_from, relative_of, scratch_of
from lavender_ext.judge.score cimport is_at_floor, new_score, score_t
from lavender_ext.pivot.direct cimport CIRCLES, HALVED, PASSED, SPENT, direct_t
from lavender_ext.pivot.principal cimport (INDEFINITE, ROUNDS, SMALL, SOLVED, STUCK, factor_free, pivots_solve,
                                           pivoting_t, pivots_correct, pivots_exchange, pivots_factor_all, pivots_on,
                                           pivots_renew, pivots_restart, pivots_rounds, pivots_slack, pivots_solve_free,
                                           pivots_start)


cdef enum:
    CORRECTIONS = 100           # refinements at a time at most; each halves the residual
    PASSES = 100
    WAIT = 6                    # of these without halving the best residual
    SHIFTS = 5                  # of the path
    HALVINGS = 41               # step lengths tried in a line search: 1, 1/2, ... 2^-40

cdef enum:                      # stages
    BEGIN = 0
    EXCHANGING = 1
    PASSING = 2


cdef int64_t direct_real(const view_t* v, int64_t band) noexcept nogil:
    """Numbers that `direct_lay` hands out, a factor of half bandwidth `band` among them, -1: none."""
    cdef int64_t m = v.p.n_rows
    return 16 * m + m * (band + 1) + 1 + scratch_of(v)


cdef int64_t direct_index(const view_t* v) noexcept nogil:
    return 4 * <int64_t>v.p.n_rows + 1


cdef void direct_lay(direct_t* t, const view_t* v, const csr_t* a, const blocks_t* p, int32_t band, const int32_t* order,
                     double tiny, double* real, int32_t* index) noexcept nogil:
    """All arrays; what is judged is v, what is pivoted on a, with d of p. e0, v0, least, sweeps, linear are the caller's."""
    cdef int64_t m = p.n_rows
    t.v = v[0]
    t.x, t.best = real, real + 3 * m
    t.start, t.origin, t.slope, t.turn = real + 6 * m, real + 7 * m, real + 8 * m, real + 9 * m
    t.scratch = real + 10 * m
    t.side = index + 3 * m
    pivots_on(&t.s, a, p, band, order, tiny, t.scratch + scratch_of(v), index)
    if not t.symmetric:
        t.s.swap = index + 2 * m
    direct_renew(t)


cdef inline void direct_renew(direct_t* t) noexcept nogil:
    pivots_renew(&t.s)
    t.relative = INFINITY
    t.floor = 0.0
    t.rank = t.solved = t.swept = t.refined = t.shifts = t.searches = t.passes = 0
    t.stage = BEGIN


cdef void direct_begin(direct_t* t, const double* start) noexcept nogil:
    """As if nothing had been solved, from start (m)."""
    direct_renew(t)
    memcpy(t.start, start, t.s.n * sizeof(double))


cdef void begin_exchanges(direct_t* t) noexcept nogil:
    """Begin with exchanges from the bounds in s.at."""
    pivots_start(&t.s, 0.0)
    t.stage = EXCHANGING


cdef inline int32_t is_good(const direct_t* t) noexcept nogil:
    """To rounding, or to the floor where it excuses that."""
    return t.relative <= t.least or (t.relative <= t.floor and is_at_floor(t.relative, t.floor))


cdef int32_t is_end(const direct_t* t) noexcept nogil:
    """The same; where every row is free, rounding is all that can be left."""
    return is_good(t) or (t.linear and is_at_floor(t.relative, t.floor))


cdef inline void clip_rows(const direct_t* t, const double* x, double* out) noexcept nogil:
    cdef int32_t i
    for i in range(t.s.n):
        out[i] = clip(x[i], t.s.p.lower[i], t.s.p.upper[i])


cdef void judge_now(direct_t* t) noexcept nogil:
    """x within its bounds, judged; the best is kept."""
    cdef score_t found = new_score()
    cdef double* x = t.x
    cdef double* w = x + t.s.n
    clip_rows(t, t.s.x, x)
    judge_view(&t.v, x, w, w + t.s.n, t.scratch, True, &found)
    t.now = relative_of(&found, w, t.s.n, t.e0, t.v0)
    if t.now < t.relative:
        t.relative = t.now
        t.floor = floor_of(&found, t.e0, t.v0)
        t.score = found
        t.x, t.best = t.best, x


cdef inline int32_t refine(direct_t* t) noexcept nogil:
    # Corrections while they halve the residual; ROUNDS where one changes a sign.
    cdef double previous = INFINITY
    cdef int32_t _
    for _ in range(CORRECTIONS):
        if is_good(t) or not t.now < 0.5 * previous:
            break
        previous = t.now
        pivots_correct(&t.s)
        pivots_slack(&t.s)
        t.refined += 1
        if pivots_exchange(&t.s):
            return ROUNDS
        judge_now(t)
    return SOLVED


cdef int32_t after_rounds(direct_t* t, int32_t code) noexcept nogil:
    """Judge what rounds left, and refine it; `code` of theirs, or ROUNDS where that changed a sign."""
    if code == SMALL or code == INDEFINITE:
        return code
    judge_now(t)
    if code != SOLVED:
        return code
    if t.s.shift != 0.0:
        return SOLVED
    t.solved = 1
    if is_good(t):
        return SOLVED
    pivots_slack(&t.s)
    return refine(t)


cdef int32_t direct_factor(direct_t* t) noexcept nogil:
    """A with all rows free: SOLVED, or SMALL or INDEFINITE after its pivots."""
    if not t.s.is_factored:
        pivots_factor_all(&t.s)
    if t.s.found.negative > 0:
        return INDEFINITE
    if t.s.found.small == 0:
        return SOLVED
    t.rank = t.s.n - t.s.found.small
    return SMALL


cdef int32_t direct_linear(direct_t* t) noexcept nogil:
    """All rows free, after a factor that is SOLVED."""
    t.s.n_rounds += 1
    pivots_solve_free(&t.s)
    return after_rounds(t, SOLVED)


cdef int32_t direct_first(direct_t* t, int32_t sweeps, int32_t n) noexcept nogil:
    """A guess of the free rows by `sweeps` symmetric sweeps, or all of a narrow band, then `direct_rounds`."""
    return after_rounds(t, pivots_solve(&t.s, t.start, sweeps, n, &t.swept))


cdef int32_t direct_rounds(direct_t* t, int32_t n) noexcept nogil:
    """At most n rounds, judged and refined.

    Signs that differ by rounding alone exchange for ever: after ROUNDS the judge may see that nothing is wrong.
    """
    return after_rounds(t, pivots_rounds(&t.s, n))


cdef void direct_begin_passes(direct_t* t, int32_t stuck) noexcept nogil:
    """Passes from the best impulse so far, along the path of shifts where rounds are stuck."""
    cdef bint known = t.relative < INFINITY and t.floor <= 1e-6
    memcpy(t.s.x, t.best if known else t.start, t.s.n * sizeof(double))
    t.stuck = stuck
    t.at = 0 if stuck else SHIFTS - 1
    t.next = 0.0
    t.passes = t.waited = 0
    t.fresh = 1
    t.reference = INFINITY


cdef inline double shift_of(int32_t at) noexcept nogil:
    # -, of d: the last is far above the rounding of a factorisation and below what a mass ratio of 1e8 leaves.
    return 1e-2 if at == 0 else 1e-4 if at == 1 else 1e-6 if at == 2 else 1e-8 if at == 3 else 1e-10


cdef inline void recenter(direct_t* t) noexcept nogil:
    memcpy(t.s.center, t.s.x, t.s.n * sizeof(double))


cdef inline void open_pass(direct_t* t) noexcept nogil:
    t.fresh = 0
    t.passes += 1
    recenter(t)
    if t.next > 0.0 or t.at < SHIFTS:
        pivots_start(&t.s, t.next if t.next > 0.0 else shift_of(t.at))
        t.at += t.next == 0.0
        t.next = 0.0
        t.shifts += 1
    pivots_restart(&t.s)


cdef inline void settle(direct_t* t) noexcept nogil:
    # More passes with the same factor, on the rows found, whatever signs rounding gives.
    cdef double previous = INFINITY
    cdef int32_t _
    for _ in range(CORRECTIONS):
        if is_good(t) or not t.now < 0.5 * previous:
            break
        previous = t.now
        recenter(t)
        pivots_slack(&t.s)
        pivots_correct(&t.s)
        pivots_slack(&t.s)
        t.refined += 1
        judge_now(t)
        if not t.now < previous:
            memcpy(t.s.x, t.s.center, t.s.n * sizeof(double))


cdef int32_t direct_pass(direct_t* t, int32_t n) noexcept nogil:
    """At most n rounds of a pass.

    SOLVED: `is_end`. ROUNDS: the pass goes on with the next call. HALVED, PASSED: it came to its end. STUCK, SMALL: the
    next one descends, or has a larger shift. INDEFINITE: there is none larger.
    """
    cdef int32_t code, i
    if t.fresh and t.passes == PASSES:
        return SPENT
    if t.fresh:
        open_pass(t)
    code = descend(t, n) if t.stuck else direct_rounds(t, n)
    if is_end(t):
        return SOLVED
    if code == ROUNDS:
        return ROUNDS
    t.fresh = 1
    if code == STUCK:
        t.stuck = 1
        t.at = 0
        clip_rows(t, t.s.center, t.s.x)
        return STUCK
    if code != SOLVED:
        if t.s.shift >= shift_of(0):
            return INDEFINITE
        t.next = 100.0 * t.s.shift
        t.at = SHIFTS
        memcpy(t.s.x, t.s.center, t.s.n * sizeof(double))
        return SMALL
    for i in range(t.s.n):
        t.turn[i] = t.s.x[i] - t.s.center[i]
    settle(t)
    if is_end(t):
        return SOLVED
    if t.at < SHIFTS or t.relative <= 0.5 * t.reference:
        t.reference = t.relative
        t.waited = 0
        return HALVED
    t.waited += 1
    return PASSED


cdef int32_t direct_turn(direct_t* t, int32_t n) noexcept nogil:
    """What comes next, of at most n rounds.

    ROUNDS, HALVED, PASSED, and SMALL and STUCK, which passes follow: another turn goes on. Else it is over: SOLVED
    `is_end`, INDEFINITE, CIRCLES or SPENT. After PASSED and SPENT, what the pass changed may be a certificate.
    """
    cdef int32_t code
    if t.stage == PASSING:
        code = direct_pass(t, n)
        if code == STUCK and not t.symmetric:
            return CIRCLES
        return SPENT if code == PASSED and t.waited >= WAIT else code
    if t.linear:
        code = direct_factor(t)
        if code == SOLVED:
            code = direct_linear(t)
    else:
        code = direct_first(t, t.sweeps, n) if t.stage == BEGIN else direct_rounds(t, n)
    t.stage = EXCHANGING
    if is_end(t):
        return SOLVED
    if code == ROUNDS or code == INDEFINITE:
        return code
    if not t.symmetric and (t.linear or code == STUCK):
        return CIRCLES if code == STUCK else INDEFINITE if code == SMALL else SPENT
    t.stage = PASSING
    direct_begin_passes(t, code == STUCK)
    return SMALL if code == SMALL else STUCK


cdef inline bint take_sides(direct_t* t) noexcept nogil:
    # F of (3) at `origin`; is the factor of those rows at hand?
    cdef pivoting_t* s = &t.s
    cdef int32_t i, changed = 0
    cdef double low, high, slop
    for i in range(s.n):
        low, high, slop = s.p.lower[i], s.p.upper[i], 8.0 * s.f[i]
        if low == high or (t.origin[i] <= low and t.slope[i] >= -slop):
            t.side[i] = -1
        else:
            t.side[i] = t.origin[i] >= high and t.slope[i] <= slop
        changed += t.side[i] != s.at[i]
    s.exchanged += changed
    memcpy(s.at, t.side, s.n * sizeof(int32_t))
    return s.is_factored and changed == 0


cdef inline double search(direct_t* t) noexcept nogil:
    # (4): x and its w at the end of the step `turn` from `origin`; t.  No cancellation:
    # phi(y) - phi(x) = 1/2 (w(x) + w(y)).(y - x)
    cdef pivoting_t* s = &t.s
    cdef int32_t i, _
    cdef double length = 1.0, gained, promised, move
    for _ in range(HALVINGS):
        for i in range(s.n):
            s.x[i] = clip(t.origin[i] + length * t.turn[i], s.p.lower[i], s.p.upper[i])
        pivots_slack(s)
        t.searches += 1
        gained = promised = 0.0
        for i in range(s.n):
            move = s.x[i] - t.origin[i]
            promised += t.slope[i] * move
            gained += (t.slope[i] + s.w[i]) * move
        if 0.5 * gained <= 1e-4 * promised:
            break
        length *= 0.5
    return length


cdef inline bint stays(const direct_t* t) noexcept nogil:
    # Was the whole step within the bounds, and does no w push a row off its own?
    cdef const pivoting_t* s = &t.s
    cdef int32_t i
    cdef double low, high, slop, y
    for i in range(s.n):
        low, high, slop = s.p.lower[i], s.p.upper[i], 8.0 * s.f[i]
        y = t.origin[i] + t.turn[i]
        if not low - slop / s.p.d[i] <= y <= high + slop / s.p.d[i]:
            return False
        if (s.at[i] < 0 and low != high and s.w[i] < -slop) or (s.at[i] > 0 and s.w[i] > slop):
            return False
    return True


cdef inline int32_t descend(direct_t* t, int32_t n) noexcept nogil:
    """At most n steps of (3), judged."""
    cdef pivoting_t* s = &t.s
    cdef int32_t i, _, code = ROUNDS
    cdef double length
    clip_rows(t, s.x, s.x)
    pivots_slack(s)
    for _ in range(n):
        memcpy(t.origin, s.x, s.n * sizeof(double))
        memcpy(t.slope, s.w, s.n * sizeof(double))
        if not take_sides(t):
            factor_free(s, NULL)
            if s.late:
                break
            if s.found.negative > 0 or s.found.small > 0:
                s.n_rounds += 1
                return INDEFINITE if s.found.negative > 0 else SMALL
        s.n_rounds += 1
        pivots_correct(s)
        for i in range(s.n):
            t.turn[i] = s.x[i] - t.origin[i]
        length = search(t)
        if length == 1.0 and stays(t):
            code = SOLVED
            break
    judge_now(t)
    return code


cdef int32_t factor_outside(void* of, const int32_t* _place, int32_t n_free, double shift) noexcept with gil:
    # By Python; -1 where it was not begun, or broke off.
    cdef Pivoting rows = <Pivoting>of
    cdef Py_ssize_t m = rows.t.s.n
    if rows.error is not None:
        return -1
    try:
        return rows.outside.factor(rows.ints[m:2 * m], n_free, shift)
    except BaseException as error:
        rows.error = error
        return -1


cdef void solve_outside(void* of, int32_t n_free, double* y) noexcept with gil:
    cdef Pivoting rows = <Pivoting>of
    cdef const double[::1] found
    if rows.error is not None or n_free == 0:
        return
    try:
        found = rows.outside.solve(np.asarray(<double[:n_free]>y).copy())
        memcpy(y, &found[0], n_free * sizeof(double))
    except BaseException as error:
        rows.error = error


cdef class Pivoting:
    """The rows of one problem, for one solve.

    Parameters
    ----------
    p : Data
        Of A in compressed rows.
    band : int
        Half bandwidth of A in order of elimination, at most m - 1; -1: the factor is `outside`.
    order : (m,) int32 or None
        Row eliminated first, second, ...; None: as they stand.
    tiny : float
        Pivots below tiny d are small.
    judged : Data, optional
        What the judge reads, its error of doing nothing known; default p.
    outside : object, optional
        `factor(place, n_free, shift)` of the rows with place >= 0, numbered as they stand: how many pivots are small, -1
        where it was not begun; `solve(rhs)` (n_free,).
    linear, symmetric : bool
        Every row is free; A is symmetric. Without `outside`: else LU, in workspace for a band of m - 1, as rows stand.
    """

    def __init__(self, Data p, int band, order, double tiny, Data judged=None, outside=None, bint linear=False,
                 bint symmetric=True):
        cdef int32_t m = p.blocks.n_rows
        cdef const int32_t[::1] given
        cdef double[::1] reals
        cdef int32_t[::1] ints
        cdef const int32_t* first = NULL
        cdef view_t v
        if p.factored or p.is_general:
            raise ValueError("Pivoting reads A in compressed rows")
        if outside is None and not symmetric and (band != m - 1 or order is not None):
            raise ValueError("LU has workspace where the band is whole, and takes rows as they stand")
        self.p, self.judged, self.order, self.outside = p, p if judged is None else judged, order, outside
        if order is not None:
            given = order
            if given.shape[0] != m:
                raise ValueError("order must name every row once")
            if m:
                first = &given[0]
        v = self.judged.view()
        # One block for the vectors and the factor: two allocations in all.
        self.reals = np.zeros(direct_real(&v, band))
        self.ints = np.zeros(direct_index(&v), np.int32)
        reals, ints = self.reals, self.ints
        self.t.e0, self.t.v0 = self.judged.reference_energy, self.judged.reference_velocity
        self.t.least = 1e-13
        self.t.linear, self.t.symmetric = linear, symmetric
        direct_lay(&self.t, &v, &p.csr, &p.blocks, band, first, tiny, &reals[0], &ints[0])
        if outside is not None:
            self.t.s.swap = NULL
            self.t.s.outside = <void*>self
            self.t.s.refactor = factor_outside
            self.t.s.resolve = solve_outside

    cdef int told(self, int32_t code) except -1:
        # What broke off outside comes up here.
        error, self.error = self.error, None
        if error is not None:
            raise error
        return code

    def factor_all(self):
        """Factor A, all rows free: SOLVED, SMALL or INDEFINITE."""
        cdef int32_t code
        with nogil:
            code = direct_factor(&self.t)
        return self.told(code)

    def begin(self, const double[::1] start, double least, int sweeps):
        """From start (m,) [N s], with `sweeps` symmetric ones; `least`: the relative residual good whatever the floor."""
        self.t.least, self.t.sweeps = least, sweeps
        memcpy(self.t.start, &start[0], self.t.s.n * sizeof(double))

    def advance(self, int n):
        """At most n rounds, refined and judged, as `direct_turn` says."""
        cdef int32_t code
        with nogil:
            code = direct_turn(&self.t, n)
        return self.told(code)

    @property
    def relative(self):
        """Relative residual of the best impulse, inf before any."""
        return self.t.relative

    @property
    def floor(self):
        """What rounding alone costs it, relative."""
        return self.t.floor

    @property
    def above_floor(self):
        """What of the relative residual of the best impulse rounding does not explain, inf before any."""
        return above_floor_of(&self.t.score, self.t.relative, self.t.floor) if self.t.relative < INFINITY else INFINITY

    @property
    def changed(self):
        """(m,) N s, what the last pass changed; a new array."""
        cdef Py_ssize_t at = 9 * <Py_ssize_t>self.t.s.n
        return self.reals[at:at + self.t.s.n].copy()

    @property
    def late(self):
        """A factor was not begun."""
        return bool(self.t.s.late)

    @property
    def n_rounds(self):
        return self.t.s.n_rounds

    @property
    def passes(self):
        """So many have begun."""
        return self.t.passes

    @property
    def rank(self):
        """Of A where `factor_all` was SMALL, by pivots above tiny d."""
        return self.t.rank

    @property
    def work(self):
        """What was done, but what was not."""
        counts = (("sweeps", 2 * self.t.sweeps * self.t.swept), ("shifts", self.t.shifts), ("refinements", self.t.refined),
                  ("factorisations", self.t.s.factorisations), ("pivots", self.t.s.exchanged),
                  ("line_searches", self.t.searches))
        return {what: count for what, count in counts if count}

    @property
    def best(self):
        """What the judge found of the best impulse; None before any."""
        cdef Py_ssize_t m = self.t.s.n, at
        if not self.t.relative < INFINITY:
            return None
        at = 0 if self.t.best < self.t.x else 3 * m     # the two change places
        found = self.reals[at:at + 3 * m].copy()
        return judged_from(self.judged, found[:m], found[m:], &self.t.score, self.t.relative, self.t.floor)

    def skipped(self):
        """Rows whose pivots were small in the last factorisation, in order of elimination."""
        cdef pivoting_t* s = &self.t.s
        rows = self.order if self.order is not None else range(s.n)
        return [i for i in rows if s.place[i] >= 0 and s.c[<int64_t>s.place[i] * s.width] == 0.0]
