"""Addresses of NumPy arrays without typed views: creating a typed view costs as much as a pass over 500 numbers."""
from libc.stdint cimport int32_t

from lavender_ext.core.validate cimport has_invalid_number

cdef extern from *:
    """
    /* The leading fields of NumPy's array and dtype structs: an ABI that has not changed since NumPy 1.0. */
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

cdef enum:                          # NumPy's constants
    C_CONTIGUOUS = 1                # array flags
    ALIGNED = 256
    WRITEABLE = 1024
    INT = 5                         # type numbers
    LONG = 7
    DOUBLE = 12


cdef inline bint has_element_type(ndarray x, int kind) noexcept:
    """Return whether the array holds aligned, native DOUBLE or 32-bit INT values, as `kind` requires."""
    return x.flags & ALIGNED and x.descr.byteorder == c"=" and (
        x.descr.type_num == kind or kind == INT and sizeof(long) == sizeof(int32_t) and x.descr.type_num == LONG)


cdef inline char* get_checked_data_pointer(object array, Py_ssize_t n, Py_ssize_t width, int kind, Py_ssize_t* stride) except? NULL:
    """Return the address of an array (n,) or (n, width) of DOUBLE or 32-bit INT; raise ValueError for other arrays.

    The caller keeps the array alive. `stride` receives the number of bytes between rows. If `stride` is NULL, the array must
    be C-contiguous and may have any shape with n * width entries.
    """
    cdef ndarray x
    cdef Py_ssize_t i, count = 1, size = sizeof(double) if kind == DOUBLE else sizeof(int32_t)
    if isinstance(array, ndarray):
        x = <ndarray>array
        for i in range(x.nd):
            count *= x.dimensions[i]
        if count == n * width and has_element_type(x, kind):
            if stride == NULL:
                if x.flags & C_CONTIGUOUS:
                    return x.data
            elif x.nd == (2 if width > 1 else 1) and x.dimensions[0] == n and (width == 1 or n == 0 or x.strides[1] == size):
                stride[0] = x.strides[0]
                return x.data
    raise ValueError(f"{n * width} numbers of {size} bytes are needed")


cdef inline double* as_double_pointer(object array, Py_ssize_t n) except? NULL:
    """Return the address of n contiguous float64 values."""
    return <double*>get_checked_data_pointer(array, n, 1, DOUBLE, NULL)


cdef inline int32_t* as_int_pointer(object array, Py_ssize_t n) except? NULL:
    """Return the address of n contiguous int32 values."""
    return <int32_t*>get_checked_data_pointer(array, n, 1, INT, NULL)


cdef inline const double* get_plain_matrix(object value, Py_ssize_t* m, Py_ssize_t* n, Py_ssize_t* nonzeros):
    """Return the address of a C-contiguous float64 matrix with valid numbers, and its shape; NULL for any other value.

    `nonzeros` receives an upper bound of its nonzeros; only in large matrices they are counted, for the sake of memory.
    """
    cdef ndarray x
    cdef const double* at
    cdef Py_ssize_t i, count = 0
    if type(value) is not ndarray:
        return NULL
    x = <ndarray>value
    if x.nd != 2 or not x.flags & C_CONTIGUOUS or not has_element_type(x, DOUBLE):
        return NULL
    m[0], n[0], at = x.dimensions[0], x.dimensions[1], <const double*>x.data
    nonzeros[0] = m[0] * n[0]
    if nonzeros[0] > 32768:
        for i in range(m[0] * n[0]):
            count += at[i] != 0.0
        nonzeros[0] = count
    if has_invalid_number(at, m[0] * n[0]):
        return NULL
    return at


cdef inline object make_read_only(object array):
    """Clear the WRITEABLE flag of an array and return the array."""
    (<ndarray>array).flags &= ~WRITEABLE
    return array


cdef inline void* get_data_pointer(object array) except? NULL:
    """Return the address of the first entry of a C-contiguous float64 or int32 array, NULL if it is empty."""
    cdef Py_ssize_t n = array.size
    if n == 0:
        return NULL
    return <void*>as_double_pointer(array, n) if array.itemsize == sizeof(double) else <void*>as_int_pointer(array, n)
