"""The first phase of `newton` from a warm start: judge it, a few sweeps; or free joints at once.

The step of a simulation at rest, or of a chain, ends here. `lavender_ext/warm/start.pxd` has the equations; what is not
within tol after it goes on from the start it came with.
"""

from __future__ import annotations

from typing import NamedTuple

from lavender._arrays import FloatArray
from lavender.problem import Problem
from lavender.solution import Claim, Status
from lavender_ext.warm.start import (
    JUDGED,
    MOST_SWEEPS,
    SOLVED,
    SWEPT,
    UNDECIDED,
    from_guess,
)

__all__ = ["Tried", "claim_of", "warm_start"]

#: How the kernel says that it ended; None where nothing was decided.
ENDED = {
    UNDECIDED: None,
    JUDGED: "as it came",
    SWEPT: "warm sweeps",
    SOLVED: "joints solved directly",
}


class Tried(NamedTuple):
    """What the first phase made of a start."""

    how: int  # how it ended, a number of the kernel; 0 where it decided nothing
    sweeps: int = 0
    factorisations: int = 0


def claim_of(tried: Tried) -> Claim | None:
    """What `newton` says of a warm start that ended in its first phase; None where it did not."""
    message = ENDED[tried.how]
    if message is None:
        return None
    work = {"factorisations": tried.factorisations}
    if tried.sweeps:
        work["sweeps"] = tried.sweeps
    form = "impulse" if tried.how == SOLVED else "velocity"
    return Claim(Status.CONVERGED, tried.factorisations, work, message, form=form)


def warm_start(
    problem: Problem, impulse: FloatArray, tol: float, budget: int, time_limit: float | None = None
) -> Tried:
    """Carry `impulse` (m,) to tol in place where the first phase can; else nothing is changed."""
    if problem.rows is None or problem.friction != "coulomb" or tol <= 0.0 or budget < 1:
        return Tried(0)
    if time_limit is not None and MOST_SWEEPS * 1e-9 * problem.data.work > time_limit:
        return Tried(0)
    return Tried(*from_guess(problem.data, impulse, tol))
