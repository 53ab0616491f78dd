"""The stopping test of a sweep solver: the judge's own arithmetic at fixed sweep counts."""
from libc.stdint cimport int32_t

from lavender_ext.problem cimport Data


cdef enum:
    RUNNING = 0
    CONVERGED = 1
    DIVERGED = 2
    STALLED = 3
    AT_FLOOR = 4


ctypedef void (*sweep_t)(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil


cdef class Watch:
    cdef Data data
    cdef readonly int32_t total             # sweeps done
    cdef readonly int32_t check_at          # sweeps at the next check
    cdef readonly int32_t best_at           # sweeps at the best check
    cdef readonly double start              # relative residual at the first check
    cdef readonly double best_relative      # of the best check
    cdef double[::1] best_lam, w, e, v
    cdef int32_t check(self, double* lam, double tol) noexcept nogil
    cdef double relative(self, double energy, double velocity) noexcept nogil
    cdef void restore(self, double* lam) noexcept nogil
    cdef int32_t run(self, sweep_t sweep, void* context, double* lam, int32_t n, double tol, int32_t* done) noexcept nogil
