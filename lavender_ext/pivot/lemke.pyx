"""Lemke's method: complementary pivoting on a dense dictionary, with lexicographic ties.

    w = q + M s + c z,   w, s >= 0,  w_k s_k = 0,   z from its first value down to 0                          (1)
    basic_i = t[i, VALUES] + sum_j t[i, j] nonbasic_j,   i < n,  z is nonbasic at first                       (2)

The n pairs (w_k, s_k) are numbered w_k = k and s_k = n_pairs + k, and z = 2 n_pairs. The first pivot makes z basic in the row
with the smallest q_k / c_k. From then on the complement of the variable that left enters, and the row with the smallest ratio
leaves:

    min over t[i, c] < 0 of (t[i, VALUES], beta_i) / -t[i, c],   beta_i = row i of the inverse basis          (3)

Ratios are compared lexicographically, which decides as q + (e, e^2, ...) would for a small e > 0, so that no basis returns.
beta is read from (2): column k of the inverse basis is minus the column of the k-th initial basic variable, or a unit vector if
that variable is basic.

Bounded rows become pairs, scaled to unit diagonal:

    lower bound only    lambda = lower + s              upper bound only    lambda = upper - s, w -> -w
    two bounds          lambda = lower + s, and a second pair, the cap: upper - lower - s >= 0 complementary to v >= 0,
                        w + v >= 0 complementary to s
    free                s basic for good and w = 0: two pivots at most, before the path; a free row that depends on others
                        keeps lambda = 0
    fixed               a constant

States of a solve, and the events that change them:

    START  -> WALK     a dictionary is built; z is basic unless s = 0 is the solution
    WALK   -> WALK     the pivots of the call are used up: returns PIVOTS
    WALK   -> FINISH   z has left, or the path is too long, or no row leaves: then returns RAY, whose direction the host checks
    FINISH -> FINISH   the exchanges are not over: returns EXCHANGES after FINISH_ROUNDS rounds
    START -> START, WALK -> WALK, FINISH -> FINISH   the deadline has passed: returns LATE
    FINISH -> START    the residual is above rounding: another path, with another covering vector c
    FINISH -> OVER     the residual is at rounding, or there were MAX_PATHS paths: returns DONE

FINISH exchanges free and bounded rows on A itself (pivot/direct.pyx) from the bounds of the path's end, so that rounding of the
pivots does not reach the result.
"""
from libc.math cimport INFINITY, fabs, sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy

import numpy as np

from lavender_ext.core.deadline cimport has_passed
from lavender_ext.core.arena cimport arena_t, make_arena, take_doubles, take_integers
from lavender_ext.core.validate cimport norm_inf
from lavender_ext.core.order cimport next_random
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.pivot.direct cimport (Pivoting, begin_direct_solve, begin_bound_exchanges, direct_t, is_solved_to_rounding,
                                        judge_iterate, step_direct_solve)
from lavender_ext.pivot.lemke cimport DONE, EXCHANGES, LATE, PIVOTS, RAY, dictionary_t, lemke_t
from lavender_ext.pivot.principal cimport AT_LOWER, AT_UPPER, FREE


cdef enum:                      # states
    START = 0
    WALK = 1
    FINISH = 2
    OVER = 3

cdef enum:
    NO_COLUMN = -1              # no variable enters, because s = 0 is the solution

cdef enum:                      # columns of the dictionary before those of the pairs
    COVER = 0                   # the column of z until z is basic
    VALUES = 1                  # values of the basic variables
    FIRST = 2                   # first column of a nonbasic variable of a pair

cdef enum:
    MAX_PATHS = 8               # Largest number of paths, each with another covering vector c.
    PIVOTS_PER_PAIR = 20        # A path ends without a result after PIVOTS_PER_PAIR n + EXTRA_PIVOTS pivots.
    EXTRA_PIVOTS = 200
    FINISH_ROUNDS = 32          # Rounds of exchanges in one step at the end of a path.


# -- the dictionary ----------------------------------------------------------------------------------------------

cdef inline int32_t complementary_variable(const dictionary_t* d, int32_t variable) noexcept nogil:
    """Return the complement of a variable: s_k for w_k, and w_k for s_k."""
    return variable - d.n_pairs if variable >= d.n_pairs else variable + d.n_pairs


cdef inline int32_t row_of_basic_variable(const dictionary_t* d, int32_t variable) noexcept nogil:
    """Return the row of a basic variable, or -1."""
    return d.position[variable]


cdef inline int32_t column_of_nonbasic_variable(const dictionary_t* d, int32_t variable) noexcept nogil:
    """Return the column of a nonbasic variable."""
    return -1 - d.position[variable]


cdef inline void set_basic_variable(dictionary_t* d, int32_t row, int32_t variable) noexcept nogil:
    d.basic[row] = variable
    d.position[variable] = row


cdef inline void set_nonbasic_variable(dictionary_t* d, int32_t column, int32_t variable) noexcept nogil:
    d.nonbasic[column] = variable
    d.position[variable] = -1 - column


cdef inline double inverse_basis_entry(const dictionary_t* d, int32_t row, int32_t k) noexcept nogil:
    """Return beta_row,k of (3)."""
    cdef int32_t at = d.position[d.initial[k]]
    if at < 0:
        return -d.t[row * d.width - 1 - at]
    return 1.0 if at == row else 0.0


cdef inline bint precedes_lexicographically(const dictionary_t* d, int32_t i, int32_t k, double divisor_i,
                                            double divisor_k) noexcept nogil:
    """Return whether beta_i / divisor_i is lexicographically below beta_k / divisor_k."""
    cdef int32_t j
    cdef double x, y, tolerance
    for j in range(d.n):
        x = inverse_basis_entry(d, i, j) / divisor_i
        y = inverse_basis_entry(d, k, j) / divisor_k
        tolerance = 1e-10 * (fabs(x) + fabs(y))
        if x < y - tolerance:
            return True
        if x > y + tolerance:
            return False
    return i < k


cdef inline void pivot_dictionary(dictionary_t* d, int32_t r, int32_t c) noexcept nogil:
    """Exchange the basic variable of row r and the nonbasic variable of column c."""
    cdef int32_t i, j, n = d.n + FIRST, leaving = d.basic[r]
    cdef double* pivot_row = d.t + r * d.width
    cdef double* row
    cdef double p = 1.0 / pivot_row[c], factor
    for j in range(n):
        pivot_row[j] = -pivot_row[j] * p
    pivot_row[c] = p
    for i in range(d.n_pairs):
        row = d.t + i * d.width
        factor = row[c]
        if i == r or factor == 0.0:
            continue
        row[c] = 0.0
        for j in range(n):
            row[j] += factor * pivot_row[j]
    set_basic_variable(d, r, d.nonbasic[c])
    set_nonbasic_variable(d, c, leaving)


cdef inline int32_t find_leaving_row(const dictionary_t* d, int32_t c) noexcept nogil:
    """Return the row (3) whose variable leaves if the variable of column c enters, or -1. Among equal ratios z leaves."""
    cdef int32_t i, best = -1
    cdef double column_scale = 0.0, value_scale = 0.0, divisor, value, ratio, min_ratio = 0.0, tolerance
    cdef const double* row
    for i in range(d.n):
        row = d.t + i * d.width
        column_scale = max(column_scale, fabs(row[c]))
        value_scale = max(value_scale, fabs(row[VALUES]))
    for i in range(d.n):
        row = d.t + i * d.width
        divisor = -row[c]
        if not divisor > 1e-13 * column_scale:
            continue
        value = row[VALUES] if row[VALUES] >= 1e-13 * value_scale else 0.0
        ratio = value / divisor
        tolerance = 1e-12 * (ratio + min_ratio)
        if best < 0 or ratio < min_ratio - tolerance:
            best, min_ratio = i, ratio
        elif ratio <= min_ratio + tolerance and d.basic[best] != 2 * d.n_pairs:
            if d.basic[i] == 2 * d.n_pairs or precedes_lexicographically(d, i, best, divisor, -d.t[best * d.width + c]):
                best, min_ratio = i, ratio
    return best


# -- bounded rows as pairs ---------------------------------------------------------------------------------------

cdef inline bint is_free_row(const blocks_t* p, int32_t i) noexcept nogil:
    return p.lower[i] == -INFINITY and p.upper[i] == INFINITY


cdef inline bint has_two_bounds(const blocks_t* p, int32_t i) noexcept nogil:
    """Return whether row i has two bounds that differ."""
    return p.lower[i] > -INFINITY and p.upper[i] < INFINITY and p.lower[i] != p.upper[i]


cdef inline double impulse_at_zero_variable(const blocks_t* p, int32_t i) noexcept nogil:
    """Return lambda_i at s = 0."""
    return p.lower[i] if p.lower[i] > -INFINITY else (p.upper[i] if p.upper[i] < INFINITY else 0.0)


cdef inline double impulse_per_variable(const blocks_t* p, int32_t i) noexcept nogil:
    """Return the change of lambda_i per unit of s: (lambda_i - `impulse_at_zero_variable`) / s."""
    cdef double size = 1.0 / sqrt(p.d[i])
    return size if p.lower[i] > -INFINITY or p.upper[i] == INFINITY else -size


cdef inline int32_t first_free_pair(const lemke_t* l) noexcept nogil:
    """Return the first pair of a free row; pairs of bounded rows, then caps, come before it."""
    return l.n_bounded + l.n_caps


cdef inline void number_complementary_pairs(lemke_t* l, int32_t* pair_of) noexcept nogil:
    """Assign numbers to the pairs: bounded rows, their caps, free rows. Write the pair of each row, or -1, to `pair_of`."""
    cdef const blocks_t* p = l.t.s.p
    cdef int32_t i, k, n = 0
    for i in range(p.n_rows):
        pair_of[i] = -1
        if p.lower[i] != p.upper[i] and not is_free_row(p, i):
            pair_of[i], l.row[n] = n, i
            n += 1
    l.n_bounded = n
    for k in range(l.n_bounded):
        if has_two_bounds(p, l.row[k]):
            l.row[n] = k
            n += 1
    l.n_caps = n - l.n_bounded
    for i in range(p.n_rows):
        if is_free_row(p, i):
            pair_of[i], l.row[n] = n, i
            n += 1
    l.d.n_pairs = l.d.n = n


cdef inline void build_dictionary_without_cover(lemke_t* l) noexcept nogil:
    """Build (1) as a dictionary in which every w is basic; z has no column yet."""
    cdef dictionary_t* d = &l.d
    cdef const blocks_t* p = l.t.s.p
    cdef int32_t* pair_of = l.t.s.place                 # `place` is free until the exchanges, and is used as scratch.
    cdef int32_t i, j, k, q
    cdef double w
    cdef double* row
    number_complementary_pairs(l, pair_of)
    for k in range(d.n):
        set_basic_variable(d, k, k)
        set_nonbasic_variable(d, k + FIRST, d.n + k)
        row = d.t + k * d.width
        for j in range(d.n + FIRST):
            row[j] = 0.0
    # rows of A, and w at s = 0
    for i in range(p.n_rows):
        if pair_of[i] < 0:
            continue
        row = d.t + pair_of[i] * d.width
        w = -p.b[i]
        for q in range(l.t.s.a.indptr[i], l.t.s.a.indptr[i + 1]):
            j = l.t.s.a.indices[q]
            w += l.t.s.a.data[q] * impulse_at_zero_variable(p, j)
            if pair_of[j] >= 0:
                row[pair_of[j] + FIRST] = impulse_per_variable(p, i) * l.t.s.a.data[q] * impulse_per_variable(p, j)
        row[VALUES] = impulse_per_variable(p, i) * w
    # caps
    for k in range(l.n_bounded, first_free_pair(l)):
        j = l.row[k]
        i = l.row[j]
        d.t[j * d.width + k + FIRST] = 1.0
        row = d.t + k * d.width
        row[j + FIRST] = -1.0
        row[VALUES] = (p.upper[i] - p.lower[i]) * sqrt(p.d[i])


# -- free rows ---------------------------------------------------------------------------------------------------

cdef inline void swap_entries(double* x, double* y, int32_t n, int64_t stride) noexcept nogil:
    cdef int32_t k
    cdef double old
    for k in range(n):
        old = x[k * stride]
        x[k * stride] = y[k * stride]
        y[k * stride] = old


cdef inline void swap_dictionary_rows(dictionary_t* d, int32_t i, int32_t j) noexcept nogil:
    cdef int32_t variable = d.basic[i]
    swap_entries(d.t + i * d.width, d.t + j * d.width, d.n + FIRST, 1)
    set_basic_variable(d, i, d.basic[j])
    set_basic_variable(d, j, variable)


cdef inline void swap_dictionary_columns(dictionary_t* d, int32_t i, int32_t j) noexcept nogil:
    cdef int32_t variable = d.nonbasic[i]
    swap_entries(d.t + i, d.t + j, d.n_pairs, d.width)
    set_nonbasic_variable(d, i, d.nonbasic[j])
    set_nonbasic_variable(d, j, variable)


cdef inline int32_t find_pivot_pair_of_free_rows(lemke_t* l, int32_t* r, int32_t* c) noexcept nogil:
    """Find a free w (row r), a free s (column c), and a bounded pair between them; return its row, or -1.

    The product of the two entries, relative to their rows, is the largest: it is the determinant of both pivots, since w and s
    have no pivot.
    """
    cdef dictionary_t* d = &l.d
    cdef int32_t i, j, row, column, first = first_free_pair(l), found = -1
    cdef double in_column, in_row, best = 1e-11
    cdef const double* bounded_row
    for i in range(d.n):
        d.t[i * d.width + COVER] = norm_inf(d.t + i * d.width + FIRST, d.n)     # z has no column yet.
    for j in range(first):
        bounded_row = d.t + j * d.width
        in_column, in_row, row, column = 0.0, 0.0, first, first + FIRST
        for i in range(first, d.n):
            if fabs(d.t[i * d.width + j + FIRST]) > in_column * d.t[i * d.width + COVER]:
                in_column, row = fabs(d.t[i * d.width + j + FIRST]) / d.t[i * d.width + COVER], i
            if fabs(bounded_row[i + FIRST]) > in_row * bounded_row[COVER]:
                in_row, column = fabs(bounded_row[i + FIRST]) / bounded_row[COVER], i + FIRST
        if in_column * in_row > best:
            best, found, r[0], c[0] = in_column * in_row, j, row, column
    return found


cdef inline bint has_passed_after_pivot(const lemke_t* l) noexcept nogil:
    """Count the work of a pivot, 1 ns per entry ("dictionary pivot" of the rates); return whether the deadline has passed."""
    return has_passed(l.t.s.deadline, <double>l.d.width * l.d.n_pairs)


cdef inline bint pivot_out_free_rows(lemke_t* l) noexcept nogil:
    """Make s of every free row basic and w nonbasic, and retire both: move them behind the others.

    Retired rows still follow the pivots of the path; retired columns do not, because their variables stay 0. Return whether all
    rows are retired; the deadline ends it before.
    """
    cdef dictionary_t* d = &l.d
    cdef int32_t r, c, bounded, i, j
    cdef double size, best
    while d.n > first_free_pair(l):
        if has_passed_after_pivot(l):
            return False
        r, c = d.n - 1, d.n - 1 + FIRST                 # Without a pivot the row depends on others, and s stays 0.
        best = 1e-11                                    # Smaller entries, relative to their row, count as rounding.
        for i in range(first_free_pair(l), d.n):
            size = norm_inf(d.t + i * d.width + FIRST, d.n)
            for j in range(first_free_pair(l) + FIRST, d.n + FIRST):
                if fabs(d.t[i * d.width + j]) > best * size:
                    r, c, best = i, j, fabs(d.t[i * d.width + j]) / size
        if best > 1e-11:
            pivot_dictionary(d, r, c)
        else:
            bounded = find_pivot_pair_of_free_rows(l, &r, &c)
            if bounded >= 0:
                pivot_dictionary(d, r, bounded + FIRST)
                pivot_dictionary(d, bounded, c)
                swap_dictionary_rows(d, r, bounded)
                swap_dictionary_columns(d, c, bounded + FIRST)
        swap_dictionary_rows(d, r, d.n - 1)
        swap_dictionary_columns(d, c, d.n - 1 + FIRST)
        d.n -= 1
    return True


# -- a path ------------------------------------------------------------------------------------------------------

cdef inline bint begin_lemke_path(lemke_t* l) noexcept nogil:
    """Build the dictionary, retire free rows, draw c unless this is the first path, and make z basic if a value is negative.

    Return whether the path has begun; the deadline ends it before.
    """
    cdef dictionary_t* d = &l.d
    cdef int32_t i, entering, r = 0
    cdef double* row
    cdef double* first_row
    build_dictionary_without_cover(l)
    if not pivot_out_free_rows(l):
        return False
    # covering vector
    for i in range(d.n_pairs):
        row = d.t + i * d.width
        row[COVER] = 0.0 if i >= d.n else 1.0
        if i < d.n and l.n_paths > 0:
            row[COVER] = 0.2 + 1.6 * ((next_random(&l.random) >> 11) * 2.0**-53)
    # Find the first row that z limits. Of equal ratios, the last is lexicographically smallest.
    for i in range(d.n):
        d.initial[i] = d.basic[i]
        row, first_row = d.t + i * d.width, d.t + r * d.width
        if row[VALUES] * first_row[COVER] <= first_row[VALUES] * row[COVER]:
            r = i
    l.n_paths += 1
    l.max_pivots = l.n_pivots + PIVOTS_PER_PAIR * d.n + EXTRA_PIVOTS
    l.state = WALK
    set_nonbasic_variable(d, COVER, 2 * d.n_pairs)
    d.entering = NO_COLUMN
    if d.n > 0 and d.t[r * d.width + VALUES] < 0.0:
        entering = complementary_variable(d, d.basic[r])
        pivot_dictionary(d, r, COVER)
        d.entering = column_of_nonbasic_variable(d, entering)
        l.n_pivots += 1
    return True


cdef inline int32_t follow_lemke_path(lemke_t* l, int32_t max_pivots) noexcept nogil:
    """Pivot until z leaves (DONE), no variable leaves (RAY), there are `max_pivots` pivots (PIVOTS), or it is LATE."""
    cdef dictionary_t* d = &l.d
    cdef int32_t r, leaving
    if d.entering == NO_COLUMN:
        return DONE
    while l.n_pivots < max_pivots:
        r = find_leaving_row(d, d.entering)
        if r < 0:
            return RAY
        leaving = d.basic[r]
        pivot_dictionary(d, r, d.entering)
        l.n_pivots += 1
        if leaving == 2 * d.n_pairs:
            return DONE
        d.entering = column_of_nonbasic_variable(d, complementary_variable(d, leaving))
        if has_passed_after_pivot(l):
            return LATE
    return PIVOTS


# -- the end of a path -------------------------------------------------------------------------------------------

cdef inline void read_dictionary_column(const lemke_t* l, int32_t c, double min_entry, double* x) noexcept nogil:
    """Write lambda (m) in column c to x: its value without the base, or its change with the entering variable."""
    cdef const dictionary_t* d = &l.d
    cdef const blocks_t* p = l.t.s.p
    cdef int32_t i, k, r
    cdef double s
    for i in range(p.n_rows):
        x[i] = 0.0
    for k in range(d.n_pairs):
        if l.n_bounded <= k < first_free_pair(l):
            continue
        r = row_of_basic_variable(d, d.n_pairs + k)
        s = d.t[r * d.width + c] if r >= 0 else (column_of_nonbasic_variable(d, d.n_pairs + k) == c)
        if s > min_entry or k >= first_free_pair(l):
            x[l.row[k]] = impulse_per_variable(p, l.row[k]) * s


cdef inline void judge_path_impulse(lemke_t* l) noexcept nogil:
    """Judge the present impulse, and store the bound of each row."""
    cdef const dictionary_t* d = &l.d
    cdef const blocks_t* p = l.t.s.p
    cdef int32_t* at = l.t.s.at
    cdef int32_t i, k
    read_dictionary_column(l, VALUES, 0.0, l.t.s.x)
    for i in range(p.n_rows):
        l.t.s.x[i] += impulse_at_zero_variable(p, i)
        at[i] = FREE if p.lower[i] != p.upper[i] else AT_LOWER
    for k in range(l.n_bounded):
        if row_of_basic_variable(d, d.n_pairs + k) < 0:
            at[l.row[k]] = AT_LOWER if p.lower[l.row[k]] > -INFINITY else AT_UPPER
    for k in range(l.n_bounded, first_free_pair(l)):
        if row_of_basic_variable(d, d.n_pairs + k) >= 0:               # The multiplier of the cap is positive.
            at[l.row[l.row[k]]] = AT_UPPER
    judge_iterate(l.t)


# -- calls -------------------------------------------------------------------------------------------------------

cdef void bind_lemke_arrays(lemke_t* l, direct_t* t, arena_t* a) noexcept nogil:
    """Take the arrays of l for the rows of t from an arena; t has its arrays, or both are only counted."""
    cdef int64_t n = 0                                  # number of pairs
    cdef int32_t i
    for i in range(t.s.p.n_rows):
        if t.s.p.lower[i] != t.s.p.upper[i]:
            n += 1 + has_two_bounds(t.s.p, i)
    l.t, l.d.width = t, n + FIRST
    l.d.t = take_doubles(a, n * l.d.width)
    l.row, l.d.initial, l.d.basic = take_integers(a, n), take_integers(a, n), take_integers(a, n)
    l.d.nonbasic, l.d.position = take_integers(a, n + FIRST), take_integers(a, 2 * n + 1)


cdef void begin_lemke_solve(lemke_t* l) noexcept nogil:
    """Begin a solve, and judge t.start (m)."""
    l.state = START
    l.n_pivots = l.n_paths = 0
    l.random = 0
    memcpy(l.t.s.x, l.t.start, l.t.s.n * sizeof(double))
    judge_iterate(l.t)


cdef int32_t follow_lemke_paths(lemke_t* l, int32_t pivots) noexcept nogil:
    """Do up to `pivots` further pivots; return DONE, PIVOTS, EXCHANGES, RAY or LATE. The best judged impulse is in t.best.

    Several short calls give the same bits as one long call.
    """
    cdef int32_t code, max_pivots = l.n_pivots + pivots
    while l.state != OVER:
        if l.state == START:
            if l.n_pivots >= max_pivots:
                return PIVOTS
            if not begin_lemke_path(l):
                return LATE
        if l.state == WALK:
            code = follow_lemke_path(l, min(max_pivots, l.max_pivots))
            if code == PIVOTS and l.n_pivots < l.max_pivots or code == LATE:
                return code
            judge_path_impulse(l)
            begin_bound_exchanges(l.t)
            l.state = FINISH
            if code == RAY and not is_solved_to_rounding(l.t):
                return RAY
        if l.state == FINISH:
            step_direct_solve(l.t, FINISH_ROUNDS)
            if l.t.s.late:
                return LATE
            if not l.t.is_over:
                return EXCHANGES
            l.state = OVER if is_solved_to_rounding(l.t) or l.n_paths == MAX_PATHS else START
    return DONE


cdef void judge_unfinished_path(lemke_t* l) noexcept nogil:
    """Judge the present impulse of a path that is not continued."""
    if l.state == WALK:
        judge_path_impulse(l)


cdef class Lemke:
    """Lemke's method on one problem with bounded rows.

    Parameters
    ----------
    rows : Pivoting
        The problem's rows; the object judges impulses, keeps the best impulse, and makes the exchanges at the end of a path.
    """

    cdef lemke_t l
    cdef Pivoting rows
    cdef object keep

    def __init__(self, Pivoting rows):
        cdef arena_t arena = make_arena(NULL, NULL)
        cdef double[::1] real
        cdef int32_t[::1] index
        bind_lemke_arrays(&self.l, &rows.t, &arena)
        real, index = np.empty(arena.n_real + 1), np.empty(arena.n_index, np.int32)
        self.rows, self.keep = rows, (real, index)
        arena = make_arena(&real[0], &index[0])
        bind_lemke_arrays(&self.l, &rows.t, &arena)

    def set_start(self, const double[::1] start):
        """Begin a solve at start (m,) [N s]."""
        begin_direct_solve(&self.rows.t, &start[0])
        begin_lemke_solve(&self.l)

    def run(self, int pivots):
        """Do up to `pivots` further pivots; return DONE, PIVOTS, EXCHANGES, RAY or LATE."""
        cdef int32_t code
        with nogil:
            code = follow_lemke_paths(&self.l, pivots)
        return self.rows.raise_error(code)

    def judge(self):
        """Judge the present impulse of an interrupted path, and keep it in `rows` if its residual is the lowest so far."""
        judge_unfinished_path(&self.l)

    @property
    def ray(self):
        """Direction (m,) of the ray, after RAY; rows with two bounds have the direction 0."""
        cdef double[::1] y = np.empty(self.rows.t.s.n)
        cdef const dictionary_t* d = &self.l.d
        cdef const blocks_t* p = self.l.t.s.p
        cdef double size = 1.0
        cdef int32_t i
        for i in range(d.n):
            size = max(size, fabs(d.t[i * d.width + d.entering]))
        read_dictionary_column(&self.l, d.entering, 1e-11 * size, &y[0])
        for i in range(p.n_rows):
            if p.lower[i] > -INFINITY and p.upper[i] < INFINITY:
                y[i] = 0.0
        return y.base

    @property
    def pivots(self):
        return self.l.n_pivots

    @property
    def paths(self):
        return self.l.n_paths
