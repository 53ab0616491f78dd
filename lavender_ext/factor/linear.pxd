"""One linear system A x = r with a dense, banded or sparse matrix, for every method that factors a matrix.

    kind     matrix                                       factor                                              source
    DENSE    full, row by row                             L L^T, or L U with row exchanges                    dense.pxd
    BAND     lower diagonals of a symmetric matrix        L D L^T, with the number of negative pivots         band.pxd
    ROWS     compressed rows of a symmetric pattern       L L^T, or L U with exchanges within supernodes      sparse.pxd
    BLOCKS   square blocks of a symmetric pattern         L L^T, or L U with exchanges within supernodes      blocks.pxd
    TREE     rows of kinematic trees                      L^T D L                                             core/tree.pxd

    analyse     `analyse_dense`, ... set kind, order, pattern and cost; of ROWS and BLOCKS `LinearSystem` and `analyse_blocks`
    factor      `factor_linear_system_matrix` factors A + shift D and returns the number of lost pivots               (1)
    solve       `solve_linear_system`; `solve_linear_system_checked` refines, and uses the fallback if (3) fails
    multiply    `multiply_by_system_matrix`                                                                                    (2)
    cost        multiply-adds of a factorisation, known after the analysis; L U takes twice those of L L^T
    sign        `compute_determinant_sign`, of det A

D = diag(d), or the identity if d is NULL. A pivot is lost if it does not exceed tiny d. L U of DENSE and ROWS is that of
D^-1/2 A D^-1/2. Exchanges within supernodes may lose digits that exchanges between all rows keep. A solution must satisfy

    max |r - A x| <= BACKWARD_TOLERANCE (max |A_ij| max |x| + max |r|)                                              (3)

The fallback is a factorisation by the caller. There is one: SuperLU of SciPy (`lavender/base/lu.py`).
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.arena cimport arena_t
from lavender_ext.core.deadline cimport deadline_t
from lavender_ext.factor.factors cimport block_matrix_t, interrupt_t, pivots_t, sparse_t


cdef enum:                      # kinds
    DENSE = 0
    BAND = 1
    ROWS = 2
    BLOCKS = 3
    TREE = 4

cdef enum:                      # factorisations
    NO_FACTOR = 0
    CHOLESKY = 1                # L L^T, L D L^T or L^T D L
    LU = 2
    CHOLESKY_OR_LU = 3          # DENSE only: L L^T, then L U if L L^T loses a pivot
    FALLBACK = 4


cdef struct fallback_t:         # factorisation by the caller
    void* at
    int32_t (*factor)(void* at) noexcept nogil              # factor the matrix; return whether that succeeded
    void (*solve)(void* at, double* x) noexcept nogil       # solves in place


cdef struct linear_t:
    int32_t kind
    int32_t n
    int32_t by                  # factorisation that the next `factor_linear_system_matrix` computes: CHOLESKY, LU or CHOLESKY_OR_LU
    int32_t wide                # use one instruction for four lanes
    double cost                 # multiply-adds of L L^T, L D L^T or L^T D L
    const double* d             # (n) diagonal of the metric D, or NULL
    double shift
    double tiny                 # A pivot of at most tiny d is lost.
    # result of the last factorisation
    int32_t factored            # CHOLESKY, LU, FALLBACK or NO_FACTOR
    pivots_t pivots             # statistics of the pivots; `small` counts the lost ones
    # fields of DENSE, BAND and TREE
    double* matrix              # DENSE (n, n), overwritten by L U; BAND (n, width) and TREE (left of the diagonal), overwritten
    double* lower               # DENSE: (`cholesky_workspace_size`) L L^T
    double* scale               # (n) DENSE with d: D^-1/2 or smallest pivots; may be d itself. TREE: 1 / D
    int32_t* swap               # (n) DENSE: row exchanges of L U
    int32_t width               # BAND: number of stored diagonals
    double* ahead               # BAND: a right-hand side that the factorisation solves with L, for one solve; or NULL
    double* diagonal            # (n) TREE: diagonal of A, then D
    const int32_t* lptr         # (n + 1) TREE: first entry of each row of L
    const int32_t* lidx
    # fields of ROWS and BLOCKS
    sparse_t rows
    block_matrix_t blocks
    double largest              # max |A_ij| of the last L U of ROWS
    const fallback_t* fallback  # factorisation by the caller, or NULL
    deadline_t* deadline        # time at which a factorisation ends, with lost pivots, or NULL


cdef inline double backward_tolerance() noexcept nogil:
    """Return BACKWARD_TOLERANCE of (3) [-], which allows thousands of roundings."""
    return 1e-12


cdef inline void analyse_dense(linear_t* f, int32_t n) noexcept nogil:
    """Set the order of a full matrix."""
    f.kind, f.n, f.cost = DENSE, n, <double>n * n * n / 6.0
    f.deadline = NULL


cdef inline void analyse_band(linear_t* f, int32_t n, int32_t width) noexcept nogil:
    """Set the order of a symmetric matrix with `width` diagonals at and below the main one."""
    f.kind, f.n, f.width, f.cost = BAND, n, width, 0.5 * n * width * width
    f.deadline = NULL


cdef int64_t cholesky_workspace_size(int32_t n) noexcept nogil
cdef int32_t analyse_rows(linear_t* f, int32_t n, const int32_t* indptr, const int32_t* indices, int64_t capacity,
                          arena_t* a) noexcept nogil
cdef void bind_rows_values(linear_t* f, int32_t nnz, arena_t* a) noexcept nogil
cdef double analyse_blocks(block_matrix_t* f, int32_t n, int32_t s, const int32_t* nptr, const int32_t* nind,
                           const int32_t* parent, const int32_t* lptr, arena_t* a) noexcept nogil
cdef void bind_block_factor_indices(block_matrix_t* f, arena_t* a) noexcept nogil
cdef void bind_block_factor_values(block_matrix_t* f, bint lu, int32_t wide, arena_t* a) noexcept nogil
cdef int32_t factor_linear_system_matrix(linear_t* f) noexcept nogil
cdef void solve_linear_system(linear_t* f, double* x) noexcept nogil
cdef void solve_transposed_linear_system(const linear_t* f, double* x) noexcept nogil
cdef int32_t solve_linear_system_checked(linear_t* f, const double* r, double* x, double* scratch) noexcept nogil
cdef void multiply_by_system_matrix(const linear_t* f, const double* x, double* y) noexcept nogil
cdef int32_t compute_determinant_sign(const linear_t* f) noexcept nogil


cdef class PythonCalls:
    cdef interrupt_t interrupt                          # for `supernodal_t.interrupt`
    cdef int32_t* stop                                  # set to 1 by an exception, or NULL
    cdef object error                                   # the first exception that has not been raised

    cdef void store_error(self, object error) noexcept
    cdef int raise_error(self) except -1


cdef class LinearSystem:
    cdef linear_t f
    cdef fallback_t calls
    cdef PythonCalls python                             # for ROWS: an exception ends a factorisation
    cdef readonly object indptr, indices                # pattern of ROWS
    cdef readonly object data                           # (nnz) entries of the last factor of ROWS
    cdef object analysis, numbers, upper, splu, other, held
    cdef readonly int64_t entries                       # number of values of L

    cpdef analyse(self)
    cdef int allocate_factor_memory(self, bint lu) except -1
