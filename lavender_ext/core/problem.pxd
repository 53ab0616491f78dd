"""What the kernels know of a problem: plain pointers into arrays that a `Data` keeps alive."""
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport blocks_t
from lavender_ext.core.csr cimport csr_t
from lavender_ext.core.generalized cimport generalized_t
from lavender_ext.core.rows cimport rows_t


cdef class Room:
    cdef void* at               # freed with the object


cdef Room room_for(Py_ssize_t bytes)


cdef class Data:
    cdef blocks_t blocks
    cdef csr_t csr              # where A is given, or formed
    cdef rows_t rows            # where factored
    cdef generalized_t general  # where is_general
    cdef readonly bint factored, is_general
    cdef readonly bint single_rows      # every block is one ROW
    cdef readonly object empty
    cdef object _numbers, _d, _nu, _step
    cdef int32_t* _place        # (n) scratch
    cdef readonly double start_energy, start_velocity
    cdef object _weight
    cdef list keep
