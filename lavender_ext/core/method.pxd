"""A method as three functions on plain structs: workspace, start, step. Nothing here needs Python, allocates, or looks at a clock.

    view_t v          a problem: its blocks with d and nu, and one of A, bodies, J and M
    options_t o       which method, to what tolerance, with how much work
    workspace_t r          the caller's arrays
    workspace(&v, &o, &r)            -> r.n_index, r.n_real as a first guess; 0: the method does not take this problem
    start(&v, &o, &r, lambda)   -> MORE | NEEDS_WORKSPACE (r.n_index, r.n_real say how much; give it, start again) | an end
    step(&v, &o, &r, work, lambda, &s) -> MORE | another outcome, lambda the best so far

A start stores its findings in r.index before it knows the size of its workspace, once: r describes the problem (`laid`) from
the first NEEDS_WORKSPACE on that asks for no more integers. A method keeps its state in r, which must not move between the start
and the last step, nor may the arrays of v.
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.problem cimport Data
from lavender_ext.core.view cimport view_t


cdef enum:                      # outcomes
    MORE = 0
    REACHED = 1                 # tol
    ROUNDOFF_LIMIT = 2                   # within twice what rounding leaves
    STUCK = 3
    CERTIFICATE = 4             # `direction` may prove that there is no solution: the caller looks, and calls again
    SPENT = 5                   # the budget, or `stop`
    NEEDS_WORKSPACE = 6
    UNFIT = 7                   # the method does not take this problem
    BROKEN = 8                  # a factor has no sound pivots
    LOST = 9                    # numbers are not finite


cdef struct options_t:
    int32_t method
    int32_t budget              # units of work
    int32_t proven              # the direction of a CERTIFICATE is a proof
    int32_t stop                # end with what is there
    int32_t wide                # four lanes are one instruction: the same bits, sooner
    double tol                  # relative residual
    double e0                   # error of doing nothing, as the judge has it: sqrt J
    double v0                   # m/s
    double most                 # doubles of one factor, above which the method does not take the problem
    double work                 # multiply-adds of one, above which it need not be laid out; 0: however many


cdef struct workspace_t:
    int64_t n_index
    int64_t n_real
    int32_t* index              # a multiple of 8 bytes
    double* real
    int32_t laid                # what follows is known, and stands in index
    int32_t tries               # layouts that were too small
    int32_t islands
    double work                 # multiply-adds of one factor


cdef struct said_t:             # since the start
    int32_t work                # in the method's unit
    int32_t factorisations
    int32_t rounds              # over J and M: of Coulomb friction,
    int32_t evaluations         # and of lambda along a line
    double relative             # residual of lambda, -1: not known
    const double* direction     # (m) N s of a CERTIFICATE, or NULL
    const double* tried         # (m) N s, the impulse that was judged last, or NULL


cdef struct method_t:
    int32_t (*workspace)(const view_t*, const options_t*, workspace_t*) noexcept nogil
    int32_t (*start)(const view_t*, const options_t*, workspace_t*, const double*) noexcept nogil
    int32_t (*step)(const view_t*, const options_t*, const workspace_t*, int32_t, double*, said_t*) noexcept nogil


cdef inline bint grant(workspace_t* r, int64_t n_index, int64_t n_real) noexcept nogil:
    """Is there as much? Else that is what is needed."""
    cdef bint enough = r.n_index >= n_index and r.n_real >= n_real and (r.real != NULL or n_real == 0)
    if not enough:
        r.n_index, r.n_real = n_index, n_real
    return enough


cdef class Method:
    cdef Data data
    cdef view_t view
    cdef options_t options
    cdef workspace_t space
    cdef said_t said
    cdef method_t own
    cdef readonly int how       # it stands: one of `OUTCOMES`
    cdef void aim(self, double tol, int budget) noexcept
