"""The judge's pass for other kernels."""
from libc.stdint cimport int32_t

from lavender_ext.block cimport blocks_t
from lavender_ext.csr cimport csr_t
from lavender_ext.rows cimport rows_t


cdef struct score_t:
    double energy               # sqrt J
    double velocity             # m/s
    double floor_energy         # sqrt J
    double floor_velocity       # m/s
    int32_t worst               # row of the largest velocity error, -1 where there is none
    int32_t finite              # 0 where e holds a NaN or an infinity


cdef void judge_into(const blocks_t* p, const csr_t* a, const rows_t* r, bint factored, const double* lam, double* w,
                     double* e, double* v, bint floor, score_t* out) noexcept nogil
