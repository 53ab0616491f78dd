"""Log of one solve by `auto`: the best impulse, the stages that ran, the deadline, and the history."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from math import inf
from time import perf_counter
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.base.deadline import NEVER, Deadline
from lavender.judge.certificates import check_certificate
from lavender.judge.residuals import (
    MAX_EXCUSED_RESIDUAL,
    find_relative_at_zero,
    get_zero_impulse_reference,
    measure_residual,
    reuse_or_judge_impulse,
)
from lavender.judge.solution import Claim, SolverStage, Status, sum_work_counts
from lavender.problem import Problem
from lavender.problem.cones import project_impulse
from lavender.solvers.small import describe_stages
from lavender.solving.loop import EMPTY_CLAIM, Loop, Record
from lavender_ext.judge.measure import BestImpulse, are_bit_identical, residuals_by_island

# Key in `Derived.cache` of the problem's convex relaxation.
RELAXATION_KEY = "lavender.solving.log: relaxation"


def get_relaxation(problem: Problem) -> Problem:
    """Return the convex relaxation over the same arrays and references; it is cached with the problem."""
    relaxed: Problem | None = problem.derived.cache.get(RELAXATION_KEY)
    if relaxed is None:
        relaxed = problem.relaxed("cone")
        get_zero_impulse_reference(problem)
        relaxed.metric.share_reference(problem.metric)
        problem.derived.cache[RELAXATION_KEY] = relaxed
    return relaxed


class SolveLog:
    """Stages that ran on a problem, their work, the best impulse and the deadline."""

    def __init__(
        self,
        problem: Problem,
        tol: float,
        budget: int,
        deadline: Deadline = NEVER,
        first: Claim = EMPTY_CLAIM,
    ) -> None:
        """Begin the log; `first` is the claim of an earlier solve, whose work counts."""
        self.problem, self.tol, self.budget, self.deadline = problem, tol, budget, deadline
        self.interrupted = False
        self.failure = ""  # Message of the last arithmetic error.
        self.remark = ""  # Message of the solve of some islands.
        # A stage was left out or ended early, because the remaining time was too short.
        self.timed_out = False
        # Smallest relative residual, the impulse (m,) [N s] with this residual, and the judge's result if it is known.
        self.best = inf
        self.impulse = problem._start
        self.judged: Any = None
        self.start = problem._start, inf  # First impulse (m,) [N s], and its relative residual.
        self._best_islands: Any = (
            None  # `BestImpulse` from the start of the solve; None before a start is stored.
        )
        # Last impulse (m,) [N s] of the interior points on the convex relaxation, or None.
        self.relaxed: FloatArray | None = None
        self.stages: list[SolverStage] = list(first.stages)
        self.work: dict[str, int] = dict(first.work)
        self.iterations = first.iterations
        self.certificate: FloatArray | None = (
            None  # Proof (m,) that no solution exists, if one was found.
        )
        # Direction (m,) that gives a lower bound of every solution's impulse, but is not a certificate.
        self.direction: FloatArray | None = None
        self.conflict: Any = (
            None  # `certificates.Proof` that the convex relaxation has no solution.
        )
        self.recorder: Recorder | None = None  # Writes the history if one is requested.

    def start_from_better_impulse(self, start: FloatArray) -> None:
        """Store `start` (m,) [N s], and begin from the better of it and the zero impulse in each island."""
        get_zero_impulse_reference(
            self.problem
        )  # Then the zero impulse needs no pass of the judge.
        if not are_bit_identical(start, self.problem._start):
            self._best_islands = BestImpulse(self.problem.metric, start, self.tol)
            start = self._best_islands.begin
        self.impulse = start.copy()
        relative = find_relative_at_zero(self.problem, start)
        self.best = (
            float(measure_residual(self.problem, start).relative) if relative is None else relative
        )
        self.start = self.impulse, self.best

    @property
    def result(self) -> FloatArray:
        """Impulse (m,) [N s] with the best impulse of each island, until one impulse meets tol in all islands."""
        return self.impulse if self._best_islands is None else self._best_islands.impulse

    def store_last_impulse(self, judged: Any) -> None:
        """Store an impulse after which no other solver runs, with the judge's result, and not island by island."""
        self.best, self.impulse, self.judged = float(judged.relative), judged.impulse, judged

    def choose_result(self) -> FloatArray:
        """Return the impulse (m,) [N s] of the solve: one that meets tol, or the best one of each island.

        After a deadline, it is the start if the islands' best impulses together have a larger residual than the start.
        """
        if self.best <= self.tol:
            return self.impulse
        if self.timed_out or self.deadline.has_passed():
            start, at_start = self.start
            self.judged = reuse_or_judge_impulse(self.problem, self.result, self.judged)
            if not self.judged.relative <= at_start:
                return start
        return self.result

    def judge_and_store_best(self, impulse: FloatArray, judged: Any = None) -> None:
        """Judge an impulse (m,) [N s] and store it in the islands in which it is the best.

        `judged` is the judge's result if it is known.
        """
        relative = find_relative_at_zero(self.problem, impulse)
        is_known = relative is not None and self._best_islands is None
        if relative is None:
            last = reuse_or_judge_impulse(
                self.problem, impulse, self.judged if judged is None else judged
            )
            relative = float(last.relative)
            impulse = last.impulse
            if relative < self.best:
                self.judged = last
        if relative < self.best:
            self.best = relative
            self.impulse = impulse.copy()
        if self.best > self.tol and not is_known:
            if self._best_islands is None:
                self._best_islands = BestImpulse(self.problem.metric, self.problem._start, self.tol)
            # A step of Newton's method may leave the bounds.
            self._best_islands.store(project_impulse(self.problem.cones, impulse))

    def compare_with_relaxation(self, impulse: FloatArray) -> tuple[float, float]:
        """Return (ratio, residual) of an impulse (m,) [N s], the largest of all islands that are not solved.

        The ratio is the residual on the convex relaxation divided by that on Coulomb's law. The residual is relative,
        on Coulomb's law. Both are 0 if all islands are solved.
        """
        problems = self.problem, get_relaxation(self.problem)
        exact, relaxed = (residuals_by_island(p.metric, impulse)[1] for p in problems)
        unsolved = exact[:, 0] > self.tol
        ratio = float((relaxed[unsolved, 1] / exact[unsolved, 1]).max(initial=0.0))
        return ratio, float(exact[unsolved, 0].max(initial=0.0))

    def record_stage(self, name: str, claim: Claim, before: float) -> None:
        """Record a stage that has ended; the relative residual before it was `before`."""
        stage = SolverStage(name, dict(claim.work), before, self.best)
        is_proof = (
            claim.certificate is not None
            and check_certificate(self.problem, claim.certificate, self.tol, self.deadline) is None
        )
        self._add_claim(claim, (stage,), claim.certificate, is_proof)

    def record_part(self, claim: Claim, rows: IntArray) -> None:
        """Record the claim of a solve of some islands, with these row numbers."""
        remark = claim.message.removeprefix(describe_stages(claim.stages)).removeprefix("; ")
        if claim.status is Status.NUMERICAL_ERROR:
            self.failure = remark
        elif claim.stages:
            self.remark = remark
        direction = None
        if claim.certificate is not None:
            direction = np.zeros(self.problem.m)
            direction[rows] = claim.certificate
        self._add_claim(claim, claim.stages, direction, claim.status is Status.INFEASIBLE)

    def _add_claim(
        self,
        claim: Claim,
        stages: Iterable[SolverStage],
        direction: FloatArray | None,
        is_proof: bool,
    ) -> None:
        """Add the work, the stages and the direction (m,) of a claim."""
        self.iterations += claim.iterations
        self.work = sum_work_counts((self.work, claim.work))
        self.stages += stages
        if is_proof:
            self.certificate = direction
        elif direction is not None:
            self.direction = direction
        if claim.status is Status.INTERRUPTED:
            raise KeyboardInterrupt

    @property
    def remaining_iterations(self) -> int:
        """Number of iterations that the budget still allows."""
        return self.budget - self.iterations

    @property
    def time_left(self) -> float | None:
        """Time until the deadline [s], for a solver's `time_limit`; None if there is no limit."""
        return self.deadline.get_remaining_seconds(1e-5)

    def done(self) -> bool:
        """Return whether the problem is solved or proved infeasible, or no time or iterations remain."""
        return self.status not in (Status.STALLED, Status.NUMERICAL_ERROR)

    def is_at_floor(self) -> bool:
        """Return whether rounding explains the best residual: no solver can be expected to reach the tolerance."""
        if self.best > MAX_EXCUSED_RESIDUAL:
            return False
        self.judged = reuse_or_judge_impulse(self.problem, self.impulse, self.judged)
        return bool(self.judged.above_floor <= self.tol)

    @property
    def status(self) -> Status:
        """Status of the solve so far."""
        if self.certificate is not None:
            return Status.INFEASIBLE
        if self.best <= self.tol:
            return Status.CONVERGED
        if self.is_at_floor():
            return Status.ROUNDOFF_LIMIT
        if self.deadline.has_passed():
            return Status.TIME_LIMIT
        if self.remaining_iterations <= 0:
            return Status.MAX_ITERATIONS
        return Status.NUMERICAL_ERROR if self.failure else Status.STALLED

    def make_claim(self) -> Claim:
        """Return the claim of the complete solve."""
        status = self.status
        if self.timed_out and status in (Status.STALLED, Status.NUMERICAL_ERROR):
            status = Status.TIME_LIMIT
        messages = [
            describe_stages(self.stages),
            self.failure,
            self.remark,
        ]
        if self.conflict is not None and self.certificate is None and self.best > self.tol:
            messages.append("of the convex relaxation, " + self.conflict.message)
        return Claim(
            Status.INTERRUPTED if self.interrupted else status,
            self.iterations,
            self.work,
            "; ".join(filter(None, messages)),
            certificate=self.direction if self.certificate is None else self.certificate,
            stages=tuple(self.stages),
            judged=self.judged,
        )


@dataclass
class Recorder:
    """Writes the history of one solve: the residual after each recorded iteration of each stage.

    A stage of sweeps or of another resumable solver is recorded after 1, 2, ..., 16 iterations of the stage, and then
    each time after an eighth more. Newton's method, `direct` and the compiled call are recorded at their end. `solve`
    is the loop of the solve, which holds the records. Recording does not change the result.
    """

    solve: Loop
    begun: float = field(default_factory=perf_counter)  # [s] Time of its creation.

    @property
    def records(self) -> list[Record]:
        """The records so far."""
        assert self.solve.records is not None
        return self.solve.records

    @property
    def time(self) -> float:
        """Time of the solve without recording [s]."""
        return perf_counter() - self.begun - self.solve.recording_time

    def append_later_records(self, solver: str, records: Iterable[Record]) -> None:
        """Append the records with more iterations than the last one."""
        for record in records:
            if not self.records or record[0] > self.records[-1][0]:
                self.records.append(record)
                self.solve.record_solvers.append(solver)

    def record_impulse(self, solver: str, iterations: int, impulse: FloatArray) -> None:
        """Record an impulse (m,) [N s] after this number of iterations of all stages."""
        time = self.time
        begin = perf_counter()
        r = measure_residual(self.solve.problem, impulse, "float64")
        self.append_later_records(solver, [(iterations, time, r.relative, r.energy, r.velocity)])
        self.solve.recording_time += perf_counter() - begin

    def append_loop_records(self, solver: str, iterations: int, time: float, loop: Loop) -> None:
        """Append the records of a loop that began at this number of iterations and this time [s]."""
        self.solve.recording_time += loop.recording_time
        records = loop.records or ()
        self.append_later_records(
            solver, [(iterations + r[0], time + r[1], *r[2:]) for r in records]
        )
