"""Bounded rows and the convex cone law: interior point and polish, and what follows where those stop short.

Rows that nearly depend on each other are asked through the augmented system (`_augmented.py`); proximal
rounds end it, or find the certificate that there is no solution.
"""

from __future__ import annotations

import numpy as np

from lavender._arrays import FloatArray
from lavender.solvers._augmented import WORTH, solve_augmented
from lavender.solvers._ipm import InteriorPoint
from lavender.solvers._polish import Proximal, Run, polish

IPM_PATIENCE = 15  # interior point steps that halve neither residual nor gap


def solve_convex(run: Run, z: FloatArray, cold: bool) -> None:
    """Warm start, then H z = g on every row, then an interior point with a polish at each new decade."""
    system = run.system
    rows = len(system.sc.kind) == system.sc.m
    if not cold:
        polish(run, z, patience=1)
        if run.done():
            return
    ip = InteriorPoint(system)
    if rows:
        polish(run, ip.everything, patience=1, limit=3)
    trigger = 1e-2
    lowest, idle = np.inf, 0
    while not run.done():
        if not ip.step():
            break
        run.count("interior point steps")
        relative = run.score(ip.z)
        idle = 0 if relative < 0.5 * lowest or ip.gap < 0.5 * ip.lowest_gap else idle + 1
        lowest = min(lowest, relative)
        if idle > IPM_PATIENCE:
            break
        if relative < trigger:
            trigger = 0.1 * relative
            if rows:
                polish(run, ip.z.copy())
            else:
                Proximal(ip.z.copy(), alpha=min(1e-4, relative), probed=0.0).advance(run, 12)
            trigger = min(trigger, 0.1 * run.best) if run.best < 1e-6 else trigger
            if run.at_floor():
                return
        if ip.length < 1e-6 or ip.gap < 1e-24 * ip.first_gap:
            break
    if not run.done() and run.best < WORTH:
        solve_augmented(run)
        if run.at_floor():
            return
    if not run.done():
        Proximal(run.best_z.copy(), alpha=1e-3).advance(run)
