"""The stopping test of a sweep solver: the judge's own arithmetic at sweep counts that depend on the numbers alone.

A check falls at the start and after the first sweep. From the residuals r0, r of the last two, k sweeps apart, the
end is expected after n more, r (r/r0)^(n/k) <= tol, and the next check is half way there: no nearer than an eighth
of the sweeps done so far, no further than as many again. A residual that does not fall is looked at again after
that eighth. The relative residual r decides:

    r <= tol                                        CONVERGED
    r not finite, or > 1e6 max(1, r of the first 8) DIVERGED
    first pass <= tol < refined one (judge/refine.pxd)
        refined <= 2 floor and <= 1e-5              AT_FLOOR
        else floor > tol                            STALLED
    no better than the best so far, and
        best <= 1e-6 and best <= 2 floor            AT_FLOOR
        sweeps > 32 * sweeps of the best + patience, and nothing
        better in sight (judge/progress.pxd)        STALLED

On the last three the best iterate is put back. A check costs about one sweep.
"""
from libc.stdint cimport int32_t
from libc.string cimport memcpy

from lavender_ext.core.parts cimport blocks_t
from lavender_ext.core.view cimport view_t
from lavender_ext.judge.measure cimport judge_view, relative_of
from lavender_ext.judge.progress cimport keep, open_progress, progress_t, rests, see
from lavender_ext.judge.refine cimport refine_view
from lavender_ext.judge.score cimport is_at_floor, relative, score_t


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
    int32_t best_at             # sweeps at the best check, -1 before any
    int32_t patience            # sweeps that may always pass without a better check
    int32_t again_at            # best_at of the iterate that was begun anew from, 0 before any
    double start                # largest relative residual of the first EARLY sweeps
    double last                 # at the last one
    double best_relative        # of the best check
    double start_energy         # sqrt J, of doing nothing
    double start_velocity       # m/s
    double* best                # (m) N s
    double* w                   # (m) scratch
    double* e                   # (m) scratch
    double* v                   # `scratch_of`
    progress_t progress


ctypedef void (*sweep_t)(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil


cdef inline void begin_watch(watch_t* s, double start_energy, double start_velocity, int32_t patience, double* room,
                       int32_t m) noexcept nogil:
    """Before the first sweep; room (3 m) is for iterates."""
    s.total = s.check_at = s.last_at = 0
    s.start = 0.0
    s.last = s.best_relative = 1.0 / 0.0
    s.best_at = -1
    s.again_at = 0
    s.patience = patience
    s.start_energy = start_energy
    s.start_velocity = start_velocity
    s.best = room
    open_progress(&s.progress, room + m, m)


cdef inline double against_start(const watch_t* s, double energy, double velocity) noexcept nogil:
    return relative(energy, velocity, s.start_energy, s.start_velocity)


cdef inline double judge_closely(const watch_t* s, const view_t* v, const double* lam, double tol, double* floor,
                                 bint* refined) noexcept nogil:
    """The judge's relative residual and its floor, refined if an ill-conditioned M needs it."""
    cdef score_t x
    cdef double found
    judge_view(v, lam, s.w, s.e, s.v, True, &x)
    found = relative_of(&x, s.w, v.p.n_rows, s.start_energy, s.start_velocity)
    refined[0] = refine_view(v, lam, s.w, s.e, s.v, s.start_energy, s.start_velocity, tol, found, &x)
    if refined[0]:
        found = relative_of(&x, s.w, v.p.n_rows, s.start_energy, s.start_velocity)
    floor[0] = against_start(s, x.floor_energy, x.floor_velocity)
    return found


cdef inline int32_t end_refined(double found, double floor, double tol) noexcept nogil:
    """The claim of an impulse whose first pass is within tol, by its refined residual: more sweeps reduce that to its floor."""
    if found <= tol:
        return CONVERGED
    if is_at_floor(found, floor):
        return AT_FLOOR
    return STALLED if not floor <= tol else RUNNING


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


cdef inline int32_t check(watch_t* s, const view_t* v, double* lam, double tol) noexcept nogil:
    """One check; sets the sweeps of the next."""
    cdef score_t x
    cdef const blocks_t* p = &v.p
    cdef double now, floor, inf = 1.0 / 0.0
    cdef bint refined = False
    cdef int32_t end
    judge_view(v, lam, s.w, s.e, s.v, False, &x)
    now = against_start(s, x.energy, x.velocity) if x.finite else inf
    if now <= tol:                                      # once more, beside what rounding hides
        now = judge_closely(s, v, lam, tol, &floor, &refined)
    if s.total <= EARLY and s.start < now < inf:
        s.start = now
    see(&s.progress, s.total, now)
    s.check_at = s.total + until_next(s, now, tol)
    s.last = now
    s.last_at = s.total
    if now <= tol:
        return CONVERGED
    if refined:
        end = end_refined(now, floor, tol)
        if end != RUNNING:
            return end
    if now < s.best_relative:
        s.best_relative = now
        s.best_at = s.total
        memcpy(s.best, lam, p.n_rows * sizeof(double))
        keep(&s.progress, s.total, lam, p.n_rows)
        return RUNNING
    if not now < inf or now > 1e6 * (s.start if s.start > 1.0 else 1.0):
        if s.best_at >= 0:
            memcpy(lam, s.best, p.n_rows * sizeof(double))
        return DIVERGED
    if s.best_at >= 0 and s.best_relative <= 1e-6:
        now = judge_closely(s, v, s.best, tol, &floor, &refined)
        if is_at_floor(now if refined else s.best_relative, floor):
            memcpy(lam, s.best, p.n_rows * sizeof(double))
            return AT_FLOOR
    if s.total > 32 * <double>s.best_at + s.patience and rests(&s.progress, p, lam, s.total, s.best_relative):
        memcpy(lam, s.best, p.n_rows * sizeof(double))
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
    cdef score_t x
    cdef double now, floor
    cdef bint within
    judge_view(v, lam, s.w, s.e, s.v, status == AT_FLOOR, &x)
    now = against_start(s, x.energy, x.velocity) if x.finite else 1.0 / 0.0
    if refine_view(v, lam, s.w, s.e, s.v, s.start_energy, s.start_velocity, tol, now, &x):
        within = now <= tol
        now = relative_of(&x, s.w, v.p.n_rows, s.start_energy, s.start_velocity)
        if within:
            return end_refined(now, against_start(s, x.floor_energy, x.floor_velocity), tol)
    if now <= tol:
        return CONVERGED
    if status == CONVERGED:
        return RUNNING
    floor = against_start(s, x.floor_energy, x.floor_velocity)
    return AT_FLOOR if is_at_floor(now, floor) else STALLED


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
