"""The proximal point method around Newton steps, with a non-monotone line search."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lavender._arrays import FloatArray
from lavender.solvers._newton.run import Run
from lavender.solvers._newton.systems import CONVEX

INNER_STEPS = 20  # Newton steps of one proximal round at most
INNER_TOL = 0.1  # |F_c| at which a round ends, relative to its start
MEMORY = 6  # steps that the non-monotone line search looks back
CERTIFY = 1e-8  # relative residual below which there is a solution
FREE = 20  # rounds in a row that cost no factorisation, and so change nothing but the weight
ALPHA_LOW = 1e-12  # proximal weight below which a factorisation sees none


@dataclass
class Proximal:
    """Proximal point with inner Newton: each round solves the problem of H + alpha, g + alpha c.

        F_c(z) = z - Pi(z - (H z - g) - alpha (z - c)),   c = z of the last round      (Rockafellar 1976)

    The inner problem is strongly monotone where H is monotone, its Newton system is factored with the
    proximal weight as it is, and steps pass a non-monotone line search on |F_c| (Grippo, Lampariello,
    Lucidi 1986). alpha falls the faster the shorter the rounds are, and rises where one fails.
    `advance` goes on from where it stands.
    """

    z: FloatArray
    law: int = CONVEX
    alpha: float = 1e-2
    inner: int = INNER_STEPS
    slowest: float = 0.1  # alpha falls at most by this factor; closer to 1 after a failure
    failures: int = 0
    idle: int = 0
    stuck: bool = False

    def advance(self, run: Run, limit: int = 10_000) -> None:
        """Rounds until the judge is content, `limit` factorisations are spent, or nothing moves."""
        system = run.system
        last, free = system.factorisations + limit, 0
        run.score(self.z)
        while not run.done() and not self.stuck and system.factorisations < last:
            before, start, centre = run.best, system.factorisations, self.z
            solved = self._round(run)
            if self.law == CONVEX and solved and run.best > 0.5 * before and run.best > CERTIFY:
                # Without a solution the rounds walk off along a direction that H does not see.
                run.certify(self.z - centre)
                if run.certificate is not None:
                    break
            used = system.factorisations - start
            run.count("proximal rounds")
            if run.best > 0.5 * before and run.at_floor():
                break
            self._adapt(solved, used, run.best > 0.5 * before or run.best == np.inf)
            free = free + 1 if used == 0 else 0
            self.stuck = self.stuck or free > FREE

    def _round(self, run: Run) -> bool:
        system, alpha, law = run.system, self.alpha, self.law
        g = system.sc.g
        z = c = self.z
        f = np.empty_like(z)
        hz = system.times(z)
        history: list[float] = []
        solved = False
        for _ in range(self.inner):
            size = system.natural(z, hz - g + alpha * (z - c), law, alpha, f)
            history.append(size)
            if (size <= INNER_TOL * history[0] and len(history) > 1) or size == 0.0:
                solved = True
                break
            if run.spent():
                break
            system.factor_natural(alpha)
            dz = system.solve_natural(-f)
            if not np.isfinite(dz).all():
                break
            hdz = system.times(dz)
            bound = max(history[-MEMORY:])
            best, t = (np.inf, 1.0), 1.0
            for _ in range(7):
                trial = z + t * dz
                value = system.natural_size(trial, hz + t * hdz - g + alpha * (trial - c), law, f)
                if value < best[0]:
                    best = (value, t)
                if value <= (1.0 - 1e-4 * t) * bound:
                    break
                t *= 0.5
            z = z + best[1] * dz
            hz = hz + best[1] * hdz
            if run.score(z) <= run.tol:
                break
        if solved or history[-1] <= history[0]:
            self.z = z
        return solved

    def _adapt(self, solved: bool, used: int, idle: bool) -> None:
        if solved:
            self.failures = 0
            fall = 0.05 if used <= 2 else 0.15 if used <= 4 else 0.4 if used <= 8 else 1.0
            fall = max(fall, self.slowest)
            if used <= 1 and self.slowest <= 0.1:
                fall = 2e-3  # a single step: the pieces are found, and only alpha is in the way
            self.alpha = max(ALPHA_LOW, self.alpha * fall)
            self.slowest = max(0.05, 0.5 * self.slowest)
            self.idle = self.idle + 1 if self.alpha == ALPHA_LOW and idle else 0
        else:
            self.failures += 1
            self.slowest = 0.2 if self.slowest < 0.2 else min(0.7, 2.0 * self.slowest)
            self.alpha *= 5.0
        self.stuck = self.idle > 3 or self.failures > 6 or self.alpha > 10.0
