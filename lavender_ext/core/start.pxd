"""Where a solve begins."""
from libc.stdint cimport int32_t

from lavender_ext.core.parts cimport blocks_t


cdef inline bint is_nothing(const blocks_t* p, const double* lam) noexcept nogil:
    """Is lam (m) 0, or what doing nothing is: Pi(0)?"""
    cdef int32_t j
    cdef bint zero = True, same = True
    for j in range(p.n_rows):
        zero = zero and lam[j] == 0.0
        same = same and lam[j] == (p.lower[j] if p.lower[j] > 0.0 else p.upper[j] if p.upper[j] < 0.0 else 0.0)
    return zero or same
