"""The candidates of `auto` as its schedule runs them: turns of counted work, continued if possible.

rest = n log(now / tol) / log(before / now)         sweeps left, by the contraction of the last n             (1)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender._arrays import FloatArray
from lavender.deadline import CHUNK_TIME, Deadline
from lavender.errors import BREAKDOWN, last_words
from lavender.registry import SolverSpec, get
from lavender.solution import Claim, Status
from lavender.solvers._accelerated import operator
from lavender.solvers.costs import METHODS, TABLE, Cost, Costs, setup_time
from lavender.solvers.direct import Enough, Impatient
from lavender.solvers.newton import NewtonState
from lavender.solvers.schedule import BELIEVED, remainder
from lavender.solvers.setup_times import forming
from lavender.solvers.solve_log import SolveLog
from lavender.solvers.sweeping import STATUS
from lavender_ext.small.checked_sweeps import CheckedSweeps, sweeps_left

__all__ = ["FIRST", "Candidate", "Sweeps", "in_short_time", "make"]

FIRST = 32  # sweeps before the first prediction of their remaining cost
MOST = 2**30  # sweeps of one call
PROBE = 0.5  # share of the time left that iterations of unknown pace may take
FORMING = 4.0  # times what forming A takes, that has to be left for sweeps over it


class Candidate:
    """A candidate on the problem of a log; its cost is a lower bound until it is counted."""

    is_finite = False  # factors
    patient = False  # may have another turn although the last ended by itself above the tolerance
    others = np.inf  # least remaining cost of the others [ns]

    def __init__(self, name: str, log: Any, costs: Costs, spec: SolverSpec) -> None:
        self.name, self.log, self.costs, self.spec = name, log, costs, spec
        late = self.late
        self.cost: Cost = Cost(np.inf, 1.0, 1.0) if late else costs.least(name)
        self.rest, self.counted = self.cost.total, late
        self.spent = 0.0  # ns, as counted
        self.state: Any = None

    @property
    def late(self) -> bool:
        """Its set-up, or counting its cost, would end after the deadline."""
        deadline = self.log.deadline
        return deadline.is_set and deadline.passed(setup_time(self.name, self.costs.problem))

    def count(self) -> None:
        self.counted = True
        if self.late:
            self.rest = np.inf
            return
        self.cost = self.costs.of(self.name)
        self.rest = self.cost.total

    @property
    def shown(self) -> str:
        """The solver's name in messages."""
        return self.spec.name

    def steps(self, work: float) -> int:
        """Iterations of a turn of so much work; 0 if not even the first would end in time."""
        setup = 0.0 if self.spent > 0.0 else self.cost.setup
        n = max(1, int((work - setup) / self.cost.each))
        left = max(self.cost.total - self.spent, 0.0)
        if self.is_finite and self.log.ends_late(self.costs.sure * left):
            return 0  # what it achieves before its end is seldom worth its time
        return min(n, self.log.left)

    def run(self, work: float, others: float) -> bool:
        self.others = others
        # What factors has little to show before its end.
        n = self.steps(BELIEVED * work if self.is_finite else work)
        if n <= 0:
            return False
        before = self.log.best
        try:
            claim = self.turn(n)
        except BREAKDOWN as error:
            self.log.failure = last_words(error)
            self.log.note(self.shown, Claim(Status.NUMERICAL_ERROR, 0), before)
            return False
        self.log.note(self.shown, claim, before)
        return self.has_done(claim)

    def has_done(self, claim: Claim) -> bool:
        """Count what a turn took and what is left; return whether it may have another."""
        last = max(claim.iterations, 1) * self.cost.each
        if self.spent == 0.0:
            last += self.cost.setup
        self.spent += last
        self.rest = remainder(self.spent, self.promise())
        return claim.status is Status.MAX_ITERATIONS or self.patient

    def turn(self, n: int) -> Claim:
        """Run at most n iterations and offer the result to the log."""
        raise NotImplementedError

    def promise(self) -> float:
        """The remaining cost that it predicts [ns]."""
        return 0.0


class Resumed(Candidate):
    """A solver that continues where it stopped; runs are short, for the clock and Ctrl-C, without changing its bits."""

    solver: Any = None
    impulse: FloatArray  # (m,) N s
    status = Status.MAX_ITERATIONS  # of the last run
    work: dict[str, int]  # of the last turn

    def begin(self) -> None:
        self.solver = self.spec.load()(**METHODS[self.name][1])
        self.state = self.solver.prepare(self.log.problem)
        self.impulse = self.log.impulse.copy()
        if hasattr(self.solver, "until"):
            self.solver.until(self.state, self.log.deadline)

    def turn(self, n: int) -> Claim:
        log, each = self.log, self.cost.each
        if not self.spent:
            self.begin()
        self.work, done, left = {}, 0, log.deadline.left()
        while True:  # as many iterations as are likely to end in time; a check at the end costs about one
            time = CHUNK_TIME if left is None else min(CHUNK_TIME, left if log.pace else PROBE * left)
            step = min(max(1, int(1e9 * time / ((log.pace or 1.0) * each))), n - done)
            last = self.iterate(step)
            done += last
            if left is not None:
                before, left = left, log.deadline.left()
                log.pace = 1e9 * (before - left) / ((last + 1) * each)
                if 2e9 * left <= log.pace * each:
                    break
            if self.status is not Status.MAX_ITERATIONS or last < step or done >= n:
                break
        self.close()
        return Claim(self.status, done, self.work)

    def iterate(self, n: int) -> int:
        """Run at most n iterations; return their number."""
        claim: Claim = self.solver.run(self.state, self.impulse, n, self.log.tol, None)
        self.status = claim.status
        for kind, count in claim.work.items():
            self.work[kind] = self.work.get(kind, 0) + count
        return claim.iterations

    def close(self) -> None:
        """Offer the result of a turn."""
        self.log.offer(self.impulse)
        # some states only say why nothing could be prepared
        best = getattr(self.state, "best", (np.inf, None))
        if best[1] is not None and best[0] < self.log.best:
            self.log.offer(best[1])


class Sweeps(Resumed):
    """Accelerated sweeps with checks that predict their cost (`lavender_ext/small/checked_sweeps.pyx`)."""

    late = False  # they form A only if there is time for it
    relative = 1.0  # residual of the last check
    least = 0.0  # ns, lower bound of the cost of any other method
    told = 0, 0  # sweeps and restarts of the turns before
    alone = False  # the first turn has all of the time that is left,
    before, begun = 1.0, 0  # the residual and the sweeps that it begins at,
    claim: Claim  # and what came of it

    def set_up(self, deadline: Deadline) -> None:
        """Everything that does not depend on the impulse; A is formed only if that is a small part of the time."""
        problem = self.costs.problem
        split = 0 if problem.rows is None else problem.rows.n_joints
        late = deadline.is_set and deadline.passed(FORMING * forming(problem))
        over = problem.metric if late else operator(problem)
        self.state = CheckedSweeps(problem.metric, over, problem.law == "cone", split)
        self.count()

    def run_first(self, log: SolveLog) -> bool:
        """Sweep for half of the time, or for all of it if the other half is too short for any other method.

        Return whether another may follow. If not, nothing but sweeps runs here; `end` judges the last impulse when the
        clock has stopped.
        """
        self.log = log
        half = 0.5 * (log.deadline.left() or 0.0)
        self.alone = 1e9 * half <= self.costs.sure * self.least
        self.begin()
        if not self.alone:
            self.sweep(Deadline(half))
            if log.done():
                return False
            if not log.ends_late(self.least):
                if not self.has_done(self.claim):
                    self.rest = np.inf
                return True
            self.alone = True  # these took so long that no other fits
        log.end = self.end
        self.sweep(log.deadline)
        return False

    def sweep(self, deadline: Deadline) -> None:
        """As many sweeps as end in time."""
        log, each = self.log, 1e-9 * self.cost.each
        self.before, self.begun = log.best, self.state.done
        try:
            pace = self.state.within(
                self.impulse, self.relative, min(log.left, MOST), log.tol, FIRST, deadline.left, each, PROBE,
                CHUNK_TIME, not self.alone,
            )  # fmt: skip
            log.pace = pace / each
        finally:
            if not self.alone:
                self.end()

    def end(self) -> None:
        """Offer and note the result of these sweeps."""
        log, sweeps = self.log, self.state
        done = sweeps.done - self.begun
        if sweeps.best is not None:
            log.take(sweeps.best)
        if self.alone:
            log.by = log.problem.metric
            log.offer(self.impulse)
            log.timed_out = done < log.left
        self.relative = log.best if sweeps.now is None else sweeps.now.relative
        self.status = STATUS[sweeps.status]
        self.close()
        self.claim = Claim(self.status, done, self.work)
        log.note(self.name, self.claim, self.before)

    def begin(self) -> None:
        log = self.log
        self.impulse = log.impulse.copy() if log.given is None else log.given
        self.relative = log.best
        if self.state is None:
            self.set_up(log.deadline)

    def iterate(self, n: int) -> int:
        """Run at most n sweeps; stop early if they predict a larger remaining cost than that of the others."""
        sweeps = self.state
        done, step = sweeps.done, min(max(sweeps.done // 2, FIRST), n)
        sweeps.run(self.impulse, self.relative, n, self.log.tol, step, FIRST, self.others / self.cost.each)
        self.relative, self.status = self.log.take(sweeps.now), STATUS[sweeps.status]
        return int(sweeps.done) - done

    def close(self) -> None:
        sweeps, told = self.state, self.told
        self.told = sweeps.sweeps, sweeps.restarts
        self.work = {"sweeps": sweeps.sweeps - told[0], "restarts": sweeps.restarts - told[1]}
        if sweeps.watch.best_relative < self.log.best:
            self.log.offer(sweeps.watch.best[1])

    def promise(self) -> float:
        sweeps = self.state
        return sweeps_left(sweeps.last, sweeps.before, self.relative, self.log.tol) * self.cost.each


class Relaxation(Resumed):
    """Sweeps of the convex relaxation from zero impulses, judged by Coulomb's law; then `nncg` from their result."""

    relative = 1.0  # by Coulomb's law, at the last check
    left = np.inf  # sweeps, by (1)
    slow = False  # the relaxation does not solve the problem, or not soon
    done = 0  # iterations of all turns

    def begin(self) -> None:
        self.solver = self.spec.load()()
        self.state = self.solver.prepare(self.log.problem.relaxed("cone"))
        self.impulse = self.log.problem.start()

    def turn(self, n: int) -> Claim:
        if self.slow and self.name == self.shown_by:
            self.shown_by = "nncg"
            self.solver = get("nncg").load()(**METHODS["nncg"][1])
            self.state = self.solver.prepare(self.log.problem)
        return super().turn(n)

    def has_done(self, claim: Claim) -> bool:
        more = super().has_done(claim)
        self.cost = self.costs.of("nncg")  # which continues
        return more

    shown_by = "relaxation"

    def iterate(self, n: int) -> int:
        """With checks of the residual under Coulomb's law, which falls with the relaxation's where contacts stick."""
        log, done = self.log, 0
        while done < n:
            step = min(max((self.done + done) // 2, FIRST), n - done)
            last = super().iterate(step)
            done += last
            before, self.relative = self.relative, log.offer(self.impulse)
            self.left = sweeps_left(last, before, self.relative, log.tol)
            if self.status is not Status.MAX_ITERATIONS:
                self.status = Status.STALLED if self.shown_by == "nncg" else Status.MAX_ITERATIONS
                break
            if self.relative <= log.tol or log.late or self.left * self.cost.each > self.others:
                break
        self.done += done
        return done

    def close(self) -> None:
        """Results were offered at each check; if the relaxation has not converged, the next turn is by `nncg`."""
        self.slow = True

    def promise(self) -> float:
        return self.left * self.cost.each if self.shown_by == "nncg" else 0.0

    @property
    def shown(self) -> str:
        return "relaxation: anderson" if self.shown_by == "relaxation" else "nncg"


class Newton(Candidate):
    """Newton's method, continued where its steps were used up, from the system whose factor was counted."""

    is_finite = True

    def turn(self, n: int) -> Claim:
        log = self.log
        if self.state is None:
            self.solver: Any = self.spec.load()(**METHODS[self.name][1])
            self.state = self.prepare()
            self.impulse = log.impulse.copy()
        claim: Claim = self.solver.turn(self.state, self.impulse, n, log.tol, log.time_left, log.left)
        _offer(log, self.impulse)
        return claim

    def prepare(self) -> NewtonState:
        problem, structure = self.log.problem, self.costs.structure
        if self.over_velocities:
            return NewtonState(problem, None, structure.kernel)
        rows = self.name == "newton over rows" or problem.rows is None
        if rows != (structure.system.form == "impulse"):
            prepared: NewtonState = self.solver.prepare(problem)
            return prepared
        return NewtonState(problem, structure.system if structure.system.solve.m else None)

    @property
    def over_velocities(self) -> bool:
        """Generalised ones."""
        return self.name == "newton" and self.log.problem.generalized is not None


class Direct(Candidate):
    """Continued where its rounds were used up; a linear system is solved no closer than tol."""

    is_finite = True

    def turn(self, n: int) -> Claim:
        log = self.log
        solver: Any = self.spec.load()()
        if log.problem.law == "linear":
            solver = Enough()
        elif self.spent == 0.0:
            solver = Impatient()
        if self.state is None:
            self.state, self.impulse = solver.prepare(log.problem), log.impulse.copy()
        claim: Claim = solver.run(self.state, self.impulse, n, log.tol, log.time_left)
        _offer(log, self.impulse)
        self.patient = claim.status is Status.STALLED and not self.state.is_over
        return claim

    def promise(self) -> float:
        # Stuck, or singular where rows are free: with more shifts and descent it takes far longer.
        return np.inf if self.patient else 0.0


def _offer(log: SolveLog, impulse: FloatArray) -> None:
    if np.isfinite(impulse).all():
        log.offer(impulse)


KINDS: dict[str, type[Candidate]] = {
    "newton": Newton, "direct": Direct, "anderson": Sweeps, "relaxation": Relaxation,
}  # fmt: skip


def in_short_time(costs: Costs, deadline: Deadline) -> Sweeps | None:
    """Sweeps that are set up, where others may not end before the deadline: by the least that these take."""
    problem = costs.problem
    least = min(
        max(costs.floor(name), 1e9 * setup_time(name, problem))
        for name in TABLE[problem.operator][problem.law]
    )
    if deadline.nanoseconds() > costs.sure**2 * least:
        return None
    sweeps = Sweeps("anderson", None, costs, get("anderson"))
    sweeps.least = least
    sweeps.set_up(deadline)
    return sweeps


def make(
    log: SolveLog,
    costs: Costs,
    names: tuple[str, ...],
    planned: tuple[str, int] | None = None,
    begun: list[Candidate] | None = None,
) -> list[Candidate]:
    """The candidates of these names that can run here, in this order, after those that have begun."""
    found = begun or []
    if found:
        names = tuple(name for name in names if name != found[0].name)
    for name in names:
        spec = get(METHODS[name][0])
        kind = KINDS.get(name, KINDS.get(spec.name, Resumed))
        made = kind(name, log, costs, spec)
        if made.rest < np.inf:
            found.append(made)
    if planned is not None:
        first_turn(found, planned)
    return found


def first_turn(found: list[Candidate], planned: tuple[str, int]) -> None:
    """Who is planned to go first does, whatever it costs; `planned`: who, and for how many iterations."""
    for candidate in found:
        candidate.counted = True
        if candidate.name == planned[0]:
            cost = candidate.cost
            candidate.rest = min(cost.total, cost.setup + planned[1] * cost.each, *(c.rest for c in found))
    found.sort(key=lambda candidate: candidate.name != planned[0])
