"""Checks of a sweep solver at fixed counts: 1, 2, ... 16 sweeps, then an eighth more each time.

At a check the relative residual r (see judge.pyx) decides:

    r <= tol                                        converged
    r not finite, or > 1e6 max(1, r at the start)   diverged
    no better than the best so far, and
        best <= 1e-6 and best <= 2 floor            at the floor of float64
        sweeps > 8 * sweeps of the best + 64        stalled

On the last three the best iterate is put back. A check costs about one sweep.
"""
from libc.math cimport isfinite
from libc.stdint cimport int32_t
from libc.string cimport memcpy

import numpy as np

from lavender_ext.judge cimport judge_into, score_t
from lavender_ext.problem cimport Data


cdef inline double ratio(double x, double reference) noexcept nogil:
    if x == 0.0:
        return 0.0
    return x / reference if reference > 0.0 else 1.0 / 0.0


cdef class Watch:
    """Where a run of sweeps stands; `data` is what the judge reads, its start error known."""

    def __init__(self, Data data):
        cdef Py_ssize_t m = data.blocks.n_rows
        self.data = data
        scratch = np.empty(3 * m + 6 * data.rows.n_bodies + 4)
        self.best_lam = scratch[:m + 1]
        self.w = scratch[m + 1:2 * m + 2]
        self.e = scratch[2 * m + 2:3 * m + 3]
        self.v = scratch[3 * m + 3:]
        self.best_relative = 1.0 / 0.0
        self.best_at = -1

    cdef int32_t check(self, double* lam, double tol) noexcept nogil:
        cdef score_t s
        cdef double r
        cdef size_t size = self.data.blocks.n_rows * sizeof(double)
        judge_into(&self.data.blocks, &self.data.csr, &self.data.rows, self.data.factored, lam, &self.w[0], &self.e[0],
                   &self.v[0], 0, &s)
        r = self.relative(s.energy, s.velocity) if s.finite else 1.0 / 0.0
        if self.total == 0:
            self.start = r
        self.check_at = self.total + (self.total >> 3 if self.total >= 16 else 1)
        if r <= tol:
            return CONVERGED
        if r < self.best_relative:
            self.best_relative = r
            self.best_at = self.total
            memcpy(&self.best_lam[0], lam, size)
            return RUNNING
        if not isfinite(r) or r > 1e6 * (self.start if self.start > 1.0 else 1.0):
            self.restore(lam)
            return DIVERGED
        if self.best_at >= 0 and self.best_relative <= 1e-6:
            judge_into(&self.data.blocks, &self.data.csr, &self.data.rows, self.data.factored, &self.best_lam[0],
                       &self.w[0], &self.e[0], &self.v[0], 1, &s)
            if self.best_relative <= 2.0 * self.relative(s.floor_energy, s.floor_velocity):
                self.restore(lam)
                return AT_FLOOR
        if self.total > 8 * <double>self.best_at + 64:
            self.restore(lam)
            return STALLED
        return RUNNING

    cdef double relative(self, double energy, double velocity) noexcept nogil:
        cdef double x = ratio(energy, self.data.start_energy), y = ratio(velocity, self.data.start_velocity)
        return x if x > y else y

    cdef void restore(self, double* lam) noexcept nogil:
        if self.best_at >= 0:
            memcpy(lam, &self.best_lam[0], self.data.blocks.n_rows * sizeof(double))

    cdef int32_t run(self, sweep_t sweep, void* context, double* lam, int32_t n, double tol, int32_t* done) noexcept nogil:
        """n sweeps, fewer where a check ends them; tol = 0 checks nothing. Counts them in `done`."""
        cdef int32_t step, status
        done[0] = 0
        while done[0] < n:
            step = n - done[0]
            if tol > 0.0:
                if self.total == self.check_at:
                    status = self.check(lam, tol)
                    if status != RUNNING:
                        return status
                if self.check_at - self.total < step:
                    step = self.check_at - self.total
            sweep(context, lam, self.total == 0, step)
            done[0] += step
            self.total += step
        return RUNNING

    @property
    def best(self):
        """(relative residual, impulse) of the best check; (inf, None) before any."""
        if self.best_at < 0:
            return self.best_relative, None
        return self.best_relative, np.array(self.best_lam[:self.data.blocks.n_rows])

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
                if self.total == self.check_at:
                    with nogil:
                        status = self.check(&lam[0], tol)
                    if status != RUNNING:
                        return status, done
                step = min(step, self.check_at - self.total)
            sweep(step, self.total == 0)
            done += step
            self.total += step
        return RUNNING, done
