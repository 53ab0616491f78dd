"""One problem of a compiled call, the settings of the call, and its workspaces, which grow to the arrays of an arena."""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.arena cimport arena_t, make_arena
from lavender_ext.core.deadline cimport deadline_t
from lavender_ext.core.method cimport workspace_t
from lavender_ext.core.block_types cimport islands_t
from lavender_ext.core.problem cimport derived_t
from lavender_ext.core.view cimport csr_t, generalized_t, rows_t, view_t
from lavender_ext.host cimport grow_workspace_to
from lavender_ext.judge.measure cimport count_judge_scratch
from lavender_ext.judge.score cimport score_t


cdef enum:
    N_COUNTS = 8                # counters of one call

cdef enum:                      # counters of a call over J and M; those over A and bodies are in small/call.pyx
    COUNT_ITERATIONS = 0        # all sweeps and steps
    COUNT_FACTORISATIONS = 1    # Newton's method over velocities
    COUNT_ROUNDS = 2            # its Coulomb rounds
    COUNT_EVALUATIONS = 3       # evaluations of its line search
    COUNT_SWEEPS_OF_LANE = 4    # sweeps over rows in a lane
    COUNT_STEPS_OF_LANE = 5     # Newton steps over rows in a lane, a factorisation each

cdef enum:                      # result code of a call
    RESULT_FAILED = 0           # The relative residual is above tol: there is no result.
    RESULT_SOLVED = 1
    RESULT_IS_START = 2         # the start is a solution and was not changed

cdef enum:                      # workspaces of one thread
    WORK = 0
    MORE = 1                    # workspace of Newton's method over A or bodies, or of Lemke's paths
    ISLANDS = 2                 # islands and their references
    NUMBERS = 3                 # A, d, nu and step
    FORMED = 4                  # A of bodies
    BOUND = 5                   # workspace of `derive_small_problem`
    GIVEN_START = 5             # of J and M: the given start and the result, if the start may be returned instead
    N_CALL_WORKSPACES = 6


cdef struct small_rules_t:      # numbers of lavender/solvers/decisions.py by their names, and the kind of call
    int32_t small_rows
    int32_t call_sweeps
    int32_t call_island_rows
    int32_t call_factorisations
    int32_t call_extrapolation
    double warm_residual
    bint pivots                 # solve problems in which all rows are bounded
    # Another method follows, which also solves friction. Then a start that is a solution is returned, and a start with a
    # larger residual than the zero impulse is replaced by the zero impulse.
    bint follows


cdef struct task_t:             # one problem, its start and its result
    view_t v                    # problem that the judge reads
    view_t over                 # bounded rows without J and M: A in compressed rows, which is solved
    csr_t a                     # A, the bodies, or J and M, unless `v` points into a `Data`
    rows_t r
    generalized_t g
    const double* dense         # A (m, m), to be converted to `a`, or NULL
    derived_t made              # derived numbers over J and M; n_empty for every problem
    bint has_derived            # the derived numbers are valid for this problem
    double zero_residual[3]     # E0, V0, relative residual of the zero impulse; E0 < 0: not known
    islands_t islands           # target of v.p.islands, if this call computed the islands
    double* by_island           # NULL, or the array (islands, 2) that `score_t.by_island` points to
    bint failed_in_lanes        # lanes have not solved the task: a lane alone has the same result
    # start, result
    double tol                  # relative residual to reach
    deadline_t* deadline        # time at which the present iterate is the result, or NULL
    bint cold                   # start from the zero impulse instead of lam
    double* lam                 # (m) N s
    double* slack_error         # (2 m + 1) w, e
    const double* push          # (n) M^-1 J^T lam over J and M; in workspace that the next problem reuses
    bint solved                 # relative residual and floor are at most tol
    int32_t counts[N_COUNTS]
    score_t score
    double relative, floor, above_floor
    double float64_relative     # relative residual of the first pass; NaN if it was not refined
    # without J and M, by `derive_small_problem`
    int32_t band                # half bandwidth of A for bounded rows; m - 1 if A is not symmetric
    int32_t split               # number of joint blocks, which are swept before the contacts
    bint solves_islands         # the islands are solved one by one
    bint pivots, linear, symmetric      # all rows are bounded; all rows are free; A is symmetric
    const int32_t* at           # offsets into `prepared` if blocks are solved exactly (`prepare_exact_blocks`), else NULL
    const double* prepared


cdef inline int64_t count_task_scratch(const task_t* j) noexcept nogil:
    """Return the number of doubles of scratch of `judge_task`."""
    return (j.v.g.n if j.v.g != NULL else 0) + count_judge_scratch(&j.v)


cdef inline bint fits_workspace(const workspace_t* r, const arena_t* a) noexcept nogil:
    """Return whether the arrays that were taken from an arena are within the workspace in which it began."""
    return a.n_index <= r.n_index and a.n_real <= r.n_real


cdef inline bint grow_workspace_to_arena(workspace_t* r, arena_t* a) noexcept nogil:
    """Grow the workspace to the sizes that an arena has counted, and begin the arena in it; return False if out of memory."""
    if not grow_workspace_to(r, a.n_index, a.n_real):
        return False
    a[0] = make_arena(r.real, r.index)
    return True
