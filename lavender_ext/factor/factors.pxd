"""Structs of the factors of `linear.pxd`, without the functions that compute them."""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.deadline cimport deadline_t


cdef extern from *:
    """
    #ifndef LAVENDER_HAS_WIDE
    #if defined(__GNUC__) && defined(__x86_64__) && !defined(LAVENDER_ONE_LANE)
    #define LAVENDER_HAS_WIDE() (__builtin_cpu_supports("avx512f") ? 2 : __builtin_cpu_supports("avx2") ? 1 : 0)
    #else
    #define LAVENDER_HAS_WIDE() 0
    #endif
    #endif
    """
    int has_wide "LAVENDER_HAS_WIDE"() noexcept nogil  # 1 or 2: instructions for four or eight lanes (`tiles.pxd`)


cdef struct pivots_t:
    int32_t small               # number of small pivots, at most tiny size_i; the solution is 0 in their rows
    int32_t negative            # number of negative pivots, with which solves work normally
    double least                # smallest p_i / size_i
    int32_t first_small         # index of the first small pivot, or -1


cdef inline void clear_pivot_statistics(pivots_t* out) noexcept nogil:
    """Set the statistics of a factorisation without pivots."""
    out.small = out.negative = 0
    out.least = 1.0 / 0.0
    out.first_small = -1


cdef struct interrupt_t:        # checks for signals during a factorisation, which may take minutes
    void* at
    int32_t (*is_requested)(void* at) noexcept nogil        # whether the factorisation must end
    double work                 # multiply-adds since the last check
    int32_t stopped             # A check has ended a factorisation; the caller resets it.


cdef struct supernodal_t:
    int32_t n                   # rows
    int32_t supernodes
    int32_t wide                # 1 or 2: use instructions for four or eight lanes
    # pattern
    const int32_t* order        # (n) row at each position; NULL: rows keep their order
    const int32_t* position     # (n) position of each row, or NULL likewise
    const int32_t* first        # (supernodes + 1) position of the first column of each supernode
    const int32_t* supernode_of     # (n) supernode of each position
    const int32_t* row_ptr      # (supernodes + 1) rows below a supernode: positions, ascending
    const int32_t* row_indices
    const int64_t* value_offset     # (supernodes + 1) offset of each panel in `values`
    const int64_t* upper_offset     # (supernodes + 1) offset in `upper` of the rows of U that belong to each panel
    # factor
    double* values
    double* upper               # rows of U; L U only
    double* scratch             # (`supernodal_scratch_size`)
    int32_t* swap               # (n) L U: index within the panel of the row that each pivot row was exchanged with
    # state of a factorisation
    int32_t* local_row          # (n) row index of each position within the present panel
    int32_t* head               # (supernodes) first of the descendants that update a supernode next
    int32_t* link               # (supernodes) next descendant in the same list
    int32_t* next_row           # (supernodes) first row of a supernode with an update that has not been done
    interrupt_t* interrupt      # checks for signals, or NULL
    deadline_t* deadline        # time at which a factorisation ends, or NULL


cdef struct sparse_t:
    supernodal_t factor
    const int32_t* indptr       # (n + 1) A in compressed rows, columns ascending
    const int32_t* indices
    double* data
    int32_t* tptr               # (n + 2) A^T in compressed rows; L U only
    int32_t* tind
    double* tdata
    double* scale               # (n) by position: diagonal of D^-1/2 for L U, otherwise the smallest accepted pivots
    double* y                   # (n) scratch of a solve


cdef struct block_matrix_t:
    int32_t n                   # block rows
    int32_t s                   # rows of a block, 1 to 6
    const int32_t* nptr         # (n + 1) blocks of row k of N: columns <= k, the diagonal block last
    const int32_t* nind
    double* nval                # lower blocks of N, row-major
    double* mval                # upper blocks of N, transposed; L U only
    const int64_t* lower_offset     # offset of each block in the factor's `values`
    const int64_t* upper_offset     # offset of each block's mirror: in `values` if both are in one supernode, otherwise in `upper`
    supernodal_t factor
