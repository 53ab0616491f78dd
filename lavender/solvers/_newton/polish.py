"""Newton's method on the natural map: the active-set polish.

    F(z) = z - Pi(z - (H z - g)) = 0,    (I - P + P H) dz = -F,    P = 1 on rows inside their bounds, else 0

The identified rows are solved exactly, rows with the wrong sign change
sides, and so on: the primal-dual active set method (Qi, Sun 1993; Hintermueller, Ito, Kunisch 2002), whose steps are
exchanges here. Where rows depend on each other it may go round in circles: it is given up where the contraction of the
number of rows c_k that change their side promises more steps than an interior point takes, or c_k stands still,

    k log(c_k) / log(c_0 / c_k)         exchanges left after the k-th                                   (1)
"""

from __future__ import annotations

from math import inf, log

from lavender._arrays import FloatArray
from lavender.solvers._newton.run import Run

__all__ = ["STILL", "exchange"]

EPS = 1e-9  # proximal weight of the polish, relative to d; refinement takes it away again
STEPS = 12  # factorisations of an interior point, as it usually takes
NEAR = 1e-5  # relative residual from which a step that gains nothing may be at the floor
STILL = 4  # exchanges in a row after which no fewer rows change than before


def exchange(run: Run, z: FloatArray) -> None:
    """Exchanges of bounded rows from z until the judge is content, nothing changes, or (1) promises too little."""
    steps = run.system.newton
    best = run.relative(*steps.place(z))
    kept, judged = z, False
    first, done, fewest, still = 0, 0, inf, 0
    try:
        while True:
            if best <= run.tol:
                judged = True
                if run.score(kept) <= run.tol:
                    return
            if run.done():
                return
            run.system.factorisations += 1
            finite, energy, velocity = steps.newton(EPS, 2)
            run.count("exchanges")
            if not finite:
                return
            relative = run.relative(energy, velocity)
            gains = relative < 0.5 * best
            if relative < best:
                best, kept, judged = relative, steps.z.copy(), False
            changed = steps.changed
            still = 0 if changed < fewest else still + 1
            fewest = min(fewest, changed)
            # The same rows again: what is left of their weight is refined away, as long as that gains.
            ended = not gains if changed == 0 else still >= STILL or _left(first, changed, done) > STEPS
            if best > run.tol and ended:
                return
            if not gains and run.tol < best < NEAR:
                judged = True
                run.score(kept)
                if run.at_floor():
                    return
            first, done = first or changed, done + 1
    finally:
        if not judged:
            run.score(kept)


def _left(first: int, now: int, done: int) -> float:
    """(1); of rows that changed after `done` exchanges since the first."""
    if done == 0 or now <= 1:
        return 0.0
    return done * log(now) / log(first / now) if now < first else inf
