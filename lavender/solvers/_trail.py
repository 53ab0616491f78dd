"""What `auto` did to a problem so far: the best impulse, what ran, what it cost, and what there is to choose from."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from time import perf_counter
from typing import Any

import numpy as np

from lavender._arrays import FloatArray, IntArray
from lavender.errors import SolverUnavailable, UnknownName
from lavender.problem import Problem
from lavender.registry import SolverSpec, get
from lavender.residuals import at_floor, known, quick, reference
from lavender.solution import Claim
from lavender.solvers._costs import Costs
from lavender.solvers._counts import islands_cost
from lavender.solvers._few import said
from lavender.solvers._islands import islands

__all__ = ["CLOCK", "Trail", "usable"]

CAUTION = 0.999  # of what is left of the tolerance: sums are rounded
CLOCK = 0.01  # s between two looks at the clock, at a nanosecond for each unit of work


@dataclass
class Trail:
    """What ran, what it cost, and the best impulse of one (sub)problem."""

    problem: Problem
    tol: float
    deadline: float
    limit: float = np.inf  # ns that the whole solve may take, as it was asked
    largest: int = 0  # velocities of the largest island, 0 where newton has no room for them
    kernel: Any = None  # newton over generalised velocities, prepared
    given: float = np.inf  # relative residual of the first impulse that was offered,
    best: float = np.inf  # and of the best
    impulse: FloatArray = field(init=False)
    steps: list[str] = field(default_factory=list)
    work: dict[str, int] = field(default_factory=dict)
    iterations: int = 0
    swept: FloatArray | None = None  # (m,) N s, where sweeps stopped
    certificate: FloatArray | None = None
    begun: bool = False  # newton over generalised velocities was
    ended: dict[str, float] = field(
        default_factory=dict
    )  # finite solvers that gave up: residual they started from

    # Finite solvers that go on where they stood: solver and state, and the impulse (m,) that goes with them.
    kept: dict[str, tuple[Any, Any]] = field(default_factory=dict)
    left: dict[str, FloatArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        m = self.problem.m
        self.costs = Costs(
            self.problem, self.tol, self.largest, 1 if self.kernel is None else self.kernel.islands
        )
        self.impulse = self.problem.start()
        self.w, self.e = np.empty(m), np.empty(m)

    def gave_up(self, key: str, before: float) -> None:
        """A finite solver ended, from the residual `before`, without being asked to."""
        self.ended[key] = before
        self.costs.gave_up(key)

    def offer(self, impulse: FloatArray) -> float:
        """Judge an impulse and keep it if it is the best."""
        found = known(self.problem, impulse)
        relative = quick(self.problem, impulse, self.w, self.e)[0] if found is None else found
        if self.given == np.inf:
            self.given = relative
        if relative < self.best:
            self.best, self.impulse = relative, impulse.copy()
        return relative

    @cached_property
    def islands(self) -> tuple[int, IntArray]:
        """How many, and the island of each block."""
        return islands(self.problem)

    def wrong_islands(self) -> tuple[IntArray, IntArray, float]:
        """Which islands miss their share of the whole tolerance, the island of each row (m,), and the share [sqrt J].

        Of the energy error each may have as much as makes the tolerance with those that have less,
        sum min(e_i, share)^2 = (tol E0)^2. A pair of tangents counts by its norm, at most sqrt(2) times its
        larger entry.
        """
        count, label = self.islands
        problem = self.problem
        energy, velocity = reference(problem)
        quick(problem, self.impulse, self.w, self.e)
        of_row = np.repeat(label, np.diff(problem.cones.ptr))
        own = np.bincount(of_row, problem.d * self.e**2, minlength=count)
        own[np.isnan(own)] = np.inf
        least = np.sort(own)
        below = np.concatenate([[0.0], np.cumsum(least[:-1])])
        level = ((self.tol * energy) ** 2 - below) / np.arange(count, 0, -1)
        above = np.flatnonzero(least > level)
        share = max(0.0, float(level[above[0]])) if len(above) else np.inf
        fast = np.zeros(count)
        np.maximum.at(fast, of_row, problem.metric.weight * np.abs(self.e))
        wrong = (own > share) | ~(np.sqrt(2.0) * fast <= self.tol * velocity)
        return (
            np.flatnonzero(wrong).astype(np.int32),
            of_row.astype(np.int32),
            CAUTION * float(np.sqrt(share)),
        )

    def apart_cost(self, those: IntArray | None = None) -> float:
        """Of the islands that are wrong, or of those given, each solved apart [ns]; inf where there is one island."""
        if self.islands[0] <= 1:
            return np.inf
        wrong, of_row, _ = self.wrong_islands()
        sizes = np.bincount(of_row, minlength=self.islands[0])
        return islands_cost(self.problem, sizes[wrong if those is None else those])

    @property
    def done(self) -> bool:
        return self.best <= self.tol or self.certificate is not None or self.late or self.at_floor()

    @property
    def late(self) -> bool:
        return perf_counter() >= self.deadline

    def late_by(self, cost: float) -> bool:
        """What is counted for so long [ns] would end after the deadline."""
        return perf_counter() + 1e-9 * cost > self.deadline

    def at_floor(self) -> bool:
        if self.best > 1e-5:
            return False
        return at_floor(*quick(self.problem, self.impulse, self.w, self.e, True))

    def add(self, name: str, claim: Claim) -> None:
        self.iterations += claim.iterations
        for kind, count in claim.work.items():
            self.work[kind] = self.work.get(kind, 0) + count
        self.steps.append(said(name, claim.work))


def usable(name: str, problem: Problem) -> SolverSpec | None:
    try:
        spec = get(name)
    except (UnknownName, SolverUnavailable):
        return None
    return spec if spec.refuses(problem) is None else None
