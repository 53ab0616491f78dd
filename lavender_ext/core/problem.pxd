"""What the kernels know of a problem: plain pointers into arrays that a `Data` keeps alive."""
from lavender_ext.core.block cimport blocks_t
from lavender_ext.core.csr cimport csr_t
from lavender_ext.core.rows cimport rows_t


cdef class Data:
    cdef blocks_t blocks
    cdef csr_t csr              # where not factored
    cdef rows_t rows            # where factored
    cdef readonly bint factored
    cdef readonly bint single_rows      # every block is one ROW
    cdef readonly object d, nu, step, empty
    cdef readonly double start_energy, start_velocity
    cdef object _weight
    cdef list keep
