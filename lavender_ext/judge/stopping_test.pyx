"""The checks of judge/stopping_test.pxd, compiled once, and their Python class."""
from libc.math cimport NAN, log10
from libc.stdint cimport int32_t
from libc.string cimport memcpy

import numpy as np

from lavender_ext.core.problem cimport Data
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport view_t
from lavender_ext.judge.bounds cimport project_on_bounds
from lavender_ext.judge.best cimport (count_islands, copy_score_without_islands, relative_residual_of_best, restore_best_islands,
                                      store_better_islands, store_start)
from lavender_ext.judge.measure cimport (residual_above_floor, relative_floor_of_score, judge_view, refine_view,
                                         relative_residual_of_score, count_judge_scratch)
from lavender_ext.judge.progress cimport residual_envelope_slope, record_impulse, has_stalled, N_STORED_CHECKS
from lavender_ext.judge.score cimport make_empty_score, relative_residual, score_t, take_smallest_island_reference
from lavender_ext.judge.stopping_test cimport (AT_FLOOR, CONVERGED, DIVERGED, N_EARLY_SWEEPS, RUNNING, STALLED,
                                               begin_stopping_test, restore_at_end, sweep_t, stopping_test_workspace_size,
                                               stopping_test_t)


cdef inline double relative_residual_of_check(const stopping_test_t* s, const score_t* x) noexcept nogil:
    """Return the relative residual of a pass without a floor; inf if an error is not finite."""
    if x.relative >= 0.0:
        return x.relative
    return relative_residual(x.energy, x.velocity, s.reference_energy, s.reference_velocity) if x.finite else 1.0 / 0.0


cdef inline bint is_explained_by_rounding(const stopping_test_t* s, const score_t* x, double now, double tol) noexcept nogil:
    """Return whether rounding explains the residuals above tol of a pass with a floor, in each island."""
    return residual_above_floor(x, now, relative_floor_of_score(x, s.reference_energy, s.reference_velocity)) <= tol


cdef inline double judge_with_floor(const stopping_test_t* s, const view_t* v, const double* lam, score_t* x) noexcept nogil:
    """Return the judge's relative residual of a pass with a floor."""
    judge_view(v, lam, s.w, s.e, s.v, True, x)
    return relative_residual_of_score(x, s.w, v.p.n_rows, s.reference_energy, s.reference_velocity)


cdef inline double judge_with_refinement(const stopping_test_t* s, const view_t* v, const double* lam, double tol, score_t* x,
                                         bint* refined) noexcept nogil:
    """Return the judge's relative residual of a pass with a floor, refined if M is ill-conditioned."""
    cdef double now = judge_with_floor(s, v, lam, x)
    refined[0] = refine_view(v, lam, s.w, s.e, s.v, s.reference_energy, s.reference_velocity, tol, now, x)
    if refined[0]:
        now = relative_residual_of_score(x, s.w, v.p.n_rows, s.reference_energy, s.reference_velocity)
    return now


cdef inline bint needs_floor(const stopping_test_t* s, const blocks_t* p, const double* lam) noexcept nogil:
    """Return whether rounding may hide the residual of a large impulse: 2^-53 sqrt(sum d lam^2) > 1e-7 E0 of an island."""
    cdef double size = 0.0, energy = s.reference_energy, velocity = s.reference_velocity
    cdef int32_t k
    for k in range(p.n_rows):
        size += p.d[k] * lam[k] * lam[k]
    take_smallest_island_reference(p, &energy, &velocity)
    return size > 8e17 * energy * energy and energy > 0.0


cdef inline int32_t status_after_refinement(const stopping_test_t* s, const score_t* x, double now, double tol) noexcept nogil:
    """Return the status of an impulse with a first pass within tol, from its refined residual."""
    if now <= tol:
        return CONVERGED
    if is_explained_by_rounding(s, x, now, tol):
        return AT_FLOOR
    return STALLED if not relative_floor_of_score(x, s.reference_energy, s.reference_velocity) <= tol else RUNNING


cdef inline int32_t sweeps_until_next_check(const stopping_test_t* s, double now, double tol) noexcept nogil:
    """Return the number of sweeps until the next check."""
    cdef double min_sweeps = s.total >> 3, n = 0.0, gap = s.total - s.last_at, fall, r = now
    cdef double max_sweeps = s.total if s.total < 64 else s.total >> 2
    if min_sweeps < 1.0:
        min_sweeps = 1.0
    if gap >= 1.0 and now < s.last:
        fall = now / s.last
        while r > tol and n < 2.0 * max_sweeps:
            r *= fall
            n += gap
        n = 0.5 * n
    n = n if n < max_sweeps else max_sweeps
    n = n if n > min_sweeps else min_sweeps
    max_sweeps = 2147483647.0 - s.total
    return <int32_t>(n if n < max_sweeps else max_sweeps)


cdef inline int32_t perform_residual_check(stopping_test_t* s, const view_t* v, double* lam, double tol) noexcept nogil:
    """Perform one check and schedule the next; return the status."""
    cdef score_t x = make_empty_score()
    cdef const blocks_t* p = &v.p
    cdef double now, last, inf = 1.0 / 0.0
    cdef bint refined = False, better = False, lost
    cdef int32_t end, i
    x.by_island = s.best.now
    if s.total == 0:
        project_on_bounds(p, lam)
    judge_view(v, lam, s.w, s.e, s.v, False, &x)
    now = relative_residual_of_check(s, &x)
    if s.total == 0:                                    # Begin from the better of the start and the zero impulse.
        copy_score_without_islands(&s.best, p, &x, now)
        if store_start(&s.best, v, s.w, s.relative_at_zero, tol, lam):
            x = make_empty_score()
            x.by_island = s.best.now
            judge_view(v, lam, s.w, s.e, s.v, False, &x)
            now = relative_residual_of_check(s, &x)
    if now <= tol:                                      # Repeat the pass with a floor.
        now = judge_with_refinement(s, v, lam, tol, &x, &refined)
    elif needs_floor(s, p, lam):
        now = judge_with_floor(s, v, lam, &x)
    copy_score_without_islands(&s.best, p, &x, now)
    lost = not now < inf and (s.reference_energy > 0.0 or not x.finite)
    if s.total <= N_EARLY_SWEEPS and s.start < now < inf:
        s.start = now
    s.progress.at[s.progress.n % N_STORED_CHECKS] = s.total
    s.progress.r[s.progress.n % N_STORED_CHECKS] = now
    s.progress.n += 1
    s.check_at = s.total + sweeps_until_next_check(s, now, tol)
    s.last = now
    s.last_at = s.total
    if now <= tol:
        return CONVERGED
    if refined:
        end = status_after_refinement(s, &x, now, tol)
        if end != RUNNING:
            return end
    if s.total > 0 and (not lost or s.best.seen > 0):
        store_better_islands(&s.best, v, lam, s.w, tol)
    s.best_relative = relative_residual_of_best(&s.best)
    if s.best_relative <= tol:                          # The islands were solved at different checks.
        x = make_empty_score()
        last = judge_with_refinement(s, v, s.best.impulse, tol, &x, &refined)
        end = CONVERGED if last <= tol else status_after_refinement(s, &x, last, tol) if refined else RUNNING
        if end != RUNNING:
            memcpy(lam, s.best.impulse, p.n_rows * sizeof(double))
            return end
    if not lost:                                        # Is the check better (see the header of stopping_test.pxd)?
        better = now < s.lowest
        s.lowest = now if better else s.lowest
        for i in range(s.best.n):
            if s.best_at < 0 or s.best.energy[i] < 0.99 * s.marked[i]:
                better = better or s.best_at < 0 or not s.best.relative[i] <= tol
                s.marked[i] = s.best.energy[i]
    if better:
        s.best_at = s.total
        record_impulse(&s.progress, s.total, lam, p.n_rows)
        return RUNNING
    if lost or 1e6 * (s.start if s.start > 1.0 else 1.0) < now < inf:
        s.has_failed = True
        restore_best_islands(&s.best, v, s.w, lam, tol, False, True)
        return DIVERGED
    if s.best_at >= 0 and s.best_relative <= 1e-6:
        x = make_empty_score()
        last = judge_with_refinement(s, v, s.best.impulse, tol, &x, &refined)
        if is_explained_by_rounding(s, &x, last if refined else s.best_relative, tol):
            memcpy(lam, s.best.impulse, p.n_rows * sizeof(double))
            return AT_FLOOR
    if s.total > 32 * <double>s.best_at + s.patience and has_stalled(&s.progress, p, lam, s.total, s.lowest):
        s.has_failed = True
        restore_at_end(s, v, lam, tol)
        return STALLED
    record_impulse(&s.progress, s.total, lam, p.n_rows)
    return RUNNING


cdef inline int32_t confirm_status_in_other_form(const stopping_test_t* s, const view_t* v, const double* lam, double tol,
                                                 int32_t status) noexcept nogil:
    """Judge lam in another form of the problem; return `status` if it holds there, otherwise RUNNING or STALLED."""
    cdef score_t x = make_empty_score()
    cdef double now
    cdef bint within
    judge_view(v, lam, s.w, s.e, s.v, status == AT_FLOOR, &x)
    now = relative_residual_of_check(s, &x)
    if refine_view(v, lam, s.w, s.e, s.v, s.reference_energy, s.reference_velocity, tol, now, &x):
        within = now <= tol
        now = relative_residual_of_score(&x, s.w, v.p.n_rows, s.reference_energy, s.reference_velocity)
        if within:
            return status_after_refinement(s, &x, now, tol)
    if now <= tol:
        return CONVERGED
    if status == CONVERGED:
        return RUNNING
    return AT_FLOOR if is_explained_by_rounding(s, &x, now, tol) else STALLED


cdef inline int32_t check_if_due(stopping_test_t* s, const view_t* v, const view_t* confirm, double* lam, double tol,
                                 int32_t* step) noexcept nogil:
    """Perform a check if one is due, and reduce `step` to the sweeps until the next; with tol = 0 there are no checks.

    confirm is NULL, or the same problem in another form in which the status must also hold.
    """
    cdef int32_t status = RUNNING
    if not tol > 0.0:
        return RUNNING
    if s.total >= s.check_at:                           # `total` may exceed `check_at` after sweeps without checks.
        status = perform_residual_check(s, v, lam, tol)
        if confirm != NULL and (status == CONVERGED or status == AT_FLOOR):
            status = confirm_status_in_other_form(s, confirm, lam, tol, status)
    if s.check_at - s.total < step[0]:
        step[0] = s.check_at - s.total
    return status


cdef int32_t check_start(stopping_test_t* s, const view_t* v, const view_t* confirm, double* lam, double tol) noexcept nogil:
    """Perform the check before the first sweep, which may change lam (m); return the status."""
    cdef int32_t step = 1
    return check_if_due(s, v, confirm, lam, tol, &step)


cdef int32_t run_until_stop(stopping_test_t* s, const view_t* v, const view_t* confirm, sweep_t sweep, void* context,
                            double* lam, int32_t n, double tol, int32_t* done) noexcept nogil:
    """Run n sweeps, or fewer if a check stops them; write their number to `done` and return the status."""
    cdef int32_t step, status
    done[0] = 0
    while done[0] < n:
        step = n - done[0]
        status = check_if_due(s, v, confirm, lam, tol, &step)
        if status != RUNNING:
            return status
        sweep(context, lam, s.total == 0, step)
        done[0] += step
        s.total += step
    return RUNNING


cdef class StoppingTest:
    """State of the stopping test of a run of sweeps.

    Parameters
    ----------
    data : Data
        Problem to judge, with known references.
    patience : int
        Minimum number of sweeps without a better check before a run stalls.
    confirm : Data, optional
        The same problem in another form, in which a status must also hold.
    keeps_last : bool
        Whether the last iterate is returned in unsolved islands under Coulomb's law or with an asymmetric A.
    """

    def __init__(self, Data data, int patience=64, Data confirm=None, bint keeps_last=False):
        cdef Py_ssize_t m = data.blocks.n_rows, workspace
        cdef double[::1] scratch
        self.view = self.other = data.get_pointers()
        if confirm is not None:
            self.other = confirm.get_pointers()
            self.confirm = &self.other
        workspace = stopping_test_workspace_size(m, count_islands(&self.view.p))
        scratch = np.empty(workspace + 2 * m + max(count_judge_scratch(&self.view), count_judge_scratch(&self.other)) + 4)
        self.keep = data, confirm, scratch
        begin_stopping_test(&self.state, &self.view.p, data.reference_energy, data.reference_velocity, data.relative_at_zero,
                            patience, &scratch[0])
        self.state.keeps_last = keeps_last
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

    @property
    def has_best(self):
        """Whether an impulse was checked, so that `keep_best` returns the best one."""
        return self.state.best.seen > 0

    def keep_best(self, double[::1] lam, double tol):
        """Replace lam (m,), unless its residual is at most tol, by the best impulse of each island, including lam."""
        cdef stopping_test_t* s = &self.state
        cdef score_t x = make_empty_score()
        cdef double now
        if s.best.seen == 0 or lam.shape[0] == 0:
            return
        x.by_island = s.best.now
        with nogil:
            judge_view(&self.view, &lam[0], s.w, s.e, s.v, False, &x)
            now = relative_residual_of_check(s, &x)
            if needs_floor(s, &self.view.p, &lam[0]):
                now = judge_with_floor(s, &self.view, &lam[0], &x)
            copy_score_without_islands(&s.best, &self.view.p, &x, now)
            if not now <= tol:
                store_better_islands(&s.best, &self.view, &lam[0], s.w, tol)
                s.best_relative = relative_residual_of_best(&s.best)
                restore_at_end(s, &self.view, &lam[0], tol)

    @property
    def sweeps_per_decade(self):
        """Sweeps per tenfold decrease of the residual, from its lower envelope at the last check; NaN if it does not fall."""
        cdef double fall = 0.0, low = 0.0
        cdef int32_t k = residual_envelope_slope(&self.state.progress, &fall, &low)
        return -k / log10(fall) if k > 0 and 0.0 < fall < 1.0 else NAN

    def run_python(self, sweep, double[::1] lam, int n, double tol):
        """Run `run_until_stop` with a Python callable sweep(count, first); return (status, sweeps done)."""
        cdef int32_t done = 0, step, status
        if lam.shape[0] == 0:
            if tol > 0.0:
                return CONVERGED, 0
            return RUNNING, n
        while done < n:
            step = n - done
            with nogil:
                status = check_if_due(&self.state, &self.view, self.confirm, &lam[0], tol, &step)
            if status != RUNNING:
                return status, done
            sweep(step, self.state.total == 0)
            done += step
            self.state.total += step
        return RUNNING, done
