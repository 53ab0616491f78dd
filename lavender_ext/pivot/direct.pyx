"""Bounded rows and linear systems solved to rounding: exchanges, refinement, shifted passes, descent; each result is judged.

    exchanges  principal pivoting (principal.pyx); then refinement x_F <- x_F - A_FF^-1 w_F while it halves the residual
    pass       exchanges on A + s D around the last result c, if A is singular on the free rows: a fixed point solves A   (1)
    descent    if exchanges are stuck, instead of them in a pass, for a sequence of smaller s:

        phi(x) = 1/2 x.A x - b.x + s/2 |x - c|_D^2,  grad phi = w                                         (2)
        x <- P(x - t A_FF^-1 w_F),  F: rows off their bounds, or pushed off them by w                     (3)
        t = 1, 1/2, ... until phi decreases by 1e-4 of the decrease that w promises                       (4)

(Bertsekas 1982.) (3) is monotone, so no set of free rows returns, which pivoting cannot guarantee on a nearly singular A.

`step_direct_solve` does at most a given number of rounds of one state, so that the caller can check a clock between steps. The
states, and the results of a step that change the state (ROUNDS_USED does not):

    GUESS     sweeps guess the free rows, or all rows are free; then as EXCHANGE
    EXCHANGE  -> over      SOLVED; INDEFINITE; of an A that is not symmetric also CYCLING, and PASSES_USED of a linear system
              -> PASS      SMALL_PIVOT: A is singular; or STUCK: refinement has ended above rounding
              -> DESCENT   STUCK: the number of infeasible rows no longer falls
    PASS      -> PASS      PASS_HALVED or PASS_ENDED: another pass; SMALL_PIVOT: another pass with a larger shift
              -> DESCENT   STUCK, from the largest shift
              -> over      SOLVED; INDEFINITE under the largest shift; PASSES_USED; CYCLING
    DESCENT   as PASS, with descent in place of exchanges
"""
from libc.math cimport INFINITY
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy

import numpy as np

from lavender_ext.core.deadline cimport get_pointer
from lavender_ext.core.arena cimport arena_t, make_arena, take_doubles, take_integers
from lavender_ext.core.block cimport clip
from lavender_ext.core.problem cimport Data
from lavender_ext.factor.factors cimport clear_pivot_statistics
from lavender_ext.factor.linear cimport CHOLESKY, LU
from lavender_ext.judge.measure cimport (residual_above_floor, relative_floor_of_score, judge_view, make_judged,
                                         relative_residual_of_score, count_judge_scratch)
from lavender_ext.judge.score cimport is_at_floor, make_empty_score, score_t
from lavender_ext.pivot.direct cimport CYCLING, DESCENT, EXCHANGE, GUESS, PASS, PASS_ENDED, PASS_HALVED, PASSES_USED, direct_t
from lavender_ext.pivot.principal cimport (INDEFINITE, ROUNDS_USED, SMALL_PIVOT, SOLVED, STUCK, bind_pivoting_arrays,
                                           compute_slack_and_rounding, correct_free_row_solution, exchange_infeasible_rows,
                                           factor_all_rows, factor_free_rows, guess_free_rows_by_sweeps,
                                           has_passed_after_product, pivoting_t, reset_exchange_patience, run_exchange_rounds,
                                           set_diagonal_shift, solve_with_all_rows_free, FREE)


cdef enum:
    MAX_CORRECTIONS = 100       # Largest number of corrections in one refinement, each of which must halve the residual.
    MAX_PASSES = 100
    MAX_WAITED_PASSES = 6       # Passes end after this many in a row that do not halve the best residual.
    N_SHIFTS = 5                # Number of shifts that a descent uses.
    MAX_STEP_LENGTHS = 41       # Largest number of step lengths in a line search: 1, 1/2, ... 2^-40.
    DESCENT_STEPS_PER_ROW = 4   # A descent ends after DESCENT_STEPS_PER_ROW n + EXTRA_DESCENT_STEPS steps.
    EXTRA_DESCENT_STEPS = 200


# -- arrays and begin --------------------------------------------------------------------------------------------

cdef void bind_direct_arrays(direct_t* t, arena_t* a) noexcept nogil:
    """Take the arrays of t from an arena; the fields listed in direct.pxd must be set before."""
    cdef int64_t m = t.v.p.n_rows
    t.x, t.best = take_doubles(a, 3 * m), take_doubles(a, 3 * m)
    t.start, t.origin = take_doubles(a, m), take_doubles(a, m)
    t.slope, t.step = take_doubles(a, m), take_doubles(a, m)
    t.scratch = take_doubles(a, count_judge_scratch(&t.v))
    bind_pivoting_arrays(&t.s, a)
    t.s.linear.swap, t.side = take_integers(a, m), take_integers(a, m)
    if not t.symmetric:
        t.s.linear.by = LU


cdef void reset_direct_solve(direct_t* t) noexcept nogil:
    """Begin without an impulse."""
    cdef int32_t i
    for i in range(t.s.n):
        t.s.at[i] = FREE
    t.s.exchanged = t.s.factorisations = t.s.n_rounds = t.s.late = 0
    clear_pivot_statistics(&t.s.linear.pivots)
    set_diagonal_shift(&t.s, 0.0)
    t.relative = INFINITY
    t.floor = 0.0
    t.rank = t.solved = t.swept = t.refined = t.shifts = t.searches = t.passes = t.is_over = 0
    t.state = GUESS


cdef void begin_direct_solve(direct_t* t, const double* start) noexcept nogil:
    """Begin a solve at start (m) [N s]."""
    reset_direct_solve(t)
    memcpy(t.start, start, t.s.n * sizeof(double))


cdef void begin_bound_exchanges(direct_t* t) noexcept nogil:
    """Begin with exchanges from the bounds in s.at; the best impulse so far is kept."""
    set_diagonal_shift(&t.s, 0.0)
    t.passes = t.is_over = 0
    t.state = EXCHANGE


# -- judging and refinement --------------------------------------------------------------------------------------

cdef inline int32_t is_best_impulse_accurate(const direct_t* t) noexcept nogil:
    """Return whether the best residual is at most `least` or explained by rounding."""
    return t.relative <= t.least or (t.relative <= t.floor and is_at_floor(t.relative, t.floor))


cdef int32_t is_solved_to_rounding(const direct_t* t) noexcept nogil:
    """Return `is_best_impulse_accurate`; for a linear system, also return True if only rounding is left."""
    return is_best_impulse_accurate(t) or (t.linear and is_at_floor(t.relative, t.floor))


cdef inline void clip_rows_to_bounds(const direct_t* t, const double* x, double* out) noexcept nogil:
    cdef int32_t i
    for i in range(t.s.n):
        out[i] = clip(x[i], t.s.p.lower[i], t.s.p.upper[i])


cdef void judge_iterate(direct_t* t) noexcept nogil:
    """Clip s.x to its bounds and judge it; keep it if its residual is the lowest so far."""
    cdef score_t score = make_empty_score()
    cdef double* x = t.x
    cdef double* w = x + t.s.n
    clip_rows_to_bounds(t, t.s.x, x)
    judge_view(&t.v, x, w, w + t.s.n, t.scratch, True, &score)
    t.now = relative_residual_of_score(&score, w, t.s.n, t.e0, t.v0)
    if t.now < t.relative:
        t.relative = t.now
        t.floor = relative_floor_of_score(&score, t.e0, t.v0)
        t.score = score
        t.x, t.best = t.best, x


cdef inline int32_t judge_and_refine_exchanges(direct_t* t, int32_t code) noexcept nogil:
    """Judge and refine the result of rounds that ended with `code`; return `code`, or ROUNDS_USED if a row was exchanged.

    The free rows are corrected as long as that halves the residual. Rows whose signs differ by rounding may be exchanged
    without end; the judge then finds that only rounding is left.
    """
    cdef double previous = INFINITY
    cdef int32_t _
    if code == SMALL_PIVOT or code == INDEFINITE:
        return code
    judge_iterate(t)
    if code != SOLVED or t.s.linear.shift != 0.0:
        return code
    t.solved = 1
    if is_best_impulse_accurate(t):
        return SOLVED
    compute_slack_and_rounding(&t.s)
    for _ in range(MAX_CORRECTIONS):
        if is_best_impulse_accurate(t) or not t.now < 0.5 * previous or has_passed_after_product(&t.s):
            break
        previous = t.now
        correct_free_row_solution(&t.s)
        compute_slack_and_rounding(&t.s)
        t.refined += 1
        if exchange_infeasible_rows(&t.s):
            return ROUNDS_USED
        judge_iterate(t)
    return SOLVED


# -- linear systems and exchanges --------------------------------------------------------------------------------

cdef inline int32_t factor_linear_system(direct_t* t) noexcept nogil:
    """Factor A with all rows free; return SOLVED, SMALL_PIVOT, INDEFINITE, or ROUNDS_USED after the deadline."""
    if not t.s.is_factored:
        factor_all_rows(&t.s)
    if t.s.late:
        return ROUNDS_USED
    if t.s.linear.pivots.negative > 0:
        return INDEFINITE
    if t.s.linear.pivots.small == 0:
        return SOLVED
    t.rank = t.s.n - t.s.linear.pivots.small
    return SMALL_PIVOT


cdef inline int32_t step_exchanges(direct_t* t, int32_t max_rounds) noexcept nogil:
    """Do at most `max_rounds` rounds of exchanges; return the result of the step."""
    return judge_and_refine_exchanges(t, run_exchange_rounds(&t.s, max_rounds))


# -- passes with a shift -----------------------------------------------------------------------------------------

cdef inline double get_proximal_shift(int32_t i) noexcept nogil:
    """Return the i-th shift s. The last shift is far above the rounding of a factor and far below a mass ratio of 1e8."""
    return 1e-2 if i == 0 else 1e-4 if i == 1 else 1e-6 if i == 2 else 1e-8 if i == 3 else 1e-10


cdef inline void repeat_proximal_pass(direct_t* t) noexcept nogil:
    """Repeat the pass on its free rows with its factor while that halves the residual, whatever the signs are."""
    cdef double previous = INFINITY
    cdef int32_t _
    for _ in range(MAX_CORRECTIONS):
        if is_best_impulse_accurate(t) or not t.now < 0.5 * previous or has_passed_after_product(&t.s):
            break
        previous = t.now
        memcpy(t.s.center, t.s.x, t.s.n * sizeof(double))
        compute_slack_and_rounding(&t.s)
        correct_free_row_solution(&t.s)
        compute_slack_and_rounding(&t.s)
        t.refined += 1
        judge_iterate(t)
        if not t.now < previous:
            memcpy(t.s.x, t.s.center, t.s.n * sizeof(double))


cdef inline int32_t step_proximal_pass(direct_t* t, int32_t max_rounds) noexcept nogil:
    """Do at most `max_rounds` rounds of a pass; return the result of the step (table of the module)."""
    cdef int32_t code, i
    if t.is_pass_over and t.passes == MAX_PASSES:
        return PASSES_USED
    if t.is_pass_over:
        t.is_pass_over = t.descent_steps = 0
        t.passes += 1
        memcpy(t.s.center, t.s.x, t.s.n * sizeof(double))
        if t.larger_shift > 0.0 or t.next_shift < N_SHIFTS:
            set_diagonal_shift(&t.s, t.larger_shift if t.larger_shift > 0.0 else get_proximal_shift(t.next_shift))
            t.next_shift += t.larger_shift == 0.0
            t.larger_shift = 0.0
            t.shifts += 1
        reset_exchange_patience(&t.s)
    code = run_descent_steps(t, max_rounds) if t.state == DESCENT else step_exchanges(t, max_rounds)
    if is_solved_to_rounding(t):
        return SOLVED
    if code == ROUNDS_USED:
        return ROUNDS_USED
    t.is_pass_over = 1
    if code == STUCK:
        if not t.symmetric:
            return CYCLING
        t.state = DESCENT
        t.next_shift = 0
        clip_rows_to_bounds(t, t.s.center, t.s.x)
        return STUCK
    if code != SOLVED:
        if t.s.linear.shift >= get_proximal_shift(0):
            return INDEFINITE
        t.larger_shift = 100.0 * t.s.linear.shift
        t.next_shift = N_SHIFTS
        memcpy(t.s.x, t.s.center, t.s.n * sizeof(double))
        return SMALL_PIVOT
    for i in range(t.s.n):
        t.step[i] = t.s.x[i] - t.s.center[i]
    repeat_proximal_pass(t)
    if is_solved_to_rounding(t):
        return SOLVED
    if t.next_shift < N_SHIFTS or t.relative <= 0.5 * t.halved_from:
        t.halved_from = t.relative
        t.waited = 0
        return PASS_HALVED
    t.waited += 1
    return PASSES_USED if t.waited >= MAX_WAITED_PASSES else PASS_ENDED


# -- descent -----------------------------------------------------------------------------------------------------


cdef inline double search_step_length(direct_t* t) noexcept nogil:
    """Find the step length (4), and compute x and w at its end.

    phi(y) - phi(x) = 1/2 (w(x) + w(y)).(y - x) has no cancellation. Return 0 if no step length meets (4): phi is at its rounding.
    """
    cdef pivoting_t* s = &t.s
    cdef int32_t i, _
    cdef double length = 1.0, gained, promised, move
    for _ in range(MAX_STEP_LENGTHS):
        for i in range(s.n):
            s.x[i] = clip(t.origin[i] + length * t.step[i], s.p.lower[i], s.p.upper[i])
        compute_slack_and_rounding(s)
        t.searches += 1
        gained = promised = 0.0
        for i in range(s.n):
            move = s.x[i] - t.origin[i]
            promised += t.slope[i] * move
            gained += (t.slope[i] + s.w[i]) * move
        if 0.5 * gained <= 1e-4 * promised or has_passed_after_product(s):
            return length
        length *= 0.5
    return 0.0


cdef inline bint is_descent_minimum(const direct_t* t) noexcept nogil:
    """Return whether the complete step stayed within the bounds and no row at a bound has a w that pushes it off the bound."""
    cdef const pivoting_t* s = &t.s
    cdef int32_t i
    cdef double low, high, tolerance, y
    for i in range(s.n):
        low, high, tolerance = s.p.lower[i], s.p.upper[i], 8.0 * s.f[i]
        y = t.origin[i] + t.step[i]
        if not low - tolerance / s.p.d[i] <= y <= high + tolerance / s.p.d[i]:
            return False
        if (s.at[i] < 0 and low != high and s.w[i] < -tolerance) or (s.at[i] > 0 and s.w[i] > tolerance):
            return False
    return True


cdef inline int32_t run_descent_steps(direct_t* t, int32_t max_steps) noexcept nogil:
    """Do at most `max_steps` steps (3) and judge x; return SOLVED, ROUNDS_USED, SMALL_PIVOT or INDEFINITE."""
    cdef pivoting_t* s = &t.s
    cdef int32_t i, _, changed, code = ROUNDS_USED
    cdef double length, tolerance
    clip_rows_to_bounds(t, s.x, s.x)
    compute_slack_and_rounding(s)
    for _ in range(max_steps):
        memcpy(t.origin, s.x, s.n * sizeof(double))
        memcpy(t.slope, s.w, s.n * sizeof(double))
        changed = 0
        for i in range(s.n):                            # Choose F of (3) at the origin.
            tolerance = 8.0 * s.f[i]
            if s.p.lower[i] == s.p.upper[i] or (t.origin[i] <= s.p.lower[i] and t.slope[i] >= -tolerance):
                t.side[i] = -1
            else:
                t.side[i] = t.origin[i] >= s.p.upper[i] and t.slope[i] <= tolerance
            changed += t.side[i] != s.at[i]
        s.exchanged += changed
        memcpy(s.at, t.side, s.n * sizeof(int32_t))
        if not s.is_factored or changed:
            factor_free_rows(s, NULL)
            if s.late:
                break
            if s.linear.pivots.negative > 0 or s.linear.pivots.small > 0:
                s.n_rounds += 1
                return INDEFINITE if s.linear.pivots.negative > 0 else SMALL_PIVOT
        s.n_rounds += 1
        correct_free_row_solution(s)
        for i in range(s.n):
            t.step[i] = s.x[i] - t.origin[i]
        length = search_step_length(t)
        t.descent_steps += 1
        if (length == 0.0 or t.descent_steps >= DESCENT_STEPS_PER_ROW * s.n + EXTRA_DESCENT_STEPS
                or (length == 1.0 and is_descent_minimum(t))):
            code = SOLVED
            break
        if s.late:
            break
    judge_iterate(t)
    return code


# -- the driver --------------------------------------------------------------------------------------------------


cdef inline int32_t choose_state_after_exchanges(direct_t* t, int32_t code) noexcept nogil:
    """Choose what follows exchanges or a linear solve that ended with `code`; return the result of the step."""
    if is_solved_to_rounding(t):
        return SOLVED
    if code == ROUNDS_USED or code == INDEFINITE:
        return code
    if not t.symmetric and code == STUCK:
        return CYCLING
    if not t.symmetric and t.linear:
        return INDEFINITE if code == SMALL_PIVOT else PASSES_USED
    # Passes from the best impulse follow, with every shift for DESCENT and with the smallest for PASS.
    memcpy(t.s.x, t.best if t.relative < INFINITY and t.floor <= 1e-6 else t.start, t.s.n * sizeof(double))
    t.state = DESCENT if code == STUCK else PASS
    t.next_shift = 0 if t.state == DESCENT else N_SHIFTS - 1
    t.larger_shift = 0.0
    t.passes = t.waited = 0
    t.is_pass_over = 1
    t.halved_from = INFINITY
    return SMALL_PIVOT if code == SMALL_PIVOT else STUCK


cdef int32_t step_direct_solve(direct_t* t, int32_t max_rounds) noexcept nogil:
    """Do at most `max_rounds` rounds of the present state; return the result of the step (table of the module)."""
    cdef int32_t code
    if t.state == GUESS or t.state == EXCHANGE:
        if t.linear:
            code = factor_linear_system(t)
            if code == SOLVED:
                t.s.n_rounds += 1
                solve_with_all_rows_free(&t.s)
                code = judge_and_refine_exchanges(t, SOLVED)
        elif t.state == GUESS:
            t.swept = not guess_free_rows_by_sweeps(&t.s, t.start, t.sweeps, max_rounds)
            code = judge_and_refine_exchanges(t, run_exchange_rounds(&t.s, max_rounds) if t.swept else SOLVED)
        else:
            code = step_exchanges(t, max_rounds)
        t.state = EXCHANGE
        code = choose_state_after_exchanges(t, code)
    else:
        code = step_proximal_pass(t, max_rounds)
    t.is_over = code == SOLVED or code == INDEFINITE or code == PASSES_USED or code == CYCLING
    return code


# -- for Python --------------------------------------------------------------------------------------------------

cdef int32_t call_python_factor(void* owner, const int32_t* _place, int32_t n_free, double shift) noexcept with gil:
    """Call `outside.factor` of Python; return its number of small pivots, -1 if it was not started or has raised."""
    cdef Pivoting rows = <Pivoting>owner
    cdef Py_ssize_t m = rows.t.s.n
    if rows.error is not None:
        return -1
    try:
        return rows.outside.factor(rows.ints[m:2 * m], n_free, shift) if n_free > 0 else 0
    except BaseException as error:
        rows.error = error
        return -1


cdef void call_python_solve(void* owner, int32_t n_free, double* y) noexcept with gil:
    """Overwrite y (n_free) with the result of `outside.solve` of Python."""
    cdef Pivoting rows = <Pivoting>owner
    cdef const double[::1] solution
    if rows.error is not None or n_free == 0:
        return
    try:
        solution = rows.outside.solve(np.asarray(<double[:n_free]>y).copy())
        memcpy(y, &solution[0], n_free * sizeof(double))
    except BaseException as error:
        rows.error = error


cdef class Pivoting:
    """The method of `direct` for one solve of a problem with bounded rows.

    Parameters
    ----------
    p : Data
        Problem with A in compressed rows.
    band : int
        Half bandwidth of A in the order of elimination, at most m - 1; -1 if the factor is `outside`.
    order : (m,) int32 or None
        Row that is eliminated first, second, ...; None: 0, 1, ...
    tiny : float
        Pivots below tiny d are small.
    judged : Data, optional
        The problem as the judge reads it, with known errors of the zero impulse; default p.
    outside : object, optional
        Factor by Python. `factor(place, n_free, shift)` factors the rows with place >= 0, numbered as in A, and returns the
        number of small pivots, or -1 if it was not started; `solve(rhs)` returns the solution (n_free,).
    linear, symmetric : bool
        Every row is free; A is symmetric. An A that is not symmetric is factored by LU, unless `outside` is given: `band` is
        then m - 1 and `order` is None.
    """

    def __init__(self, Data p, int band, order, double tiny, Data judged=None, outside=None, bint linear=False,
                 bint symmetric=True):
        cdef int32_t m = p.blocks.n_rows
        cdef const int32_t[::1] row_order
        cdef arena_t arena = make_arena(NULL, NULL)
        cdef double[::1] reals
        cdef int32_t[::1] ints
        if p.factored or p.is_general:
            raise ValueError("the problem data has no A in compressed rows; Pivoting needs it: give problem.csr_data")
        if outside is None and not symmetric and (band != m - 1 or order is not None):
            raise ValueError("LU needs a band of m - 1 and rows in their own order")
        self.p, self.judged, self.order, self.outside = p, p if judged is None else judged, order, outside
        self.t.v = self.judged.get_pointers()
        self.t.e0, self.t.v0 = self.judged.reference_energy, self.judged.reference_velocity
        self.t.least = 1e-13
        self.t.linear, self.t.symmetric = linear, symmetric
        self.t.s.a, self.t.s.p, self.t.s.band, self.t.s.order, self.t.s.linear.tiny = &p.csr, &p.blocks, band, NULL, tiny
        if order is not None:
            row_order = order
            if row_order.shape[0] != m:
                raise ValueError("order must name every row once")
            if m:
                self.t.s.order = &row_order[0]
        # One array for the vectors and the factor: two allocations in all.
        bind_direct_arrays(&self.t, &arena)
        self.reals, self.ints = np.zeros(arena.n_real + 1), np.zeros(arena.n_index + 1, np.int32)
        reals, ints = self.reals, self.ints
        arena = make_arena(&reals[0], &ints[0])
        bind_direct_arrays(&self.t, &arena)
        reset_direct_solve(&self.t)
        if outside is not None:
            self.t.s.linear.by = CHOLESKY
            self.t.s.outside = <void*>self
            self.t.s.factor_outside = call_python_factor
            self.t.s.solve_outside = call_python_solve

    cdef int raise_error(self, int32_t code) except -1:
        """Raise the error of `outside` if it has raised one; otherwise return `code`."""
        error, self.error = self.error, None
        if error is not None:
            raise error
        return code

    def factor_all(self):
        """Factor A with all rows free; return SOLVED, SMALL_PIVOT or INDEFINITE."""
        cdef int32_t code
        with nogil:
            code = factor_linear_system(&self.t)
        return self.raise_error(code)

    def set_start(self, const double[::1] start, double least, int sweeps):
        """Begin at start (m,) [N s] with `sweeps` symmetric sweeps; a relative residual up to `least` is not refined."""
        self.t.least, self.t.sweeps = least, sweeps
        memcpy(self.t.start, &start[0], self.t.s.n * sizeof(double))

    def set_deadline(self, deadline):
        """Set the time at which rounds and compiled factors end, or None."""
        self.deadline, self.t.s.deadline = deadline, get_pointer(deadline)

    def advance(self, int max_rounds):
        """Do up to `max_rounds` rounds, refine and judge; return the result of the step (table in direct.pyx)."""
        cdef int32_t code
        with nogil:
            code = step_direct_solve(&self.t, max_rounds)
        return self.raise_error(code)

    @property
    def is_over(self):
        """Whether the result of the last step was final."""
        return bool(self.t.is_over)

    @property
    def relative(self):
        """Relative residual of the best impulse; inf before the first impulse."""
        return self.t.relative

    @property
    def floor(self):
        """Relative round-off limit of the best impulse."""
        return self.t.floor

    @property
    def above_floor(self):
        """Part of the best relative residual that rounding does not explain, inf before the first impulse."""
        return residual_above_floor(&self.t.score, self.t.relative, self.t.floor) if self.t.relative < INFINITY else INFINITY

    @property
    def changed(self):
        """Change (m,) [N s] of the impulse in the last pass, a new array."""
        cdef Py_ssize_t at = 9 * <Py_ssize_t>self.t.s.n
        return self.reals[at:at + self.t.s.n].copy()

    @property
    def late(self):
        """Whether the deadline has ended the rounds."""
        return bool(self.t.s.late)

    @property
    def n_rounds(self):
        return self.t.s.n_rounds

    @property
    def passes(self):
        """Number of passes that have begun."""
        return self.t.passes

    @property
    def rank(self):
        """Rank of A if `factor_all` returned SMALL_PIVOT: the number of pivots above tiny d."""
        return self.t.rank

    @property
    def work(self):
        """Counts of work that are not 0."""
        counts = (("sweeps", 2 * self.t.sweeps * self.t.swept), ("shifts", self.t.shifts), ("refinements", self.t.refined),
                  ("factorisations", self.t.s.factorisations), ("pivots", self.t.s.exchanged),
                  ("line_searches", self.t.searches))
        return {kind: count for kind, count in counts if count}

    @property
    def best(self):
        """The best impulse with its residual as a `Judged`; None before the first impulse."""
        cdef Py_ssize_t m = self.t.s.n, at
        if not self.t.relative < INFINITY:
            return None
        at = 0 if self.t.best < self.t.x else 3 * m     # `best` and `x` exchange their memory, so the lower address decides.
        numbers = self.reals[at:at + 3 * m].copy()
        return make_judged(self.judged, numbers[:m], numbers[m:], &self.t.score, self.t.relative, self.t.floor)
