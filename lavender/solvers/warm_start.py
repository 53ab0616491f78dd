"""First phase of `newton` from a warm start: judge it, then a few sweeps, or a direct solve of free joints.

It suffices for most steps of a simulation at rest and for chains of joints. The equations are in
`lavender_ext/newton/warm_start.pxd`. If the result is not within tol, `newton` continues from the original start.
"""

from __future__ import annotations

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Deadline
from lavender.judge.solution import Claim, Status
from lavender.problem import Problem
from lavender_ext.newton.warm_start import JUDGED, SOLVED, SWEPT, UNDECIDED, solve_from_guess

UNDECIDED_RESULT = UNDECIDED, 0, 0

#: Message for each code of the kernel; None if the phase did not solve the problem.
MESSAGES = {UNDECIDED: None, JUDGED: "as it came", SWEPT: "warm sweeps", SOLVED: "joints solved directly"}


def make_warm_start_claim(code: int, sweeps: int, factorisations: int) -> Claim | None:
    """Return the claim of `newton` for the code and counts of its first phase; None if the phase decided nothing."""
    message = MESSAGES[code]
    if message is None:
        return None
    work = {"factorisations": factorisations} | ({"sweeps": sweeps} if sweeps else {})
    form = "impulse" if code == SOLVED else "velocity"
    return Claim(Status.CONVERGED, factorisations, work, message, form=form)


def warm_start(
    problem: Problem, impulse: FloatArray, tol: float, budget: int, deadline: Deadline | None = None
) -> tuple[int, int, int]:
    """Solve `impulse` (m,) [N s] to tol in place if the first phase can; otherwise leave it unchanged.

    Return (key of `MESSAGES`, sweeps, factorisations).
    """
    if problem.rows is None or problem.friction != "coulomb" or tol <= 0.0 or budget < 1:
        return UNDECIDED_RESULT
    result: tuple[int, int, int] = solve_from_guess(problem.data, impulse, tol, deadline)
    return result
