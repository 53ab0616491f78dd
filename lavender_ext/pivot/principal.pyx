"""Principal pivoting on a boxed LCP, and the factorisations under it: LDL^T, or LU of few rows where A is not symmetric.

    free rows F: (A_FF + s D_FF) x_F = b_F - A_FB x_B + s D_FF center_F,  bound rows B: x = its bound    (1)
    w = A x - b + s D (x - center),   D = diag(d)                                                       (2)
    infeasible: x_i outside its bounds on F, w_i < 0 at a lower, w_i > 0 at an upper bound              (3)
    exchange all infeasible rows, while their number falls within `patience` tries                      (4)

Judice, Pires 1994 (block principal pivoting; when (4) is stuck the caller descends on the energy instead).
s > 0 is the proximal shift of a singular matrix. Free rows are numbered compactly in a fixed order of
elimination, so the bandwidth of A never grows; a dense matrix is a band of full width. A linear system is
the case of all rows free. LU is of D^-1/2 (A_FF + s D_FF) D^-1/2, dense, with rows exchanged for the largest pivot.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.block cimport relax_row
from lavender_ext.core.csr cimport csr_dot
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport csr_t
from lavender_ext.factor.band cimport ldl_back_all, ldl_factor, ldl_factor_2, ldl_solve, no_pivots
from lavender_ext.factor.dense cimport dense_lu, dense_lu_solve
from lavender_ext.factor.tiles cimport has_wide
from lavender_ext.judge.score cimport unit_roundoff
from lavender_ext.pivot.principal cimport AT_LOWER, AT_UPPER, FREE, INDEFINITE, ROUNDS, SMALL, SOLVED, STUCK, pivoting_t


cdef enum:
    PATIENCE = 8                # exchanges without a new least number of infeasible rows


cdef inline void factor_lu(pivoting_t* s) noexcept nogil:
    cdef int32_t i, j, k = s.n_free, q, at, to
    cdef const csr_t* a = s.a
    cdef double* row
    no_pivots(&s.found)
    for j in range(k):
        s.size[j] = 1.0 / sqrt(s.size[j])
    for i in range(s.n):
        at = s.place[i]
        if at < 0:
            continue
        row = s.c + <int64_t>at * k
        for j in range(k):
            row[j] = 0.0
        for q in range(a.indptr[i], a.indptr[i + 1]):
            to = s.place[a.indices[q]]
            if to >= 0:
                row[to] = s.size[at] * a.data[q] * s.size[to]
        row[at] += s.shift
    s.found.small = dense_lu(has_wide(), k, s.c, s.swap, s.tiny)
    s.factorisations += 1
    s.is_factored = 1


cdef inline void factor_elsewhere(pivoting_t* s) noexcept nogil:
    cdef int32_t small = s.refactor(s.outside, s.place, s.n_free, s.shift)
    s.late = small < 0
    if s.late:
        return
    no_pivots(&s.found)
    s.found.small = small
    s.factorisations += 1
    s.is_factored = 1


cdef void factor_free(pivoting_t* s, double* x) noexcept nogil:
    """A_FF + s D_FF of (1); x: what ldl_factor takes along, or NULL."""
    cdef int32_t i, j, k = 0, q, r, at, to, in_place
    cdef const csr_t* a = s.a
    cdef double* col
    s.is_half_solved = 0
    for r in range(s.n):
        i = r if s.natural else s.order[r]
        s.place[i] = -1
        if s.at[i] == FREE:
            s.place[i] = k
            s.size[k] = s.p.d[i]
            k += 1
    s.n_free = k
    if s.refactor != NULL:
        factor_elsewhere(s)
        return
    if s.swap != NULL:
        factor_lu(s)
        return
    s.width = s.band + 1 if s.band < k else k
    in_place = s.natural and k == s.n
    for i in range(s.n):
        at = s.place[i]
        if at < 0:
            continue
        col = s.c + <int64_t>at * s.width
        for j in range(s.width):
            col[j] = 0.0
        col -= at
        q = a.indptr[i]
        if in_place:
            q = a.indptr[i + 1]                         # places are rows: the upper half, from the right
            while q > a.indptr[i] and a.indices[q - 1] >= i:
                q -= 1
                col[a.indices[q]] = a.data[q]
        else:
            for q in range(a.indptr[i], a.indptr[i + 1]):
                to = s.place[a.indices[q]]
                if to >= at:
                    col[to] = a.data[q]
        col[at] += s.shift * s.p.d[i]
    ldl_factor(k, s.width, s.c, s.size, s.tiny, x, &s.found)
    s.factorisations += 1
    s.is_factored = 1


cdef inline void solve_factored(const pivoting_t* s, double* y) noexcept nogil:
    # y (n_free) <- (A_FF + s D_FF)^-1 y
    cdef int32_t j
    if s.resolve != NULL:
        s.resolve(s.outside, s.n_free, y)
        return
    if s.swap == NULL:
        ldl_solve(s.n_free, s.width, s.c, y)
        return
    for j in range(s.n_free):
        y[j] *= s.size[j]
    dense_lu_solve(s.n_free, s.c, s.swap, y)
    for j in range(s.n_free):
        y[j] *= s.size[j]


cdef void pivots_factor_all(pivoting_t* s) noexcept nogil:
    """A factor of A, all rows free and no shift; of LDL^T with the first half of x = A^-1 b on the way."""
    cdef int32_t i, q, end, half
    cdef const csr_t* a = s.a
    if s.swap != NULL or not (s.natural and s.band == 1 and s.n > 1):
        for i in range(s.n):
            s.at[i] = FREE
            s.x[i] = s.p.b[i]
        half = s.natural and s.swap == NULL and s.refactor == NULL
        factor_free(s, s.x if half else NULL)
        s.is_half_solved = half
        return
    s.is_half_solved = 1
    s.n_free = s.n
    s.width = 2
    for i in range(s.n):
        s.at[i] = FREE
        s.place[i] = i
        s.size[i] = s.p.d[i]
        s.x[i] = s.p.b[i]
        s.c[2 * i] = 0.0
        s.c[2 * i + 1] = 0.0
        end = a.indptr[i + 1]
        q = end - 2 if end - 2 > a.indptr[i] else a.indptr[i]
        while q < end:                                  # the last two entries hold the upper half
            if a.indices[q] >= i:
                s.c[i + a.indices[q]] = a.data[q]
            q += 1
    no_pivots(&s.found)
    ldl_factor_2(s.n, s.c, s.size, s.tiny, s.x, &s.found)
    s.factorisations += 1
    s.is_factored = 1


cdef void pivots_correct(pivoting_t* s) noexcept nogil:
    """x_F <- x_F - (A_FF + s D_FF)^-1 w_F."""
    cdef int32_t i
    for i in range(s.n):
        if s.place[i] >= 0:
            s.y[s.place[i]] = s.w[i]
    solve_factored(s, s.y)
    for i in range(s.n):
        if s.place[i] >= 0:
            s.x[i] -= s.y[s.place[i]]


cdef void pivots_slack(pivoting_t* s) noexcept nogil:
    """w of (2) and its rounding f."""
    cdef int32_t i, q, end
    cdef const int32_t* idx = s.a.indices
    cdef const double* val = s.a.data
    cdef double t, u, s0, s1, f0, f1
    for i in range(s.n):
        q = s.a.indptr[i]
        end = s.a.indptr[i + 1]
        s0 = 0.0
        s1 = 0.0
        f0 = 0.0
        f1 = 0.0
        while q + 2 <= end:
            t = val[q] * s.x[idx[q]]
            u = val[q + 1] * s.x[idx[q + 1]]
            s0 += t
            s1 += u
            f0 += fabs(t)
            f1 += fabs(u)
            q += 2
        if q < end:
            t = val[q] * s.x[idx[q]]
            s0 += t
            f0 += fabs(t)
        s.w[i] = (s0 + s1) - s.p.b[i]
        s.f[i] = unit_roundoff() * ((f0 + f1) + fabs(s.p.b[i]))
        if s.shift > 0.0:
            s.w[i] += s.shift * s.p.d[i] * (s.x[i] - s.center[i])


cdef inline int32_t wanted(const pivoting_t* s, int32_t i) noexcept nogil:
    # Side of row i after (3). 8 f: a few roundings of w, and of x through d.
    cdef double lower = s.p.lower[i], upper = s.p.upper[i], slop = 8.0 * s.f[i]
    if lower == upper:
        return AT_LOWER
    if s.at[i] == AT_LOWER:
        return FREE if s.w[i] < -slop else AT_LOWER
    if s.at[i] == AT_UPPER:
        return FREE if s.w[i] > slop else AT_UPPER
    slop = slop / s.p.d[i]
    if s.x[i] < lower - slop:
        return AT_LOWER
    if s.x[i] > upper + slop:
        return AT_UPPER
    return FREE


cdef int32_t pivots_exchange(pivoting_t* s) noexcept nogil:
    """(3), (4); the number of infeasible rows before, as a negative number where patience was used up."""
    cdef int32_t i, bad = 0
    for i in range(s.n):
        bad += wanted(s, i) != s.at[i]
    if bad == 0:
        return 0
    if bad < s.best:
        s.best = bad
        s.patience = PATIENCE
    elif s.patience > 0:
        s.patience -= 1
    else:
        return -bad
    s.is_factored = 0
    for i in range(s.n):
        s.at[i] = wanted(s, i)
    s.exchanged += bad
    return bad


cdef inline void pivots_place(pivoting_t* s) noexcept nogil:
    """x of bound rows."""
    cdef int32_t i
    for i in range(s.n):
        if s.at[i] == AT_LOWER:
            s.x[i] = s.p.lower[i]
        elif s.at[i] == AT_UPPER:
            s.x[i] = s.p.upper[i]


cdef inline void pivots_predict(pivoting_t* s) noexcept nogil:
    """Sides from x and w: where x - w / d falls; w of this x."""
    cdef int32_t i
    cdef double y
    for i in range(s.n):
        y = s.x[i] - s.w[i] / s.p.d[i]
        if y <= s.p.lower[i] or s.p.lower[i] == s.p.upper[i]:
            s.at[i] = AT_LOWER
        elif y >= s.p.upper[i]:
            s.at[i] = AT_UPPER
        else:
            s.at[i] = FREE
    s.is_factored = 0


cdef inline void pivots_sweep(pivoting_t* s, int32_t n) noexcept nogil:
    """n times: all rows upwards, then downwards, x_i <- clip(x_i - omega w_i / d_i), omega = 1.7, then 1.

    Along a stack each contact gets 0.85 of what the one before got: over-relaxed, the news travels 4000
    contacts before it underflows; at 0.5 it would be 1000.
    """
    cdef int32_t i, k
    cdef double* x = s.x
    cdef double omega, w
    for k in range(n):
        omega = 1.7 if k == 0 else 1.0
        for i in range(s.n):
            w = csr_dot(s.a, i, x) - s.p.b[i]
            x[i] = relax_row(x[i], w, omega * s.p.step[i], s.p.lower[i], s.p.upper[i])
        for i in range(s.n - 1, -1, -1):
            w = csr_dot(s.a, i, x) - s.p.b[i]
            x[i] = relax_row(x[i], w, omega * s.p.step[i], s.p.lower[i], s.p.upper[i])


cdef void pivots_solve_free(pivoting_t* s) noexcept nogil:
    """x = A^-1 b, all rows free and factored; w is left alone."""
    cdef int32_t i
    cdef double* y = s.x if s.natural else s.y
    if s.is_half_solved:
        s.is_half_solved = 0
        ldl_back_all(s.n, s.width, s.c, s.x)
        return
    for i in range(s.n):
        y[i if s.natural else s.place[i]] = s.p.b[i]
    solve_factored(s, y)
    if not s.natural:
        for i in range(s.n):
            s.x[i] = y[s.place[i]]


cdef inline int32_t pivots_all_free(pivoting_t* s) noexcept nogil:
    """Are all rows free at the solution? 1, with x, where A is positive definite and x within its bounds."""
    cdef int32_t i
    for i in range(s.n):
        if s.p.lower[i] == s.p.upper[i]:
            return 0
    pivots_factor_all(s)
    if s.found.negative > 0 or s.found.small > 0:
        s.is_factored = 0
        return 0
    pivots_solve_free(s)
    for i in range(s.n):
        if not s.p.lower[i] <= s.x[i] <= s.p.upper[i]:
            s.is_factored = 0
            return 0
    return 1


cdef int32_t pivots_rounds(pivoting_t* s, int32_t rounds) noexcept nogil:
    """At most `rounds` rounds of: factor, solve, exchange; until no row is infeasible, or a factor is not begun."""
    cdef int32_t _r, bad
    for _r in range(rounds):
        s.n_rounds += 1
        pivots_place(s)
        pivots_slack(s)
        if not s.is_factored:
            factor_free(s, NULL)
        if s.late:
            s.n_rounds -= 1
            return ROUNDS
        if s.found.negative > 0:
            return INDEFINITE
        if s.found.small > 0 and (s.shift == 0.0 or s.swap != NULL or s.refactor != NULL):
            return SMALL
        pivots_correct(s)
        pivots_slack(s)
        bad = pivots_exchange(s)
        if bad == 0:
            return SOLVED
        if bad < 0:
            return STUCK
    return ROUNDS


cdef int32_t pivots_solve(pivoting_t* s, const double* start, int32_t sweeps, int32_t n, int32_t* swept) noexcept nogil:
    """A boxed problem: where that costs less than the sweeps all rows free first, which may be the end of it.

    Else `sweeps` symmetric sweeps from `start` (m), the rows free that they leave free, and at most n rounds.
    """
    cdef int32_t i
    # Multiply-adds: (band + 1)^2 / 2 a row against two for each nonzero and sweep.
    cdef bint cheap = s.band >= 0 and n > 0 and s.n > 0 and (
        (s.band + 1.0) * (s.band + 1) * s.n <= 4.0 * sweeps * s.a.indptr[s.n])
    swept[0] = not (cheap and pivots_all_free(s))
    if not swept[0]:
        s.n_rounds += 1
        return SOLVED
    for i in range(s.n):
        s.x[i] = start[i]
    pivots_sweep(s, sweeps)
    pivots_slack(s)
    pivots_predict(s)
    return pivots_rounds(s, n)


cdef void pivots_restart(pivoting_t* s) noexcept nogil:
    s.best = s.n + 1
    s.patience = PATIENCE


cdef void pivots_start(pivoting_t* s, double shift) noexcept nogil:
    s.shift = shift
    s.is_factored = 0
    pivots_restart(s)


cdef void pivots_renew(pivoting_t* s) noexcept nogil:
    """As if made anew: no row at a bound, nothing factored, nothing counted."""
    cdef int32_t i
    for i in range(s.n):
        s.at[i] = FREE
    s.is_half_solved = s.exchanged = s.factorisations = s.n_rounds = s.late = 0
    no_pivots(&s.found)
    pivots_start(s, 0.0)


cdef void pivots_on(pivoting_t* s, const csr_t* a, const blocks_t* p, int32_t band, const int32_t* order, double tiny,
                    double* real, int32_t* whole) noexcept nogil:
    """Arrays in real, 6 m numbers and the factor's, and whole, 2 m; order: NULL as rows stand."""
    cdef int32_t i, m = p.n_rows
    s.a = a
    s.p = p
    s.n = m
    s.band = band
    s.tiny = tiny
    s.order = order
    s.natural = 1
    if order != NULL:
        for i in range(m):
            s.natural &= order[i] == i
    s.x = real
    s.w = real + m
    s.f = real + 2 * m
    s.center = real + 3 * m
    s.y = real + 4 * m
    s.size = real + 5 * m
    s.c = real + 6 * m
    s.at = whole
    s.place = whole + m
    s.swap = NULL
    s.outside = NULL
    s.refactor = NULL
    s.resolve = NULL
    pivots_renew(s)
