"""The first phase of `newton` from a warm start: judge it, a few sweeps; or free joints at once.

It solves steps of a simulation at rest, or of a chain. `lavender_ext/newton/warm_start.pxd` has the equations. If the
result is not within tol, `newton` continues from the original start.
"""

from __future__ import annotations

from lavender.base.arrays import FloatArray
from lavender.judge.solution import Claim, Status
from lavender.problem import Problem
from lavender_ext.newton.warm_start import (
    JUDGED,
    MOST_SWEEPS,
    SOLVED,
    SWEPT,
    UNDECIDED,
    from_guess,
)

NOTHING = UNDECIDED, 0, 0

#: How the kernel says that it ended; None where nothing was decided.
ENDED = {
    UNDECIDED: None,
    JUDGED: "as it came",
    SWEPT: "warm sweeps",
    SOLVED: "joints solved directly",
}


def claim_of(how: int, sweeps: int, factorisations: int) -> Claim | None:
    """The claim of `newton` for a warm start that ended so in the first phase; None if it decided nothing."""
    message = ENDED[how]
    if message is None:
        return None
    work = {"factorisations": factorisations} | ({"sweeps": sweeps} if sweeps else {})
    form = "impulse" if how == SOLVED else "velocity"
    return Claim(Status.CONVERGED, factorisations, work, message, form=form)


def warm_start(
    problem: Problem, impulse: FloatArray, tol: float, budget: int, time_limit: float | None = None
) -> tuple[int, int, int]:
    """Solve `impulse` (m,) to tol in place if the first phase can; otherwise leave it unchanged.

    How it ended, of `ENDED`, its sweeps and factorisations.
    """
    if problem.rows is None or problem.friction != "coulomb" or tol <= 0.0 or budget < 1:
        return NOTHING
    if time_limit is not None and MOST_SWEEPS * 1e-9 * problem.data.work > time_limit:
        return NOTHING
    found: tuple[int, int, int] = from_guess(problem.data, impulse, tol)
    return found
