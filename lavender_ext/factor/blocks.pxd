"""Factors of sparse matrices: by dense panels, and of square blocks by block rows and columns; patterns by symbolic.pyx."""
from libc.stdint cimport int32_t, int64_t


cdef struct sparse_t:
    int32_t n                   # rows
    int32_t panels
    int32_t wide                # 1 where four lanes are one instruction
    int32_t lu
    const int32_t* order        # (n) row at each place
    const int32_t* place        # (n) place of each row
    const int32_t* first        # (panels + 1) places
    const int32_t* of           # (n) panel of a place
    const int32_t* rptr         # (panels + 1) places below a panel, ascending
    const int32_t* rows
    const int64_t* at           # (panels + 1) of a panel in `val`,
    const int64_t* beside       # (panels + 1) and of what is beside it in `up`
    double* val
    double* up                  # L U only
    double* temp                # what one panel takes from another, at most, or STRIP rows of one
    double* scale               # (n) L U: of each place; else the least pivot of each
    double* y                   # (n)
    int32_t* swap               # (n) L U: the place within the panel that came here
    int32_t* rel                # (n) row of a place in the present panel
    int32_t* head               # (panels) panels that take from a panel next
    int32_t* link               # (panels)
    int32_t* next               # (panels) first row not yet taken


cdef struct factor_t:
    int32_t n                   # block columns
    int32_t s                   # rows of a block, 1 to 6
    const int32_t* nptr         # (n + 1) blocks of row k of N, columns <= k, the diagonal last
    const int32_t* nind
    const int32_t* rptr         # (n + 1) pattern of row k of L, columns < k ascending
    const int32_t* rind
    const int32_t* lptr         # (n + 1) column of L, rows > j ascending
    const int32_t* lind
    double* nval                # lower blocks of N, row-major
    double* mval                # their mirror (upper blocks, transposed), unsymmetric only
    double* lval                # blocks of L, each transposed
    double* uval                # blocks of U, unsymmetric only
    double* dval                # (n) factored diagonal blocks
    double* work                # (n) blocks, zero between calls
    double* work2
    int32_t* pivot              # (n s), unsymmetric only
    int32_t* next               # (n)
    const sparse_t* super       # panels, or NULL: L then stands in `lval` and `dval`
    const int64_t* spot         # of each lower block of N in their values
