"""Sweeps under Coulomb's law between Newton's walks: they find which contacts stick, Newton's method what they carry.

`nncg` in both directions and `anderson` take turns, each from where it stood, or from the best point where that is far
better. A round costs as much as the factorisations so far, by counts of multiply-adds, and ends with a short walk.
"""

from __future__ import annotations

from functools import cached_property
from time import perf_counter
from typing import Any

import numpy as np

from lavender._arrays import FloatArray
from lavender.registry import get
from lavender.solution import Status
from lavender.solvers import _rates as rates
from lavender.solvers._counts import newton_factor, sweep_cost
from lavender.solvers._newton.desaxce import apart
from lavender.solvers._newton.proximal import Proximal
from lavender.solvers._newton.run import Run
from lavender.solvers._newton.systems import AUGMENTED, MatrixSystem, System

__all__ = ["Sweeping", "step_cost"]

# Solver, options, sweeps of one iteration, and iterations of a round at least.
METHODS: tuple[tuple[str, dict[str, Any], float, int], ...] = (
    ("nncg", {"order": "symmetric"}, 2.0, 100),
    ("anderson", {}, 1.0, 300),
)
MOST = 30_000  # iterations of a round at most
SHARE = 2.0  # of what the factorisations cost, that sweeps may
ANEW = 0.1  # of a method's own residual, that the best is below where it starts anew from there
WALK, STEPS = 6, 6  # factorisations after a round, and Newton steps of one of its proximal rounds
WEIGHT = 1e-6  # proximal weight there at most
HOPE = 0.5  # residual of the sweeps from which a walk gets nowhere
CLOCK = 0.01  # s between two looks at the clock


class _Method:
    """One of them: where it stands."""

    def __init__(self, name: str, options: dict[str, Any], times: float, least: int) -> None:
        self.name, self.options, self.times, self.least = name, options, times, least
        self.solver: Any = None
        self.state: Any = None
        self.impulse = np.empty(0)  # (m,) N s
        self.relative = np.inf  # its residual
        self.ended = False


class Sweeping:
    """Rounds of sweeps of one solve, from z (mk,) on."""

    def __init__(self, run: Run, z: FloatArray) -> None:
        self.run, self.start = run, z.copy()
        self.methods = [_Method(*m) for m in METHODS]
        self.rounds, self.spent = 0, 0.0  # ns
        self.factor_cost = step_cost(run.system)

    @cached_property
    def sweep_cost(self) -> float:
        """One sweep [ns]."""
        return sweep_cost(self.run.system.sc.problem)

    def round(self) -> bool:
        """One round; whether the judge is content, or nothing is left to do."""
        run = self.run
        method = self.methods[self.rounds % len(self.methods)]
        self.rounds += 1
        anew = run.best < ANEW * method.relative < np.inf
        if method.solver is None or anew:
            self._begin(method, run.best_z if anew else self.start)
        if not method.ended:
            z = self._sweep(method)
            if not run.done() and method.relative < HOPE and not run.at_floor():
                apart(run, Proximal(z, AUGMENTED, min(WEIGHT, method.relative), STEPS), WALK)
        return run.done() or run.at_floor()

    def _begin(self, method: _Method, z: FloatArray) -> None:
        sc = self.run.system.sc
        method.solver = get(method.name).load()(**method.options)
        method.state = method.solver.prepare(sc.problem)
        method.impulse = sc.impulse(z)
        method.ended = False

    def _sweep(self, method: _Method) -> FloatArray:
        run, each = self.run, method.times * self.sweep_cost
        paid = SHARE * run.system.factorisations * self.factor_cost - self.spent
        n = max(method.least, int(min(float(MOST), paid / each)))
        # In short runs for the clock and Ctrl-C alone: cut anywhere, sweeps give the same bits.
        chunk = max(1, int(1e9 * CLOCK / each))
        for start in range(0, n, chunk):
            claim = method.solver.run(method.state, method.impulse, min(chunk, n - start), run.tol, None)
            self.spent += claim.iterations * each
            run.sweeps += claim.work["sweeps"]
            method.ended = claim.status is not Status.MAX_ITERATIONS
            if method.ended or perf_counter() >= run.deadline:
                break
        run.count("rounds of sweeps")
        z = run.system.sc.unknown(method.impulse)
        method.relative = run.score(z)
        return z


def step_cost(system: System) -> float:
    """One step of Newton's method [ns], by the rates of `_rates.py`."""
    dense = isinstance(system, MatrixSystem) and system.dense
    factor = rates.DENSE * system.cost if dense else newton_factor(system)
    return rates.STEP["newton"] + rates.NEWTON_ROW["coulomb"] * system.sc.m + rates.UNSYMMETRIC * factor
