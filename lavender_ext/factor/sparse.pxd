"""The factor by dense panels that `sparse.pyx` makes."""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.factor.blocks cimport sparse_t


cdef class SparsePanels:
    cdef sparse_t f
    cdef object keep, numbers, indptr, indices
    cdef double half                                    # multiply-adds of L L^T, roughly,
    cdef readonly double work                           # and of the factor
    cdef readonly int64_t entries                       # numbers it holds

    @staticmethod
    cdef SparsePanels of_blocks(analysis, int32_t n, bint wide)
    cdef _hold(self, analysis, int32_t n, bint lu, bint wide)
    cdef _make_workspace(self)
