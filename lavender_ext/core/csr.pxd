"""Products with rows of a compressed sparse row matrix, shared by sweeps and the judge."""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.view cimport csr_t


cdef enum:
    # Number of entries above which a row is summed in pieces: rounding of a longer sum would exceed the judge's round-off floor.
    LONG_ROW = 128


cdef inline double csr_row_dot(const csr_t* a, int32_t i, const double* x) noexcept nogil:
    """Return sum_j A_ij x_j, in four running sums: a fixed order of additions with four times the throughput of one sum."""
    cdef int32_t p = a.indptr[i], end = a.indptr[i + 1]
    cdef const int32_t* idx = a.indices
    cdef const double* val = a.data
    cdef double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0
    while p + 4 <= end:
        s0 += val[p] * x[idx[p]]
        s1 += val[p + 1] * x[idx[p + 1]]
        s2 += val[p + 2] * x[idx[p + 2]]
        s3 += val[p + 3] * x[idx[p + 3]]
        p += 4
    if p < end:
        s0 += val[p] * x[idx[p]]
        if p + 1 < end:
            s1 += val[p + 1] * x[idx[p + 1]]
            if p + 2 < end:
                s2 += val[p + 2] * x[idx[p + 2]]
    return (s0 + s1) + (s2 + s3)


cdef inline double csr_range_dot_with_abs_sum(const csr_t* a, int32_t p, int32_t end, const double* x, double* size) noexcept nogil:
    """Return the sum over entries [p, end) in the order of csr_row_dot; write the sum of absolute values to `size`."""
    cdef const int32_t* idx = a.indices
    cdef const double* val = a.data
    cdef double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0, f0 = 0.0, f1 = 0.0, f2 = 0.0, f3 = 0.0, t
    while p + 4 <= end:
        t = val[p] * x[idx[p]]
        s0 += t
        f0 += fabs(t)
        t = val[p + 1] * x[idx[p + 1]]
        s1 += t
        f1 += fabs(t)
        t = val[p + 2] * x[idx[p + 2]]
        s2 += t
        f2 += fabs(t)
        t = val[p + 3] * x[idx[p + 3]]
        s3 += t
        f3 += fabs(t)
        p += 4
    if p < end:
        t = val[p] * x[idx[p]]
        s0 += t
        f0 += fabs(t)
        if p + 1 < end:
            t = val[p + 1] * x[idx[p + 1]]
            s1 += t
            f1 += fabs(t)
            if p + 2 < end:
                t = val[p + 2] * x[idx[p + 2]]
                s2 += t
                f2 += fabs(t)
    size[0] = (f0 + f1) + (f2 + f3)
    return (s0 + s1) + (s2 + s3)


cdef inline double csr_row_dot_with_abs_sum(const csr_t* a, int32_t i, const double* x, double* size) noexcept nogil:
    """Return sum_j A_ij x_j and write sum_j |A_ij x_j| to `size`.

    A row of at most LONG_ROW entries gets the bits of csr_row_dot. A longer row is summed in pieces of LONG_ROW entries, and the
    sum of the pieces is compensated.
    """
    cdef int32_t p = a.indptr[i], last = a.indptr[i + 1], end
    cdef double high = 0.0, low = 0.0, term, piece_size, total, added
    if last - p <= LONG_ROW:
        return csr_range_dot_with_abs_sum(a, p, last, x, size)
    size[0] = 0.0
    while p < last:
        end = p + LONG_ROW if last - p > LONG_ROW else last
        term = csr_range_dot_with_abs_sum(a, p, end, x, &piece_size)
        size[0] += piece_size
        total = high + term
        added = total - high
        low += (high - (total - added)) + (term - added)
        high = total
        p = end
    return high + low if low == low else high          # low is NaN if the sum overflows


cdef inline void transpose_csr(int32_t m, int32_t n, const int32_t* indptr, const int32_t* indices, const double* data,
                               int32_t* ptr, int32_t* row, double* value) noexcept nogil:
    """Transpose a matrix (m, n) in compressed rows: pointers in ptr (n + 2), ascending rows, values."""
    cdef int32_t i, j, q
    for j in range(n + 2):
        ptr[j] = 0
    for q in range(indptr[m]):
        ptr[indices[q] + 2] += 1
    for j in range(2, n + 2):
        ptr[j] += ptr[j - 1]
    for i in range(m):
        for q in range(indptr[i], indptr[i + 1]):
            j = indices[q] + 1
            row[ptr[j]] = i
            value[ptr[j]] = data[q]
            ptr[j] += 1


cdef inline double scale_asymmetry(double gap, double d_i, double d_j) noexcept nogil:
    """Return gap / sqrt(d_i d_j) for gap = |A_ij - A_ji|: also meaningful for heavy bodies with small entries."""
    return gap / sqrt(d_i) / sqrt(d_j) if gap > 0.0 else 0.0


cdef inline double measure_asymmetry_and_bandwidth(const csr_t* a, const double* d, int32_t n, int32_t* cursor,
                                                   int32_t* band) noexcept nogil:
    """Return the asymmetry of A and write its lower and upper bandwidth to band[2]; columns must be sorted.

    The asymmetry is max |A - A^T| / max |A|. If that is rounding (at most 1e-14) and max |A_ij - A_ji| / sqrt(d_i d_j) is
    above 1e-10, it is the latter.

    cursor (n) is scratch: the first entry of row j that has not yet been matched with its mirror image in an earlier row.
    """
    cdef int32_t i, j, q
    cdef double x, gap = 0.0, big = 0.0, scaled = 0.0
    band[0] = band[1] = 0
    for i in range(n):
        cursor[i] = a.indptr[i]
    for i in range(n):
        if a.indptr[i] < a.indptr[i + 1]:
            j = i - a.indices[a.indptr[i]]
            if j > band[0]:
                band[0] = j
            j = a.indices[a.indptr[i + 1] - 1] - i
            if j > band[1]:
                band[1] = j
        for q in range(a.indptr[i], a.indptr[i + 1]):
            x = fabs(a.data[q])
            if x > big:
                big = x
            j = a.indices[q]
            if j < i:
                if q >= cursor[i]:                      # no mirror image above the diagonal
                    gap = max(gap, x)
                    scaled = max(scaled, scale_asymmetry(x, d[i], d[j]))
                continue
            if j == i:
                continue
            while cursor[j] < a.indptr[j + 1] and a.indices[cursor[j]] < i:
                gap = max(gap, fabs(a.data[cursor[j]]))
                scaled = max(scaled, scale_asymmetry(fabs(a.data[cursor[j]]), d[j], d[a.indices[cursor[j]]]))
                cursor[j] += 1
            if cursor[j] < a.indptr[j + 1] and a.indices[cursor[j]] == i:
                x = fabs(a.data[q] - a.data[cursor[j]])
                cursor[j] += 1
            gap = max(gap, x)
            scaled = max(scaled, scale_asymmetry(x, d[i], d[j]))
    gap = gap / big if big > 0.0 else 0.0
    return scaled if gap <= 1e-14 and scaled > 1e-10 else gap
