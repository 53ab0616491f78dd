"""The gate of arrays for what most callers give: float64 that lies together, of the shape asked for."""
from cpython.buffer cimport PyBUF_C_CONTIGUOUS, PyBUF_FORMAT, PyBuffer_Release, PyObject_GetBuffer

import numpy as np

cdef object ndarray = np.ndarray


def plain(value, tuple shape, bint finite, bint copy):
    """`value`, or a copy of it, read-only; None where it is not such an array and the long way finds the words.

    None in `shape` stands for any length; `finite`: NaN and infinities are left to the long way.
    """
    cdef Py_buffer view
    cdef Py_ssize_t i, n = 1
    cdef const double* x
    cdef double s = 0.0                                 # stays 0, or becomes NaN
    cdef bint fits
    if type(value) is not ndarray or not value.flags.c_contiguous:
        return None
    PyObject_GetBuffer(value, &view, PyBUF_FORMAT | PyBUF_C_CONTIGUOUS)
    fits = view.format[0] == 100 and view.format[1] == 0 and view.ndim == len(shape)    # "d"
    if fits:
        for i in range(view.ndim):
            wanted = shape[i]
            n *= view.shape[i]
            if wanted is not None and wanted != view.shape[i]:
                fits = False
                break
    if fits and finite:
        x = <const double*>view.buf
        for i in range(n):
            s += 0.0 * x[i]
        fits = s == 0.0
    PyBuffer_Release(&view)
    if not fits:
        return None
    made = value.copy() if copy else value
    made.setflags(write=False)
    return made


def has_negative(const double[::1] x):
    """Whether any number is below 0."""
    cdef Py_ssize_t i
    for i in range(x.shape[0]):
        if x[i] < 0.0:
            return True
    return False
