"""Newton's method on one scaled problem for Python: arrays that `newton_t` points into."""
from lavender_ext.newton.run cimport newton_t
from lavender_ext.newton.system cimport others_t


cdef class Solve:
    cdef newton_t n
    cdef others_t calls
    cdef object keep, others, raised
    cdef readonly object v, einv, p, pair, bt           # small matrices of every element
    cdef readonly int m
