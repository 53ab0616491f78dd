"""The solvers of `auto` as its tree runs them: so many iterations, then more from where they stopped."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import CHUNK_TIME, NEVER, Deadline, Stopwatch
from lavender.base.errors import BREAKDOWN, last_words
from lavender.judge.solution import Claim, Status
from lavender.problem import Problem
from lavender.solvers._accelerated import operator
from lavender.solvers.costs import SWEEPS, sweep_cost
from lavender.solvers.direct import Enough
from lavender.solvers.registry import get
from lavender.solvers.setup_times import forming
from lavender.solvers.solve_log import SolveLog
from lavender.solvers.sweeping import STATUS
from lavender_ext.small.checked_sweeps import CheckedSweeps, sweeps_left

__all__ = ["METHODS", "Direct", "Iterations", "Newton", "Step", "Sweeps", "made", "setup_time"]

NNCG: dict[str, Any] = {"order": "symmetric", "restart": "against"}
#: Solver and options of each step.
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "anderson": ("anderson", {}),
    "newton": ("newton", {}),
    "newton over rows": ("newton", {"form": "impulse"}),
    "direct": ("direct", {}),
    "nncg": ("nncg", NNCG),
    # On a loose pile: the convex relaxation has one answer, and where contacts stick it is Coulomb's.
    "nncg from the cone law": ("nncg", NNCG | {"convex": int(SWEEPS)}),
    "admm": ("admm", {}),
}
FIRST = 32  # sweeps before the first prediction of their remaining number
MOST = 2**30  # iterations of one call
NEAR = 0.02  # relative residual, up to which Newton's method under friction begins from another's impulse
PROBE = 0.5  # share of the time left that iterations of unknown pace may take
AT_MOST = 4.0  # times its count, that a sweep takes: of blocks that are solved exactly
FORMING = 4.0  # times what forming A takes, that has to be left for sweeps over it


def made(name: str, problem: Problem) -> Any:
    """The solver of a step."""
    solver, options = METHODS[name]
    if is_exact(problem) and "sweep" in get(solver).options:
        options = options | {"sweep": "blocks"}
    return get(solver).load()(**options)


def is_exact(problem: Problem) -> bool:
    """Sweeps solve each block exactly: under the cone law, and where a contact's rows may have unlike units."""
    return problem.law == "cone" or (problem.law == "coulomb" and problem.matrix is not None)


def setup_time(name: str, problem: Problem) -> float:
    """What a step sets up before its first iteration takes [s]; 0: next to nothing."""
    return float(made(name, problem).setup_time(problem))


class Step:
    """A solver on the problem of a log."""

    over = late = False  # it has nothing more to do, or no time for it
    least = np.inf  # iterations that may be predicted to be left, and it goes on
    state: Any = None
    impulse: FloatArray  # (m,) N s

    def __init__(self, name: str, log: SolveLog) -> None:
        self.name, self.log = name, log
        self.solver = made(name, log.problem)

    def run(self, n: float) -> None:
        """At most n iterations, offered to the log."""
        log, before = self.log, self.log.best
        try:
            claim = self.turn(int(min(max(n, 1.0), log.left, MOST)))
        except BREAKDOWN as error:
            log.failure, self.over = last_words(error), True
            claim = Claim(Status.NUMERICAL_ERROR, 0)
        self.over = self.over or claim.status is not Status.MAX_ITERATIONS
        self.late = claim.status is Status.TIME_LIMIT
        log.note(self.name, claim, before)

    def turn(self, n: int) -> Claim:
        """Run and offer what came of it."""
        raise NotImplementedError

    def offer(self) -> None:
        """The iterate, to the log."""
        if np.isfinite(self.impulse).all():
            self.log.offer(self.impulse)


class Newton(Step):
    """From the state whose factor was counted; from doing nothing under friction of which sweeps left much, and once
    more if it ends in vain.
    """

    anew = lost = False

    def run(self, n: float) -> None:
        log, done = self.log, self.log.iterations
        super().run(n)
        if self.lost and not self.anew and not log.done():
            self.anew, self.over, self.state.begun = True, False, False
            super().run(n - (log.iterations - done))

    def turn(self, n: int) -> Claim:
        log = self.log
        if not self.state.begun:
            far = log.best > NEAR and log.problem.law in ("coulomb", "cone")
            self.impulse = log.problem.start() if self.anew or far else log.impulse.copy()
            self.anew = not (self.impulse - log.problem.start()).any()
        claim = self.solver.turn(self.state, self.impulse, n, log.tol, log.time_left, log.left)
        self.lost = claim.status is Status.STALLED
        self.offer()
        return claim


class Direct(Step):
    """A linear system is solved no closer than tol."""

    def turn(self, n: int) -> Claim:
        log = self.log
        if self.state is None:
            if log.problem.law == "linear":
                self.solver = Enough()
            self.state, self.impulse = self.solver.prepare(log.problem), log.impulse.copy()
        claim = self.solver.run(self.state, self.impulse, n, log.tol, log.time_left)
        self.offer()
        return claim


class Iterations(Step):
    """A solver that continues to the bit: in short runs, for the clock and Ctrl-C."""

    def turn(self, n: int) -> Claim:
        done, work = 0, dict[str, int]()
        if self.state is None:
            self.begin()
        self.each = 2e-9 * sweep_cost(self.log.problem)
        status = Status.MAX_ITERATIONS
        while done < n and status is Status.MAX_ITERATIONS and not self.log.late:
            claim = self.some(done, n)
            done, status = done + claim.iterations, claim.status
            for kind, count in claim.work.items():
                work[kind] = work.get(kind, 0) + count
            if claim.iterations < 1:
                break
        self.offer()
        best = getattr(self.state, "best", (np.inf, None))
        if best[1] is not None and best[0] < self.log.best:
            self.log.offer(best[1])
        return Claim(status, done, work)

    def begin(self) -> None:
        """From where the log is."""
        self.state, self.impulse = self.solver.prepare(self.log.problem), self.log.impulse.copy()
        self.solver.until(self.state, self.log.deadline)

    def some(self, done: int, n: int) -> Claim:
        """As many as end soon, of n of which so many are done."""
        left = self.log.deadline.left()
        time = CHUNK_TIME if left is None else min(CHUNK_TIME, PROBE * left)
        few = min(max(1, int(time / self.each)), n - done)
        return self.solver.run(self.state, self.impulse, few, self.log.tol, None)


class Sweeps(Step):
    """Accelerated sweeps whose checks predict how many are left (`lavender_ext/small/checked_sweeps.pyx`)."""

    relative = 1.0  # residual of the last check
    told = 0  # restarts of the turns before

    def __init__(self, problem: Problem, deadline: Deadline = NEVER) -> None:
        """Everything that depends on no impulse; A is formed only if that is a small part of the time."""
        self.name, self.each = "anderson", 1e-9 * sweep_cost(problem)
        split = 0 if problem.rows is None else problem.rows.n_joints
        late = deadline.is_set and deadline.passed(FORMING * forming(problem))
        over = problem.metric if late else operator(problem)
        self.state = CheckedSweeps(problem.metric, over, is_exact(problem), split)

    def begin(self, log: SolveLog) -> None:
        """From where the log is, or from a given start that is worse than doing nothing."""
        self.log, self.relative = log, log.best
        self.impulse = log.impulse.copy() if log.given is None else log.given

    def turn(self, n: int) -> Claim:
        before, left = self.state.done, self.log.deadline.left()
        try:
            self.sweep(n, NEVER if left is None else Deadline(PROBE * left))
        finally:
            claim = self.taken(before)
        return claim

    def sweep(self, n: int, until: Deadline) -> None:
        """Between looks at the clock, until more than `least` are predicted to be left."""
        log, state, end = self.log, self.state, self.state.done + n
        chunk, at, before = max(1, int(CHUNK_TIME / self.each)), state.done, self.relative
        pace = AT_MOST * self.each
        while state.done < end:
            due = min(end, at + max(at // 2, FIRST))
            k = min(chunk, due - state.done)
            left, watch = until.left(), Stopwatch()
            if left is not None:
                k = min(k, max(1, int(PROBE * left / pace)))
            state.run(self.impulse, k, log.tol)
            pace = max(watch.seconds, 1e-9) / k
            self.relative = log.take(state.now)
            ended = STATUS[state.status] is not Status.MAX_ITERATIONS
            if ended or self.relative <= log.tol or log.late or until.passed(pace):
                return
            if state.done >= due:
                if sweeps_left(due - at, before, self.relative, log.tol) > self.least:
                    return
                at, before = due, self.relative

    def taken(self, before: int) -> Claim:
        """Offer the result of the sweeps since `before`."""
        log, state = self.log, self.state
        if state.best is not None:
            log.take(state.best)
        self.relative = log.best if state.now is None else state.now.relative
        if state.watch.best_relative < log.best:
            log.offer(state.watch.best[1])
        told, self.told = self.told, state.restarts
        work = {"sweeps": state.done - before, "restarts": state.restarts - told}
        return Claim(STATUS[state.status], state.done - before, work)

    def finish(self) -> None:
        """With all of the time that is left; the last are judged when the clock has stopped."""
        log, begun, before = self.log, self.state.done, self.log.best

        def end() -> None:
            log.by = log.problem.metric
            claim = self.taken(begun)
            log.offer(self.impulse)
            log.timed_out = claim.iterations < log.left
            log.note(self.name, claim, before)

        log.end = end
        self.state.within(
            self.impulse, min(log.left, MOST), log.tol, FIRST, log.deadline.left, PROBE, CHUNK_TIME
        )
