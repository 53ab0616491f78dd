"""Rows of a compressed sparse row matrix: the products that sweeps and the judge share."""
from libc.math cimport fabs
from libc.stdint cimport int32_t


cdef struct csr_t:
    const int32_t* indptr       # (m + 1)
    const int32_t* indices      # (nnz)
    const double* data          # (nnz) 1/kg


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


cdef inline double csr_abs_dot(const csr_t* a, int32_t i, const double* x) noexcept nogil:
    # sum_j |A_ij| |x_j|
    cdef int32_t p, end = a.indptr[i + 1]
    cdef double s = 0.0
    for p in range(a.indptr[i], end):
        s += fabs(a.data[p]) * fabs(x[a.indices[p]])
    return s


cdef inline double csr_dot_size(const csr_t* a, int32_t i, const double* x, double* size) noexcept nogil:
    # csr_dot, to the bit, and sum_j |A_ij x_j| into size.
    cdef int32_t p = a.indptr[i], end = a.indptr[i + 1]
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
