"""Principal pivoting with any factorisation: the loop of `lavender_ext/pivot/principal.pyx`, step by step in Python.

Where the compiled factorisation serves, the whole loop runs there; with LAPACK, panels or SuperLU each step is one
call into the same compiled code.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import lapack

from lavender._arrays import FloatArray, IntArray
from lavender.deadline import Deadline, Stopwatch
from lavender.problem import Problem
from lavender.solvers._factor import (
    SMALL_SIZE,
    TINY,
    DenseFactor,
    Factor,
    LUFactor,
    SparseFactor,
    choose,
    permuted_band,
)
from lavender.solvers.weights import dense_factor, sparse_factor
from lavender_ext.pivot.principal import INDEFINITE, ROUNDS, SMALL, SOLVED, STUCK, Pivoting

HALVINGS = 41  # step lengths tried in a line search: 1, 1/2, ... 2^-40
# s for each multiply-add of a dense factor, and for each nonzero of a sparse one, with as many times more as it has
# thousands of rows: what a first factor is refused by where the time is short.
DENSE, SPARSE, SPARSE_ROWS = 1.5e-10, 1e-7, 1000.0
SWEEP = 4e-9  # s for each nonzero of a sweep both ways and its slack, likewise
SWEEPS, MOST_SWEEPS = 2, 24  # symmetric sweeps of Gauss-Seidel that guess the free rows, at least and at most
SHARE = 0.5  # of what a factor costs, that they may; a multiply-add of theirs takes a nanosecond
NEVER = Deadline()
SLOP = 8.0  # roundings of w within which a sign means nothing, as there


class PivotState:
    """A problem's rows, free or at a bound, and the factorisation that serves them."""

    chosen: tuple[str, int, IntArray | None]

    def __init__(self, problem: Problem, like: PivotState | None = None) -> None:
        self.problem = problem
        self.symmetric = problem.is_symmetric
        self.factor: Factor | None = None
        if self.symmetric:
            same = like is not None and like.symmetric and _same_pattern(like.problem, problem)
            self.chosen = like.chosen if like is not None and same else choose(problem)
            self.form, band, order = self.chosen
            if self.form != "band":
                band = -1
                self.factor = DenseFactor(problem) if self.form == "dense" else SparseFactor(problem)
        else:
            self.chosen = self.form, band, order = "LU", problem.m - 1, None
            if problem.m > SMALL_SIZE:
                band, self.factor = -1, LUFactor(problem)
        self.rows = Pivoting(
            problem.csr_data, band, order, TINY, symmetric=self.symmetric or self.factor is not None
        )
        self.is_factored = False
        self.small = 0  # pivots that the last factor by Python found at rounding
        self.late = False  # a factor was not begun that would have ended after the deadline
        # Of the next factor [s]: the first by structure, then as long as the last took.
        self.seconds = DENSE * problem.m**3 / 3.0
        if self.is_sparse:
            self.seconds = min(
                self.seconds, SPARSE * len(problem._compressed[1]) * (1.0 + problem.m / SPARSE_ROWS)
            )
        if not self.symmetric:
            self.seconds = 2.0 * (max(self.seconds, _filled(problem)) if self.is_sparse else self.seconds)
        self.factorisations = self.exchanged = self.searches = 0  # by Python

    @property
    def is_sparse(self) -> bool:
        """The factor takes a matrix of few entries."""
        return self.form == "sparse" or (isinstance(self.factor, LUFactor) and self.factor.sparse)

    def start(self, shift: float) -> None:
        """Proximal shift s; nothing is factored."""
        self.rows.start(shift)
        self.is_factored = False

    @property
    def sweeps(self) -> int:
        """Symmetric sweeps that guess the free rows: few before a compiled factor, else as cost a share of one."""
        if self.factor is None:
            return SWEEPS
        m, data = self.problem.m, self.problem.csr_data
        factor = dense_factor(m)
        if self.is_sparse:
            factor = min(factor, sparse_factor(self.problem.csr.nnz, m))
        return int(min(max(SWEEPS, SHARE * factor / (2.0 * data.work)), MOST_SWEEPS))

    @property
    def work(self) -> dict[str, int]:
        """Counted since the state was made, what is not 0."""
        r = self.rows
        counts = (
            ("factorisations", r.factorisations + self.factorisations),
            ("pivots", r.exchanged + self.exchanged),
            ("line_searches", self.searches),
        )
        return {what: count for what, count in counts if count}

    def factorise(self, whole: bool = False) -> int:
        """Factor the free rows, or all rows before anything else is done: SOLVED, SMALL or INDEFINITE."""
        if self.factor is None:
            small, negative = self.rows.factor_all() if whole else self.rows.factor()
            self.is_factored = True
            return INDEFINITE if negative else SMALL if small else SOLVED
        n_free = self.rows.number()
        self.factorisations += 1
        self.is_factored = True
        watch = Stopwatch()
        small = self.small = self.factor.factor(self.rows.place, n_free, self.rows.shift)
        self.seconds = watch.seconds
        return SMALL if small else SOLVED

    def too_late(self, deadline: Deadline) -> bool:
        """Whether the next factor would end after it, by what the last one took."""
        if self.factor is None or not deadline.passed(self.seconds):
            return False
        self.late = True
        return True

    def solve_free(self) -> None:
        """x = A^-1 b with all rows free and factored."""
        if self.factor is None:
            self.rows.solve_free()
        else:
            self.rows.x[:] = self.factor.solve(self.problem.b)

    def solve(self, start: FloatArray, sweeps: int, n: int, deadline: Deadline) -> tuple[int, int, bool]:
        """A boxed problem from `start`: (outcome, rounds done, whether it was swept)."""
        rows, before = self.rows, self.rows.n_rounds
        if self.factor is None:
            code, swept = rows.solve(start, sweeps, n)
            return code, rows.n_rounds - before, swept
        if deadline.passed(sweeps * SWEEP * self.problem.csr_data.work):
            rows.solve(start, 0, 0)
            self.late = True
            return ROUNDS, 0, False
        rows.solve(start, sweeps, 0)
        return *self.rounds(n, deadline), True

    def newton(self) -> None:
        """x_F <- x_F - (A_FF + s D_FF)^-1 w_F."""
        if self.factor is None:
            self.rows.correct()
        else:
            free = np.flatnonzero(self.rows.place >= 0)
            self.rows.x[free] -= self.factor.solve(self.rows.w[free])

    def correct(self) -> None:
        """The same, then w anew."""
        self.newton()
        self.rows.slack()

    def rounds(self, n: int, deadline: Deadline = NEVER) -> tuple[int, int]:
        """At most n rounds of factor, solve, exchange: (outcome, rounds done)."""
        rows = self.rows
        if self.factor is None:
            before = rows.n_rounds
            return rows.rounds(n), rows.n_rounds - before
        for done in range(1, n + 1):
            rows.put_bounds()
            rows.slack()
            if not self.is_factored:
                if self.too_late(deadline):
                    return ROUNDS, done - 1
                code = self.factorise()
                if code != SOLVED:
                    return code, done
            self.correct()
            bad = self.exchange()
            if bad <= 0:
                return (STUCK if bad else SOLVED), done
            if deadline.passed():
                return ROUNDS, done
        return ROUNDS, n

    def exchange(self) -> int:
        """Rows of the wrong sign, which have now changed sides."""
        bad = self.rows.exchange()
        if bad > 0:
            self.is_factored = False
        return bad

    def descend(self, n: int, deadline: Deadline = NEVER) -> tuple[int, int]:
        """At most n steps of projected Newton on the energy: (outcome, steps done). x must be within its bounds.

            phi(x) = 1/2 x.A x - b.x + s/2 |x - center|_D^2,  grad phi = w                         (1)
            x <- P(x - t A_FF^-1 w_F),  F: rows off their bounds, or whose w pushes them off         (2)
            t = 1, 1/2, ... until phi falls by 1e-4 of what w promises                              (3)

        Bertsekas 1982. Monotone, so no set comes back: what pivoting lacks on a nearly singular A.
        """
        rows, cones = self.rows, self.problem.cones
        low, high, fixed = cones.lower, cones.upper, cones.lower == cones.upper
        rows.slack()
        x, w = rows.x.copy(), rows.w.copy()
        for done in range(1, n + 1):
            slop = SLOP * rows.f
            at = np.where(fixed | ((x <= low) & (w >= -slop)), -1, np.where((x >= high) & (w <= slop), 1, 0))
            if not (self.is_factored and np.array_equal(at, rows.at)):
                self.exchanged += int(np.count_nonzero(at != rows.at))
                rows.at[:] = at
                if self.too_late(deadline):
                    rows.x[:] = x
                    return ROUNDS, done - 1
                code = self.factorise()
                if code != SOLVED:
                    return code, done
            self.newton()
            step = rows.x - x
            t = 1.0
            for _ in range(HALVINGS):
                np.clip(x + t * step, low, high, out=rows.x)
                rows.slack()
                self.searches += 1
                move = rows.x - x
                # phi(y) - phi(x) = 1/2 (w(x) + w(y)).(y - x): no cancellation
                if 0.5 * ((w + rows.w) @ move) <= 1e-4 * (w @ move):
                    break
                t *= 0.5
            slop = SLOP * rows.f
            reach = slop / self.problem.csr_data.d
            whole = t == 1.0 and bool(np.all((x + step >= low - reach) & (x + step <= high + reach)))
            x, w = rows.x.copy(), rows.w.copy()
            if whole and not np.any(((at < 0) & ~fixed & (w < -slop)) | ((at > 0) & (w > slop))):
                return SOLVED, done
            if deadline.passed():
                return ROUNDS, done
        return ROUNDS, n

    def impulse(self) -> FloatArray:
        """x clipped to the bounds (m,); a new array."""
        out = np.empty(self.problem.m)
        self.rows.clipped(out)
        return out

    def rank(self) -> int:
        """Rank of a positive semidefinite A with all rows free, pivots of 1e-13 d counting as zero.

        Band and sparse: the pivots just found (a zero pivot of a semidefinite matrix has a zero column, so
        leaving it out is exact). Dense: Cholesky with pivoting.
        """
        m, d = self.problem.m, self.problem.csr_data.d
        if self.factor is None:
            return m - int(self.rows.pivots[0])
        if self.form == "dense":
            scale = 1.0 / np.sqrt(d)
            return int(lapack.dpstrf(scale[:, None] * self.problem.dense() * scale, tol=TINY)[2])
        return m - self.small


def _filled(problem: Problem) -> float:
    """Of LU [s] as wide as an order of small bandwidth leaves it: what entries alone do not tell, fill is."""
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    a = problem.csr
    order = reverse_cuthill_mckee(a, symmetric_mode=False).astype(np.int32)
    width = float(permuted_band(problem, order) + 1)
    return DENSE * problem.m * min(width * width, problem.m**2 / 3.0)


def _same_pattern(p: Problem, q: Problem) -> bool:
    a, b = p.csr, q.csr
    return np.array_equal(a.indptr, b.indptr) and np.array_equal(a.indices, b.indices)
