"""Estimate the costs of Newton's method and of sweeps [ns] from their structure; `auto` compares only these numbers.

    Newton   start + n (row m + entry e + work w)                                                             (1)
    sweep    sweep_row m + entry e, under the cone law over J sweep_cone e                                    (2)

m is the number of rows; e the multiply-adds of a sweep, or the entries of A that one step reads; w the multiply-adds of
one factorisation and its solves, from the solver's own analysis (`NewtonState.count`); n the number of factorisations,
which depends on the law. Over generalised velocities everything is compiled: start and row are 0, and n is the number
for bounded rows under every law, multiplied by RIGID_STEP_RATIO if a row has no compliance and not all rows are
bounded, and by SOFT_STEP_RATIO if every row has enough compliance and not all rows are free. No clock is read: the same
problem has the same counts on every machine. The twelve rates of `rates.json` were fitted to measured times of random
problems (docs/method.md, "Figures without a command").
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from typing import Any

from lavender.problem import Problem
from lavender.solvers._accelerated import sweep_work
from lavender.solvers.setup_times import dense_work, formation_time

__all__ = [
    "EXPECTED_SWEEPS",
    "RATES",
    "Count",
    "factorisations",
    "formed_count",
    "min_count",
    "newton_cost",
    "sweep_cost",
]

# os.path is used because pathlib would take 4 % of the time of `import lavender`.
with open(os.path.join(os.path.dirname(__file__), "rates.json"), encoding="utf-8") as _file:
    RATES: dict[str, Any] = json.load(_file)
# Steps over generalised velocities per factorisation of the other forms, if no row is rigid and if a row is rigid.
SOFT_STEP_RATIO = 0.5
RIGID_STEP_RATIO = 4.0
# Assumed number of sweeps to a solution: `auto` starts with Newton's method if it is estimated to cost less.
EXPECTED_SWEEPS = 100.0


@dataclass(frozen=True)
class Count:
    """Counts of one step of Newton's method.

    Parameters
    ----------
    form : {"bodies", "dense", "panels", "velocities"}
        Matrix that is factored.
    work : float
        Multiply-adds of one factorisation.
    entries : float
        Numbers that a step reads in addition.
    rows : float
        Number of rows; 0 over generalised velocities.
    set_up : float, ns
        Cost of forming A of J and M.
    steps : float
        Steps per factorisation that the law is expected to need.
    """

    form: str
    work: float
    entries: float
    rows: float
    set_up: float = 0.0
    steps: float = 1.0


def factorisations(law: str, form: str = "") -> float:
    """Return the expected number of factorisations of Newton's method.

    It is 1 for linear problems. Over velocities, all other laws have the number of bounded rows.
    """
    if law == "linear":
        return 1.0
    return float(RATES["count"]["rows" if law == "lcp" or form == "velocities" else law])


def newton_cost(count: Count, law: str) -> float:
    """Return the estimated cost of Newton's method [ns], (1)."""
    r = RATES
    step_cost = r["row"] * count.rows + r["entry"] * count.entries + r["work"][count.form] * count.work
    start = r["start"] if count.rows else 0.0
    return float(start + count.set_up + count.steps * factorisations(law, count.form) * step_cost)


def min_count(problem: Problem) -> Count:
    """Return a lower bound of the counts of Newton's method that needs no analysis of the matrix."""
    over_velocities = problem.generalized is not None
    return Count("bodies", 0.0, float(problem.metric.work), 0.0 if over_velocities else float(problem.m))


def sweep_cost(problem: Problem) -> float:
    """Return the estimated cost of one sweep [ns], (2)."""
    cone = problem.law == "cone" and problem.matrix is None
    return float(
        RATES["sweep row"] * problem.m + RATES["sweep cone" if cone else "entry"] * sweep_work(problem)
    )


def formed_count(problem: Problem) -> Count:
    """Return a lower bound of the counts of Newton's method over the rows of an A formed of J and M."""
    m = float(problem.m)
    entries = min(float(problem.metric.entries_of_a), m * m)
    work = 0.0 if entries < 0.5 * m * m else dense_work(problem.m)
    return Count("dense", work, entries, m, 1e9 * formation_time(problem))
