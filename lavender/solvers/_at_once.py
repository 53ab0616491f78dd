"""A factor that costs less than to find out what else there is: `direct`, before anything is looked at or noted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lavender._arrays import FloatArray
from lavender.problem import Problem
from lavender.registry import FEW
from lavender.residuals import judged, known
from lavender.solution import Claim, Status
from lavender.solvers import _rates as rates
from lavender.solvers._costs import Exact
from lavender.solvers._counts import sweep_cost
from lavender.solvers._factor import PanelsLU, TooDear
from lavender.solvers._few import WARM, said
from lavender.solvers._first import factors_at_once, joints_at_once
from lavender.solvers._trail import usable
from lavender.solvers.direct import Direct, Enough, Impatient

__all__ = ["HASTY", "JOINTS", "Factored", "factor_first", "joints_over_velocities"]

JOINTS = Exact("direct", 0.0, 0)
HASTY = Exact("direct", 0.0, rates.DIRECT_ROUNDS, (("patience", False),))


@dataclass
class Factored:
    """What `direct` did, for the trail where it is not the end."""

    chosen: Exact
    claim: Claim
    impulse: FloatArray  # (m,) N s
    before: float  # relative residual that it began with
    relative: float  # and ended with

    def ended(self) -> Claim:
        """Where that meets the tolerance."""
        work = self.claim.work
        return Claim(Status.CONVERGED, self.claim.iterations, work, said("direct", work))


def factor_first(
    problem: Problem, impulse: FloatArray, n: int, tol: float, time_limit: float | None
) -> tuple[Factored | None, bool]:
    """`direct` from an impulse (m,), or None where something else comes first; whether that is since its factor fills.

    Bounded rows of a narrow band; a symmetric linear system that costs least so (`joints_at_once`), and one that is not
    and has few entries, unless the factor fills so much that slow sweeps cost less, or time runs out.
    """
    if problem.m <= FEW or n <= 0 or problem.generalized is not None:
        return None, False
    solver: Direct
    if problem.law == "linear":
        if not (joints_at_once(problem) if problem.is_symmetric else PanelsLU.takes(problem)):
            return None, False
        chosen, solver = JOINTS, _enough(problem, time_limit)
    elif factors_at_once(problem):
        chosen, solver = HASTY, Impatient()
    else:
        return None, False
    return _factored(problem, impulse, n, tol, time_limit, chosen, solver)


def joints_over_velocities(
    problem: Problem, impulse: FloatArray, n: int, tol: float, time_limit: float | None
) -> tuple[Factored | None, bool]:
    """The same of a linear system in generalised coordinates on which Newton's method over velocities costs more."""
    if problem.law != "linear" or problem.m <= FEW or n <= 0:
        return None, False
    return _factored(problem, impulse, n, tol, time_limit, JOINTS, _enough(problem, time_limit))


def _enough(problem: Problem, time_limit: float | None) -> Enough:
    """`direct` whose fill is counted before the first number."""
    limit = np.inf if time_limit is None else 1e9 * time_limit
    return Enough(most=min(rates.SWEEPS_REDUNDANT * sweep_cost(problem), limit))


@np.errstate(all="ignore")  # what overflows is judged
def _factored(
    problem: Problem,
    impulse: FloatArray,
    n: int,
    tol: float,
    time_limit: float | None,
    chosen: Exact,
    solver: Direct,
) -> tuple[Factored | None, bool]:
    spec = usable("direct", problem)
    found = known(problem, impulse)
    before = judged(problem, impulse.copy()).relative if found is None else found
    if spec is None or before <= tol:
        return None, False
    lam = impulse.copy() if before <= WARM else problem.start()
    try:
        state = solver.prepare(problem)
        claim = solver.run(state, lam, min(spec.max_iter, n), tol, time_limit)
    except TooDear:
        return None, True
    after = known(problem, lam)
    return Factored(chosen, claim, lam, before, np.inf if after is None else after), False
