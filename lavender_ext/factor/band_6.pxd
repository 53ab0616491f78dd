"""LDL^T of factor/band.pxd where rows come in sixes, a body each: six columns at once.

The storage and (1) are those of factor/band.pxd; the six columns of a body end at the same row, so that a column that
they change is read and written once instead of six times. On wide bands that is why this second way is here: a step of
`newton` on a pile of 60 boxes takes 4 ms instead of 11. Narrow bands, and those that end raggedly, go one column at a
time.
"""
from libc.stdint cimport int32_t, int64_t


cdef inline void sub_columns(double* to, int32_t length, const double* c0, const double* c1, const double* c2,
                             const double* c3, const double* c4, const double* c5, const double* l) noexcept nogil:
    # to -= sum of l times columns
    cdef double l0 = l[0], l1 = l[1], l2 = l[2], l3 = l[3], l4 = l[4], l5 = l[5]
    cdef int32_t t
    if l0 == 0.0 and l1 == 0.0 and l2 == 0.0 and l3 == 0.0 and l4 == 0.0 and l5 == 0.0:
        return                                          # bodies that do not touch, and no fill
    for t in range(length):
        to[t] -= ((l0 * c0[t] + l1 * c1[t]) + (l2 * c2[t] + l3 * c3[t])) + (l4 * c4[t] + l5 * c5[t])


cdef inline int32_t ldl_factor_6(int32_t n, int32_t width, double* band, const double* size) noexcept nogil:
    """N = L D L^T, six columns of a body at once; 0 where a pivot is lost. size (n) is the diagonal.

    band[i width] is 1 / D_i after it, and the rest of a column what it was before its division. Column j of a
    body ends where its body's others end: six columns reach down to the same row.
    """
    cdef int32_t i, j, k, q, first, end
    cdef double p
    cdef double x[6]
    cdef double l[6]
    cdef const double* c[6]
    for first in range(0, n, 6):
        end = first + width if first + width < n else n
        for j in range(6):
            i = first + j
            for q in range(6):
                # what row i has in the columns before it; the others take no part
                k = q if q < j else 0
                c[q] = band + <int64_t>(first + k) * width + (j - k)
                l[q] = c[q][0] * x[q] if q < j else 0.0
            sub_columns(band + <int64_t>i * width, end - i, c[0], c[1], c[2], c[3], c[4], c[5], l)
            p = band[<int64_t>i * width]
            if not p > 1e-15 * size[i]:
                return 0
            x[j] = 1.0 / p
            # the diagonal is read as a row of column j no more
            band[<int64_t>i * width] = x[j]
        for k in range(first + 6, end):
            for q in range(6):
                c[q] = band + <int64_t>(first + q) * width + (k - first - q)
                l[q] = c[q][0] * x[q]
            sub_columns(band + <int64_t>k * width, end - k, c[0], c[1], c[2], c[3], c[4], c[5], l)
    return 1


cdef inline void ldl_solve_6(int32_t n, int32_t width, const double* band, double* u) noexcept nogil:
    """u (n) <- N^-1 u after `ldl_factor_6`."""
    cdef int32_t i, j, q, t, first, end, below
    cdef double s0, s1, s2, s3, s4, s5, y
    cdef double l[6]
    cdef const double* c[6]
    for first in range(0, n, 6):
        end = first + width if first + width < n else n
        for j in range(6):
            i = first + j
            c[j] = band + <int64_t>i * width
            l[j] = u[i] * c[j][0]
            for q in range(1, 6 - j):
                u[i + q] -= c[j][q] * l[j]
            c[j] += 6 - j
        sub_columns(u + first + 6, end - first - 6, c[0], c[1], c[2], c[3], c[4], c[5], l)
    for first in range(n - 6, -1, -6):
        end = first + width if first + width < n else n
        below = first + 6
        for j in range(6):
            c[j] = band + <int64_t>(first + j) * width + (6 - j)
        s0 = s1 = s2 = s3 = s4 = s5 = 0.0
        for t in range(end - below):
            y = u[below + t]
            s0 += c[0][t] * y
            s1 += c[1][t] * y
            s2 += c[2][t] * y
            s3 += c[3][t] * y
            s4 += c[4][t] * y
            s5 += c[5][t] * y
        l[0] = s0
        l[1] = s1
        l[2] = s2
        l[3] = s3
        l[4] = s4
        l[5] = s5
        for j in range(5, -1, -1):
            y = u[first + j] - l[j]
            for q in range(1, 6 - j):
                y -= c[j][q - (6 - j)] * u[first + j + q]
            u[first + j] = y * band[<int64_t>(first + j) * width]
