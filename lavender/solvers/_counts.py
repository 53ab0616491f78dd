"""What one factor or one sweep of a problem costs, counted from its structure with the weights of `weights.py`."""

from __future__ import annotations

from lavender.problem import Problem
from lavender.solvers import weights
from lavender.solvers._accelerated import sweep_work
from lavender.solvers.newton_systems.systems import PANELS, MatrixSystem, System


def sweep_cost(problem: Problem, work: float | None = None) -> float:
    """Of one sweep [ns]; `work`: its multiply-adds, where they are not those of what `anderson` sweeps over."""
    return (
        weights.SWEEP[problem.law] * (sweep_work(problem) if work is None else work)
        + weights.SWEEP_ROW * problem.m
    )


def dense_factor(m: float) -> float:
    """Of m rows [ns]."""
    return weights.DENSE * float(m) ** 3 / 3.0 + weights.DENSE_ENTRY * float(m) ** 2


def sparse_factor(nnz: int, m: int) -> float:
    """Of a matrix of m rows and nnz entries [ns]."""
    return weights.SPARSE * nnz * (1.0 + m / weights.SPARSE_ROWS)


def newton_factor(system: System) -> float:
    """One symmetric factor of Newton's matrix [ns]."""
    if not isinstance(system, MatrixSystem):
        return (weights.BLOCK if system.cost < PANELS else weights.PANEL) * system.cost
    if system.dense:
        return dense_factor(system.solve.m)
    return float(
        weights.FILLED
        + weights.FILLED_ENTRY * len(system.sparse.indices)
        + weights.FILLED_WORK * system.sparse.work
    )
