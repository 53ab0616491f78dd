"""Principal pivoting for other compiled loops: its state, its outcomes, and its steps by name."""
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport csr_t
from lavender_ext.factor.band cimport pivots_t


cpdef enum:                     # outcomes
    SOLVED = 0
    ROUNDS = 1                  # all rounds used
    SMALL = 2                   # a pivot too small for s = 0
    INDEFINITE = 3              # a negative pivot
    STUCK = 4                   # patience used up


cdef enum:                      # sides of a row
    FREE = 0
    AT_LOWER = -1
    AT_UPPER = 1


ctypedef int32_t (*refactor_t)(void* outside, const int32_t* place, int32_t n_free, double shift) noexcept nogil
ctypedef void (*resolve_t)(void* outside, int32_t n_free, double* y) noexcept nogil


cdef struct pivoting_t:
    const csr_t* a
    const blocks_t* p           # b, d, lower, upper
    int32_t n
    int32_t band                # half bandwidth in order of elimination
    const int32_t* order        # (n) row eliminated first, second, ...; not read where natural
    int32_t natural             # order is 0, 1, ...
    int32_t* swap               # (n) rows exchanged by LU; NULL: LDL^T, of a symmetric A
    int32_t* at                 # (n) FREE | AT_LOWER | AT_UPPER
    int32_t* place              # (n) place among the free rows, -1
    double* x                   # (n) N s
    double* w                   # (n) m/s, (2)
    double* f                   # (n) m/s, 2^-53 (|A| |x| + |b|): rounding of w
    double* center              # (n) N s
    double* y                   # (n) scratch
    double* size                # (n) d of the free rows, by place; of LU d^-1/2
    double* c                   # (n (band + 1)) factor; of LU (n_free, n_free)
    double shift                # s
    double tiny                 # pivots below tiny d are small
    int32_t n_free
    int32_t width
    int32_t is_factored         # of the present set and shift
    int32_t is_half_solved      # x holds what the factorisation made of b on its way
    pivots_t found
    int32_t best                # least number of infeasible rows so far
    int32_t patience
    int32_t exchanged           # rows that changed sides so far
    int32_t factorisations
    int32_t n_rounds
    int32_t late                # a factor was not begun
    void* outside               # whose factor it is, of the rows with a place, numbered as they stand, or NULL:
    refactor_t refactor         # how many of its pivots are small, -1: not begun
    resolve_t resolve           # y (n_free) <- the solve


cdef void pivots_on(pivoting_t* s, const csr_t* a, const blocks_t* p, int32_t band, const int32_t* order, double tiny,
                    double* real, int32_t* whole) noexcept nogil
cdef void pivots_renew(pivoting_t* s) noexcept nogil
cdef void factor_free(pivoting_t* s, double* x) noexcept nogil
cdef void pivots_factor_all(pivoting_t* s) noexcept nogil
cdef void pivots_solve_free(pivoting_t* s) noexcept nogil
cdef int32_t pivots_solve(pivoting_t* s, const double* start, int32_t sweeps, int32_t n, int32_t* swept) noexcept nogil
cdef int32_t pivots_rounds(pivoting_t* s, int32_t n) noexcept nogil
cdef void pivots_start(pivoting_t* s, double shift) noexcept nogil
cdef void pivots_restart(pivoting_t* s) noexcept nogil
cdef void pivots_slack(pivoting_t* s) noexcept nogil
cdef void pivots_correct(pivoting_t* s) noexcept nogil
cdef int32_t pivots_exchange(pivoting_t* s) noexcept nogil
