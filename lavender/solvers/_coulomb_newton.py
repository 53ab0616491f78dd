"""Coulomb friction by Newton's method: convex start, Alart-Curnier map, De Saxce's fixed point.

    convex    K* contains u, r in K:               what the "cone" law solves
    Coulomb   K* contains u + mu |u_t| n, r in K   (De Saxce, Feng 1998)

so the Coulomb answer is the convex answer of the problem whose normal rhs is lowered by mu |u_t|.
"""

from __future__ import annotations

import numpy as np

from lavender._arrays import FloatArray
from lavender.cones import ROW
from lavender.solvers._ipm import AUGMENTED
from lavender.solvers._polish import EnergyRun, Run, proximal_newton, solve_convex

CONVEX_TOL = 1e-4  # of the convex start, in energy
OUTER = 30  # fixed points at most


def solve_coulomb(run: Run, z: FloatArray, cold: bool) -> None:
    """From the warm start, then from the convex answer, then from De Saxce's fixed points."""
    if not cold:
        proximal_newton(run, z, AUGMENTED, alpha=1e-4, limit=30)
        if run.done or run.at_floor():
            return
    system = run.system
    g = system.sc.g
    plain = g.copy()
    point = z
    try:
        for outer in range(OUTER):
            convex = EnergyRun(system, CONVEX_TOL * 0.1**min(outer, 4), run.budget, run.deadline)
            solve_convex(convex, point, cold=outer == 0)
            point = convex.best_z
            g[:] = plain
            run.log.append(f"convex {convex.best:.0e}")
            run.score(point)
            if run.done:
                return
            proximal_newton(run, point.copy(), AUGMENTED, alpha=1e-4, limit=60)
            if run.done or run.at_floor():
                return
            _lower_normals(run, plain, point)
    finally:
        g[:] = plain


def _lower_normals(run: Run, plain: FloatArray, z: FloatArray) -> None:
    # g_n <- g_n - a |s_t| - a_s |s_s| in scaled units
    sc = run.system.sc
    s = run.system.times(z) - plain
    for i in np.flatnonzero(sc.kind != ROW):
        j, end = sc.ptr[i], sc.ptr[i + 1]
        spin = sc.kind[i] == 2
        t = s[j + 1 : end - spin]
        sc.g[j] = plain[j] - sc.a_t[i] * np.sqrt(t @ t) - (sc.a_s[i] * abs(s[end - 1]) if spin else 0.0)
