"""The checks of judge/stopping_test.pxd, compiled once, and the same for Python: where a run of sweeps stands."""
from libc.math cimport NAN, log10
from libc.stdint cimport int32_t
from libc.string cimport memcpy

import numpy as np

from lavender_ext.core.problem cimport Data
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport view_t
from lavender_ext.judge.best cimport count_islands, note_score, relative_of_best, see_impulse
from lavender_ext.judge.measure cimport above_floor_of, floor_of, judge_view, refine_view, relative_of, scratch_of
from lavender_ext.judge.progress cimport envelope, keep, rests, see
from lavender_ext.judge.score cimport new_score, relative, score_t, smallest_reference
from lavender_ext.judge.stopping_test cimport (AT_FLOOR, CONVERGED, DIVERGED, EARLY, RUNNING, STALLED, begin_stopping_test, sweep_t,
                                       stopping_test_workspace_size,
                                       stopping_test_t)


cdef inline double relative_to_start(const stopping_test_t* s, const score_t* x) noexcept nogil:
    """Relative residual of a pass without floor; inf if an error is not finite."""
    if x.relative >= 0.0:
        return x.relative
    return relative(x.energy, x.velocity, s.reference_energy, s.reference_velocity) if x.finite else 1.0 / 0.0


cdef inline bint is_rounding(const stopping_test_t* s, const score_t* x, double now, double tol) noexcept nogil:
    """Whether rounding explains what a pass with its floor found above tol, in each island."""
    return above_floor_of(x, now, floor_of(x, s.reference_energy, s.reference_velocity)) <= tol


cdef inline double judge_with_floor(const stopping_test_t* s, const view_t* v, const double* lam, score_t* x) noexcept nogil:
    """The judge's relative residual with its floor."""
    judge_view(v, lam, s.w, s.e, s.v, True, x)
    return relative_of(x, s.w, v.p.n_rows, s.reference_energy, s.reference_velocity)


cdef inline double judge_closely(const stopping_test_t* s, const view_t* v, const double* lam, double tol, score_t* x,
                                 bint* refined) noexcept nogil:
    """The judge's relative residual with its floor, refined if an ill-conditioned M needs it."""
    cdef double now = judge_with_floor(s, v, lam, x)
    refined[0] = refine_view(v, lam, s.w, s.e, s.v, s.reference_energy, s.reference_velocity, tol, now, x)
    if refined[0]:
        now = relative_of(x, s.w, v.p.n_rows, s.reference_energy, s.reference_velocity)
    return now


cdef inline bint rounds_much(const stopping_test_t* s, const blocks_t* p, const double* lam) noexcept nogil:
    """Whether rounding of so large an impulse may hide the residual: 2^-53 sqrt(sum d lam^2) > 1e-7 E0 of some island."""
    cdef double size = 0.0, energy = s.reference_energy, velocity = s.reference_velocity
    cdef int32_t k
    for k in range(p.n_rows):
        size += p.d[k] * lam[k] * lam[k]
    smallest_reference(p, &energy, &velocity)
    return size > 8e17 * energy * energy and energy > 0.0


cdef inline int32_t end_refined(const stopping_test_t* s, const score_t* x, double now, double tol) noexcept nogil:
    """The claim of an impulse whose first pass is within tol, by its refined residual: more sweeps reduce that to its floor."""
    if now <= tol:
        return CONVERGED
    if is_rounding(s, x, now, tol):
        return AT_FLOOR
    return STALLED if not floor_of(x, s.reference_energy, s.reference_velocity) <= tol else RUNNING


cdef inline int32_t until_next(const stopping_test_t* s, double now, double tol) noexcept nogil:
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


cdef inline bint is_progress(stopping_test_t* s, double now, double tol) noexcept nogil:
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


cdef inline int32_t check(stopping_test_t* s, const view_t* v, double* lam, double tol) noexcept nogil:
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
    lost = not now < inf and (s.reference_energy > 0.0 or not x.finite)
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


cdef inline int32_t confirmed(const stopping_test_t* s, const view_t* v, const double* lam, double tol,
                              int32_t status) noexcept nogil:
    """The claim `status`, judged in another form: what does not hold there goes on, or has stalled."""
    cdef score_t x = new_score()
    cdef double now
    cdef bint within
    judge_view(v, lam, s.w, s.e, s.v, status == AT_FLOOR, &x)
    now = relative_to_start(s, &x)
    if refine_view(v, lam, s.w, s.e, s.v, s.reference_energy, s.reference_velocity, tol, now, &x):
        within = now <= tol
        now = relative_of(&x, s.w, v.p.n_rows, s.reference_energy, s.reference_velocity)
        if within:
            return end_refined(s, &x, now, tol)
    if now <= tol:
        return CONVERGED
    if status == CONVERGED:
        return RUNNING
    return AT_FLOOR if is_rounding(s, &x, now, tol) else STALLED


cdef inline int32_t due(stopping_test_t* s, const view_t* v, const view_t* confirm, double* lam, double tol,
                        int32_t* step) noexcept nogil:
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


cdef int32_t run_until_stop(stopping_test_t* s, const view_t* v, const view_t* confirm, sweep_t sweep, void* context, double* lam,
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


cdef class StoppingTest:
    """Where a run of sweeps stands; `data` is what the judge reads, its start error known.

    `confirm`: the same problem in another form, which a claim must hold in too.
    """

    def __init__(self, Data data, int patience=64, Data confirm=None):
        cdef Py_ssize_t m = data.blocks.n_rows, workspace
        cdef double[::1] scratch
        self.view = self.other = data.view()
        if confirm is not None:
            self.other = confirm.view()
            self.confirm = &self.other
        workspace = stopping_test_workspace_size(m, count_islands(&self.view.p))
        scratch = np.empty(workspace + 2 * m + scratch_of(&self.other) + 4)
        self.keep = data, confirm, scratch
        begin_stopping_test(&self.state, &self.view.p, data.reference_energy, data.reference_velocity, patience, &scratch[0])
        self.state.w = &scratch[workspace]
        self.state.e = &scratch[workspace + m]
        self.state.v = &scratch[workspace + 2 * m]

    @property
    def total(self):
        """Sweeps done."""
        return self.state.total

    @property
    def best(self):
        """(relative residual, impulse) of the best of each island; (inf, None) before any check."""
        if self.state.best_at < 0:
            return self.state.best_relative, None
        return self.state.best_relative, np.array(self.keep[2])[:self.view.p.n_rows]

    def keep_best(self, double[::1] lam, double tol):
        """Replace lam (m,), unless it meets tol, by the best of each island of it and of all checks."""
        cdef stopping_test_t* s = &self.state
        cdef score_t x = new_score()
        cdef double now
        if s.best.seen == 0 or lam.shape[0] == 0:
            return
        x.by_island = s.best.now
        with nogil:
            judge_view(&self.view, &lam[0], s.w, s.e, s.v, False, &x)
            now = relative_to_start(s, &x)
            if rounds_much(s, &self.view.p, &lam[0]):
                now = judge_with_floor(s, &self.view, &lam[0], &x)
            note_score(&s.best, &self.view.p, &x, now)
            if not now <= tol:
                see_impulse(&s.best, &self.view.p, &lam[0], tol)
                s.best_relative = relative_of_best(&s.best)
                memcpy(&lam[0], s.best.impulse, lam.shape[0] * sizeof(double))

    @property
    def sweeps_per_decade(self):
        """Sweeps in which the residual falls tenfold, by its lower envelope at the last check; NaN where it does not."""
        cdef double fall = 0.0, low = 0.0
        cdef int32_t k = envelope(&self.state.progress, &fall, &low)
        return -k / log10(fall) if k > 0 and 0.0 < fall < 1.0 else NAN

    def run_python(self, sweep, double[::1] lam, int n, double tol):
        """`watched` with a Python callable sweep(count, first); returns (status, sweeps done)."""
        cdef int32_t done = 0, step, status
        if lam.shape[0] == 0:
            if tol > 0.0:
                return CONVERGED, 0
            return RUNNING, n
        while done < n:
            step = n - done
            with nogil:
                status = due(&self.state, &self.view, self.confirm, &lam[0], tol, &step)
            if status != RUNNING:
                return status, done
            sweep(step, self.state.total == 0)
            done += step
            self.state.total += step
        return RUNNING, done
