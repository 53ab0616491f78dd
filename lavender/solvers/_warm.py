"""The first phase of `newton` from a warm start: judge it, a few sweeps, few Newton steps; or free joints at once.

The step of a simulation at rest, or of a chain, ends here. `lavender_ext/warm/start.pxd` and `active_set.pxd` have the
equations; what is not within tol after it goes on from the start it came with.
"""

from __future__ import annotations

import numpy as np

from lavender._arrays import FloatArray
from lavender._derived import Tried
from lavender.problem import Problem
from lavender.solution import Claim, Status
from lavender_ext.warm.start import from_guess, limits

#: How it ended, by number of lavender_ext/warm/start.pxd: None where nothing was decided.
ENDED = (None, "as it came", "warm sweeps", "joints solved directly", "warm sweeps, Newton steps over bodies")

MOST_SWEEPS, MOST_STEPS = limits()  # sweeps and factorisations that the first phase may cost


def warm_claim(how: int, sweeps: int, factorisations: int) -> Claim | None:
    """What `newton` says of a warm start that ended in its first phase; None where it did not."""
    message = ENDED[how]
    if message is None:
        return None
    work = {"factorisations": factorisations}
    if sweeps:
        work["sweeps"] = sweeps
    return Claim(Status.CONVERGED, factorisations, work, message, form="impulse" if how == 3 else "velocity")


def solve_warm(
    problem: Problem, impulse: FloatArray, tol: float, budget: int, time_limit: float | None = None
) -> tuple[Claim | None, int, int]:
    """Carry `impulse` (m,) to tol in place: the claim, or None and nothing changed; sweeps, factorisations done."""
    if problem.rows is None or problem.friction != "coulomb" or tol <= 0.0 or budget < MOST_STEPS:
        return None, 0, 0
    if time_limit is not None and MOST_SWEEPS * 1e-9 * problem.data.work > time_limit:
        return None, 0, 0
    tried = problem.derived.tried
    if (
        tried is None
        or tried.tol != tol
        or problem.guess is None
        or not np.array_equal(impulse, problem.guess)
    ):
        tried = Tried(tol, *from_guess(problem.data, impulse, tol))
    _, how, sweeps, factorisations = tried
    return warm_claim(how, sweeps, factorisations), sweeps, factorisations


def note_tried(problem: Problem, tol: float, sweeps: int, factorisations: int) -> None:
    """The guess of `problem` was tried at tol, in vain."""
    problem.derived.tried = Tried(tol, 0, sweeps, factorisations)
