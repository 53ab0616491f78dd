"""Run the solvers of `auto` in steps: each runs some iterations, and may later continue where it stopped."""

from __future__ import annotations

from dataclasses import replace
from math import log
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Deadline
from lavender.base.errors import BREAKDOWN, format_error
from lavender.judge.solution import Claim, Status, sum_work_counts
from lavender.problem import Problem
from lavender.solvers._accelerated import build_state_in_given_form
from lavender.solvers.costs import Cost, estimate_formation_cost, get_loose_limit
from lavender.solvers.decisions import DECISIONS
from lavender.solvers.direct import SufficientDirect
from lavender.solvers.loop import Loop
from lavender.solvers.registry import get
from lavender.solvers.solve_log import SolveLog, get_relaxation
from lavender_ext.judge.measure import all_finite, residuals_by_island

__all__ = [
    "METHODS",
    "Iterations",
    "Newton",
    "RelaxedNewton",
    "Step",
    "Sweeps",
    "estimate_cost",
    "make_solver",
    "starts_relaxed",
]

NNCG_OPTIONS: dict[str, Any] = {"order": "symmetric", "restart": "against"}
MAX_CALL_ITERATIONS = 2**30  # Largest number of iterations in one call.
#: Solver and options of each step, by its name.
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "anderson": ("anderson", {}),
    "newton": ("newton", {}),
    "newton over rows": ("newton", {"form": "impulse"}),
    "direct": ("direct", {}),
    "nncg": ("nncg", NNCG_OPTIONS),
    "admm": ("admm", {}),
    # On large piles, `admm` needs fewer iterations from zero than from an iterate of sweeps.
    "admm from zero": ("admm", {}),
    "newton on the relaxation": ("newton", {}),
}
# Predictions of remaining sweeps replace a smaller tol by this relative residual.
MIN_PREDICTED_RESIDUAL = 1e-16
# [s/ns] Upper bound of the ratio of an iteration's time to its estimated cost.
ITERATION_TIME_PER_COST = 4e-9
# Sweeps over large problems with friction before the first prediction of how many remain.
FIRST_SWEEPS_OF_LARGE_PROBLEM = 8
# Interior points on the relaxation need at least this number of factorisations.
FIRST_RELAXED_FACTORISATIONS = 6
# Interior points on the relaxation continue to this multiple of tol, because Coulomb's law has a larger residual.
RELAXED_TOLERANCE = 0.01
# Sweeps use a formed A only if at least this multiple of the cost to form it remains.
FORMATION_COST_RATIO = 4.0


def make_solver(name: str, problem: Problem) -> Any:
    """Create the solver of a step."""
    solver, options = METHODS[name]
    if name == "direct" and problem.law == "linear":
        return SufficientDirect()  # `auto` needs no refinement of a solution that meets tol.
    # Solve blocks exactly under the cone law, and for a matrix, in which the rows of a contact may have different
    # units.
    exact = problem.law == "cone" or (problem.law == "coulomb" and problem.matrix is not None)
    if exact and "sweep" in get(solver).options:
        options = options | {"sweep": "blocks"}
    return get(solver).load()(**options)


def estimate_cost(name: str, problem: Problem, state: Any = None) -> Cost:
    """Estimate the costs of the solver of a step."""
    cost: Cost = make_solver(name, problem).cost(problem, state)
    return cost


def starts_relaxed(problem: Problem) -> bool:
    """Return whether `auto` solves the convex relaxation first: under Coulomb's law, if the problem is large."""
    large = problem.law == "coulomb" and problem.m >= DECISIONS.relaxed_rows
    return large and not problem.cones.has_round and problem.is_symmetric


class Step:
    """A solver that runs on the problem of a log.

    `over` is true if the step cannot continue, `late` if it has no time to continue. The step stops if it predicts that
    more than `least` iterations are still needed.
    """

    over = late = slips = False
    least = np.inf
    state: Any = None
    impulse: FloatArray  # Present iterate (m,) [N s].

    def __init__(self, name: str, log: SolveLog) -> None:
        self.name, self.log = name, log
        self.solver = make_solver(name, log.problem)

    def run(self, n: float) -> None:
        """Run at most n iterations and record the stage in the log."""
        log, before = self.log, self.log.best
        try:
            claim = self.advance(int(min(max(n, 1.0), log.remaining_iterations, MAX_CALL_ITERATIONS)))
        except BREAKDOWN as error:
            log.failure, self.over = format_error(error), True
            claim = Claim(Status.NUMERICAL_ERROR, 0)
        self.over = self.over or claim.status is not Status.MAX_ITERATIONS
        self.late = claim.status is Status.TIME_LIMIT
        log.timed_out = log.timed_out or self.late
        log.record_stage(self.name, claim, before)

    def advance(self, n: int) -> Claim:
        """Run at most n iterations and offer the result to the log."""
        log = self.log
        if self.state is None:
            self.state, self.impulse = self.solver.prepare(log.problem), log.impulse.copy()
        claim: Claim = self.solver.run(self.state, self.impulse, n, log.tol, log.time_left)
        self.store_iterate_in_log(claim.judged)
        self.record_iterate(claim)
        return claim

    def record_iterate(self, claim: Claim) -> None:
        """Record the iterate at the end of a stage, if a history is requested."""
        log = self.log
        if log.recorder is not None:
            log.recorder.record_impulse(self.name, log.iterations + claim.iterations, self.impulse)

    def store_iterate_in_log(self, judged: Any = None) -> None:
        """Offer the iterate, and the judge's pass over it if there is one, to the log if it is finite."""
        if all_finite(self.impulse):
            self.log.judge_and_store_best(self.impulse, judged=judged)


class Newton(Step):
    """Newton's method with the state that the tree has analysed.

    It starts from the best impulse. If it stalls after a start that is not the zero impulse, it starts once more from
    zero, unless the compiled call has started from zero.
    """

    started_from_zero = is_second_start = has_stalled = False

    def run(self, n: float) -> None:
        """Run at most n iterations, with a second start from zero if the first one stalls."""
        log, done = self.log, self.log.iterations
        super().run(n)
        if self.has_stalled and not self.started_from_zero and not log.done():
            self.started_from_zero = self.is_second_start = True
            self.over = self.state.begun = False
            super().run(n - (log.iterations - done))

    def advance(self, n: int) -> Claim:
        """Run about n iterations; choose the start at the first call."""
        log = self.log
        if not self.state.begun:
            self.impulse = log.problem.start() if self.is_second_start else log.impulse.copy()
            self.started_from_zero = self.started_from_zero or not (self.impulse - log.problem.start()).any()
        claim = self.solver.advance(
            self.state, self.impulse, n, log.tol, log.time_left, log.remaining_iterations
        )
        self.has_stalled = claim.status is Status.STALLED
        self.store_iterate_in_log(claim.judged)
        self.record_iterate(claim)
        return claim


class Iterations(Step):
    """A resumable solver, which runs in chunks between checks of the clock and Ctrl-C."""

    time_fraction = 1.0  # Fraction of the remaining time that a stage may use.

    def advance(self, n: int) -> Claim:
        """Run at most n iterations and offer the last and the best iterate to the log."""
        log, left = self.log, self.log.deadline.get_remaining_seconds()
        if self.state is None:
            self.prepare_and_set_start()
        loop = Loop(
            problem=log.problem, solver=self.solver, state=self.state, impulse=self.impulse, tol=log.tol,
            deadline=None if left is None else log.deadline if self.time_fraction == 1.0
            else Deadline(self.time_fraction * left),
            pace=ITERATION_TIME_PER_COST * estimate_cost("anderson", log.problem).iteration,
            records=None if log.recorder is None else [],
        )  # fmt: skip
        begun = 0.0 if log.recorder is None else log.recorder.time
        claim = self.run_loop_iterations(loop, n)
        if log.recorder is not None:
            log.recorder.append_loop_records(self.name, log.iterations, begun, loop)
        self.store_iterate_in_log()
        if log.best > log.tol:
            best, impulse = self.state.best  # pyright: ignore[reportOptionalMemberAccess]
            if impulse is not None and best < log.best:
                log.judge_and_store_best(impulse)
        return claim

    def prepare_and_set_start(self) -> None:
        """Prepare the solver and start from the best impulse of the log, or from zero."""
        start = self.log.problem._start if self.name == "admm from zero" else self.log.impulse
        self.state, self.impulse = self.solver.prepare(self.log.problem), start.copy()

    def run_loop_iterations(self, loop: Loop, n: int) -> Claim:
        """Run at most n iterations."""
        return loop.run_chunks(n)


class Sweeps(Iterations):
    """Sweeps that stop if more than `least` remaining sweeps are predicted.

    With a time limit, they use a part of the remaining time, or all of it in `auto.sweep_until_deadline`.
    """

    time_fraction = DECISIONS.time_share
    predicted = 0.0  # Predicted number of sweeps that are still needed, from the last checks.
    n_islands = 0  # Number of islands; 0 if it is not known.

    @property
    def is_large(self) -> bool:
        """Whether `auto` solves the convex relaxation of the problem first."""
        return starts_relaxed(self.log.problem)

    def advance(self, n: int) -> Claim:
        """Run at most n sweeps, offer the result to the log, and predict how many remain."""
        before = self.log.best
        claim = super().advance(n)
        now, tol = self.log.best, max(self.log.tol, MIN_PREDICTED_RESIDUAL)
        if now > tol:
            gain = log(before / now) if now < before else 0.0
            self.predicted = claim.iterations * log(now / tol) / gain if gain > 0.0 else np.inf
        return claim

    def prepare_and_set_start(self) -> None:
        """Prepare the sweeps; start from the best impulse."""
        p, deadline = self.log.problem, self.log.deadline
        too_late = deadline.has_passed(1e-9 * get_loose_limit(p)) and deadline.has_passed(
            1e-9 * FORMATION_COST_RATIO * estimate_formation_cost(p)
        )
        self.state = build_state_in_given_form(self.solver, p) if too_late else self.solver.prepare(p)
        self.impulse = self.log.impulse.copy()

    def run_loop_iterations(self, loop: Loop, n: int) -> Claim:
        """Run at most n sweeps; predict how many remain at intervals."""
        first = FIRST_SWEEPS_OF_LARGE_PROBLEM if self.is_large else int(DECISIONS.first_sweeps)
        growth = 1.0 if self.is_large else 0.5
        done, due, tol = self.state.watch.total, 0, max(self.log.tol, MIN_PREDICTED_RESIDUAL)
        if self.time_fraction == 1.0:  # Checks would cost as much as the first sweeps: run these without.
            loop.tol = 0.0
            claim = loop.run_chunks(min(n, first))
            if claim.status is not Status.MAX_ITERATIONS:
                return claim
            loop.tol = self.log.tol
        now = self.log.best
        while True:
            step = n - due
            if self.least < np.inf:
                step = min(step, max(int(growth * (done + due)), 1 if done else first))
            due += step
            claim = loop.run_chunks(due)
            if claim.status is Status.TIME_LIMIT and self.time_fraction < 1.0:
                return replace(claim, status=Status.MAX_ITERATIONS)
            if claim.status is not Status.MAX_ITERATIONS or due == n:
                return claim
            before, now = now, self.measure_progress()
            if self.has_solved_half():
                return claim
            gain = log(before / now) if 0.0 < now < before else 0.0
            self.predicted = step * log(now / tol) / gain if now > tol and gain > 0.0 else np.inf
            if now <= tol or self.is_hopeless(self.least):
                return claim

    def is_hopeless(self, max_remaining: float) -> bool:
        """Return whether more than `max_remaining` sweeps are predicted; large problems first make some of these."""
        done = 0.0 if self.state is None else self.state.watch.total
        is_early = self.is_large and done < DECISIONS.sweep_fraction * max_remaining
        return self.predicted > max_remaining and not is_early

    def measure_progress(self) -> float:
        """Return the smallest relative residual so far."""
        if self.is_large:
            return float(self.state.best[0])  # Sweeps of large problems take as long as a pass of the judge.
        self.store_iterate_in_log()
        return self.log.best

    def has_solved_half(self) -> bool:
        """Return whether at least half of the blocks of a large problem belong to solved islands."""
        if not self.is_large or self.n_islands == 1:
            return False
        island_of_block, table = residuals_by_island(self.log.problem.metric, self.impulse)
        self.n_islands = len(table)
        return float(np.mean(table[island_of_block, 0] <= self.log.tol)) >= 0.5


class RelaxedNewton(Step):
    """Interior points on the convex relaxation, judged under Coulomb's law. They stop if contacts slip."""

    like: Any = None  # `NewtonState` of the problem, whose elimination order is reused.

    def advance(self, n: int) -> Claim:
        """Run at most n factorisations, and compare both laws after each from the first possible end on."""
        log = self.log
        if self.state is None:
            self.state = self.solver.update(self.like, get_relaxation(log.problem))
            self.impulse = log.problem.start()
        system, trial = self.state.system, self.impulse.copy()
        claim, done = Claim(Status.MAX_ITERATIONS, 0), 0
        work: dict[str, int] = {}
        count = min(n, FIRST_RELAXED_FACTORISATIONS) if system is not None else n
        while done < n and claim.status is Status.MAX_ITERATIONS:
            claim = self.solver.advance(
                self.state, self.impulse, count, RELAXED_TOLERANCE * log.tol, log.time_left, n - done
            )
            done, work, count = done + claim.iterations, sum_work_counts((work, claim.work)), 1
            self.store_iterate_in_log()
            if claim.status is not Status.MAX_ITERATIONS or system is None:
                break
            system.solve.write_interior_impulse(trial)
            log.judge_and_store_best(trial)
            self.slips = log.compare_with_relaxation(trial) < DECISIONS.slip_ratio
            if log.best <= log.tol or self.slips:
                break
        self.record_iterate(claim)
        return replace(claim, iterations=done, work=work)
