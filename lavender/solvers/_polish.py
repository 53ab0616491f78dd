"""Active-set polish: Newton's method on the natural map, on convex problems.

    F(z) = z - Pi(z - (H z - g)) = 0,    (I - P + P H) dz = -F,    P in the derivative of Pi

For bounded rows P is 0 or 1: the identified rows are solved exactly, rows with the wrong sign change
sides, and so on: the primal-dual active set method (Qi, Sun 1993; Hintermueller, Ito, Kunisch 2002).
Each system carries a proximal weight eps that its iterative refinement takes away again, so rows that
depend on each other keep the impulses nearest to those they came with.
"""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import numpy as np

from lavender._arrays import FloatArray
from lavender.residuals import quick
from lavender.solvers._ipm import System

EPS = 1e-9  # proximal weight, relative to d


class Judge:
    """The judge's relative residual of z, and the best z so far."""

    def __init__(self, system: System) -> None:
        self.sc = system.sc
        self.problem = system.sc.problem
        self.w, self.e = np.empty(self.problem.m), np.empty(self.problem.m)
        self.best, self.best_z, self.floor = np.inf, np.zeros(system.sc.m), 0.0

    def __call__(self, z: FloatArray) -> float:
        relative, _ = quick(self.problem, self.sc.impulse(z), self.w, self.e)
        if relative < self.best:
            self.best, self.best_z = relative, z.copy()
        return relative

    def at_floor(self) -> bool:
        """The best point is within twice the floor."""
        relative, self.floor = quick(self.problem, self.sc.impulse(self.best_z), self.w, self.e, True)
        return relative <= 2.0 * self.floor


def refined(system: System, rhs: FloatArray, rounds: int = 8) -> FloatArray:
    """Solve the Newton system without its proximal weight, by refinement until it gains nothing."""
    x = system.solve_natural(rhs)
    size = float(np.abs(rhs).max(initial=0.0))
    last = np.inf
    for _ in range(rounds):
        r = rhs - system.natural_times(x)
        left = float(np.abs(r).max(initial=0.0))
        if not left < 0.5 * last or left <= 1e-16 * size:
            break
        last = left
        x = x + system.solve_natural(r)
    return x


def polish(
    system: System,
    judge: Judge,
    z: FloatArray,
    tol: float,
    budget: int,
    *,
    eps: float = EPS,
    patience: int = 3,
    deadline: float = np.inf,
    clock: Callable[[], float] = perf_counter,
) -> tuple[bool, int]:
    """Newton steps from z until the judge says tol; (reached, steps). The judge keeps the best point."""
    f = np.empty_like(z)
    worse = 0
    steps = 0
    relative = judge(z)
    while relative > tol and steps < budget and clock() < deadline:
        s = system.times(z) - system.sc.g
        system.natural(z, s, f, False, eps)
        if not system.factor_natural(eps):
            pass  # a lost pivot drops its direction; refinement tells whether it mattered
        steps += 1
        best = judge.best
        z = z + refined(system, -f)
        if not np.isfinite(z).all():
            break
        relative = judge(z)
        worse = 0 if relative < 0.5 * best else worse + 1
        if worse >= patience:
            break
    return judge.best <= tol, steps
