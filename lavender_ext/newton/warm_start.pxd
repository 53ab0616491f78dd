"""A warm start carried to the judge's tolerance, on the factored form: few sweeps, or one banded solve.

    judge        lam as it came: relative residual max(E/E0, V/V0) <= tol?                      (1)
    contacts     sequential impulses, judged after 4, 8, 16, 32 and 64 sweeps; from 16 on given up
                 where r_s (r_s / r_s/2)^(2 (64 - s)/s), what 64 would leave, is above tol       (2)
    free joints  A lam = b by LDL^T on the band of A, one round of refinement                   (3)

An impulse is scored by the judge's own lines (judge/measure.pyx, judge/score.pxd): the residual found here is the
judge's. What is not decided here (dependent joints, numbers near the ends of the range, a residual that stays above
tol) is left to the caller, with lam as it came.
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport rows_t


cpdef enum:
    FIRST_SWEEPS = 4            # of (2); fewer leave a residual just below tol, and the next step begins above it
    PATIENT_SWEEPS = 16         # from here on (2) is given up where it will not do
    MOST_SWEEPS = 64
    MOST_ROWS = 200000          # so that all of it takes a fraction of a second
    MOST_BAND = 48              # rows between the first and the last of one body's joints, for (3)
    MOST_TRACED = 256           # scores of one solve that are noted

cpdef enum:                     # how it ended
    UNDECIDED = 0
    JUDGED = 1                  # met tol as it came
    SWEPT = 2                   # met it after some sweeps
    SOLVED = 3                  # met it after one factorisation
    FACTORED = 5                # met it after turns of Newton's method (engine/newton_substep.pyx)


cdef struct warm_t:
    double* kept                # (m) lam as it came
    double* band                # (m, width) of (3)
    double* slack               # (m) w of the impulse that was scored last
    double* error               # (m) e of it
    int32_t* last               # (n_bodies) last joint seen on a body
    int32_t* before             # (2 kj) the one before on the same body: 2 joint + side, or -1
    int32_t width               # of the band, 0 where (3) does not apply
    int32_t sweeps              # done
    int32_t factorisations      # done
    double relative             # of lam as it is left
    double* trace               # (MOST_TRACED, 3) or NULL: sweeps and factorisations so far, E [sqrt J], max |e_n| [N s]
    int32_t traced              # scores noted


cdef inline int64_t room_of(const blocks_t* p, int32_t width) noexcept nogil:
    # doubles that `lay_out` hands out
    return (3 + <int64_t>width) * p.n_rows


cdef inline void bind_warm_workspace(warm_t* s, double* real, int32_t* index, const blocks_t* p, const rows_t* r) noexcept nogil:
    # index (n_bodies + 2 joints)
    s.kept = real
    s.slack = real + p.n_rows
    s.error = s.slack + p.n_rows
    s.band = s.error + p.n_rows
    s.last = index
    s.before = index + r.n_bodies


cdef int32_t start_errors(const blocks_t* p, double* energy, double* velocity) noexcept nogil
cdef void observe(const blocks_t* p, const rows_t* r, const warm_t* s, double* residual,
                         double* violation) noexcept nogil
cdef int32_t band_width(const blocks_t* p, const rows_t* r, int32_t* last) noexcept nogil
cdef double judged(const blocks_t* p, const rows_t* r, warm_t* s, const double* lam, double* v, double e0,
                          double v0) noexcept nogil
cdef int32_t warm_solve(const blocks_t* p, const rows_t* r, warm_t* s, double tol, double* lam, double* v,
                               int32_t has_velocity) noexcept nogil
