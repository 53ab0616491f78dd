"""The rows of a problem that move, in the scaled unknown of Newton's method, from the problem's own arrays.

    z = D^1/2 lambda,   H = D^-1/2 A D^-1/2,   g = D^-1/2 (b - A fixed)

An element is a bounded row, or a contact with the tangents and the spin that move. Rows of equal bounds, tangents without
friction and empty rows of A stay where they are.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memset

from lavender_ext.core.block cimport CONTACT, CONTACT_SPIN as SPIN, ROW, blocks_t, ends_apart
from lavender_ext.core.csr cimport csr_t
from lavender_ext.newton.cones cimport KEPT
from lavender_ext.newton.elements cimport elements_t


cdef struct scaled_t:
    elements_t e
    int32_t* keep               # (m) rows that move
    double* fixed               # (rows) impulse of the others
    double* scale               # (m) D^-1/2
    double* speed               # (m) velocity error per unit of the natural map
    int32_t small               # entries of small matrices


cdef inline bint is_known(const blocks_t* p) noexcept nogil:
    """Only rows and contacts of up to two tangents, with or without spin, or boxes of them."""
    cdef int32_t i
    for i in range(p.n_blocks):
        if p.kind[i] != ROW and p.kind[i] != CONTACT and not ends_apart(p.kind[i]):
            return False
    return True


cdef inline bint is_row(const blocks_t* p, int32_t i) noexcept nogil:
    return p.kind[i] == ROW or p.ptr[i + 1] - p.ptr[i] == 1


cdef inline double low_of(const blocks_t* p, int32_t i, int32_t j) noexcept nogil:
    return p.lower[j] if p.kind[i] == ROW else 0.0


cdef inline double high_of(const blocks_t* p, int32_t i, int32_t j) noexcept nogil:
    return p.upper[j] if p.kind[i] == ROW else 1.0 / 0.0


cdef inline bint stays(const blocks_t* p, const csr_t* a, int32_t i, int32_t j, double* at) noexcept nogil:
    """Row j of block i cannot move; its impulse into `at`."""
    cdef int32_t q
    cdef double x = 0.0, low, high
    at[0] = 0.0
    if not is_row(p, i):
        return j > p.ptr[i] and (p.mu[i] == 0.0 or (ends_apart(p.kind[i]) and j == p.ptr[i + 1] - 1
                                                    and p.patch_radius[i] == 0.0))
    low, high = low_of(p, i, j), high_of(p, i, j)
    if low == high:
        at[0] = low
        return True
    for q in range(a.indptr[j], a.indptr[j + 1]):
        x += fabs(a.data[q])
    if x != 0.0:
        return False
    x = high if p.b[j] > 0.0 else low if p.b[j] < 0.0 else 0.0
    x = x if fabs(x) < 1.0 / 0.0 else 0.0
    at[0] = low if x < low else high if x > high else x
    return True


cdef inline int64_t scaled_index(int64_t m) noexcept nogil:
    return 8 * m + 4


cdef inline int64_t scaled_real(int64_t m) noexcept nogil:
    return (9 + 2 * KEPT) * m + 1


cdef inline void lay_scaled(scaled_t* s, int64_t m, int32_t* index, double* real) noexcept nogil:
    """Places in index (`scaled_index`) and real (`scaled_real`)."""
    s.keep = index
    s.e.ptr = index + m
    s.e.kind = index + 2 * m + 1
    s.e.wptr = index + 3 * m + 1
    s.e.node = index + 4 * m + 2                        # no bodies: two and three numbers for each element
    s.e.slot = index + 6 * m + 2
    s.e.group = index + 8 * m + 2
    s.fixed = real
    s.scale = real + m
    s.speed = real + 2 * m
    s.e.theta = real + 3 * m
    s.e.g = real + 4 * m
    s.e.lower = real + 5 * m
    s.e.upper = real + 6 * m
    s.e.at = real + 7 * m
    s.e.as_ = real + 8 * m
    s.e.scaling = real + 9 * m
    s.e.panel = NULL
    s.e.parts = 2
    s.e.ar = NULL
    s.e.s = 1
    s.e.n_groups = 0


cdef inline void make_scaled(scaled_t* s, const blocks_t* p, const csr_t* a) noexcept nogil:
    """Elements and their numbers, in the places of `lay_scaled`."""
    cdef int32_t i, j, q, n = 0, m = 0, first, second
    cdef int32_t* ptr = <int32_t*>s.e.ptr
    cdef int32_t* kind = <int32_t*>s.e.kind
    cdef int32_t* wptr = <int32_t*>s.e.wptr
    cdef double* g = <double*>s.e.g
    cdef double* at = <double*>s.e.at
    cdef double* spin = <double*>s.e.as_
    cdef double x
    for i in range(p.n_blocks):
        first = m
        for j in range(p.ptr[i], p.ptr[i + 1]):
            s.fixed[j] = 0.0
            if stays(p, a, i, j, &x):
                s.fixed[j] = x
                continue
            s.keep[m] = j
            s.scale[m] = 1.0 / sqrt(p.d[j])
            s.speed[m] = sqrt(p.nu[j] * p.d[j]) * s.scale[m]
            (<double*>s.e.lower)[m] = low_of(p, i, j) / s.scale[m]
            (<double*>s.e.upper)[m] = high_of(p, i, j) / s.scale[m]
            m += 1
            if is_row(p, i) or m == first + 1:
                ptr[n] = m - 1
                kind[n] = ROW
                at[n] = spin[n] = 0.0
                n += 1
        if m > first + 1 and not is_row(p, i):
            second = s.keep[m - 1]
            kind[n - 1] = SPIN if ends_apart(p.kind[i]) and second == p.ptr[i + 1] - 1 else CONTACT
            at[n - 1] = p.mu[i] * sqrt(p.d[s.keep[first + 1]] / p.d[p.ptr[i]])
            if kind[n - 1] == SPIN:
                spin[n - 1] = p.mu[i] * p.patch_radius[i] * sqrt(p.d[second] / p.d[p.ptr[i]])
    ptr[n] = m
    wptr[0] = 0
    for i in range(n):
        q = ptr[i + 1] - ptr[i]
        wptr[i + 1] = wptr[i] + q * q
    s.small = wptr[n]
    s.e.n, s.e.m = n, m
    memset(<double*>s.e.theta, 0, m * sizeof(double))   # on the diagonal of A already
    for i in range(m):
        j = s.keep[i]
        x = 0.0
        for q in range(a.indptr[j], a.indptr[j + 1]):
            x += a.data[q] * s.fixed[a.indices[q]]
        g[i] = (p.b[j] - x) * s.scale[i]


cdef inline bint dense_matrix(const scaled_t* s, const csr_t* a, int32_t rows, int32_t* place, double* h) noexcept nogil:
    """H (m, m) of the rows that move; place (rows) is scratch. Whether it is symmetric."""
    cdef int32_t i, j, q, m = s.e.m
    cdef double x
    cdef bint same = True
    for j in range(rows):
        place[j] = -1
    for i in range(m):
        place[s.keep[i]] = i
    memset(h, 0, <int64_t>m * m * sizeof(double))
    for i in range(m):
        for q in range(a.indptr[s.keep[i]], a.indptr[s.keep[i] + 1]):
            j = place[a.indices[q]]
            if j >= 0:
                h[<int64_t>i * m + j] = a.data[q] * s.scale[i] * s.scale[j]
    for i in range(m):
        for j in range(i):
            x = h[<int64_t>i * m + j] - h[<int64_t>j * m + i]
            same = same and fabs(x) <= 1e-14
    return same
