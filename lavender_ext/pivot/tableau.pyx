"""Complementary pivoting on a dense dictionary (Lemke's method), degeneracy broken lexicographically.

    w = q + M s + c z,   w, s >= 0,  w_i s_i = 0                                             (1)
    basic_i = t[i, n + 1] + sum_j t[i, j] nonbasic_j,   i < n, j <= n                         (2)

Variables are numbered w_i = i, s_i = n + i, z = 2 n. The first pivot brings z in where q_i / c_i is least;
from then on the complement of the variable that left enters, and the row with the least ratio leaves:

    min over t[i, c] < 0 of (t[i, n + 1], beta_i) / -t[i, c],   beta_i = row i of the inverse basis   (3)

compared lexicographically: what q + (e, e^2, ...) would decide for a small e > 0. beta is read off (2):
beta_ij = -t[i, column of w_j], or 1 where w_j itself is basic in row i, else 0.

`lavender/solvers/lemke.py` makes (1) of any bounded rows and follows many paths; for few rows `lav_lemke_rows` does so
on one, where the diagonal is enough to eliminate free ones.
"""
from libc.math cimport INFINITY, fabs, sqrt
from libc.stdint cimport int32_t, int64_t

import numpy as np

from lavender_ext.core.block cimport blocks_t
from lavender_ext.core.csr cimport csr_t
from lavender_ext.core.problem cimport Data
from lavender_ext.pivot.principal cimport AT_LOWER, AT_UPPER, FREE


cpdef enum:                     # how a path ended
    DONE = 0                    # z left: s solves the problem
    PIVOTS = 1                  # all pivots used
    RAY = 2                     # nothing limits the entering variable
    HELD = 3                    # a free row is not reached by a pivot of its own


cdef struct dictionary_t:
    int32_t n
    double* t                   # (n, n + 2), last column: values of the basic variables
    int32_t* basic              # (n) variable of each row
    int32_t* nonbasic           # (n + 1) variable of each column
    int32_t* where              # (2 n + 1) row of a basic variable, -1 - column of others
    double tiny                 # entries below tiny times the largest of their column are zero
    int32_t entering            # column; at a ray the one that nothing limits


cdef inline double beta(const dictionary_t* d, int32_t i, int32_t j) noexcept nogil:
    cdef int32_t at = d.where[j]
    if at < 0:
        return -d.t[<int64_t>i * (d.n + 2) - 1 - at]
    return 1.0 if at == i else 0.0


cdef inline int32_t precedes(const dictionary_t* d, int32_t i, int32_t k, double si,
                             double sk) noexcept nogil:
    # Is beta_i / si lexicographically below beta_k / sk?
    cdef int32_t j
    cdef double x, y, gap
    for j in range(d.n):
        x = beta(d, i, j) / si
        y = beta(d, k, j) / sk
        gap = 1e-10 * (fabs(x) + fabs(y))
        if x < y - gap:
            return 1
        if x > y + gap:
            return 0
    return i < k


cdef public void lav_dictionary_pivot(dictionary_t* d, int32_t r, int32_t c) noexcept nogil:
    """Basic variable of row r and nonbasic variable of column c change places."""
    cdef int32_t i, j, width = d.n + 2, var
    cdef double* row = d.t + <int64_t>r * width
    cdef double* to
    cdef double p = 1.0 / row[c], f
    for j in range(width):
        row[j] = -row[j] * p
    row[c] = p
    for i in range(d.n):
        if i == r:
            continue
        to = d.t + <int64_t>i * width
        f = to[c]
        if f == 0.0:
            continue
        to[c] = 0.0
        for j in range(width):
            to[j] += f * row[j]
    var = d.basic[r]
    d.basic[r] = d.nonbasic[c]
    d.nonbasic[c] = var
    d.where[d.basic[r]] = r
    d.where[var] = -1 - c


cdef inline int32_t limiting_row(const dictionary_t* d, int32_t c) noexcept nogil:
    # (3); -1 where no basic variable falls. Among equals z leaves.
    cdef int32_t i, best = -1, width = d.n + 2
    cdef double big = 0.0, s, value, ratio, least = 0.0, scale = 0.0, gap
    for i in range(d.n):
        if fabs(d.t[<int64_t>i * width + c]) > big:
            big = fabs(d.t[<int64_t>i * width + c])
        if fabs(d.t[<int64_t>i * width + d.n + 1]) > scale:
            scale = fabs(d.t[<int64_t>i * width + d.n + 1])
    for i in range(d.n):
        s = -d.t[<int64_t>i * width + c]
        if not s > d.tiny * big:
            continue
        value = d.t[<int64_t>i * width + d.n + 1]
        if value < d.tiny * scale:
            value = 0.0                                 # rounding of zero
        ratio = value / s
        gap = 1e-12 * (ratio + least)
        if best < 0 or ratio < least - gap:
            best = i
            least = ratio
        elif ratio <= least + gap:
            if d.basic[best] == 2 * d.n:
                continue
            if d.basic[i] == 2 * d.n or precedes(d, i, best, s, -d.t[<int64_t>best * width + c]):
                best = i
                least = ratio
    return best


cdef public int32_t lav_lemke_pivots(dictionary_t* d, int32_t pivots, int32_t* done) noexcept nogil:
    """At most `pivots` complementary pivots from column `entering`; how many into done."""
    cdef int32_t r, var
    done[0] = 0
    while done[0] < pivots:
        r = limiting_row(d, d.entering)
        if r < 0:
            return RAY
        var = d.basic[r]
        lav_dictionary_pivot(d, r, d.entering)
        done[0] += 1
        if var == 2 * d.n:
            return DONE
        var = var - d.n if var >= d.n else var + d.n
        d.entering = -1 - d.where[var]
    return PIVOTS


cdef inline void begin(dictionary_t* d) noexcept nogil:
    # Every w basic, in its own row.
    cdef int32_t i
    for i in range(d.n):
        d.basic[i] = d.where[i] = i
        d.nonbasic[i] = d.n + i
        d.where[d.n + i] = -1 - i
    d.nonbasic[d.n] = 2 * d.n
    d.where[2 * d.n] = -1 - d.n


cdef inline int32_t standard_form(dictionary_t* d, const blocks_t* p, const csr_t* a, int32_t* place,
                                  int32_t* row) noexcept nogil:
    """(1) of bounded rows, scaled to d = 1: those that are not fixed, then one for each with two bounds.

    lambda_i = lower + s d^-1/2, or upper - s d^-1/2 where there is no other; a cap is (upper - lower) d^1/2 - s >= 0.
    row: of each place, of a cap the place that it is for; the number of rows that are not fixed.
    """
    cdef int32_t i, j, l, q, k = 0, m = p.n_rows, width
    cdef double w, scale, base
    for i in range(m):
        place[i] = -1
        if p.lower[i] != p.upper[i]:
            place[i] = k
            row[k] = i
            k += 1
    d.n = k
    for j in range(k):
        if p.lower[row[j]] > -INFINITY and p.upper[row[j]] < INFINITY:
            row[d.n] = j
            d.n += 1
    width = d.n + 2
    for q in range(d.n * width):
        d.t[q] = 0.0
    for j in range(k):
        i = row[j]
        scale = turn(p, i)
        w = -p.b[i]
        for q in range(a.indptr[i], a.indptr[i + 1]):
            l = a.indices[q]
            base = p.lower[l] if p.lower[l] > -INFINITY else (p.upper[l] if p.upper[l] < INFINITY else 0.0)
            w += a.data[q] * base
            if place[l] >= 0:
                d.t[<int64_t>j * width + place[l]] = scale * a.data[q] * turn(p, l)
        d.t[<int64_t>j * width + d.n + 1] = scale * w
    for l in range(k, d.n):
        j = row[l]
        i = row[j]
        d.t[<int64_t>j * width + l] = 1.0
        d.t[<int64_t>l * width + j] = -1.0
        d.t[<int64_t>l * width + d.n + 1] = (p.upper[i] - p.lower[i]) * sqrt(p.d[i])
    begin(d)
    return k


cdef inline double turn(const blocks_t* p, int32_t i) noexcept nogil:
    cdef double scale = 1.0 / sqrt(p.d[i])
    return scale if p.lower[i] > -INFINITY or p.upper[i] == INFINITY else -scale


cdef inline int32_t eliminate(dictionary_t* d, const blocks_t* p, int32_t k, int32_t* row,
                              int32_t* kept) noexcept nogil:
    """Free rows made basic for good, and left out; how many of k rows stay, or -1. kept: place of each that does."""
    cdef int32_t i, j, l, n = 0, stay = 0, width = d.n + 2
    cdef double size
    for j in range(k):
        if p.lower[row[j]] > -INFINITY or p.upper[row[j]] < INFINITY:
            continue
        size = 0.0
        for l in range(d.n):
            if fabs(d.t[<int64_t>j * width + l]) > size:
                size = fabs(d.t[<int64_t>j * width + l])
        if not fabs(d.t[<int64_t>j * width + j]) > 1e-10 * size:
            return -1
        lav_dictionary_pivot(d, j, j)
    for j in range(d.n):
        if d.basic[j] == j:
            kept[n] = j
            n += 1
            stay += j < k
    for i in range(n):                                  # no place comes after the one that it is read from
        for j in range(n):
            d.t[<int64_t>i * (n + 2) + j] = d.t[<int64_t>kept[i] * width + kept[j]]
        size = d.t[<int64_t>kept[i] * width + d.n + 1]
        d.t[<int64_t>i * (n + 2) + n] = 1.0             # covers
        d.t[<int64_t>i * (n + 2) + n + 1] = size
    d.n = n
    begin(d)
    return stay


cdef public int32_t lav_lemke_rows(const blocks_t* p, const csr_t* a, double tiny, int32_t pivots, double* t,
                                   int32_t* whole, int32_t* at, double* x, int32_t* done) noexcept nogil:
    """One path of at most so many pivots on bounded rows: on which side each of them ends, into at (m), and where.

    x (m): all but free rows. t, whole: room for a dictionary of 2 m rows, and for 13 m + 2 numbers.
    """
    cdef dictionary_t d
    cdef int32_t i, j, k, r = 0, code, m = p.n_rows
    cdef int32_t* place = whole
    cdef int32_t* row = whole + m
    cdef int32_t* kept = whole + 3 * m
    d.t = t
    d.basic = whole + 5 * m
    d.nonbasic = whole + 7 * m
    d.where = whole + 9 * m + 1
    d.tiny = tiny
    done[0] = 0
    k = standard_form(&d, p, a, place, row)
    k = eliminate(&d, p, k, row, kept)
    if k < 0:
        return HELD
    for i in range(d.n):
        if d.t[<int64_t>i * (d.n + 2) + d.n + 1] <= d.t[<int64_t>r * (d.n + 2) + d.n + 1]:
            r = i
    if d.n > 0 and d.t[<int64_t>r * (d.n + 2) + d.n + 1] < 0.0:
        lav_dictionary_pivot(&d, r, d.n)
        d.entering = -1 - d.where[d.n + r]
        code = lav_lemke_pivots(&d, pivots - 1, done)
        done[0] += 1
        if code != DONE:
            return code
    for i in range(m):
        at[i] = FREE if place[i] >= 0 else AT_LOWER
        if place[i] < 0:
            x[i] = p.lower[i]
    for j in range(k):
        i = row[kept[j]]
        r = d.where[d.n + j]
        x[i] = p.lower[i] if p.lower[i] > -INFINITY else p.upper[i]
        if r < 0:
            at[i] = AT_LOWER if p.lower[i] > -INFINITY else AT_UPPER
        else:
            x[i] += turn(p, i) * d.t[<int64_t>r * (d.n + 2) + d.n + 1]
    for j in range(k, d.n):
        if d.where[d.n + j] >= 0:
            at[row[row[kept[j]]]] = AT_UPPER
    return DONE


def follow(Data p, double tiny, int pivots, int32_t[::1] at, double[::1] x):
    """(how the path ended, its pivots) of bounded rows of A in compressed rows, as `lav_lemke_rows`; `at`, `x` (m,)."""
    cdef int32_t m = p.blocks.n_rows, code, done
    cdef double[::1] t = np.empty(2 * m * (2 * m + 2))
    cdef int32_t[::1] whole = np.empty(13 * m + 2, np.int32)
    if p.factored or at.shape[0] != m or x.shape[0] != m or m == 0:
        raise ValueError("A in compressed rows, and a side and a number of each, are needed")
    with nogil:
        code = lav_lemke_rows(&p.blocks, &p.csr, tiny, pivots, &t[0], &whole[0], &at[0], &x[0], &done)
    return code, done


cdef class Dictionary:
    """One dictionary over the caller's arrays: t (n, n + 2) float64, basic (n,), nonbasic (n + 1,) int32."""

    cdef dictionary_t d
    cdef object keep

    def __init__(self, double[:, ::1] t, int32_t[::1] basic, int32_t[::1] nonbasic, int32_t[::1] where,
                 double tiny):
        cdef int32_t n = <int32_t>t.shape[0], i
        sizes = (t.shape[1], basic.shape[0], nonbasic.shape[0], where.shape[0])
        if n == 0 or sizes != (n + 2, n, n + 1, 2 * n + 1):
            raise ValueError("a dictionary of n > 0 rows has n + 2 columns")
        self.keep = (t, basic, nonbasic, where)
        self.d.n = n
        self.d.t = &t[0, 0]
        self.d.basic = &basic[0]
        self.d.nonbasic = &nonbasic[0]
        self.d.where = &where[0]
        self.d.tiny = tiny
        for i in range(n):
            where[basic[i]] = i
        for i in range(n + 1):
            where[nonbasic[i]] = -1 - i

    def pivot(self, int r, int c):
        with nogil:
            lav_dictionary_pivot(&self.d, r, c)

    def enter(self, int variable):
        """The variable that enters next; it must be nonbasic."""
        self.d.entering = -1 - self.d.where[variable]

    @property
    def entering(self):
        return self.d.entering

    def pivots(self, int n):
        """(0 done, 1 all pivots used, 2 ray; number of pivots)."""
        cdef int32_t code, done
        with nogil:
            code = lav_lemke_pivots(&self.d, n, &done)
        return code, done
