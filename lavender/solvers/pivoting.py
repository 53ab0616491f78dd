"""State of pivoting methods: which rows of a problem are free (`lavender_ext/pivot/direct.pyx`), and their factor."""

from __future__ import annotations

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.base.deadline import Deadline, Stopwatch
from lavender.base.lazy_import import import_numerical_modules
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.problem import Problem
from lavender.solvers.costs import (
    RATES,
    count_dense_work,
    estimate_band_factor_cost,
    estimate_dense_factor_cost,
    estimate_first_factor_cost,
    estimate_sparse_work,
)
from lavender.solvers.factors import (
    MAX_COMPILED_FACTOR_ROWS,
    PIVOT_TOLERANCE,
    DenseFactor,
    Factor,
    LUFactor,
    SparseFactor,
    choose_factorisation,
    compute_half_bandwidth_in_order,
    find_small_bandwidth_order,
)
from lavender_ext.pivot.direct import Pivoting

# Smallest and largest number of symmetric Gauss-Seidel sweeps that guess the free rows.
MIN_GUESS_SWEEPS, MAX_GUESS_SWEEPS = 2, 24
# The sweeps that guess the free rows may cost this fraction of a factorisation, at 1 ns per multiply-add of a sweep.
GUESS_COST_FRACTION = 0.5


class TimedFactor:
    """A factorisation by Python that does not start if it would end after the deadline."""

    def __init__(self, inner: Factor, seconds: float) -> None:
        self.inner = inner
        # Time [s] of the next factor: an estimate at first, then the time of the last factor.
        self.seconds = seconds
        self.deadline = Deadline()

    def factor(self, place: IntArray, n_free: int, shift: float) -> int:
        """Factor as `Factor.factor` does; n_free may be 0. Return -1 if the factorisation would end too late."""
        if n_free == 0:
            return 0
        if self.deadline.has_passed(self.seconds):
            return -1
        watch = Stopwatch()
        small = self.inner.factor(place, n_free, shift)
        self.seconds = watch.elapsed_seconds
        return small

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Solve for the free rows, (n_free,)."""
        return self.inner.solve(rhs)


class PivotState:
    """The rows of a problem, free or at a bound, and their factorisation."""

    chosen: tuple[str, int, IntArray | None]

    def __init__(self, problem: Problem, like: PivotState | None = None) -> None:
        self.problem = problem
        self.symmetric = problem.is_symmetric
        if problem.m > MAX_COMPILED_FACTOR_ROWS:
            import_numerical_modules()  # Factorisations and certificates use these modules.
        factor: Factor | None = None
        if self.symmetric:
            same = like is not None and like.symmetric and _have_same_pattern(like.problem, problem)
            self.chosen = like.chosen if like is not None and same else choose_factorisation(problem)
            self.form, band, order = self.chosen
            if self.form != "band":
                band = -1
                factor = DenseFactor(problem) if self.form == "dense" else SparseFactor(problem)
        else:
            self.chosen = self.form, band, order = "LU", problem.m - 1, None
            if problem.m > MAX_COMPILED_FACTOR_ROWS:
                band, factor = -1, LUFactor(problem)
        #: Whether the factor is sparse.
        self.is_sparse = self.form == "sparse" or (isinstance(factor, LUFactor) and factor.sparse)
        self.outside: TimedFactor | None = None
        if factor is not None:
            self.outside = TimedFactor(factor, 1e-9 * self._estimate_first_factor_cost())
        get_zero_impulse_reference(problem)
        # [s] Time of one round with a compiled factor: first an estimate for free rows, then the last round's time.
        # [ns] Includes the computation of w.
        sweep_cost = RATES["symmetric sweep entry"] * problem.csr_data.work
        self.seconds = 1e-9 * (estimate_band_factor_cost(problem.m, band) + sweep_cost)
        self.rows = Pivoting(
            problem.csr_data, band, order, PIVOT_TOLERANCE, problem.metric, self.outside, problem.law == "linear",
            self.symmetric,
        )  # fmt: skip

    def _estimate_first_factor_cost(self) -> float:
        """Estimate the cost of the first factor [ns] from the structure."""
        entries = len(self.problem._compressed[1]) if self.is_sparse else np.inf
        cost = estimate_first_factor_cost(self.problem.m, entries)
        if self.is_sparse and not self.symmetric:
            cost = max(cost, _estimate_filled_factor_cost(self.problem))
        return cost if self.symmetric else 2.0 * cost

    @property
    def sweeps(self) -> int:
        """Number of symmetric sweeps that guess the free rows: the minimum for a compiled factor, else by its cost."""
        if self.outside is None:
            return MIN_GUESS_SWEEPS
        m, factor = self.problem.m, estimate_dense_factor_cost(self.problem.m)
        if self.is_sparse:
            factor = min(factor, estimate_sparse_work(self.problem.csr.nnz, m))
        sweeps = GUESS_COST_FRACTION * factor / (2.0 * self.problem.csr_data.work)
        return int(min(max(MIN_GUESS_SWEEPS, sweeps), MAX_GUESS_SWEEPS))

    def is_too_late_to_sweep(self, deadline: Deadline) -> bool:
        """Return whether the sweeps before the first factor would end after the deadline."""
        cost = self.sweeps * RATES["symmetric sweep entry"] * self.problem.csr_data.work
        return not deadline.fits(cost)

    def run_rounds(self, deadline: Deadline, max_rounds: int) -> tuple[int, bool]:
        """Run at most `max_rounds` rounds that are expected to end before the deadline.

        Returns
        -------
        (int, bool)
            Code of `Pivoting.advance`, and whether the time does not suffice for a further round.
        """
        left, before, watch = deadline.get_remaining_seconds(), self.rows.n_rounds, Stopwatch()
        if left is None or self.outside is not None:  # No limit, or `TimedFactor` checks the clock.
            return self.rows.advance(max_rounds), max_rounds == 0
        n = int(left / self.seconds)
        # Do half of the rounds that fit into the time; the caller calls again.
        n = min(max_rounds, max(1, n // 2) if n else 0)
        code = self.rows.advance(n)
        if self.rows.n_rounds > before:
            self.seconds = watch.elapsed_seconds / (self.rows.n_rounds - before)
        return code, n == 0

    def set_deadline(self, deadline: Deadline) -> None:
        """Start no factor by Python that is expected to end after `deadline`."""
        if self.outside is not None:
            self.outside.deadline = deadline

    def rank(self) -> int:
        """Rank of a positive semidefinite A with all rows free, pivots of 1e-13 d counting as zero.

        In the elimination of a semidefinite matrix, a zero pivot has a zero column, so leaving it out changes nothing.
        """
        return int(self.rows.rank)


def _estimate_filled_factor_cost(problem: Problem) -> float:
    """Estimate the cost [ns] of a banded LU in an order of small bandwidth, which includes the fill."""
    width = float(compute_half_bandwidth_in_order(problem, find_small_bandwidth_order(problem)) + 1)
    work = problem.m * min(width * width, count_dense_work(problem.m) / problem.m)
    return float(RATES["dense factor"] * work)


def _have_same_pattern(p: Problem, q: Problem) -> bool:
    """Return whether A has the same sparsity pattern in both problems."""
    a, b = p.csr, q.csr
    return np.array_equal(a.indptr, b.indptr) and np.array_equal(a.indices, b.indices)
