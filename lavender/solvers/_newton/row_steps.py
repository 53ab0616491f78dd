"""Newton steps on the natural map of bounded rows, over a matrix; over bodies compiled code takes them."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender._arrays import FloatArray

__all__ = ["RowSteps", "refined"]


def refined(system: Any, rhs: FloatArray, rounds: int = 2) -> FloatArray:
    """Solve the Newton system with its proximal weight mostly refined away; the next Newton step does the rest."""
    x: FloatArray = system.solve_natural(rhs)
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


class RowSteps:
    """Steps of a matrix' system, as `Interior` of `lavender_ext/newton/fused_step.pyx` takes those over bodies."""

    def __init__(self, system: Any, law: int) -> None:
        self.system, self.law = system, law
        self.z: FloatArray = np.zeros(system.sc.m)
        self.hz, self.f = np.zeros_like(self.z), np.zeros_like(self.z)
        self.changed = 0  # rows that took another side in the last step

    def place(self, z: FloatArray) -> tuple[float, float]:
        """z as the point of `newton`: (|F|, velocity error)."""
        self.z = z.copy()
        return self._look()

    def newton(self, eps: float, rounds: int) -> tuple[bool, float, float]:
        """One Newton step: (whether it is finite, |F|, velocity error)."""
        system = self.system
        system.natural(self.z, self.hz - system.sc.g, self.law, eps, self.f)
        before, counted = self._side(), system.factorisations
        system.factor_natural(eps)
        system.factorisations = counted  # the caller counts it
        dz = refined(system, -self.f, rounds)
        finite = bool(np.isfinite(dz).all())
        if finite:
            self.z = self.z + dz
        error = self._look()
        self.changed = int(np.count_nonzero(self._side() != before))
        return finite, *error

    def _look(self) -> tuple[float, float]:
        system = self.system
        self.hz = system.times(self.z)
        energy = system.natural_size(self.z, self.hz - system.sc.g, self.law, self.f)
        return float(energy), float((system.sc.speed * np.abs(self.f)).max(initial=0.0))

    def _side(self) -> Any:
        sc = self.system.sc
        y = self.z - (self.hz - sc.g)
        return (y > sc.upper).astype(np.int8) - (y < sc.lower)
