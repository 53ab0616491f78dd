"""What one call, one factor, one sweep or all islands of a problem cost, counted from its structure."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.problem import Problem
from lavender.registry import FEW
from lavender.solvers import _rates as rates
from lavender.solvers._accelerated import sweep_work
from lavender.solvers._factor import panels_cost
from lavender.solvers._islands import block_bodies
from lavender.solvers._newton.general import factor_flops
from lavender.solvers._newton.systems import (
    PANELS,
    MatrixSystem,
    System,
)
from lavender.solvers._sweeping import reads_whitened
from lavender_ext.core import assemble
from lavender_ext.factor import graph


def general_cost(problem: Problem, largest: int) -> float:
    """Newton over generalised velocities, `largest` of them in one island [ns]."""
    factor = rates.GENERAL[problem.law] * factor_flops(problem, largest)
    return rates.GENERAL_START + general_count(problem) * (
        rates.GENERAL_ROW[problem.law] * problem.m + factor
    )


def velocities_cost(problem: Problem, largest: int) -> float:
    """The same as others are compared with: of few rows under Coulomb's law as it usually is, without the tail."""
    if problem.law == "coulomb" and problem.m <= FEW:
        step = rates.FEW_STEP_ROW * problem.m + rates.FEW_STEP_FLOP * factor_flops(problem, largest)
        return rates.FEW_CALL + rates.FEW_STEPS * step
    return general_cost(problem, largest)


def general_count(problem: Problem) -> float:
    """Its steps, as expected: one where rows are free and soft, since then it has no proximal term."""
    if problem.law == "linear" and problem.m:
        assert problem.compliance is not None
        if np.all(problem.compliance >= rates.GENERAL_SOFT * problem.d):
            return 1.0
    return rates.GENERAL_COUNT[problem.law]


def general_step(problem: Problem, largest: int, islands: int) -> float:
    """One step over generalised velocities, in one of the islands, without what is lost on those that fail [ns]."""
    factors = rates.GENERAL[problem.law] * factor_flops(problem, largest)
    return (rates.GENERAL_STEP_ROW * problem.m + factors) / islands


def sweep_cost(problem: Problem) -> float:
    """Of one sweep [ns]."""
    return rates.SWEEP[problem.law] * sweep_work(problem) + rates.SWEEP_ROW * problem.m


def is_redundant(problem: Problem) -> bool:
    """The same weight rests on more points than the bodies can tell apart, and none of them is soft.

    Faces on faces; sweeps then hardly move it. With Coulomb friction a Newton method suffers as much.
    """
    p = problem
    if p.rows is None or p.law == "coulomb" or p.m <= 6 * p.rows.n_bodies:
        return False
    assert p.compliance is not None
    return not p.compliance.any() and (p.law != "cone" or not is_loose(p))


def finite_least(problem: Problem, symmetric: bool | None = None) -> float:
    """What no finite solver costs less than [ns]; `symmetric`: as if A were, or were not."""
    m = problem.m
    if problem.law == "linear" or (
        problem.law == "lcp" and (m <= FEW or (problem.is_symmetric if symmetric is None else symmetric))
    ):
        if m <= FEW and problem.law == "lcp":
            return few_direct(m)
        width = 3.0 if problem.matrix is None else max(3.0, 0.5 * len(problem._compressed[1]) / m)
        factor = min(rates.BAND * m * width * width, float(dense_factor(m)))
        return rates.START["direct"] + rates.DIRECT[problem.law] * (
            rates.STEP["direct"] + rates.ROW * m + factor
        )
    start, step, row = newton_rates(problem)
    return start + rates.NEWTON[problem.law] * (step + row * m)


def few_direct(m: int) -> float:
    """`direct` on so many bounded rows, up to FEW [ns]."""
    return rates.FEW_START + rates.FEW_ROUNDS * (rates.ROW * m + rates.BAND * m**3 / 6.0)


def rows_direct(problem: Problem) -> float:
    """`direct` on joints between bodies, A formed, by panels [ns]."""
    m, entries = problem.m, int(assemble.bound(problem.data)[0])
    factor = panels_cost(entries, m)
    return (
        rates.START["direct"]
        + rates.FORMED_ROWS * entries
        + rates.DIRECT["linear"] * (rates.STEP["direct"] + rates.ROW * m + factor)
    )


def joints_formed(problem: Problem) -> float:
    """`direct` on linear rows in generalised coordinates, A formed [ns]; its entries at a guess.

    Rows of A meet in the columns of Y that they share: half of a row's, in the mean.
    """
    m = problem.m
    in_row = 0.5 * (problem.metric.work - 4.0 * m) / max(m, 1)
    entries = int(problem.metric.entries_of_a / max(1.0, 0.5 * in_row))
    factor = min(panels_cost(entries, m), float(dense_factor(m)))
    return (
        formed_cost(problem)
        + rates.START["direct"]
        + rates.DIRECT["linear"] * (rates.STEP["direct"] + rates.ROW * m + factor)
    )


def newton_rates(problem: Problem) -> tuple[float, float, float]:
    """Of `newton` [ns]: a call, and beside each factor a step and each row."""
    if problem.rows is not None and problem.rows.n_bodies and problem.law != "coulomb":
        return rates.BODIES_START, rates.BODIES_STEP, rates.BODIES_ROW
    return rates.START["newton"], rates.STEP["newton"], rates.NEWTON_ROW[problem.law]


def formed_cost(problem: Problem) -> float:
    """What A costs before a solver that needs it begins, of J and M that sweeps take as they are [ns]."""
    if problem.generalized is None or not reads_whitened(problem):
        return 0.0
    if problem.law in ("cone", "coulomb"):
        return rates.RUBBED_START + rates.RUBBED * float(problem.metric.entries_of_a)
    return rates.FORMED_START + rates.FORMED * float(problem.metric.entries_of_a)


def dense_factor(m: Any) -> Any:
    """Of m rows [ns]."""
    m = np.asarray(m, float)
    return rates.DENSE * m**3 / 3.0 + rates.DENSE_ENTRY * m**2


def sparse_factor(nnz: int, m: int) -> float:
    """Of a matrix of m rows and nnz entries [ns]."""
    return rates.SPARSE * nnz * (1.0 + m / rates.SPARSE_ROWS)


def filled(entries: Any, work: float) -> Any:
    """One factor of Newton's matrix over rows of A by panels [ns]: entries of its pattern, multiply-adds of L L^T."""
    return rates.FILLED + rates.FILLED_ENTRY * entries + rates.FILLED_WORK * work


def newton_factor(system: System) -> float:
    """One symmetric factor of Newton's matrix [ns]."""
    if not isinstance(system, MatrixSystem):
        return (rates.BLOCK if system.cost < PANELS else rates.PANEL) * system.cost
    if system.dense:
        return float(dense_factor(system.sc.m))
    return float(filled(len(system.sparse.indices), system.sparse.work))


def admm_cost(problem: Problem, m: Any, entries: Any, count: float) -> tuple[Any, Any, Any]:
    """`admm` on m rows [ns]: to the end, for each chance to get there; with the first factor alone; an iteration."""
    lu = 1.0 if problem.is_symmetric else rates.UNSYMMETRIC
    factor = lu * rates.SPARSE * entries * (1.0 + m / rates.SPARSE_ROWS)
    if problem.is_symmetric:
        factor = np.minimum(factor, dense_factor(m))
    each = rates.ADMM_ROW * m + rates.ADMM_ENTRY * lu * np.minimum(rates.ADMM_FILL * entries, 0.5 * m * m)
    whole = rates.ADMM_START + rates.ADMM_FACTORS * factor + count * each
    return (
        whole / (rates.ADMM_LUCK if problem.rows is None else rates.ADMM_LUCK_BODIES),
        rates.ADMM_START + factor,
        each,
    )


def islands_cost(problem: Problem, sizes: Any) -> float:
    """Islands of so many rows, solved apart by Newton's method or `admm`, by their sizes alone [ns]."""
    m = np.asarray(sizes, float)
    count = rates.NEWTON[problem.law] + np.minimum(rates.MOST, rates.PER_ROW[problem.law] * m)
    start, step, row = newton_rates(problem)
    factor = np.minimum(dense_factor(m), filled(problem.metric.work / max(problem.m, 1) * m, 0.0))
    each = start + count * (step + row * m + rates.UNSYMMETRIC * factor)
    if problem.law in ("cone", "coulomb"):
        entries = sweep_work(problem) / max(problem.m, 1) * m
        each = np.minimum(each, admm_cost(problem, m, entries, rates.ADMM_COUNT)[0])
    each += rates.ISLAND
    return float(each.sum())


def together_cost(problem: Problem, count: int, largest: int) -> float:
    """What it takes to solve so many islands in compiled code, beside sweeps over each [ns].

    Under a convex law that of J and M is mostly Newton's method, `largest` velocities in an island, which hardly
    ever fails: half of it counts.
    """
    found = rates.TOGETHER + rates.TOGETHER_ISLAND * count + rates.TOGETHER_ROW * problem.m
    if problem.generalized is not None and problem.law != "coulomb":
        found += 0.5 * general_cost(problem, largest) if largest else np.inf
    return found


def is_loose(problem: Problem) -> bool:
    """Nearly every contact between two bodies of its own, not one of a face: sweeps then settle which ones stick."""
    assert problem.rows is not None
    pairs = graph.body_pairs(block_bodies(problem), problem.rows.n_bodies, True)
    return bool(4 * pairs > 3 * problem.n_blocks)
