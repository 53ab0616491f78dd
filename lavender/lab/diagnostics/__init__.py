"""Possible mistakes in a problem's data, reported as suspicions and never as errors.

A solver converges on a problem with a normal that points the wrong way as on any other. `diagnose` checks relations
that hold in data of real bodies:

    centres     c_b - c_a = arm_a - arm_b, whatever contact of the pair says so; n points from a to b:
                n.(c_b - c_a) > 0 between bodies without hollows                                        (1)
    size        k^2 = tr(I) / 2m, the radius of gyration, is of the size of the arms                    (2)
    targets     target = b + J v*: zero on tangents, not negative where bodies overlap                  (3)
    speeds      v* is a velocity, not g = 9.81 m/s^2; targets and approaches are those of things that move (4)

Of J and M, (1) is known where contacts are of rigid bodies alone: six velocities, coupled to no other, of which three
have one mass, in the frame of the world: a row of direction d has J = (d, r x d) there, with the arm r.

Every threshold keeps a distance from the values in the built-in suite, the scenes of the gallery, robots and recorded
problems. If the numbers would be ordinary under another reading (M^-1 read as M), the suspicion says so.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lavender.lab.diagnostics import blocks, bodies, motion
from lavender.lab.diagnostics.diagnostic import Suspicion
from lavender.problem import Problem, check_problem

__all__ = ["Suspicion", "diagnose"]

CHECKS = (*blocks.CHECKS, *motion.CHECKS, *bodies.CHECKS, blocks.conflict)


def diagnose(
    problem: Problem, impulse: Any = None, *, velocity: Any = None, gap: Any = None, dt: float | None = None
) -> tuple[Suspicion, ...]:
    """Look for mistakes in a problem's data, or in the impulses that a solver found for it.

    Examines signs and order of normals, bodies and their sizes, masses, order of rows, targets, coefficients, keys and
    the guess. Of at most 1000 rows, it asks Newton's method for a proof that the convex relaxation has no solution, and
    names the blocks that fight. A suspicion need not be an error: a hook has normals against its arms, a conveyor has
    targets on tangents. An empty result proves nothing.

    Parameters
    ----------
    problem : Problem
    impulse : (m,) N s, optional
        A solution to examine; default: the problem's guess.
    velocity : (n, 6) of bodies, (nv,) of J and M, m/s and rad/s, optional
        Before the step. v* is held to it: it alone tells accelerations without their dt, or forgotten.
    gap : (n_contacts,) m, optional
        Between the surfaces of each contact, negative where they overlap; with `dt`. Targets are held to it: it alone
        tells their sign, and a dt too many or too few.
    dt : float, s, optional
        The step.

    Returns
    -------
    tuple of Suspicion
        Empty if nothing is suspicious.

    Raises
    ------
    InputError
        `problem` is not a Problem, an array has another shape, `gap` comes without `dt`, or either it or `velocity`
        with a matrix, which has no v*.

    Examples
    --------
    >>> import numpy as np
    >>> import lavender as lv
    >>> problem = lv.Problem.contact(np.eye(6), [0.0, 0.0, 0.2, 0.0, 0.0, 0.2], mu=[0.5, 12.0])
    >>> [s.kind for s in lv.diagnose(problem)]
    ['friction', 'tangents first']
    """
    check_problem(problem)
    state = motion.state_before(problem, velocity, gap, dt)
    given = problem.guess if impulse is None else problem.impulse_array(impulse)
    with np.errstate(all="ignore"):  # what is beyond float64 is no larger and no smaller than anything
        known = problem.derived.cache.get(__name__)
        if known is None:
            known = problem.derived.cache[__name__] = tuple(s for check in CHECKS for s in check(problem))
        found = [replace(s, data=dict(s.data)) for s in known]
        found += motion.stepped(problem, *state)
        if given is not None:
            found += blocks.wrong_impulses(problem, given)
    return tuple(found)
