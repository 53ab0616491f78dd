"""Chunks, clock, history and Ctrl-C around one solver's `run`, and the best of what came of it.

A chunk lasts about 10 ms. Chunks do not change the result, because every solver checks convergence at fixed numbers
of iterations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import CHUNK_TIME, Deadline, Stopwatch
from lavender.base.errors import BREAKDOWN, format_error
from lavender.judge.residuals import (
    Residual,
    best_of_islands,
    find_stored,
    judge_impulse,
    residual,
    store_result,
)
from lavender.judge.solution import (
    INTERRUPTED,
    MAX_ITERATIONS,
    NUMERICAL_ERROR,
    STALLED,
    TIME_LIMIT,
    Claim,
    History,
    summed,
)
from lavender.problem import Problem
from lavender.problem.cones import project
from lavender.solvers.registry import Solver, State
from lavender_ext.judge.measure import same_bits
from lavender_ext.judge.watch import Watch

LEAST = 1e-6  # s, what is left of a limit for a solver that is called at all
SHARE = 0.7  # of what is left, for a chunk at the pace of the last
FIRST_CHUNK = 256  # iterations: 10 ms at 40 us each, slower than any compiled sweep of few rows
Callback = Callable[[int, FloatArray, Residual], Any]
Record = tuple[int, float, float, float, float]  # iterations, s, relative, energy, velocity
BOUND_ROUNDING = (
    1e-12  # Impulses closer to their bounds than this share are within them: projections round as much.
)
NOTHING_DONE = Claim(MAX_ITERATIONS, 0)


@dataclass
class Loop:
    """Chunks, clock, history and Ctrl-C around one solver's `run`."""

    problem: Problem
    solver: Solver
    state: Any
    impulse: FloatArray  # (m,) N s, in place
    tol: float
    deadline: Deadline
    callback: Callback | None = None
    records: list[Record] | None = None
    time: float = 0.0  # s, of the solver alone
    done: int = 0  # iterations
    work: dict[str, int] = field(default_factory=dict)
    broken: bool = False  # the solver did not return
    next_record: int = 0  # iterations
    pace: float = inf  # s that an iteration takes at most, as counted; inf: the first one tells

    def run_once(self, max_iter: int) -> Claim:
        """In one call, of a solver that cannot be continued."""
        start_point = self.impulse.copy()
        watch = Stopwatch()
        try:
            try:
                claim = self.call(max_iter, self.deadline.remaining(LEAST))
            finally:
                self.time = watch.seconds
            if not self.broken:
                return claim
        except KeyboardInterrupt:
            claim = Claim(INTERRUPTED, 0, {}, "Ctrl-C")
        # It was in the middle of whatever it does.
        self.impulse[:] = best_of_islands(self.problem, (start_point,), (self.impulse,), self.tol)
        return claim

    def call(self, max_iter: int, time_limit: float | None) -> Claim:
        """Run at most so many iterations of the solver; an arithmetic breakdown becomes a claim."""
        try:
            return self.solver.run(self.state, self.impulse, max_iter, self.tol, time_limit)
        except BREAKDOWN as error:
            self.broken = True
            return Claim(NUMERICAL_ERROR, 0, {}, format_error(error))

    def run(self, max_iter: int) -> Claim:
        """In chunks; the result is the best of what was checked."""
        claim = self.chunks(max_iter)
        self._keep_best()
        return claim

    def chunks(self, max_iter: int) -> Claim:
        """So many iterations in all, or fewer where the solver, the clock, the callback or Ctrl-C ends them."""
        # About a nanosecond per unit of work: the first guess, then measured. Capped, for solvers in Python.
        chunk = min(FIRST_CHUNK, max(1, int(CHUNK_TIME * 1e9) // max(1, self.problem.metric.work)))
        records = self.records is not None or self.callback is not None
        claim = NOTHING_DONE
        if self.deadline.is_set:
            chunk = max(1, min(chunk, int(self._aim() / self.pace)))
        try:
            if self.deadline.is_set:
                watch = Stopwatch()
                self.solver.set_deadline(self.state, self.deadline)
                self.time += watch.seconds
            if records and self._record():
                return self._total(Claim(INTERRUPTED, 0, {}, "stopped by the callback"))
            while self.done < max_iter:
                n = min(chunk, max_iter - self.done)
                if records:
                    n = min(n, self.next_record - self.done)
                watch = Stopwatch()
                claim = self.call(n, None)
                elapsed = watch.seconds
                self.time += elapsed
                self.done += claim.iterations
                self.work = summed((self.work, claim.work))
                stopped = records and self.done == self.next_record and self._record()
                if claim.status is not MAX_ITERATIONS:
                    break
                if claim.iterations < 1:
                    claim = Claim(STALLED, 0, {}, f"did none of the {n} iterations that it was asked for")
                    break
                if stopped:
                    claim = Claim(INTERRUPTED, 0, {}, "stopped by the callback")
                    break
                # What is more than half over is not begun.
                if self.deadline.passed(0.5 * elapsed / claim.iterations):
                    claim = Claim(TIME_LIMIT, 0, {}, claim.message)
                    break
                if self.done < max_iter:
                    chunk = self._next_chunk(n, elapsed)
        except KeyboardInterrupt:
            claim = Claim(INTERRUPTED, 0, {}, "Ctrl-C")
        return self._total(claim)

    def _next_chunk(self, n: int, elapsed: float) -> int:
        return max(1, min(8 * n, int(n * self._aim() / max(elapsed, 1e-7))))

    def _aim(self) -> float:
        left = self.deadline.remaining()
        return CHUNK_TIME if left is None else min(CHUNK_TIME, SHARE * left)

    def not_worse(self, start: FloatArray, or_zero: bool = True) -> None:
        """Keep the best of the result, the start and, with `or_zero`, the zero impulse in each island.

        A result that meets tol stays as it is.
        """
        problem = self.problem
        found = find_stored(problem, self.impulse) or judge_impulse(problem, self.impulse.copy())
        if found.relative > self.tol:
            found = best_of(problem, found, start, self.tol, or_zero)
        store_result(problem, found)
        self.impulse[:] = found.impulse

    def _keep_best(self) -> None:
        # A solver whose residual may rise keeps its best checked iterate; a budget (tol = 0) means the last one.
        if self.tol == 0.0:
            return
        state: State = self.state
        watch = getattr(state, "watch", None)
        if isinstance(watch, Watch):
            # The rows of a state may be in another order than those of its problem.
            getattr(state, "keep_best", watch.keep_best)(self.impulse, self.tol)
            return
        best = getattr(state, "best", None)
        if best is None or best[1] is None:
            return
        last = find_stored(self.problem, self.impulse) or judge_impulse(self.problem, self.impulse.copy())
        if last.relative <= self.tol:
            store_result(self.problem, last)  # for the result
        else:
            self.impulse[:] = best_of_islands(self.problem, (best[1],), (self.impulse,), self.tol)

    def _record(self) -> bool:
        r = residual(self.problem, self.impulse, "float64")
        if self.records is not None:
            self.records.append((self.done, self.time, r.relative, r.energy, r.velocity))
        self.next_record = self.done + max(1, self.done >> 3)  # 1, 2, ... 16, then an eighth more each time
        return bool(self.callback(self.done, self.impulse.copy(), r)) if self.callback is not None else False

    def _total(self, claim: Claim) -> Claim:
        if claim.iterations == self.done and claim.work == self.work:
            return claim  # of a single chunk
        return replace(claim, iterations=self.done, work=self.work)

    def recorded(self) -> History | None:
        """The history, where one was asked for."""
        if self.records is None:
            return None
        if not self.records or self.records[-1][0] != self.done:
            self._record()
        columns = list(zip(*self.records, strict=True))
        return History(np.array(columns[0], np.int64), *(np.array(c, float) for c in columns[1:]))


def best_of(problem: Problem, found: Any, start: FloatArray | None, tol: float, or_zero: bool = True) -> Any:
    """Return a pass of the judge over the best of `found`, the start (m,) and the zero impulse in each island.

    What rounding alone keeps from tol is left as it is. An impulse outside its bounds is projected onto them first.
    """
    if found.above_floor <= tol:
        return found
    first, own = problem._start if start is None else start, found.impulse
    with np.errstate(all="ignore"):  # impulses that overflow are judged below
        inside = project(problem.cones, own)
    if not np.allclose(inside, own, rtol=BOUND_ROUNDING, atol=0.0):
        own = inside
    best = best_of_islands(problem, (first, problem._start) if or_zero else (first,), (own,), tol)
    return found if same_bits(best, found.impulse) else judge_impulse(problem, best)
