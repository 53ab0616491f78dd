"""The log of one solve of `auto`: the best impulse, what ran, and when it has to end."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import NEVER, Deadline
from lavender.judge.certificates import check_certificate
from lavender.judge.residuals import (
    MAX_EXCUSED_RESIDUAL,
    best_of_islands,
    find_known_relative,
    find_stored,
    judge_impulse,
    store_result,
)
from lavender.judge.solution import Claim, SolverStage, Status, summed
from lavender.problem import Problem
from lavender.solvers.small import NO_TIME, NOTHING, told

__all__ = ["GAIN", "SolveLog"]

GAIN = 0.99  # of the residual, of which turns in vain leave more


class SolveLog:
    """What ran on a (sub)problem, what it cost, and the best impulse."""

    def __init__(self, problem: Problem, tol: float, budget: int, deadline: Deadline = NEVER) -> None:
        self.problem, self.tol, self.budget, self.deadline = problem, tol, budget, deadline
        self.interrupted = False
        self.failure = ""  # what broke down, in words
        self.timed_out = False  # it ended a little before the deadline, as the rest of the time was too short
        self.best, self.impulse = np.inf, problem._start  # lowest relative residual, (m,) N s
        self.result: FloatArray | None = None  # (m,) N s, while nothing met tol: the best of each island
        self.given: FloatArray | None = None  # (m,) N s, a start that is worse than doing nothing
        self.stages: list[SolverStage] = []
        self.work: dict[str, int] = {}
        self.iterations = 0
        self.certificate: FloatArray | None = None  # (m,)
        self.direction: FloatArray | None = None  # (m,) one that is none, but bounds the impulses
        self.conflict: Any = None  # of `certify`: who fights in the convex relaxation, and what lifts it

    def offer(self, impulse: FloatArray) -> None:
        """Judge an impulse (m,) and keep it in the islands where it is the best, also for the final judgement."""
        relative = find_known_relative(self.problem, impulse)
        if relative is None:
            last = judge_impulse(self.problem, impulse.copy())
            relative, impulse = float(last.relative), last.impulse
            if relative < self.best:
                store_result(self.problem, last)
        if relative < self.best:
            self.best, self.impulse = relative, impulse.copy()
        if self.best > self.tol:
            start = self.problem._start if self.result is None else self.result
            self.result = best_of_islands(self.problem, (start,), (impulse,), self.tol)

    def note(self, name: str, claim: Claim, before: float) -> None:
        """Record a turn that has ended; the residual was `before`."""
        self.iterations += claim.iterations
        self.work = summed((self.work, claim.work))
        self.stages.append(SolverStage(name, dict(claim.work), before, self.best))
        if claim.certificate is not None:
            if check_certificate(self.problem, claim.certificate, self.tol, self.deadline) is None:
                self.certificate = claim.certificate
            else:
                self.direction = claim.certificate
        if claim.status is Status.INTERRUPTED:
            raise KeyboardInterrupt

    # -- the end ---------------------------------------------------------------------------------

    @property
    def left(self) -> int:
        """Iterations that may still be done."""
        return self.budget - self.iterations

    @property
    def time_left(self) -> float | None:
        """s until the time limit, for a solver's `time_limit`."""
        return self.deadline.remaining(1e-5)

    def ends_late(self, cost: float) -> bool:
        """Whether a step of this counted cost [ns] would end after the deadline."""
        return self.deadline.passed(1e-9 * cost)

    @property
    def vain(self) -> bool:
        """The last turn gained next to nothing."""
        return bool(self.stages) and self.best > GAIN * self.stages[-1].before

    def done(self) -> bool:
        """Solved, proved infeasible, or out of time, iterations or progress."""
        return self.status not in (Status.STALLED, Status.NUMERICAL_ERROR)

    def at_floor(self) -> bool:
        if self.best > MAX_EXCUSED_RESIDUAL:
            return False
        last = find_stored(self.problem, self.impulse) or judge_impulse(self.problem, self.impulse)
        return bool(last.above_floor <= self.tol)

    @property
    def status(self) -> Status:
        if self.certificate is not None:
            return Status.INFEASIBLE
        if self.best <= self.tol:
            return Status.CONVERGED
        if self.at_floor():
            return Status.ROUNDOFF_LIMIT
        if self.timed_out or self.deadline.passed():
            return Status.TIME_LIMIT
        if self.left <= 0:
            return Status.MAX_ITERATIONS
        return Status.NUMERICAL_ERROR if self.failure else Status.STALLED

    def claim(self) -> Claim:
        """The claim of the whole solve."""
        status = self.status
        nothing = NOTHING.get(status, NO_TIME if self.budget > 0 else "no iterations were asked for")
        message = told(self.stages) or ("" if self.failure else nothing)
        return Claim(
            Status.INTERRUPTED if self.interrupted else status,
            self.iterations,
            self.work,
            "; ".join(filter(None, (message, self.failure, *self._fights()))),
            certificate=self.direction if self.certificate is None else self.certificate,
            stages=tuple(self.stages),
        )

    def _fights(self) -> list[str]:
        """Who fights in the relaxation, where Coulomb's law is not proved to have no solution, and what to do."""
        if self.conflict is None or self.best <= self.tol:
            return []
        told = (
            []
            if self.certificate is not None
            else ["of the convex relaxation, " + self.conflict.proof.message]
        )
        return [*told, self.conflict.advice]
