"""J and M under Coulomb's law where sweeps gave way: turns of equal counted work, twice as much in each round.

Newton's method over the velocities, sweeps of another kind from the beginning and those that gave way, each on from
where it stood: which of them ends soon nobody can count on, and together they take a few times what the first of them
would have.
"""

from __future__ import annotations

import numpy as np

from lavender.solvers import _rates as rates
from lavender.solvers._counts import general_step
from lavender.solvers._sweepers import Sweeps
from lavender.solvers._trail import Trail
from lavender.solvers._turns import ROUNDS, VELOCITY, whole
from lavender.solvers._walks import OTHER

__all__ = ["alternate"]

FIRST = 1.5  # times what Newton's method is expected to cost, its first turn where nothing costs less
LEAST = 200e3  # ns of a turn, beside which what Python needs for it is little


def alternate(trail: Trail, sweeps: Sweeps | None, budget: int) -> bool:
    """Rounds, until a turn would cost more than a solver that forms A; True when nothing is left to do.

    A turn is as long as all that `sweeps` did.
    """
    costs = trail.costs
    newton = costs.over_velocities_exact
    if newton is None:
        return False
    others = np.inf
    if not trail.late_by(rates.WITH_A * costs.formed):  # to ask what they cost may form A
        others = min((e.cost for e in costs.exact if e.key not in (VELOCITY, *trail.ended)), default=np.inf)
    step = general_step(trail.problem, trail.largest, costs.islands)
    allowed = max(LEAST, min(newton.cost, others) if sweeps is None else sweeps.done * sweeps.per)
    first = FIRST * newton.cost if newton.cost <= others else 0.0
    swept = [] if sweeps is None else [sweeps]
    other: Sweeps | None = None
    for _ in range(ROUNDS):
        if not (allowed <= others or first > 0.0):
            break
        before = trail.iterations
        steps = int(max(allowed, first) / step)
        if steps > 0 and VELOCITY not in trail.ended and whole(trail, newton, budget, steps):
            return True
        if allowed > others:
            break
        if other is None:
            other = Sweeps(trail, **OTHER)
            other.impulse, other.last = trail.problem.start(), 1.0
            swept.insert(0, other)
        for each in swept:
            if each.run(budget, cap=each.done + int(allowed / each.per)):
                return True
        if trail.iterations == before:
            break  # nobody is left
        first, allowed = 0.0, 2.0 * allowed
    return trail.done
