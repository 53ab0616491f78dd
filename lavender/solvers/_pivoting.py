"""Principal pivoting with any factorisation: the loop of `lavender_ext/pivoting.pyx`, step by step in Python.

Where the compiled factorisation serves, the whole loop runs there; with LAPACK or QDLDL each step is one
call into the same compiled code.
"""

from __future__ import annotations

from time import perf_counter

import numpy as np
from scipy.linalg import lapack

from lavender._arrays import FloatArray
from lavender.problem import Problem
from lavender.solvers._factor import TINY, DenseFactor, SparseFactor, choose
from lavender_ext.pivoting import Pivoting

SOLVED, ROUNDS, SMALL, INDEFINITE = range(4)  # outcomes, as in lavender_ext/pivoting.pyx


class PivotState:
    """A problem's rows, free or at a bound, and the factorisation that serves them."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.form, band, order = choose(problem)
        self.rows = Pivoting(problem.csr_data, band if self.form == "band" else -1, order, TINY)
        self.factor = {"dense": DenseFactor, "sparse": SparseFactor}[self.form](problem) if self.form != "band" else None
        self.is_factored = False
        self.factorisations = 0  # by Python

    def start(self, shift: float) -> None:
        """Proximal shift s; nothing is factored."""
        self.rows.start(shift)
        self.is_factored = False

    @property
    def work(self) -> dict[str, int]:
        """Counted since the state was made."""
        r = self.rows
        return {
            "factorisations": r.factorisations + self.factorisations,
            "pivots": r.exchanged,
        }

    def factorise(self) -> int:
        """Factor the free rows: SOLVED, SMALL or INDEFINITE."""
        if self.factor is None:
            small, negative = self.rows.factor()
            return INDEFINITE if negative else SMALL if small else SOLVED
        n_free = self.rows.number()
        self.factorisations += 1
        self.is_factored = True
        return SMALL if self.factor.factor(self.rows.place, n_free, self.rows.shift) else SOLVED

    def solve_free(self) -> None:
        """x = A^-1 b with all rows free and factored, then w."""
        if self.factor is None:
            self.rows.solve_free()
        else:
            self.rows.x[:] = self.factor.solve(self.problem.b)
            self.rows.slack()

    def correct(self) -> None:
        """x_F <- x_F - (A_FF + s D_FF)^-1 w_F, then w anew."""
        if self.factor is None:
            self.rows.correct()
        else:
            free = np.flatnonzero(self.rows.place >= 0)
            self.rows.x[free] -= self.factor.solve(self.rows.w[free])
        self.rows.slack()

    def rounds(self, n: int, stop_at: float | None = None) -> tuple[int, int]:
        """At most n rounds of factor, solve, exchange: (outcome, rounds done)."""
        rows = self.rows
        if self.factor is None:
            before = rows.n_rounds
            return rows.rounds(n), rows.n_rounds - before
        for done in range(1, n + 1):
            rows.put_bounds()
            rows.slack()
            if not self.is_factored:
                code = self.factorise()
                if code != SOLVED:
                    return code, done
            self.correct()
            if self.exchange() == 0:
                return SOLVED, done
            if stop_at is not None and perf_counter() >= stop_at:
                return ROUNDS, done
        return ROUNDS, n

    def exchange(self) -> int:
        """Rows of the wrong sign, which have now changed sides."""
        bad = self.rows.exchange()
        if bad:
            self.is_factored = False
        return bad

    def impulse(self, out: FloatArray) -> FloatArray:
        """x clipped to the bounds, into out (m,)."""
        self.rows.clipped(out)
        return out

    def rank(self) -> int:
        """Rank of a positive semidefinite A with all rows free, pivots of 1e-13 d counting as zero.

        Band: the pivots just found (a zero pivot of a semidefinite matrix has a zero column, so leaving it
        out is exact). Dense: Cholesky with pivoting. Sparse: pivots of A + 1e-10 D below 1e-8 D.
        """
        m, d = self.problem.m, self.problem.csr_data.d
        if self.factor is None:
            return m - int(self.rows.pivots[0])
        if self.form == "dense":
            scale = 1.0 / np.sqrt(d)
            return int(lapack.dpstrf(scale[:, None] * self.problem.dense() * scale, tol=TINY)[2])
        return m - self.factor.factor(np.arange(m, dtype=np.int32), m, 1e-10, 1e-8)
