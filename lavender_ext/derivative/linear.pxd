"""Linearisation of one solution, the factor of its equations, and their adjoint, for other modules: see `linear.pyx`."""
from libc.stdint cimport int32_t

from lavender_ext.core.arena cimport arena_t
from lavender_ext.core.view cimport view_t
from lavender_ext.derivative.natural cimport linearised_t


cdef void bind_linearised_arrays(linearised_t* a, arena_t* arena) noexcept nogil
cdef void judge_and_linearise(linearised_t* a, const double* lam, double energy, double velocity,
                              double* scratch) noexcept nogil
cdef ssize_t derivative_factor_scratch_size(int32_t n, const view_t* v) noexcept nogil
cdef void bind_derivative_factor(linearised_t* a, arena_t* arena) noexcept nogil
cdef bint factor_derivative_system(linearised_t* a, const view_t* v, double shift, double* scratch) noexcept nogil
cdef public void lav_adjoint(const linearised_t* a, const double* y, const double* c, const double* x, double* q, double* s,
                             double* f) noexcept nogil
