"""H as a band: c[j width + t] = H[j + t, j] of rows in another order, elements whole."""
from libc.stdint cimport int32_t, int64_t

import numpy as np

from lavender_ext.newton.elements cimport Elements, elements_t


cdef public void lav_band(int32_t m, const int32_t* indptr, const int32_t* indices, const double* a,
                          const int32_t* place, const double* scale, int32_t width, double* c) noexcept nogil:
    """Lower half of diag(scale) A diag(scale), its row i at place[i]; scale (m) in A's order."""
    cdef int32_t i, j, q
    cdef int64_t n
    for n in range(<int64_t>m * width):
        c[n] = 0.0
    for i in range(m):
        for q in range(indptr[i], indptr[i + 1]):
            j = indices[q]
            if place[i] >= place[j]:
                c[<int64_t>place[j] * width + place[i] - place[j]] = scale[i] * scale[j] * a[q]


cdef public int32_t lav_band_width(int32_t m, const int32_t* indptr, const int32_t* indices,
                                   const int32_t* place) noexcept nogil:
    """Half bandwidth of A with row i at place[i]."""
    cdef int32_t i, q, x, widest = 0
    for i in range(m):
        for q in range(indptr[i], indptr[i + 1]):
            x = place[i] - place[indices[q]]
            widest = x if x > widest else widest
    return widest


cdef public int32_t lav_element_graph(int32_t n, const int32_t* ptr, const int32_t* element, const int32_t* indptr,
                                      const int32_t* indices, int32_t* mark, int32_t* to, int32_t* other) noexcept nogil:
    """Which elements an element's rows of A reach: (to, other) as compressed rows, other as long as A's indices."""
    cdef int32_t i, j, q, k, count = 0
    for i in range(n):
        mark[i] = -1
    for i in range(n):
        to[i] = count
        for j in range(ptr[i], ptr[i + 1]):
            for q in range(indptr[j], indptr[j + 1]):
                k = element[indices[q]]
                if mark[k] != i:
                    mark[k] = i
                    other[count] = k
                    count += 1
    to[n] = count
    return count


cdef public void lav_band_free(int32_t m, int32_t width, const double* c, const double* free, double eps,
                               double* out) noexcept nogil:
    """H + eps where free (m), in the band's order, is not 0; the identity elsewhere."""
    cdef int32_t j, t
    cdef int64_t q
    for j in range(m):
        q = <int64_t>j * width
        if free[j] == 0.0:
            for t in range(width):
                out[q + t] = 0.0
            out[q] = 1.0
            continue
        for t in range(width):
            out[q + t] = c[q + t] if j + t < m and free[j + t] != 0.0 else 0.0
        out[q] += eps


cdef inline void band_block(const double* c, double* out, int32_t p, int32_t q, int32_t width, const double* left,
                            const double* right, bint diagonal, const int32_t ni, const int32_t nj) noexcept nogil:
    # out_ij = left H_ij right^T (+ I) of the block whose first row is p and first column q
    cdef int32_t k, l, t, r
    cdef bint some = False
    cdef double x
    cdef double block[16]
    cdef double half[16]
    for k in range(ni):
        for l in range(nj):
            r = p + k - q - l
            if r < 0:                                   # above the diagonal, of a diagonal block alone
                x = c[<int64_t>(p + k) * width - r]
            else:
                x = c[<int64_t>(q + l) * width + r] if r < width else 0.0
            block[k * nj + l] = x
            some = some or x != 0.0
    if not some and not diagonal:
        return
    for k in range(ni):
        for l in range(nj):
            x = 0.0
            for t in range(ni):
                x += left[k * ni + t] * block[t * nj + l]
            half[k * nj + l] = x
    for k in range(ni):
        for l in range(nj):
            r = p + k - q - l
            if 0 <= r < width:
                x = 1.0 if r == 0 else 0.0
                for t in range(nj):
                    x += half[k * nj + t] * right[l * nj + t]
                out[<int64_t>(q + l) * width + r] = x


cdef public void lav_band_scaled(const elements_t* e, const int32_t* order, const int32_t* place, int32_t width,
                                 const double* c, const double* bt, double* out) noexcept nogil:
    """I + B^T H B; elements in the band's order (n), place (m) of each row."""
    cdef int32_t h, g, i, j, p, q, ni, nj
    cdef int64_t n
    for n in range(<int64_t>e.m * width):
        out[n] = 0.0
    for h in range(e.n):
        j = order[h]
        nj = e.ptr[j + 1] - e.ptr[j]
        q = place[e.ptr[j]]
        for g in range(h, e.n):
            i = order[g]
            ni = e.ptr[i + 1] - e.ptr[i]
            p = place[e.ptr[i]]
            if p - q >= width + nj:
                break
            if ni == 3 and nj == 3:
                band_block(c, out, p, q, width, bt + e.wptr[i], bt + e.wptr[j], g == h, 3, 3)
            else:
                band_block(c, out, p, q, width, bt + e.wptr[i], bt + e.wptr[j], g == h, ni, nj)


def scaled_band(const int32_t[::1] indptr, const int32_t[::1] indices, const double[::1] a, const int32_t[::1] place,
         const double[::1] scale, double[:, ::1] out):
    """diag(scale) A diag(scale) into a band (m, width), row i at place[i]."""
    if out.shape[0] and a.shape[0]:
        with nogil:
            lav_band(<int32_t>out.shape[0], &indptr[0], &indices[0], &a[0], &place[0], &scale[0],
                     <int32_t>out.shape[1], &out[0, 0])


def band_width(const int32_t[::1] indptr, const int32_t[::1] indices, const int32_t[::1] place):
    """Half bandwidth of A with row i at place[i]; A not empty, its pattern symmetric."""
    cdef int32_t width
    with nogil:
        width = lav_band_width(<int32_t>place.shape[0], &indptr[0], &indices[0], &place[0])
    return width


def element_graph(const int32_t[::1] ptr, const int32_t[::1] element, const int32_t[::1] indptr,
                  const int32_t[::1] indices):
    """(indptr, indices) of the graph of elements that A couples; A not empty."""
    cdef int32_t n = <int32_t>ptr.shape[0] - 1, count
    to_array, other_array = np.empty(n + 1, np.int32), np.empty(indices.shape[0] + 1, np.int32)
    cdef int32_t[::1] mark = np.empty(n + 1, np.int32), to = to_array, other = other_array
    with nogil:
        count = lav_element_graph(n, &ptr[0], &element[0], &indptr[0], &indices[0], &mark[0], &to[0], &other[0])
    return to_array, other_array[:count].copy()


def scaled_entries(const int32_t[::1] indptr, const int32_t[::1] indices, const double[::1] a, const double[::1] scale):
    """Entries of diag(scale) A diag(scale)."""
    out_array = np.empty(a.shape[0])
    cdef double[::1] out = out_array
    cdef int32_t i, q
    with nogil:
        for i in range(indptr.shape[0] - 1):
            for q in range(indptr[i], indptr[i + 1]):
                out[q] = scale[i] * a[q] * scale[indices[q]]
    return out_array


def band_free(const double[:, ::1] c, const double[::1] free, double eps, double[:, ::1] out):
    """H + eps on free rows, the identity elsewhere."""
    with nogil:
        lav_band_free(<int32_t>c.shape[0], <int32_t>c.shape[1], &c[0, 0], &free[0], eps, &out[0, 0])


def band_scaled(Elements e, const int32_t[::1] order, const int32_t[::1] place, const double[:, ::1] c,
                const double[::1] bt, double[:, ::1] out):
    """I + B^T H B."""
    with nogil:
        lav_band_scaled(&e.e, &order[0], &place[0], <int32_t>c.shape[1], &c[0, 0], &bt[0], &out[0, 0])
