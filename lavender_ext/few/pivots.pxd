"""Bounded rows by pivots, judged, in room that the caller has: what `direct` does, without a word of Python.

    A lambda = b where every row is free; else principal pivoting (pivot/principal.pyx); refined while that halves the
    residual; where A is singular on the free rows once more on A + s D, s = 1e-10, around the last answer

The same steps in the same order as `direct` takes on any problem, so the same bits and counts. What does not end to
rounding, or below tol where that is `enough`, is nobody's result.
"""
from libc.math cimport INFINITY
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy, memset

from lavender_ext.core.block cimport blocks_t
from lavender_ext.core.csr cimport csr_t
from lavender_ext.driver.driver cimport view_t
from lavender_ext.judge.measure cimport judge_into, relative_of
from lavender_ext.judge.score cimport relative, score_t
from lavender_ext.pivot.principal cimport (SMALL, SOLVED, pivoting_t, pivots_correct, pivots_exchange, pivots_factor_all,
                                           pivots_on, pivots_restart, pivots_rounds, pivots_slack, pivots_solve,
                                           pivots_solve_free, pivots_start)


cdef enum:
    SWEEPS = 2                  # that guess the free rows
    ROUNDS = 32
    CORRECTIONS = 100           # refinements
    PASSES = 100                # around the last answer, where A is singular


cdef struct trial_t:
    const view_t* v             # as the judge reads it: A, or bodies
    double e0                   # errors of doing nothing
    double v0
    double tol
    int32_t linear              # every row is free
    int32_t symmetric           # A is
    int32_t enough              # below tol is good, not to rounding alone
    pivoting_t s
    double* x                   # (m) N s, as it was judged last
    double* best                # (m) N s
    double* w                   # (m)
    double* e                   # (m)
    double* scratch             # (12 n_bodies)
    double relative             # of best,
    double floor
    double now                  # and of x
    double now_floor
    int32_t solved              # exchanges came to an end
    int32_t done                # rounds
    int32_t swept
    int32_t refined
    int32_t shifts
    int32_t rank                # of a singular system, all rows free; else 0


cdef inline int64_t pivots_real(const view_t* v, int64_t band) noexcept nogil:
    cdef int64_t m = v.p.n_rows
    return 10 * m + m * (band + 1) + 1 + (12 * <int64_t>v.r.n_bodies if v.r != NULL else 0)


cdef inline int64_t pivots_index(const view_t* v) noexcept nogil:
    return 3 * <int64_t>v.p.n_rows + 1


cdef inline void lay_pivots(trial_t* t, const view_t* v, double* real) noexcept nogil:
    """Places of all but the factor in real (`pivots_real`)."""
    cdef int64_t m = v.p.n_rows
    t.v = v
    t.x, t.best, t.w, t.e = real, real + m, real + 2 * m, real + 3 * m
    t.scratch = real + 4 * m


cdef inline void begin_pivots(trial_t* t, const csr_t* a, const blocks_t* p, int32_t band, int32_t* index) noexcept nogil:
    """As if nothing had been solved: A in compressed rows, with its own d; index (`pivots_index`)."""
    memset(index, 0, pivots_index(t.v) * sizeof(int32_t))
    pivots_on(&t.s, a, p, band, 1e-13, t.scratch + (12 * <int64_t>t.v.r.n_bodies if t.v.r != NULL else 0), index)
    if not t.symmetric:
        t.s.swap = index + 2 * <int64_t>p.n_rows
    t.relative = INFINITY
    t.floor = 0.0
    t.solved = t.done = t.swept = t.refined = t.shifts = t.rank = 0


cdef inline bint is_good(const trial_t* t) noexcept nogil:
    # As `direct`: to rounding, or to the floor where that is not of an impulse that ran away.
    cdef double floor = t.floor if t.floor < 1e-6 else 1e-6
    return t.relative <= (floor if floor > 1e-13 else 1e-13)


cdef inline bint is_end(const trial_t* t) noexcept nogil:
    # Where every row is free, rounding is all that can be left.
    return is_good(t) or (t.linear and t.relative <= 2.0 * (t.floor if t.floor < 1e-6 else 1e-6))


cdef inline void judge_now(trial_t* t) noexcept nogil:
    """x within its bounds, judged; the best is kept."""
    cdef score_t s = score_t(0.0, 0.0, 0.0, 0.0, -1, 1)
    cdef const blocks_t* p = t.s.p
    cdef int32_t i
    cdef double v
    for i in range(t.s.n):
        v = t.s.x[i]
        t.x[i] = p.lower[i] if v < p.lower[i] else (p.upper[i] if v > p.upper[i] else v)
    judge_into(&t.v.p, t.v.a, t.v.r, t.v.r != NULL, t.x, t.w, t.e, t.scratch, True, &s)
    t.now = relative_of(&s, t.w, t.s.n, t.e0, t.v0)
    t.now_floor = relative(s.floor_energy, s.floor_velocity, t.e0, t.v0)
    if t.now < t.relative:
        t.relative, t.floor = t.now, t.now_floor
        memcpy(t.best, t.x, t.s.n * sizeof(double))


cdef inline void recenter(trial_t* t) noexcept nogil:
    memcpy(t.s.center, t.s.x, t.s.n * sizeof(double))


cdef inline bint shifted(trial_t* t, const double* start) noexcept nogil:
    """Passes on A + s D around the best answer, or the start; given up where one does not halve the residual, or is stuck."""
    cdef pivoting_t* s = &t.s
    cdef int32_t before, _
    cdef double previous, reference = INFINITY
    cdef bint whole
    memcpy(s.x, start, s.n * sizeof(double))
    if t.relative < INFINITY and not t.floor > 1e-6:
        memcpy(s.x, t.best, s.n * sizeof(double))
    t.shifts = 1
    for _ in range(PASSES):
        recenter(t)
        if s.shift == 0.0:
            pivots_start(s, 1e-10)
        pivots_restart(s)
        before = s.n_rounds
        if pivots_rounds(s, 1 if t.linear else ROUNDS) != SOLVED:
            return False
        t.done += s.n_rounds - before
        judge_now(t)
        previous = INFINITY
        whole = True                                    # just after a solve
        while True:
            if not t.relative < INFINITY:
                return False                            # not a number
            if is_good(t) or (whole and is_end(t)) or t.refined == CORRECTIONS or not t.now < 0.5 * previous:
                break
            whole = False
            previous = t.now
            recenter(t)
            pivots_slack(s)
            pivots_correct(s)
            t.refined += 1
            judge_now(t)
            if not t.now < previous:
                memcpy(s.x, s.center, s.n * sizeof(double))
        if is_end(t) or not t.relative <= 0.5 * reference:
            break
        reference = t.relative
    return is_end(t) and t.relative <= t.tol


cdef inline bint refined(trial_t* t, const double* start) noexcept nogil:
    """Refinements of the rows found free."""
    cdef double previous = INFINITY
    cdef bint enough = t.enough and not t.linear
    judge_now(t)
    if not is_good(t):
        pivots_slack(&t.s)
        while t.refined < CORRECTIONS and not is_good(t) and t.now < 0.5 * previous:
            previous = t.now
            pivots_correct(&t.s)
            pivots_slack(&t.s)
            t.refined += 1
            if pivots_exchange(&t.s):
                if enough:
                    break
                return False
            judge_now(t)
    if not (enough or is_end(t)):
        return t.linear and t.symmetric and shifted(t, start)
    return t.relative <= t.tol


cdef inline bint pivot(trial_t* t, const double* start) noexcept nogil:
    """Into `best`; did it end below tol?"""
    cdef pivoting_t* s = &t.s
    cdef int32_t code
    if t.linear:
        t.done = 1
        pivots_factor_all(s)
        if s.found.negative or (s.found.small and not t.symmetric):
            return False
        if s.found.small:
            t.done, t.rank = 0, s.n - s.found.small
            return shifted(t, start)
        pivots_solve_free(s)
        return refined(t, start)
    code = pivots_solve(s, start, SWEEPS, ROUNDS, &t.swept)
    t.done = s.n_rounds
    t.solved = code == SOLVED
    if code == SMALL and t.symmetric:
        return shifted(t, start)
    return t.solved and refined(t, start)
