"""The rows of one problem for `lavender_ext/pivot/direct.pyx`, and the factor that serves them there."""

from __future__ import annotations

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.base.deadline import Deadline, Stopwatch
from lavender.base.lazy_import import import_numerics
from lavender.judge.residuals import get_reference
from lavender.problem import Problem
from lavender.solvers.factors import (
    BAND,
    SMALL_SIZE,
    TINY,
    DenseFactor,
    Factor,
    LUFactor,
    SparseFactor,
    choose,
    dense_cost,
    narrow_order,
    permuted_band,
)
from lavender.solvers.setup_times import DENSE, dense_work, first_factor, sparse_work
from lavender_ext.pivot.direct import Pivoting

SWEEP = 4e-9  # s for each nonzero of a sweep both ways and its slack, likewise
SWEEPS, MOST_SWEEPS = 2, 24  # symmetric sweeps of Gauss-Seidel that guess the free rows, at least and at most
SHARE = 0.5  # of what a factor costs, that they may; a multiply-add of theirs takes a nanosecond


class Timed:
    """A factorisation by Python, which does not begin if it would end after the deadline."""

    def __init__(self, inner: Factor, seconds: float) -> None:
        self.inner = inner
        self.seconds = seconds  # of the next factor: the first by structure, then as long as the last took
        self.deadline = Deadline()

    def factor(self, place: IntArray, n_free: int, shift: float) -> int:
        """As `Factor`, of no row too; -1 if it was not begun."""
        if n_free == 0:
            return 0
        if self.deadline.passed(self.seconds):
            return -1
        watch = Stopwatch()
        small = self.inner.factor(place, n_free, shift)
        self.seconds = watch.seconds
        return small

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Of the free rows, (n_free,)."""
        return self.inner.solve(rhs)


class PivotState:
    """A problem's rows, free or at a bound, and the factorisation that serves them."""

    chosen: tuple[str, int, IntArray | None]

    def __init__(self, problem: Problem, like: PivotState | None = None) -> None:
        self.problem = problem
        self.symmetric = problem.is_symmetric
        if problem.m > SMALL_SIZE:
            import_numerics()  # for factors, and for proofs that there is no solution
        factor: Factor | None = None
        if self.symmetric:
            same = like is not None and like.symmetric and _same_pattern(like.problem, problem)
            self.chosen = like.chosen if like is not None and same else choose(problem)
            self.form, band, order = self.chosen
            if self.form != "band":
                band = -1
                factor = DenseFactor(problem) if self.form == "dense" else SparseFactor(problem)
        else:
            self.chosen = self.form, band, order = "LU", problem.m - 1, None
            if problem.m > SMALL_SIZE:
                band, factor = -1, LUFactor(problem)
        #: The factor takes a matrix of few entries.
        self.is_sparse = self.form == "sparse" or (isinstance(factor, LUFactor) and factor.sparse)
        self.outside = None if factor is None else Timed(factor, self._expected())
        get_reference(problem)
        # Of one round [s], all rows free, where the factor is compiled; then as long as the last took.
        self.seconds = 1e-9 * BAND * problem.m * (band + 1.0) ** 2 + SWEEP * problem.csr_data.work
        self.rows = Pivoting(
            problem.csr_data, band, order, TINY, problem.metric, self.outside, problem.law == "linear", self.symmetric
        )  # fmt: skip

    def _expected(self) -> float:
        """What the first factor takes [s], by structure."""
        seconds = first_factor(self.problem.m, len(self.problem._compressed[1]) if self.is_sparse else np.inf)
        if self.symmetric:
            return seconds
        return 2.0 * (max(seconds, _filled(self.problem)) if self.is_sparse else seconds)

    @property
    def sweeps(self) -> int:
        """Symmetric sweeps that guess the free rows: few before a compiled factor, else a share of its cost."""
        if self.outside is None:
            return SWEEPS
        m, data = self.problem.m, self.problem.csr_data
        factor = dense_cost(m)
        if self.is_sparse:
            factor = min(factor, sparse_work(self.problem.csr.nnz, m))
        return int(min(max(SWEEPS, SHARE * factor / (2.0 * data.work)), MOST_SWEEPS))

    def too_late_to_sweep(self, deadline: Deadline) -> bool:
        """Whether the sweeps before the first factor would end after the deadline."""
        return deadline.passed(self.sweeps * SWEEP * self.problem.csr_data.work)

    def advance(self, deadline: Deadline, most: int) -> tuple[int, bool]:
        """Run the rounds, at most `most`, that are expected to end before the deadline.

        Returns
        -------
        (int, bool)
            Code of `Pivoting.advance`, and whether no round fits.
        """
        left, before, watch = deadline.remaining(), self.rows.n_rounds, Stopwatch()
        if left is None or self.outside is not None:  # which asks the clock itself
            return self.rows.advance(most), most == 0
        n = int(left / self.seconds)
        n = min(most, max(1, n // 2) if n else 0)  # then it is asked again
        code = self.rows.advance(n)
        if self.rows.n_rounds > before:
            self.seconds = watch.seconds / (self.rows.n_rounds - before)
        return code, n == 0

    def set_deadline(self, deadline: Deadline) -> None:
        """Let no factor by Python begin that is expected to end after `deadline`."""
        if self.outside is not None:
            self.outside.deadline = deadline

    def rank(self) -> int:
        """Rank of a positive semidefinite A with all rows free, pivots of 1e-13 d counting as zero.

        A zero pivot of a semidefinite matrix has a zero column, so leaving it out is exact.
        """
        return int(self.rows.rank)


def _filled(problem: Problem) -> float:
    """Of LU [s] as wide as an order of small bandwidth leaves it: what entries alone do not tell, fill is."""
    width = float(permuted_band(problem, narrow_order(problem)) + 1)
    return DENSE * problem.m * min(width * width, dense_work(problem.m) / problem.m)


def _same_pattern(p: Problem, q: Problem) -> bool:
    a, b = p.csr, q.csr
    return np.array_equal(a.indptr, b.indptr) and np.array_equal(a.indices, b.indices)
