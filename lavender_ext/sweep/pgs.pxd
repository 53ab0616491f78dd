"""Declarations of `pgs.pyx`: one sweep of projected Gauss-Seidel over the blocks order (k), in each form of A."""
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport csr_t, generalized_t, rows_t


cdef void sweep_csr_once(const blocks_t* p, const csr_t* a, const int32_t* order, double* lam) noexcept nogil
cdef void sweep_bounded_rows(const blocks_t* p, const csr_t* a, double* lam) noexcept nogil
cdef void sweep_matrix_sor(const blocks_t* p, const csr_t* a, double omega, const int32_t* order, double* lam) noexcept nogil
cdef void sweep_jacobi(const blocks_t* p, const double* w, double omega, double* lam) noexcept nogil
cdef void sweep_bodies(const blocks_t* p, const rows_t* r, const int32_t* order, int32_t n, double* lam,
                       double* v) noexcept nogil
cdef void sweep_bodies_in_sequence(const blocks_t* p, const rows_t* r, double* lam, double* v) noexcept nogil
cdef void sweep_generalized(const blocks_t* p, const generalized_t* g, const int32_t* order, double* lam,
                            double* v) noexcept nogil
