"""Interface of an iterative method: three functions on plain structs that neither use Python nor allocate.

    view_t v                      the problem: blocks with d and nu, and one of A, bodies, J and M
    options_t o                   method, tolerance, budget
    workspace_t r                 arrays that the caller allocates
    workspace(&v, &o, &r)         estimates r.n_index and r.n_real; returns 0 if the method does not accept the problem
    start(&v, &o, &r, lambda)     returns MORE, NEEDS_WORKSPACE (allocate r.n_index and r.n_real, then start again) or another
                                  outcome
    step(&v, &o, &r, work, lambda, &s)      returns MORE or another outcome; lambda is the best impulse so far

`start` analyses the structure of the problem once and stores the result in r.index, before it can compute the size of the
remaining workspace: r.is_bound is set from the first NEEDS_WORKSPACE that does not request more integers. A method keeps its
state in r. Neither r nor the arrays of v may move between `start` and the last `step`.
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.deadline cimport Deadline, deadline_t
from lavender_ext.core.problem cimport Data
from lavender_ext.core.view cimport view_t


cdef enum:                      # outcomes
    MORE = 0
    REACHED = 1                 # the residual is at most tol
    ROUNDOFF_LIMIT = 2          # the residual is within twice the round-off floor
    STUCK = 3                   # the method makes no progress
    CERTIFICATE = 4             # `direction` may prove that no solution exists: the caller checks it, and may step again
    SPENT = 5                   # the budget is used up, `stop` is set, or the deadline has passed
    NEEDS_WORKSPACE = 6
    UNFIT = 7                   # the method does not accept this problem
    BROKEN = 8                  # a factorisation has no acceptable pivots
    LOST = 9                    # a number is not finite


cdef struct options_t:
    int32_t method
    int32_t budget              # maximum units of work
    int32_t proven              # the caller confirmed that the direction of a CERTIFICATE is a proof
    int32_t stop                # the next step ends with the present result
    int32_t wide                # 1: use instructions for four doubles, which the processor has; the results have the same bits
    double tol                  # relative residual
    double e0                   # judge's energy error of the zero impulse, sqrt J
    double v0                   # judge's velocity error of the zero impulse, m/s
    double most                 # maximum doubles of one factor; the method does not accept a problem that needs more
    double work                 # multiply-adds of one factor above which no workspace is bound; 0: no limit
    deadline_t* deadline        # time at which a step ends with the present result, or NULL
    const void* host            # functions of a caller that this method calls, or NULL


cdef struct workspace_t:
    int64_t n_index
    int64_t n_real
    int32_t* index              # a multiple of 8 bytes
    double* real
    int32_t is_bound            # the structure is analysed, and the following fields are known
    int32_t tries               # number of layouts that were too small
    int32_t islands
    double work                 # multiply-adds of one factor


# Provide at least these sizes, with the content of the integers unless they grow; return 0 if there is not enough memory.
ctypedef public int32_t (*grow_t)(workspace_t* memory, int64_t n_index, int64_t n_real) noexcept nogil


cdef struct info_t:             # statistics since the start
    int32_t work                # units of work of the method
    int32_t factorisations
    int32_t rounds              # over J and M: friction updates of Coulomb's law
    int32_t evaluations         # over J and M: line search evaluations
    double relative             # relative residual of lambda, -1 if unknown
    const double* direction     # (m) N s, direction of a CERTIFICATE, or NULL
    const double* tried         # (m) N s, the impulse that was judged last, or NULL


cdef struct method_t:
    int32_t (*workspace)(const view_t*, const options_t*, workspace_t*) noexcept nogil
    int32_t (*start)(const view_t*, const options_t*, workspace_t*, const double*) noexcept nogil
    int32_t (*step)(const view_t*, const options_t*, const workspace_t*, int32_t, double*, info_t*) noexcept nogil


cdef inline bint require_workspace(workspace_t* r, int64_t n_index, int64_t n_real) noexcept nogil:
    """Return whether r has n_index int32 and n_real doubles of workspace; if not, store these sizes in r."""
    cdef bint is_enough = r.n_index >= n_index and r.n_real >= n_real and (r.real != NULL or n_real == 0)
    if not is_enough:
        r.n_index, r.n_real = n_index, n_real
    return is_enough


cdef class Method:
    cdef Data data
    cdef view_t view
    cdef options_t options
    cdef workspace_t space
    cdef workspace_t memory     # in which `space` is
    cdef info_t info
    cdef method_t own
    cdef readonly Deadline deadline     # of `options.deadline`
    cdef readonly int how       # the last outcome: one of `OUTCOMES`
    cdef int32_t analyse(self)
