"""The zero impulse, from which a solve starts by default."""
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport blocks_t


cdef inline double clip_zero_to_row_bounds(const blocks_t* p, int32_t k) noexcept nogil:
    """Return Pi(0) of row k: zero clipped to its bounds."""
    return p.lower[k] if p.lower[k] > 0.0 else p.upper[k] if p.upper[k] < 0.0 else 0.0


cdef inline bint is_zero_impulse(const blocks_t* p, const double* lam) noexcept nogil:
    """Return whether lam (m) is 0 or Pi(0)."""
    cdef int32_t j
    cdef bint zero = True, same = True
    for j in range(p.n_rows):
        zero = zero and lam[j] == 0.0
        same = same and lam[j] == clip_zero_to_row_bounds(p, j)
    return zero or same
