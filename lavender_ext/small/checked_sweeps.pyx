"""Accelerated sweeps with residual checks, from which `auto` predicts how many are left.

    rest = n log(now / tol) / log(before / now)         sweeps left, by the contraction of the last n    (1)

Where A was formed of J and M the checks read A, which costs a sweep and not ten; a residual below tol there is checked
by J and M.
"""
from cpython.exc cimport PyErr_CheckSignals
from libc.math cimport INFINITY, log
from libc.stdint cimport int32_t

import numpy as np

from lavender_ext.accelerate.accelerated cimport AcceleratedSweeps
from lavender_ext.core.problem cimport Data
from lavender_ext.judge.measure cimport Judged
from lavender_ext.judge.watch cimport Watch

run = AcceleratedSweeps.run

cdef enum:
    MEMORY = 5                  # sweeps that are combined
    PATIENCE = 500              # of their watch


cpdef double sweeps_left(double done, double before, double now, double tol) noexcept nogil:
    """(1); inf where the residual does not fall."""
    cdef double gain = log(before / now) if 0.0 < now < before < INFINITY else 0.0
    return done * log(now / (tol if tol > 1e-16 else 1e-16)) / gain if gain > 0.0 else INFINITY


cdef class CheckedSweeps:
    """Sweeps of `anderson` in the order given, from the first one on, and what their last check found.

    Parameters
    ----------
    metric : Data
        What the judge reads, its error of doing nothing known.
    data : Data
        What is swept: `metric`, or rows of A.
    exact : bool
        Each block is solved exactly.
    split : int
        Blocks before it are swept before the others: joints, contacts.
    """

    cdef readonly Data metric, data
    cdef readonly bint exact
    cdef readonly int split, memory
    cdef readonly Watch watch
    cdef readonly AcceleratedSweeps over
    cdef readonly Judged now, best      # of the last check, and of all
    cdef readonly int status            # of the watch
    cdef readonly int done, restarts

    def __init__(self, Data metric, Data data, bint exact, int split):
        cdef bint formed = (metric.factored or metric.is_general) and not (data.factored or data.is_general)
        if data is not metric:
            data.set_start(metric.start_energy, metric.start_velocity)
        self.metric, self.data, self.exact, self.split, self.memory = metric, data, exact, split, MEMORY
        # Rows of A that were formed: the form that was given has the last word.
        self.watch = Watch(data, PATIENCE, metric if formed else None)
        order = np.arange(data.blocks.n_blocks, dtype=np.int32)
        self.over = AcceleratedSweeps(data, order, split, 0, np.zeros(1, np.uint64), exact, MEMORY)

    cdef int sweep(self, lam, int n, double tol) except -1:
        """n of them, fewer where their watch ends them, whose checks cost as much as the first sweeps; none for tol = 0."""
        cdef int32_t last, undone
        self.status, last, undone = run(self.over, self.watch, lam, n, tol)
        self.restarts += undone
        if tol == 0.0:
            self.watch.state.check_at = self.watch.state.total
        self.done += last
        return last

    cdef double check(self, lam, double tol) except *:
        """The relative residual: by what is swept, and below tol by the judge."""
        self.now = Judged(self.data, lam.copy())
        if self.now.relative <= tol and self.data is not self.metric:
            self.now = Judged(self.metric, self.now.impulse)
        if self.best is None or self.now.relative < self.best.relative:
            self.best = self.now
        return self.now.relative

    def run(self, lam, int n, double tol):
        """From `lam` (m,) [N s] in place, at most `n`, and a check."""
        if self.done:
            self.over.start(lam)
        self.sweep(lam, n, tol)
        self.check(lam, tol)

    def within(self, lam, int n, double tol, int first, left, double share, double chunk):
        """For as long as `left()` [s] says, checked after `first` and whenever half as many more are done.

        One, as sweeps that solve blocks exactly are no steady work, then as many as fit into `share` of what is left, at
        most `chunk` [s], at the pace of the last.
        """
        cdef double time = left(), was, pace, fit = 1.0
        cdef int32_t end = self.done + n, due = self.done + first, step
        cdef bint is_due
        if self.done:
            self.over.start(lam)
        while True:
            step = max(1, min(<int32_t>min(fit, 1e9), min(due, end) - self.done))
            self.sweep(lam, step, 0.0)
            is_due = self.done == due
            if is_due:
                if self.check(lam, tol) <= tol:
                    return
                due = self.done + max(self.done // 2, first)
            PyErr_CheckSignals()
            was, time = time, left()
            pace = max(was - time, 1e-9) / (step + is_due)
            if self.done >= end or 2.0 * time <= pace:
                return
            fit = min(share * time, chunk) / pace
