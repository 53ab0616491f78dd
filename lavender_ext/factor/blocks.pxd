"""A sparse matrix of square blocks and its factor: patterns by block rows and columns, made by symbolic.pyx."""
from libc.stdint cimport int32_t, int64_t


cdef struct supernodes_t:       # block columns of one pattern, as dense panels (supernodal.pxd)
    int32_t n                   # panels
    int32_t wide                # 1 where four lanes are one instruction
    const int32_t* first        # (n + 1) block columns
    const int32_t* of           # (blocks) panel of a block column
    const int32_t* rptr         # (n + 1) block rows below a panel, ascending
    const int32_t* rows
    const int32_t* height       # (n) rows of a panel
    const int64_t* at           # (n + 1) of a panel in `val`
    const int64_t* spot         # of each lower block of N in `val`
    double* val
    double* temp                # what one panel takes from another, at most
    int32_t* place              # (blocks) first row of a block row in the present panel
    int32_t* head               # (n) panels that take from a panel next
    int32_t* link               # (n)
    int32_t* next               # (n) first row not yet taken


cdef struct factor_t:
    int32_t n                   # block columns
    int32_t s                   # rows of a block, 1 to 6
    const int32_t* nptr         # (n + 1) blocks of row k of N, columns <= k ascending, the diagonal last
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
    const supernodes_t* super   # or NULL: L then stands in `lval` and `dval`
