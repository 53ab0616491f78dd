"""What `auto` tries before anything is noted or counted closely; most problems end here.

    factors           bounded rows of a narrow band, joints                                           (`_at_once.py`)
    J and M           joints, where factors over the velocities fill; sweeps, where one body carries many bounded rows
                      or fill takes long to count; newton over the velocities where it costs next to nothing
    a first look      at sweeps                                                                       (`_sweepers.py`)
    few rows          of J and M under Coulomb's law: newton over the velocities

What did not end it is handed on: `Opening.trail`.
"""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np

from lavender._arrays import FloatArray
from lavender.problem import Problem
from lavender.registry import FEW
from lavender.solution import Claim, Status
from lavender.solvers import _rates as rates
from lavender.solvers._at_once import Factored, factor_first, joints_over_velocities
from lavender.solvers._first import general_first, general_second, general_steps, joints_before_count
from lavender.solvers._newton import general
from lavender.solvers._sweepers import SWEEPER, Glance, look_first
from lavender.solvers._trail import Trail
from lavender.solvers._turns import VELOCITY, note, velocities_left

__all__ = ["Opening"]


class Opening:
    """What `auto` tries first on `problem` from `impulse` (m,) [N s], in n iterations to `tol`; the end is put there.

    `failed`: few rows that the one compiled call did not end.
    """

    def __init__(
        self,
        problem: Problem,
        impulse: FloatArray,
        n: int,
        tol: float,
        time_limit: float | None,
        failed: bool,
    ) -> None:
        self.problem, self.impulse, self.n, self.tol = problem, impulse, n, tol
        self.time_limit, self.failed = time_limit, failed
        self.deadline = np.inf if time_limit is None else perf_counter() + time_limit
        self.first: Factored | None = None  # `direct` as it came first,
        self.fills = False  # or did not, since its factor fills
        self.glance: Glance | None = None  # sweeps
        self.kernel: Any = None  # newton over the velocities, None where it has no room
        self.newton: Claim | None = None  # and what it came to,
        self.lam = impulse.copy()  # (m,) N s, and where
        self.before: list[Claim] = []  # what ran before the last of these, in order

    def run(self) -> Claim | None:
        """The end, or None where it is not reached."""
        if self._is_factored(factor_first):
            return self._factored()
        if self.problem.generalized is not None and self.n > 0:
            end = self._velocities()
            if end is not None:
                return end
        if self.glance is None and self.first is None:
            left = self.n - (0 if self.newton is None else self.newton.iterations)
            self._look(left, largest=self.largest)
        end = self._swept()
        if end is None and self.newton is None and self.kernel is not None and general_second(self.problem):
            end = self._by_newton()
        return end

    @property
    def largest(self) -> int:
        """Velocities of the largest island, 0 where newton has no room for them."""
        return 0 if self.kernel is None else int(self.kernel.largest)

    def _velocities(self) -> Claim | None:
        """Newton over them ends nearly all robots: before it comes only what costs less than to know its own cost."""
        problem = self.problem
        known = problem.derived.first
        if known is False and self._is_factored(joints_over_velocities):
            return self._factored()
        bounded = problem.law == "lcp" and problem.m > FEW
        if bounded:
            self._look(self.n)
        if (end := self._swept()) is not None:
            return end
        kernel = general.looked_at(problem)
        if kernel.crowded:
            # Its factors fill so much that to count them takes longer than what may be the end.
            if known is None and joints_before_count(problem):
                known = False
                if self._is_factored(joints_over_velocities):
                    return self._factored()
            if bounded and self.glance is None:
                self._look(self.n, crowded=True)
                if (end := self._swept()) is not None:
                    return end
            assert problem.generalized is not None
            room = 1e-9 * rates.CROWDED * float(problem.generalized.nv) ** 2
            kernel = None if perf_counter() + room > self.deadline else general.prepare(problem)
        self.kernel = kernel if kernel is not None and kernel.fits else None
        if self.kernel is not None and (general_first(problem, self.largest) if known is None else known):
            return self._by_newton()
        if known is None and self._is_factored(joints_over_velocities):
            return self._factored()
        return None

    def _is_factored(self, begin: Any) -> bool:
        problem, tol = self.problem, self.tol
        self.first, self.fills = begin(problem, self.impulse, self.n, tol, self.time_limit)
        return self.first is not None and self.first.relative <= tol

    def _factored(self) -> Claim:
        assert self.first is not None
        return self._end(self.first.impulse, self.first.ended())

    def _look(self, n: int, crowded: bool = False, largest: int = 0) -> None:
        self.glance = look_first(
            self.problem, self.impulse, n, self.tol, self.failed, self.time_limit, crowded, largest
        )

    def _swept(self) -> Claim | None:
        if self.glance is None or not self.glance.best <= self.tol:
            return None
        return self._end(self.glance.impulse, self.glance.claim())

    def _by_newton(self) -> Claim | None:
        if self.glance is not None:
            self.before.append(self.glance.claim())
        left = None if np.isinf(self.deadline) else max(self.deadline - perf_counter(), 1e-3)
        swept = 0 if self.glance is None else self.glance.done
        steps = min(self.n - swept, general_steps(self.problem, self.kernel.islands))
        claim = general.run(self.problem, self.kernel, self.lam, steps, self.tol, left)
        if claim.status is Status.CONVERGED:
            return self._end(self.lam, general.named(claim, "auto"))
        self.newton = claim
        self.before.append(general.named(claim, "auto"))
        return None

    def _end(self, impulse: FloatArray, claim: Claim) -> Claim:
        self.impulse[:] = impulse
        for before in reversed(self.before):
            claim = _then(before, claim)
        return claim

    def trail(self) -> Trail:
        """What was tried, noted."""
        limit = np.inf if self.time_limit is None else 1e9 * self.time_limit
        trail = Trail(
            problem=self.problem, tol=self.tol, deadline=self.deadline, limit=limit, largest=self.largest,
            kernel=self.kernel,
        )  # fmt: skip
        trail.offer(self.impulse)
        if self.first is not None:
            note(trail, self.first.chosen, self.first.claim, self.first.impulse, self.first.before)
        if self.newton is not None:
            if len(self.before) > 1 and self.glance is not None:
                trail.add(SWEEPER, self.glance.claim())
                self.glance.told = self.glance.done
            trail.add("newton", self.newton)
            velocities_left(trail, self.newton, self.lam)
            if self.newton.status is not Status.MAX_ITERATIONS:
                trail.gave_up(VELOCITY, trail.best)
            if np.isfinite(self.lam).all():
                trail.offer(self.lam)
        return trail


def _then(first: Claim, second: Claim) -> Claim:
    """Of two solvers, one after the other."""
    work = dict(first.work)
    for kind, count in second.work.items():
        work[kind] = work.get(kind, 0) + count
    message = f"{first.message} -> {second.message}"
    return Claim(second.status, first.iterations + second.iterations, work, message)
