"""Rows of a compressed sparse row matrix: the products that sweeps and the judge share."""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.view cimport csr_t


cdef enum:
    LONG_ROW = 128              # Entries that one running sum rounds to about the floor of the judge; longer rows are split.


cdef inline double csr_dot(const csr_t* a, int32_t i, const double* x) noexcept nogil:
    # sum_j A_ij x_j in four running sums: a fixed order of additions, four times the throughput.
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


cdef inline double range_dot_size(const csr_t* a, int32_t p, int32_t end, const double* x, double* size) noexcept nogil:
    # The sum over entries [p, end) in the order of csr_dot; that of absolute values into size.
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


cdef inline double csr_dot_long(const csr_t* a, int32_t i, const double* x, double* size) noexcept nogil:
    # csr_dot, to the bit, and sum_j |A_ij x_j| into size. A row of more than LONG_ROW entries is summed in parts, and the
    # sum of the parts is compensated.
    cdef int32_t p = a.indptr[i], last = a.indptr[i + 1], end
    cdef double high = 0.0, low = 0.0, term, part, total, back
    if last - p <= LONG_ROW:
        return range_dot_size(a, p, last, x, size)
    size[0] = 0.0
    while p < last:
        end = p + LONG_ROW if last - p > LONG_ROW else last
        term = range_dot_size(a, p, end, x, &part)
        size[0] += part
        total = high + term
        back = total - high
        low += (high - (total - back)) + (term - back)
        high = total
        p = end
    return high + low if low == low else high          # what overflows is infinite


cdef inline void by_columns(int32_t m, int32_t n, const int32_t* indptr, const int32_t* indices, const double* data,
                            int32_t* ptr, int32_t* row, double* value) noexcept nogil:
    """A matrix (m, n) in compressed rows by its columns, rows ascending; ptr (n + 2)."""
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


cdef inline double own_share(double gap, double d_i, double d_j) noexcept nogil:
    """|A_ij - A_ji| / sqrt(d_i d_j): of rows of heavy bodies, too, whose entries are small."""
    return gap / sqrt(d_i) / sqrt(d_j) if gap > 0.0 else 0.0


cdef inline double scan_entries(const csr_t* a, const double* d, int32_t n, int32_t* cursor,
                                int32_t* band) noexcept nogil:
    """Asymmetry of A; its lower and upper bandwidth into band[2]; columns are sorted.

        max |A - A^T| / max |A|;    where that is rounding, up to 1e-14:  max |A_ij - A_ji| / sqrt(d_i d_j) above 1e-10

    cursor (n) is scratch: the first entry of row j that no earlier row has looked up as its mirror image.
    """
    cdef int32_t i, j, q
    cdef double x, gap = 0.0, big = 0.0, own = 0.0
    band[0] = 0
    band[1] = 0
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
                    own = max(own, own_share(x, d[i], d[j]))
                continue
            if j == i:
                continue
            while cursor[j] < a.indptr[j + 1] and a.indices[cursor[j]] < i:
                gap = max(gap, fabs(a.data[cursor[j]]))
                own = max(own, own_share(fabs(a.data[cursor[j]]), d[j], d[a.indices[cursor[j]]]))
                cursor[j] += 1
            if cursor[j] < a.indptr[j + 1] and a.indices[cursor[j]] == i:
                x = fabs(a.data[q] - a.data[cursor[j]])
                cursor[j] += 1
            gap = max(gap, x)
            own = max(own, own_share(x, d[i], d[j]))
    gap = gap / big if big > 0.0 else 0.0
    return own if gap <= 1e-14 and own > 1e-10 else gap
