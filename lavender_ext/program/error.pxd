"""Compressed rows of quadratic programs."""
from libc.stdint cimport int32_t


cdef struct csr_t:
    Py_ssize_t m, n
    const int32_t* ptr
    const int32_t* idx
    const double* val


cdef csr_t read_csr(object arrays, Py_ssize_t m, Py_ssize_t n) except *
