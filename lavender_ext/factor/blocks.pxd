"""A sparse matrix of square blocks and its factor: patterns by block rows and columns, made by symbolic.pyx."""
from libc.stdint cimport int32_t


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
