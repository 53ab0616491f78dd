"""The stopping test of a sweep solver: the judge's own arithmetic at sweep counts that depend on the numbers alone.

A check falls at the start and after the first sweep. From the residuals r0, r of the last two, k sweeps apart, the
end is expected after n more, r (r/r0)^(n/k) <= tol, and the next check is half way there: no nearer than an eighth
of the sweeps done so far, no further than as many again. A residual that does not fall is looked at again after
that eighth. The relative residual r decides:

    r <= tol                                        CONVERGED
    r of the best of each island (best.pxd) <= tol  CONVERGED, with these
    r not finite, or > 1e6 max(1, r of the first 8) DIVERGED; where E0 = 0 (r = 0 or inf), E not finite
    first pass <= tol < refined one (judge/refine.pxd)
        refined <= 2 floor and <= 1e-5              AT_FLOOR
        else floor > tol                            STALLED
    no better than the best so far, and
        best <= 1e-6 and best <= 2 floor            AT_FLOOR
        sweeps > 32 * sweeps of the best + patience, and nothing
        better in sight (judge/progress.pxd)        STALLED

"Better": r is lower than ever, or E of an island that is not solved fell by 1 % since the last better check. Except at
CONVERGED by r, the best impulse of each island is put back. A check costs about one sweep.
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy

from lavender_ext.core.parts cimport blocks_t
from lavender_ext.core.view cimport view_t
from lavender_ext.judge.best cimport best_room, best_t, bind_best, note_score, relative_of_best, see_impulse
from lavender_ext.judge.measure cimport above_floor_of, floor_of, judge_view, relative_of
from lavender_ext.judge.progress cimport keep, open_progress, progress_t, rests, see
from lavender_ext.judge.refine cimport refine_view
from lavender_ext.judge.score cimport new_score, relative, score_t, smallest_reference


cpdef enum:
    RUNNING = 0
    CONVERGED = 1
    DIVERGED = 2
    STALLED = 3
    AT_FLOOR = 4


cdef enum:
    EARLY = 8                   # sweeps, whose residuals rise where doing nothing is nearly right


cdef struct watch_t:
    int32_t total               # sweeps done
    int32_t check_at            # sweeps at the next check
    int32_t last_at             # sweeps at the last check
    int32_t best_at             # sweeps at the last better check, -1 before any
    int32_t patience            # sweeps that may always pass without a better check
    int32_t again_at            # best_at of the iterate that was begun anew from, 0 before any
    double start                # largest relative residual of the first EARLY sweeps
    double last                 # at the last one
    double best_relative        # of `best`
    double lowest               # r of all checks
    double start_energy         # sqrt J, of doing nothing
    double start_velocity       # m/s
    best_t best
    double* marked              # (n) sqrt J, E of each island's best at the last better check
    double* w                   # (m) scratch
    double* e                   # (m) scratch
    double* v                   # `scratch_of`
    progress_t progress


ctypedef void (*sweep_t)(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil


cdef inline int64_t watch_room(int64_t m, int64_t n) noexcept nogil:
    """Number of doubles that `begin_watch` needs for m rows in n islands."""
    return best_room(m, n) + n + 2 * m


cdef inline void begin_watch(watch_t* s, const blocks_t* p, double start_energy, double start_velocity, int32_t patience,
                             double* room) noexcept nogil:
    """Before the first sweep; room (`watch_room`)."""
    s.total = s.check_at = s.last_at = 0
    s.start = 0.0
    s.last = s.best_relative = s.lowest = 1.0 / 0.0
    s.best_at = -1
    s.again_at = 0
    s.patience = patience
    s.start_energy = start_energy
    s.start_velocity = start_velocity
    bind_best(&s.best, p, room)
    s.marked = room + best_room(p.n_rows, s.best.n)
    open_progress(&s.progress, s.marked + s.best.n, p.n_rows)


cdef inline double relative_to_start(const watch_t* s, const score_t* x) noexcept nogil:
    """Relative residual of a pass without floor; inf if an error is not finite."""
    if x.relative >= 0.0:
        return x.relative
    return relative(x.energy, x.velocity, s.start_energy, s.start_velocity) if x.finite else 1.0 / 0.0


cdef inline bint is_rounding(const watch_t* s, const score_t* x, double now, double tol) noexcept nogil:
    """Whether rounding explains what a pass with its floor found above tol, in each island."""
    return above_floor_of(x, now, floor_of(x, s.start_energy, s.start_velocity)) <= tol


cdef inline double judge_with_floor(const watch_t* s, const view_t* v, const double* lam, score_t* x) noexcept nogil:
    """The judge's relative residual with its floor."""
    judge_view(v, lam, s.w, s.e, s.v, True, x)
    return relative_of(x, s.w, v.p.n_rows, s.start_energy, s.start_velocity)


cdef inline double judge_closely(const watch_t* s, const view_t* v, const double* lam, double tol, score_t* x,
                                 bint* refined) noexcept nogil:
    """The judge's relative residual with its floor, refined if an ill-conditioned M needs it."""
    cdef double now = judge_with_floor(s, v, lam, x)
    refined[0] = refine_view(v, lam, s.w, s.e, s.v, s.start_energy, s.start_velocity, tol, now, x)
    if refined[0]:
        now = relative_of(x, s.w, v.p.n_rows, s.start_energy, s.start_velocity)
    return now


cdef inline bint rounds_much(const watch_t* s, const blocks_t* p, const double* lam) noexcept nogil:
    """Whether rounding of so large an impulse may hide the residual: 2^-53 sqrt(sum d lam^2) > 1e-7 E0 of some island."""
    cdef double size = 0.0, energy = s.start_energy, velocity = s.start_velocity
    cdef int32_t k
    for k in range(p.n_rows):
        size += p.d[k] * lam[k] * lam[k]
    smallest_reference(p, &energy, &velocity)
    return size > 8e17 * energy * energy and energy > 0.0


cdef inline int32_t end_refined(const watch_t* s, const score_t* x, double now, double tol) noexcept nogil:
    """The claim of an impulse whose first pass is within tol, by its refined residual: more sweeps reduce that to its floor."""
    if now <= tol:
        return CONVERGED
    if is_rounding(s, x, now, tol):
        return AT_FLOOR
    return STALLED if not floor_of(x, s.start_energy, s.start_velocity) <= tol else RUNNING


cdef inline int32_t until_next(const watch_t* s, double now, double tol) noexcept nogil:
    """Sweeps until the next check."""
    cdef double least = s.total >> 3, most = s.total, n = 0.0, gap = s.total - s.last_at, fall, r = now
    if least < 1.0:
        least = 1.0
    if gap >= 1.0 and now < s.last:
        fall = now / s.last
        while r > tol and n < 2.0 * most:
            r *= fall
            n += gap
        n = 0.5 * n
    n = n if n < most else most
    n = n if n > least else least
    most = 2147483647.0 - s.total
    return <int32_t>(n if n < most else most)


cdef inline bint is_progress(watch_t* s, double now, double tol) noexcept nogil:
    """Whether a check is better, after `see_impulse`."""
    cdef bint better = now < s.lowest
    cdef int32_t i
    if better:
        s.lowest = now
    for i in range(s.best.n):
        if s.best_at < 0 or s.best.energy[i] < 0.99 * s.marked[i]:
            better = better or s.best_at < 0 or not s.best.relative[i] <= tol
            s.marked[i] = s.best.energy[i]
    return better


cdef inline int32_t check(watch_t* s, const view_t* v, double* lam, double tol) noexcept nogil:
    """One check; sets the sweeps of the next."""
    cdef score_t x = new_score()
    cdef const blocks_t* p = &v.p
    cdef double now, last, inf = 1.0 / 0.0
    cdef bint refined = False, lost
    cdef int32_t end
    x.by_island = s.best.now
    judge_view(v, lam, s.w, s.e, s.v, False, &x)
    now = relative_to_start(s, &x)
    if now <= tol:                                      # once more, with what rounding hides
        now = judge_closely(s, v, lam, tol, &x, &refined)
    elif rounds_much(s, p, lam):
        now = judge_with_floor(s, v, lam, &x)
    note_score(&s.best, p, &x, now)
    lost = not now < inf and (s.start_energy > 0.0 or not x.finite)
    if s.total <= EARLY and s.start < now < inf:
        s.start = now
    see(&s.progress, s.total, now)
    s.check_at = s.total + until_next(s, now, tol)
    s.last = now
    s.last_at = s.total
    if now <= tol:
        return CONVERGED
    if refined:
        end = end_refined(s, &x, now, tol)
        if end != RUNNING:
            return end
    if not lost or s.best.seen > 0:
        see_impulse(&s.best, p, lam, tol)
        s.best_relative = relative_of_best(&s.best)
    if s.best_relative <= tol:                          # each island at another check
        x = new_score()
        last = judge_closely(s, v, s.best.impulse, tol, &x, &refined)
        end = CONVERGED if last <= tol else end_refined(s, &x, last, tol) if refined else RUNNING
        if end != RUNNING:
            memcpy(lam, s.best.impulse, p.n_rows * sizeof(double))
            return end
    if not lost and is_progress(s, now, tol):
        s.best_at = s.total
        keep(&s.progress, s.total, lam, p.n_rows)
        return RUNNING
    if lost or 1e6 * (s.start if s.start > 1.0 else 1.0) < now < inf:
        if s.best_at >= 0:
            memcpy(lam, s.best.impulse, p.n_rows * sizeof(double))
        return DIVERGED
    if s.best_at >= 0 and s.best_relative <= 1e-6:
        x = new_score()
        last = judge_closely(s, v, s.best.impulse, tol, &x, &refined)
        if is_rounding(s, &x, last if refined else s.best_relative, tol):
            memcpy(lam, s.best.impulse, p.n_rows * sizeof(double))
            return AT_FLOOR
    if s.total > 32 * <double>s.best_at + s.patience and rests(&s.progress, p, lam, s.total, s.lowest):
        memcpy(lam, s.best.impulse, p.n_rows * sizeof(double))
        return STALLED
    keep(&s.progress, s.total, lam, p.n_rows)
    return RUNNING


cdef inline bint begins_again(watch_t* s, int32_t patience) noexcept nogil:
    """Whether a run that STALLED, its best put back, may go on from there with nothing remembered: once for each best.

    For maps with a memory, which may have lost the way; `patience` sweeps are theirs to find a better one.
    """
    if s.best_at <= s.again_at:
        return False
    s.again_at = s.best_at
    s.patience = s.total - 32 * s.best_at + patience
    return True


cdef inline int32_t confirmed(const watch_t* s, const view_t* v, const double* lam, double tol, int32_t status) noexcept nogil:
    """The claim `status`, judged in another form: what does not hold there goes on, or has stalled."""
    cdef score_t x = new_score()
    cdef double now
    cdef bint within
    judge_view(v, lam, s.w, s.e, s.v, status == AT_FLOOR, &x)
    now = relative_to_start(s, &x)
    if refine_view(v, lam, s.w, s.e, s.v, s.start_energy, s.start_velocity, tol, now, &x):
        within = now <= tol
        now = relative_of(&x, s.w, v.p.n_rows, s.start_energy, s.start_velocity)
        if within:
            return end_refined(s, &x, now, tol)
    if now <= tol:
        return CONVERGED
    if status == CONVERGED:
        return RUNNING
    return AT_FLOOR if is_rounding(s, &x, now, tol) else STALLED


cdef inline int32_t due(watch_t* s, const view_t* v, const view_t* confirm, double* lam, double tol, int32_t* step) noexcept nogil:
    """A check, where one is due; the sweeps until the next into step, where these are fewer. tol = 0 checks nothing.

    confirm: the same problem in another form, which a claim must hold in too, or NULL.
    """
    cdef int32_t status = RUNNING
    if not tol > 0.0:
        return RUNNING
    if s.total >= s.check_at:                           # later, after sweeps that were not checked
        status = check(s, v, lam, tol)
        if confirm != NULL and (status == CONVERGED or status == AT_FLOOR):
            status = confirmed(s, confirm, lam, tol, status)
    if s.check_at - s.total < step[0]:
        step[0] = s.check_at - s.total
    return status


cdef inline int32_t watched(watch_t* s, const view_t* v, const view_t* confirm, sweep_t sweep, void* context, double* lam,
                            int32_t n, double tol, int32_t* done) noexcept nogil:
    """n sweeps, fewer where a check ends them; counts them in `done`."""
    cdef int32_t step, status
    done[0] = 0
    while done[0] < n:
        step = n - done[0]
        status = due(s, v, confirm, lam, tol, &step)
        if status != RUNNING:
            return status
        sweep(context, lam, s.total == 0, step)
        done[0] += step
        s.total += step
    return RUNNING


cdef class Watch:
    cdef object keep
    cdef view_t view
    cdef view_t other
    cdef const view_t* confirm  # the other, or NULL
    cdef watch_t state
