"""Newton's method on one problem for Python: arrays that `newton_t` points into."""
from libc.stdint cimport int32_t

from lavender_ext.core.problem cimport Data
from lavender_ext.newton.run cimport newton_t
from lavender_ext.newton.system cimport others_t


cdef class Solve:
    cdef newton_t n
    cdef others_t calls
    cdef Data data
    cdef list held
    cdef object others, raised, real, index
    cdef readonly object keep, block, ptr, kind, wptr, fixed, scale, theta, g, lower, upper, a_t, a_s
    cdef readonly object v, einv, p, pair, bt           # small matrices of every element
    cdef readonly int m
    cdef _real(self, const double* at, Py_ssize_t n)
    cdef _whole(self, const int32_t* at, Py_ssize_t n)
