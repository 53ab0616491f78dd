"""The work of each method on a problem, counted from its structure when first needed, and kept.

sweep        multiply-adds of one sweep
factor       weighted multiply-adds of one factorisation: of A (`direct`), of Newton's matrix over rows, bodies or
             generalised velocities; `_least` are bounds from below that need no analysis of a pattern
formed       entries of A that a method forms first, of a problem given by J and M
"""

from __future__ import annotations

from typing import Any

from lavender._derived import cached_property
from lavender.problem import Problem
from lavender.registry import SMALL_ROWS
from lavender.solvers import weights
from lavender.solvers._accelerated import sweep_work
from lavender.solvers._factor import PanelsLU, choose, filled_cost, panels_cost
from lavender.solvers.newton_systems import general
from lavender.solvers.newton_systems.systems import System, make_system
from lavender.solvers.small import MOST, others_cost, prepared, velocities_cost
from lavender.solvers.sweeping import reads_whitened
from lavender_ext.core import assemble
from lavender_ext.factor import graph

__all__ = ["Structure"]

THIN = 3.0  # entries in a row of a factor, at least
FILL = 6.0  # entries of a factor for each of A, at most


class Structure:
    """Counts of one problem."""

    def __init__(self, problem: Problem) -> None:
        self.problem, self.m = problem, problem.m

    @cached_property
    def sweep(self) -> float:
        """Multiply-adds of one sweep; a block that is solved exactly costs each of its rows as much as it has."""
        p, work = self.problem, float(sweep_work(self.problem))
        return work * p.m / (3.0 * p.n_blocks) if p.law == "cone" and p.cones.has_rolling else work

    @cached_property
    def entries(self) -> float:
        """Of A, at most where it is not formed."""
        p = self.problem
        if p.generalized is not None:
            return float(p.metric.entries_of_a)
        if p.rows is not None:
            return min(float(assemble.bound(p.data)[0]), float(p.m) ** 2)
        return float(len(p._compressed[1]))

    @cached_property
    def formed(self) -> float:
        """Entries of A that a method has to form from J and M; 0 if A was given, or if sweeps form it as well."""
        return self.entries if reads_whitened(self.problem) else 0.0

    def admm(self, n: float) -> tuple[float, float]:
        """Of `admm`: nonzeros of the matrix that it factors, and entries that n of its iterations read."""
        entries = self.entries if self.problem.matrix is not None else self.sweep
        lu = 1.0 if self.problem.is_symmetric else 2.0
        fill = min(FILL * entries, 0.5 * float(self.m) ** 2) + 10.0 * self.m
        return lu * entries * (1.0 + self.m / 1000.0), n * lu * fill

    @cached_property
    def is_loose(self) -> bool:
        """Nearly every contact joins another pair of bodies: sweeps then decide which contacts stick."""
        p = self.problem
        if p.rows is None or not p.rows.n_bodies:
            return False
        return 4 * graph.body_pairs(p.rows.block_bodies, p.rows.n_bodies, True) > 3 * p.n_blocks

    # -- factors of A ------------------------------------------------------------------------------

    @property
    def is_definite(self) -> bool:
        """`direct` exchanges rows of symmetric matrices, or of few rows."""
        p = self.problem
        return p.law == "linear" or (p.law == "lcp" and (p.m <= SMALL_ROWS or p.is_symmetric))

    @property
    def direct_least(self) -> float:
        """What one factor of A costs at least."""
        if self.problem.matrix is not None:
            return self.direct
        return min(weights.BAND * self.m * THIN**2, weights.dense_factor(self.m))

    @cached_property
    def direct(self) -> float:
        """One factor of A as `direct` makes it; of a factored problem without forming A."""
        p, m = self.problem, self.m
        dense = weights.dense_factor(m)
        if p.rows is not None and p.rows.n_bodies:
            band = float(graph.body_spread(p.cones.ptr, p.rows.block_bodies, p.rows.n_bodies) + 1)
            return min(dense, weights.BAND * m * band**2, self._sparse(self.entries))
        if p.generalized is not None and p.law != "linear":
            return min(dense, self._sparse(self.entries))
        form, band, _ = choose(p) if p.is_symmetric else ("general", max(p.bandwidth), None)
        if form == "band":
            return weights.BAND * m * float(min(band, m) + 1) ** 2
        nnz = float(len(p._compressed[1]))
        if form == "sparse" or (form == "general" and p.law == "linear" and PanelsLU.takes(p)):
            return min(dense, self._sparse(nnz))
        return min(dense, weights.sparse_factor(int(nnz), m))

    def _sparse(self, entries: float) -> float:
        """A sparse symmetric factor of so many entries.

        With bounds rows are analysed anew for each free set. Of a given matrix that costs less than is counted here: on
        18 of 30 recorded ones exchanges do not end.
        """
        p = self.problem
        if p.law != "linear" and p.matrix is not None:
            return weights.sparse_factor(int(entries), p.m)
        return filled_cost(p) if p.law == "linear" and p.rows is None else panels_cost(int(entries), p.m)

    # -- factors of Newton's matrix ----------------------------------------------------------------

    @cached_property
    def system(self) -> System:
        """Newton's system over the bodies, or over the rows of A; a later factorisation uses it."""
        rows = self.problem.rows
        return make_system(self.problem, "impulse" if rows is None or rows.n_bodies == 0 else "velocity")

    @cached_property
    def newton(self) -> float:
        """One factor of it."""
        return weights.newton_factor(self.system)

    @property
    def newton_least(self) -> float:
        """A lower bound: the factor without fill-in."""
        p = self.problem
        if p.rows is not None and p.rows.n_bodies:
            turns = p.rows.inv_inertia.any() and (p.rows.n_joints or p.m > p.n_blocks)
            n, s = p.rows.n_bodies, 6 if turns else 3
            return weights.body_factor(float(n * s**3 * (1.0 + self._pairs + 0.5 * self._pairs**2)))
        entries = self.m if p.matrix is None else self.entries
        return min(weights.row_factor(self.m, entries), weights.dense_factor(self.m))

    @cached_property
    def _pairs(self) -> float:
        """Pairs of bodies with a block between them, for each body: 1 in a chain, 2 or 3 in a lattice."""
        p = self.problem
        if p.rows is None or p.rows.n_bodies == 0:
            return 1.0
        return float(graph.body_pairs(p.rows.block_bodies, p.rows.n_bodies, False)) / p.rows.n_bodies

    # -- velocities of generalised coordinates -----------------------------------------------------

    @cached_property
    def kernel(self) -> Any:
        """Newton's method over them with its memory; None if the problem is too large for it."""
        return None if self.problem.generalized is None else general.prepare(self.problem)

    def is_small(self, tol: float) -> bool:
        """One compiled call is tried before all else."""
        p, kernel = self.problem, self.kernel
        if p.generalized is not None:
            most = MOST if self.m <= SMALL_ROWS else min(MOST, others_cost(p, tol))
            return kernel is not None and velocities_cost(p, kernel.largest) <= most
        return self.m <= SMALL_ROWS or prepared(p) is not None

    @cached_property
    def velocities(self) -> float:
        """One step over them, in one of the islands."""
        kernel = self.kernel
        return general.factor_flops(self.problem, kernel.largest) / max(1, kernel.islands)

    @property
    def read(self) -> float:
        """What it reads beside its factor: a sweep's multiply-adds, of one of the islands."""
        return self.sweep / max(1, self.kernel.islands)

    @property
    def steps(self) -> float:
        """Steps for each that one island takes."""
        return float(max(1, self.kernel.islands))
