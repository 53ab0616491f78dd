"""The supernodal factor of a matrix in compressed rows (`sparse.pyx`), and its solve."""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.factor.supernodal cimport solve_supernodes, supernodal_t


cdef struct sparse_t:
    supernodal_t factor
    int32_t lu
    double* scale               # (n) by position: D^-1/2 of L U, else the smallest accepted pivots
    double* y                   # (n) scratch of a solve


cdef inline void sparse_solve(const sparse_t* f, const double* b, double* x) noexcept nogil:
    """Compute x = (A + shift D)^-1 b after `lav_sparse_factor`; b and x may be one array."""
    cdef int32_t k
    cdef const int32_t* order = f.factor.order
    for k in range(f.factor.n):
        f.y[k] = b[order[k]]
        if f.lu:
            f.y[k] *= f.scale[k]
    solve_supernodes(&f.factor, f.y, f.lu)
    for k in range(f.factor.n):
        x[order[k]] = f.y[k] * f.scale[k] if f.lu else f.y[k]


cdef class SparsePanels:
    cdef sparse_t f
    cdef object analysis, numbers, indptr, indices
    cdef double cholesky_work                           # multiply-adds of L L^T
    cdef readonly double work                           # multiply-adds of the factor
    cdef readonly int64_t entries                       # number of its values

    cdef _allocate(self)
