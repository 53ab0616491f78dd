"""Newton's method on one problem for Python: arrays that `newton_t` points into."""
from libc.stdint cimport int32_t

from lavender_ext.core.method cimport Method
from lavender_ext.newton.bodies cimport pattern_t
from lavender_ext.newton.run cimport newton_t
from lavender_ext.newton.system cimport others_t


cdef class Layout:
    cdef pattern_t a
    cdef object index, filled
    cdef readonly object body, node, turned             # (k, 2) bodies, block columns, and (k,) which were changed over
    cdef readonly object nptr, lptr                     # (n + 1) blocks of N by rows, and of L by columns
    cdef readonly object panels                         # of `symbolic.block_panels`, or None
    cdef readonly int n, s
    cdef readonly double work                           # multiply-adds of a factor


cdef class Solve(Method):
    cdef newton_t* n
    cdef others_t calls
    cdef list held
    cdef object others, raised, real, index
    cdef readonly object keep, block, ptr, part, wptr, fixed, scale, theta, g, lower, upper, reach
    cdef readonly object v, einv, p, pair, bt           # small matrices of every element
    cdef readonly int m
