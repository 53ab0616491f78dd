"""Products with K: from rows to bodies and back."""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.newton.elements cimport elements_t


cdef inline void to_bodies_of_size(const elements_t* e, int32_t n, const double* x, double* y, const int32_t s) noexcept nogil:
    cdef int32_t h, i, j, c, first, second
    cdef const double *p
    cdef double u
    cdef double sum[12]
    for i in range(n * s):
        y[i] = 0.0
    for h in range(e.n_groups):
        i = e.group[h]
        first = e.node[2 * i]
        second = e.node[2 * i + 1]
        if first < 0:
            continue
        for c in range(2 * s):
            sum[c] = 0.0
        for j in range(e.ptr[i], e.ptr[e.group[h + 1]]):
            p = e.panel + <int64_t>j * 2 * s
            u = x[j]
            for c in range(2 * s):
                sum[c] += p[c] * u
        for c in range(s):
            y[first * s + c] += sum[c]
        if second >= 0:
            for c in range(s):
                y[second * s + c] += sum[s + c]


cdef inline void to_rows_of_size(const elements_t* e, const double* y, double* x, const int32_t s) noexcept nogil:
    cdef int32_t h, i, j, c, first, second
    cdef const double *p
    cdef double t, u
    cdef double of[12]
    for h in range(e.n_groups):
        i = e.group[h]
        first = e.node[2 * i]
        second = e.node[2 * i + 1]
        for c in range(s):
            of[c] = y[first * s + c] if first >= 0 else 0.0
            of[s + c] = y[second * s + c] if second >= 0 else 0.0
        for j in range(e.ptr[i], e.ptr[e.group[h + 1]]):
            p = e.panel + <int64_t>j * 2 * s
            t = u = 0.0
            for c in range(s):
                t += p[2 * c] * of[2 * c]
                u += p[2 * c + 1] * of[2 * c + 1]
            x[j] = t + u


cdef inline void to_bodies(const elements_t* e, int32_t n, const double* x, double* y) noexcept nogil:
    """y = K^T x, (n, s)."""
    if e.s == 1:
        to_bodies_of_size(e, n, x, y, 1)
    elif e.s == 3:
        to_bodies_of_size(e, n, x, y, 3)
    elif e.s == 6:
        to_bodies_of_size(e, n, x, y, 6)
    else:
        to_bodies_of_size(e, n, x, y, e.s)


cdef inline void to_rows(const elements_t* e, const double* y, double* x) noexcept nogil:
    """x = K y, (m)."""
    if e.s == 1:
        to_rows_of_size(e, y, x, 1)
    elif e.s == 3:
        to_rows_of_size(e, y, x, 3)
    elif e.s == 6:
        to_rows_of_size(e, y, x, 6)
    else:
        to_rows_of_size(e, y, x, e.s)
