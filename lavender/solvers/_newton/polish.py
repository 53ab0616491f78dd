"""Newton's method on the natural map: the active-set polish.

    F(z) = z - Pi(z - (H z - g)) = 0,    (I - P + P H) dz = -F,    P in the derivative of Pi

For bounded rows P is 0 or 1: the identified rows are solved exactly, rows with the wrong sign change
sides, and so on: the primal-dual active set method (Qi, Sun 1993; Hintermueller, Ito, Kunisch 2002).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender._arrays import FloatArray
from lavender.solvers._newton.row_steps import refined
from lavender.solvers._newton.run import Run
from lavender.solvers._newton.systems import CONVEX

EPS = 1e-9  # proximal weight of the polish, relative to d; refinement takes it away again


def polish(run: Run, z: FloatArray, law: int = CONVEX, *, patience: int = 2, limit: int = 12) -> None:
    """Newton steps from z until the judge is content or `patience` of them gain nothing."""
    system = run.system
    if law == CONVEX and system.newton is not None:
        _polish_rows(run, system.newton, z, patience, limit)
        return
    f = np.empty_like(z)
    worse = 0
    best = run.score(z)
    for _ in range(limit):
        if run.done():
            return
        system.natural(z, system.times(z) - system.sc.g, law, EPS, f)
        system.factor_natural(EPS)
        run.count("polish steps")
        z = z + refined(system, -f)
        if not np.isfinite(z).all():
            return
        relative = run.score(z)
        if relative > 1e3 * best:
            return
        worse = 0 if relative < 0.5 * best else worse + 1
        best = min(best, relative)
        if worse >= patience or (worse and run.at_floor()):
            return


def _polish_rows(run: Run, steps: Any, z: FloatArray, patience: int, limit: int) -> None:
    """The same for bounded rows, a whole step in compiled code."""
    best = relative = run.relative(*steps.place(z))
    worse, kept, judged = 0, z, False
    try:
        for _ in range(limit):
            if best <= run.tol:
                judged = True
                if run.score(kept) <= run.tol:
                    return
            if run.done():
                return
            run.system.factorisations += 1
            finite, energy, velocity = steps.newton(EPS, 2)
            run.count("polish steps")
            if not finite:
                return
            relative = run.relative(energy, velocity)
            if relative > 1e3 * best:
                return
            worse = 0 if relative < 0.5 * best else worse + 1
            if relative < best:
                best, kept, judged = relative, steps.z.copy(), False
            if worse >= patience:
                return
            if worse and best < 1e-5:
                judged = True
                run.score(kept)
                if run.at_floor():
                    return
    finally:
        if not judged:
            run.score(kept)
