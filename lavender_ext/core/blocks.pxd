"""Blocks of a problem: pointers into arrays that the object keeps alive."""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.block_types cimport blocks_t


cdef class Blocks:
    cdef blocks_t at                                    # without law, b, d, nu and step
    cdef readonly object ints, numbers                  # arrays that `at` points into, with optional extra memory at the end
    cdef tuple _arrays
    cdef readonly int32_t fault                         # first fault of core/faults.pxd, or NO_FAULT
    cdef readonly int64_t index                         # its block or row
    cdef readonly bint is_free                          # every row is unbounded
    cdef readonly bint is_bounded_rows                  # every row has constant bounds
    cdef readonly bint has_round                        # some contact has more than two tangents
    cdef readonly bint has_rolling                      # some contact has rolling rows with a bound of their own
    cdef readonly bint has_ellipse                      # some contact bounds its two tangents by an ellipse
    cdef readonly bint single_rows                      # every block is one bounded row

    cdef bint bind_arrays(self, const int32_t[::1] ptr, const int32_t[::1] kind, const double[::1] lower,
                          const double[::1] upper, const double[::1] mu, const double[::1] radius, const double[::1] rolling)
    cdef bint validate(self) noexcept


cdef Blocks allocate_blocks(Py_ssize_t k, Py_ssize_t m, Py_ssize_t ints=*, Py_ssize_t numbers=*)
