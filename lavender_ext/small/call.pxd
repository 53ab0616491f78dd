"""Solver call for small problems: `derive_small_problem` once, then `solve_small` from any start, on a copy for each thread."""
from libc.stdint cimport int32_t

from lavender_ext.core.deadline cimport deadline_t
from lavender_ext.core.method cimport workspace_t
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport view_t
from lavender_ext.judge.score cimport score_t


cdef enum:
    N_COUNTS = 8                # counters of one call

cdef enum:                      # result code of a call
    RESULT_FAILED = 0           # The relative residual is above tol: there is no result.
    RESULT_SOLVED = 1
    RESULT_IS_START = 2         # the start is a solution and was not changed


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


cdef struct small_problem_t:
    view_t v                    # problem that the judge reads
    view_t over                 # problem that is solved; for bounded rows, A in compressed rows
    double zero_residual[3]     # E0, V0, relative residual of the zero impulse
    int32_t band                # half bandwidth of A for bounded rows; m - 1 if A is not symmetric
    int32_t split               # number of joint blocks, which are swept before the contacts
    bint by_island              # `v.p.islands` are solved one by one
    bint pivots, linear, symmetric      # all rows are bounded; all rows are free; A is symmetric
    const int32_t* at           # offsets into `prepared` if blocks are solved exactly (`prepare_exact_blocks`), else NULL
    const double* prepared
    score_t score               # score of the result
    double relative, floor


cdef struct solve_workspaces_t:
    workspace_t work
    workspace_t more            # workspace of Newton's method, or of Lemke's paths


cdef bint can_use_small_call(const blocks_t* p) noexcept nogil
cdef bint are_all_rows_bounded(const blocks_t* p) noexcept nogil
cdef bint derive_small_problem(small_problem_t* s, workspace_t* workspace) noexcept nogil
cdef void judge_small_impulse(small_problem_t* s, const double* lam, double* both, double* scratch) noexcept nogil
cdef int32_t solve_small(small_problem_t* s, const small_rules_t* rules, double* own, bint cold, double tol, deadline_t* deadline,
                         double* both, solve_workspaces_t* workspaces, int32_t* counts) except -1 nogil


cdef class Rules:
    cdef small_rules_t at
