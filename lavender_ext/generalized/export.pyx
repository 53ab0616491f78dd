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
    CODES = 8                   # kinds of constraints


cdef public int32_t lav_export_blocks(int32_t m, const int32_t* type_, const int32_t* id_, const int32_t* codes,
                                      const int32_t* most, const int32_t* dim, const double* friction,
                                      const int32_t* geom, const double* loss, double dt, int32_t* ptr, int32_t* kind,
                                      double* lower,
                                      double* upper, double* mu, double* scale, uint64_t* key) noexcept nogil:
    """Blocks of m rows, how many; -1 - i where row i is of a type that `codes` does not hold, or names what is not there.

    codes (8): equality, friction of a joint, of a tendon, limit of a joint, of a tendon, contact without friction,
    pyramidal, elliptic; most (8): how many there are of what rows of each code name. A contact's dim is from 1 to 6, and
    its rows end with the m. Of ptr room for m + 1.
    """
    cdef int32_t i = 0, j, _j, k = 0, t, of, size, count, nth, code
    cdef double inf = 1.0 / 0.0
    ptr[0] = 0
    while i < m:
        t = type_[i]
        of = id_[i]
        size = 1
        count = 1
        code = 0
        while code < CODES and t != codes[code]:
            code += 1
        if code == CODES or not 0 <= of < most[code]:
            return -1 - i
        mu[k] = 0.0
        kind[k] = ROW
        lower[i] = -inf
        upper[i] = inf
        scale[i] = 1.0
        key[k] = (<uint64_t>(t + 1) << 56) | (<uint64_t>of << 32)
        if code == 0:
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
        elif code <= 2:
            lower[i] = -dt * loss[i]
            upper[i] = dt * loss[i]
        elif code <= 4:
            lower[i] = 0.0
            if k > 0 and (key[k - 1] | 0xFFFF) == (key[k] | 0xFFFF):
                key[k] = key[k - 1] + 1                 # the other limit of the same joint
        else:
            nth = 0
            j = of - 1
            while j >= 0 and geom[2 * j] == geom[2 * of] and geom[2 * j + 1] == geom[2 * of + 1]:
                nth += 1
                j -= 1
            key[k] = ((<uint64_t>1 << 63) | (<uint64_t>((geom[2 * of] + 1) & 0xFFFFF) << 40)
                      | (<uint64_t>((geom[2 * of + 1] + 1) & 0xFFFFF) << 20) | (<uint64_t>(nth & 0xFFFF) << 4))
            lower[i] = 0.0
            if code == 5:
                kind[k] = CONTACT
            elif not 1 < dim[of] <= JOINED:
                return -1 - i
            elif code == 6:
                count = 2 * (dim[of] - 1)               # an edge each
                if i + count > m:
                    return -1 - i
                for j in range(1, count):
                    lower[i + j] = 0.0
                    upper[i + j] = inf
                    scale[i + j] = 1.0
                    mu[k + j] = 0.0
                    kind[k + j] = ROW
                    key[k + j] = key[k] + j
            else:
                size = dim[of]
                if i + size > m:
                    return -1 - i
                kind[k] = ROUND if size > 3 else CONTACT
                mu[k] = friction[5 * of]
                for j in range(1, size):
                    lower[i + j] = -inf
                    upper[i + j] = inf
                    scale[i + j] = friction[5 * of + j - 1] / mu[k] if mu[k] > 0.0 else 0.0
        for _j in range(count):
            i += size
            k += 1
            ptr[k] = i
    return k


def blocks(const int32_t[::1] type_, const int32_t[::1] id_, const int32_t[::1] codes, tuple most,
           const int32_t[::1] dim, const double[:, ::1] friction, const int32_t[:, ::1] geom, const double[::1] loss,
           double dt):
    """(ptr, kind, lower, upper, mu, scale, key), or the number of a row that is unknown, or names what is not there."""
    cdef int32_t m = <int32_t>type_.shape[0], k
    cdef int32_t limits[CODES]
    for k in range(CODES):
        limits[k] = most[k]
    whole = np.empty(2 * m + 1, np.int32)
    numbers = np.empty(4 * m)
    keys = np.empty(m, np.uint64)
    cdef int32_t[::1] w = whole
    cdef double[::1] x = numbers
    cdef uint64_t[::1] key = keys
    if m == 0:
        whole[0] = 0
        return whole, whole[:0], numbers, numbers, numbers, numbers, keys
    k = lav_export_blocks(m, &type_[0], &id_[0], &codes[0], limits, &dim[0] if dim.shape[0] else NULL,
                          &friction[0, 0] if friction.shape[0] else NULL, &geom[0, 0] if geom.shape[0] else NULL,
                          &loss[0], dt, &w[0], &w[m + 1], &x[0], &x[m], &x[2 * m], &x[3 * m], &key[0])
    if k < 0:
        return -1 - k
    return (whole[:k + 1].copy(), whole[m + 1:m + 1 + k].copy(), numbers[:m].copy(), numbers[m:2 * m].copy(),
            numbers[2 * m:2 * m + k].copy(), numbers[3 * m:], keys[:k])


def rows_of_dense(const double[::1] values, int32_t m, int32_t n, const double[::1] scale):
    """(indptr, indices, data) of J scaled by row, from its numbers row by row; there are m n of them."""
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
                   const int32_t[::1] columns, const double[::1] scale, int32_t n):
    """The same of compressed rows of n columns that may have room between them; None where columns do not ascend.

    Of rows that cannot be followed, the first one's number.
    """
    cdef int32_t i, q, m = <int32_t>count.shape[0]
    cdef Py_ssize_t at = 0, total = 0, room = min(values.shape[0], columns.shape[0])
    cdef double x
    cdef int32_t last, end
    cdef bint ascend = True
    for i in range(m):
        if not 0 <= count[i] <= room or not 0 <= first[i] <= room - count[i]:
            return i
        total += count[i]
    indptr_ = np.empty(m + 1, np.int32)
    indices_ = np.empty(total, np.int32)
    data_ = np.empty(total)
    cdef int32_t[::1] indptr = indptr_, indices = indices_
    cdef double[::1] data = data_
    indptr[0] = 0
    for i in range(m):
        end = first[i] + count[i]
        last = -1
        for q in range(first[i], end):
            if columns[q] <= last:
                ascend = False
                if columns[q] < 0:
                    return i
            last = max(last, columns[q])
            x = values[q] * scale[i]
            if x != 0.0:
                indices[at] = columns[q]
                data[at] = x
                at += 1
        if last >= n:
            return i
        indptr[i + 1] = <int32_t>at
    if not ascend:
        return None
    return (indptr_, indices_, data_) if at == total else (indptr_, indices_[:at].copy(), data_[:at].copy())


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


def lower_pointers(const int32_t[::1] first, const int32_t[::1] count, const int32_t[::1] columns, Py_ssize_t entries):
    """Pointers (n + 1) of M's rows by first place and length; None where they are no lower triangle, row behind row.

    Columns ascend to the diagonal entry, and as many numbers go with them.
    """
    cdef Py_ssize_t i, q, n = first.shape[0], nnz = columns.shape[0]
    out = np.empty(n + 1, np.int32)
    cdef int32_t[::1] at = out
    cdef int32_t last
    at[0] = 0
    if entries != nnz or count.shape[0] != n:
        return None
    for i in range(n):
        if first[i] != at[i] or not 0 < count[i] <= nnz - at[i]:
            return None
        at[i + 1] = at[i] + count[i]
        last = -1
        for q in range(at[i], at[i + 1]):
            if columns[q] <= last:
                return None
            last = columns[q]
        if last != i:
            return None
    return out if at[n] == nnz else None


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


def motion_gap(const int32_t[::1] parent, const int32_t[::1] body, const double[:, ::1] axis,
               const double[:, ::1] spatial, const double[::1] v):
    """How far the spatial velocities c (n, 6) of bodies are from those that v (nv) makes, and the largest term.

        c_i = c_parent(i) + sum over the velocities j of body i of s_j v_j,   s = axis (nv, 6)

    0 where s is all zeros: a copy did not fill it. -1 where these are not the arrays of one tree.
    """
    cdef Py_ssize_t i, j, k
    cdef double term, big = 0.0, gap = 0.0, filled = 0.0
    scratch = np.zeros((spatial.shape[0], 6))
    cdef double[:, ::1] made = scratch
    if not body.shape[0] == axis.shape[0] == v.shape[0] or parent.shape[0] != spatial.shape[0]:
        return -1.0, 0.0
    for i in range(spatial.shape[0]):
        if not 0 <= parent[i] < spatial.shape[0]:
            return -1.0, 0.0
    for j in range(v.shape[0]):
        if not 0 <= body[j] < spatial.shape[0]:
            return -1.0, 0.0
        for k in range(6):
            term = axis[j, k] * v[j]
            made[body[j], k] += term
            big = widest(big, term)
            filled = widest(filled, axis[j, k])
    for i in range(1, spatial.shape[0]):
        for k in range(6):
            gap = widest(gap, made[i, k] + spatial[parent[i], k] - spatial[i, k])
            big = widest(big, spatial[i, k])
    return (gap if filled != 0.0 else 0.0), big


def row_gaps(const int32_t[::1] jptr, const int32_t[::1] jidx, const double[::1] jval, const double[::1] scale,
             const double[::1] rhs, const double[::1] impulse, double dt, const double[:] v, const double[:] vel,
             const double[:] free, const double[:] b, const double[:] push, const double[:] a):
    """How far J, scaled by row, is from vectors that were made by it, each by the size of its terms.

        J v = efc_vel   (1)      J a0 - aref = efc_b   (2)      J^T f = qfrc_constraint   (3)

    with v before the step, rhs = dt (aref - J a0), free = dt a0, impulse = dt f. 0 where such a vector is all zeros: one
    that a copy did not fill. The size of terms is |J_i|_1 |x|_max for (1) and (2), the largest of |J|^T |f| for (3).
    The fourth number is 0, or NaN where a is not finite.
    """
    cdef int32_t i, j, m = <int32_t>jptr.shape[0] - 1, n = <int32_t>v.shape[0]
    cdef Py_ssize_t q
    cdef double c, size, s_v, finite = 0.0, gap_1 = 0.0, gap_2 = 0.0, gap_3 = 0.0
    cdef double big_1 = 0.0, big_2 = 0.0, big_3 = 0.0, said_1 = 0.0, said_2 = 0.0, said_3 = 0.0
    cdef double top_v = 0.0, top_free = 0.0
    cdef double[::1] pushed = np.zeros(2 * n + 1)       # dt J^T f, and the same of absolute values
    for j in range(n):
        top_v = widest(top_v, v[j])
        top_free = widest(top_free, free[j])
        said_3 = widest(said_3, push[j])
        finite += 0.0 * a[j]
    for i in range(m):
        size = s_v = 0.0
        for q in range(jptr[i], jptr[i + 1]):
            j = jidx[q]
            c = jval[q]
            s_v += c * v[j]
            size += fabs(c)
            c *= impulse[i]
            pushed[j] += c
            pushed[n + j] += fabs(c)
        c = scale[i] * vel[i]
        gap_1 = widest(gap_1, s_v - c)
        big_1 = widest(big_1, size * top_v + fabs(c))
        said_1 = widest(said_1, vel[i])
        c = scale[i] * dt * b[i]
        gap_2 = widest(gap_2, rhs[i] + c)
        big_2 = widest(big_2, size * top_free + fabs(rhs[i]) + fabs(c))
        said_2 = widest(said_2, b[i])
    for j in range(n):
        c = dt * push[j]
        gap_3 = widest(gap_3, pushed[j] - c)
        big_3 = widest(big_3, pushed[n + j] + fabs(c))
    return (gap_1 / big_1 if said_1 != 0.0 and big_1 != 0.0 else 0.0,
            gap_2 / big_2 if said_2 != 0.0 and big_2 != 0.0 else 0.0,
            gap_3 / big_3 if said_3 != 0.0 and big_3 != 0.0 else 0.0, finite)


cdef inline double widest(double so_far, double x) noexcept nogil:
    """The larger of |x| and what was largest so far; NaN stays."""
    x = fabs(x)
    return so_far if x <= so_far or so_far != so_far else x
