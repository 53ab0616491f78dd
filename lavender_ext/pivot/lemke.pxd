"""Lemke's method for other compiled loops: memory of the caller's, then calls of `lemke_run` until it says DONE."""
from libc.stdint cimport int32_t, int64_t, uint64_t

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.pivot.direct cimport direct_t


cpdef enum:                     # why a call ends
    DONE = 0                    # a path ended at a solution to rounding, or all paths were followed
    PIVOTS = 1                  # all pivots used
    RAY = 2                     # nothing limits the entering variable: `lemke_ray` may be a certificate
    LATE = 3                    # the exchanges at the end of a path wait for a factor that was not begun


cdef struct dictionary_t:
    int32_t n
    int32_t rows                # the first n can leave; free ones behind them follow
    int64_t width               # of a row of t, at least n + 2
    double* t                   # (rows, width): n + 1 columns, then values of the basic variables
    int32_t* basic              # (n) variable of each row
    int32_t* nonbasic           # (n + 1) variable of each column
    int32_t* where              # (2 n + 1) row of a basic variable, -1 - column of others
    double tiny                 # entries below tiny times the largest of their column are zero
    int32_t entering            # column; at a ray the one that nothing limits


cdef struct lemke_t:
    dictionary_t d
    direct_t* t                 # the rows: what is judged, and the exchanges at the end of a path
    int32_t* row                # row of each place; of a cap the place that it is for
    int32_t* exchanged          # places whose w and s have exchanged their parts
    int32_t bounded             # places: so many bounded rows, then
    int32_t caps                # of those with two bounds one more, then free rows that no pivot reached,
    int32_t split               # second halves of these, then free rows that were eliminated
    int32_t stage
    int32_t paths               # begun
    int32_t pivots
    int32_t last                # pivots at which this path counts as lost
    uint64_t random


cdef int64_t lemke_real(const blocks_t* p) noexcept nogil
cdef int64_t lemke_index(const blocks_t* p) noexcept nogil
cdef void lemke_lay(lemke_t* l, direct_t* t, double* real, int32_t* index) noexcept nogil
cdef void lemke_begin(lemke_t* l) noexcept nogil
cdef int32_t lemke_run(lemke_t* l, int32_t pivots) noexcept nogil
cdef void lemke_judge(lemke_t* l) noexcept nogil
cdef void lemke_ray(const lemke_t* l, double* y) noexcept nogil
