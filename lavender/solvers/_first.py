"""What comes before anything is swept, factored or counted closely."""

from __future__ import annotations

import numpy as np

from lavender.problem import LAWS, Problem
from lavender.registry import FEW
from lavender.solvers import _rates as rates
from lavender.solvers._costs import Costs
from lavender.solvers._counts import (
    finite_least,
    formed_cost,
    general_cost,
    general_count,
    is_redundant,
    joints_formed,
    newton_rates,
    rows_direct,
    sweep_cost,
)
from lavender.solvers._factor import DENSE_SHARE, SMALL_BAND, choose
from lavender.solvers._islands import block_bodies
from lavender.solvers._newton.general import factor_flops
from lavender_ext.core import assemble
from lavender_ext.factor import graph
from lavender_ext.few.many import contacts_are_soft
from lavender_ext.pivot.principal import bandwidth

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
CARRIED_GATE = (
    FEW,
    rates.FORMED,
    rates.SWEEP_START,
    rates.CARRIED,
    rates.SWEEP["lcp"],
    rates.SWEEP_ROW,
)


def first_look(per: float) -> int:
    """Sweeps, each of cost `per` [ns], before their residual is looked at."""
    return int(min(max(rates.FIRST_LOOK, rates.LOOKED / per), rates.LAST_LOOK))


def general_first(problem: Problem, largest: int) -> bool:
    """Newton over generalised velocities costs next to nothing, or less than only to form A = Y Y^T for the others.

    The columns of Y have n_c entries: sum n_c^2 >= (sum n_c)^2 / nv multiply-adds. Without friction, whose steps are
    less certain, what Python needs for it and each of its entries counts, of a linear system what `direct` then costs
    as well, under the cone law what sweeps usually cost. Under Coulomb's law few rows have sweeps first where these
    usually cost less, unless contacts are soft, on which it takes few steps. Or, of many soft rows there, more than
    velocities, less than sweeps usually cost where rows depend on each other.
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
    if cost <= rates.FORM * entries * entries / max(1, problem.generalized.nv):
        return True
    if problem.law == "linear" and cost <= joints_formed(problem):
        return True
    if problem.law == "lcp" and cost <= formed_cost(problem):
        return True
    # Under the cone law sweeps end few problems that it does not, and those late.
    if problem.law == "cone" and cost <= rates.WITH_A * formed_cost(problem) + rates.SWEEPS * sweep_cost(
        problem
    ):
        return True
    if (
        problem.law != "coulomb"
        or problem.m <= max(rates.MANY_ROWS, problem.generalized.nv)
        or not np.all(problem.compliance)
    ):
        return False
    step = (
        rates.MANY_STEP
        + rates.MANY_ROW * problem.m
        + rates.GENERAL["coulomb"] * factor_flops(problem, largest)
    )
    return rates.GENERAL_START + rates.MANY_COUNT * step <= rates.SWEEPS_REDUNDANT * sweep_cost(problem)


def general_second(problem: Problem) -> bool:
    """The same right after a first look at sweeps: of few rows Python takes longer to compare costs."""
    return problem.law == "coulomb" and problem.m <= FEW


def joints_before_count(problem: Problem) -> bool:
    """Joints on J and M whose factors over velocities fill so much that to count them takes longer than `direct`.

    Not where rows are free and soft, which one factor ends.
    """
    return problem.law == "linear" and general_count(problem) > 1.0


def general_steps(problem: Problem, islands: int) -> int:
    """Steps that Newton's method over generalised velocities has before another solver is asked."""
    law = problem.law
    if law == "coulomb":
        return rates.GENERAL_STEPS[law]
    return rates.GENERAL_STEPS[law] + int(rates.GENERAL_COUNT[law]) * (islands - 1)


def is_glanced(problem: Problem, per: float) -> bool:
    """A first look at sweeps, each of cost `per` [ns], comes before anything else is found out."""
    if problem.law == "linear":
        # LU of few rows costs as much as hundreds of sweeps, and more where they depend on each other.
        return not problem.is_symmetric and problem.m <= rates.LU_ROWS
    if problem.m <= FEW:
        return not factors_at_once(problem)
    if is_redundant(problem) or factors_at_once(problem):
        return False
    look, most = rates.FIRST_LOOK * per, rates.GLANCED
    if look > most and problem.law == "lcp" and not _may_be_narrow(problem):
        # Whether A is symmetric, and what a factor of it takes, is not asked for before.
        most += rates.GLANCE * (formed_cost(problem) + finite_least(problem, True))
    return look <= most


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
    per = (
        rates.SWEEP["lcp"] * problem.metric.work + rates.SWEEP_ROW * problem.m
    )  # A is not what is swept then
    return bool(cost >= rates.SWEEP_START + rates.CARRIED * per)


def _may_be_narrow(problem: Problem) -> bool:
    """Its A is a narrow band in the order of elimination, or has no more entries than one where nobody looks for it."""
    if problem.generalized is not None:
        return False
    # What was found out before says nothing: the same problem goes the same way again.
    if _body_width(problem) > rates.NARROW and _asks_for_order(problem):
        return bool(choose(problem)[0] == "band")
    if problem.rows is not None:
        return True
    m, entries = problem.m, len(problem._compressed[1])
    return entries <= (2 * rates.NARROW + 1) * m and (
        entries < DENSE_SHARE * m * m or max(bandwidth(*problem._compressed[:2])) <= SMALL_BAND
    )


def factors_at_once(problem: Problem) -> bool:
    """Bounded rows, few or of a symmetric narrow band that is found in no time: `direct`, without a look."""
    if problem.law != "lcp":
        return False
    m = problem.m
    if m <= FEW:
        return True
    if problem.generalized is not None or is_redundant(problem):
        return False
    width = _body_width(problem)
    if width <= rates.NARROW:
        return _is_hasty(m, width)
    if not _asks_for_order(problem):
        return False
    form, band, _ = choose(problem)
    return form == "band" and _is_hasty(m, band + 1)


def _body_width(problem: Problem) -> float:
    """Of A's band in the order of blocks, by the bodies that they share; inf where these are not given."""
    rows = problem.rows
    if rows is None or not rows.n_bodies:
        return np.inf
    return float(graph.body_spread(problem.cones.ptr, block_bodies(problem), rows.n_bodies) + 1)


def _asks_for_order(problem: Problem) -> bool:
    """A has so few entries, and is symmetric, that an order of a narrow band is looked for; of bodies, too."""
    if problem.rows is not None:
        entries = int(assemble.bound(problem.data)[0])
    else:
        entries = len(problem._compressed[1])
    return entries <= rates.NARROW_ENTRIES * problem.m and problem.is_symmetric


def _is_hasty(m: int, width: float) -> bool:
    """A band of m bounded rows so narrow that nothing else is looked at before `direct`."""
    return rates.DIRECT["lcp"] * rates.BAND * m * float(width) ** 2 <= rates.BAND_AT_ONCE


def joints_at_once(problem: Problem) -> bool:
    """A symmetric linear system for `direct`, without a look at what else there is.

    Of few rows; a matrix, whose factor costs less than the one of `newton`; bodies, by the entries that A can have.
    """
    if problem.m <= rates.FEW_JOINTS or problem.matrix is not None:
        return True
    if problem.rows is None or problem.rows.n_bodies == 0:
        return False
    direct = rows_direct(problem)
    start, step, row = newton_rates(problem)
    if direct <= start + rates.NEWTON["linear"] * (step + row * problem.m):
        return True  # whatever the factor of newton costs
    return direct <= Costs(problem, 1e-6).newton_guess
