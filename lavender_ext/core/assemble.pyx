"""A = J M^-1 J^T + diag(compliance) in compressed rows, from the factored form, in time linear in its entries.

    A_rc = sum over the bodies that rows r and c share of J_r . (M^-1 J^T)_c

Blocks that meet at a body are found from the blocks of each body; entries that are exactly zero are left out.
A_rc is formed once, from r <= c, so that A is symmetric to the bit.
"""
from libc.stdint cimport INT32_MAX, int32_t, int64_t

import numpy as np

from lavender_ext.core.csr cimport by_columns
from lavender_ext.core.door cimport is_number
from lavender_ext.core.parts cimport blocks_t, n_directions, n_turns
from lavender_ext.core.problem cimport Data
from lavender_ext.core.rows cimport contact_jacobian, dot6, minv_times
from lavender_ext.core.view cimport bodies_of, rows_t

cdef object F8 = np.dtype(np.float64), I4 = np.dtype(np.int32)


cdef public void lav_expand_rows(const blocks_t* p, const rows_t* r, double* jac, double* minv_jac) noexcept nogil:
    """J and M^-1 J^T of every row as (m, 12), in the layout of joint rows."""
    cdef int32_t i, j, k, c, a, b, end
    for i in range(p.n_blocks):
        j = p.ptr[i]
        end = p.ptr[i + 1]
        a = bodies_of(r, i)[0]
        b = bodies_of(r, i)[1]
        if i < r.n_joints:
            for k in range(12 * j, 12 * end):
                jac[k] = r.jac[k]
        else:
            c = i - r.n_joints
            contact_jacobian(r, c, n_directions(p, i), n_turns(p, i), jac + 12 * j)
        for k in range(j, end):
            minv_times(jac + 12 * k, r.inv_mass, r.inv_inertia, a, b, minv_jac + 12 * k)


cdef public void lav_body_blocks(const blocks_t* p, const rows_t* r, int32_t* start, int32_t* blocks,
                                 int64_t* bound) noexcept nogil:
    """Blocks of each body: blocks[start[i]:start[i + 1]], increasing; start (n + 1), blocks (2 k).

    bound[0] becomes a bound on the entries of A.
    """
    cdef int32_t i, s, x, t, sum_ = 0
    cdef int64_t here
    for i in range(r.n_bodies + 1):
        start[i] = 0
    for i in range(p.n_blocks):
        for s in range(2):
            x = bodies_of(r, i)[s]
            if x >= 0:
                start[x] += 1
    for i in range(r.n_bodies + 1):
        t = start[i]
        start[i] = sum_
        sum_ += t
    for i in range(p.n_blocks):
        for s in range(2):
            x = bodies_of(r, i)[s]
            if x >= 0:
                blocks[start[x]] = i
                start[x] += 1
    i = r.n_bodies
    while i > 0:
        start[i] = start[i - 1]
        i -= 1
    start[0] = 0
    bound[0] = 0
    for i in range(p.n_blocks):
        here = p.ptr[i + 1] - p.ptr[i]
        t = (bodies_of(r, i)[0] >= 0) + (bodies_of(r, i)[1] >= 0)
        bound[0] += here if t == 0 else (1 - t) * here * here    # a block meets itself once, not at both bodies
    for i in range(r.n_bodies):
        here = 0
        for x in range(start[i], start[i + 1]):
            here += p.ptr[blocks[x] + 1] - p.ptr[blocks[x]]
        bound[0] += here * here


cdef inline int32_t meet(const rows_t* r, int32_t i, const int32_t* start, const int32_t* blocks, int32_t* out) noexcept nogil:
    # Blocks that share a body with block i, increasing: the merge of two sorted lists; i itself always.
    cdef int32_t a = bodies_of(r, i)[0], b = bodies_of(r, i)[1], x = 0, y = 0, xe = 0, ye = 0, n = 0, u, v
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


cdef inline int32_t shared_sides(const rows_t* r, int32_t i, int32_t j) noexcept nogil:
    # Bit 2 s + t: side s of block i and side t of block j are the same moving body.
    cdef int32_t s, t, x, bits = 0
    for s in range(2):
        x = bodies_of(r, i)[s]
        for t in range(2):
            if x >= 0 and x == bodies_of(r, j)[t]:
                bits |= 1 << (2 * s + t)
    return bits


cdef inline double meeting(const double* jac, const double* minv_jac, int32_t bits) noexcept nogil:
    # sum over the shared bodies; bit 2 s + t: side s of jac, side t of minv_jac.
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


cdef inline int32_t single(int32_t bits) noexcept nogil:
    # Which of the four bits, where it is one alone; else -1.
    if bits == 1:
        return 0
    if bits == 2:
        return 1
    if bits == 4:
        return 2
    return 3 if bits == 8 else -1


cdef public void lav_assemble(const blocks_t* p, const rows_t* r, const double* jac, const double* minv_jac,
                              const int32_t* start, const int32_t* blocks, int32_t* near, int32_t* sides,
                              int32_t* next_, int32_t* indptr, int32_t* indices, double* data) noexcept nogil:
    """Rows of A into indptr (m + 1), indices, data; near, sides (2 k + 1), next_ (m) are scratch.

    next_[c] is the entry of row c that the row of its column, which comes later, copies.
    """
    cdef int32_t i, n, q, j, row, col, end, at, bit, nnz = 0
    cdef double value
    cdef const double* x
    cdef const double* y
    indptr[0] = 0
    for i in range(p.n_blocks):
        n = meet(r, i, start, blocks, near)
        for q in range(n):
            sides[q] = shared_sides(r, i, near[q]) if i <= near[q] else 0
        for row in range(p.ptr[i], p.ptr[i + 1]):
            for q in range(n):
                j = near[q]
                col = p.ptr[j]
                end = p.ptr[j + 1]
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
                # The lower block gives J, the higher M^-1 J^T.
                if col == row:
                    value = (meeting(jac + 12 * row, minv_jac + 12 * row, sides[q]) + r.compliance[row])
                    if value != 0.0:
                        indices[nnz] = row
                        data[nnz] = value
                        nnz += 1
                    next_[row] = nnz
                    col += 1
                bit = single(sides[q])
                if bit >= 0:
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
                        value = meeting(jac + 12 * row, minv_jac + 12 * col, sides[q])
                        indices[nnz] = col
                        data[nnz] = value
                        nnz += value != 0.0
                        col += 1
            indptr[row + 1] = nnz


def bound(Data p):
    """(most entries A can have, start, blocks): how large A gets before it is formed."""
    start_ = np.empty(p.rows.n_bodies + 1, np.int32)    # a view made an array again costs more than the view
    blocks_ = np.empty(2 * p.blocks.n_blocks + 1, np.int32)
    cdef int32_t[::1] start = start_, blocks = blocks_
    cdef int64_t most
    lav_body_blocks(&p.blocks, &p.rows, &start[0], &blocks[0], &most)
    return most, start_, blocks_


def delassus(Data p, Py_ssize_t most, int32_t[::1] start, int32_t[::1] blocks):
    """A as (indptr, indices, data) of compressed rows with sorted columns; arguments are `bound(p)`, most < 2^31."""
    cdef Py_ssize_t m = p.blocks.n_rows
    cdef int32_t nnz
    data_, indices_, indptr_ = np.empty(most + 1), np.empty(most + 1, np.int32), np.zeros(m + 1, np.int32)
    cdef double[::1] jac = np.empty(24 * m + 1), data = data_
    cdef double* minv_jac = &jac[12 * m]
    cdef int32_t[::1] indices = indices_, indptr = indptr_
    cdef int32_t[::1] near = np.empty(4 * p.blocks.n_blocks + 2 + m, np.int32)
    with nogil:
        lav_expand_rows(&p.blocks, &p.rows, &jac[0], minv_jac)
        lav_assemble(&p.blocks, &p.rows, &jac[0], minv_jac, &start[0], &blocks[0], &near[0],
                     &near[2 * p.blocks.n_blocks + 1], &near[0] + 4 * p.blocks.n_blocks + 2, &indptr[0], &indices[0],
                     &data[0])
    nnz = indptr[m]
    found = indices_[:nnz], data_[:nnz]
    if nnz < 0.75 * most:                               # a copy costs more than a quarter of unused workspace
        found = found[0].copy(), found[1].copy()
    return (indptr_, *found)


def dense_to_csr(const double[:, ::1] a, double sign=1.0):
    """Nonzeros of a dense matrix times a sign as (indptr, indices, data), int32; nnz must be below 2^31."""
    cdef Py_ssize_t i, j, n = a.shape[0], m = a.shape[1], nnz = 0, q = 0
    for i in range(n):
        for j in range(m):
            nnz += a[i, j] != 0.0
    whole, numbers = np.empty(n + 1 + nnz, np.int32), np.empty(nnz)
    cdef int32_t[::1] indptr = whole
    cdef double[::1] data = numbers
    cdef int32_t* indices = &indptr[0] + n + 1
    indptr[0] = 0
    for i in range(n):
        for j in range(m):
            if a[i, j] != 0.0:
                indices[q] = <int32_t>j
                data[q] = sign * a[i, j]
                q += 1
        indptr[i + 1] = <int32_t>q
    whole.setflags(False)
    numbers.setflags(False)
    return whole[:n + 1], whole[n + 1:], numbers


def transposed(const int32_t[::1] indptr, const int32_t[::1] indices, const double[::1] data, int n):
    """(indptr, indices, data) of the transpose of a matrix (m, n) in compressed rows."""
    cdef Py_ssize_t nnz = indices.shape[0]
    ptr_array, row_array, value_array = np.empty(n + 2, np.int32), np.empty(max(nnz, 1), np.int32), np.empty(max(nnz, 1))
    cdef int32_t[::1] ptr = ptr_array, row = row_array
    cdef double[::1] value = value_array
    by_columns(<int32_t>indptr.shape[0] - 1, n, &indptr[0], &indices[0] if nnz else NULL, &data[0] if nnz else NULL,
               &ptr[0], &row[0], &value[0])
    return ptr_array[:n + 1], row_array[:nnz], value_array[:nnz]


def mirrored(const int32_t[::1] indptr, const int32_t[::1] indices, const double[::1] data):
    """(indptr, indices, data) of both triangles of a symmetric matrix from the rows of its lower one, diagonal last."""
    cdef Py_ssize_t n = indptr.shape[0] - 1, nnz = indices.shape[0]
    cdef Py_ssize_t i, q, k = 0
    upper = transposed(indptr, indices, data, n)
    cdef const int32_t[::1] above = upper[0], column = upper[1]
    cdef const double[::1] number = upper[2]
    ptr_array, index_array, value_array = np.zeros(n + 1, np.int32), np.empty(2 * nnz - n, np.int32), np.empty(2 * nnz - n)
    cdef int32_t[::1] ptr = ptr_array, index = index_array
    cdef double[::1] value = value_array
    for i in range(n):
        for q in range(indptr[i], indptr[i + 1]):
            index[k] = indices[q]
            value[k] = data[q]
            k += 1
        for q in range(above[i] + 1, above[i + 1]):     # the diagonal is there already
            index[k] = column[q]
            value[k] = number[q]
            k += 1
        ptr[i + 1] = <int32_t>k
    return ptr_array, index_array, value_array


cdef int32_t count_rows(Py_ssize_t lines, Py_ssize_t across, const int32_t* ptr, const int32_t* idx, const double* val,
                        bint columns, int32_t* count) noexcept nogil:
    # count[row] += its nonzeros; False where the matrix has no ascending indices in range, or numbers that the door excludes.
    cdef Py_ssize_t i
    cdef int32_t p
    for i in range(lines):
        if ptr[i + 1] < ptr[i]:
            return False
        for p in range(ptr[i], ptr[i + 1]):
            if not 0 <= idx[p] < across or p > ptr[i] and idx[p] <= idx[p - 1]:
                return False
            if not is_number(val[p]):
                return False
            count[idx[p] if columns else i] += val[p] != 0.0
    return True


def stacked(int32_t n, parts):
    """Rows of n columns of several matrices, one under another, as (indptr, indices, data) without entries that are zero.

    A part is (indptr, indices, data, whether these are of columns, a sign that it is multiplied with, its rows). None where a
    part is not int32 and float64 in canonical form, and inside the door: who checks at length finds the words.
    """
    cdef const int32_t[::1] ptr, idx
    cdef const double[::1] val
    cdef double sign
    cdef bint columns
    cdef int32_t m = 0, rows, first, i, p, nnz
    for part in parts:
        m += part[5]
        if part[0].dtype is not I4 or part[1].dtype is not I4 or part[2].dtype is not F8:
            return None
    indptr = np.zeros(m + 2, np.int32)                  # one before, so that filling moves each pointer to its row's end
    cdef int32_t[::1] start = indptr
    first = 0
    for ptr_, idx_, val_, columns, _, rows in parts:
        ptr, idx, val = ptr_, idx_, val_
        if ptr.shape[0] != (n if columns else rows) + 1 or ptr[0] != 0 or ptr[ptr.shape[0] - 1] > idx.shape[0] \
                or idx.shape[0] != val.shape[0]:
            return None
        if idx.shape[0] and not count_rows(ptr.shape[0] - 1, rows if columns else n, &ptr[0], &idx[0], &val[0], columns,
                                           &start[2] + first if rows else NULL):
            return None
        first += rows
    for i in range(m):
        start[i + 2] += start[i + 1]
    nnz = start[m + 1]
    indices, data = np.empty(nnz, np.int32), np.empty(nnz)
    cdef int32_t[::1] column = indices
    cdef double[::1] value = data
    first = 1
    for ptr_, idx_, val_, columns, sign, rows in parts:
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


cdef public void lav_gram_pattern(int32_t m, const int32_t* indptr, const int32_t* indices, const int32_t* ptr,
                                  const int32_t* row, int32_t* mark, int32_t* count) noexcept nogil:
    """count (m + 1): where each row of Y Y^T + D begins, its diagonal always there; mark (m) is scratch."""
    cdef int32_t i, q, p, k
    for i in range(m):
        mark[i] = -1
    count[0] = 0
    for i in range(m):
        mark[i] = i
        k = 1
        for q in range(indptr[i], indptr[i + 1]):
            for p in range(ptr[indices[q]], ptr[indices[q] + 1]):
                if mark[row[p]] != i:
                    mark[row[p]] = i
                    k += 1
        count[i + 1] = count[i] + k


cdef public int32_t lav_gram(int32_t m, const int32_t* indptr, const int32_t* indices, const double* data,
                             const int32_t* ptr, const int32_t* row, const double* value, const double* diagonal,
                             int32_t* next, double* sum_, int32_t* count, int32_t* out, double* entry) noexcept nogil:
    """Y Y^T + D by columns, which are its rows; entries in all, those that are zero left out.

    Each is a sum over the columns of Y in their order, the same for (i, j) and (j, i). count is from
    `lav_gram_pattern`; next (2 m) is scratch, sum_ (m).
    """
    cdef int32_t i, j, q, p, k, to = 0, begin
    cdef int32_t* list_ = next + m
    cdef double y
    # Row i adds itself to every column it meets: rows of each column ascend.
    for i in range(m):
        next[i] = count[i]
        sum_[i] = 0.0
        list_[i] = -1
    for i in range(m):
        # Entries of row i, linked through `list_` from the last to the first: no order is needed.
        k = i
        list_[i] = i
        for q in range(indptr[i], indptr[i + 1]):
            y = data[q]
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
    TILE = 4                    # rows and columns of A whose sums are in registers


cdef bint is_full(int32_t m, const int32_t* indptr, const int32_t* indices) noexcept nogil:
    """Has every row entries in the same columns, in ascending order?"""
    cdef int32_t i, q, n = indptr[1]
    for i in range(m):
        if indptr[i + 1] != (i + 1) * n:
            return False
        for q in range(n):
            if indices[i * n + q] != indices[q] or (q > 0 and indices[q] <= indices[q - 1]):
                return False
    return True


cdef void full_gram(int32_t m, int64_t n, const double* y, const double* across, double* a) noexcept nogil:
    """a (m, m) = Y Y^T of Y (m, n), in `across` by columns; each entry a sum in their order, as of `lav_gram`."""
    cdef int32_t tiles = (m + TILE - 1) // TILE, down, right, i, j, r, c, high, wide
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
                            s[TILE * r + c] += x * across[k * m + j + c]
            else:
                for k in range(n):
                    for r in range(high):
                        for c in range(wide):
                            s[TILE * r + c] += y[(i + r) * n + k] * across[k * m + j + c]
            for r in range(high):
                for c in range(wide):
                    a[<int64_t>(i + r) * m + j + c] = a[<int64_t>(j + c) * m + i + r] = s[TILE * r + c]


cdef int32_t full_rows(int32_t m, const double* diagonal, int32_t* count, int32_t* out, double* entry) noexcept nogil:
    """D is added to A (m, m), and entries that are zero are left out."""
    cdef int32_t i, j, to = 0
    cdef double x
    for i in range(m):
        count[i] = to
        for j in range(m):
            x = entry[<int64_t>i * m + j]
            if i == j:
                x += diagonal[i]
            if x != 0.0:
                out[to], entry[to] = j, x
                to += 1
    count[m] = to
    return to


def gram(const double[::1] data, const int32_t[::1] indices, const int32_t[::1] indptr, int n, const double[::1] diagonal):
    """(indptr, indices, data) of Y Y^T + D, columns sorted, of Y (m, n) in compressed rows; D = diag(diagonal)."""
    cdef int32_t m = <int32_t>indptr.shape[0] - 1, nnz = <int32_t>indices.shape[0], total
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
        by_columns(m, n, &indptr[0], columns, numbers, ptr, row, &value[0])
        full = nnz > 0 and <int64_t>m * m < INT32_MAX and is_full(m, &indptr[0], columns)
        if full:
            count[m] = m * m
        else:
            lav_gram_pattern(m, &indptr[0], columns, ptr, row, scratch, &count[0])
    out_array, entry_array = np.empty(count[m], np.int32), np.empty(count[m])
    out, entry = out_array, entry_array
    with nogil:
        if full:
            full_gram(m, nnz // m, numbers, &value[0], &entry[0])
            total = full_rows(m, &diagonal[0], &count[0], &out[0], &entry[0])
        else:
            total = lav_gram(m, &indptr[0], columns, numbers, ptr, row, &value[0], &diagonal[0], scratch, &value[nnz],
                             &count[0], &out[0], &entry[0])
    return count_array, out_array[:total], entry_array[:total]
