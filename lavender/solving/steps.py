"""Steps of `auto`: the solvers that it runs in turns. A solver continues from its last turn."""

from __future__ import annotations

import math
from dataclasses import replace
from math import inf
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Deadline
from lavender.base.errors import BREAKDOWN, format_error
from lavender.judge.solution import Claim, Status, sum_work_counts
from lavender.problem import Problem
from lavender.solvers._accelerated import build_state_in_given_form
from lavender.solvers.costs import estimate_formation_cost, get_loose_limit
from lavender.solvers.decisions import DECISIONS
from lavender.solvers.direct import SufficientDirect
from lavender.solvers.newton import WARM_START_MAX_RESIDUAL
from lavender.solvers.registry import get
from lavender.solving.log import SolveLog, get_relaxation
from lavender.solving.loop import Loop
from lavender_ext.judge.measure import all_finite, residuals_by_island


def make_solver(name: str, problem: Problem) -> Any:
    """Create the solver of a step, whose name begins with that of the solver."""
    spec = get(name.split()[0])
    if name == "direct" and problem.law == "linear":
        return SufficientDirect()  # `auto` needs no refinement of a solution that meets tol.
    if name == "nncg":
        return spec.load()(restart="against")
    # Solve blocks exactly under the cone law, and for a matrix: rows of a contact may differ in unit.
    exact = problem.law == "cone" or (problem.law == "coulomb" and problem.matrix is not None)
    return spec.load()(**({"sweep": "blocks"} if exact and "sweep" in spec.options else {}))


def prepare_sweeps(solver: Any, problem: Problem, deadline: Deadline) -> Any:
    """Prepare sweeps, over the given form if they may form A and too little time remains for it."""
    may_form = problem.generalized is not None or problem.law == "lcp"
    if not may_form or deadline.fits(get_loose_limit(problem)):
        return solver.prepare(problem)
    has_time = deadline.fits(DECISIONS.formation_time * estimate_formation_cost(problem))
    return solver.prepare(problem) if has_time else build_state_in_given_form(solver, problem)


class Step:
    """A solver on the problem of a log. It runs in turns, and continues at the end of its last turn.

    The `DecisionTree` of the solve creates it. `over` is true if the step cannot continue, `late` if it has no time to
    continue. The step stops if it predicts that more than `least` iterations are still needed.
    """

    over = late = False
    least = inf
    state: Any = None
    impulse: FloatArray  # Present iterate (m,) [N s].

    def __init__(self, name: str, log: SolveLog, tree: Any) -> None:
        self.name = name
        self.log = log
        self.is_large = tree.is_large
        self.solver = make_solver(name, log.problem)
        if self.name.startswith("newton"):
            self.analysed, self.started_from_zero = tree.newton_state, tree.started_from_zero

    def run(self, n: float) -> None:
        """Run at most n iterations and record the stage in the log."""
        log = self.log
        before = self.log.best
        try:
            # Counts of kernels have 32 bits.
            claim = self.advance(int(min(max(n, 1.0), log.remaining_iterations, 2**30)))
            if log.recorder is not None and not isinstance(
                self, Iterations
            ):  # Their loop makes records.
                log.recorder.record_impulse(
                    self.name, log.iterations + claim.iterations, self.impulse
                )
        except BREAKDOWN as error:
            log.failure = format_error(error)
            self.over = True
            claim = Claim(Status.NUMERICAL_ERROR, 0)
        self.over = self.over or claim.status is not Status.MAX_ITERATIONS
        self.late = claim.status is Status.TIME_LIMIT
        log.timed_out = log.timed_out or self.late
        log.record_stage(self.name, claim, before)

    def advance(self, n: int) -> Claim:
        """Run at most n iterations and offer the result to the log."""
        log = self.log
        if self.state is None:
            self.state = self.solver.prepare(log.problem)
            self.impulse = log.impulse.copy()
        claim: Claim = self.solver.run(self.state, self.impulse, n, log.tol, log.time_left)
        self.store_iterate_in_log(claim.judged)
        return claim

    def store_iterate_in_log(self, judged: Any = None) -> None:
        """Offer the iterate, and the judge's pass over it if there is one, to the log if it is finite."""
        if all_finite(self.impulse):
            self.log.judge_and_store_best(self.impulse, judged=judged)


class Newton(Step):
    """Newton's method with the state that the tree has analysed.

    It starts from the best impulse. If it stalls after a start that is not the zero impulse, it starts once more from
    zero, unless the compiled call has started from zero. If it stalls over velocities again, it continues from the best
    impulse over bodies or over the rows of A.
    """

    is_second_start = has_stalled = False

    def run(self, n: float) -> None:
        """Run at most n iterations, with a second start from zero and over rows of A if the method stalls."""
        log = self.log
        end = self.log.iterations + n
        super().run(n)
        if self.has_stalled and not self.started_from_zero and not log.done():
            self.started_from_zero = self.is_second_start = True
            self.over = self.state.begun = False
            super().run(end - log.iterations)
        if self.has_stalled and self.state.general is not None and not log.done():
            continuation = self.solver.prepare_continuation(self.state)
            if continuation is not None:
                # As in Newton's method by name, a bad start is replaced by the zero impulse.
                self.state = continuation
                self.is_second_start = not log.best <= WARM_START_MAX_RESIDUAL
                self.over = False
                super().run(end - log.iterations)

    def advance(self, n: int) -> Claim:
        """Run about n iterations, on large problems with friction more; choose the start at the first call."""
        log = self.log
        is_large = self.is_large
        done = 0
        work = dict[str, int]()
        extension = int(DECISIONS.turn_extension)
        self.state = self.state or self.analysed
        if not self.state.begun:
            self.impulse = log.problem.start() if self.is_second_start else log.impulse.copy()
            self.started_from_zero = (
                self.started_from_zero or not (self.impulse - log.problem.start()).any()
            )
        count = max(1, n - extension) if is_large else n
        while True:
            before = log.best
            left = log.remaining_iterations - done
            claim = self.solver.advance(
                self.state, self.impulse, count, log.tol, log.time_left, left
            )
            self.store_iterate_in_log(claim.judged)
            done = done + claim.iterations
            work = sum_work_counts((work, claim.work))
            is_slow = not is_large or (done >= n and log.best > 0.5 * before)
            if (
                is_slow
                or claim.status is not Status.MAX_ITERATIONS
                or done >= log.remaining_iterations
            ):
                break
            count = extension
        self.has_stalled = claim.status is Status.STALLED
        return replace(claim, iterations=done, work=work)


class RelaxedNewton(Step):
    """Interior points on the convex relaxation, judged under Coulomb's law. They stop if contacts slip."""

    def advance(self, n: int) -> Claim:
        """Run at most n factorisations, and compare both laws after each from the first possible end on."""
        log = self.log
        if self.state is None:  # The elimination order of the problem's own state is reused.
            self.state = self.solver.update(self.analysed, get_relaxation(log.problem))
            self.impulse = log.problem.start()
        system = self.state.system
        trial = self.impulse.copy()
        slips = False
        claim = Claim(Status.MAX_ITERATIONS, 0)
        done = 0
        work = dict[str, int]()
        count = min(n, int(DECISIONS.relaxed_start)) if system is not None else n
        while done < n and claim.status is Status.MAX_ITERATIONS:
            tol = DECISIONS.relaxed_tol * log.tol
            claim = self.solver.advance(
                self.state, self.impulse, count, tol, log.time_left, n - done
            )
            done = done + claim.iterations
            work = sum_work_counts((work, claim.work))
            count = 1
            if claim.status is not Status.MAX_ITERATIONS or system is None:
                self.store_iterate_in_log()
                break
            system.solve.write_interior_impulse(trial)
            log.judge_and_store_best(trial)
            ratio, residual = log.compare_with_relaxation(trial)
            slips = slips or ratio < DECISIONS.slip_ratio
            few_slide = slips and system.solve.fraction_near_sliding < DECISIONS.near_sliding
            if log.best <= log.tol or few_slide or (slips and residual > DECISIONS.trial_residual):
                break
            if ratio < DECISIONS.relaxed_solved:
                log.relaxed = trial
                break
        return replace(claim, iterations=done, work=work)


class Iterations(Step):
    """A resumable solver, which runs in chunks between checks of the clock and Ctrl-C.

    `admm` on large problems with friction starts again if another solver has found a better impulse.
    """

    time_fraction = 1.0  # Fraction of the remaining time that a stage may use.

    def advance(self, n: int) -> Claim:
        """Run at most n iterations and offer the last and the best iterate to the log."""
        log = self.log
        left = self.log.deadline.get_remaining_seconds()
        restarts = self.name == "admm" and self.is_large
        if self.state is None or (restarts and log.best < self.state.best[0]):
            self.prepare_and_set_start()
        is_whole = left is None or self.time_fraction == 1.0
        deadline = log.deadline if is_whole else Deadline(self.time_fraction * left)
        loop = Loop(
            problem=log.problem,
            solver=self.solver,
            state=self.state,
            impulse=self.impulse,
            tol=log.tol,
            deadline=deadline,
            records=None if log.recorder is None else [],
        )
        begun = 0.0 if log.recorder is None else log.recorder.time
        claim = self.run_loop(loop, n)
        if log.recorder is not None:
            log.recorder.append_loop_records(self.name, log.iterations, begun, loop)
        self.store_iterate_in_log()
        if log.best > log.tol:
            best, impulse = self.state.best  # pyright: ignore[reportOptionalMemberAccess]
            if impulse is not None and best < log.best:
                log.judge_and_store_best(impulse)
        return claim

    def prepare_and_set_start(self) -> None:
        """Prepare the solver and start from the best impulse of the log, zero, or the relaxation's solution."""
        log = self.log
        start = self.log.impulse
        if (
            self.name == "admm from zero"
        ):  # On large piles, it needs fewer iterations than from sweeps.
            start = log.problem._start
        elif self.name == "admm" and self.state is None and log.relaxed is not None:
            start = log.relaxed
        self.state = self.solver.prepare(log.problem)
        self.impulse = start.copy()

    def run_loop(self, loop: Loop, n: int) -> Claim:
        """Run at most n iterations."""
        return loop.run_chunks(n)


class Sweeps(Iterations):
    """Sweeps that stop if more than `least` remaining sweeps are predicted.

    With a time limit, they use a part of the remaining time, or all of it in `sweep_until_deadline`.
    """

    time_fraction = DECISIONS.time_share
    predicted = 0.0  # Predicted number of sweeps that are still needed, from the last checks.
    n_islands = 0  # Number of islands; 0 if it is not known.

    def advance(self, n: int) -> Claim:
        """Run at most n sweeps, offer the result to the log, and predict how many remain."""
        before = self.log.best
        claim = super().advance(n)
        self.predict(claim.iterations, before, self.log.best)
        return claim

    def predict(self, sweeps: int, before: float, now: float) -> None:
        """Predict the number of remaining sweeps from the last ones and the residuals before and after them."""
        tol = max(self.log.tol, DECISIONS.predicted_residual)
        if now > tol:
            gain = math.log(before / now) if now < before else 0.0
            self.predicted = sweeps * math.log(now / tol) / gain if gain > 0.0 else inf

    def prepare_and_set_start(self) -> None:
        """Prepare the sweeps; start from the best impulse."""
        self.state = prepare_sweeps(self.solver, self.log.problem, self.log.deadline)
        self.impulse = self.log.impulse.copy()

    def run_loop(self, loop: Loop, n: int) -> Claim:
        """Run at most n sweeps; predict how many remain at intervals."""
        is_large, log = self.is_large, self.log
        first = int(DECISIONS.large_sweeps if is_large else DECISIONS.first_sweeps)
        growth = 1.0 if is_large else 0.5
        tol = max(log.tol, DECISIONS.predicted_residual)
        done = self.state.watch.total
        due = 0
        if (
            self.time_fraction == 1.0
        ):  # Checks would cost as much as the first sweeps: run these without.
            loop.tol = 0.0
            claim = loop.run_chunks(min(n, first))
            if claim.status is not Status.MAX_ITERATIONS:
                return claim
            loop.tol = log.tol
        now = log.best
        while True:
            step = n - due
            if self.least < inf:
                step = min(step, max(int(growth * (done + due)), 1 if done else first))
            due += step
            claim = loop.run_chunks(due)
            if claim.status is Status.TIME_LIMIT and self.time_fraction < 1.0:
                return replace(claim, status=Status.MAX_ITERATIONS)
            if claim.status is not Status.MAX_ITERATIONS or due == n:
                return claim
            before = now
            now = float(self.state.best[0])
            if not is_large:  # Sweeps of large problems take as long as a pass of the judge.
                self.store_iterate_in_log()
                now = log.best
            elif self.n_islands != 1:
                island_of_block, table = residuals_by_island(log.problem.metric, self.impulse)
                self.n_islands = len(table)
                if (
                    np.mean(table[island_of_block, 0] <= log.tol) >= 0.5
                ):  # The other islands continue alone.
                    return claim
            self.predicted = inf
            self.predict(step, before, now)
            if now <= tol or self.is_hopeless(self.least):
                return claim

    def is_hopeless(self, max_remaining: float) -> bool:
        """Return whether more than `max_remaining` sweeps are predicted; large problems first make some of these."""
        done = 0.0 if self.state is None else self.state.watch.total
        is_early = self.is_large and done < DECISIONS.sweep_fraction * max_remaining
        return self.predicted > max_remaining and not is_early


#: Class of the step of each solver; the other solvers have `Iterations`.
STEP_CLASSES = {
    "anderson": Sweeps,
    "direct": Step,
    "newton": Newton,
    "newton on the relaxation": RelaxedNewton,
}
