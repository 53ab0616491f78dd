"""What Newton's method and sweeps cost [ns], counted from their structure: the only numbers that `auto` compares.

    Newton   start + n (row m + entry e + work w)                                                             (1)
    sweep    sweep_row m + entry e, under the cone law over J sweep_cone e                                    (2)

m rows; e multiply-adds of a sweep or entries of A, which one step reads; w multiply-adds of one factorisation and its
solution, as the solver's own analysis tells them (`NewtonState.count`); n factorisations, by law. Over generalised
velocities all is compiled: no start, nothing for a row, and n, whatever the law, is that of bounded rows, STEPS times
as large where a row has no compliance and not all are bounded, SOFT times where every row has enough and not all are
free. No clock is read: the same problem has the same counts on every machine. The twelve rates of `rates.json` were
fitted on measured times of random problems (docs/method.md, "Figures without a command").
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from typing import Any

from lavender.problem import Problem
from lavender.solvers._accelerated import sweep_work
from lavender.solvers.setup_times import dense_work, formed_once

__all__ = ["RATES", "SWEEPS", "Count", "factorisations", "formed", "least", "newton_cost", "sweep_cost"]

# By os.path: pathlib would be 4 % of `import lavender`.
with open(os.path.join(os.path.dirname(__file__), "rates.json"), encoding="utf-8") as _file:
    RATES: dict[str, Any] = json.load(_file)
SOFT = 0.5  # over generalised velocities for each factorisation elsewhere, if no row is rigid
STEPS = 4.0  # over generalised velocities for each factorisation elsewhere, if a row is rigid
SWEEPS = 100.0  # that a problem is counted to take: Newton's method comes first where its cost is less


@dataclass(frozen=True)
class Count:
    """One step of Newton's method."""

    form: str  # bodies, dense, panels or velocities: what is factored
    work: float  # multiply-adds of one factorisation
    entries: float  # read beside it
    rows: float  # 0 over generalised velocities
    set_up: float = 0.0  # ns, A formed of J and M
    steps: float = 1.0  # for each factorisation by law


def factorisations(law: str, form: str = "") -> float:
    """How many Newton's method is counted for; linear is one, every other law over velocities what bounded rows are."""
    if law == "linear":
        return 1.0
    return float(RATES["count"]["rows" if law == "lcp" or form == "velocities" else law])


def newton_cost(count: Count, law: str) -> float:
    """(1)."""
    r = RATES
    each = r["row"] * count.rows + r["entry"] * count.entries + r["work"][count.form] * count.work
    start = r["start"] if count.rows else 0.0
    return float(start + count.set_up + count.steps * factorisations(law, count.form) * each)


def least(problem: Problem) -> Count:
    """What Newton's method costs at least, told without an analysis."""
    over_velocities = problem.generalized is not None
    return Count("bodies", 0.0, float(problem.metric.work), 0.0 if over_velocities else float(problem.m))


def sweep_cost(problem: Problem) -> float:
    """(2)."""
    cone = problem.law == "cone" and problem.matrix is None
    return float(
        RATES["sweep row"] * problem.m + RATES["sweep cone" if cone else "entry"] * sweep_work(problem)
    )


def formed(problem: Problem) -> Count:
    """What Newton's method over rows of an A that is formed of J and M costs at least."""
    m = float(problem.m)
    entries = min(float(problem.metric.entries_of_a), m * m)
    work = 0.0 if entries < 0.5 * m * m else dense_work(problem.m)
    return Count("dense", work, entries, m, 1e9 * formed_once(problem))
