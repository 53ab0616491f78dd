"""Lemke's method: complementary pivoting on a dense dictionary, degeneracy broken lexicographically.

    w = q + M s + c z,   w, s >= 0,  w_i s_i = 0,  z from its first value down to 0             (1)
    basic_i = t[i, n + 1] + sum_j t[i, j] nonbasic_j,   i < n, j <= n                         (2)

Variables are numbered w_i = i, s_i = n + i, z = 2 n. The first pivot brings z in where q_i / c_i is least;
from then on the complement of the variable that left enters, and the row with the least ratio leaves:

    min over t[i, c] < 0 of (t[i, n + 1], beta_i) / -t[i, c],   beta_i = row i of the inverse basis   (3)

compared lexicographically: what q + (e, e^2, ...) would decide for a small e > 0. beta is read off (2):
beta_ij = -t[i, column of w_j], or 1 where w_j itself is basic in row i, else 0.

Bounded rows become (1), scaled to unit diagonal:

    lower bound alone   lambda = lower + s              upper bound alone   lambda = upper - s, w -> -w
    both bounds         lambda = lower + s, a row more: upper - lower - s >= 0 complementary to v >= 0,
                        w + v >= 0 complementary to s
    free                eliminated by a pivot of its own or with another row; what none reaches is split, lambda = s+ - s-
    fixed               a constant

A path ends at z = 0, a solution, or on a ray. Its sides are where the exchanges of direct.pyx begin, which solve the
free rows on A itself, so that what the pivots lost does not reach the result. Where that is not to rounding another
covering vector c is another path.
"""
from libc.math cimport INFINITY, fabs, sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy

import numpy as np

from lavender_ext.core.validate cimport norm_inf
from lavender_ext.core.order cimport next_random
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.judge.score cimport is_at_floor
from lavender_ext.pivot.direct cimport (HALVED, Pivoting, direct_begin, direct_begin_passes, direct_pass, direct_rounds, direct_t,
                                        judge_now)
from lavender_ext.pivot.lemke cimport DONE, LATE, PIVOTS, RAY, dictionary_t, lemke_t
from lavender_ext.pivot.principal cimport AT_LOWER, AT_UPPER, FREE, SMALL, pivots_start


cdef enum:                      # what comes next
    OPEN = 0                    # another path
    WALK = 1                    # more of this one
    EXCHANGE = 2                # its end
    OVER = 3

cdef enum:
    PATHS = 8                   # covering vectors tried
    A_ROW = 20                  # pivots on one path, and so many
    MORE = 200                  # in all, before it counts as lost
    ROUNDS = 32                 # of exchanges at its end


# -- the dictionary ----------------------------------------------------------------------------------------------

cdef inline double beta(const dictionary_t* d, int32_t i, int32_t j) noexcept nogil:
    cdef int32_t at = d.where[j]
    if at < 0:
        return -d.t[i * d.width - 1 - at]
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


cdef inline void pivot(dictionary_t* d, int32_t r, int32_t c) noexcept nogil:
    """Basic variable of row r and nonbasic variable of column c change places."""
    cdef int32_t i, j, n = d.n + 2, var
    cdef double* row = d.t + r * d.width
    cdef double* to
    cdef double p = 1.0 / row[c], f
    for j in range(n):
        row[j] = -row[j] * p
    row[c] = p
    for i in range(d.rows):
        if i == r:
            continue
        to = d.t + i * d.width
        f = to[c]
        if f == 0.0:
            continue
        to[c] = 0.0
        for j in range(n):
            to[j] += f * row[j]
    var = d.basic[r]
    d.basic[r] = d.nonbasic[c]
    d.nonbasic[c] = var
    d.where[d.basic[r]] = r
    d.where[var] = -1 - c


cdef inline int32_t limiting_row(const dictionary_t* d, int32_t c) noexcept nogil:
    # (3); -1 where no basic variable falls. Among equals z leaves.
    cdef int32_t i, best = -1
    cdef double big = 0.0, s, value, ratio, least = 0.0, scale = 0.0, gap
    cdef const double* row
    for i in range(d.n):
        row = d.t + i * d.width
        if fabs(row[c]) > big:
            big = fabs(row[c])
        if fabs(row[d.n + 1]) > scale:
            scale = fabs(row[d.n + 1])
    for i in range(d.n):
        row = d.t + i * d.width
        s = -row[c]
        if not s > d.tiny * big:
            continue
        value = row[d.n + 1]
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
            if d.basic[i] == 2 * d.n or precedes(d, i, best, s, -d.t[best * d.width + c]):
                best = i
                least = ratio
    return best


cdef inline int32_t walk(lemke_t* l, int32_t end) noexcept nogil:
    # Complementary pivots from column `entering`, until there were `end` in all.
    cdef dictionary_t* d = &l.d
    cdef int32_t r, var
    while l.pivots < end:
        r = limiting_row(d, d.entering)
        if r < 0:
            return RAY
        var = d.basic[r]
        pivot(d, r, d.entering)
        l.pivots += 1
        if var == 2 * d.n:
            return DONE
        var = var - d.n if var >= d.n else var + d.n
        d.entering = -1 - d.where[var]
    return PIVOTS


cdef inline void every_w_basic(dictionary_t* d) noexcept nogil:
    # In its own row.
    cdef int32_t i
    for i in range(d.n):
        d.basic[i] = d.where[i] = i
        d.nonbasic[i] = d.n + i
        d.where[d.n + i] = -1 - i
    d.nonbasic[d.n] = 2 * d.n
    d.where[2 * d.n] = -1 - d.n


# -- bounded rows as (1) -----------------------------------------------------------------------------------------

cdef inline int32_t is_free(const blocks_t* p, int32_t i) noexcept nogil:
    return p.lower[i] == -INFINITY and p.upper[i] == INFINITY


cdef inline double base(const blocks_t* p, int32_t i) noexcept nogil:
    # lambda where s = 0
    return p.lower[i] if p.lower[i] > -INFINITY else (p.upper[i] if p.upper[i] < INFINITY else 0.0)


cdef inline double turn(const blocks_t* p, int32_t i) noexcept nogil:
    # lambda - base over s
    cdef double scale = 1.0 / sqrt(p.d[i])
    return scale if p.lower[i] > -INFINITY or p.upper[i] == INFINITY else -scale


cdef inline int32_t most_rows(const blocks_t* p) noexcept nogil:
    # of a dictionary: one, of a free row and one with two bounds two, of a fixed one none
    cdef int32_t i, n = 0
    for i in range(p.n_rows):
        if p.lower[i] != p.upper[i]:
            n += 2 if is_free(p, i) or (p.lower[i] > -INFINITY and p.upper[i] < INFINITY) else 1
    return n


cdef inline void standard_form(lemke_t* l) noexcept nogil:
    """(1) with a row for each free one, behind those of the others."""
    cdef dictionary_t* d = &l.d
    cdef const blocks_t* p = l.t.s.p
    cdef int32_t* place = l.t.s.place                   # scratch here
    cdef int32_t i, j, q, k = 0
    cdef double w, scale
    cdef double* row
    for i in range(p.n_rows):
        place[i] = -1
        if p.lower[i] != p.upper[i] and not is_free(p, i):
            place[i] = k
            l.row[k] = i
            k += 1
    l.bounded = k
    for j in range(l.bounded):
        if p.lower[l.row[j]] > -INFINITY and p.upper[l.row[j]] < INFINITY:
            l.row[k] = j
            k += 1
    l.caps = k - l.bounded
    for i in range(p.n_rows):
        if is_free(p, i):
            place[i] = k
            l.row[k] = i
            k += 1
    d.n = d.rows = k
    for j in range(most_rows(p)):
        l.exchanged[j] = 0
    for j in range(k):
        row = d.t + j * d.width
        for i in range(k + 2):
            row[i] = 0.0
    for i in range(p.n_rows):
        if place[i] < 0:
            continue
        row = d.t + place[i] * d.width
        scale = turn(p, i)
        w = -p.b[i]
        for q in range(l.t.s.a.indptr[i], l.t.s.a.indptr[i + 1]):
            j = l.t.s.a.indices[q]
            w += l.t.s.a.data[q] * base(p, j)
            if place[j] >= 0:
                row[place[j]] = scale * l.t.s.a.data[q] * turn(p, j)
        row[k + 1] = scale * w
    for k in range(l.bounded, l.bounded + l.caps):
        j = l.row[k]
        i = l.row[j]
        d.t[j * d.width + k] = 1.0
        row = d.t + k * d.width
        row[j] = -1.0
        row[d.n + 1] = (p.upper[i] - p.lower[i]) * sqrt(p.d[i])
    every_w_basic(d)


cdef inline void swap(double* x, double* y, int32_t n, int64_t stride) noexcept nogil:
    cdef int32_t k
    cdef double old
    for k in range(n):
        old = x[k * stride]
        x[k * stride] = y[k * stride]
        y[k * stride] = old


cdef inline void swap_rows(dictionary_t* d, int32_t i, int32_t j) noexcept nogil:
    swap(d.t + i * d.width, d.t + j * d.width, d.n + 2, 1)


cdef inline void swap_columns(dictionary_t* d, int32_t i, int32_t j) noexcept nogil:
    swap(d.t + i, d.t + j, d.rows, d.width)


cdef inline int32_t free_pivot(const lemke_t* l, int32_t end, int32_t* one, int32_t* two) noexcept nogil:
    """Free row `one` and free variable `two` before `end` whose entry is largest beside the row; 0 where there is none."""
    cdef const dictionary_t* d = &l.d
    cdef int32_t i, j, first = l.bounded + l.caps
    cdef double size, most = 1e-11
    for i in range(first, end):
        size = norm_inf(d.t + i * d.width, d.n)          # of row i of M
        for j in range(first, end):
            if fabs(d.t[i * d.width + j]) > most * size:
                one[0], two[0], most = i, j, fabs(d.t[i * d.width + j]) / size
    return most > 1e-11


cdef inline int32_t bounded_pivot(lemke_t* l, int32_t end, int32_t* one, int32_t* two) noexcept nogil:
    """Of the other rows the one whose entries with free row `one` and free variable `two` are largest beside both; or -1.

    Between these two there is no pivot: the determinant is the product of the entries.
    """
    cdef dictionary_t* d = &l.d
    cdef int32_t i, j, r, c, first = l.bounded + l.caps, best = -1
    cdef double share, across, most = 1e-11
    cdef const double* y
    for i in range(end):
        d.t[i * d.width + d.n] = norm_inf(d.t + i * d.width, d.n)    # z has no column yet
    for j in range(first):
        y = d.t + j * d.width
        share, across, r, c = 0.0, 0.0, first, first
        for i in range(first, end):
            if fabs(d.t[i * d.width + j]) > share * d.t[i * d.width + d.n]:
                share, r = fabs(d.t[i * d.width + j]) / d.t[i * d.width + d.n], i
            if fabs(y[i]) > across * y[d.n]:
                across, c = fabs(y[i]) / y[d.n], i
        if share * across > most:
            most, best, one[0], two[0] = share * across, j, r, c
    return best


cdef inline int32_t eliminate(lemke_t* l) noexcept nogil:
    """Free rows made basic for good, behind all others; how many places are left.

    What leaves with a free row has no part any more, since all w of free rows are 0: any of their variables may take its
    place. Where none can, w and s of another row exchange their parts.
    """
    cdef dictionary_t* d = &l.d
    cdef int32_t j, row, one = 0, two = 0, end = d.n
    while end > l.bounded + l.caps:
        if free_pivot(l, end, &one, &two):
            pivot(d, one, two)
        else:
            j = bounded_pivot(l, end, &one, &two)
            if j < 0:
                return end
            pivot(d, one, j)
            pivot(d, j, two)
            swap_rows(d, one, j)
            swap_columns(d, j, two)
            l.exchanged[j] = not l.exchanged[j]
        end -= 1
        swap_rows(d, one, two)                          # each variable into its own place again, and this one behind all
        swap_rows(d, two, end)
        swap_columns(d, two, end)
        row = l.row[two]
        l.row[two] = l.row[end]
        l.row[end] = row
    return end


cdef inline void open_path(lemke_t* l) noexcept nogil:
    """(1) of this path: free rows eliminated or split, its covering vector; then its first pivot."""
    cdef dictionary_t* d = &l.d
    cdef int32_t i, j, k, left, n, first, r = 0, gone
    cdef double q
    cdef double* row
    cdef double* to
    standard_form(l)
    first, left = l.bounded + l.caps, eliminate(l)
    l.split = left - first
    gone, n = d.n - left, left + l.split
    i = d.n - 1
    while l.split > 0 and i >= left:                    # behind the second halves
        memcpy(d.t + (i + l.split) * d.width, d.t + i * d.width, (d.n + 2) * sizeof(double))
        l.row[i + l.split] = l.row[i]
        i -= 1
    for i in range(n + gone):
        if left <= i < n:
            continue
        row = d.t + i * d.width
        q = row[d.n + 1]
        for k in range(l.split):
            row[left + k] = -row[first + k]
        row[n] = 1.0 if i < n else 0.0
        row[n + 1] = q
    for k in range(l.split):
        row = d.t + (first + k) * d.width
        to = d.t + (left + k) * d.width
        l.row[left + k] = l.row[first + k]
        for j in range(n + 2):
            to[j] = -row[j]
        to[n] = 1.0
    d.n, d.rows = n, n + gone
    every_w_basic(d)
    d.tiny = 1e-13 if l.paths == 1 else 1e-11           # the finer one where entries of A span as much
    if l.paths > 1:
        for i in range(n):
            d.t[i * d.width + n] = 0.2 + 1.6 * ((next_random(&l.random) >> 11) * 2.0**-53)
    l.paths += 1
    l.stage = EXCHANGE
    for i in range(n):                                  # the last of equals is lexicographically least
        row = d.t + i * d.width
        to = d.t + r * d.width
        if row[n + 1] * to[n] <= to[n + 1] * row[n]:
            r = i
    if n == 0 or d.t[r * d.width + n + 1] >= 0.0:
        return
    pivot(d, r, n)
    d.entering = -1 - d.where[n + r]
    l.pivots += 1
    l.last = l.pivots + A_ROW * n + MORE
    l.stage = WALK


# -- what a path finds -------------------------------------------------------------------------------------------

cdef inline int32_t where_s(const lemke_t* l, int32_t j) noexcept nogil:
    # as `where`, of s of a place
    return l.d.where[j] if l.exchanged[j] else l.d.where[l.d.n + j]


cdef inline double along(const lemke_t* l, int32_t j, int32_t c, double least) noexcept nogil:
    # s_j in column c: its value, or how it grows with the entering variable
    cdef const dictionary_t* d = &l.d
    cdef int32_t r = where_s(l, j)
    cdef double x
    if r < 0:
        return 1.0 if -1 - r == c else 0.0
    x = d.t[r * d.width + c]
    return x if x > least else 0.0


cdef inline void column(const lemke_t* l, int32_t c, double least, double* x) noexcept nogil:
    """lambda (m) of column c, less its base: all but fixed rows."""
    cdef const dictionary_t* d = &l.d
    cdef const blocks_t* p = l.t.s.p
    cdef int32_t i, j, first = l.bounded + l.caps, second = first + l.split
    for j in range(l.bounded):
        i = l.row[j]
        x[i] = turn(p, i) * along(l, j, c, least)
    for j in range(first, second):
        i = l.row[j]
        x[i] = turn(p, i) * (along(l, j, c, least) - along(l, j + l.split, c, least))
    for j in range(d.n, d.rows):
        i = l.row[j]
        x[i] = turn(p, i) * d.t[j * d.width + c]


cdef inline void take_values(lemke_t* l) noexcept nogil:
    """x and the side of every row, judged."""
    cdef const dictionary_t* d = &l.d
    cdef const blocks_t* p = l.t.s.p
    cdef int32_t i, j
    for i in range(p.n_rows):
        l.t.s.x[i] = 0.0
        l.t.s.at[i] = FREE if p.lower[i] != p.upper[i] else AT_LOWER
    column(l, d.n + 1, 0.0, l.t.s.x)
    for i in range(p.n_rows):
        l.t.s.x[i] += base(p, i)
    for j in range(l.bounded):
        i = l.row[j]
        if where_s(l, j) < 0:
            l.t.s.at[i] = AT_LOWER if p.lower[i] > -INFINITY else AT_UPPER
    for j in range(l.bounded, l.bounded + l.caps):
        if where_s(l, j) >= 0:                          # the cap pulls
            l.t.s.at[l.row[l.row[j]]] = AT_UPPER
    judge_now(l.t)


cdef inline int32_t exchange(lemke_t* l) noexcept nogil:
    """Rounds from the sides of a path's end, with a shift where A is singular on the free rows; 0: they wait."""
    cdef direct_t* t = l.t
    cdef int32_t code
    pivots_start(&t.s, 0.0)
    code = direct_rounds(t, ROUNDS)
    if code == SMALL and not t.s.late:
        direct_begin_passes(t, 0)
        code = HALVED
        while code == HALVED:
            code = direct_pass(t, ROUNDS)
    return not t.s.late


cdef void lemke_ray(const lemke_t* l, double* y) noexcept nogil:
    """The direction (m) of the ray that a call ended on; rows with two bounds have none."""
    cdef const dictionary_t* d = &l.d
    cdef const blocks_t* p = l.t.s.p
    cdef double big = 1.0
    cdef int32_t i
    for i in range(d.n):
        if fabs(d.t[i * d.width + d.entering]) > big:
            big = fabs(d.t[i * d.width + d.entering])
    for i in range(p.n_rows):
        y[i] = 0.0
    column(l, d.entering, 1e-11 * big, y)
    for i in range(p.n_rows):
        if p.lower[i] > -INFINITY and p.upper[i] < INFINITY:
            y[i] = 0.0


# -- the calls ---------------------------------------------------------------------------------------------------

cdef int64_t lemke_real(const blocks_t* p) noexcept nogil:
    """Numbers that `lemke_lay` hands out."""
    cdef int64_t n = most_rows(p)
    return n * (n + 2) + 1


cdef int64_t lemke_index(const blocks_t* p) noexcept nogil:
    return 6 * <int64_t>most_rows(p) + 2


cdef void lemke_lay(lemke_t* l, direct_t* t, double* real, int32_t* index) noexcept nogil:
    """All arrays, for the rows of t, which is laid out."""
    cdef int32_t n = most_rows(t.s.p)
    l.t = t
    l.d.t, l.d.width = real, n + 2
    l.row, l.exchanged, l.d.basic = index, index + n, index + 2 * n
    l.d.nonbasic, l.d.where = index + 3 * n, index + 4 * n + 1


cdef void lemke_begin(lemke_t* l) noexcept nogil:
    """As if no path had been followed; t.start (m) is judged."""
    l.stage = l.paths = l.pivots = 0
    l.random = 0
    memcpy(l.t.s.x, l.t.start, l.t.s.n * sizeof(double))
    judge_now(l.t)


cdef inline int32_t is_good_enough(const direct_t* t) noexcept nogil:
    return t.relative <= 1e-12 or is_at_floor(t.relative, t.floor)


cdef int32_t lemke_run(lemke_t* l, int32_t pivots) noexcept nogil:
    """At most so many more pivots, in parts the same as in one; the best judged impulse stands in t.best."""
    cdef int32_t code, end = l.pivots + pivots
    while l.stage != OVER:
        if l.stage == OPEN:
            if l.pivots >= end:
                return PIVOTS
            open_path(l)
        if l.stage == WALK:
            code = walk(l, end if end < l.last else l.last)
            if code == PIVOTS and l.pivots < l.last:
                return PIVOTS
            l.stage = OVER if l.paths == PATHS else OPEN
            if code == PIVOTS:                          # lost
                continue
            take_values(l)
            if code == RAY and not is_good_enough(l.t):
                return RAY
            l.stage = EXCHANGE
        elif l.stage == EXCHANGE:
            take_values(l)                              # no path was needed, or it waited
        if l.stage == EXCHANGE:
            if not exchange(l):
                return LATE
            l.stage = OVER if l.paths == PATHS or is_good_enough(l.t) else OPEN
    return DONE


cdef void lemke_judge(lemke_t* l) noexcept nogil:
    """What a path stands at that is not followed further, which may be the best impulse."""
    if l.stage == WALK:
        take_values(l)


cdef class Lemke:
    """Paths of one problem over the rows that exchange at their end.

    Parameters
    ----------
    rows : Pivoting
        Theirs is what is judged, and the best impulse.
    """

    cdef lemke_t l
    cdef Pivoting rows
    cdef object keep

    def __init__(self, Pivoting rows):
        cdef const blocks_t* p = rows.t.s.p
        cdef double[::1] real = np.empty(lemke_real(p))
        cdef int32_t[::1] index = np.empty(lemke_index(p), np.int32)
        self.rows, self.keep = rows, (real, index)
        lemke_lay(&self.l, &rows.t, &real[0], &index[0])

    def begin(self, const double[::1] start):
        """From start (m,) [N s]."""
        direct_begin(&self.rows.t, &start[0])
        lemke_begin(&self.l)

    def run(self, int pivots):
        """At most so many more pivots: DONE, PIVOTS, RAY or LATE."""
        cdef int32_t code
        with nogil:
            code = lemke_run(&self.l, pivots)
        return self.rows.told(code)

    def judge(self):
        """Where the path stands, if it is not at its end."""
        lemke_judge(&self.l)

    @property
    def ray(self):
        """Its direction (m,), after RAY."""
        cdef double[::1] y = np.empty(self.rows.t.s.n)
        lemke_ray(&self.l, &y[0])
        return y.base

    @property
    def pivots(self):
        return self.l.pivots

    @property
    def paths(self):
        return self.l.paths
