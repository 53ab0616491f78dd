"""Coulomb friction by Newton's method: convex start, Alart-Curnier map, De Saxce's fixed point.

    convex    K* contains u, r in K:               what the "cone" law solves
    Coulomb   K* contains u + mu |u_t| n, r in K   (De Saxce, Feng 1998)

so the Coulomb answer is the convex answer of the problem whose normal rhs is lowered by mu |u_t|.
"""

from __future__ import annotations

import numpy as np

from lavender._arrays import FloatArray
from lavender.cones import ROW
from lavender.solvers._ipm import AUGMENTED, InteriorPoint
from lavender.solvers._polish import EnergyRun, Proximal, Run, solve_convex

CONVEX_TOL = 1e-4  # of the convex start, in energy
STRETCH = 60  # factorisations between two looks at whether a method gets anywhere
LARGE = 1000  # rows from which the first proximal weight is larger
HEAVY = 1e3  # mass ratio from which the convex answer is asked first
OUTER = 30  # fixed points at most


def solve_coulomb(run: Run, z: FloatArray, cold: bool) -> None:
    """From the start, then from the convex answer, then from De Saxce's fixed points."""
    system = run.system
    plain = Proximal(z, AUGMENTED, 1e-3 if system.sc.m < LARGE else 1e-2)
    if not cold or not _is_heavy(run):
        plain.advance(run, STRETCH // 3)
        if run.done() or run.at_floor():
            return
        near = Proximal(InteriorPoint(system).everything, AUGMENTED, 1e-4)
        near.advance(run, STRETCH // 2)
        if run.done() or run.at_floor():
            return
        _pursue(run, plain)
    if run.done() or run.at_floor():
        return
    g = system.sc.g
    given = g.copy()
    point = run.best_z.copy()
    try:
        for outer in range(OUTER):
            convex = EnergyRun(system, CONVEX_TOL * 0.1 ** min(outer, 4), run.budget, run.deadline)
            solve_convex(convex, point, cold=outer == 0)
            point = convex.best_z
            g[:] = given
            run.count("convex starts")
            for stage, number in convex.stages.items():
                run.stages[stage] = run.stages.get(stage, 0) + number
            run.score(point)
            if run.done():
                return
            _pursue(run, Proximal(point.copy(), AUGMENTED, 1e-3))
            if run.done() or run.at_floor():
                return
            if not plain.stuck:
                plain.advance(run, STRETCH)
                if run.done() or run.at_floor():
                    return
            _lower_normals(run, given, point)
    finally:
        g[:] = given


def _pursue(run: Run, method: Proximal) -> None:
    # As long as each stretch brings the residual down to a third.
    while not run.done() and not method.stuck:
        before = run.best
        method.advance(run, STRETCH)
        if run.best > 0.3 * before or run.at_floor():
            return


def _is_heavy(run: Run) -> bool:
    rows = run.system.sc.problem.rows
    if rows is None:
        return False
    moving = rows.inv_mass[rows.inv_mass > 0.0]
    return len(moving) > 0 and bool(moving.max() >= HEAVY * moving.min())


def _lower_normals(run: Run, plain: FloatArray, z: FloatArray) -> None:
    # g_n <- g_n - a |s_t| - a_s |s_s| in scaled units
    sc = run.system.sc
    s = run.system.times(z) - plain
    for i in np.flatnonzero(sc.kind != ROW):
        j, end = sc.ptr[i], sc.ptr[i + 1]
        spin = sc.kind[i] == 2
        t = s[j + 1 : end - spin]
        sc.g[j] = plain[j] - sc.a_t[i] * np.sqrt(t @ t) - (sc.a_s[i] * abs(s[end - 1]) if spin else 0.0)
