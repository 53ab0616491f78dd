"""A = J M^-1 J^T + diag(compliance) in compressed rows, from the factored form, in time linear in its entries.

    A_rc = sum over the bodies that rows r and c share of J_r . (M^-1 J^T)_c

Blocks that share a body are found from the list of blocks of each body. Entries that are exactly zero are not stored.
A_rc is computed once, for r <= c, so that A is symmetric to the bit.
"""
from libc.stdint cimport INT32_MAX, int32_t, int64_t
from libc.string cimport memcpy

import numpy as np

from lavender_ext.core.arrays cimport get_plain_matrix, make_read_only, ndarray
from lavender_ext.core.csr cimport transpose_csr
from lavender_ext.core.deadline cimport Deadline, deadline_t, get_pointer, has_passed
from lavender_ext.core.faults cimport NO_FAULT, find_matrix_fault
from lavender_ext.core.mass cimport THIN_PADDING, compress_dense_rows
from lavender_ext.core.validate cimport has_invalid_number
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.problem cimport Data
from lavender_ext.core.rows cimport dot6, get_block_jacobian, multiply_inverse_mass
from lavender_ext.core.view cimport get_block_bodies, get_moving_body, rows_t

cdef object F8 = np.dtype(np.float64), I4 = np.dtype(np.int32)


cdef public void lav_list_blocks_of_bodies(const blocks_t* p, const rows_t* r, int32_t* start, int32_t* blocks,
                                           int64_t* bound) noexcept nogil:
    """List the blocks of body i in increasing order in blocks[start[i]:start[i + 1]]; start (n + 1), blocks (2 k).

    bound[0] receives an upper bound on the number of stored entries of A.
    """
    cdef int32_t i, s, x, t
    cdef int64_t n_rows
    for i in range(r.n_bodies + 1):
        start[i] = 0
    for i in range(p.n_blocks):
        for s in range(2):
            x = get_moving_body(r, i, s)
            if x >= 0:
                start[x] += 1
    for i in range(r.n_bodies):                         # the end of each list, from which it is filled backwards
        start[i + 1] += start[i]
    for i in range(p.n_blocks - 1, -1, -1):
        for s in range(2):
            x = get_moving_body(r, i, s)
            if x >= 0:
                start[x] -= 1
                blocks[start[x]] = i
    bound[0] = 0
    for i in range(p.n_blocks):
        n_rows = p.ptr[i + 1] - p.ptr[i]
        t = (get_moving_body(r, i, 0) >= 0) + (get_moving_body(r, i, 1) >= 0)
        # The loop over bodies counts a block with itself once for each of its moving bodies; count it once in all.
        bound[0] += n_rows if t == 0 else (1 - t) * n_rows * n_rows
    for i in range(r.n_bodies):
        n_rows = 0
        for x in range(start[i], start[i + 1]):
            n_rows += p.ptr[blocks[x] + 1] - p.ptr[blocks[x]]
        bound[0] += n_rows * n_rows


cdef inline int32_t list_coupled_blocks(const rows_t* r, int32_t i, const int32_t* start, const int32_t* blocks,
                                        int32_t* out) noexcept nogil:
    """List block i and the blocks that share a body with it in `out`, increasing; return their number."""
    cdef int32_t a = get_moving_body(r, i, 0), b = get_moving_body(r, i, 1), x = 0, y = 0, xe = 0, ye = 0, n = 0, u, v
    if a >= 0:
        x = start[a]
        xe = start[a + 1]
    if b >= 0:
        y = start[b]
        ye = start[b + 1]
    if x == xe and y == ye:
        out[0] = i
        return 1
    while x < xe or y < ye:
        u = blocks[x] if x < xe else 2147483647
        v = blocks[y] if y < ye else 2147483647
        out[n] = u if u < v else v
        n += 1
        x += u <= v
        y += v <= u
    return n


cdef inline double compute_coupling_entry(const double* jac, const double* minv_jac, int32_t bits) noexcept nogil:
    """Return the entry of A of two rows, J (12) of one times M^-1 J^T (12) of the other over the bodies that they share.

    Bit 2 s + t of `bits` is set if body s of the first row is body t of the other.
    """
    cdef double value = 0.0
    if bits & 1:
        value += dot6(jac, minv_jac)
    if bits & 2:
        value += dot6(jac, minv_jac + 6)
    if bits & 4:
        value += dot6(jac + 6, minv_jac)
    if bits & 8:
        value += dot6(jac + 6, minv_jac + 6)
    return value


cdef public void lav_form_delassus_matrix(const blocks_t* p, const rows_t* r, const int32_t* start, const int32_t* blocks,
                                          double* jac, int32_t* scratch, int32_t* indptr, int32_t* indices,
                                          double* data) noexcept nogil:
    """Write the rows of A into indptr (m + 1), indices, data, with the lists of `lav_list_blocks_of_bodies`.

    jac (24 m) receives J and M^-1 J^T of every row; scratch (4 k + 2 + m).
    """
    cdef double* minv_jac = jac + 12 * <int64_t>p.n_rows
    cdef int32_t* neighbors = scratch
    cdef int32_t* sides = scratch + 2 * <int64_t>p.n_blocks + 1
    # Entry of each row above the diagonal that will be copied next, into the row of that entry's column.
    cdef int32_t* next_ = sides + 2 * <int64_t>p.n_blocks + 1
    cdef int32_t i, n, q, j, row, col, end, at, bit, s, t, body, nnz = 0
    cdef double value
    cdef const int32_t* bodies
    cdef const double* x
    cdef const double* y
    for i in range(p.n_blocks):                         # J and M^-1 J^T (m, 12) in the layout of joint rows, of bodies a and b
        row = p.ptr[i]
        x = get_block_jacobian(p, r, i, jac + 12 * row)
        if i < r.n_joints:
            memcpy(jac + 12 * row, x, 12 * (p.ptr[i + 1] - row) * sizeof(double))
        bodies = get_block_bodies(r, i)
        for row in range(p.ptr[i], p.ptr[i + 1]):
            multiply_inverse_mass(jac + 12 * row, r.inv_mass, r.inv_inertia, bodies[0], bodies[1], minv_jac + 12 * row)
    indptr[0] = 0
    for i in range(p.n_blocks):
        n = list_coupled_blocks(r, i, start, blocks, neighbors)
        for q in range(n):
            # Bit 2 s + t is set if body s (0 or 1) of block i and body t of its neighbour are the same moving body.
            sides[q] = 0
            for s in range(2 if i <= neighbors[q] else 0):
                body = get_moving_body(r, i, s)
                for t in range(2):
                    if body >= 0 and body == get_block_bodies(r, neighbors[q])[t]:
                        sides[q] |= 1 << (2 * s + t)
        for row in range(p.ptr[i], p.ptr[i + 1]):
            for q in range(n):
                j = neighbors[q]
                col = p.ptr[j]
                end = p.ptr[j + 1]
                # below the diagonal: copy from the row of the column
                while col < end and col < row:
                    at = next_[col]
                    if at < indptr[col + 1] and indices[at] == row:
                        indices[nnz] = col
                        data[nnz] = data[at]
                        nnz += 1
                        next_[col] = at + 1
                    col += 1
                if col == end:
                    continue
                # diagonal and above: J of this row times M^-1 J^T of the column
                if col == row:
                    value = (compute_coupling_entry(jac + 12 * row, minv_jac + 12 * row, sides[q]) + r.compliance[row])
                    if value != 0.0:
                        indices[nnz] = row
                        data[nnz] = value
                        nnz += 1
                    next_[row] = nnz
                    col += 1
                bit = (sides[q] > 1) + (sides[q] > 2) + (sides[q] > 4)
                if sides[q] == 1 << bit:                # The blocks share one body.
                    x = jac + 12 * row + 6 * (bit >> 1)
                    y = minv_jac + 6 * (bit & 1)
                    while col < end:
                        value = dot6(x, y + 12 * col)
                        indices[nnz] = col
                        data[nnz] = value
                        nnz += value != 0.0
                        col += 1
                else:
                    while col < end:
                        value = compute_coupling_entry(jac + 12 * row, minv_jac + 12 * col, sides[q])
                        indices[nnz] = col
                        data[nnz] = value
                        nnz += value != 0.0
                        col += 1
            indptr[row + 1] = nnz


def bound_delassus_entries(Data p):
    """Return an upper bound on the entries of A, and the lists (start, blocks) of `lav_list_blocks_of_bodies`."""
    start_ = np.empty(p.rows.n_bodies + 1, np.int32)    # Converting a view back to an array costs more than creating the view.
    blocks_ = np.empty(2 * p.blocks.n_blocks + 1, np.int32)
    cdef int32_t[::1] start = start_, blocks = blocks_
    cdef int64_t max_entries
    lav_list_blocks_of_bodies(&p.blocks, &p.rows, &start[0], &blocks[0], &max_entries)
    return max_entries, start_, blocks_


def bound_delassus_bandwidth(Data p, const int32_t[::1] start, const int32_t[::1] blocks):
    """Return an upper bound of the half bandwidth of A: the largest distance of two rows that share a body.

    The arguments after p are the results of `bound_delassus_entries(p)`.
    """
    cdef const int32_t* ptr = p.blocks.ptr
    cdef int32_t i, band = 0
    for i in range(p.blocks.n_blocks):
        band = max(band, ptr[i + 1] - 1 - ptr[i])
    for i in range(p.rows.n_bodies):
        if start[i] < start[i + 1]:
            band = max(band, ptr[blocks[start[i + 1] - 1] + 1] - 1 - ptr[blocks[start[i]]])
    return band


def form_delassus_matrix(Data p, Py_ssize_t max_entries, int32_t[::1] start, int32_t[::1] blocks):
    """Return A as (indptr, indices, data) of compressed rows with sorted columns.

    The arguments after p are the results of `bound_delassus_entries(p)`; max_entries must be below 2^31.
    """
    cdef Py_ssize_t m = p.blocks.n_rows
    cdef int32_t nnz
    data_, indices_, indptr_ = np.empty(max_entries + 1), np.empty(max_entries + 1, np.int32), np.zeros(m + 1, np.int32)
    cdef double[::1] jac = np.empty(24 * m + 1), data = data_
    cdef int32_t[::1] indices = indices_, indptr = indptr_
    cdef int32_t[::1] scratch = np.empty(4 * p.blocks.n_blocks + 2 + m, np.int32)
    with nogil:
        lav_form_delassus_matrix(&p.blocks, &p.rows, &start[0], &blocks[0], &jac[0], &scratch[0], &indptr[0], &indices[0], &data[0])
    nnz = indptr[m]
    entries = indices_[:nnz], data_[:nnz]
    if nnz < 0.75 * max_entries:                        # Copy only if more than a quarter of the memory is unused.
        entries = entries[0].copy(), entries[1].copy()
    return (indptr_, *entries)


def dense_to_csr(a, double sign=1.0):
    """Return the nonzeros of a dense matrix times `sign` as (indptr, indices, data), int32; nnz must be below 2^31.

    None is returned unless the matrix is a C-contiguous float64 array with valid numbers.
    """
    cdef Py_ssize_t n = 0, m = 0, nnz = 0, q
    cdef const double* entries = get_plain_matrix(a, &n, &m, &nnz)
    if entries == NULL:
        return None
    all_indices, values = np.empty(n + 1 + nnz + THIN_PADDING, np.int32), np.empty(nnz + THIN_PADDING)
    cdef int32_t* indices = <int32_t*>(<ndarray>all_indices).data
    cdef double* data = <double*>(<ndarray>values).data
    nnz = compress_dense_rows(entries, m, <int32_t>n, <int32_t>m, indices, indices + n + 1, data)
    if sign != 1.0:
        for q in range(nnz):
            data[q] *= sign
    make_read_only(all_indices)
    make_read_only(values)
    return all_indices[:n + 1], all_indices[n + 1:n + 1 + nnz], values[:nnz]


def mirror_lower_triangle(const int32_t[::1] indptr, const int32_t[::1] indices, const double[::1] data):
    """Return (indptr, indices, data) of a symmetric matrix from its lower triangle, with the diagonal entry last in each row."""
    cdef Py_ssize_t n = indptr.shape[0] - 1, nnz = indices.shape[0], i, q, k = 0
    cdef int32_t[::1] above = np.empty(n + 2, np.int32), column = np.empty(nnz + 1, np.int32)
    cdef double[::1] upper_value = np.empty(nnz + 1)
    if n:
        transpose_csr(<int32_t>n, <int32_t>n, &indptr[0], &indices[0], &data[0], &above[0], &column[0], &upper_value[0])
    ptr_array, index_array, value_array = np.zeros(n + 1, np.int32), np.empty(2 * nnz - n, np.int32), np.empty(2 * nnz - n)
    cdef int32_t[::1] ptr = ptr_array, index = index_array
    cdef double[::1] value = value_array
    for i in range(n):
        for q in range(indptr[i], indptr[i + 1]):
            index[k] = indices[q]
            value[k] = data[q]
            k += 1
        for q in range(above[i] + 1, above[i + 1]):     # The diagonal is already stored.
            index[k] = column[q]
            value[k] = upper_value[q]
            k += 1
        ptr[i + 1] = <int32_t>k
    return ptr_array, index_array, value_array


def stack_csr_matrices(int32_t n, matrices):
    """Stack several matrices of n columns vertically; return (indptr, indices, data) without zero entries, or None.

    A matrix is (indptr, indices, data, whether it is stored by columns, a sign that it is multiplied with, its number of
    rows). None is returned if a matrix does not have int32 indices and float64 data in canonical form, or has an entry
    that core/validate.pxd (1) rejects. The caller then validates in detail and raises.
    """
    cdef const int32_t[::1] ptr, idx
    cdef const double[::1] val
    cdef double sign
    cdef bint columns
    cdef int64_t fault_at
    cdef int32_t m = 0, rows, first, i, p, nnz
    for matrix in matrices:
        m += matrix[5]
        if matrix[0].dtype is not I4 or matrix[1].dtype is not I4 or matrix[2].dtype is not F8:
            return None
    indptr = np.zeros(m + 2, np.int32)                  # One extra entry: filling moves each pointer to the end of its row.
    cdef int32_t[::1] start = indptr
    first = 0
    for ptr_, idx_, val_, columns, _, rows in matrices:
        ptr, idx, val = ptr_, idx_, val_
        if ptr.shape[0] != (n if columns else rows) + 1 or ptr[0] != 0 or ptr[ptr.shape[0] - 1] > idx.shape[0] \
                or idx.shape[0] != val.shape[0]:
            return None
        nnz = ptr[ptr.shape[0] - 1]
        if idx.shape[0] and (find_matrix_fault(&ptr[0], &idx[0], <int32_t>ptr.shape[0] - 1, rows if columns else n, nnz, False,
                                               &fault_at) != NO_FAULT or has_invalid_number(&val[0], nnz)):
            return None
        for i in range(<int32_t>ptr.shape[0] - 1):
            for p in range(ptr[i], ptr[i + 1]):
                start[2 + first + (idx[p] if columns else i)] += val[p] != 0.0
        first += rows
    for i in range(m):
        start[i + 2] += start[i + 1]
    nnz = start[m + 1]
    indices, data = np.empty(nnz, np.int32), np.empty(nnz)
    cdef int32_t[::1] column = indices
    cdef double[::1] value = data
    first = 1
    for ptr_, idx_, val_, columns, sign, rows in matrices:
        ptr, idx, val = ptr_, idx_, val_
        for i in range(<int32_t>ptr.shape[0] - 1):
            for p in range(ptr[i], ptr[i + 1]):
                if val[p] != 0.0:
                    nnz = first + (idx[p] if columns else i)
                    column[start[nnz]] = i if columns else idx[p]
                    value[start[nnz]] = sign * val[p]
                    start[nnz] += 1
        first += rows
    for x in (indptr, indices, data):
        x.setflags(False)
    return indptr[:m + 1], indices, data


cdef inline double sparse_product_cost() noexcept nogil:
    """Return the time [ns] of a multiply-add of a sparse row by a sparse row."""
    return 2.0


cdef bint count_gram_entries(int32_t m, const int32_t* indptr, const int32_t* indices, const int32_t* ptr,
                             const int32_t* row, int32_t* mark, int32_t* count,
                             deadline_t* deadline) noexcept nogil:
    """Write the row pointers of the pattern of Y Y^T + D, diagonal included, into count (m + 1); mark (m) is scratch.

    Return 0 if the deadline has passed before the end.
    """
    cdef int32_t i, q, p, k
    cdef double work
    for i in range(m):
        mark[i] = -1
    count[0] = 0
    for i in range(m):
        mark[i] = i
        k, work = 1, 0.0
        for q in range(indptr[i], indptr[i + 1]):
            work += ptr[indices[q] + 1] - ptr[indices[q]]
            for p in range(ptr[indices[q]], ptr[indices[q] + 1]):
                if mark[row[p]] != i:
                    mark[row[p]] = i
                    k += 1
        count[i + 1] = count[i] + k
        if has_passed(deadline, sparse_product_cost() * work):
            return False
    return True


cdef int32_t form_sparse_gram_matrix(int32_t m, const int32_t* indptr, const int32_t* indices, const double* data,
                                     const int32_t* ptr, const int32_t* row, const double* value, const double* diagonal,
                                     int32_t* next, double* sum_, int32_t* count, int32_t* out, double* entry,
                                     deadline_t* deadline) noexcept nogil:
    """Compute Y Y^T + D in compressed rows without zero entries; return the number of entries, -1 after the deadline.

    Each entry is a sum over the columns of Y in their order, the same for (i, j) and (j, i). count is from
    `count_gram_entries`; next (2 m) and sum_ (m) are scratch.
    """
    cdef int32_t i, j, q, p, k, to = 0, begin
    cdef int32_t* list_ = next + m
    cdef double y, work
    # Row i appends its entries to their columns, so that the rows of each column ascend.
    for i in range(m):
        next[i] = count[i]
        sum_[i] = 0.0
        list_[i] = -1
    for i in range(m):
        # The entries of row i are linked through `list_` from the last to the first; their order does not matter.
        k, work = i, 0.0
        list_[i] = i
        for q in range(indptr[i], indptr[i + 1]):
            y = data[q]
            work += ptr[indices[q] + 1] - ptr[indices[q]]
            for p in range(ptr[indices[q]], ptr[indices[q] + 1]):
                j = row[p]
                if list_[j] < 0:
                    list_[j] = k
                    k = j
                sum_[j] += y * value[p]
        sum_[i] += diagonal[i]
        while True:
            j = list_[k]
            list_[k] = -1
            if sum_[k] != 0.0:
                out[next[k]] = i
                entry[next[k]] = sum_[k]
                next[k] += 1
            sum_[k] = 0.0
            if k == i:
                break
            k = j
        if has_passed(deadline, sparse_product_cost() * work):
            return -1
    for i in range(m):
        begin = count[i]
        count[i] = to
        for q in range(begin, next[i]):
            out[to] = out[q]
            entry[to] = entry[q]
            to += 1
    count[m] = to
    return to


cdef enum:
    TILE = 4                    # rows and columns of A that are summed in registers


cdef bint has_identical_row_columns(int32_t m, const int32_t* indptr, const int32_t* indices) noexcept nogil:
    """Return whether every row has entries in the same columns, in ascending order."""
    cdef int32_t i, q, n = indptr[1]
    for i in range(m):
        if indptr[i + 1] != (i + 1) * n:
            return False
        for q in range(n):
            if indices[i * n + q] != indices[q] or (q > 0 and indices[q] <= indices[q - 1]):
                return False
    return True


cdef int32_t form_dense_gram_matrix(int32_t m, int64_t n, const double* y, const double* y_transposed, const double* diagonal,
                                    int32_t* count, int32_t* out, double* a, deadline_t* deadline) noexcept nogil:
    """Write A = Y Y^T + D of a dense Y (m, n) to `count`, `out` and `a` as compressed rows without zero entries.

    The sums are in the order of the columns, as in `form_sparse_gram_matrix`. Return the number of entries, or -1 if the
    deadline has passed before the end.
    """
    cdef int32_t tiles = (m + TILE - 1) // TILE, down, right, i, j, r, c, high, wide, to = 0
    cdef int64_t k
    cdef double x
    cdef double s[TILE * TILE]
    for right in range(tiles):
        for down in range(right, tiles):
            i, j = TILE * down, TILE * right
            high, wide = min(TILE, m - i), min(TILE, m - j)
            for r in range(TILE * TILE):
                s[r] = 0.0
            if wide == TILE and high == TILE:
                for k in range(n):
                    for r in range(TILE):
                        x = y[(i + r) * n + k]
                        for c in range(TILE):
                            s[TILE * r + c] += x * y_transposed[k * m + j + c]
            else:
                for k in range(n):
                    for r in range(high):
                        for c in range(wide):
                            s[TILE * r + c] += y[(i + r) * n + k] * y_transposed[k * m + j + c]
            for r in range(high):
                for c in range(wide):
                    a[<int64_t>(i + r) * m + j + c] = a[<int64_t>(j + c) * m + i + r] = s[TILE * r + c]
            if has_passed(deadline, TILE * TILE * n * 0.5):     # A multiply-add takes 0.5 ns.
                return -1
    for i in range(m):                                  # Add D to the dense (m, m) matrix and compress it.
        count[i] = to
        for j in range(m):
            x = a[<int64_t>i * m + j]
            if i == j:
                x += diagonal[i]
            if x != 0.0:
                out[to], a[to] = j, x
                to += 1
    count[m] = to
    return to


def form_gram_matrix(const double[::1] data, const int32_t[::1] indices, const int32_t[::1] indptr, int n,
                     const double[::1] diagonal, Deadline deadline=None):
    """Return (indptr, indices, data) of Y Y^T + D, columns sorted, for Y (m, n) in compressed rows and D = diag(diagonal).

    Return None if the deadline has passed before the end.
    """
    cdef int32_t m = <int32_t>indptr.shape[0] - 1, nnz = <int32_t>indices.shape[0], total
    cdef deadline_t* end = get_pointer(deadline)
    cdef int32_t[::1] whole = np.empty(n + 2 + nnz + 2 * m + 1, np.int32), count, out
    cdef double[::1] value = np.empty(nnz + m + 1), entry
    cdef const int32_t* columns = &indices[0] if nnz else NULL
    cdef const double* numbers = &data[0] if nnz else NULL
    cdef bint full
    cdef int32_t* ptr = &whole[0]
    cdef int32_t* row = ptr + n + 2
    cdef int32_t* scratch = row + nnz
    count_array = np.zeros(m + 1, np.int32)
    if m == 0:
        return count_array, np.empty(0, np.int32), np.empty(0)
    count = count_array
    with nogil:
        transpose_csr(m, n, &indptr[0], columns, numbers, ptr, row, &value[0])
        full = nnz > 0 and <int64_t>m * m < INT32_MAX and has_identical_row_columns(m, &indptr[0], columns)
        if full:
            count[m] = m * m
            total = 0
        else:
            total = count_gram_entries(m, &indptr[0], columns, ptr, row, scratch, &count[0], end) - 1
    if total < 0:
        return None
    out_array, entry_array = np.empty(count[m], np.int32), np.empty(count[m])
    out, entry = out_array, entry_array
    with nogil:
        if full:
            total = form_dense_gram_matrix(m, nnz // m, numbers, &value[0], &diagonal[0], &count[0], &out[0], &entry[0], end)
        else:
            total = form_sparse_gram_matrix(m, &indptr[0], columns, numbers, ptr, row, &value[0], &diagonal[0], scratch,
                                            &value[nnz], &count[0], &out[0], &entry[0], end)
    if total < 0:
        return None
    return count_array, out_array[:total], entry_array[:total]
