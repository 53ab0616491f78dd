"""Stop at a velocity error in m/s: the tolerance that guarantees it, and the acceptance of answers that meet it.

The relative residual is the largest max(E / E0, V / V0) of an island, with the velocity error V and the references E0,
V0 of the zero impulse. With V0 the largest reference of an island,

    relative <= velocity_tol / V0   =>   V <= velocity_tol on every row                                        (1)

Solvers run to the tolerance (1). An answer with a larger relative residual is also accepted if the judge measures
V <= velocity_tol, because (1) limits E, too, which was not requested.
"""

from __future__ import annotations

from typing import Any

from lavender.base.arrays import check_float
from lavender.base.errors import InputError
from lavender.judge.residuals import residual
from lavender.judge.solution import Solution, Status
from lavender.problem import Problem

# [-] Relative residual of the zero impulse: it is accepted if its own error is small enough.
MAX_VELOCITY_TOLERANCE = 1.0
DEFAULT_TOLERANCE = 1e-6  # [-] Default of `tol` of all solves.
UNFINISHED = (Status.MAX_ITERATIONS, Status.STALLED, Status.TIME_LIMIT)


def check_velocity_tolerance(velocity_tol: float, tol: float) -> float:
    """Return `velocity_tol` [m/s] as a float."""
    velocity_tol = check_float("velocity_tol", velocity_tol, above=0.0)
    if tol != DEFAULT_TOLERANCE:
        raise InputError(
            f"tol is {tol:g} and velocity_tol is {velocity_tol:g}; one of them is needed alone"
        )
    return velocity_tol


def relative_tolerance(problem: Problem, velocity_tol: float, tol: float) -> float:
    """Return the relative residual (1) that guarantees a velocity error [m/s, rad/s] of every row.

    `tol`, of the same call, must be the default.
    """
    velocity_tol = check_velocity_tolerance(velocity_tol, tol)
    reference = residual(problem, problem.start()).velocity_at_zero if problem.m else 0.0
    ratio = velocity_tol / reference if reference > 0.0 else MAX_VELOCITY_TOLERANCE
    return min(ratio, MAX_VELOCITY_TOLERANCE)


def accept_velocity(solution: Solution, velocity_tol: float) -> Solution:
    """Return the solution with the requested velocity error, as CONVERGED if the judge measures no larger one."""
    values: dict[str, Any] = {"velocity_tol": velocity_tol}
    if solution.status in UNFINISHED and solution.residual.velocity <= velocity_tol:
        values["status"] = Status.CONVERGED
        values["message"] = f"the velocity error of every row is at most {velocity_tol:g} m/s"
    return solution.with_fields(**values)
