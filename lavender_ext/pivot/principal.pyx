"""Principal pivoting on a boxed LCP, with its factorisations: LDL^T, or LU of few rows if A is not symmetric.

    free rows F: (A_FF + s D_FF) x_F = b_F - A_FB x_B + s D_FF center_F,  bound rows B: x = its bound    (1)
    w = A x - b + s D (x - center),   D = diag(d)                                                       (2)
    infeasible: x_i outside its bounds on F, w_i < 0 at a lower, w_i > 0 at an upper bound              (3)
    exchange all infeasible rows, unless their number has not fallen for MAX_PATIENCE exchanges         (4)

Judice, Pires 1994 (block principal pivoting; if (4) is stuck, the caller descends on the energy instead).
s > 0 is the proximal shift of a singular matrix. Free rows are numbered compactly in a fixed order of elimination, so the
bandwidth of A never grows; a dense matrix is a band of full width. A linear system is the case in which all rows are free. LU
factors D^-1/2 (A_FF + s D_FF) D^-1/2, dense, with row exchanges for the largest pivot.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.deadline cimport has_passed
from lavender_ext.core.arena cimport arena_t, take_doubles, take_integers
from lavender_ext.core.block cimport project_row_update
from lavender_ext.core.csr cimport csr_row_dot
from lavender_ext.core.view cimport csr_t
from lavender_ext.factor.factors cimport has_wide, clear_pivot_statistics
from lavender_ext.factor.linear cimport CHOLESKY, LU, analyse_band, analyse_dense, factor_linear_system_matrix, solve_linear_system
from lavender_ext.judge.score cimport unit_roundoff
from lavender_ext.pivot.principal cimport AT_LOWER, AT_UPPER, FREE, INDEFINITE, ROUNDS_USED, SMALL_PIVOT, SOLVED, STUCK, pivoting_t


cdef enum:
    MAX_PATIENCE = 8            # Rounds are stuck after this many exchanges without a new smallest number of infeasible rows.


cdef inline void copy_free_rows_to_dense_matrix(pivoting_t* s) noexcept nogil:
    """Copy A_FF to the full matrix of L U."""
    cdef int32_t i, j, q, at, to
    cdef const csr_t* a = s.a
    cdef double* row
    analyse_dense(&s.linear, s.n_free)
    for i in range(s.n):
        at = s.place[i]
        if at < 0:
            continue
        row = s.linear.matrix + <int64_t>at * s.n_free
        for j in range(s.n_free):
            row[j] = 0.0
        for q in range(a.indptr[i], a.indptr[i + 1]):
            to = s.place[a.indices[q]]
            if to >= 0:
                row[to] = a.data[q]


cdef inline void copy_free_rows_to_band(pivoting_t* s) noexcept nogil:
    """Copy A_FF to the columns of its band."""
    cdef int32_t i, j, q, at, to
    cdef bint in_place = s.natural and s.n_free == s.n
    cdef const csr_t* a = s.a
    cdef double* col
    analyse_band(&s.linear, s.n_free, s.band + 1 if s.band < s.n_free else s.n_free)
    for i in range(s.n):
        at = s.place[i]
        if at < 0:
            continue
        col = s.linear.matrix + <int64_t>at * s.linear.width
        for j in range(s.linear.width):
            col[j] = 0.0
        col -= at
        q = a.indptr[i]
        if in_place:
            q = a.indptr[i + 1]                         # Every row keeps its place: copy the upper half, from the right.
            while q > a.indptr[i] and a.indices[q - 1] >= i:
                q -= 1
                col[a.indices[q]] = a.data[q]
        else:
            for q in range(a.indptr[i], a.indptr[i + 1]):
                to = s.place[a.indices[q]]
                if to >= at:
                    col[to] = a.data[q]


cdef void factor_free_rows(pivoting_t* s, double* x) noexcept nogil:
    """Factor A_FF + s D_FF of (1). L D L^T begins the solve of x (n_free) on the way, unless x is NULL."""
    cdef int32_t i, k = 0, r, small
    for r in range(s.n):
        i = r if s.natural else s.order[r]
        s.place[i] = -1
        if s.at[i] == FREE:
            s.place[i] = k
            s.size[k] = s.p.d[i]
            k += 1
    s.n_free = k
    s.linear.ahead = x
    if s.factor_outside != NULL:
        small = s.factor_outside(s.outside, s.place, s.n_free, s.linear.shift)
        s.late = small < 0
        if s.late:
            return
        clear_pivot_statistics(&s.linear.pivots)
        s.linear.pivots.small = small
        s.factorisations += 1
        s.is_factored = 1
        return
    if s.linear.by == LU:
        copy_free_rows_to_dense_matrix(s)
    else:
        copy_free_rows_to_band(s)
    s.linear.deadline = s.deadline
    factor_linear_system_matrix(&s.linear)
    s.factorisations += 1
    s.is_factored = 1
    s.late = s.deadline != NULL and s.deadline.passed


cdef inline void solve_free_rows(pivoting_t* s, double* y) noexcept nogil:
    """Compute y (n_free) <- (A_FF + s D_FF)^-1 y."""
    if s.solve_outside != NULL:
        s.solve_outside(s.outside, s.n_free, y)
    else:
        solve_linear_system(&s.linear, y)


cdef void factor_all_rows(pivoting_t* s) noexcept nogil:
    """Factor A with all rows free and no shift. L D L^T in natural order begins the solve of x = A^-1 b at the same time."""
    cdef int32_t i
    for i in range(s.n):
        s.at[i] = FREE
        s.x[i] = s.p.b[i]
    factor_free_rows(s, s.x if s.natural and s.linear.by != LU and s.factor_outside == NULL else NULL)


cdef void correct_free_row_solution(pivoting_t* s) noexcept nogil:
    """Compute x_F <- x_F - (A_FF + s D_FF)^-1 w_F."""
    cdef int32_t i
    for i in range(s.n):
        if s.place[i] >= 0:
            s.y[s.place[i]] = s.w[i]
    solve_free_rows(s, s.y)
    for i in range(s.n):
        if s.place[i] >= 0:
            s.x[i] -= s.y[s.place[i]]


cdef void compute_slack_and_rounding(pivoting_t* s) noexcept nogil:
    """Compute w (2) and its rounding f."""
    cdef int32_t i, q, end
    cdef const int32_t* idx = s.a.indices
    cdef const double* val = s.a.data
    cdef double t, u, s0, s1, f0, f1
    for i in range(s.n):
        q = s.a.indptr[i]
        end = s.a.indptr[i + 1]
        s0 = s1 = f0 = f1 = 0.0
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
        if s.linear.shift > 0.0:
            s.w[i] += s.linear.shift * s.p.d[i] * (s.x[i] - s.center[i])


cdef inline int32_t choose_bound_after_exchange(const pivoting_t* s, int32_t i) noexcept nogil:
    """Return the state of row i after an exchange (3). The tolerance 8 f is a few roundings of w, or of x = w / d."""
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


cdef int32_t exchange_infeasible_rows(pivoting_t* s) noexcept nogil:
    """Make an exchange (4); return the number of rows that were infeasible (3) before.

    The number is negative if no row is exchanged because patience is used up.
    """
    cdef int32_t i, n_infeasible = 0
    for i in range(s.n):
        n_infeasible += choose_bound_after_exchange(s, i) != s.at[i]
    if n_infeasible == 0:
        return 0
    if n_infeasible < s.min_infeasible:
        s.min_infeasible = n_infeasible
        s.patience = MAX_PATIENCE
    elif s.patience > 0:
        s.patience -= 1
    else:
        return -n_infeasible
    s.is_factored = 0
    for i in range(s.n):
        s.at[i] = choose_bound_after_exchange(s, i)
    s.exchanged += n_infeasible
    return n_infeasible


cdef bint has_passed_after_product(pivoting_t* s) noexcept nogil:
    """Count the work of a symmetric sweep, or of a round without its factor; return and store whether the deadline has passed."""
    cdef double cost = 4.0 * s.a.indptr[s.n]            # 4 ns per entry of A
    s.late = s.late or has_passed(s.deadline, cost)
    return s.late


cdef inline void run_symmetric_sweeps(pivoting_t* s, int32_t n) noexcept nogil:
    """Do n symmetric sweeps x_i <- clip(x_i - omega w_i / d_i), with omega = 1.7 in the first sweep and 1 in the others.

    Along a stack, with omega = 1.7, the impulse of a contact changes by 0.85 times the change of the contact before. A change
    passes through 4000 contacts before it underflows, and with omega = 1 and a factor of 0.5 through 1000.
    """
    cdef int32_t i, k
    cdef double* x = s.x
    cdef double omega, w
    for k in range(n):
        if has_passed_after_product(s):
            return
        omega = 1.7 if k == 0 else 1.0
        for i in range(s.n):
            w = csr_row_dot(s.a, i, x) - s.p.b[i]
            x[i] = project_row_update(x[i], w, omega * s.p.step[i], s.p.lower[i], s.p.upper[i])
        for i in range(s.n - 1, -1, -1):
            w = csr_row_dot(s.a, i, x) - s.p.b[i]
            x[i] = project_row_update(x[i], w, omega * s.p.step[i], s.p.lower[i], s.p.upper[i])


cdef void solve_with_all_rows_free(pivoting_t* s) noexcept nogil:
    """Compute x = A^-1 b with all rows free and factored; w is unchanged."""
    cdef int32_t i
    cdef double* y = s.x if s.natural else s.y
    if s.linear.ahead != NULL:
        solve_linear_system(&s.linear, s.x)
        return
    for i in range(s.n):
        y[i if s.natural else s.place[i]] = s.p.b[i]
    solve_free_rows(s, y)
    if not s.natural:
        for i in range(s.n):
            s.x[i] = y[s.place[i]]


cdef inline bint is_solved_with_all_rows_free(pivoting_t* s) noexcept nogil:
    """Solve with all rows free; return whether A is positive definite and x is within its bounds, so that x is the solution."""
    cdef int32_t i
    for i in range(s.n):
        if s.p.lower[i] == s.p.upper[i]:
            return False
    factor_all_rows(s)
    if s.late or s.linear.pivots.negative > 0 or s.linear.pivots.small > 0:
        s.is_factored = 0
        return False
    solve_with_all_rows_free(s)
    for i in range(s.n):
        if not s.p.lower[i] <= s.x[i] <= s.p.upper[i]:
            s.is_factored = 0
            return False
    return True


cdef int32_t run_exchange_rounds(pivoting_t* s, int32_t max_rounds) noexcept nogil:
    """Factor, solve and exchange, at most `max_rounds` times, until no row is infeasible or the deadline has passed."""
    cdef int32_t _, i, n_infeasible
    for _ in range(max_rounds):
        if has_passed_after_product(s):
            return ROUNDS_USED
        s.n_rounds += 1
        for i in range(s.n):
            if s.at[i] != FREE:
                s.x[i] = s.p.lower[i] if s.at[i] == AT_LOWER else s.p.upper[i]
        compute_slack_and_rounding(s)
        if not s.is_factored:
            factor_free_rows(s, NULL)
        if s.late:
            s.n_rounds -= 1
            return ROUNDS_USED
        if s.linear.pivots.negative > 0:
            return INDEFINITE
        if s.linear.pivots.small > 0 and (s.linear.shift == 0.0 or s.linear.by == LU or s.factor_outside != NULL):
            return SMALL_PIVOT
        correct_free_row_solution(s)
        compute_slack_and_rounding(s)
        n_infeasible = exchange_infeasible_rows(s)
        if n_infeasible == 0:
            return SOLVED
        if n_infeasible < 0:
            return STUCK
    return ROUNDS_USED


cdef int32_t guess_free_rows_by_sweeps(pivoting_t* s, const double* start, int32_t sweeps, int32_t max_rounds) noexcept nogil:
    """Return 1 if all rows are free at the solution x; else guess the free rows by `sweeps` symmetric sweeps from start (m).

    All rows free are tried only if their factor costs less than the sweeps, and `max_rounds` allows a round.
    """
    cdef int32_t i
    cdef double y
    # Multiply-adds: (band + 1)^2 / 2 per row of a factor, two per nonzero of a sweep.
    cdef bint is_cheap = s.band >= 0 and max_rounds > 0 and s.n > 0 and (
        (s.band + 1.0) * (s.band + 1) * s.n <= 4.0 * sweeps * s.a.indptr[s.n])
    if is_cheap and is_solved_with_all_rows_free(s):
        s.n_rounds += 1
        return 1
    for i in range(s.n):
        s.x[i] = start[i]
    run_symmetric_sweeps(s, sweeps)
    compute_slack_and_rounding(s)
    for i in range(s.n):                                # x - w / d decides which rows are free and which are at a bound.
        y = s.x[i] - s.w[i] / s.p.d[i]
        if y <= s.p.lower[i] or s.p.lower[i] == s.p.upper[i]:
            s.at[i] = AT_LOWER
        elif y >= s.p.upper[i]:
            s.at[i] = AT_UPPER
        else:
            s.at[i] = FREE
    s.is_factored = 0
    return 0


cdef void reset_exchange_patience(pivoting_t* s) noexcept nogil:
    """Reset the number of exchanges that may follow without progress."""
    s.min_infeasible = s.n + 1
    s.patience = MAX_PATIENCE


cdef void set_diagonal_shift(pivoting_t* s, double shift) noexcept nogil:
    """Set the shift. The factor becomes invalid, and the count of exchanges without progress is reset."""
    s.linear.shift = shift
    s.is_factored = 0
    reset_exchange_patience(s)


cdef void bind_pivoting_arrays(pivoting_t* s, arena_t* a) noexcept nogil:
    """Take the arrays of s and of its factor, LDL^T, from an arena; the first five fields must be set before."""
    cdef int64_t n = s.p.n_rows
    cdef int32_t i
    s.n, s.natural = s.p.n_rows, 1
    if s.order != NULL:
        for i in range(s.n):
            s.natural &= s.order[i] == i
    s.x, s.w, s.f, s.center = take_doubles(a, n), take_doubles(a, n), take_doubles(a, n), take_doubles(a, n)
    s.y, s.size, s.linear.matrix = take_doubles(a, n), take_doubles(a, n), take_doubles(a, n * (s.band + 1))
    s.at, s.place = take_integers(a, n), take_integers(a, n)
    s.linear.by, s.linear.wide = CHOLESKY, has_wide()
    s.linear.d = s.linear.scale = s.size
    s.outside = s.factor_outside = s.solve_outside = NULL
