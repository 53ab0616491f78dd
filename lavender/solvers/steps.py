"""The solvers of `auto` as its tree runs them: so many iterations, then more from where they stopped."""

from __future__ import annotations

from dataclasses import replace
from math import log
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Deadline
from lavender.base.errors import BREAKDOWN, format_error
from lavender.judge.solution import Claim, Status
from lavender.problem import Problem
from lavender.solvers._accelerated import as_given
from lavender.solvers.costs import SWEEPS, sweep_cost
from lavender.solvers.direct import Enough
from lavender.solvers.loop import Loop
from lavender.solvers.registry import get
from lavender.solvers.setup_times import forming
from lavender.solvers.solve_log import SolveLog
from lavender_ext.judge.measure import all_finite

__all__ = ["METHODS", "Iterations", "Newton", "Step", "Sweeps", "made", "setup_time"]

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
FIRST = 32  # sweeps before the first prediction of how many are left
MOST = 2**30  # iterations of one call
LEAST = 1e-16  # relative residual that can be predicted
# Relative residual up to which Newton's method begins from another's impulse, and a solution may be near.
NEAR = 0.02
PROBE = 0.5  # share of the time left that sweeps have before who factors
PACE = 4e-9  # s for each ns that an iteration is counted for, at most
FORMING = 4.0  # times what forming A takes, that has to be left for sweeps over it


def made(name: str, problem: Problem) -> Any:
    """The solver of a step."""
    solver, options = METHODS[name]
    if name == "direct" and problem.law == "linear":
        return Enough()  # no closer than tol
    # Sweeps solve each block exactly under the cone law, and where a contact's rows may have unlike units.
    exact = problem.law == "cone" or (problem.law == "coulomb" and problem.matrix is not None)
    if exact and "sweep" in get(solver).options:
        options = options | {"sweep": "blocks"}
    return get(solver).load()(**options)


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
            claim = self.advance(int(min(max(n, 1.0), log.left, MOST)))
        except BREAKDOWN as error:
            log.failure, self.over = format_error(error), True
            claim = Claim(Status.NUMERICAL_ERROR, 0)
        self.over = self.over or claim.status is not Status.MAX_ITERATIONS
        self.late = claim.status is Status.TIME_LIMIT
        log.note(self.name, claim, before)

    def advance(self, n: int) -> Claim:
        """Run and offer what came of it."""
        log = self.log
        if self.state is None:
            self.state, self.impulse = self.solver.prepare(log.problem), log.impulse.copy()
        claim: Claim = self.solver.run(self.state, self.impulse, n, log.tol, log.time_left)
        self.offer()
        return claim

    def offer(self) -> None:
        """The iterate, to the log."""
        if all_finite(self.impulse):
            self.log.offer(self.impulse)


class Newton(Step):
    """From the state whose factor was counted; from nothing if sweeps left much, and once more if it ends in vain."""

    anew = lost = False

    def run(self, n: float) -> None:
        log, done = self.log, self.log.iterations
        super().run(n)
        if self.lost and not self.anew and not log.done():
            self.anew, self.over, self.state.begun = True, False, False
            super().run(n - (log.iterations - done))

    def advance(self, n: int) -> Claim:
        log = self.log
        if not self.state.begun:
            far = log.best > NEAR
            self.impulse = log.problem.start() if self.anew or far else log.impulse.copy()
            self.anew = not (self.impulse - log.problem.start()).any()
        claim = self.solver.advance(self.state, self.impulse, n, log.tol, log.time_left, log.left)
        self.lost = claim.status is Status.STALLED
        self.offer()
        return claim


class Iterations(Step):
    """A solver that continues to the bit, in chunks for the clock and Ctrl-C."""

    share = 1.0  # of the time left, that a turn may take

    def advance(self, n: int) -> Claim:
        log, left = self.log, self.log.deadline.remaining()
        if self.state is None:
            self.begin()
        loop = Loop(
            problem=log.problem, solver=self.solver, state=self.state, impulse=self.impulse, tol=log.tol,
            deadline=log.deadline if left is None or self.share == 1.0 else Deadline(self.share * left),
            pace=PACE * sweep_cost(log.problem),
        )  # fmt: skip
        claim = self.iterate(loop, n)
        self.offer()
        if log.best > log.tol:
            best, impulse = self.state.best
            if impulse is not None and best < log.best:
                log.offer(impulse)
        return claim

    def begin(self) -> None:
        """From where the log is."""
        self.state, self.impulse = self.solver.prepare(self.log.problem), self.log.impulse.copy()

    def iterate(self, loop: Loop, n: int) -> Claim:
        """At most n iterations."""
        return loop.chunks(n)


class Sweeps(Iterations):
    """Until more than `least` are predicted to be left; under a time limit for half of what is left, or to the end."""

    share = PROBE

    def begin(self) -> None:
        """From where the log is, or from a given start that is worse than doing nothing."""
        p = self.log.problem
        late = self.log.deadline.is_set and self.log.deadline.passed(FORMING * forming(p))
        self.state = as_given(self.solver, p) if late else self.solver.prepare(p)
        self.impulse = self.log.impulse.copy() if self.log.given is None else self.log.given

    def iterate(self, loop: Loop, n: int) -> Claim:
        """Look after FIRST, and whenever half as many more are done, how fast the residual falls."""
        done, due, tol = self.state.watch.total, 0, max(self.log.tol, LEAST)
        if self.share == 1.0:  # checks would cost as much as the first sweeps
            loop.tol = 0.0
            claim = loop.chunks(min(n, FIRST))
            if claim.status is not Status.MAX_ITERATIONS:
                return claim
            loop.tol = self.log.tol
        while True:
            step = min(n - due, max((done + due) // 2, FIRST)) if self.least < np.inf else n - due
            due += step
            claim = loop.chunks(due)
            if claim.status is Status.TIME_LIMIT and self.share < 1.0:
                return replace(claim, status=Status.MAX_ITERATIONS)
            if claim.status is not Status.MAX_ITERATIONS or due == n:
                return claim
            before = self.log.best
            self.offer()
            now = self.log.best
            gain = log(before / now) if 0.0 < now < before else 0.0
            if now <= tol or gain * self.least < step * log(now / tol):
                return claim

    def finish(self) -> None:
        """With all of the time that is left."""
        self.share, self.least = 1.0, np.inf
        self.run(np.inf)
        self.log.timed_out = self.late
