"""Chooses and combines other solvers, by their expected costs.

    small problems   one compiled call, which solves most of them (`small.py`)
    others           the candidates of a table, each with a cost that is counted from the problem's structure and fitted
                     rates (`costs.py`); repeatedly, the candidate with the least expected remaining cost gets a turn
                     (`schedule.py`)

Costs are counted, never timed, so the same problem is solved in the same way on every machine. The clock only ends a
solve under a time limit, and shortens its turns. The result is the best impulse of all turns. If a problem remains
unsolved, `auto` looks for a certificate that it has no solution. `Solution.turns` lists what ran.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender._arrays import FloatArray
from lavender.deadline import Deadline
from lavender.errors import BREAKDOWN, last_words
from lavender.problem import OPERATORS, Problem
from lavender.registry import SMALL_ROWS, SolverSpec
from lavender.solution import Claim, Status
from lavender.solvers.certify import certify
from lavender.solvers.costs import Costs, Plan, candidates
from lavender.solvers.methods import Candidate, Sweeps, in_short_time, make
from lavender.solvers.schedule import race
from lavender.solvers.setup_times import sweeping
from lavender.solvers.small import AUTO, NO_TIME, QUARTER, call_ends_within
from lavender.solvers.solve_log import SolveLog
from lavender.solvers.structure import Structure

# Sweeps start from a given guess up to this relative residual, even if doing nothing has less, because the guess tells
# which rows are free. Under limits of 1 and 10 ms, residuals from stale guesses are then 1.8 and 1.3 times smaller. The
# value is arbitrary: half or twice as much changes nothing.
STALE = 1e3
NOTHING_TOLD = Claim(Status.MAX_ITERATIONS, 0)
ONE_CALL = 200  # iterations that a problem of few rows, solved in one call, takes, unless its path is long


@dataclass
class State:
    """What `auto` has prepared: nothing."""

    problem: Problem
    log: SolveLog | None = None  # of the solve that has ended, as long as it is not told


@dataclass(frozen=True)
class Auto:
    """Chooses and combines other solvers; the solution's message and `turns` name them.

    Parameters
    ----------
    plan : Plan or its data, optional
        Result of `lavender.explain` for a problem of the same structure, whose costs are used instead of counting anew.
    """

    plan: Any = None

    def __post_init__(self) -> None:
        if self.plan is not None:
            object.__setattr__(self, "plan", Plan.of(self.plan))

    def prepare(self, problem: Problem) -> State:
        if self.plan is not None:
            self.plan.check(problem)
        return State(problem)

    def update(self, state: State, problem: Problem) -> State:
        return self.prepare(problem)

    def run(
        self, state: State, impulse: FloatArray, max_iter: int, tol: float, time_limit: float | None = None
    ) -> Claim:
        problem, state.log = state.problem, None
        deadline = Deadline(time_limit)
        if max_iter >= ONE_CALL and _has_call(problem, deadline):
            share = 1.0 if problem.m <= SMALL_ROWS else QUARTER
            made = AUTO.solve(problem, impulse, tol, share * deadline.nanoseconds())
            if made is not None and made[0].relative <= tol:
                claim = AUTO.claim(problem, made[1], impulse, made[0].relative)
                if claim.iterations <= max_iter:
                    impulse[:] = made[0].impulse
                    return claim
        if problem.m == 0:
            return Claim(Status.CONVERGED, 0, {}, "nothing to solve")
        costs = sweeps = None
        if deadline.is_set and self.plan is None and not problem.cones.has_round:
            if deadline.passed(sweeping(problem)):
                return Claim(Status.TIME_LIMIT, 0, {}, NO_TIME)
            costs = Costs(problem)
            sweeps = in_short_time(costs, deadline)
        log = SolveLog(problem, tol, max_iter, deadline, None if sweeps is None else sweeps.state.data)
        log.offer(impulse)
        if log.best > 1.0:
            log.given = impulse.copy() if log.best < STALE else None
            log.offer(problem.start())  # doing nothing is better
        state.log = log
        try:
            if max_iter > 0 and log.best > tol:
                solve(log, self.plan, sweeps, None if costs is None else costs.structure)
        except KeyboardInterrupt:
            log.interrupted = True  # the best impulse goes back all the same
        except BREAKDOWN as error:
            log.failure = last_words(error)
        return NOTHING_TOLD

    def tell(self, state: State, impulse: FloatArray, claim: Claim) -> Claim:
        """When the clock has stopped: the best impulse, judged, and what ran."""
        log, state.log = state.log, None
        if log is None:
            return claim
        if log.end is not None:
            log.end()
        impulse[:] = log.impulse
        return log.claim()


def _has_call(problem: Problem, deadline: Deadline) -> bool:
    """Whether the compiled call is made: of more rows only if it is counted to end in a quarter of the time left."""
    left = deadline.left()
    return left is None or problem.m <= SMALL_ROWS or call_ends_within(problem, QUARTER * left)


def solve(
    log: SolveLog, plan: Plan | None = None, sweeps: Sweeps | None = None, structure: Structure | None = None
) -> None:
    """To the end, by a plan where one is given; `sweeps`, `structure`: what is set up for a time limit."""
    if log.done() if sweeps is None else not sweeps.run_first(log):
        return
    with np.errstate(all="ignore"):  # what overflows is judged
        others(log, plan, structure, [] if sweeps is None else [sweeps])


def others(log: SolveLog, plan: Plan | None, structure: Structure | None, begun: list[Candidate]) -> None:
    """All candidates, of which one may have begun, and at last the certificate."""
    costs = Costs(log.problem, log.tol, structure=structure, plan=plan)
    names = tuple(name for name, _ in plan.candidates) if plan else candidates(costs.structure, log.deadline)
    race(list(make(log, costs, names, None if plan is None else plan.first, begun)), log.done)
    if log.best > log.tol and log.certificate is None and (log.left > 0 or log.vain):
        certify(log)


SPEC = SolverSpec(
    name="auto",
    factory=Auto,
    laws=frozenset({"linear", "lcp", "coulomb", "cone"}),
    boxes=frozenset({"coulomb", "cone"}),
    operators=frozenset(OPERATORS),
    round_cones=True,
    rolling=True,
    small=AUTO,
    resumable=False,
    delegates=True,
    max_iter=1_000_000,
    options={"plan": "result of lavender.explain, whose costs are used; default: counted anew"},
    summary="chooses and combines other solvers by expected cost",
)
