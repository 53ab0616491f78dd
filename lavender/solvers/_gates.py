"""Which problems a compiled call for few rows, or one over velocities, is tried on before anything else is counted.

The compiled loops (`lavender_ext/few/many.pyx`) make the same comparisons of counted costs, in the same order.
"""

from __future__ import annotations

from lavender.problem import LAWS, Problem
from lavender.registry import FEW
from lavender.solvers import _rates as rates
from lavender.solvers._counts import sweep_cost
from lavender.solvers._newton.general import factor_flops
from lavender_ext.core import assemble
from lavender_ext.few.many import contacts_are_soft

__all__ = [
    "CARRIED_GATE",
    "GENERAL_GATE",
    "NO_GATE",
    "call_ends_within",
    "first_look",
    "general_cost",
    "general_first",
    "is_carried",
]

FIRST_LOOK, LAST_LOOK = 16, 64  # sweeps before the first look at the residual: so many at least and at most,
LOOKED = 60e3  # ns, or as cost so much: a look and a cut in the sweeps are not free
# Of few rows under Coulomb's law, up to so many: Newton's method over velocities costs less than sweeps where so much
# for a row and a multiply-add of its factor comes to no more than that; and of d, what rows of soft contacts have.
FEW_GATE = (
    float(FEW),
    rates.FEW_STEPS * rates.FEW_STEP_ROW - rates.FEW_SWEEPS * rates.FEW_SWEEP_ROW,
    rates.FEW_STEPS * rates.FEW_STEP_FLOP,
    rates.FEW_LOOK - rates.FEW_CALL,
    rates.SOFT,
)
NO_GATE = (0.0,) * 5  # in place of these where nothing else would come first
# All that `general_first` reads, for a compiled loop over many problems.
GENERAL_GATE = (
    rates.GENERAL_START,
    tuple(rates.GENERAL_ROW[law] for law in LAWS),
    tuple(rates.GENERAL[law] for law in LAWS),
    rates.GENERAL_FIRST,
    rates.FORM,
    tuple(rates.GENERAL_COUNT[law] for law in LAWS),
    FEW_GATE,
)
# And `is_carried`.
CARRIED_GATE = (FEW, rates.FORMED, rates.SWEEP_START, rates.CARRIED, rates.SWEEP["lcp"], rates.SWEEP_ROW)


def first_look(per: float) -> int:
    """Sweeps, each of cost `per` [ns], before their residual is looked at."""
    return int(min(max(FIRST_LOOK, LOOKED / per), LAST_LOOK))


def call_ends_within(problem: Problem, time_limit: float | None) -> bool:
    """The compiled call for few rows takes a quarter of the limit [s] at most: without an end it leaves nothing."""
    if time_limit is None or (problem.generalized is None and problem.law in ("linear", "lcp")):
        return True
    if problem.generalized is not None:
        cost = general_cost(problem, problem.generalized.nv)
    else:
        per = sweep_cost(problem)
        cost = first_look(per) * per
    return 4e-9 * cost <= time_limit


def general_cost(problem: Problem, largest: int) -> float:
    """Newton over generalised velocities, `largest` of them in one island [ns]."""
    law = problem.law
    step = rates.GENERAL_ROW[law] * problem.m + rates.GENERAL[law] * factor_flops(problem, largest)
    return rates.GENERAL_START + rates.GENERAL_COUNT[law] * step


def general_first(problem: Problem, largest: int) -> bool:
    """Newton over generalised velocities costs next to nothing, or less than only to form A = Y Y^T for the others.

    The columns of Y have n_c entries: sum n_c^2 >= (sum n_c)^2 / nv multiply-adds. Under Coulomb's law few rows have
    sweeps first where these usually cost less, unless contacts are soft, on which it takes few steps.
    """
    assert problem.generalized is not None
    cost = general_cost(problem, largest)
    if problem.law == "coulomb" and problem.m <= FEW:
        _, row, flop, most, _ = FEW_GATE
        if row * problem.m + flop * factor_flops(problem, largest) <= most:
            return True
        if not contacts_are_soft(problem.metric, rates.SOFT):
            return False
    if cost <= rates.GENERAL_FIRST:
        return True
    entries = 0.5 * (problem.metric.work - 4.0 * problem.m)
    return cost <= rates.FORM * entries * entries / max(1, problem.generalized.nv)


def is_carried(problem: Problem) -> bool:
    """Bounded rows, more than few, that meet on one body: A is full, and to form it costs more than many sweeps do.

    What couples them has few ranks. Combined sweeps end as soon as they have seen these, or they are far from it.
    """
    if problem.law != "lcp" or problem.m <= FEW or problem.matrix is not None:
        return False
    if problem.generalized is not None:
        cost = rates.FORMED * problem.metric.entries_of_a
    else:
        cost = rates.FORMED_ROWS * int(assemble.bound(problem.data)[0])
    return bool(cost >= rates.SWEEP_START + rates.CARRIED * sweep_cost(problem, problem.metric.work))
