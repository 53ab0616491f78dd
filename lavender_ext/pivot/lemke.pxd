"""Declarations of Lemke's method: bind the arrays, then call `follow_lemke_paths` until it returns DONE.

The states are in lemke.pyx.
"""
from libc.stdint cimport int32_t, int64_t, uint64_t

from lavender_ext.core.arena cimport arena_t
from lavender_ext.pivot.direct cimport direct_t


cpdef enum:                     # results of `follow_lemke_paths`
    DONE = 0                    # the residual is at rounding, or every path has ended
    PIVOTS = 1                  # the pivots of the call are used up
    RAY = 2                     # no variable leaves: the ray may be a certificate
    LATE = 3                    # the deadline has passed
    EXCHANGES = 4               # the exchanges at the end of a path need another call, which does not count as pivots


cdef struct dictionary_t:
    int32_t n_pairs
    int32_t n                   # rows, and columns of pairs, in use; the retired ones of free rows follow
    int64_t width               # length of a row of t
    double* t                   # (n_pairs, width): column of z, values of the basic variables, columns of the nonbasic variables
    int32_t* basic              # (n_pairs) variable of each row
    int32_t* nonbasic           # (n_pairs + 2) variable of each column; the column of values has no variable
    int32_t* position           # (2 n_pairs + 1) row of a basic variable; -1 - column of a nonbasic variable
    int32_t* initial            # (n) basic variables before the path
    int32_t entering            # column of the entering variable; after a ray, the column that no row limits, or NO_COLUMN


cdef struct lemke_t:
    dictionary_t d
    direct_t* t                 # solver of the rows: judges impulses, and makes the exchanges at the end of a path
    int32_t* row                # row of each pair; pair of each cap
    int32_t n_bounded           # number of pairs of bounded rows; pairs of caps and of free rows follow
    int32_t n_caps
    int32_t state
    int32_t n_paths             # number of paths begun
    int32_t n_pivots
    uint64_t random
    int32_t max_pivots          # A path ends without a result after this many pivots.


cdef void bind_lemke_arrays(lemke_t* l, direct_t* t, arena_t* a) noexcept nogil
cdef void begin_lemke_solve(lemke_t* l) noexcept nogil
cdef int32_t follow_lemke_paths(lemke_t* l, int32_t pivots) noexcept nogil
cdef void judge_unfinished_path(lemke_t* l) noexcept nogil
