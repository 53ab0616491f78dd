"""Addresses of arrays that a caller has checked."""
from cython cimport view
from libc.stdint cimport int32_t
from libc.stdlib cimport calloc, free

import numpy as np


cdef inline object zeros(Py_ssize_t n):
    """(n + 1,) float64 whose pages come when they are touched: NumPy asks for huge ones, each of which may wait long."""
    cdef view.array made = view.array(shape=(n + 1,), itemsize=sizeof(double), format="d", allocate_buffer=False)
    made.data = <char*>calloc(n + 1, sizeof(double))
    if made.data == NULL:
        raise MemoryError(f"{n} numbers")
    made.callback_free_data = free
    return np.asarray(made)


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
