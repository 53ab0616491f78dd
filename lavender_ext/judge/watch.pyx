"""The watch of judge/watch.pxd for Python: where a run of sweeps stands, and the loop of sweeps and checks."""
from libc.math cimport NAN, log10
from libc.stdint cimport int32_t

import numpy as np

from lavender_ext.core.block cimport blocks_t
from lavender_ext.core.csr cimport csr_t
from lavender_ext.core.problem cimport Data
from lavender_ext.core.rows cimport rows_t
from lavender_ext.judge.progress cimport envelope
from lavender_ext.judge.watch cimport AT_FLOOR, CONVERGED, RUNNING, begin_watch, check, confirmed, sweep_t, watch_t


cdef public int32_t lav_watch_check(watch_t* s, const blocks_t* p, const csr_t* a, const rows_t* r, int32_t factored,
                                    double* lam, double tol) noexcept nogil:
    """One check of `s` on lam (m); the status."""
    return check(s, p, a, r, NULL, factored, lam, tol)


cdef class Watch:
    """Where a run of sweeps stands; `data` is what the judge reads, its start error known.

    `confirm`: the same problem in another form, which a claim must hold in too.
    """

    def __init__(self, Data data, int patience=64, Data confirm=None):
        cdef Py_ssize_t m = data.blocks.n_rows
        cdef Data last = data if confirm is None else confirm
        cdef Py_ssize_t n = last.general.n + m if last.is_general else 12 * <Py_ssize_t>last.rows.n_bodies
        cdef double[::1] scratch = np.empty(5 * m + n + 4)
        self.data = data
        self.confirm = confirm
        self.keep = scratch
        begin_watch(&self.state, data.start_energy, data.start_velocity, patience, &scratch[0], <int32_t>m)
        self.state.w = &scratch[3 * m]
        self.state.e = &scratch[4 * m]
        self.state.v = &scratch[5 * m]

    @property
    def total(self):
        """Sweeps done."""
        return self.state.total

    @property
    def best_relative(self):
        """Relative residual of the best check; inf before any."""
        return self.state.best_relative

    @property
    def best(self):
        """(relative residual, impulse) of the best check; (inf, None) before any."""
        if self.state.best_at < 0:
            return self.state.best_relative, None
        return self.state.best_relative, np.array(self.keep)[:self.data.blocks.n_rows]

    @property
    def sweeps_per_decade(self):
        """Sweeps in which the residual falls tenfold, by its lower envelope at the last check; NaN where it does not."""
        cdef double fall = 0.0, low = 0.0
        cdef int32_t k = envelope(&self.state.progress, &fall, &low)
        return -k / log10(fall) if k > 0 and 0.0 < fall < 1.0 else NAN

    cdef int32_t check_now(self, double* lam, double tol) noexcept nogil:
        cdef int32_t status = check(&self.state, &self.data.blocks, &self.data.csr, &self.data.rows,
                                    &self.data.general if self.data.is_general else NULL, self.data.factored, lam, tol)
        if self.confirm is not None and (status == CONVERGED or status == AT_FLOOR):
            return confirmed(&self.state, &self.confirm.blocks, &self.confirm.csr, &self.confirm.rows,
                             &self.confirm.general if self.confirm.is_general else NULL, self.confirm.factored, lam,
                             tol, status)
        return status

    cdef int32_t run(self, sweep_t sweep, void* context, double* lam, int32_t n, double tol, int32_t* done) noexcept nogil:
        """n sweeps, fewer where a check ends them; tol = 0 checks nothing. Counts them in `done`."""
        cdef int32_t step, status
        done[0] = 0
        while done[0] < n:
            step = n - done[0]
            if tol > 0.0:
                if self.state.total == self.state.check_at:
                    status = self.check_now(lam, tol)
                    if status != RUNNING:
                        return status
                if self.state.check_at - self.state.total < step:
                    step = self.state.check_at - self.state.total
            sweep(context, lam, self.state.total == 0, step)
            done[0] += step
            self.state.total += step
        return RUNNING

    def run_python(self, sweep, double[::1] lam, int n, double tol):
        """`run` with a Python callable sweep(count, first); returns (status, sweeps done)."""
        cdef int32_t done = 0, step, status
        if lam.shape[0] == 0:
            if tol > 0.0:
                return CONVERGED, 0
            return RUNNING, n
        while done < n:
            step = n - done
            if tol > 0.0:
                if self.state.total == self.state.check_at:
                    with nogil:
                        status = self.check_now(&lam[0], tol)
                    if status != RUNNING:
                        return status, done
                step = min(step, self.state.check_at - self.state.total)
            sweep(step, self.state.total == 0)
            done += step
            self.state.total += step
        return RUNNING, done
