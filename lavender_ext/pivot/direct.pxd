"""What `direct` does, call by call: rounds, passes and descent of pivot/direct.pyx, each judged.

    direct_lay(&t, ...)                       arrays of the caller's, `direct_real` and `direct_index` long
    direct_begin(&t, start)
    direct_turn(&t, n)                        until it is over: all of the below, one of them at a time

    direct_factor, direct_linear              where every row is free
    direct_first, then direct_rounds          else, while they say ROUNDS
    direct_begin_passes, then direct_pass     where A is singular or rounds are stuck, while they do not say SOLVED

The best judged impulse stands in `best` after each call.
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.problem cimport Data
from lavender_ext.core.view cimport csr_t, view_t
from lavender_ext.judge.score cimport score_t
from lavender_ext.pivot.principal cimport pivoting_t


cpdef enum:                     # outcomes of a pass, behind those of rounds
    HALVED = 5                  # the best residual: another pass
    PASSED = 6                  # it did not: `turn` may be a certificate
    SPENT = 7                   # all passes, or the last ones gained nothing
    CIRCLES = 8                 # STUCK for good: A is not symmetric, so no energy to descend on


cdef struct direct_t:
    pivoting_t s
    view_t v                    # as the judge reads it
    double e0                   # errors of doing nothing
    double v0
    double least                # relative residual that is good whatever the floor
    int32_t sweeps              # symmetric ones that guess the free rows
    int32_t linear              # every row is free
    int32_t symmetric           # A is
    double* start               # (m) N s
    double* x                   # (3 m) judged last: N s, its slack m/s, its error N s
    double* best                # (3 m) the same of the least residual
    double* origin              # (m) N s, of a step of descent,
    double* slope               # (m) m/s, w there
    double* turn                # (m) N s, that step; then what the last pass changed
    double* scratch             # of the judge
    int32_t* side               # (m)
    score_t score               # of best,
    double relative             # its relative residual,
    double floor
    double now                  # and that of x
    int32_t stage               # of turns
    int32_t rank                # of A, all rows free, where that is singular; else 0
    int32_t solved              # exchanges came to an end without a shift
    int32_t swept
    int32_t refined
    int32_t shifts
    int32_t searches            # steps tried along a line
    int32_t stuck               # passes descend,
    int32_t at                  # the next shift of the path, or
    double next                 # this one
    int32_t passes
    int32_t waited              # passes since the best residual was halved
    int32_t fresh               # the next call begins a pass
    double reference


cdef int64_t direct_real(const view_t* v, int64_t band) noexcept nogil
cdef int64_t direct_index(const view_t* v) noexcept nogil
cdef void direct_lay(direct_t* t, const view_t* v, const csr_t* a, const blocks_t* p, int32_t band, const int32_t* order,
                     double tiny, double* real, int32_t* index) noexcept nogil
cdef void direct_begin(direct_t* t, const double* start) noexcept nogil
cdef void begin_exchanges(direct_t* t) noexcept nogil
cdef int32_t is_end(const direct_t* t) noexcept nogil
cdef void judge_now(direct_t* t) noexcept nogil
cdef int32_t after_rounds(direct_t* t, int32_t code) noexcept nogil
cdef int32_t direct_factor(direct_t* t) noexcept nogil
cdef int32_t direct_linear(direct_t* t) noexcept nogil
cdef int32_t direct_first(direct_t* t, int32_t sweeps, int32_t n) noexcept nogil
cdef int32_t direct_rounds(direct_t* t, int32_t n) noexcept nogil
cdef void direct_begin_passes(direct_t* t, int32_t stuck) noexcept nogil
cdef int32_t direct_pass(direct_t* t, int32_t n) noexcept nogil
cdef int32_t direct_turn(direct_t* t, int32_t n) noexcept nogil


cdef class Pivoting:
    cdef direct_t t
    cdef Data p, judged
    cdef object reals, ints, order, outside, error

    cdef int told(self, int32_t code) except -1
