"""Newton's method on the natural map: the active-set polish, and the proximal point method around it.

    F(z) = z - Pi(z - (H z - g)) = 0,    (I - P + P H) dz = -F,    P in the derivative of Pi

For bounded rows P is 0 or 1: the identified rows are solved exactly, rows with the wrong sign change
sides, and so on: the primal-dual active set method (Qi, Sun 1993; Hintermueller, Ito, Kunisch 2002).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from time import perf_counter

import numpy as np

from lavender._arrays import FloatArray
from lavender.residuals import at_floor, check_certificate, quick, reference
from lavender.solvers._ipm import CONVEX, InteriorPoint, System, VelocitySystem

EPS = 1e-9  # proximal weight of the polish, relative to d; refinement takes it away again
INNER_STEPS = 20  # Newton steps of one proximal round at most
INNER_TOL = 0.1  # |F_c| at which a round ends, relative to its start
MEMORY = 6  # steps that the non-monotone line search looks back
CERTIFY = 1e-8  # relative residual below which there is a solution
PROBE = 1e-7  # proximal weight below which a round is as good as a plain Newton step
FREE = 20  # rounds in a row that cost no factorisation, and so change nothing but the weight
ALPHA_LOW = 1e-12  # proximal weight below which a factorisation sees none


@dataclass
class Run:
    """Budget, clock and best iterate of one solve; `score` is the judge's relative residual."""

    system: System
    tol: float
    budget: int  # factorisations
    deadline: float  # of perf_counter
    best: float = np.inf
    best_z: FloatArray = field(init=False)
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

    def error(self, ip: InteriorPoint) -> float:
        """Relative residual of an interior point of the convex law; the judge's where a step does not know it."""
        return self.score(ip.z) if ip.error is None else self.relative(*ip.error)

    def relative(self, energy: float, velocity: float) -> float:
        """Relative residual of the judge's two errors; inf where one is not finite."""
        energy_start, velocity_start = reference(self.system.sc.problem)
        energy = 0.0 if energy == 0.0 else energy / energy_start if energy_start > 0.0 else np.inf
        velocity = 0.0 if velocity == 0.0 else velocity / velocity_start if velocity_start > 0.0 else np.inf
        return max(energy, velocity) if energy + velocity < np.inf else np.inf

    def reached(self) -> bool:
        return self.best <= self.tol

    def spent(self) -> bool:
        """No budget or time for another factorisation, at about a nanosecond for each multiply-add."""
        if self.system.factorisations >= self.budget:
            return True
        return self.deadline < np.inf and perf_counter() + 1e-9 * self.system.cost >= self.deadline

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


def refined(system: System, rhs: FloatArray, rounds: int = 2) -> FloatArray:
    """Solve the Newton system with its proximal weight mostly refined away; the next Newton step does the rest."""
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


def polish(run: Run, z: FloatArray, law: int = CONVEX, *, patience: int = 2, limit: int = 12) -> None:
    """Newton steps from z until the judge is content or `patience` of them gain nothing."""
    system = run.system
    if law == CONVEX and isinstance(system, VelocitySystem) and system.newton is not None:
        _polish_rows(run, system, z, patience, limit)
        return
    f = np.empty_like(z)
    worse = 0
    best = run.score(z)
    for _ in range(limit):
        if run.done():
            return
        system.natural(z, system.times(z) - system.sc.g, law, EPS, f)
        system.factor_natural(EPS)
        run.count("polish steps")
        z = z + refined(system, -f)
        if not np.isfinite(z).all():
            return
        relative = run.score(z)
        if relative > 1e3 * best:
            return
        worse = 0 if relative < 0.5 * best else worse + 1
        best = min(best, relative)
        if worse >= patience or (worse and run.at_floor()):
            return


def _polish_rows(run: Run, system: VelocitySystem, z: FloatArray, patience: int, limit: int) -> None:
    """The same for bounded rows, a whole step in compiled code."""
    steps = system.newton
    best = relative = run.relative(*steps.place(z))
    worse, kept, judged = 0, z, False
    try:
        for _ in range(limit):
            if best <= run.tol:
                judged = True
                if run.score(kept) <= run.tol:
                    return
            if run.done():
                return
            system.factorisations += 1
            finite, energy, velocity = steps.newton(EPS, 2)
            run.count("polish steps")
            if not finite:
                return
            relative = run.relative(energy, velocity)
            if relative > 1e3 * best:
                return
            worse = 0 if relative < 0.5 * best else worse + 1
            if relative < best:
                best, kept, judged = relative, steps.z.copy(), False
            if worse >= patience:
                return
            if worse and best < 1e-5:
                judged = True
                run.score(kept)
                if run.at_floor():
                    return
    finally:
        if not judged:
            run.score(kept)


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
    probed: float = 1e-2
    stuck: bool = False

    def advance(self, run: Run, limit: int = 10_000) -> None:
        """Rounds until the judge is content, `limit` factorisations are spent, or nothing moves."""
        system = run.system
        last, free = system.factorisations + limit, 0
        run.score(self.z)
        while not run.done() and not self.stuck and system.factorisations < last:
            if run.best < self.probed and self.alpha > PROBE:
                # Near enough, plain Newton steps may end it: asked once for each decade.
                polish(run, run.best_z.copy(), self.law, limit=4)
                self.probed = 0.1 * run.best
                if run.done():
                    break
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
