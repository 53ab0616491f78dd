"""Solves with the factor L^T D L of `tree.pxd`."""
from libc.stdint cimport int32_t


cdef inline void axpy_subtract(double* x, const double* l, double f, int32_t n) noexcept nogil:
    """Subtract f l from x (n)."""
    cdef int32_t i
    if f != 0.0:
        for i in range(n):
            x[i] -= f * l[i]


cdef inline void axpy_subtract_2(double* x, const double* l, double f, const double* u, double g, int32_t n) noexcept nogil:
    """Subtract f l, then g u from x (n)."""
    cdef int32_t i
    for i in range(n):
        x[i] = (x[i] - f * l[i]) - g * u[i]


cdef inline void solve_tree_factor(int32_t n, const int32_t* lptr, const int32_t* lidx, const double* lval,
                                   const double* inv_pivot, double* x) noexcept nogil:
    """Overwrite x (n) with (L^T D L)^-1 x; lptr indexes both lidx and lval."""
    cdef int32_t k, q, first, end
    cdef double z
    for k in range(n - 1, -1, -1):                          # L^T z = x
        z = x[k]
        if z != 0.0:
            first = lptr[k]
            end = lptr[k + 1]
            for q in range(first, end):
                x[lidx[q]] -= lval[q] * z
    for k in range(n):                                      # D, then L x = z
        z = x[k] * inv_pivot[k]
        first = lptr[k]
        end = lptr[k + 1]
        for q in range(first, end):
            z -= lval[q] * x[lidx[q]]
        x[k] = z
