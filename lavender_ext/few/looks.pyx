"""Accelerated sweeps with looks at what they promise: the loop of `auto`'s first glance in one call.

    rest = n log(now / tol) / log(before / now)         sweeps left, by the contraction of the last n    (1)

They go on while rest costs no more than `least`, and all that were done no more than `most`; each time half as many as
were done, `first` at least. `now` is the judge's.
"""
from libc.math cimport INFINITY, log
from libc.stdint cimport int32_t

from lavender_ext.accelerate.accelerated import run
from lavender_ext.core.problem cimport Data
from lavender_ext.judge.measure cimport Judged
from lavender_ext.judge.watch cimport RUNNING


cpdef double sweeps_left(double done, double before, double now, double tol) noexcept nogil:
    """(1); inf where the residual does not fall."""
    cdef double gain = log(before / now) if 0.0 < now < before < INFINITY else 0.0
    return done * log(now / (tol if tol > 1e-16 else 1e-16)) / gain if gain > 0.0 else INFINITY


def look(Data metric, lam, double before, int32_t sweeps, int32_t n, double tol, sweeper, int32_t first,
         double per, double least, double most):
    """From `lam` (m,) [N s] in place, at `before`, at most `n`, `sweeps` before the first look.

    sweeper is (data, watch, memory, prepared, exact, convex, space, order, split, mode, rng, keeps) of
    `accelerated.run`, per what a sweep costs, as `least` and `most`. (what the judge finds last, the residual before
    the last run, its iterations, all iterations, status, sweeps, restarts so far)
    """
    cdef Judged now
    cdef int32_t status, last, total = 0, backwards, swept = 0, restarts
    data, watch, memory, prepared, exact, convex, space, order, split, mode, rng, keeps = sweeper
    while True:
        status, last, backwards, restarts = run(
            data, watch, lam, sweeps, tol, memory, prepared, exact, convex, space, order, split, mode, rng, keeps)
        total += last
        swept += backwards
        now = Judged(metric, lam.copy())
        if now.relative <= tol or status != RUNNING or total >= n or total * per > most or \
                sweeps_left(last, before, now.relative, tol) * per > least:
            return now, before, last, total, status, swept, restarts
        before = now.relative
        sweeps = total // 2 if total // 2 > first else first
        if sweeps > n - total:
            sweeps = n - total
