"""Cost of one factorisation or one sweep [ns], counted from a problem's structure, and the rates of whole solvers.

Nanoseconds of one core; constants, the same on every machine: no clock is read. What `auto` expects of a solver as a
whole are the fitted rates of `rates.json` (`costs.py`).
"""

from __future__ import annotations

import json
import os
from functools import cache
from math import log10
from typing import Any

from lavender.problem import Problem
from lavender.solvers._accelerated import sweep_work
from lavender.solvers.newton_systems.systems import PANELS, MatrixSystem, System

RATES = os.path.join(os.path.dirname(__file__), "rates.json")
SWEEP = {"linear": 1.05, "lcp": 1.0, "coulomb": 0.65, "cone": 1.25}  # for each multiply-add of a sweep,
SWEEP_ROW = 5.0  # and each of its rows
DENSE, DENSE_ENTRY = 0.03, 3.0  # for each multiply-add of a dense factor, and for each entry of its matrix
BAND = 0.4  # of a band's
BLOCK, PANEL = 0.35, 0.2  # of one over bodies, by block rows and by panels
SPARSE = 100.0  # for each nonzero of a sparse factor's matrix,
SPARSE_ROWS = 1000.0  # as many times more as it has thousands of rows: fill grows with the size
# Of `newton` over rows of A by panels, whose analysis is kept: a factor with its solutions, for each entry of its
# pattern, and each multiply-add.
FILLED, FILLED_ENTRY, FILLED_WORK = 50e3, 6.0, 0.12

SIXTH = 6.0  # decades that counts of sweeps are fitted for
READ = 4.0  # times that what steps over velocities read is read before the first (fitted to curves: 3.6)
FORMED_START, FORMED = 60e3, 2.0  # of A formed of J and M, and of each of its entries


@cache
def rates() -> dict[str, Any]:
    """Of `rates.json`, read once."""
    with open(RATES, encoding="utf-8") as file:
        found: dict[str, Any] = json.load(file)
    return found


def decades(tol: float) -> float:
    """Sweeps to `tol`, relative to those that are fitted."""
    return -log10(min(max(tol, 1e-16), 0.1)) / SIXTH


def law_of(problem: Problem) -> str:
    """The law as rates tell it: Coulomb's where contacts resist rolling is one of its own."""
    return "rolling" if problem.law == "coulomb" and problem.cones.has_rolling else problem.law


def of_law(rate: Any, law: str) -> float:
    """The value of a rate for this law: one for rows with or without bounds, and one for each law of friction."""
    if not isinstance(rate, dict):  # it is asked often: a generator and `Mapping` take four times as long
        return float(rate)
    for kind in (law, "coulomb" if law == "rolling" else law):
        if kind in rate:
            return float(rate[kind])
    return float(rate["rows"])


def sweep_cost(problem: Problem, work: float | None = None) -> float:
    """Cost of one sweep [ns]; `work`: its multiply-adds, by default those of the sweeps of `anderson`."""
    return SWEEP[problem.law] * (sweep_work(problem) if work is None else work) + SWEEP_ROW * problem.m


def dense_factor(m: float) -> float:
    """Of m rows [ns]."""
    return DENSE * float(m) ** 3 / 3.0 + DENSE_ENTRY * float(m) ** 2


def sparse_factor(nnz: int, m: int) -> float:
    """Of a matrix of m rows and nnz entries [ns]."""
    return SPARSE * nnz * (1.0 + m / SPARSE_ROWS)


def body_factor(work: float) -> float:
    """One factor over bodies of at least so many multiply-adds [ns]."""
    return min(BLOCK * work, PANEL * max(work, PANELS))


def row_factor(m: int, entries: float) -> float:
    """One factor by panels of a matrix of so many entries, without fill-in [ns]."""
    below = 0.5 * (entries / m - 1.0)
    return FILLED + FILLED_ENTRY * entries + FILLED_WORK * m * 0.5 * below**2


def newton_factor(system: System) -> float:
    """One symmetric factor of Newton's matrix [ns]."""
    if not isinstance(system, MatrixSystem):
        return (BLOCK if system.cost < PANELS else PANEL) * system.cost
    if system.dense:
        return dense_factor(system.solve.m)
    return float(FILLED + FILLED_ENTRY * len(system.sparse.indices) + FILLED_WORK * system.sparse.work)
