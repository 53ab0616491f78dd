"""Solve from a warm start over bodies to the judge's tolerance by a few sweeps or one banded factorisation.

    start        accept lam unchanged if its relative residual max(E/E0, V/V0) <= tol            (1)
    contacts     sequential impulses, judged after 4, 8, 16, 32 and 64 sweeps; from 16 on they end
                 if r_s (r_s / r_s/2)^(2 (64 - s)/s), the residual predicted for 64, exceeds tol  (2)
    free joints  A lam = b by LDL^T on the band of A, with one refinement                        (3)

Impulses are scored by the judge's functions (judge/measure.pyx, judge/score.pxd), so that the residual is the judge's.
If the joints are dependent, values are near the limits of their range, or the residual stays above tol, lam is
restored and the result is UNDECIDED.
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.arena cimport arena_t, take_doubles, take_integers
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.deadline cimport deadline_t
from lavender_ext.core.view cimport rows_t


cpdef enum:
    # Number of sweeps before the first check of (2). After fewer sweeps the residual is just below tol: the next step starts above.
    FIRST_SWEEP_CHECK = 4
    MIN_SWEEPS_TO_GIVE_UP = 16  # From this many sweeps on, the prediction of (2) is reliable.
    MAX_WARM_SWEEPS = 64        # If more sweeps are needed, Newton's method is faster.
    MAX_WARM_ROWS = 200000      # With more rows, the sweeps may take more than a fraction of a second.
    MAX_BAND_WIDTH = 48         # If the band of A is wider, (3) is not used.
    MAX_TRACED_SCORES = 256     # Largest number of judged impulses of one solve that are traced.

cpdef enum:                     # results
    UNDECIDED = 0
    JUDGED = 1                  # the start is within tol
    SWEPT = 2                   # within tol after sweeps
    SOLVED = 3                  # within tol after one factorisation
    FACTORED = 5                # within tol after Newton's method (engine/newton_substep.pyx)


cdef struct warm_t:
    double* given               # (m) the given start
    double* start               # (m) lam at the start, zero in islands in which the given start is worse
    double* band                # (m, width) band of A
    double* slack               # (m) slack w of the last judged impulse
    double* error               # (m) error e of the last judged impulse
    double* by_island           # (blocks, 2) relative residual and E of each island of the last judged impulse
    int32_t* last_joint         # (n_bodies) last joint on a body
    int32_t* previous_joint     # (2 joints) previous joint on the same body: 2 joint + side, or -1
    int32_t keeps_start         # without a result, lam is the given start
    int32_t width               # width of the band; 0 if (3) does not apply
    int32_t sweeps
    int32_t factorisations
    double relative             # relative residual of lam
    double* trace               # (MAX_TRACED_SCORES, 3) or NULL: work so far, E [sqrt J], max |e_n| [N s] of each score
    int32_t n_traced
    deadline_t* deadline        # time at which the sweeps or the factorisation end without a result, or NULL


cdef inline void bind_warm_start(warm_t* s, const blocks_t* p, const rows_t* r, arena_t* a) noexcept nogil:
    """Take the arrays; s.width is set, unless only the integers are used."""
    cdef int64_t m = p.n_rows
    s.start, s.slack, s.error, s.given = take_doubles(a, m), take_doubles(a, m), take_doubles(a, m), take_doubles(a, m)
    s.by_island, s.band = take_doubles(a, 2 * <int64_t>p.n_blocks), take_doubles(a, s.width * m)
    s.last_joint, s.previous_joint = take_integers(a, r.n_bodies), take_integers(a, 2 * <int64_t>r.n_joints)


cdef int32_t zero_impulse_errors(const blocks_t* p, double* energy, double* velocity) noexcept nogil
cdef void measure_as_engine(const blocks_t* p, const rows_t* r, const warm_t* s, double* residual,
                         double* violation) noexcept nogil
cdef int32_t compute_joint_bandwidth(const blocks_t* p, const rows_t* r, int32_t* last) noexcept nogil
cdef double judge_impulse(const blocks_t* p, const rows_t* r, warm_t* s, const double* lam, double* v, double e0,
                          double v0) noexcept nogil
cdef int32_t solve_from_warm_start(const blocks_t* p, const rows_t* r, warm_t* s, double tol, double* lam, double* v,
                               int32_t has_velocity) noexcept nogil
