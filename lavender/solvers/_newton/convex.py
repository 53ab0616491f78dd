"""Bounded rows and the convex cone law: exchanges, interior points, and what follows where those stop short.

Rows that nearly depend on each other are asked through the augmented system (`_newton/augmented.py`); proximal
rounds end it, or find the certificate that there is no solution.
"""

from __future__ import annotations

import numpy as np

from lavender._arrays import FloatArray
from lavender.solvers._newton.augmented import WORTH, solve_augmented
from lavender.solvers._newton.interior_point import InteriorPoint
from lavender.solvers._newton.polish import exchange
from lavender.solvers._newton.proximal import Proximal
from lavender.solvers._newton.run import Run
from lavender.solvers._newton.systems import DELTA

IPM_STEPS = 1000  # of one interior point at most, whatever the budget
IPM_PATIENCE = 15  # interior point steps that halve neither residual nor gap
REFINEMENTS, CLEAR = 3, 1e-3  # of a first point, and share of the tolerance at which they end
FINER, MORE = 1e-12, 20  # weight of another factor of rows that all hold, and refinements with it
FIRST = 1e-2  # relative residual of the first polish of an interior point; the next at each decade
CLOSE = 1e-6  # relative residual from which rounding is what holds an interior point up,
STILL = 3  # where so many steps do not halve it
# Proximal weight on cones: their scaling spans more than that of rows, and what N loses to rounding is 2^-53 over
# it (measured on a redundant pyramid: 3e-8 is the end at 1e-10, 4e-10 at 1e-8, and 1e-6 costs a step more).
CONE_DELTA = 1e-8


def solve_convex(run: Run, z: FloatArray, cold: bool) -> None:
    """Rows: exchanges from the warm start and from H z = g. Cones, and what that leaves: interior points."""
    system = run.system
    if len(system.sc.kind) < system.sc.m:
        _solve_cones(run)
        return
    try:
        if not cold:
            _exchange(run, z)
        if not run.done() and not run.at_floor():
            _solve_rows(run)
    finally:
        run.take_back()


def _solve_rows(run: Run) -> None:
    """Exchanges from H z = g on every row; an interior point."""
    ip = InteriorPoint(run.system, apart=run.system.sc.problem.is_symmetric)
    _everything(run, ip)
    if not run.done():
        _exchange(run, ip.everything)
    if not run.done():
        _interior(run, ip, True)
    if not run.done() and not run.at_floor():
        run.take_back()
        _proximal(run)


def _exchange(run: Run, z: FloatArray) -> None:
    """Exchanges from z; what these leave unfinished is no start for what follows."""
    before = run.best, run.best_z
    exchange(run, z)
    if not run.done():
        run.set_aside(*before)


def _solve_cones(run: Run) -> None:
    """Interior points."""
    system = run.system
    symmetric = system.sc.problem.is_symmetric
    for delta in (CONE_DELTA, DELTA):
        # Where the weight itself is what is in the way (large faces, most of whose points carry nothing).
        _interior(run, InteriorPoint(system, delta, apart=symmetric), False)
        if run.done() or run.at_floor():
            return
    _proximal(run)


def _proximal(run: Run) -> None:
    if run.best < WORTH:
        solve_augmented(run)
        if run.at_floor():
            return
    if not run.done():
        Proximal(run.best_z.copy(), alpha=1e-3).advance(run)


def _everything(run: Run, ip: InteriorPoint) -> None:
    """H z = g on every row, refined where all of them hold."""
    system, sc = run.system, run.system.sc
    z = ip.everything
    linear = sc.problem.law == "linear"
    if not (linear or (system.form == "impulse" and np.all((z >= sc.lower) & (z <= sc.upper)))):
        return
    # The weight of the first point goes away with the factor that is there; another costs more.
    _refine(run, z, REFINEMENTS, 0.1)
    if linear and not run.done():
        # Rows that nearly depend on each other feel that weight: with next to none a factor is less exact, and
        # refinement mends that.
        system.v[:] = 1.0 / (sc.theta + FINER)
        system.factor_barrier()
        _refine(run, system.solve_barrier(sc.g), MORE, 1.0)


def _refine(run: Run, z: FloatArray, most: int, contraction: float) -> None:
    """z + (H + W)^-1 (g - H z) with the last factor, while that contracts what is left."""
    system, sc = run.system, run.system.sc
    left = sc.g - system.times(z)
    size, relative = float(np.sqrt(left @ left)), np.inf
    for _ in range(most):
        z = z + system.solve_barrier(left)
        run.count("refinements")
        left = sc.g - system.times(z)
        before, size = size, float(np.sqrt(left @ left))  # |F| where every row still holds
        relative = run.relative(size, float((sc.speed * np.abs(left)).max()))
        if not size < contraction * before or relative <= CLEAR * run.tol:
            break
    if relative <= run.tol:
        run.score(z)


def _interior(run: Run, ip: InteriorPoint, rows: bool) -> None:
    """Steps until the judge is content or they get nowhere; rows are polished at each new decade, cones at the end."""
    trigger = FIRST
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
            if rows and relative < trigger:
                trigger = 0.1 * relative
                exchange(run, ip.z.copy())
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
        Proximal(kept.copy(), alpha=min(1e-4, lowest)).advance(run, 12)
