"""Whether islands are taken apart in compiled code before sweeps over all of them; what it leaves, once more."""

from __future__ import annotations

import numpy as np

from lavender.solvers._counts import together_cost
from lavender.solvers._split import solve_together, takes
from lavender.solvers._sweepers import Glance
from lavender.solvers._trail import Trail
from lavender_ext.few.looks import sweeps_left

__all__ = ["solve_islands", "worth_together"]

ONCE_MORE = (
    2.0  # times what a finite solver was guessed to cost for each row, from which sweeps of islands go on
)
SAVED = 0.5  # share of all sweeps that islands spare which are not the largest


def worth_together(trail: Trail, glance: Glance | None) -> bool:
    """What it costs to take islands apart is less than what they save of sweeps over all of them.

    Those cost no more than a finite solver, which comes next. They all go on until the island that needs most of
    them is there. A glance tells how many are left.
    """
    problem, costs = trail.problem, trail.costs
    if problem.law == "lcp" and trail.ended:
        return False  # where direct gave up, A is singular: so it is in islands, and sweeps are slow
    over_velocities = problem.generalized is not None and problem.law != "coulomb"
    expected = costs.sweeping
    if glance is not None:
        rest = sweeps_left(glance.last, glance.before, glance.best, trail.tol)
        expected = min(expected, rest * costs.sweep)
    # Islands are not looked for where even one would cost too much.
    if not over_velocities and not together_cost(problem, 1, trail.largest) < SAVED * expected:
        return False
    if not takes(trail):
        return False
    cost = together_cost(problem, trail.islands[0], trail.largest)
    if over_velocities:
        return cost < costs.sweeping
    if problem.law == "cone" and trail.islands[0] == problem.n_blocks:
        return False  # a sweep solves each block exactly
    expected = min(expected, max(costs.least, costs.guess))
    if not cost < SAVED * expected:
        return False
    rows = np.bincount(trail.islands[1], weights=np.diff(problem.cones.ptr))
    return bool(cost < SAVED * (1.0 - rows.max() / problem.m) * expected)


def solve_islands(trail: Trail, budget: int) -> bool:
    """Islands in compiled code, given up by a guess of what else there is; those left once more where it is worth it.

    What else there is for the whole is then there for them alone.
    """
    costs, m = trail.costs, trail.problem.m
    each = max(costs.least, costs.guess) / m
    left = solve_together(trail, budget, each)
    if not trail.done and len(left) and trail.problem.generalized is None:
        rows = np.bincount(trail.islands[1], weights=np.diff(trail.problem.cones.ptr))
        known = costs.cheapest / float(rows[left].sum())
        if known > ONCE_MORE * each:
            solve_together(trail, budget, known)
    return trail.done
