"""Impulses of an engine that publishes velocities alone, as many games do: the impulses that explain its motion best.

    minimise 1/2 lambda.A lambda - lambda.J (v+ - v*)   within the bounds and cones,   A = J M^-1 J^T           (1)

v* is the velocity without constraint impulses, v+ the engine's. Up to a constant, (1) is the kinetic energy of what is
left over, v+ - v* - M^-1 J^T lambda: position corrections, damping, and contacts that the problem does not have. (1) is
the convex law "cone" with b = J (v+ - v*) and without compliance. Impulses of redundant contacts are not unique; their
effect on the motion is.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lavender.base.arrays import ArrayLike, FloatArray, as_array, get_shape
from lavender.base.errors import CapabilityError
from lavender.problem import Problem, check_problem
from lavender.solving.solve import solve
from lavender_ext.core.problem import multiply_body_jacobian

PLANAR_COLUMNS = [0, 1, 5]  # v_x, v_y and omega of a body in the plane.
RECONSTRUCTION_TOL = 1e-10  # [-] Relative residual of (1): far below the errors of engines.


class Reconstruction(NamedTuple):
    """Impulses that explain a change of velocity.

    Parameters
    ----------
    impulse : (m,), N s
    left_over : float, m/s or rad/s
        Largest entry of v+ - v* - M^-1 J^T lambda in absolute value.
    """

    impulse: FloatArray
    left_over: float


def reconstruct(problem: Problem, velocity: ArrayLike) -> Reconstruction:
    """Compute the impulses within bounds and cones that explain an engine's velocities best, eq. (1) of the module.

    Parameters
    ----------
    problem : Problem
        Problem of the step, by bodies or J and M, with v* after forces and before constraint impulses.
    velocity : (n, 6), planar (n, 3) or (nv,), m/s, rad/s
        v+, the engine's velocity after its solve.

    Returns
    -------
    Reconstruction
        `lavender.residual(problem, reconstruction.impulse)` judges the impulses on the problem itself.

    Raises
    ------
    InputError
        `velocity` has another shape than v*, or is not finite.
    CapabilityError
        The problem was given as a matrix.
    """
    check_problem(problem)
    form = problem.rows if problem.generalized is None else problem.generalized
    if form is None:
        raise CapabilityError(
            "this problem was given as a matrix; J and M are needed for velocities"
        )
    shape = form.v_free.shape
    if problem.generalized is None and get_shape("velocity", velocity) == (shape[0], 3):
        planar = as_array("velocity", velocity, (shape[0], 3), unit="m/s, rad/s")
        velocity = np.zeros(shape)
        velocity[:, PLANAR_COLUMNS] = planar
    change = as_array("velocity", velocity, shape, unit="m/s, rad/s") - form.v_free
    if problem.generalized is not None:
        b = problem.generalized.velocity_of(change)
    else:
        b = np.empty(problem.m)
        multiply_body_jacobian(problem.data, change, b)
    if not np.abs(b).max(initial=0.0) > np.finfo(float).tiny:
        b[:] = 0.0
    rigid = replace(
        problem, b=b, friction="cone", compliance=np.zeros(problem.m), guess=None, qp=None
    )
    impulse = solve(rigid, impulse=rigid.start(), tol=RECONSTRUCTION_TOL).impulse
    left_over = np.abs(change - problem.compute_velocity_change(impulse)).max(initial=0.0)
    return Reconstruction(impulse, float(left_over))
