"""Bounded rows and the convex cone law: interior point and polish, and what follows where those stop short.

Rows that nearly depend on each other are asked through the augmented system (`_newton/augmented.py`); proximal
rounds end it, or find the certificate that there is no solution.
"""

from __future__ import annotations

import numpy as np

from lavender._arrays import FloatArray
from lavender.solvers._newton.augmented import WORTH, solve_augmented
from lavender.solvers._newton.interior_point import InteriorPoint
from lavender.solvers._newton.polish import polish
from lavender.solvers._newton.proximal import Proximal
from lavender.solvers._newton.run import Run
from lavender.solvers._newton.systems import DELTA

IPM_STEPS = 1000  # of one interior point at most, whatever the budget
IPM_PATIENCE = 15  # interior point steps that halve neither residual nor gap
HOLD = 0.1  # share of rows beyond their bounds up to which exchanging those is worth a try,
FEW = 64  # or rows up to which it always is
REFINEMENTS = 3
FIRST = 1e-2  # relative residual of the first polish of an interior point; the next at each decade
SETTLED = (
    0.0025  # share of rows that may change their side in the step after which one polish is tried sooner
)
CLOSE = 1e-6  # relative residual from which rounding is what holds an interior point up,
STILL = 3  # where so many steps do not halve it
# Proximal weight on cones: their scaling spans more than that of rows, and what N loses to rounding is 2^-53 over
# it (measured on a redundant pyramid: 3e-8 is the end at 1e-10, 4e-10 at 1e-8, and 1e-6 costs a step more).
CONE_DELTA = 1e-8


def solve_convex(run: Run, z: FloatArray, cold: bool) -> None:
    """Warm start, then H z = g on every row, then an interior point and its polish."""
    system = run.system
    sc = system.sc
    rows = len(sc.kind) == sc.m
    if not cold:
        polish(run, z, patience=1)
        if run.done():
            return
    ip = InteriorPoint(system, DELTA if rows else CONE_DELTA, apart=sc.problem.is_symmetric)
    tried = not rows or _everything(run, ip)
    if not run.done():
        _interior(run, ip, rows)
    if run.done() or run.at_floor():
        return
    if not tried:
        # An asymmetric A may hold an interior point up at once where exchanging rows ends it.
        polish(run, ip.everything, patience=1, limit=3)
        if run.done() or run.at_floor():
            return
    if not rows:
        # Where the weight itself is what is in the way (large faces, most of whose points carry nothing).
        _interior(run, InteriorPoint(system, DELTA, sc.problem.is_symmetric), rows)
        if run.done() or run.at_floor():
            return
    if run.best < WORTH:
        solve_augmented(run)
        if run.at_floor():
            return
    if not run.done():
        Proximal(run.best_z.copy(), alpha=1e-3).advance(run)


def _everything(run: Run, ip: InteriorPoint) -> bool:
    """H z = g where nearly every row holds; whether it was pursued."""
    system, sc = run.system, run.system.sc
    z = ip.everything
    wrong = np.count_nonzero((z < sc.lower) | (z > sc.upper))
    if wrong == 0 and system.form == "impulse":
        # The weight of the first point goes away with the factor that is there; another costs more.
        left = sc.g - system.times(z)
        size = float(np.sqrt(left @ left))
        for _ in range(REFINEMENTS):
            z = z + system.solve_barrier(left)
            run.count("refinements")
            left = sc.g - system.times(z)
            before, size = size, float(np.sqrt(left @ left))  # |F| where every row still holds
            if not size < 0.1 * before or run.relative(size, 0.0) <= 1e-3 * run.tol:
                break
        if run.relative(size, 0.0) <= run.tol and run.score(z) <= run.tol:
            return True
    worth = bool(sc.m <= FEW or wrong <= HOLD * sc.m)
    if worth and not run.done():
        polish(run, z, patience=1, limit=3)
    return worth


def _interior(run: Run, ip: InteriorPoint, rows: bool) -> None:
    """Steps until the judge is content or they get nowhere; rows are polished at each new decade, cones at the end."""
    trigger, untried = FIRST, True
    lowest, idle, still, kept = np.inf, 0, 0, ip.z.copy()
    try:
        for _ in range(IPM_STEPS):
            if run.done() or not ip.step():
                break
            run.count("interior point steps")
            relative = run.error(ip)
            gains = relative < 0.5 * lowest
            idle = 0 if gains or ip.gap < 0.5 * ip.lowest_gap else idle + 1
            still = 0 if gains else still + 1
            if relative < lowest:
                lowest = relative
                kept[:] = ip.z
            if relative <= run.tol and run.score(ip.z) <= run.tol:
                return
            settled = untried and ip.changed is not None and ip.changed <= SETTLED * len(kept)
            if rows and (relative < trigger or settled):
                untried, trigger = False, min(FIRST, 0.1 * relative)
                polish(run, ip.z.copy())
                trigger = min(trigger, 0.1 * run.best) if run.best < 1e-6 else trigger
                if run.done() or run.at_floor():
                    return
            if (
                idle > IPM_PATIENCE
                or (still >= STILL and lowest < CLOSE)
                or ip.length < 1e-6
                or ip.gap < 1e-24 * ip.first_gap
            ):
                break
    finally:
        if lowest < run.best:
            run.score(kept)
    if not rows and lowest < CLOSE and not run.done() and not run.at_floor():
        Proximal(kept.copy(), alpha=min(1e-4, lowest), probed=0.0).advance(run, 12)
