"""Budget, clock and best iterate of one solve by Newton's method."""

from __future__ import annotations

from dataclasses import dataclass, field
from time import perf_counter

import numpy as np

from lavender._arrays import FloatArray
from lavender.certificates import check_certificate
from lavender.residuals import at_floor, quick, reference, relative_of
from lavender.solvers._newton.interior_point import InteriorPoint
from lavender.solvers._newton.systems import System


@dataclass
class Run:
    """Budget, clock and best iterate of one solve; `score` is the judge's relative residual."""

    system: System
    tol: float
    budget: int  # factorisations
    deadline: float  # of perf_counter
    best: float = np.inf
    best_z: FloatArray = field(init=False)
    aside: tuple[float, FloatArray] | None = None  # a best point that is no start for what comes
    floor: float = 0.0
    stages: dict[str, int] = field(default_factory=dict)  # what ran, for the message
    certificate: FloatArray | None = None  # (m,) N s: no solution exists

    def __post_init__(self) -> None:
        m = self.system.sc.problem.m
        self.w, self.e = np.empty(m), np.empty(m)
        self.best_z = np.zeros(self.system.sc.m)

    def count(self, stage: str) -> None:
        self.stages[stage] = self.stages.get(stage, 0) + 1

    @property
    def message(self) -> str:
        return ", ".join(f"{n} {stage}" for stage, n in self.stages.items())

    def score(self, z: FloatArray) -> float:
        """Relative residual of z; keeps the best."""
        sc = self.system.sc
        relative, _ = quick(sc.problem, sc.impulse(z), self.w, self.e)
        if relative < self.best:
            self.best, self.best_z = relative, z.copy()
        return relative

    def set_aside(self, best: float, best_z: FloatArray) -> None:
        """Go on with an earlier best point; the one of now counts again in the end."""
        if self.best < best:
            self.aside = self.best, self.best_z
            self.best, self.best_z = best, best_z

    def take_back(self) -> None:
        """The best of all."""
        if self.aside is not None and self.aside[0] < self.best:
            self.best, self.best_z = self.aside

    def error(self, ip: InteriorPoint) -> float:
        """Relative residual of an interior point of the convex law; the judge's where a step does not know it."""
        return self.score(ip.z) if ip.error is None else self.relative(*ip.error)

    def relative(self, energy: float, velocity: float) -> float:
        """Relative residual of the judge's two errors; inf where one is not finite."""
        problem = self.system.sc.problem
        reference(problem)
        return relative_of(problem.metric, energy, velocity)

    def reached(self) -> bool:
        return self.best <= self.tol

    def spent(self) -> bool:
        """No budget or time for another factorisation, at the system's pace."""
        if self.system.factorisations >= self.budget:
            return True
        return self.deadline < np.inf and perf_counter() + self.system.seconds >= self.deadline

    def at_floor(self) -> bool:
        """The best point is within twice the floor."""
        if self.best > 1e-5:
            return False
        sc = self.system.sc
        relative, self.floor = quick(sc.problem, sc.impulse(self.best_z), self.w, self.e, True)
        return at_floor(relative, self.floor)

    def done(self) -> bool:
        return self.reached() or self.certificate is not None or self.spent()

    def certify(self, y: FloatArray) -> None:
        """Keep the direction y (scaled) if it proves that there is no solution."""
        sc = self.system.sc
        largest = float(np.abs(y).max(initial=0.0))
        if not 0.0 < largest < np.inf:
            return
        # Rounding leaves rows that do not take part slightly on the wrong side of their bounds.
        y = np.where(np.abs(y) > 1e-11 * largest, y / largest, 0.0)
        whole = np.zeros(sc.problem.m)
        whole[sc.keep] = y * sc.scale
        if check_certificate(sc.problem, whole) is None:
            self.certificate = whole
