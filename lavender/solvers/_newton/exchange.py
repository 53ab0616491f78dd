"""Bounded rows: sweeps that guess which ones are free, and exchanges of those that are on the wrong side.

    F = {j: lower_j < (z - (H z - g))_j < upper_j},   H_FF z_F = g_F - H_FN z_N,   z_N at its bounds,   F anew, ...

Each exchange is a Newton step on the natural map and costs one factor: the primal-dual active set method
(Hintermueller, Ito, Kunisch 2002). From a few sweeps it takes one to seven where an interior point takes ten to twenty.
Where rows depend on each other it may go round in circles: it is given up where the contraction of the number of rows
c_k that change their side promises more steps than an interior point takes, or c_k stands still,

    k log(c_k) / log(c_0 / c_k)         exchanges left after the k-th                                   (1)
"""

from __future__ import annotations

from math import inf, log
from time import perf_counter
from typing import Any

from lavender._arrays import FloatArray
from lavender.registry import get
from lavender.solution import Status
from lavender.solvers._counts import newton_factor, newton_rates, sweep_cost
from lavender.solvers._newton.polish import EPS
from lavender.solvers._newton.run import Run
from lavender.solvers._newton.systems import System

__all__ = ["exchange", "sweep"]

SWEEPER = "anderson"
SHARE = 1.0  # of what a step costs, that sweeps may,
LEAST, MOST = 8, 1000  # and so many at least and at most
STEPS = 12  # factorisations of an interior point, as it usually takes
STILL = 4  # exchanges in a row after which no fewer rows change than before
CLOCK = 0.01  # s between two looks at the clock


def step_cost(system: System) -> float:
    """One factor and what goes with it [ns]."""
    problem = system.sc.problem
    _, step, row = newton_rates(problem)
    return step + row * system.sc.m + newton_factor(system)


def sweep(run: Run, impulse: FloatArray) -> FloatArray:
    """z (mk,) after sweeps from an impulse (m,) that cost as much as a factor."""
    problem = run.system.sc.problem
    each = sweep_cost(problem)
    n = int(min(max(LEAST, SHARE * step_cost(run.system) / each), MOST))
    solver: Any = get(SWEEPER).load()()
    state = solver.prepare(problem)
    impulse = impulse.copy()
    # In short runs for the clock and Ctrl-C alone: cut anywhere, sweeps give the same bits.
    chunk = max(1, int(1e9 * CLOCK / each))
    for start in range(0, n, chunk):
        claim = solver.run(state, impulse, min(chunk, n - start), run.tol, None)
        run.sweeps += claim.iterations
        if claim.status is not Status.MAX_ITERATIONS or perf_counter() >= run.deadline:
            break
    run.stages["sweeps"] = run.sweeps
    return run.system.sc.unknown(impulse)


def exchange(run: Run, z: FloatArray) -> None:
    """Exchanges from z until the judge is content, nothing changes, or (1) promises too little."""
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
            if relative < best:
                best, kept, judged = relative, steps.z.copy(), False
            changed = steps.changed
            still = 0 if changed < fewest else still + 1
            fewest = min(fewest, changed)
            ended = changed == 0 or still >= STILL or _left(first, changed, done) > STEPS
            if best > run.tol and ended:
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
