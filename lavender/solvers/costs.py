"""Estimate the costs of Newton's method and of sweeps [ns] from their structure; `auto` compares only these numbers.

    Newton   start + n (row m + entry e + work w)                                                             (1)
    sweep    sweep_row m + entry e, under the cone law over J sweep_cone e                                    (2)

    direct   n (row m + work w)                                                                               (3)

m is the number of rows; e the multiply-adds of a sweep, or the entries of A that one step reads; w the multiply-adds of
one factorisation and its solves, from the solver's own analysis (`NewtonState.count`) or from the band of A. n is the
number of factorisations: 1 for linear problems, otherwise `DECISIONS.factorisations`, and
`DECISIONS.pivot_factorisations` for `direct`. Over generalised velocities everything is compiled: start and row are 0.
No clock is read: the same problem has the same counts on every machine.
The rates of `rates.json` are fitted to measured times of random problems
(docs/method.md, "Figures without a command").
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from typing import Any

from lavender.problem import Problem
from lavender.solvers._accelerated import sweep_work
from lavender.solvers.decisions import DECISIONS
from lavender.solvers.setup_times import dense_work, formation_time

__all__ = [
    "RATES",
    "Count",
    "direct_cost",
    "factorisations",
    "formed_count",
    "min_count",
    "newton_cost",
    "sweep_cost",
]

# os.path is used because pathlib would take 4 % of the time of `import lavender`.
with open(os.path.join(os.path.dirname(__file__), "rates.json"), encoding="utf-8") as _file:
    RATES: dict[str, Any] = json.load(_file)


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
    """

    form: str
    work: float
    entries: float
    rows: float
    set_up: float = 0.0


def factorisations(law: str) -> float:
    """Return the expected number of factorisations of Newton's method: 1 for linear problems."""
    return 1.0 if law == "linear" else DECISIONS.factorisations


def newton_cost(count: Count, law: str) -> float:
    """Return the estimated cost of Newton's method [ns], (1)."""
    r = RATES
    step_cost = r["row"] * count.rows + r["entry"] * count.entries + r["work"][count.form] * count.work
    start = r["start"] if count.rows else 0.0
    return float(start + count.set_up + factorisations(law) * step_cost)


def direct_cost(problem: Problem) -> float:
    """Return the estimated cost of `direct` on bounded rows of a matrix [ns], (3)."""
    m = float(problem.m)
    work = m * (1.0 + max(problem.bandwidth)) ** 2 if problem.is_symmetric else 2.0 * dense_work(problem.m)
    return DECISIONS.pivot_factorisations * (RATES["pivot row"] * m + RATES["pivot work"] * work)


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
