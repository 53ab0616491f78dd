"""The first phase of `newton` from a warm start: judge it, a few sweeps; or free joints at once.

It solves steps of a simulation at rest, or of a chain. `lavender_ext/warm/start.pxd` has the equations. If the result
is not within tol, `newton` continues from the original start.
"""

from __future__ import annotations

from typing import NamedTuple

from lavender.base.arrays import FloatArray
from lavender.judge.solution import Claim, Status
from lavender.problem import Problem
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
    """Result of the first phase."""

    how: int  # how it ended, a number of the kernel; 0 where it decided nothing
    sweeps: int = 0
    factorisations: int = 0


def claim_of(tried: Tried) -> Claim | None:
    """The claim of `newton` for a warm start solved in the first phase; None if it was not."""
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
    """Solve `impulse` (m,) to tol in place if the first phase can; otherwise leave it unchanged."""
    if problem.rows is None or problem.friction != "coulomb" or tol <= 0.0 or budget < 1:
        return Tried(0)
    if time_limit is not None and MOST_SWEEPS * 1e-9 * problem.data.work > time_limit:
        return Tried(0)
    return Tried(*from_guess(problem.data, impulse, tol))
