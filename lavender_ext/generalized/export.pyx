"""MuJoCo's constraint rows in the layout of a problem: blocks, bounds, keys, J and its checks, in one pass each.

Arrays come as the engine holds them: efc_type, efc_id (m), contact dim (c), friction (c, 5), geom (c, 2). A contact
whose coefficients f differ has the rows of its tangents scaled by f_j / f_0, so that one mu = f_0 bounds all:

    |(lambda_1 / f_0, ..., lambda_n / f_n)| <= lambda_n   <=>   |lambda'| <= f_0 lambda_n,   lambda'_j = lambda_j f_0 / f_j   (1)
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t, uint64_t

import numpy as np

from lavender_ext.core.block cimport CONTACT, ROUND, ROW


cpdef enum:
    JOINED = 6                  # rows of an equality that are one block; a flex has one for each edge


cdef public int32_t lav_export_blocks(int32_t m, const int32_t* type_, const int32_t* id_, const int32_t* codes,
                                      const int32_t* dim, const double* friction, const int32_t* geom,
                                      const double* loss, double dt, int32_t* ptr, int32_t* kind, double* lower,
                                      double* upper, double* mu, double* scale, uint64_t* key) noexcept nogil:
    """Blocks of m rows, how many; -1 - i where row i is of a type that `codes` does not hold.

    codes (8): equality, friction of a joint, of a tendon, limit of a joint, of a tendon, contact without friction,
    pyramidal, elliptic. Of ptr room for m + 1.
    """
    cdef int32_t i = 0, j, _j, k = 0, t, of, size, count, nth
    cdef double inf = 1.0 / 0.0
    ptr[0] = 0
    while i < m:
        t = type_[i]
        of = id_[i]
        size = 1
        count = 1
        mu[k] = 0.0
        kind[k] = ROW
        lower[i] = -inf
        upper[i] = inf
        scale[i] = 1.0
        key[k] = (<uint64_t>(t + 1) << 56) | (<uint64_t>of << 32)
        if t == codes[0]:
            while i + size < m and type_[i + size] == t and id_[i + size] == of:
                lower[i + size] = -inf
                upper[i + size] = inf
                scale[i + size] = 1.0
                size += 1
            if size > JOINED:                           # rows of their own: together they would reach every vertex
                count = size
                size = 1
                for j in range(1, count):
                    mu[k + j] = 0.0
                    kind[k + j] = ROW
                    key[k + j] = key[k] + j
        elif t == codes[1] or t == codes[2]:
            lower[i] = -dt * loss[i]
            upper[i] = dt * loss[i]
        elif t == codes[3] or t == codes[4]:
            lower[i] = 0.0
            if k > 0 and (key[k - 1] | 0xFFFF) == (key[k] | 0xFFFF):
                key[k] = key[k - 1] + 1                 # the other limit of the same joint
        elif t == codes[5] or t == codes[6] or t == codes[7]:
            nth = 0
            j = of - 1
            while j >= 0 and geom[2 * j] == geom[2 * of] and geom[2 * j + 1] == geom[2 * of + 1]:
                nth += 1
                j -= 1
            key[k] = ((<uint64_t>1 << 63) | (<uint64_t>((geom[2 * of] + 1) & 0xFFFFF) << 40)
                      | (<uint64_t>((geom[2 * of + 1] + 1) & 0xFFFFF) << 20) | (<uint64_t>(nth & 0xFFFF) << 4))
            lower[i] = 0.0
            if t == codes[5]:
                kind[k] = CONTACT
            elif t == codes[6]:
                count = 2 * (dim[of] - 1)               # an edge each
                for j in range(1, count):
                    lower[i + j] = 0.0
                    upper[i + j] = inf
                    scale[i + j] = 1.0
                    mu[k + j] = 0.0
                    kind[k + j] = ROW
                    key[k + j] = key[k] + j
            else:
                size = dim[of]
                kind[k] = ROUND if size > 3 else CONTACT
                mu[k] = friction[5 * of]
                for j in range(1, size):
                    lower[i + j] = -inf
                    upper[i + j] = inf
                    scale[i + j] = friction[5 * of + j - 1] / mu[k] if mu[k] > 0.0 else 0.0
        else:
            return -1 - i
        for _j in range(count):
            i += size
            k += 1
            ptr[k] = i
    return k


def blocks(const int32_t[::1] type_, const int32_t[::1] id_, const int32_t[::1] codes, const int32_t[::1] dim,
           const double[:, ::1] friction, const int32_t[:, ::1] geom, const double[::1] loss, double dt):
    """(ptr, kind, lower, upper, mu, scale, key), or the number of a row of unknown type."""
    cdef int32_t m = <int32_t>type_.shape[0], k
    whole = np.empty(2 * m + 1, np.int32)
    numbers = np.empty(4 * m)
    keys = np.empty(m, np.uint64)
    cdef int32_t[::1] w = whole
    cdef double[::1] x = numbers
    cdef uint64_t[::1] key = keys
    if m == 0:
        whole[0] = 0
        return whole, whole[:0], numbers, numbers, numbers, numbers, keys
    k = lav_export_blocks(m, &type_[0], &id_[0], &codes[0], &dim[0] if dim.shape[0] else NULL,
                          &friction[0, 0] if friction.shape[0] else NULL, &geom[0, 0] if geom.shape[0] else NULL,
                          &loss[0], dt, &w[0], &w[m + 1], &x[0], &x[m], &x[2 * m], &x[3 * m], &key[0])
    if k < 0:
        return -1 - k
    return (whole[:k + 1].copy(), whole[m + 1:m + 1 + k].copy(), numbers[:m].copy(), numbers[m:2 * m].copy(),
            numbers[2 * m:2 * m + k].copy(), numbers[3 * m:], keys[:k])


def rows_of_dense(const double[::1] values, int32_t m, int32_t n, const double[::1] scale):
    """(indptr, indices, data) of J scaled by row, from its numbers row by row."""
    cdef int32_t i, j
    cdef Py_ssize_t at = 0
    cdef double x
    indptr_ = np.empty(m + 1, np.int32)
    indices_ = np.empty(m * n, np.int32)
    data_ = np.empty(m * n)
    cdef int32_t[::1] indptr = indptr_, indices = indices_
    cdef double[::1] data = data_
    indptr[0] = 0
    for i in range(m):
        for j in range(n):
            x = values[i * n + j] * scale[i]
            if x != 0.0:
                indices[at] = j
                data[at] = x
                at += 1
        indptr[i + 1] = <int32_t>at
    return indptr_, indices_[:at].copy(), data_[:at].copy()


def rows_of_sparse(const double[::1] values, const int32_t[::1] count, const int32_t[::1] first,
                   const int32_t[::1] columns, const double[::1] scale):
    """The same of compressed rows that may have room between them; None where columns do not ascend."""
    cdef int32_t i, q, m = <int32_t>count.shape[0]
    cdef Py_ssize_t at = 0, total = 0
    cdef double x
    for i in range(m):
        total += count[i]
    indptr_ = np.empty(m + 1, np.int32)
    indices_ = np.empty(total, np.int32)
    data_ = np.empty(total)
    cdef int32_t[::1] indptr = indptr_, indices = indices_
    cdef double[::1] data = data_
    indptr[0] = 0
    for i in range(m):
        for q in range(first[i], first[i] + count[i]):
            if q > first[i] and columns[q] <= columns[q - 1]:
                return None
            x = values[q] * scale[i]
            if x != 0.0:
                indices[at] = columns[q]
                data[at] = x
                at += 1
        indptr[i + 1] = <int32_t>at
    return indptr_, indices_[:at].copy(), data_[:at].copy()


def numbers(const double[:] force, const double[:] aref, const double[:] r, const double[:] inverse,
            const double[::1] scale, double dt):
    """(impulse, target, compliance) of every row from efc_force, efc_aref and efc_R; and max |efc_R efc_D - 1|."""
    cdef Py_ssize_t i, m = scale.shape[0]
    cdef double gap = 0.0, x
    impulse_ = np.zeros(m)
    target_ = np.empty(m)
    compliance_ = np.empty(m)
    cdef double[::1] impulse = impulse_, target = target_, compliance = compliance_
    for i in range(m):
        if scale[i] != 0.0:
            impulse[i] = dt * force[i] / scale[i]
        target[i] = dt * scale[i] * aref[i]
        compliance[i] = r[i] * scale[i] * scale[i]
        x = fabs(r[i] * inverse[i] - 1.0)
        if gap == gap and not x <= gap:                 # NaN stays
            gap = x
    return impulse_, target_, compliance_, gap


def row_pointers(const int32_t[::1] first, const int32_t[::1] count):
    """Pointers (n + 1) of rows by first place and length; None where there is room between them."""
    cdef Py_ssize_t i, n = first.shape[0]
    out = np.empty(n + 1, np.int32)
    cdef int32_t[::1] at = out
    at[0] = 0
    for i in range(n):
        if first[i] != at[i]:
            return None
        at[i + 1] = at[i] + count[i]
    return out


def mass_mismatch(const int32_t[::1] mptr, const int32_t[::1] midx, const double[::1] mval, const double[::1] x,
                  const double[::1] y):
    """max |M x - y| over max (|M| |x| + |y|), M by its lower triangle; 0 where both vanish."""
    cdef int32_t i, q, n = <int32_t>x.shape[0]
    cdef double gap = 0.0, big = 0.0
    scratch = np.zeros(2 * n + 1)
    cdef double[::1] s = scratch
    for i in range(n):
        for q in range(mptr[i], mptr[i + 1]):
            s[i] += mval[q] * x[midx[q]]
            s[n + i] += fabs(mval[q] * x[midx[q]])
            if midx[q] != i:
                s[midx[q]] += mval[q] * x[i]
                s[n + midx[q]] += fabs(mval[q] * x[i])
    for i in range(n):
        if fabs(s[i] - y[i]) > gap or s[i] != s[i] or y[i] != y[i]:
            gap = fabs(s[i] - y[i])
        if s[n + i] + fabs(y[i]) > big:
            big = s[n + i] + fabs(y[i])
    return gap / big if big > 0.0 else 0.0


def row_mismatch(const int32_t[::1] jptr, const int32_t[::1] jidx, const double[::1] jval, const double[::1] x,
                 const double[::1] y):
    """max |J x - J y| over max |J| (|x| + |y|); 0 where both vanish."""
    cdef int32_t i, q, m = <int32_t>jptr.shape[0] - 1
    cdef double gap = 0.0, big = 0.0, s, t
    for i in range(m):
        s = 0.0
        t = 0.0
        for q in range(jptr[i], jptr[i + 1]):
            s += jval[q] * (x[jidx[q]] - y[jidx[q]])
            t += fabs(jval[q]) * (fabs(x[jidx[q]]) + fabs(y[jidx[q]]))
        if fabs(s) > gap or s != s:
            gap = fabs(s)
        if t > big:
            big = t
    return gap / big if big > 0.0 else 0.0
