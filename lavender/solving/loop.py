"""Call a solver's `run` in chunks, with clock, history and Ctrl-C, and select the best of its results.

A chunk lasts about 10 ms, under a time limit 1 ms. Chunks do not change the result, because every solver checks
convergence at fixed numbers of iterations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import CHUNK_TIME, LIMITED_CHUNK_TIME, NEVER, Deadline
from lavender.base.errors import BREAKDOWN, format_error
from lavender.judge.residuals import (
    Residual,
    combine_best_islands,
    judge_impulse,
    measure_residual,
    reuse_or_judge_impulse,
)
from lavender.judge.solution import (
    DIVERGED,
    INTERRUPTED,
    MAX_ITERATIONS,
    NUMERICAL_ERROR,
    STALLED,
    TIME_LIMIT,
    Claim,
    History,
    sum_work_counts,
)
from lavender.problem import Problem
from lavender.problem.cones import project_impulse
from lavender.solvers.registry import State
from lavender_ext.judge.measure import are_bit_identical
from lavender_ext.judge.stopping_test import LONG_RUN_SWEEPS, StoppingTest

MIN_TIME_LIMIT = 1e-6  # Smallest time limit [s] that is passed to a solver.
# Largest number of iterations of the first chunk: at 40 us per iteration, as of solvers in Python, it takes 10 ms.
FIRST_CHUNK_ITERATIONS = 256
FIRST_LIMITED_ITERATIONS = 16  # The same under a time limit.
# Under a time limit the first chunk is shorter by this factor, because a sweep may take 4 ns per unit of work.
LIMITED_CHUNK_MARGIN = 4
Callback = Callable[[int, FloatArray, Residual], Any]
# The fields are iterations, time [s], relative residual, energy error and velocity error.
Record = tuple[int, float, float, float, float]
# An impulse outside its bounds by up to this relative distance counts as inside; projections cause smaller errors.
BOUND_ROUNDING = 1e-12
EMPTY_CLAIM = Claim(MAX_ITERATIONS, 0)


def get_stopping_test(state: Any) -> StoppingTest | None:
    """Return the stopping test of a solver's state, which keeps the best iterates; None if it has none."""
    watch = getattr(state, "watch", None)
    return watch if isinstance(watch, StoppingTest) else None


@dataclass
class Loop:
    """Loop around one solver's `run`, with chunks, clock, history and Ctrl-C."""

    problem: Problem
    solver: Any
    state: Any  # State of the solver.
    impulse: FloatArray  # Start (m,) [N s]; replaced by the result in place.
    tol: float
    deadline: Deadline = NEVER
    callback: Callback | None = None
    records: list[Record] | None = None  # The history; None if it is not requested.
    # Solver of each record, if `auto` makes the records.
    record_solvers: list[str] = field(default_factory=list)
    time: float = 0.0  # [s] Time of the solver, without the judge.
    recording_time: float = 0.0  # [s] Time of the judge for the records.
    done: int = 0  # Number of iterations so far.
    work: Mapping[str, int] = field(default_factory=dict)  # Work so far, as in `Claim`.
    broken: bool = False  # Whether the solver raised an arithmetic error.
    next_record: int = 0  # Number of iterations at which the next record is made.
    judged: Any = None  # The judge's last pass over a result.

    def run_in_one_call(self, max_iter: int) -> Claim:
        """Run a solver that cannot be continued, in one call."""
        start_point = self.impulse.copy()
        begin = perf_counter()
        try:
            try:
                left = self.deadline.get_remaining_seconds(MIN_TIME_LIMIT)
                claim = self.call_solver(max_iter, left)
            finally:
                self.time = perf_counter() - begin - self.recording_time
            self.done = claim.iterations
            if not self.broken:
                return claim
        except KeyboardInterrupt:
            claim = Claim(INTERRUPTED, 0, {}, "Ctrl-C")
        # After an error, the array may contain an intermediate result: choose the best of it and the start.
        self.impulse[:] = combine_best_islands(self.problem, start_point, (self.impulse,), self.tol)
        return claim

    def call_solver(self, max_iter: int, time_limit: float | None) -> Claim:
        """Run at most `max_iter` iterations of the solver; an arithmetic error becomes a NUMERICAL_ERROR claim."""
        try:
            claim = self.solver.run(self.state, self.impulse, max_iter, self.tol, time_limit)
            self.judged = claim.judged
            return claim
        except BREAKDOWN as error:
            self.broken = True
            return Claim(NUMERICAL_ERROR, 0, {}, format_error(error))

    def run(self, max_iter: int) -> Claim:
        """Run in chunks; the result is the best of the iterates that the solver has checked."""
        claim = self.run_chunks(max_iter)
        if self.tol != 0.0:  # With tol = 0, the result is the last iterate.
            self._keep_best(claim)
        return claim

    def run_chunks(self, max_iter: int) -> Claim:
        """Run `max_iter` iterations in total, or fewer if the solver, the clock, the callback or Ctrl-C ends them."""
        # Assume 1 ns per unit of work for the first chunk, with a limit for solvers in Python; later chunks are
        # measured.
        deadline = self.deadline
        nanoseconds = int(1e9 * self._choose_chunk_time())
        first = FIRST_LIMITED_ITERATIONS if deadline.is_set else FIRST_CHUNK_ITERATIONS
        chunk = min(first, max(1, nanoseconds // max(1, self.problem.metric.work)))
        if deadline.is_set and self.done == 0:
            chunk = max(1, chunk // LIMITED_CHUNK_MARGIN)
        records = self.records is not None or self.callback is not None
        claim = EMPTY_CLAIM
        try:
            if deadline.is_set:
                begin = perf_counter()
                self.solver.set_deadline(self.state, deadline)
                self.time += perf_counter() - begin
            if records and self._record_residual():
                return self._add_to_total_work(Claim(INTERRUPTED, 0, {}, "stopped by the callback"))
            while self.done < max_iter:
                n = min(chunk, max_iter - self.done)
                if records:
                    n = min(n, self.next_record - self.done)
                begin = perf_counter()
                claim = self.call_solver(n, None)
                elapsed = perf_counter() - begin
                self.time += elapsed
                self.done += claim.iterations
                self.work = sum_work_counts((self.work, claim.work)) if self.work else claim.work
                stopped = records and self.done == self.next_record and self._record_residual()
                if claim.status is not MAX_ITERATIONS:
                    break
                if claim.iterations < 1:
                    claim = Claim(STALLED, 0, {}, f"did none of the {n} requested iterations")
                    break
                if stopped:
                    claim = Claim(INTERRUPTED, 0, {}, "stopped by the callback")
                    break
                if deadline.has_passed():
                    claim = Claim(TIME_LIMIT, 0, {}, claim.message)
                    break
                if self.done < max_iter:
                    chunk = self.choose_chunk_size(n, elapsed)
        except KeyboardInterrupt:
            claim = Claim(INTERRUPTED, 0, {}, "Ctrl-C")
        if claim.iterations == self.done and claim.work == self.work:
            return claim  # The claim of a single chunk needs no addition.
        return self._add_to_total_work(claim)

    def choose_chunk_size(self, n: int, elapsed: float) -> int:
        """Return the number of iterations of the next chunk, after n iterations in `elapsed` seconds."""
        return max(1, min(8 * n, int(n * self._choose_chunk_time() / max(elapsed, 1e-7))))

    def _choose_chunk_time(self) -> float:
        """Return the intended time of the next chunk [s]."""
        left = self.deadline.get_remaining_seconds()
        return CHUNK_TIME if left is None else min(LIMITED_CHUNK_TIME, left)

    def _is_long(self, claim: Claim) -> bool:
        """Return whether impulses that still grow at the end of a run may grow without end."""
        return claim.status in (DIVERGED, STALLED) or self.done >= LONG_RUN_SWEEPS

    def replace_by_best_impulse(self, start: FloatArray, claim: Claim) -> None:
        """Replace a result that does not meet tol by the best of result and start in each island."""
        problem = self.problem
        result = reuse_or_judge_impulse(problem, self.impulse, self.judged)
        if result.relative > self.tol:
            result = select_best_impulse(problem, result, start, self.tol, self._is_long(claim))
        self.judged = result
        self.impulse[:] = result.impulse

    def keep_start(self) -> None:
        """Judge the start, and let the zero impulse replace it as in a solve."""
        problem = self.problem
        if not are_bit_identical(self.impulse, problem._start):
            self.impulse[:] = combine_best_islands(problem, self.impulse, (), self.tol)
        self.judged = judge_impulse(problem, self.impulse.copy())

    def _keep_best(self, claim: Claim) -> None:
        """Replace the last iterate by the best checked iterate; a state's `best` that is no impulse does not count."""
        state: State = self.state
        watch = get_stopping_test(state)
        if watch is not None:
            # Use the state's own method if it has one, because its rows may have another order than the problem's.
            getattr(state, "keep_best", watch.keep_best)(self.impulse, self.tol)  # pyright: ignore[reportOptionalMemberAccess]
            return
        best = getattr(state, "best", None)
        if best is None or best[1] is None:
            return
        checked = np.asarray(best[1])
        is_impulse = checked.shape == self.impulse.shape and checked.dtype.kind in "iuf"
        if not is_impulse or not np.isfinite(checked).all():
            return
        checked = checked.astype(float)
        self.judged = reuse_or_judge_impulse(self.problem, self.impulse, self.judged)
        if self.judged.relative > self.tol:
            self.impulse[:] = combine_best_islands(
                self.problem, checked, (self.impulse,), self.tol, is_long=self._is_long(claim)
            )

    def _record_residual(self) -> bool:
        """Record the residual and call the callback; return whether the callback stops the solve."""
        begin = perf_counter()
        r = measure_residual(self.problem, self.impulse, "float64")
        if self.records is not None:
            self.records.append((self.done, self.time, r.relative, r.energy, r.velocity))
        self.recording_time += perf_counter() - begin
        # Record at 1, 2, ... 16 iterations, then after each eighth more.
        self.next_record = self.done + max(1, self.done >> 3)
        return (
            bool(self.callback(self.done, self.impulse.copy(), r))
            if self.callback is not None
            else False
        )

    def _add_to_total_work(self, claim: Claim) -> Claim:
        return replace(claim, iterations=self.done, work=self.work)

    def get_history(self) -> History | None:
        """Return the history, or None if it was not requested."""
        if self.records is None:
            return None
        solvers = self.record_solvers
        # `auto` returns the best impulse of all stages, which may differ from the last record.
        if solvers and self.records[-1][0] == self.done:
            self.records.pop()
        if not self.records or self.records[-1][0] != self.done:
            self._record_residual()
        if solvers:
            solvers = [*solvers, solvers[-1]][: len(self.records)]
        done, time, relative, energy, velocity = (
            np.array(c) for c in zip(*self.records, strict=True)
        )
        return History(
            iterations=done.astype(np.int64),
            time=time,
            relative=relative,
            energy=energy,
            velocity=velocity,
            solvers=tuple(solvers),
        )


def select_best_impulse(
    problem: Problem, result: Any, start: FloatArray | None, tol: float, is_long: bool = False
) -> Any:
    """Return the judged best of `result` and the start (m,) in each island; `is_long` as in `combine_best_islands`.

    A result that meets tol, or is at its round-off floor, is returned unchanged. An impulse outside its bounds is
    projected first.
    """
    if result.above_floor <= tol:
        return result
    first = problem._start if start is None else start
    own = result.impulse
    with np.errstate(all="ignore"):  # Projections of large impulses may overflow without a warning.
        inside = project_impulse(problem.cones, own)
    if not np.allclose(inside, own, rtol=BOUND_ROUNDING, atol=0.0):
        own = inside
    best = combine_best_islands(problem, first, (own,), tol, is_long=is_long)
    return result if are_bit_identical(best, result.impulse) else judge_impulse(problem, best)
