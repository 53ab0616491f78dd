"""Select and combine other solvers by their estimated costs (`Solver.cost`).

    start            if the start is a solution, nothing runs
    compiled call    one call for small problems, for small islands with friction, and for J and M if Newton's method
                     is estimated to cost no more than the first sweeps (`small.py`); attempted once
    large problems   under Coulomb's law, from `relaxed_rows` rows on, five stages come first (of J and M, if the
                     velocities belong to free bodies). They solve the convex relaxation, which has the same
                     solution if no contact slips, and judge each iterate under Coulomb's law. After each stage, only
                     the islands that it has not solved continue
                     1. `anderson`, which sweeps under the cone law until contacts slip, while it predicts fewer sweeps
                        than the lower bound of the cost of Newton's method pays for
                     2. more sweeps, after an analysis of Newton's matrix: at least `sweep_fraction` of its cost, then
                        unless more sweeps are predicted than its cost, or stage 3, pays for
                     3. `admm` from zero, up to 0.4 times that cost and 600 iterations, if this pays for 150
                     4. the interior points of `newton` on the relaxation, until their residual of the relaxation is
                        below `slip_ratio` times Coulomb's: contacts slip
                     5. `admm` from the relaxation's solution, which stage 4 then computes, if its residual on Coulomb's
                        law is at most `trial_residual`: `trial_iterations` at a time, while two more such turns are
                        predicted to solve the problem
                     The alternation follows
    sweeps           `anderson`, unless the problem is linear or large: `first_sweeps` sweeps. Sweeping continues up to
                     the cost of the cheapest factorising solver, unless more sweeps are predicted to be needed
    factorisations   `newton` (over velocities, bodies or rows of A), and for bounded rows of a matrix `direct`, the
                     cheapest first, each up to `budget_ratio` times its estimated cost
    certificate      a search for a proof that no solution exists: for J and M from the smallest violation of the
                     constraints, for other problems under Coulomb's law by a linear program
    alternation      the factorising solvers, `admm` and sweeps, each continued where it stopped, with doubled
                     work in each round, until no solver improves the residual in two rounds or the total cost exceeds
                     `total_ratio` times the cost of the cheapest. On large problems with friction, `newton` begins with
                     `turn_factorisations`, each solver starts from the best impulse of the others, `newton` with Euler
                     steps (`lavender_ext/newton/flow.pxd`), and sweeps do not run
    end              a search for a certificate by a linear program, if none was tried before (`certify.py`)

Linear problems given by a matrix, and others with a narrow band as A, start with `direct`. A program with a singular P
is solved by backends (`singular_programs.py`). The result is the best impulse of all stages. Costs are estimated, never
measured, so the same problem is solved in the same way on every machine. Under a time limit, a factorising solver
starts only if its estimated cost fits in the remaining time; sweeps before it use at most the fraction `time_share` of
the time, or all of it if no factorising solver fits. `Solution.stages` lists the stages that ran, `lavender.explain`
the stages that would run. The decisions depend on these numbers (`decisions.py`):

"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from math import inf, nan
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import NEVER, Deadline, format_seconds
from lavender.base.errors import BREAKDOWN, format_error
from lavender.judge.solution import Claim, Status, sum_work_counts
from lavender.problem import OPERATORS, Problem
from lavender.problem.derived import cached_property
from lavender.solvers._accelerated import build_state_in_given_form
from lavender.solvers.certify import (
    certify_by_least_violation,
    certify_by_linear_programs,
    certify_infeasibility,
)
from lavender.solvers.costs import (
    RATES,
    Cost,
    estimate_first_factor_cost,
    estimate_formation_cost,
    get_loose_limit,
)
from lavender.solvers.decisions import DECISIONS, describe_numbers
from lavender.solvers.direct import SufficientDirect
from lavender.solvers.islands import get_rows_of_blocks, restrict_to_blocks
from lavender.solvers.newton import WARM_START_MAX_RESIDUAL, NewtonState
from lavender.solvers.newton_systems.systems import find_bodies
from lavender.solvers.registry import Solver, SolverSpec, get
from lavender.solvers.small import AUTO
from lavender.solving.compiled_call import choose_call_deadline
from lavender.solving.log import Recorder, SolveLog, get_relaxation
from lavender.solving.loop import Loop
from lavender.solving.singular_programs import program_backends, run_program_backends
from lavender_ext.judge.measure import all_finite, residuals_by_island

assert __doc__ is not None
__doc__ += describe_numbers() + "\n"

# Newton's method on the relaxation may use this multiple of its expected number of factorisations.
RELAXED_BUDGET_RATIO = 2.0
# On large problems with friction, `admm` may cost this fraction of Newton's method before that runs, up to the largest
# number of iterations, if it pays for the smallest. Without a factor, an iteration costs about as much as three sweeps.
ADMM_FRACTION, SWEEPS_PER_ADMM_ITERATION = 0.4, 3.0
MIN_ADMM_ITERATIONS, MAX_ADMM_ITERATIONS = 150.0, 600.0
# `admm` continues from the solution of the relaxation while at most this number of further turns are predicted to
# solve the problem.
MAX_TRIALS = 2
# The relaxation is solved if its residual is below this multiple of Coulomb's.
SOLVED_RELAXATION_RATIO = 1e-5
# Largest number of rounds of alternation; the limit of the total cost ends most solves earlier.
MAX_ALTERNATIONS = 12
# The compiled call is only made if at least this many iterations are allowed; it usually needs fewer.
MIN_ITERATIONS_FOR_COMPILED_CALL = 200
# [ns] If no solver gains and Newton's method has not ended, it runs on up to this cost. On nine rows of J and M with
# masses over many orders, it took 1,460 factorisations of 30 us.
MAX_LAST_NEWTON_COST = 1e8
MAX_CALL_ITERATIONS = 2**30  # Largest number of iterations in one call.
# Predictions of remaining sweeps replace a smaller tol by this relative residual.
MIN_PREDICTED_RESIDUAL = 1e-16
# Sweeps of `is_large` problems before the first prediction of how many remain.
FIRST_SWEEPS_OF_LARGE_PROBLEM = 8
# Interior points on the relaxation need at least this number of factorisations.
FIRST_RELAXED_FACTORISATIONS = 6
# Interior points on the relaxation continue to this multiple of tol, because Coulomb's law has a larger residual.
RELAXED_TOLERANCE = 0.01
# Sweeps use a formed A only if at least this multiple of the cost to form it remains.
FORMATION_COST_RATIO = 4.0
#: Solver and options of each step, by its name.
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "anderson": ("anderson", {}),
    "newton": ("newton", {}),
    "direct": ("direct", {}),
    "admm": ("admm", {}),
    # On large piles, `admm` needs fewer iterations from zero than from an iterate of sweeps.
    "admm from zero": ("admm", {}),
    "newton on the relaxation": ("newton", {}),
}


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


def estimate_cost(name: str, problem: Problem) -> Cost:
    """Estimate the costs of the solver of a step."""
    cost: Cost = make_solver(name, problem).cost(problem)
    return cost


def starts_relaxed(problem: Problem) -> bool:
    """Return whether `auto` solves the convex relaxation first: under Coulomb's law, if the problem is large.

    Of J and M, this requires that the velocities belong to free bodies. Over the rows of a sparse A, Newton's method on
    Coulomb's law takes fewer steps than on the relaxation.
    """
    large = problem.law == "coulomb" and problem.m >= DECISIONS.relaxed_rows
    if not large or problem.cones.has_round or not problem.is_symmetric:
        return False
    return problem.generalized is None or find_bodies(problem) is not None


class Step:
    """A solver that runs on the problem of a log in turns, each of which continues where the last one stopped.

    `over` is true if the step cannot continue, `late` if it has no time to continue. The step stops if it predicts that
    more than `least` iterations are still needed.
    """

    over = late = False
    least = inf
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
            self.record_history(claim)
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
        return claim

    def record_history(self, claim: Claim) -> None:
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
    zero, unless the compiled call has started from zero. If it stalls over velocities again, it continues from the best
    impulse over bodies or over the rows of A.
    """

    started_from_zero = is_second_start = has_stalled = False
    best = inf  # Smallest residual of all stages when this step ended.

    def run(self, n: float) -> None:
        """Run at most n iterations, with a second start from zero and over rows of A if the method stalls."""
        log, end = self.log, self.log.iterations + n
        super().run(n)
        if self.has_stalled and not self.started_from_zero and not log.done():
            self.started_from_zero = self.is_second_start = True
            self.over = self.state.begun = False
            super().run(end - log.iterations)
        if self.has_stalled and self.state.general is not None and not log.done():
            continuation = self.solver.prepare_continuation(self.state)
            if continuation is not None:
                # As in Newton's method by name, a bad start is replaced by the zero impulse.
                self.state, self.is_second_start = continuation, not log.best <= WARM_START_MAX_RESIDUAL
                self.over = False
                super().run(end - log.iterations)

    def advance(self, n: int) -> Claim:
        """Run about n iterations; choose the start at the first call."""
        log = self.log
        if not self.state.begun:
            self.impulse = log.problem.start() if self.is_second_start else log.impulse.copy()
            self.started_from_zero = self.started_from_zero or not (self.impulse - log.problem.start()).any()
        elif log.best < self.best and starts_relaxed(log.problem) and self.state.system is not None:
            self.state.system.solve.continue_from_better_point(log.impulse, n)
        claim = self.solver.advance(
            self.state, self.impulse, n, log.tol, log.time_left, log.remaining_iterations
        )
        self.has_stalled = claim.status is Status.STALLED
        self.store_iterate_in_log(claim.judged)
        self.best = log.best
        return claim


class RelaxedNewton(Step):
    """Interior points on the convex relaxation, judged under Coulomb's law. They stop if contacts slip."""

    like: Any = None  # `NewtonState` of the problem; its elimination order is reused.

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
            ratio, residual = log.compare_with_relaxation(trial)
            if log.best <= log.tol or (ratio < DECISIONS.slip_ratio and residual > DECISIONS.trial_residual):
                break
            if ratio < SOLVED_RELAXATION_RATIO:
                log.relaxed = trial
                break
        return replace(claim, iterations=done, work=work)


class Iterations(Step):
    """A resumable solver, which runs in chunks between checks of the clock and Ctrl-C."""

    time_fraction = 1.0  # Fraction of the remaining time that a stage may use.
    restarts = False  # Whether a stage starts from the best impulse if another solver has found a better one.

    def __init__(self, name: str, log: SolveLog) -> None:
        super().__init__(name, log)
        self.restarts = name == "admm" and starts_relaxed(log.problem)

    def advance(self, n: int) -> Claim:
        """Run at most n iterations and offer the last and the best iterate to the log."""
        log, left = self.log, self.log.deadline.get_remaining_seconds()
        if self.state is None or (self.restarts and log.best < self.state.best[0]):
            self.prepare_and_set_start()
        deadline = None
        if left is not None:
            deadline = log.deadline if self.time_fraction == 1.0 else Deadline(self.time_fraction * left)
        loop = Loop(
            problem=log.problem, solver=self.solver, state=self.state, impulse=self.impulse, tol=log.tol,
            deadline=deadline, records=None if log.recorder is None else [],
        )  # fmt: skip
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

    def record_history(self, claim: Claim) -> None:
        """Do nothing: the loop has made the records."""

    def prepare_and_set_start(self) -> None:
        """Prepare the solver and start from the best impulse of the log, zero, or the relaxation's solution."""
        log, start = self.log, self.log.impulse
        if self.name == "admm from zero":
            start = log.problem._start
        elif self.name == "admm" and self.state is None and log.relaxed is not None:
            start = log.relaxed
        self.state, self.impulse = self.solver.prepare(self.log.problem), start.copy()

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

    def __init__(self, name: str, log: SolveLog) -> None:
        super().__init__(name, log)
        self.is_large = starts_relaxed(log.problem)

    def advance(self, n: int) -> Claim:
        """Run at most n sweeps, offer the result to the log, and predict how many remain."""
        before = self.log.best
        claim = super().advance(n)
        self.predict(claim.iterations, before, self.log.best)
        return claim

    def predict(self, sweeps: int, before: float, now: float) -> None:
        """Predict the number of remaining sweeps from the last ones and the residuals before and after them."""
        tol = max(self.log.tol, MIN_PREDICTED_RESIDUAL)
        if now > tol:
            gain = math.log(before / now) if now < before else 0.0
            self.predicted = sweeps * math.log(now / tol) / gain if gain > 0.0 else inf

    def prepare_and_set_start(self) -> None:
        """Prepare the sweeps; start from the best impulse."""
        p, deadline = self.log.problem, self.log.deadline
        too_late = not deadline.fits(get_loose_limit(p)) and not deadline.fits(
            FORMATION_COST_RATIO * estimate_formation_cost(p)
        )
        self.state = build_state_in_given_form(self.solver, p) if too_late else self.solver.prepare(p)
        self.impulse = self.log.impulse.copy()

    def run_loop(self, loop: Loop, n: int) -> Claim:
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
            if self.least < inf:
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
            self.predicted = inf
            self.predict(step, before, now)
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


#: Class of the step of each solver; the other solvers have `Iterations`.
STEP_CLASSES = {
    "anderson": Sweeps, "direct": Step, "newton": Newton,
    "newton on the relaxation": RelaxedNewton,
}  # fmt: skip


@dataclass(frozen=True)
class Stage:
    """One stage of the tree."""

    solver: str  # Name in `METHODS`, or "certificate".
    iterations: float  # Largest number of iterations.
    cost: float  # [ns] Estimated cost of these iterations.
    why: str  # Reason, for `lavender.explain`.
    least: float = inf  # Sweeps stop if they predict that more than this number of sweeps is still needed.
    # Position among the stages after which only islands that are not solved continue; 0 for other stages.
    position: int = 0


class DecisionTree:
    """The stages of `auto` for a problem, as an iterable, and the costs that it compares [ns].

    `log.best` is the smallest relative residual so far; without a log, no stage runs. Stages before `first_stage` have
    run on a problem with more islands.
    """

    compiled_call_failed = False  # Whether the compiled call over velocities of J and M has failed.
    started_from_zero = False  # Whether that call started from the zero impulse.
    remaining_cost = 0.0  # [ns] Cost that the alternation may still use.
    sweeps_failed = False  # Whether sweeps did not improve the residual in the alternation.

    def __init__(
        self, problem: Problem, deadline: Deadline = NEVER, log: Any = None, first_stage: int = 1
    ) -> None:
        self.problem, self.law, self.deadline, self.log = problem, problem.law, deadline, log
        self.first_stage = first_stage
        self.sweep = estimate_cost("anderson", problem).iteration  # [ns] Cost of one sweep.
        self.first = DECISIONS.first_sweeps * self.sweep  # [ns] Cost of the first sweeps.
        # [ns] Lower bound of the cost of Newton's method, without its analysis.
        self.min_newton_cost = estimate_cost("newton", problem).total

    @property
    def best(self) -> float:
        """Smallest relative residual so far; NaN if no stage runs."""
        return nan if self.log is None else float(self.log.best)

    def skip(self, stage: Stage) -> None:
        """Return the cost of a stage that does not run to the alternation."""
        self.remaining_cost += stage.cost

    @cached_property
    def relaxed_sweep(self) -> float:
        """Cost of one sweep over the convex relaxation [ns]."""
        return estimate_cost("anderson", get_relaxation(self.problem)).iteration

    @cached_property
    def newton_state(self) -> NewtonState | None:
        """State of Newton's method after the analysis of its matrix.

        None if Newton's method refuses the problem, if the analysis fails, or if it would end after the deadline.
        """
        if get("newton").refuses(self.problem) is not None or self.is_late:
            return None
        try:
            state: NewtonState = get("newton").load()().prepare(self.problem)
        except BREAKDOWN:
            return None
        return state

    @property
    def solver_costs(self) -> dict[str, float]:
        """Estimated costs [ns] of the factorising solvers, the cheapest first; a failed `newton` comes last."""
        found = {} if self.newton_state is None else {"newton": self.newton_state.cost}
        if self.can_pivot:
            found["direct"] = self.direct
        failed = "newton" if self.compiled_call_failed else ""
        return dict(sorted(found.items(), key=lambda item: (item[0] == failed, item[1])))

    @cached_property
    def can_pivot(self) -> bool:
        """Whether `direct` is considered: for bounded rows, or linear ones of bodies, if A is given or cheap."""
        if self.law == "linear" and self.problem.rows is not None:
            max_cost = self.min_newton_cost
        elif self.law == "lcp":
            max_cost = self.first
        else:
            return False
        return self.formation <= max_cost and self.deadline.fits(self.formation / DECISIONS.time_share)

    @cached_property
    def formation(self) -> float:
        """Cost to form A from bodies or from J and M [ns], whether or not A is cached."""
        return estimate_formation_cost(self.problem, self.problem.matrix is not None)

    @cached_property
    def direct(self) -> float:
        """Cost of `direct` on bounded rows [ns], including the cost to form A."""
        return self.formation + estimate_cost("direct", self.problem).total

    @property
    def newton(self) -> float:
        """Cost of the cheapest factorising solver [ns]; inf if none is possible."""
        return min(self.solver_costs.values(), default=inf)

    @property
    def unit(self) -> float:
        """Cost [ns] of the cheapest factorising solver, or of the first sweeps if there is none."""
        return self.newton if self.newton < inf else self.first

    @property
    def is_late(self) -> bool:
        """Whether no factorising solver can return a result before the deadline."""
        return not self.has_time_for_newton()

    def has_time_for_newton(self, before: float = 0.0) -> bool:
        """Return whether the least cost of Newton's method fits after `before` [ns]."""
        needed = before + 2.0 * get_loose_limit(self.problem)
        if self.problem.generalized is None and self.deadline.fits(needed):
            return True  # The least cost of bodies and matrices is below the loose limit.
        return self.has_time("newton", self.min_newton_cost, before)

    def has_time(self, name: str, cost: float, before: float = 0.0) -> bool:
        """Return whether a factorising solver of this cost [ns] ends in time if it starts after `before` [ns]."""
        if not self.deadline.is_set:
            return True
        needed = before + cost
        if name == "newton" and "newton_state" in vars(self):
            return self.deadline.fits(needed)
        return self.deadline.fits(get_loose_limit(self.problem) + needed) or self.deadline.fits(
            estimate_cost(name, self.problem).setup + needed
        )

    def has_time_to_factorise_after(self, steps: dict[str, Step], cost: float) -> bool:
        """Return whether work of this cost [ns] leaves time for a factorising solver, or all of them have ended."""
        if "newton_state" not in vars(self):
            return self.has_time_for_newton(cost)
        step = steps.get("newton")
        if self.newton_state is None or step is None or not step.over:
            return self.newton_state is not None and self.has_time("newton", self.newton, cost)
        return not step.late

    def leaves_time(self, stage: Stage, step: Step) -> bool:
        """Return whether a stage of any solver but sweeps can end before the deadline."""
        if isinstance(step, RelaxedNewton):
            return self.has_time("newton", stage.cost)
        if isinstance(step, Newton):
            return self.newton_state is not None and self.has_time("newton", self.newton_state.cost)
        if step.name == "direct":
            return self.has_time("direct", self.direct if self.can_pivot else stage.cost)
        if step.state is not None:
            return True
        return self.deadline.fits(estimate_cost(stage.solver, self.problem).setup / DECISIONS.time_share)

    @cached_property
    def factorises_first(self) -> bool:
        """Whether a factorising solver costs less than the first sweeps, or sweeps do not accept the problem.

        The cost to factor a sparse A depends on its fill-in, which only an analysis computes. Before the first sweeps,
        therefore, only the costs of `direct` and of Newton's method over bodies or velocities are compared.
        """
        p = self.problem
        if self.law == "linear" or p.cones.has_round or (self.can_pivot and self.direct < self.first):
            return True
        # Started at the same point as a failed compiled call, Newton's method would stall again.
        if self.compiled_call_failed or p.matrix is not None:
            return False
        return self.min_newton_cost < self.first and self.newton < self.first

    def __iter__(self) -> Iterator[Stage]:
        """Yield the stages in order. The caller runs a stage only if the stages before it did not solve the problem."""
        p, ratio, first = self.problem, DECISIONS.budget_ratio, self.first
        if p.matrix is not None and self.law == "linear":
            yield Stage("direct", inf, self.min_newton_cost, "linear, a matrix")
        relaxed = starts_relaxed(p)
        if relaxed:
            yield from self.iterate_relaxed_stages()
        max_cost = self.min_newton_cost if self.law == "linear" else first
        pivots_first = self.factorises_first and self.can_pivot and self.direct < max_cost
        if pivots_first:
            n = ratio * DECISIONS.pivot_factorisations
            yield Stage("direct", n, ratio * self.direct, "a narrow band: before any analysis")
        elif not (relaxed or self.factorises_first):
            yield self.sweeps(first, "the first sweeps, before any analysis")
        if not relaxed and not self.factorises_first and first < self.newton < inf:
            why = f"up to {format_seconds(1e-9 * self.newton)}, as much as {next(iter(self.solver_costs))} costs"
            yield self.sweeps(self.newton - first, why, self.newton)
        if p.generalized is not None and not np.all(p.compliance):
            yield from islice(self.iterate_factorising_stages(0.25 * ratio), 1)
            # The certificate's smallest violation is computed over velocities.
            cost = self.newton if self.newton_state is None else self.newton_state.cost
            yield Stage("certificate", 1.0, cost, "whether the least violation proves that there is none")
        if relaxed:
            yield from self.iterate_alternating_stages()
            return
        for stage in self.iterate_factorising_stages(ratio):
            if not (pivots_first and stage.solver == "direct"):  # It has had this budget.
                yield stage
        if self.law == "coulomb" and p.generalized is None and ratio * self.unit >= RATES["linear program"]:
            yield Stage("certificate", 1.0, RATES["linear program"], "whether a linear program proves it")
        yield from self.iterate_alternating_stages()

    def iterate_relaxed_stages(self) -> Iterator[Stage]:
        """Yield the first stages of a large problem with friction, unless they have run on a larger problem."""
        if self.first_stage <= 1:
            cost = self.min_newton_cost
            least = cost / self.relaxed_sweep
            yield Stage("anderson", inf, cost, "before any analysis", least=least, position=1)
        state = self.newton_state
        if state is None:
            return
        cost = ADMM_FRACTION * state.cost
        iterations = min(cost / (SWEEPS_PER_ADMM_ITERATION * self.relaxed_sweep), MAX_ADMM_ITERATIONS)
        runs_admm = iterations >= MIN_ADMM_ITERATIONS
        if self.first_stage <= 2:
            why = f"up to {format_seconds(1e-9 * state.cost)}, as much as newton costs"
            least = state.cost / self.relaxed_sweep
            if runs_admm:
                least = min(least, SWEEPS_PER_ADMM_ITERATION * iterations)
            yield Stage("anderson", inf, state.cost, why, least=least, position=2)
        if self.first_stage <= 3 and runs_admm:
            why = f"up to {ADMM_FRACTION:g} times newton's cost"
            yield Stage("admm from zero", iterations, cost, why, position=3)
        if self.first_stage <= 4:
            n, why = RELAXED_BUDGET_RATIO * state.steps, "exact if no contact slips"
            yield Stage("newton on the relaxation", n, state.cost, why, position=4)
        if self.log is None or self.log.relaxed is not None:
            n, why = DECISIONS.trial_iterations, "from the relaxation, while it is predicted to end soon"
            yield from self.repeat_while_converging(Stage("admm", n, n * self.relaxed_sweep, why), MAX_TRIALS)

    def iterate_factorising_stages(self, times: float) -> Iterator[Stage]:
        """Yield stages of the factorising solvers; each may cost `times` the estimated cost of the cheapest of them."""
        budget = times * self.newton
        for name, cost in self.solver_costs.items():
            if cost <= budget:
                why = f"{times:.3g} times its estimated cost of {format_seconds(1e-9 * cost)}"
                yield self.factorisation(name, times * cost, why)

    def iterate_alternating_stages(self) -> Iterator[Stage]:
        """Yield all solvers in rounds with doubled work, until no solver improves the residual in two rounds."""
        self.remaining_cost = DECISIONS.total_ratio * self.unit
        times = DECISIONS.budget_ratio
        if starts_relaxed(self.problem):
            times = DECISIONS.turn_factorisations / DECISIONS.factorisations
        for k in range(MAX_ALTERNATIONS):
            before = self.best
            for stage in self.iterate_one_round(times * 2.0**k):
                if self.remaining_cost < 1.0:  # Less than 1 ns remains.
                    return
                fraction = min(1.0, self.remaining_cost / stage.cost)
                self.remaining_cost -= fraction * stage.cost
                yield replace(stage, iterations=fraction * stage.iterations, cost=fraction * stage.cost)
            if k > 0 and self.best >= before:
                return

    def iterate_one_round(self, times: float) -> Iterator[Stage]:
        """Yield one round, in which each solver may cost `times` the cheapest factorising solver."""
        p, cost, setup = self.problem, times * self.unit, 0.0
        why = f"in turn, {times:.3g} times the cheapest factorising solver's cost"
        if starts_relaxed(p):
            yield from (self.factorisation(name, cost, why) for name in self.solver_costs)
            # An iteration costs as much as a sweep under the cone law.
            n = ADMM_FRACTION * cost / self.relaxed_sweep
            yield from self.repeat_while_converging(Stage("admm", n, ADMM_FRACTION * cost, why))
            return
        n = 0.5 * cost / self.sweep  # An iteration of `admm` costs as much as two sweeps.
        if p.generalized is not None:
            # `admm` forms and factors A of J and M. Its set-up cost does not depend on cached data.
            setup = estimate_formation_cost(p, False)
            setup += estimate_first_factor_cost(p.m, float(p.metric.entries_of_matrix))
        yield from (self.factorisation(name, cost, why) for name in self.solver_costs)
        if setup <= cost:
            yield from self.repeat_while_converging(Stage("admm", n, cost, why))
        if not self.sweeps_failed and not p.cones.has_round:
            before = self.best
            yield self.sweeps(cost, why)
            self.sweeps_failed = self.best >= before

    def repeat_while_converging(self, stage: Stage, max_more: int = 1) -> Iterator[Stage]:
        """Yield a stage. On large problems with friction, repeat it while it is predicted to converge.

        It is repeated while `max_more` further stages of the same gain reach tol.
        """
        is_converging = True
        while is_converging:
            before = self.best
            yield stage
            gains = starts_relaxed(self.problem) and self.best < before
            is_converging = gains and self.best * (self.best / before) ** max_more <= self.log.tol

    def factorisation(self, name: str, cost: float, why: str) -> Stage:
        """Return the stage of a factorising solver with the budget `cost` [ns]."""
        steps = DECISIONS.pivot_factorisations
        if name == "newton" and self.newton_state is not None:
            steps = self.newton_state.steps
        return Stage(name, cost / self.solver_costs[name] * steps, cost, why)

    def sweeps(self, cost: float, why: str, max_remaining: float = inf) -> Stage:
        """Return a stage of sweeps with the budget `cost` [ns].

        Sweeping stops if the sweeps that are still needed are predicted to cost more than `max_remaining` [ns].
        """
        return Stage("anderson", cost / self.sweep, cost, why, max_remaining / self.sweep)


@dataclass
class AutoState:
    """State of one solve."""

    problem: Problem
    failed_call: tuple[int, ...] | None = None  # Counts of a compiled call that has failed.
    loop: Loop | None = None  # Loop of the solve, if it records a history.
    first_stage: int = 1  # Position of the first stage that has not run on a problem with more islands.


@dataclass(frozen=True)
class Auto(Solver):
    """Select and combine other solvers; the solution's message and `stages` name them."""

    lazy_modules = ("scipy.sparse.linalg", "scipy.optimize")

    def prepare(self, problem: Problem) -> AutoState:
        """Return the state of a new solve. Nothing is prepared."""
        return AutoState(problem)

    def start_workers(self, state: AutoState, time_limit: float) -> None:
        """Start the process of the backend that solves a program with a singular P."""
        if state.problem.has_singular_program:
            for spec in program_backends()[:1]:
                spec.load()().start_workers(state.problem, time_limit)

    def run(
        self, state: AutoState, impulse: FloatArray, max_iter: int, tol: float, time_limit: float | None
    ) -> Claim:
        if state.loop is None:
            return self._run(state, impulse, max_iter, tol, time_limit)
        recorder = Recorder(state.loop)
        recorder.record_impulse("start", 0, impulse)
        claim = self._run(state, impulse, max_iter, tol, time_limit, recorder)
        last = claim.stages[-1].solver if claim.stages else "start"
        recorder.record_impulse(last, claim.iterations, impulse)
        return claim

    def _run(
        self,
        state: AutoState,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None,
        recorder: Recorder | None = None,
    ) -> Claim:
        """Run as `run`, and let `recorder`, if it is given, write the history."""
        problem, deadline = state.problem, Deadline(time_limit)
        if problem.has_singular_program:
            return run_program_backends(SolveLog(problem, tol, max_iter, deadline), impulse)
        counts: tuple[int, ...] | None = state.failed_call
        if counts is None and max_iter >= MIN_ITERATIONS_FOR_COMPILED_CALL:
            own = choose_call_deadline(problem, deadline)
            result, counts = AUTO.solve_and_judge(problem, impulse, tol, own)
            if result is not None and result.relative <= tol:
                claim = AUTO.make_claim(problem, counts, impulse, result.relative)
                if claim.iterations <= max_iter:
                    impulse[:] = result.impulse
                    return replace(claim, judged=result)
        failed = AUTO.list_claims_of_failed_call(problem, counts)
        if problem.m == 0:
            return Claim(Status.CONVERGED, 0, {}, "nothing to solve")
        log = SolveLog(problem, tol, max_iter, deadline)
        tree = DecisionTree(problem, deadline, log, state.first_stage)
        tree.compiled_call_failed = bool(failed) and problem.generalized is not None
        tree.started_from_zero = tree.compiled_call_failed and not (impulse - problem._start).any()
        log.start_from_better_impulse(impulse)
        log.recorder = recorder
        try:
            if max_iter > 0 and log.best > tol and not log.done():
                for name, claim in failed:
                    log.record_stage(name, claim, log.best)
                solve(log, tree)
        except KeyboardInterrupt:
            log.interrupted = True  # Return the best impulse so far also after Ctrl-C.
        except BREAKDOWN as error:
            log.failure = format_error(error)
        impulse[:] = log.result if log.best > tol else log.impulse
        return log.make_claim()


@np.errstate(all="ignore")  # Results that overflow are judged.
def solve(log: SolveLog, tree: DecisionTree) -> None:
    """Run the stages of the tree until one solves the problem or no stage remains. Then search for a certificate."""
    steps: dict[str, Step] = {}
    if log.deadline.is_set and tree.is_late and not log.problem.cones.has_round:
        sweep_until_deadline(log, tree, steps)
        return
    stages = iter(tree)
    # Check this first, because the tree computes costs before it yields the next stage.
    while not log.done():
        stage = next(stages, None)
        if stage is None:
            break
        if stage.solver == "certificate":
            if log.deadline.fits(stage.cost):
                is_matrix = log.problem.generalized is None
                (certify_by_linear_programs if is_matrix else certify_by_least_violation)(log)
            continue
        step = steps.get(stage.solver)
        if step is None:
            step = steps[stage.solver] = create_solver_step(stage.solver, log, tree)
        if log.deadline.is_set and not step.over:
            if isinstance(step, Sweeps):
                cost = min(stage.cost, DECISIONS.time_share * log.deadline.get_remaining_nanoseconds())
                if not stage.position and not tree.has_time_to_factorise_after(steps, cost):
                    sweep_until_deadline(log, tree, steps)
                    return
            elif not tree.leaves_time(stage, step):
                step.over = step.late = log.timed_out = True
        if step.over or (isinstance(step, Sweeps) and step.is_hopeless(stage.least)):
            tree.skip(stage)
        else:
            step.least = stage.least
            step.run(stage.iterations)
        if stage.position and not log.done() and solve_unsolved_islands(log, stage.position + 1):
            return
    newton = steps.get("newton")
    if newton is not None and not newton.over and not log.done() and not log.deadline.is_set:
        # No solver gained, but Newton's method has not ended. By name it would go on.
        state = tree.newton_state
        step_cost = tree.solver_costs["newton"] / state.steps if state is not None else inf
        newton.run(min(get("newton").max_iter, MAX_LAST_NEWTON_COST / step_cost))
    if log.timed_out and not log.done():
        sweep_until_deadline(log, tree, steps)
    can_continue = log.remaining_iterations > 0 or log.last_stage_failed
    if log.best > log.tol and log.certificate is None and can_continue:
        certify_infeasibility(log)


def solve_unsolved_islands(log: SolveLog, first_stage: int) -> bool:
    """Solve the islands that are not solved as a problem of their own, and return whether there are other islands.

    `first_stage` is the position of the first stage that has not run.
    """
    problem = log.problem
    island_of_block, table = residuals_by_island(problem.metric, log.result)
    unsolved = table[:, 0] > log.tol
    if unsolved.all():
        return False
    blocks = np.flatnonzero(unsolved[island_of_block]).astype(np.int32)
    rows = get_rows_of_blocks(problem, blocks)
    state = AutoState(restrict_to_blocks(problem, blocks, rows), first_stage=first_stage)
    impulse, result = log.result[rows], log.result.copy()
    claim = Auto()._run(state, impulse, log.remaining_iterations, log.tol, log.time_left)
    result[rows] = impulse
    log.judge_and_store_best(result)
    log.record_part(claim, rows)
    return True


def sweep_until_deadline(log: SolveLog, tree: DecisionTree, steps: dict[str, Step]) -> None:
    """Use the remaining time for sweeps: no factorising solver would end in time.

    On large problems with friction, `admm`, which needs no factor there, gets half of the time after the first half.
    """
    log.timed_out = True
    shared = ("anderson", "admm from zero") if starts_relaxed(log.problem) else ()
    for k, name in enumerate((*shared, "anderson")):
        step = steps[name] = steps.get(name) or create_solver_step(name, log, tree)
        setup = 0.0 if step.state is not None else estimate_cost(name, log.problem).setup
        if not step.over and (name == "anderson" or log.deadline.fits(setup)):
            assert isinstance(step, Iterations)
            step.least, step.time_fraction = inf, DECISIONS.time_share if k < len(shared) else 1.0
            step.run(inf)
        if log.done():
            return


def create_solver_step(name: str, log: SolveLog, tree: DecisionTree) -> Step:
    """Create the step of the solver `name`; Newton's method gets the state that the tree has analysed."""
    step = STEP_CLASSES.get(name, Iterations)(name, log)
    if isinstance(step, RelaxedNewton):
        step.like = tree.newton_state
    if isinstance(step, Newton):
        step.state, step.started_from_zero = tree.newton_state, tree.started_from_zero
    return step


SPEC = SolverSpec(
    name="auto",
    factory=Auto,
    laws=frozenset({"linear", "lcp", "coulomb", "cone"}),
    box_friction_laws=frozenset({"coulomb", "cone"}),
    operators=frozenset(OPERATORS),
    round_cones=True,
    supports_rolling=True,
    small=AUTO,
    singular_programs=True,
    resumable=False,
    delegates=True,
    max_iter=1_000_000,
    summary="chooses and combines other solvers by counted cost",
)
