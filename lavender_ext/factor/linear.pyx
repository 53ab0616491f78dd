"""One linear system: the functions of `linear.pxd`, and the class `LinearSystem`, by which Python uses them."""
from cpython.exc cimport PyErr_CheckSignals
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t

import numpy as np

from lavender_ext.core.arena cimport arena_t, make_arena, take_doubles, take_integers
from lavender_ext.core.dot cimport dot
from lavender_ext.core.deadline cimport Deadline, get_pointer
from lavender_ext.core.tree cimport factor_tree_matrix
from lavender_ext.core.tree_solve cimport solve_tree_factor
from lavender_ext.core.validate cimport norm_inf
from lavender_ext.factor.band cimport back_substitute_all_band_ldl, factor_band_ldl, solve_band_ldl
from lavender_ext.factor.blocks cimport factor_blocks
from lavender_ext.factor.dense cimport (PANEL_COLUMNS, dense_cholesky, dense_cholesky_solve, dense_lu, dense_lu_solve,
                                        dense_lu_solve_transposed, panel_offset)
from lavender_ext.factor.factors cimport block_matrix_t, has_wide, interrupt_t, clear_pivot_statistics, supernodal_t
from lavender_ext.factor.linear cimport (BAND, BLOCKS, CHOLESKY, DENSE, FALLBACK, LU, NO_FACTOR, ROWS, TREE, PythonCalls,
                                         analyse_dense, backward_tolerance, fallback_t, linear_t)
from lavender_ext.factor.sparse cimport factor_sparse, solve_sparse
from lavender_ext.factor.supernodal cimport panel_width, rows_below, solve_supernodes, supernodal_scratch_size
from lavender_ext.factor.symbolic cimport find_supernodes, order_rows, list_factor_rows_by_column, list_supernode_rows


#: Largest accepted backward error (3) of `linear.pxd`.
BACKWARD_TOLERANCE = backward_tolerance()


cdef enum:
    MAX_REFINEMENTS = 1         # Largest number of refinements of a solution with L U of ROWS; after them the fallback is used.


# -- analyse and bind ----------------------------------------------------------------------------------------


cdef int64_t cholesky_workspace_size(int32_t n) noexcept nogil:
    """Return the number of doubles of L in its panels; at most n^2."""
    cdef int32_t k = n - 1 - (n - 1) % PANEL_COLUMNS if n > 0 else 0
    return panel_offset(n, k) + <int64_t>(n - k) * (n - k)


cdef inline int64_t* take_offsets(arena_t* a, int64_t count) noexcept nogil:
    """Take `count` int64 of an arena whose integers are aligned to 8 bytes."""
    take_integers(a, a.n_index % 2)
    return <int64_t*>take_integers(a, 2 * count)


cdef int32_t analyse_rows(linear_t* f, int32_t n, const int32_t* indptr, const int32_t* indices, int64_t capacity,
                          arena_t* a) noexcept nogil:
    """Set order and pattern of a factor of compressed rows of a symmetric pattern, n > 0, and the cost.

    The arena's integers are aligned to 8 bytes. Return 1; 0 if more than `capacity` integers are needed, at least
    a.n_index; -1 if L has 2^31 entries or more.
    """
    cdef int32_t nnz = indptr[n], workspace = nnz + nnz // 4 + n + 1, count, i, j, k, at = 0
    cdef int64_t below = 0                              # rows below all supernodes
    cdef supernodal_t* p = &f.rows.factor
    cdef int64_t* outside = take_offsets(a, n)
    cdef int32_t* begin = take_integers(a, n + 1)
    cdef int32_t* order = take_integers(a, n)
    cdef int32_t* size = take_integers(a, n)
    cdef int32_t* parent = take_integers(a, n)
    cdef int32_t* nptr = take_integers(a, n + 1)
    cdef int32_t* lptr = take_integers(a, n + 1)
    cdef int32_t* group = take_integers(a, n + 1)
    cdef int32_t* nind = take_integers(a, nnz // 2 + n + 1)
    cdef int32_t* scratch = take_integers(a, 11 * <int64_t>n + 3 + workspace)
    cdef int32_t* lind
    f.kind, f.n, f.rows.indptr, f.rows.indices = ROWS, n, indptr, indices
    if a.n_index > capacity:
        return 0
    count = order_rows(n, indptr, indices, workspace, scratch, outside, begin, order, size, nptr, nind, parent, lptr)
    if count < 0:
        return -1
    lind = take_integers(a, lptr[count] + 1)
    if a.n_index > capacity:
        return 0
    list_factor_rows_by_column(count, nptr, nind, parent, scratch, lptr, scratch + count, lind)
    k = find_supernodes(count, lptr, lind, size, group)
    for i in range(k):
        for j in range(lptr[group[i + 1] - 1], lptr[group[i + 1]]):
            below += size[lind[j]]
    if below > 2147483647:
        return -1
    p.n, p.supernodes = n, k
    p.interrupt = NULL
    p.order, p.position, p.supernode_of = take_integers(a, n), take_integers(a, n), take_integers(a, n)
    p.swap, p.local_row = take_integers(a, n), take_integers(a, n)
    p.first, p.row_ptr, p.row_indices = take_integers(a, k + 1), take_integers(a, k + 1), take_integers(a, below)
    p.head, p.link, p.next_row = take_integers(a, k), take_integers(a, k), take_integers(a, k)
    p.value_offset, p.upper_offset = take_offsets(a, k + 1), take_offsets(a, k + 1)
    if a.n_index > capacity:
        return 0
    # the first position of each vertex in scratch (count + 1), the row at each position, and the position of each row
    for i in range(count):
        scratch[i] = at
        for j in range(begin[order[i]], begin[order[i] + 1]):
            (<int32_t*>p.order)[at], (<int32_t*>p.position)[j] = j, at
            at += 1
    scratch[count] = n
    f.cost = list_supernode_rows(k, scratch, lptr, lind, group, <int32_t*>p.first, <int32_t*>p.supernode_of, <int32_t*>p.row_ptr,
                                 <int32_t*>p.row_indices, <int64_t*>p.value_offset, <int64_t*>p.upper_offset)
    return 1


cdef void bind_rows_values(linear_t* f, int32_t nnz, arena_t* a) noexcept nogil:
    """Take the values of a matrix of nnz entries after `analyse_rows`, and of both of its factors."""
    cdef supernodal_t* p = &f.rows.factor
    f.rows.data, f.rows.tdata = take_doubles(a, nnz), take_doubles(a, nnz)
    f.rows.scale, f.rows.y = take_doubles(a, f.n), take_doubles(a, f.n)
    p.values, p.upper = take_doubles(a, p.value_offset[p.supernodes]), take_doubles(a, p.upper_offset[p.supernodes])
    p.scratch = take_doubles(a, supernodal_scratch_size(p, True))


cdef double analyse_blocks(block_matrix_t* f, int32_t n, int32_t s, const int32_t* nptr, const int32_t* nind,
                           const int32_t* parent, const int32_t* lptr, arena_t* a) noexcept nogil:
    """Take the arrays for the pattern of f, and unless the arena only counts, set it; return the multiply-adds of L L^T.

    nptr and nind are the blocks of N. `compute_block_elimination_tree` returns parent (n), the elimination tree, and
    lptr (n + 1), the columns of L. The arena's integers are aligned to 8 bytes.
    """
    cdef int32_t blocks = nptr[n], i, j, k, q, count
    cdef int64_t place, ld
    cdef double work
    cdef supernodal_t* p = &f.factor
    cdef int64_t* lower_offset = take_offsets(a, blocks)
    cdef int64_t* upper_offset = take_offsets(a, blocks)
    cdef int64_t* value_offset = take_offsets(a, n + 1)
    cdef int64_t* panel_upper_offset = take_offsets(a, n + 1)
    cdef int32_t* supernode_of = take_integers(a, <int64_t>n * s)
    cdef int32_t* first = take_integers(a, n + 1)
    cdef int32_t* row_ptr = take_integers(a, n + 1)
    cdef int32_t* group = take_integers(a, n + 1)
    cdef int32_t* starts = take_integers(a, n + 1)
    cdef int32_t* mark = take_integers(a, n + 1)
    cdef int32_t* lind = take_integers(a, lptr[n] + 1)
    cdef int32_t* row_indices = take_integers(a, s * <int64_t>lptr[n] + 1)
    if a.index == NULL:
        return 0.0
    list_factor_rows_by_column(n, nptr, nind, parent, mark, lptr, starts, lind)
    count = find_supernodes(n, lptr, lind, NULL, group)
    for i in range(n + 1):
        starts[i] = i * s
    work = list_supernode_rows(count, starts, lptr, lind, group, first, supernode_of, row_ptr, row_indices, value_offset,
                               panel_upper_offset)
    p.n, p.supernodes = n * s, count
    p.order = p.position = NULL
    p.first, p.supernode_of, p.row_ptr, p.row_indices = first, supernode_of, row_ptr, row_indices
    p.value_offset, p.upper_offset = value_offset, panel_upper_offset
    f.n, f.s, f.nptr, f.nind, f.lower_offset, f.upper_offset = n, s, nptr, nind, lower_offset, upper_offset
    # Find the places of the blocks of N.
    for k in range(n):
        for q in range(nptr[k], nptr[k + 1]):
            j = nind[q] * s
            i = supernode_of[j]
            ld = panel_width(p, i) + rows_below(p, i)
            if k * s < first[i + 1]:                    # Both blocks are in the diagonal block of the supernode.
                lower_offset[q] = value_offset[i] + (k * s - first[i]) + (j - first[i]) * ld
                upper_offset[q] = value_offset[i] + (j - first[i]) + (k * s - first[i]) * ld
                continue
            place = row_ptr[i]
            while row_indices[place] != k * s:
                place += 1
            place -= row_ptr[i]
            lower_offset[q] = value_offset[i] + panel_width(p, i) + place + (j - first[i]) * ld
            upper_offset[q] = panel_upper_offset[i] + place + (j - first[i]) * <int64_t>rows_below(p, i)
    return work


cdef void bind_block_factor_indices(block_matrix_t* f, arena_t* a) noexcept nogil:
    """Take the integers of a factorisation, after `analyse_blocks`."""
    cdef supernodal_t* p = &f.factor
    p.swap, p.local_row = take_integers(a, p.n), take_integers(a, p.n)
    p.head, p.link, p.next_row = take_integers(a, f.n), take_integers(a, f.n), take_integers(a, f.n)


cdef void bind_block_factor_values(block_matrix_t* f, bint lu, int32_t wide, arena_t* a) noexcept nogil:
    """Take the values of N and of its factor, after `analyse_blocks`; `lu`: the matrix may be factored as L U."""
    cdef supernodal_t* p = &f.factor
    cdef int64_t values = <int64_t>f.nptr[f.n] * f.s * f.s
    p.wide = wide
    p.interrupt = NULL
    f.nval = take_doubles(a, values)
    f.mval = take_doubles(a, values if lu else 0)
    p.values = take_doubles(a, p.value_offset[p.supernodes])
    p.upper = take_doubles(a, p.upper_offset[p.supernodes] if lu else 0)
    p.scratch = take_doubles(a, supernodal_scratch_size(p, lu))


# -- factor ------------------------------------------------------------------------------------------------------


cdef inline bint is_late(const linear_t* f) noexcept nogil:
    """Return whether the deadline has ended the factorisation."""
    return f.deadline != NULL and f.deadline.passed


cdef inline void shift_dense(const linear_t* f) noexcept nogil:
    """Add shift D to the diagonal."""
    cdef int32_t i
    if f.shift != 0.0:
        for i in range(f.n):
            f.matrix[i * (<int64_t>f.n + 1)] += f.shift * (f.d[i] if f.d != NULL else 1.0)


cdef inline void factor_dense(linear_t* f) noexcept nogil:
    """Factor a full matrix by L L^T, unless only LU is allowed; use L U if L L^T is not allowed or loses a pivot."""
    cdef int32_t i, j
    cdef double* row
    cdef const double* min_pivot = NULL
    if f.by & CHOLESKY:
        shift_dense(f)
        if f.d != NULL:
            for i in range(f.n):
                f.scale[i] = f.tiny * f.d[i]
            min_pivot = f.scale
        f.pivots.small = dense_cholesky(f.wide, f.n, f.matrix, min_pivot, f.lower, f.deadline)
        f.factored = CHOLESKY if f.pivots.small == 0 or min_pivot != NULL else NO_FACTOR
        if f.pivots.small == 0 or not f.by & LU or is_late(f):
            return
    elif f.d != NULL:                                   # D^-1/2 A D^-1/2 + shift
        for i in range(f.n):
            f.scale[i] = 1.0 / sqrt(f.d[i])
        for i in range(f.n):
            row = f.matrix + <int64_t>i * f.n
            for j in range(f.n):
                if row[j] != 0.0:
                    row[j] = f.scale[i] * row[j] * f.scale[j]
            row[i] += f.shift
    else:
        shift_dense(f)
    f.pivots.small = dense_lu(f.wide, f.n, f.matrix, f.swap, f.tiny, f.deadline)
    f.factored = LU if f.pivots.small == 0 else NO_FACTOR


cdef inline void replace_factor_by_fallback(linear_t* f) noexcept nogil:
    """Replace the factor by the caller's fallback. Without a fallback, or if it fails, the system then has no factor."""
    f.factored = NO_FACTOR
    if f.fallback != NULL and f.fallback.factor(f.fallback.at):
        f.factored, f.pivots.small = FALLBACK, 0


cdef int32_t factor_linear_system_matrix(linear_t* f) noexcept nogil:
    """Factor A + shift D, until the deadline; return the number of lost pivots.

    For BAND, `pivots` also contains the number of negative pivots.
    """
    cdef int32_t i, lost, negative
    f.rows.factor.deadline = f.blocks.factor.deadline = f.deadline
    clear_pivot_statistics(&f.pivots)
    if f.kind == DENSE:
        factor_dense(f)
    elif f.kind == BAND:
        for i in range(f.n if f.shift != 0.0 else 0):
            f.matrix[<int64_t>i * f.width] += f.shift * f.d[i]
        # If `ahead` is set, this begins its solve at the same time.
        factor_band_ldl(f.n, f.width, f.matrix, f.d, f.tiny, f.ahead, &f.pivots, f.deadline)
        f.factored = CHOLESKY
    elif f.kind == ROWS:
        f.factored, negative = LU if f.by == LU else CHOLESKY, 0
        f.largest = norm_inf(f.rows.data, f.rows.indptr[f.n]) if f.by == LU else 0.0
        for i in range(f.n if f.d != NULL else 0):
            negative += not f.d[i] > 0.0
        f.pivots.small = negative if negative else factor_sparse(&f.rows, f.by == LU, f.d, f.shift, f.tiny)
        if f.pivots.small and f.fallback != NULL and not is_late(f):
            replace_factor_by_fallback(f)
    elif f.kind == BLOCKS:
        f.factored = f.by
        f.pivots.small = factor_blocks(&f.blocks, f.by == LU)
    else:
        f.factored = CHOLESKY
        lost = factor_tree_matrix(f.n, f.lptr, f.lidx, f.matrix, f.diagonal, f.scale, f.tiny, f.deadline)
        f.pivots.small, f.pivots.first_small = lost >= 0, lost
    if is_late(f):
        f.factored = NO_FACTOR                          # A part of the factor was not written.
    return f.pivots.small


# -- solve, multiply, sign -----------------------------------------------------------------------------------------


cdef void solve_linear_system(linear_t* f, double* x) noexcept nogil:
    """Overwrite the right-hand side x (n) with the solution, which is infinite if the system has no factor."""
    cdef int32_t j
    if f.factored == FALLBACK:
        f.fallback.solve(f.fallback.at, x)
    elif f.factored == NO_FACTOR:
        for j in range(f.n):
            x[j] = 1.0 / 0.0
    elif f.kind == BAND and x == f.ahead:
        f.ahead = NULL
        back_substitute_all_band_ldl(f.n, f.width, f.matrix, x)
    elif f.kind == BAND:
        solve_band_ldl(f.n, f.width, f.matrix, x)
    elif f.kind == ROWS:
        solve_sparse(&f.rows, f.factored == LU, x)
    elif f.kind == BLOCKS:
        solve_supernodes(&f.blocks.factor, x, f.factored == LU)
    elif f.kind == TREE:
        solve_tree_factor(f.n, f.lptr, f.lidx, f.matrix, f.scale, x)
    elif f.factored == CHOLESKY:
        dense_cholesky_solve(f.n, f.lower, x)
    elif f.d == NULL:
        dense_lu_solve(f.n, f.matrix, f.swap, x)
    else:
        for j in range(f.n):
            x[j] *= f.scale[j]
        dense_lu_solve(f.n, f.matrix, f.swap, x)
        for j in range(f.n):
            x[j] *= f.scale[j]


cdef void solve_transposed_linear_system(const linear_t* f, double* x) noexcept nogil:
    """Overwrite x (n) with A^-T x. This requires L U of a full matrix without d."""
    dense_lu_solve_transposed(f.n, f.matrix, f.swap, x)


cdef void multiply_by_system_matrix(const linear_t* f, const double* x, double* y) noexcept nogil:
    """Compute y = A x, without the shift, for ROWS, or for DENSE if L U has not overwritten the matrix."""
    cdef int32_t i, q
    cdef double s
    for i in range(f.n):
        s = 0.0
        if f.kind == DENSE:
            s = dot(f.matrix + <int64_t>i * f.n, x, f.n)
        else:
            for q in range(f.rows.indptr[i], f.rows.indptr[i + 1]):
                s += f.rows.data[q] * x[f.rows.indices[q]]
        y[i] = s


cdef int32_t solve_linear_system_checked(linear_t* f, const double* r, double* x, double* scratch) noexcept nogil:
    """Solve A x = r. Refine L U of ROWS until (3) holds, then use the fallback if necessary; return whether (3) holds.

    scratch has n doubles; x must not be r.
    """
    cdef int32_t i, k
    for i in range(f.n):
        x[i] = r[i]
    solve_linear_system(f, x)
    if f.kind != ROWS or f.factored != LU:
        return f.factored != NO_FACTOR
    for k in range(MAX_REFINEMENTS + 1):
        multiply_by_system_matrix(f, x, scratch)
        for i in range(f.n):                            # r - A x
            scratch[i] = r[i] - scratch[i]
            if f.shift != 0.0:
                scratch[i] -= f.shift * x[i]
        if norm_inf(scratch, f.n) <= backward_tolerance() * ((f.largest + f.shift) * norm_inf(x, f.n) + norm_inf(r, f.n)):
            return True
        if k < MAX_REFINEMENTS:
            solve_linear_system(f, scratch)
            for i in range(f.n):
                x[i] += scratch[i]
    replace_factor_by_fallback(f)
    for i in range(f.n):
        x[i] = r[i]
    solve_linear_system(f, x)
    return f.factored != NO_FACTOR


cdef int32_t compute_determinant_sign(const linear_t* f) noexcept nogil:
    """Return the sign of det A after a factorisation; 0 if it is not known."""
    cdef const supernodal_t* s = &f.blocks.factor if f.kind == BLOCKS else &f.rows.factor
    cdef int32_t i, k, sign = 1
    cdef int64_t rows
    if f.factored != LU:
        return f.factored == CHOLESKY
    if f.kind == DENSE:
        for k in range(f.n):
            if (f.swap[k] != k) != (f.matrix[<int64_t>k * (f.n + 1)] < 0.0):
                sign = -sign
        return sign
    for i in range(s.supernodes):
        rows = panel_width(s, i) + rows_below(s, i)
        for k in range(panel_width(s, i)):
            if (s.swap[s.first[i] + k] != k) != (s.values[s.value_offset[i] + k * (rows + 1)] < 0.0):
                sign = -sign
    return sign


# -- for Python --------------------------------------------------------------------------------------------------


cdef int32_t run_signal_handlers(void* at) noexcept with gil:
    """Run the handlers of signals that have arrived; return whether one has raised an exception."""
    try:
        PyErr_CheckSignals()
    except BaseException as error:
        (<PythonCalls>at).store_error(error)
        return 1
    return 0


cdef class PythonCalls:
    """Calls of a factorisation to Python, also to signal handlers. The first exception ends the work, and is then raised."""

    def __cinit__(self):
        self.interrupt = interrupt_t(<void*>self, run_signal_handlers, 0.0, 0)

    cdef void store_error(self, object error) noexcept:
        """Store an exception, unless an earlier one has not been raised yet, which may have caused it."""
        if self.error is None:
            self.error = error
        if self.stop != NULL:
            self.stop[0] = 1

    cdef int raise_error(self) except -1:
        """Raise the stored exception, if any, and allow further factorisations."""
        error, self.error, self.interrupt.stopped = self.error, None, 0
        if error is not None:
            raise error
        return 0


cdef int32_t call_fallback(void* at) noexcept with gil:
    cdef LinearSystem system = <LinearSystem>at
    if system.python.error is not None:                 # The caller is about to raise it.
        return 0
    try:
        system.other = system.splu(system)
        return 1
    except RuntimeError:                                # The matrix is singular.
        return 0
    except BaseException as error:
        system.python.store_error(error)
        return 0


cdef void solve_by_fallback(void* at, double* x) noexcept with gil:
    cdef LinearSystem system = <LinearSystem>at
    cdef double[::1] view = <double[:system.f.n]>x
    cdef const double[::1] solution
    try:
        solution = system.other.solve(np.array(view))
        view[:] = solution
    except BaseException as error:
        system.python.store_error(error)
        view[:] = np.nan


cdef class LinearSystem:
    """A linear system: a full matrix, or one in canonical compressed rows of a symmetric pattern.

    Parameters
    ----------
    pattern : int or tuple
        Order of a full matrix, n > 0; or (indptr (n + 1,), indices (nnz,)), int32.
    wide : bool
        Use four lanes if the processor has them; the bits are the same.
    splu : callable, optional
        Fallback for a matrix in compressed rows: called with the system if pivots are lost, it factors the matrix and returns
        an object with `solve(r)`, or raises RuntimeError if the matrix is singular.
    """

    def __init__(self, pattern, bint wide=True, splu=None):
        self.f.wide, self.splu, self.python = has_wide() if wide else 0, splu, PythonCalls()
        if isinstance(pattern, int):
            analyse_dense(&self.f, pattern)
        else:
            self.indptr, self.indices = pattern
            self.f.kind, self.f.n = ROWS, <int32_t>len(self.indptr) - 1
        if self.f.n < 1:
            raise ValueError(f"the matrix has {self.f.n} rows; at least one row is needed")
        if splu is not None:
            self.calls = fallback_t(<void*>self, call_fallback, solve_by_fallback)
            self.f.fallback = &self.calls

    cpdef analyse(self):
        """Compute order, pattern and cost of the factor from the pattern alone; done at the first use."""
        cdef int32_t n = self.f.n, nnz, outcome = 0
        cdef int64_t capacity
        cdef int32_t[::1] index
        cdef const int32_t[::1] indptr = self.indptr, indices = self.indices
        cdef arena_t a
        if self.f.kind == DENSE or self.analysis is not None:
            return
        nnz = <int32_t>indices.shape[0]
        capacity = 50 * <int64_t>n + 8 * <int64_t>nnz
        while outcome == 0:
            index = np.empty(capacity + 2, np.int32)
            a = make_arena(NULL, &index[0])
            with nogil:
                outcome = analyse_rows(&self.f, n, &indptr[0], &indices[0] if nnz else NULL, capacity, &a)
            capacity = a.n_index + 10 * <int64_t>n + nnz
        if outcome < 0:
            raise OverflowError("the factor has 2^31 entries or more")
        self.analysis = index
        self.f.rows.factor.wide, self.f.rows.factor.interrupt = self.f.wide, &self.python.interrupt
        self.entries = self.f.rows.factor.value_offset[self.f.rows.factor.supernodes]

    cdef int allocate_factor_memory(self, bint lu) except -1:
        """Allocate the memory that the next factorisation needs, L U or L L^T, unless it is allocated."""
        cdef int32_t n = self.f.n
        cdef int64_t size
        cdef double[::1] x
        cdef int32_t[::1] index
        cdef supernodal_t* f = &self.f.rows.factor
        if self.f.kind == DENSE:
            if self.numbers is None:
                x = self.numbers = np.empty(n)
                self.f.scale = &x[0]
            if not lu and self.f.lower == NULL:
                self.held = x = np.empty(cholesky_workspace_size(n))
                self.f.lower = &x[0]
            if lu and self.f.swap == NULL:
                self.upper = index = np.empty(n, np.int32)
                self.f.swap = &index[0]
            return 0
        self.analyse()
        if self.numbers is None:
            x = self.numbers = np.empty(self.entries + 2 * n + 1)
            f.values = &x[0]
            self.f.rows.scale, self.f.rows.y = &x[self.entries], &x[self.entries + n]
            x = self.held = np.empty(supernodal_scratch_size(f, True) + 1)
            f.scratch = &x[0]
        if lu and self.upper is None:
            size = f.upper_offset[f.supernodes]
            values, columns = np.empty(size + len(self.indices) + 1), np.empty(n + 2 + len(self.indices), np.int32)
            self.upper = values, columns
            x, index = values, columns
            f.upper, self.f.rows.tdata = &x[0], &x[size]
            self.f.rows.tptr, self.f.rows.tind = &index[0], &index[0] + n + 2
        return 0

    @property
    def n(self):
        """Number of rows."""
        return self.f.n

    @property
    def cost(self):
        """Multiply-adds of a factorisation L L^T, from the pattern; L U takes twice as many. inf if it cannot be stored."""
        try:
            self.analyse()
        except OverflowError:
            return np.inf
        return self.f.cost

    def factor(self, data, d=None, double shift=0.0, double tiny=0.0, bint lu=False, Deadline deadline=None):
        """Factor A + shift D as L U (`lu`) or L L^T; return the number of pivots that do not exceed tiny d.

        The result is -1 if the deadline has passed before the end.

        Parameters
        ----------
        data : (nnz,) or (n, n) float64
            Entries of A. L L^T reads those at and after the diagonal in the order of elimination, or of each row of a full
            matrix, whose diagonal receives the shift; L U overwrites a full matrix.
        d : (n,) float64, optional
            Diagonal of D, positive; default 1.
        """
        cdef const double[::1] metric
        cdef const double[::1] x = data.reshape(-1)         # a view of `data`
        cdef int32_t lost, n = self.f.n
        self.allocate_factor_memory(lu)
        if x.shape[0] != (<int64_t>n * n if self.f.kind == DENSE else len(self.indices)):
            raise ValueError(f"data has {x.shape[0]} entries; the entries of the analysed matrix are needed")
        self.data, self.other = data, None
        if x.shape[0] == 0:
            return n
        self.f.d = NULL
        if d is not None:
            metric = np.ascontiguousarray(d)
            if metric.shape[0] != n:
                raise ValueError(f"d has {metric.shape[0]} entries; {n} are needed")
            self.f.d = &metric[0]
        self.f.rows.data = self.f.matrix = <double*>&x[0]
        self.f.shift, self.f.tiny, self.f.by = shift, tiny, LU if lu else CHOLESKY
        self.f.deadline = get_pointer(deadline)
        with nogil:
            lost = factor_linear_system_matrix(&self.f)
        if is_late(&self.f):
            lost = -1
        if self.python.interrupt.stopped:
            self.f.factored = NO_FACTOR
        self.python.raise_error()
        return lost

    def solve(self, const double[::1] r, bint checked=False):
        """Solve with the last factor; return a new array (n,).

        With `checked`, L U of compressed rows is refined, and replaced by the fallback if its backward error stays above (3) of
        `linear.pxd`; without a solution that satisfies it, the result is None.
        """
        cdef int32_t n = self.f.n
        out = np.array(r)
        cdef double[::1] x = out, scratch
        cdef bint is_good = True
        if x.shape[0] != n or self.numbers is None:
            raise ValueError(f"r has {x.shape[0]} entries; {n} are needed, and `factor` must be called first")
        if checked:
            scratch = np.empty(n)
            with nogil:
                is_good = solve_linear_system_checked(&self.f, &r[0], &x[0], &scratch[0])
        else:
            with nogil:
                solve_linear_system(&self.f, &x[0])
        self.python.raise_error()
        return out if is_good else None

    def multiply(self, const double[::1] x):
        """Return A x (n,) for the matrix A of the last factorisation.

        A full matrix is overwritten by its L U factor, so the product is not available after it.
        """
        out = np.empty(self.f.n)
        cdef double[::1] y = out
        if x.shape[0] != self.f.n or self.data is None:
            raise ValueError(f"x has {x.shape[0]} entries; {self.f.n} are needed, and `factor` must be called first")
        multiply_by_system_matrix(&self.f, &x[0], &y[0])
        return out

    @property
    def sign(self):
        """Sign of det A, 0 if the fallback has factored it or no factor exists."""
        return compute_determinant_sign(&self.f)

    @property
    def uses_fallback(self):
        """Whether the fallback computed the last factor."""
        return self.f.factored == FALLBACK

    @property
    def order(self):
        """Row (n,) that is eliminated first, second, ...; for a matrix in compressed rows."""
        self.analyse()
        return np.asarray(<int32_t[:self.f.n]><int32_t*>self.f.rows.factor.order).copy()
