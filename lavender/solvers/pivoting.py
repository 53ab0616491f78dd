"""State of pivoting methods: which rows of a problem are free (`lavender_ext/pivot/direct.pyx`), and their factor."""

from __future__ import annotations

import numpy as np

from lavender.base.arrays import IntArray
from lavender.base.deadline import Deadline
from lavender.base.lazy_import import import_numerical_modules
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.problem import Problem
from lavender.solvers.costs import estimate_dense_factor_cost, estimate_sparse_work
from lavender.solvers.factors import (
    MAX_COMPILED_FACTOR_ROWS,
    PIVOT_TOLERANCE,
    DenseFactor,
    LUFactor,
    SparseFactor,
    choose_factorisation,
)
from lavender_ext.pivot.direct import Pivoting

# Smallest and largest number of symmetric Gauss-Seidel sweeps that guess the free rows.
MIN_GUESS_SWEEPS, MAX_GUESS_SWEEPS = 2, 24
# The sweeps that guess the free rows may cost this fraction of a factorisation, at 1 ns per multiply-add of a sweep.
GUESS_COST_FRACTION = 0.5


class PivotState:
    """The rows of a problem, free or at a bound, and their factorisation."""

    chosen: tuple[str, int, IntArray | None]

    def __init__(self, problem: Problem, like: PivotState | None = None) -> None:
        self.problem = problem
        self.symmetric = problem.is_symmetric
        if problem.m > MAX_COMPILED_FACTOR_ROWS:
            import_numerical_modules()  # Factorisations and certificates use these modules.
        factor: DenseFactor | SparseFactor | LUFactor | None = None
        if self.symmetric:
            if (
                like is not None
                and like.symmetric
                and all(map(np.array_equal, like.problem._compressed[:2], problem._compressed[:2]))
            ):  # A has the same sparsity pattern in both problems.
                self.chosen = like.chosen
            else:
                self.chosen = choose_factorisation(problem)
            self.form, band, order = self.chosen
            if self.form != "band":
                band = -1
                factor = DenseFactor(problem) if self.form == "dense" else SparseFactor(problem)
        else:
            self.chosen = self.form, band, order = "LU", problem.m - 1, None
            if problem.m > MAX_COMPILED_FACTOR_ROWS:
                band = -1
                factor = LUFactor(problem)
        #: Whether the factor is sparse.
        self.is_sparse = self.form == "sparse" or (isinstance(factor, LUFactor) and factor.sparse)
        self.outside = factor  # The factorisation by Python; None if the kernel factors.
        get_zero_impulse_reference(problem)
        self.rows = Pivoting(
            problem.csr_data,
            band,
            order,
            PIVOT_TOLERANCE,
            problem.metric,
            self.outside,
            problem.law == "linear",
            self.symmetric,
        )

    @property
    def sweeps(self) -> int:
        """Number of symmetric sweeps that guess the free rows: the minimum for a compiled factor, else by its cost."""
        if self.outside is None:
            return MIN_GUESS_SWEEPS
        m = self.problem.m
        factor = estimate_dense_factor_cost(self.problem.m)
        if self.is_sparse:
            factor = min(factor, estimate_sparse_work(self.problem.csr.nnz, m))
        sweeps = GUESS_COST_FRACTION * factor / (2.0 * self.problem.csr_data.work)
        return int(min(max(MIN_GUESS_SWEEPS, sweeps), MAX_GUESS_SWEEPS))

    def set_deadline(self, deadline: Deadline) -> None:
        """Set the time at which rounds and factorisations end."""
        self.rows.set_deadline(deadline)
        if self.outside is not None:
            self.outside.deadline = deadline

    def rank(self) -> int:
        """Rank of a positive semidefinite A with all rows free, pivots of 1e-13 d counting as zero.

        In the elimination of a semidefinite matrix, a zero pivot has a zero column, so leaving it out changes nothing.
        """
        return int(self.rows.rank)
