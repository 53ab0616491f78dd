"""Complementary pivoting on a dense dictionary (Lemke's method), degeneracy broken lexicographically.

    w = q + M s + c z,   w, s >= 0,  w_i s_i = 0                                             (1)
    basic_i = t[i, n + 1] + sum_j t[i, j] nonbasic_j,   i < n, j <= n                         (2)

Variables are numbered w_i = i, s_i = n + i, z = 2 n. The first pivot brings z in where q_i / c_i is least;
from then on the complement of the variable that left enters, and the row with the least ratio leaves:

    min over t[i, c] < 0 of (t[i, n + 1], beta_i) / -t[i, c],   beta_i = row i of the inverse basis   (3)

compared lexicographically: what q + (e, e^2, ...) would decide for a small e > 0. beta is read off (2):
beta_ij = -t[i, column of w_j], or 1 where w_j itself is basic in row i, else 0.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t, int64_t


cpdef enum:                     # how a path ended
    DONE = 0                    # z left: s solves the problem
    PIVOTS = 1                  # all pivots used
    RAY = 2                     # nothing limits the entering variable


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
