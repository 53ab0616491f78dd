"""Accelerated sweeps with looks at what they promise: `auto`'s first glance in one call.

    rest = n log(now / tol) / log(before / now)         sweeps left, by the contraction of the last n    (1)

They go on while rest is no more than `least`; each time half as many as were done, `first` at least. `now` is the
judge's.
"""
from libc.math cimport INFINITY, log
from libc.stdint cimport int32_t

import numpy as np

from lavender_ext.accelerate.accelerated import allocate, run
from lavender_ext.core.problem cimport Data
from lavender_ext.judge.measure cimport Judged
from lavender_ext.judge.measure import velocity_change
from lavender_ext.judge.watch cimport RUNNING, Watch
from lavender_ext.local import gauss_seidel

cdef enum:
    MEMORY = 5                  # sweeps that are combined
    PATIENCE = 500              # of their watch


cpdef double sweeps_left(double done, double before, double now, double tol) noexcept nogil:
    """(1); inf where the residual does not fall."""
    cdef double gain = log(before / now) if 0.0 < now < before < INFINITY else 0.0
    return done * log(now / (tol if tol > 1e-16 else 1e-16)) / gain if gain > 0.0 else INFINITY


cdef class Looks:
    """Sweeps of `anderson` in the order given, from the first one on, and what the last look at them found.

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
    cdef readonly object space, prepared, order, rng     # as `accelerated.run` takes them
    cdef readonly Judged now            # of the last look,
    cdef readonly double before         # relative residual before the last sweeps,
    cdef readonly int last, done        # how many these were, and all of them
    cdef readonly int status            # of the watch
    cdef readonly int sweeps, restarts

    def __init__(self, Data metric, Data data, bint exact, int split):
        cdef bint formed = (metric.factored or metric.is_general) and not (data.factored or data.is_general)
        if data is not metric:
            data.set_start(metric.start_energy, metric.start_velocity)
        self.metric, self.data, self.exact, self.split, self.memory = metric, data, exact, split, MEMORY
        # Rows of A that were formed: the form that was given has the last word.
        self.watch = Watch(data, PATIENCE, metric if formed else None)
        self.prepared = gauss_seidel.prepare(data) if exact else None
        self.space = allocate(data, MEMORY)
        self.order = np.arange(data.blocks.n_blocks, dtype=np.int32)
        self.rng = np.zeros(1, np.uint64)

    def run(self, lam, double before, int n, double tol, int sweeps, int first, double least, bint watched=True):
        """From `lam` (m,) [N s] in place, at the relative residual `before`, at most `n`, `sweeps` before the first look.

        `least`: sweeps left that they promise at most, to go on. `watched`: by their watch between two looks as well,
        whose checks cost as much as the first sweeps.
        """
        cdef Judged now
        cdef int32_t status, last, swept, restarts
        if self.data.factored or self.data.is_general:
            velocity_change(self.data, lam, self.space[3])
        while True:
            status, last, swept, restarts = run(
                self.data, self.watch, lam, sweeps, tol if watched else 0.0, MEMORY, self.prepared, self.exact, 0,
                self.space, self.order, self.split, 0, self.rng, False)
            if not watched:
                self.watch.state.check_at = self.watch.state.total
            self.done += last
            self.sweeps += swept
            now = Judged(self.metric, lam.copy())
            if now.relative <= tol or status != RUNNING or self.done >= n or \
                    sweeps_left(last, before, now.relative, tol) > least:
                self.now, self.before, self.last, self.status, self.restarts = now, before, last, status, restarts
                return
            before = now.relative
            sweeps = self.done // 2 if self.done // 2 > first else first
            if sweeps > n - self.done:
                sweeps = n - self.done
