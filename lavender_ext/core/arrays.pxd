"""Addresses of arrays that a caller has checked."""
from libc.stdint cimport int32_t


cdef inline void* address(object array):
    """Of the first number of a C-contiguous float64 or int32 array; NULL where there is none."""
    cdef const double[::1] x
    cdef const int32_t[::1] y
    if array.ndim > 1:
        array = array.ravel()
    if len(array) == 0:
        return NULL
    if array.itemsize == 4:
        y = array
        return <void*>&y[0]
    x = array
    return <void*>&x[0]
