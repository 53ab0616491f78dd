"""Declarations of principal pivoting (`principal.pyx`): its state, results and operations."""
from libc.stdint cimport int32_t

from lavender_ext.core.deadline cimport deadline_t
from lavender_ext.core.arena cimport arena_t
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport csr_t
from lavender_ext.factor.linear cimport linear_t


cpdef enum:                     # results of rounds
    SOLVED = 0                  # no row is infeasible
    ROUNDS_USED = 1             # the rounds of the call are used up
    SMALL_PIVOT = 2             # a pivot is too small for a factorisation without a shift (s = 0)
    INDEFINITE = 3              # a pivot is negative
    STUCK = 4                   # the number of infeasible rows no longer falls


cdef enum:                      # state of a row: free, or at one of its bounds
    FREE = 0
    AT_LOWER = -1
    AT_UPPER = 1


ctypedef int32_t (*outside_factor_t)(void* outside, const int32_t* place, int32_t n_free, double shift) noexcept nogil
ctypedef void (*outside_solve_t)(void* outside, int32_t n_free, double* y) noexcept nogil


cdef struct pivoting_t:
    const csr_t* a              # The caller sets the first five fields before `bind_pivoting_arrays`.
    const blocks_t* p           # b, d, lower, upper
    int32_t band                # half bandwidth in the order of elimination; -1: no compiled factor
    const int32_t* order        # (n) row that is eliminated first, second, ...; NULL: 0, 1, ...
    int32_t n
    int32_t natural             # The order is 0, 1, ...
    linear_t linear             # system A_FF + s D_FF, factored as L D L^T, or as L U if A is not symmetric; the caller sets `tiny`
    int32_t* at                 # (n) state of each row: FREE | AT_LOWER | AT_UPPER
    int32_t* place              # (n) index of each row among the free rows, or -1
    double* x                   # (n) N s
    double* w                   # (n) m/s, slack (2) of principal.pyx
    double* f                   # (n) m/s, rounding of w: 2^-53 (|A| |x| + |b|)
    double* center              # (n) N s, centre of the proximal term
    double* y                   # (n) scratch
    double* size                # (n) d of the free rows, in the order of `place`
    int32_t n_free
    int32_t is_factored         # The factor belongs to the present free rows and shift.
    int32_t min_infeasible      # smallest number of infeasible rows so far
    int32_t patience            # remaining exchanges without a new smallest number of infeasible rows, before rounds are stuck
    int32_t exchanged           # number of changes of rows between free and a bound so far
    int32_t factorisations
    int32_t n_rounds
    deadline_t* deadline        # time at which rounds and compiled factors end, or NULL
    int32_t late                # The deadline has passed.
    void* outside               # owner of an outside factor, whose rows are the rows with a place >= 0, numbered as in A; or NULL
    outside_factor_t factor_outside     # returns the number of small pivots; -1 after the deadline
    outside_solve_t solve_outside       # y (n_free) <- solution


cdef bint has_passed_after_product(pivoting_t* s) noexcept nogil
cdef void bind_pivoting_arrays(pivoting_t* s, arena_t* a) noexcept nogil
cdef void set_diagonal_shift(pivoting_t* s, double shift) noexcept nogil
cdef void reset_exchange_patience(pivoting_t* s) noexcept nogil
cdef void factor_free_rows(pivoting_t* s, double* x) noexcept nogil
cdef void factor_all_rows(pivoting_t* s) noexcept nogil
cdef void solve_with_all_rows_free(pivoting_t* s) noexcept nogil
cdef int32_t guess_free_rows_by_sweeps(pivoting_t* s, const double* start, int32_t sweeps, int32_t max_rounds) noexcept nogil
cdef int32_t run_exchange_rounds(pivoting_t* s, int32_t max_rounds) noexcept nogil
cdef void compute_slack_and_rounding(pivoting_t* s) noexcept nogil
cdef void correct_free_row_solution(pivoting_t* s) noexcept nogil
cdef int32_t exchange_infeasible_rows(pivoting_t* s) noexcept nogil
