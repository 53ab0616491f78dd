"""The method of the solver `direct`, step by step, without Python (states in direct.pyx).

    t.v, t.e0, t.v0, t.least, t.sweeps, t.linear, t.symmetric, and a, p, band, order, linear.tiny of t.s are set
    bind_direct_arrays(&t, &arena)                  twice: to count, and with memory (core/arena.pxd)
    begin_direct_solve(&t, start), or begin_bound_exchanges(&t) from the bounds in t.s.at
    step_direct_solve(&t, max_rounds)               until t.is_over

After each step `best` is the best judged impulse.
"""
from libc.stdint cimport int32_t

from lavender_ext.core.arena cimport arena_t
from lavender_ext.core.problem cimport Data
from lavender_ext.core.view cimport view_t
from lavender_ext.judge.score cimport score_t
from lavender_ext.pivot.principal cimport pivoting_t


cpdef enum:                     # results of a step, in addition to those of rounds (principal.pxd)
    PASS_HALVED = 5             # A pass has halved the best residual; another pass follows.
    PASS_ENDED = 6              # A pass has not halved the best residual. Its change `step` may be a certificate.
    PASSES_USED = 7             # All passes are used up, or the last passes did not lower the residual.
    CYCLING = 8                 # Exchanges are stuck. A is not symmetric, so there is no energy to descend on.


cdef enum:                      # states
    GUESS = 0
    EXCHANGE = 1
    PASS = 2
    DESCENT = 3


cdef struct direct_t:
    pivoting_t s
    view_t v                    # the problem that is judged
    double e0                   # energy error of the zero impulse, sqrt J
    double v0                   # velocity error of the zero impulse, m/s
    double least                # A smaller relative residual is not refined, whatever the round-off floor is.
    int32_t sweeps              # symmetric sweeps that guess the free rows
    int32_t linear              # Every row is free.
    int32_t symmetric           # A is symmetric.
    double* start               # (m) N s
    double* x                   # (3 m) impulse that was judged last [N s], its slack [m/s], its error [N s]
    double* best                # (3 m) impulse, slack and error with the smallest residual so far
    double* origin              # (m) N s, start of a step of descent
    double* slope               # (m) m/s, w at `origin`
    double* step                # (m) N s, step of a descent; after a pass, the change of the impulse in this pass
    double* scratch             # scratch memory of the judge
    int32_t* side               # (m) scratch of a step of descent
    score_t score               # of `best`
    double relative             # relative residual of `best`
    double floor                # relative round-off floor of `best`
    double now                  # relative residual of `x`
    int32_t state
    int32_t is_over
    int32_t rank                # rank of a singular A with all rows free; otherwise 0
    int32_t solved              # Exchanges have ended without a shift of the diagonal.
    int32_t swept               # The free rows were guessed by sweeps.
    int32_t refined             # number of corrections of the free rows by refinement
    int32_t shifts
    int32_t searches            # number of step lengths that line searches tried
    int32_t next_shift          # index of the next shift in `get_proximal_shift`; N_SHIFTS: the shift does not change any more
    double larger_shift         # If this is positive, it is the next shift.
    int32_t passes              # number of passes begun
    int32_t waited              # number of passes since the best residual was last halved
    int32_t descent_steps       # number of steps of descent in this pass
    int32_t is_pass_over        # The next step begins a pass.
    double halved_from          # residual that the next pass has to halve


cdef void bind_direct_arrays(direct_t* t, arena_t* a) noexcept nogil
cdef void begin_direct_solve(direct_t* t, const double* start) noexcept nogil
cdef void begin_bound_exchanges(direct_t* t) noexcept nogil
cdef int32_t step_direct_solve(direct_t* t, int32_t max_rounds) noexcept nogil
cdef int32_t is_solved_to_rounding(const direct_t* t) noexcept nogil
cdef void judge_iterate(direct_t* t) noexcept nogil


cdef class Pivoting:
    cdef direct_t t
    cdef Data p, judged
    cdef object reals, ints, order, outside, error, deadline

    cdef int raise_error(self, int32_t code) except -1
