"""The watch of judge/watch.pxd for Python: where a run of sweeps stands, and the loop of sweeps and checks."""
from libc.math cimport NAN, log10
from libc.stdint cimport int32_t
from libc.string cimport memcpy

import numpy as np

from lavender_ext.core.problem cimport Data
from lavender_ext.judge.measure cimport scratch_of
from lavender_ext.judge.progress cimport envelope
from lavender_ext.judge.best cimport count_islands, note_score, relative_of_best, see_impulse
from lavender_ext.judge.measure cimport judge_view
from lavender_ext.judge.score cimport new_score, score_t
from lavender_ext.judge.watch cimport (CONVERGED, RUNNING, begin_watch, due, judge_with_floor, relative_to_start, rounds_much,
                                       watch_room, watch_t)


cdef class Watch:
    """Where a run of sweeps stands; `data` is what the judge reads, its start error known.

    `confirm`: the same problem in another form, which a claim must hold in too.
    """

    def __init__(self, Data data, int patience=64, Data confirm=None):
        cdef Py_ssize_t m = data.blocks.n_rows, room
        cdef double[::1] scratch
        self.view = self.other = data.view()
        if confirm is not None:
            self.other = confirm.view()
            self.confirm = &self.other
        room = watch_room(m, count_islands(&self.view.p))
        scratch = np.empty(room + 2 * m + scratch_of(&self.other) + 4)
        self.keep = data, confirm, scratch
        begin_watch(&self.state, &self.view.p, data.start_energy, data.start_velocity, patience, &scratch[0])
        self.state.w = &scratch[room]
        self.state.e = &scratch[room + m]
        self.state.v = &scratch[room + 2 * m]

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
        cdef watch_t* s = &self.state
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
