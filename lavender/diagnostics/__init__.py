"""Possible mistakes in a problem's data, reported as diagnostics and never as errors.

A solver also converges on a problem in which a normal points the wrong way. `diagnose` checks relations
that hold for the data of real bodies:

    centres     c_b - c_a = arm_a - arm_b for every contact of a pair; n points from a to b:
                n.(c_b - c_a) > 0 between convex bodies                                                 (1)
    size        the radius of gyration k, k^2 = tr(I) / 2m, has the order of magnitude of the arms      (2)
    targets     target = b + J v*: zero on tangents, not negative if bodies overlap                     (3)
    speeds      targets and approach speeds are plausible; with the state, v* = v + dt a                    (4)

For a problem in J and M, (1) is checked if all contacts belong to free rigid bodies: six velocities in the world frame,
coupled to no others, three of them with equal mass. A row of direction d then has J = (d, r x d) with the arm r.

Thresholds are well outside the values that occur in the built-in suite, the scenes of the gallery, robots and recorded
problems. If the numbers would be ordinary under another interpretation (M^-1 read as M), the diagnostic names it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lavender.diagnostics import blocks, bodies, motion
from lavender.diagnostics.diagnostic import Diagnostic
from lavender.problem import Problem, check_problem

__all__ = ["Diagnostic", "diagnose"]

CHECKS = (
    blocks.diagnose_blocks,
    blocks.diagnose_row_order,
    blocks.diagnose_duplicate_contacts,
    motion.diagnose_targets,
    bodies.diagnose_geometry,
    bodies.diagnose_masses,
    blocks.diagnose_conflict,
)


def diagnose(
    problem: Problem,
    impulse: Any = None,
    *,
    velocity: Any = None,
    gap: Any = None,
    dt: float | None = None,
) -> tuple[Diagnostic, ...]:
    """Look for mistakes in a problem's data, or in the impulses that a solver found for it.

    Checked are the signs and order of normals, bodies and their sizes, masses, the order of rows, targets,
    coefficients, keys and the guess. For up to 1000 rows, Newton's method also searches for a proof that the convex
    relaxation has no solution, and the conflicting blocks are named. A diagnostic need not be an error: a hook has
    normals against its arms, a conveyor has targets on tangents. An empty result does not prove that the data are
    right.

    Parameters
    ----------
    problem : Problem
    impulse : (m,) N s, optional
        A solution to examine; default: the problem's guess.
    velocity : (n, 6) for bodies, (n, 3) for bodies in the xy plane, (nv,) for J and M, m/s and rad/s, optional
        Velocity before the step; in the plane (v_x, v_y, omega), as in `RowBuilder`. It is compared with v*, which
        shows accelerations that were not multiplied by dt or were left out.
    gap : (n_contacts,), m, optional
        Distance between the surfaces of each contact, negative if they overlap; requires `dt`. It is compared with the
        targets, which shows a wrong sign, or a factor dt too many or too few.
    dt : float, s, optional
        Step size.

    Returns
    -------
    tuple of Diagnostic
        Empty if nothing is suspicious.

    Raises
    ------
    InputError
        `problem` is not a Problem, an array has a wrong shape, `gap` is given without `dt`, or `gap` or `velocity` is
        given for a problem in matrix form, which has no v*.

    Examples
    --------
    >>> import numpy as np
    >>> import lavender as lv
    >>> problem = lv.Problem.contact(np.eye(6), [0.0, 0.0, 0.2, 0.0, 0.0, 0.2], mu=[0.5, 12.0])
    >>> [s.kind for s in lv.diagnose(problem)]
    ['friction', 'tangents first']
    """
    check_problem(problem)
    with np.errstate(all="ignore"):  # Comparisons with numbers beyond float64 are false.
        of_state = tuple(motion.diagnose_state(problem, velocity, gap, dt))
        solution = problem.guess if impulse is None else problem.make_start(impulse)
        cached = problem.derived.cache.get(__name__)
        if cached is None:
            cached = problem.derived.cache[__name__] = tuple(
                s for check in CHECKS for s in check(problem)
            )
        diagnostics = [*(replace(s, data=dict(s.data)) for s in cached), *of_state]
        if solution is not None:
            diagnostics += blocks.diagnose_impulses(problem, solution)
    return tuple(diagnostics)
