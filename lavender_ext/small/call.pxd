"""The call of few rows for other compiled loops: `lay_few` once, then `run_few` from any start, by any thread on its own copy."""
from libc.stdint cimport int32_t

from lavender_ext.core.method cimport workspace_t
from lavender_ext.core.parts cimport blocks_t
from lavender_ext.core.view cimport view_t
from lavender_ext.judge.score cimport score_t


cdef enum:
    COUNTS = 8                  # of one call

cdef enum:                      # how it ended
    FAILED = 0                  # not below tol: nobody's result
    ENDED = 1
    KEPT = 2                    # where it started, which is a solution


cdef struct few_rules_t:        # what is asked for
    int32_t rows                # more have no call but as islands
    int32_t swept               # sweeps before the first factors
    double warm                 # relative residual from which pivots start
    bint pivots                 # bounded rows
    bint follows                # friction: another method comes next; a start that is a solution is the result, a bad one no start


cdef struct few_t:
    view_t v                    # as the judge reads it
    view_t over                 # what is solved: of bounded rows A
    double begin[3]             # E0, V0, relative residual of doing nothing
    int32_t band                # half bandwidth, of bounded rows: m - 1 where A is not symmetric
    int32_t split               # blocks before it are swept before the others: joints, contacts
    bint pivots, linear, symmetric      # bounded rows; all of them free; A
    const int32_t* at           # of blocks that are solved exactly, as gauss_seidel.prepare has them; else NULL
    const double* prepared
    score_t score               # of the result
    double relative, floor


cdef struct rooms_t:
    workspace_t work
    workspace_t more                 # of Newton's method, or of paths


cdef bint has_call(const blocks_t* p) noexcept nogil
cdef bint are_bounded(const blocks_t* p) noexcept nogil
cdef bint lay_few(few_t* s, workspace_t* workspace) noexcept nogil
cdef void judge_few(few_t* s, const double* lam, double* both, double* scratch) noexcept nogil
cdef int32_t run_few(few_t* s, const few_rules_t* rules, double* own, bint cold, double tol, double most, double* both,
                     rooms_t* rooms, int32_t* counts) noexcept nogil


cdef class Rules:
    cdef few_rules_t at
