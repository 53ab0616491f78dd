"""Declarations of `gauss_seidel.pyx`: sweeps of block Gauss-Seidel."""
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport csr_t, generalized_t, rows_t, view_t


cdef double index_prepared_numbers(const blocks_t* p, int32_t* start) noexcept nogil
cdef void prepare_exact_blocks(const view_t* v, const int32_t* start, double* g) noexcept nogil
cdef int32_t sweep_exact_blocks(const blocks_t* p, const csr_t* a, const rows_t* r, const generalized_t* o, const int32_t* start,
                          const double* g, const int32_t* order, double* lam, double* v) noexcept nogil
