"""Stopping test of sweep solvers: the judge's arithmetic, at sweep counts that depend only on the residuals.

The first checks are at the start and after the first sweep. The start is projected on its bounds, and islands may begin from
the zero impulse instead (best.pxd). From the residuals r0, r of the last two checks, k sweeps apart,
the end is predicted after n more sweeps, r (r/r0)^(n/k) <= tol. The next check is after n/2 sweeps, but at least an eighth
of the sweeps done so far, and at most as many again or, from 64 sweeps on, a quarter of them. If the residual does not
fall, it is after that eighth. The relative
residual r decides:

    r <= tol                                        CONVERGED
    r of the best of each island (best.pxd) <= tol  CONVERGED, with these
    r not finite, or > 1e6 max(1, r of the first 8) DIVERGED; if E0 = 0 (r = 0 or inf), E not finite
    first pass <= tol < refined one (judge/refine.pxd)
        refined <= 2 floor and <= 1e-5              AT_FLOOR
        else floor > tol                            STALLED
    no better than the best so far, and
        best <= 1e-6 and best <= 2 floor            AT_FLOOR
        sweeps > 32 * sweeps of the best + patience, and no
        progress predicted (judge/progress.pxd)     STALLED

"Better": r is lower than ever, or E of an island that is not solved fell by 1 % since the last better check. Except at
CONVERGED by r, the impulse of best.pxd is restored. A check costs about one sweep. Checks are compiled once, in
`stopping_test.pyx`; `run_until_stop` is called by pointer.
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport view_t
from lavender_ext.judge.best cimport best_workspace_size, best_t, bind_best, restore_best_islands
from lavender_ext.judge.progress cimport progress_t


cpdef enum:
    RUNNING = 0
    CONVERGED = 1
    DIVERGED = 2
    STALLED = 3
    AT_FLOOR = 4


cpdef enum:
    LONG_RUN_SWEEPS = 64        # After so many sweeps, impulses that still grow may grow without end (best.pxd).


cdef enum:
    N_EARLY_SWEEPS = 8          # Residuals of these sweeps may rise, because the zero impulse is nearly a solution.


cdef struct stopping_test_t:
    int32_t total               # sweeps done
    int32_t check_at            # sweeps at the next check
    int32_t last_at             # sweeps at the last check
    int32_t best_at             # sweeps at the last better check, -1 before any
    int32_t patience            # minimum number of sweeps without a better check before a run stalls
    int32_t keeps_last          # the last iterate is returned by (2) of best.pxd
    int32_t has_failed          # the run has diverged or stalled
    int32_t again_at            # value of best_at at the last restart, 0 before any restart
    double start                # largest relative residual of checks in the first N_EARLY_SWEEPS sweeps
    double last                 # relative residual at the last check
    double best_relative        # relative residual of `best`
    double lowest               # lowest relative residual of all checks
    double reference_energy     # sqrt J, energy error of the zero impulse
    double reference_velocity   # m/s, velocity error of the zero impulse
    double relative_at_zero     # relative residual of the zero impulse
    best_t best
    double* marked              # (n) sqrt J, E of each island's best at the last better check
    double* w                   # (m) scratch
    double* e                   # (m) scratch
    double* v                   # scratch of `count_judge_scratch` doubles
    progress_t progress


ctypedef void (*sweep_t)(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil


cdef inline int64_t stopping_test_workspace_size(int64_t m, int64_t n) noexcept nogil:
    """Return the number of doubles that `begin_stopping_test` needs for m rows in n islands."""
    return best_workspace_size(m, n) + n + 2 * m


cdef inline void begin_stopping_test(stopping_test_t* s, const blocks_t* p, double reference_energy, double reference_velocity,
                                     double relative_at_zero, int32_t patience, double* workspace) noexcept nogil:
    """Initialise s before the first sweep; workspace (`stopping_test_workspace_size`)."""
    s.total = s.check_at = s.last_at = 0
    s.start = 0.0
    s.last = s.best_relative = s.lowest = 1.0 / 0.0
    s.best_at = -1
    s.again_at = s.keeps_last = s.has_failed = 0
    s.patience = patience
    s.reference_energy = reference_energy
    s.reference_velocity = reference_velocity
    s.relative_at_zero = relative_at_zero
    bind_best(&s.best, p, workspace)
    s.best.reference_energy = reference_energy
    s.marked = workspace + best_workspace_size(p.n_rows, s.best.n)
    s.progress.n = 0
    s.progress.last_at = s.progress.before_at = -1
    s.progress.last = s.marked + s.best.n
    s.progress.before = s.progress.last + p.n_rows


cdef inline bint restart_if_stalled(stopping_test_t* s, int32_t patience) noexcept nogil:
    """Return whether a STALLED run may restart from its best impulse without memory, once for each best impulse.

    This is for accelerated sweeps: their memory may be the reason of the stall. They get `patience` sweeps to find a better
    impulse.
    """
    if s.best_at <= s.again_at:
        return False
    s.again_at = s.best_at
    s.patience = s.total - 32 * s.best_at + patience
    return True


cdef inline void restore_at_end(stopping_test_t* s, const view_t* v, double* lam, double tol) noexcept nogil:
    """Replace lam (m), scored in `best.now` with slack `w`, by the impulse of best.pxd after the end of a run."""
    restore_best_islands(&s.best, v, s.w, lam, tol, s.keeps_last, s.has_failed or s.total >= LONG_RUN_SWEEPS)


cdef int32_t check_start(stopping_test_t* s, const view_t* v, const view_t* confirm, double* lam, double tol) noexcept nogil
cdef int32_t run_until_stop(stopping_test_t* s, const view_t* v, const view_t* confirm, sweep_t sweep, void* context,
                            double* lam, int32_t n, double tol, int32_t* done) noexcept nogil


cdef class StoppingTest:
    cdef object keep
    cdef view_t view, other
    cdef const view_t* confirm  # address of `other`, or NULL if no status needs confirmation in another form
    cdef stopping_test_t state
