"""Arithmetic of 3-vectors, complementing `dot3` and `cross` of core/rows.pxd; `out` may alias an argument."""
from libc.stdint cimport int32_t

from lavender_ext.core.rows cimport dot3


cdef inline void copy3(const double* x, double* out) noexcept nogil:
    """Copy x to out."""
    cdef int32_t k
    for k in range(3):
        out[k] = x[k]


cdef inline void scale3(double s, const double* x, double* out) noexcept nogil:
    """Compute out = s x."""
    cdef int32_t k
    for k in range(3):
        out[k] = s * x[k]


cdef inline void subtract3(const double* x, const double* y, double* out) noexcept nogil:
    """Compute out = x - y."""
    cdef int32_t k
    for k in range(3):
        out[k] = x[k] - y[k]


cdef inline void add_scaled3(const double* x, double s, const double* y, double* out) noexcept nogil:
    """Compute out = x + s y."""
    cdef int32_t k
    for k in range(3):
        out[k] = x[k] + s * y[k]


cdef inline void linear_combination3(double s, const double* x, double t, const double* y, double* out) noexcept nogil:
    """Compute out = s x + t y."""
    cdef int32_t k
    for k in range(3):
        out[k] = s * x[k] + t * y[k]


cdef inline void copy_column3(const double* matrix, int32_t j, double* out) noexcept nogil:
    """Copy column j of a matrix (3, 3), axis j of a body's frame, to out."""
    cdef int32_t k
    for k in range(3):
        out[k] = matrix[3 * k + j]


cdef inline void matvec3(const double* matrix, const double* x, double* out) noexcept nogil:
    """Compute out = matrix (3, 3) x; out must not alias x."""
    cdef int32_t k
    for k in range(3):
        out[k] = dot3(matrix + 3 * k, x)
