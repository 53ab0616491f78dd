"""Addresses of arrays: a typed view costs as much as a pass over 500 numbers, which is most of what small arrays cost."""
from cpython.buffer cimport PyBUF_C_CONTIGUOUS, PyBUF_FORMAT, PyBUF_STRIDES, PyBuffer_Release, PyObject_GetBuffer
from cython cimport view
from libc.stdint cimport int32_t
from libc.stdlib cimport calloc, free
from libc.string cimport strchr

import numpy as np


cdef inline object zeros(Py_ssize_t n):
    """(n + 1,) float64 whose pages come when they are touched: NumPy asks for huge ones, each of which may wait long."""
    cdef view.array made = view.array(shape=(n + 1,), itemsize=sizeof(double), format="d", allocate_buffer=False)
    made.data = <char*>calloc(n + 1, sizeof(double))
    if made.data == NULL:
        raise MemoryError(f"{n} numbers")
    made.callback_free_data = free
    return np.asarray(made)


cdef inline char* spread(object array, Py_ssize_t n, Py_ssize_t width, const char* kinds, Py_ssize_t size,
                         Py_ssize_t* stride) except? NULL:
    """Of (n,) or (n, width) numbers of `size` bytes, of kinds that `struct` has, that the caller keeps.

    `stride`: bytes from one to the next; where it is NULL all lie together, in any shape. ValueError of other arrays.
    """
    cdef Py_buffer held
    cdef bint fits
    cdef Py_ssize_t i, count = 1
    cdef char* at
    PyObject_GetBuffer(array, &held, PyBUF_FORMAT | (PyBUF_STRIDES if stride != NULL else PyBUF_C_CONTIGUOUS))
    at = <char*>held.buf
    fits = held.itemsize == size and held.format[1] == 0 and strchr(kinds, held.format[0]) != NULL
    for i in range(held.ndim):
        count *= held.shape[i]
    fits = fits and count == n * width
    if stride != NULL and fits:
        fits = held.ndim == (2 if width > 1 else 1) and held.shape[0] == n and (width == 1 or held.strides[1] == size)
        stride[0] = held.strides[0]
    PyBuffer_Release(&held)
    if not fits:
        raise ValueError(f"{n * width} numbers of {size} bytes are needed")
    return at


cdef inline double* doubles(object array, Py_ssize_t n) except? NULL:
    """Of n float64 that lie together."""
    return <double*>spread(array, n, 1, "d", sizeof(double), NULL)


cdef inline int32_t* ints(object array, Py_ssize_t n) except? NULL:
    """Of n int32 that lie together."""
    return <int32_t*>spread(array, n, 1, "il", sizeof(int32_t), NULL)


cdef inline void* address(object array) except? NULL:
    """Of the first number of a C-contiguous float64 or int32 array; NULL where there is none."""
    cdef Py_ssize_t n = array.size
    if n == 0:
        return NULL
    return <void*>doubles(array, n) if array.itemsize == sizeof(double) else <void*>ints(array, n)
