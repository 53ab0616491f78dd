"""Addresses of arrays: a typed view costs as much as a pass over 500 numbers, which is most of what small arrays cost."""
from cython cimport view
from libc.stdint cimport int32_t
from libc.stdlib cimport calloc, free

import numpy as np

cdef extern from *:
    """
    /* What NumPy's own inline functions read of an array and its type: an ABI that has not changed since 1.0. */
    typedef struct { PyObject_HEAD PyObject *typeobj; char kind, type, byteorder, old; int type_num; } lav_descr;
    typedef struct {
        PyObject_HEAD char *data; int nd; Py_ssize_t *dimensions, *strides; PyObject *base; lav_descr *descr; int flags;
    } lav_array;
    """
    ctypedef struct lav_descr:
        char byteorder
        int type_num
    ctypedef class numpy.ndarray [object lav_array, check_size ignore]:
        cdef char* data
        cdef int nd
        cdef Py_ssize_t* dimensions
        cdef Py_ssize_t* strides
        cdef lav_descr* descr
        cdef int flags

cdef enum:                          # NumPy's
    TOGETHER = 1                    # flags: C-contiguous
    ALIGNED = 256
    WRITEABLE = 1024
    INT = 5                         # types, as in C
    LONG = 7
    DOUBLE = 12


cdef inline object zeros(Py_ssize_t n):
    """(n + 1,) float64 whose pages come when they are touched: NumPy asks for huge ones, each of which may wait long."""
    cdef view.array made = view.array(shape=(n + 1,), itemsize=sizeof(double), format="d", allocate_buffer=False)
    made.data = <char*>calloc(n + 1, sizeof(double))
    if made.data == NULL:
        raise MemoryError(f"{n} numbers")
    made.callback_free_data = free
    return np.asarray(made)


cdef inline bint is_of(ndarray x, int kind) noexcept:
    """Whether all numbers are DOUBLE, or INT of 32 bits, as the processor reads them."""
    return x.flags & ALIGNED and x.descr.byteorder == c"=" and (
        x.descr.type_num == kind or kind == INT and sizeof(long) == sizeof(int32_t) and x.descr.type_num == LONG)


cdef inline char* spread(object array, Py_ssize_t n, Py_ssize_t width, int kind, Py_ssize_t* stride) except? NULL:
    """Of (n,) or (n, width) numbers, DOUBLE or INT of 32 bits, that the caller keeps.

    `stride`: bytes from one to the next; where it is NULL all lie together, in any shape. ValueError of other arrays.
    """
    cdef ndarray x
    cdef Py_ssize_t i, count = 1, size = sizeof(double) if kind == DOUBLE else sizeof(int32_t)
    if isinstance(array, ndarray):
        x = <ndarray>array
        for i in range(x.nd):
            count *= x.dimensions[i]
        if count == n * width and is_of(x, kind):
            if stride == NULL:
                if x.flags & TOGETHER:
                    return x.data
            elif x.nd == (2 if width > 1 else 1) and x.dimensions[0] == n and (width == 1 or n == 0 or x.strides[1] == size):
                stride[0] = x.strides[0]
                return x.data
    raise ValueError(f"{n * width} numbers of {size} bytes are needed")


cdef inline double* doubles(object array, Py_ssize_t n) except? NULL:
    """Of n float64 that lie together."""
    return <double*>spread(array, n, 1, DOUBLE, NULL)


cdef inline int32_t* ints(object array, Py_ssize_t n) except? NULL:
    """Of n int32 that lie together."""
    return <int32_t*>spread(array, n, 1, INT, NULL)


cdef inline object frozen(object array):
    """The array itself, which nobody but who made it may write to from here on."""
    (<ndarray>array).flags &= ~WRITEABLE
    return array


cdef inline void* address(object array) except? NULL:
    """Of the first number of a C-contiguous float64 or int32 array; NULL where there is none."""
    cdef Py_ssize_t n = array.size
    if n == 0:
        return NULL
    return <void*>doubles(array, n) if array.itemsize == sizeof(double) else <void*>ints(array, n)
