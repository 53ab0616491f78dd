"""The first phase of `newton` from a warm start: judge it, then a few sweeps, or one banded solve of free joints.

The step of a simulation at rest, or of a chain, ends here. `lavender_ext/warm.pxd` has the equations; what is not
within tol after it goes on from the start it came with.
"""

from __future__ import annotations

from lavender._arrays import FloatArray
from lavender.problem import Problem
from lavender.solution import Claim, Status
from lavender_ext import warm as kernels

#: How it ended, by number of lavender_ext/warm.pxd: None where nothing was decided.
ENDED = (None, "as it came", "warm sweeps", "joints solved directly")


def warm_claim(how: int, sweeps: int, factorisations: int) -> Claim | None:
    """What `newton` says of a warm start that ended in its first phase; None where it did not."""
    message = ENDED[how]
    if message is None:
        return None
    work = {"factorisations": factorisations}
    if sweeps:
        work["sweeps"] = sweeps
    return Claim(Status.CONVERGED, factorisations, work, message, form="velocity" if how < 3 else "impulse")


def solve_warm(problem: Problem, impulse: FloatArray, tol: float, budget: int) -> Claim | None:
    """Carry `impulse` (m,) to tol in place; None, and nothing changed, where the first phase does not suffice."""
    if problem.rows is None or problem.friction != "coulomb" or tol <= 0.0 or budget < 1:
        return None
    return warm_claim(*kernels.from_guess(problem.data, impulse, tol))
