"""Select and combine other solvers: the following decision tree, with two estimated costs (`costs.py`).

    the start is a solution     nothing runs
    a program with a singular P `PROGRAM_BACKENDS`, one after the other; a linear program searches for a certificate if
                                none finds a solution
    a small problem             one compiled call (`small.py`), for at most 64 rows, for small islands with friction,
                                and for J and M if Newton's method costs less than 100 sweeps and few contacts are
                                between bodies; if it fails, the problem is treated as any other
    a matrix                    `direct`: linear systems without a limit; bounded rows of a narrow band with up to
                                DIRECT_BUDGET_RATIO times the factorisations expected for `newton`; bounded rows of an
                                asymmetric matrix with the same budget, but after sweeps
    sweeps (`anderson`)         EXPECTED_SWEEPS before an analysis gives Newton's cost, then up to that cost, or until
                                the predicted cost of the remaining sweeps exceeds it. Linear problems, and bounded rows
                                and cones that are not given as a matrix, are swept only if MIN_SWEEPS_PER_NEWTON
                                sweeps cost less than Newton's method. Contacts of a matrix are solved exactly
    a loose pile                at least MIN_PILE_ROWS contact rows under Coulomb's law, nearly all between different
                                pairs: for the same cost again, conjugate gradients over sweeps (`nncg`), first under
                                the cone law unless there is rolling or torsional friction
    Newton's method (`newton`)  up to NEWTON_BUDGET_RATIO times its cost: over bodies or rows; for J and M over
                                velocities and over rows of A, the cheaper one first. If it stalls from the impulse of
                                another solver, it starts again from zero
    a certificate               for J and M with a rigid row, from the smallest violation, after RELIABLE_BUDGET_RATIO
                                times Newton's cost over velocities (NEWTON_BUDGET_RATIO if another form is cheaper);
                                for other problems under Coulomb's law by a linear program, if the residual is above
                                NEAR_SOLUTION_RESIDUAL
    alternation                 with doubled work in each round, until no solver improves the residual in two stages:
                                `newton` (for J and M also over rows, within NEWTON_BUDGET_RATIO times the cost or
                                MIN_ROW_FORM_BUDGET; earlier if the compiled call failed, or before the end), `admm`
                                (for J and M once a factor of A costs no more), `nncg`, and sweeps while they improve;
                                in total TOTAL_BUDGET_RATIO times Newton's cost and at most MAX_ALTERNATION_COST
    the end                     a linear program searches for a certificate if none was tried (`certify.py`)

Each solver continues where it stopped, and the result is the best impulse of all. Costs are estimated, never measured,
so the same problem is solved in the same way on every machine. With a time limit, the tree is the same with these
exceptions: a factorising solver starts only if its result is expected in time; sweeps come first in every case if
RELIABLE_BUDGET_RATIO times Newton's cost does not fit; sweeps before Newton's method use at most half of the remaining
time; sweeps use the rest if Newton's method has no time. `Solution.stages` lists the stages that ran,
`lavender.explain` the stages that would run.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from math import inf, nan

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import NEVER, Deadline, seconds
from lavender.base.errors import BREAKDOWN, format_error
from lavender.judge.residuals import best_of_islands
from lavender.judge.solution import Claim, Status
from lavender.problem import OPERATORS, Problem
from lavender.problem.derived import cached_property
from lavender.solvers import costs
from lavender.solvers.certify import (
    MIN_LINEAR_PROGRAM_COST,
    certify_by_least_violation,
    certify_infeasibility,
    linear_programs,
)
from lavender.solvers.islands import count_pairs
from lavender.solvers.newton import WARM_START_MAX_RESIDUAL, NewtonState
from lavender.solvers.registry import Solver, SolverSpec, get, specs
from lavender.solvers.setup_times import (
    first_factor_time,
    first_sweep_time,
    formation_time,
    forming_time,
    matrix_setup_time,
    tight_limit,
)
from lavender.solvers.small import AUTO, NO_TIME_MESSAGE, time_fraction
from lavender.solvers.solve_log import MIN_GAIN_RATIO, SolveLog
from lavender.solvers.steps import (
    METHODS,
    NEAR_SOLUTION_RESIDUAL,
    SWEEPS_TIME_FRACTION,
    Iterations,
    Newton,
    Step,
    Sweeps,
    setup_time,
)

# Newton's method may use this multiple of its estimated cost before solvers alternate.
NEWTON_BUDGET_RATIO = 10.0
# `direct` may use this multiple of the factorisations that Newton's method is expected to need.
DIRECT_BUDGET_RATIO = 4.0
MAX_ALTERNATIONS = 6  # Largest number of rounds of alternation, each with twice the work of the round before.
TOTAL_BUDGET_RATIO = 200.0  # All solvers together may use this multiple of Newton's estimated cost.
# Largest estimated cost [ns] of the alternation, and of Newton's method unless RELIABLE_BUDGET_RATIO times its cost is
# more.
MAX_ALTERNATION_COST = 6e10
# If Newton's method converges reliably, sweeps precede it only if this many cost less than it.
MIN_SWEEPS_PER_NEWTON = 200.0
# Sweeps before the first factor of a sparse matrix, which may fill, and the largest fraction of nonzeros of such a one.
SWEEPS_BEFORE_SPARSE_FACTOR, SPARSE_FRACTION = 32.0, 0.05
# Newton's method over rows may use at least this estimated cost [ns], however much cheaper another form is.
MIN_ROW_FORM_BUDGET = 5e6
# Below this many contact rows, Newton's method is faster than conjugate-gradient sweeps and then Newton's method.
MIN_PILE_ROWS = 390
# `direct` runs first up to this half bandwidth, if that is at most a quarter of the rows.
MAX_DIRECT_BAND = 100
RELIABLE_BUDGET_RATIO = 4.0  # Within this multiple of the estimated cost, nine of ten problems converge.
# Fraction of the estimated cost after which an interior point has an impulse that improves on sweeps.
EARLY_RESULT_FRACTION = 0.25
# A quadratic program with a singular P is solved by the first of these that is installed and solves it; osqp is always
# installed.
PROGRAM_BACKENDS = ("piqp", "clarabel", "osqp")
# The compiled call is only made if at least this many iterations are allowed; it usually needs fewer.
MIN_ITERATIONS_FOR_COMPILED_CALL = 200


@dataclass(frozen=True)
class Stage:
    """One stage of the tree.

    Parameters
    ----------
    solver : str
        Name in `METHODS`, or "certificate".
    iterations : float
        Largest number of iterations.
    cost : float, ns
        Estimated cost of these iterations.
    why : str
        Reason, for `lavender.explain`.
    least : float
        Sweeps stop if they predict that more than this number remain.
    """

    solver: str
    iterations: float
    cost: float
    why: str
    least: float = inf


class Tree:
    """The stages of `auto` for a problem, as an iterable, and the costs that it compares [ns].

    The caller sets `best`, the relative residual so far, and adds the cost of stages that it skips to `remaining_cost`.
    """

    cost_before_newton = 0.0  # Cost [ns] of the sweeps before Newton's method.
    remaining_cost = 0.0  # Cost [ns] that remains for the alternation.
    compiled_call_failed = False  # The compiled call over velocities of J and M has failed.
    sweeps_failed = False  # Sweeps did not improve the residual in the alternation.
    best = nan

    def __init__(self, problem: Problem, deadline: Deadline = NEVER) -> None:
        self.problem, self.law, self.deadline = problem, problem.law, deadline

    @cached_property
    def sweep(self) -> float:
        """Cost of one sweep [ns]."""
        return costs.sweep_cost(self.problem)

    @cached_property
    def min_newton_cost(self) -> float:
        """Lower bound of the cost of Newton's method [ns], without its analysis."""
        return costs.newton_cost(costs.min_count(self.problem), self.law)

    @cached_property
    def states(self) -> dict[str, NewtonState]:
        """States of Newton's method after its analysis, the cheaper form first; empty if it is refused or too late."""
        is_possible = get("newton").refuses(self.problem) is None and not self.is_late
        return self.prepare_newton("newton") if is_possible else {}

    def prepare_newton(self, name: str) -> dict[str, NewtonState]:
        """Return {name: state} of Newton's method in this form after its analysis; empty if that breaks down."""
        try:
            return {name: get("newton").load()(**METHODS[name][1]).prepare(self.problem)}
        except BREAKDOWN:
            return {}

    @cached_property
    def row_form_cost(self) -> float:
        """Lower bound of the cost [ns] of Newton's method over an A formed of J and M; inf if that is not possible."""
        p, state = self.problem, self.states.get("newton")
        if state is None or state.general is None or p.cones.has_round:
            return inf
        return costs.newton_cost(costs.formed_count(p), self.law)

    def add_row_form(self, max_cost: float) -> bool:
        """Analyse A of J and M, too, if its Newton's method costs less than `max_cost` [ns] and has time.

        A form that has failed in the compiled call becomes the last one. Return whether a form was added.
        """
        p, states = self.problem, self.states
        if "newton over rows" in states or self.row_form_cost >= max_cost or self.is_late:
            return False
        if self.deadline.is_set and self.deadline.passed(matrix_setup_time(p) + 3.0 * forming_time(p)):
            return False
        both = states | self.prepare_newton("newton over rows")
        failed = self.compiled_call_failed
        self.states = dict(
            sorted(both.items(), key=lambda item: (failed and item[1].general is not None, item[1].cost))
        )
        return len(both) > len(states)

    @property
    def newton(self) -> float:
        """Cost of Newton's method [ns] in its cheapest form; inf if it is not possible."""
        return min((state.cost for state in self.states.values()), default=inf)

    @property
    def is_late(self) -> bool:
        """Whether no factorising solver can return a result before the deadline."""
        return not self.has_time("newton", self.min_newton_cost)

    def has_time(self, name: str, cost: float, before: float = 0.0) -> bool:
        """Return whether a factorising solver of this cost [ns] has a result in time if it starts after `before` [ns].

        An interior point has a result after each factorisation; under Coulomb's law, and in `direct`, only at the end.
        """
        if not self.deadline.is_set:
            return True
        needed = 1e-9 * (
            before + (1.0 if name == "direct" or self.law == "coulomb" else EARLY_RESULT_FRACTION) * cost
        )
        if name == "newton" and "states" in vars(self):
            return not self.deadline.passed(needed)
        if not self.deadline.passed(tight_limit(self.problem) + needed):
            return True
        return not self.deadline.passed(setup_time(name, self.problem) + needed)

    @property
    def pivots(self) -> str:
        """Reason to use `direct` for bounded rows of a matrix, "a narrow band" or "not symmetric", else empty."""
        p, band = self.problem, min(MAX_DIRECT_BAND, self.problem.m // 4)
        if p.matrix is None or self.law != "lcp":
            return ""
        entries = len(p._compressed[1])
        if p.is_symmetric:
            return "a narrow band" if entries <= (2 * band + 1) * p.m and max(p.bandwidth) <= band else ""
        return "not symmetric" if entries > SPARSE_FRACTION * p.m**2 else ""

    @cached_property
    def is_loose(self) -> bool:
        """Whether nearly every contact under Coulomb's law is between another pair of bodies or of trees of M.

        Sweeps then determine quickly which contacts stick.
        """
        p = self.problem
        if self.law != "coulomb" or np.count_nonzero(p.cones.contact_rows) < MIN_PILE_ROWS:
            return False
        return 4 * count_pairs(p) > 3 * p.n_blocks

    def __iter__(self) -> Iterator[Stage]:
        """Yield the stages in order; each is only needed if the stages before it did not solve the problem."""
        if self.problem.matrix is not None and self.law == "linear":
            p = self.problem
            if len(p._compressed[1]) < SPARSE_FRACTION * p.m**2 and max(p.bandwidth) > MAX_DIRECT_BAND:
                yield Stage(
                    "anderson",
                    SWEEPS_BEFORE_SPARSE_FACTOR,
                    SWEEPS_BEFORE_SPARSE_FACTOR * self.sweep,
                    "a sparse matrix whose factor may fill",
                    SWEEPS_BEFORE_SPARSE_FACTOR,
                )
            yield Stage("direct", inf, self.min_newton_cost, "linear, a matrix")
        pivots, max_factorisations = self.pivots, DIRECT_BUDGET_RATIO * costs.factorisations(self.law)
        if pivots == "a narrow band":
            yield Stage("direct", max_factorisations, self.min_newton_cost, f"bounded rows, {pivots}")
        # Fill determines the cost of a factor, and only an analysis gives it: before it, the usual number of sweeps.
        yield from self.sweeps_first(max(self.min_newton_cost, costs.EXPECTED_SWEEPS * self.sweep))
        yield from self.sweeps_first(min(self.newton, self.row_form_cost))
        row_form_budget = max(NEWTON_BUDGET_RATIO * self.newton, MIN_ROW_FORM_BUDGET)
        self.add_row_form(row_form_budget if self.compiled_call_failed else self.newton)
        yield from self.sweeps_first(self.newton)
        if pivots == "not symmetric":
            yield Stage("direct", max_factorisations, self.newton, f"bounded rows, {pivots}")
        if self.problem.generalized is not None and not np.all(self.problem.compliance):
            velocity_state = self.states.get("newton")  # The smallest violation is found over velocities.
            cost = self.newton if velocity_state is None else velocity_state.cost
            is_cheap = cost <= max(NEWTON_BUDGET_RATIO * self.newton, MIN_ROW_FORM_BUDGET)
            budget_ratio = RELIABLE_BUDGET_RATIO if is_cheap else NEWTON_BUDGET_RATIO
            yield from islice(self.factorisations(budget_ratio), 1)
            yield Stage("certificate", 1.0, cost, "whether the least violation proves that there is none")
        yield from self.factorisations(NEWTON_BUDGET_RATIO)
        self.add_row_form(max(NEWTON_BUDGET_RATIO * self.newton, MIN_ROW_FORM_BUDGET))
        if self.law == "coulomb" and self.problem.generalized is None and self.best > NEAR_SOLUTION_RESIDUAL:
            yield Stage("certificate", 1.0, MIN_LINEAR_PROGRAM_COST, "whether a linear program proves it")
        unit = max((state.cost for state in self.states.values()), default=costs.EXPECTED_SWEEPS * self.sweep)
        unit = min(unit, max(self.newton, MIN_ROW_FORM_BUDGET))
        total = min((TOTAL_BUDGET_RATIO - NEWTON_BUDGET_RATIO) * unit, MAX_ALTERNATION_COST)
        self.remaining_cost = total - self.cost_before_newton
        for k in range(MAX_ALTERNATIONS):
            before = self.best
            for stage in self.alternate(2.0**k):
                if self.remaining_cost < 1.0:  # [ns]
                    return
                fraction = min(1.0, self.remaining_cost / stage.cost)
                self.remaining_cost -= fraction * stage.cost
                yield replace(stage, iterations=fraction * stage.iterations, cost=fraction * stage.cost)
            # Near a solution, the row form needs only a few of its factorisations.
            ratio = NEWTON_BUDGET_RATIO if self.best <= WARM_START_MAX_RESIDUAL else 1.0
            no_gain = k > 0 and self.best > MIN_GAIN_RATIO * before
            if no_gain and not self.add_row_form(ratio * self.remaining_cost):
                return

    def factorisations(self, times: float) -> Iterator[Stage]:
        """Yield stages of Newton's method, in all its forms, with this multiple of their estimated costs."""
        for name, state in self.states.items():
            ratio = min(times, max(RELIABLE_BUDGET_RATIO, MAX_ALTERNATION_COST / state.cost))
            why = f"{ratio:.3g} times its counted cost of {seconds(1e-9 * state.cost)}"
            yield Stage(name, ratio * state.steps, ratio * state.cost, why)

    def sweeps_first(self, newton: float) -> Iterator[Stage]:
        """Yield sweeps up to Newton's cost `newton` [ns], of which earlier sweeps are subtracted.

        The callers first pass a lower bound of the cost, then the cost after the analysis, then that with the row form.
        """
        cost = newton - self.cost_before_newton
        # Newton's method then converges within its estimated cost, if that fits the time limit.
        is_reliable = self.law == "linear" or (self.law != "coulomb" and self.problem.matrix is None)
        is_reliable = is_reliable and not self.deadline.passed(1e-9 * RELIABLE_BUDGET_RATIO * newton)
        sweeps_pay = not is_reliable or MIN_SWEEPS_PER_NEWTON * self.sweep <= newton
        if sweeps_pay and 0.0 < cost < inf and not self.problem.cones.has_round:
            self.cost_before_newton += cost
            why = f"{seconds(1e-9 * cost)} of what newton costs"
            yield self.sweeps(cost, why, newton)
            if self.is_loose:
                has_rolling = self.problem.cones.has_more_parts
                yield self.iterations("nncg" if has_rolling else "nncg from the cone law", cost, why)

    def sweeps(self, cost: float, why: str, max_remaining: float = inf) -> Stage:
        """Return a stage of sweeps of this cost [ns]; it stops if it predicts more than `max_remaining` [ns]."""
        return Stage("anderson", cost / self.sweep, cost, why, max_remaining / self.sweep)

    def iterations(self, name: str, cost: float, why: str) -> Stage:
        """Return a stage of this cost [ns] of a solver whose iterations cost as much as two sweeps."""
        return Stage(name, 0.5 * cost / self.sweep, cost, why)

    def alternate(self, times: float) -> Iterator[Stage]:
        """Yield one round of all solvers, with this multiple of the cost of Newton's method before."""
        cost = (
            times
            * NEWTON_BUDGET_RATIO
            * (self.newton if self.newton < inf else costs.EXPECTED_SWEEPS * self.sweep)
        )
        why = f"in turn, {times * NEWTON_BUDGET_RATIO:g} times newton's cost"
        yield from self.factorisations(times * NEWTON_BUDGET_RATIO)
        p = self.problem
        # Time to form A of J and M if no stage did, and its first factor; it does not depend on cached data.
        time_to_form = (
            0.0 if p.generalized is None or "newton over rows" in self.states else formation_time(p)
        )
        if (
            p.generalized is None
            or 1e9 * (time_to_form + first_factor_time(p.m, float(p.metric.entries_of_a))) <= cost
        ):
            yield self.iterations("admm", cost, why)
        yield self.iterations("nncg", cost, why)
        if not self.sweeps_failed and not self.problem.cones.has_round:
            before = self.best
            yield self.sweeps(cost, why)
            self.sweeps_failed = self.best > MIN_GAIN_RATIO * before


@dataclass
class AutoState:
    """State of one solve.

    Parameters
    ----------
    problem : Problem
    failed_call : tuple of int or None
        Counts of a compiled call that has failed; None if it has not been made.
    """

    problem: Problem
    failed_call: tuple[int, ...] | None = None


@dataclass(frozen=True)
class Auto(Solver):
    """Select and combine other solvers; the solution's message and `stages` name them."""

    def prepare(self, problem: Problem) -> AutoState:
        """Return the state of a new solve: nothing is prepared."""
        return AutoState(problem)

    def start_workers(self, state: AutoState, time_limit: float) -> None:
        """Start the process of the backend that solves a program with a singular P."""
        if state.problem.has_singular_program:
            for spec in program_backends()[:1]:
                spec.load()().start_workers(state.problem, time_limit)

    def run(
        self, state: AutoState, impulse: FloatArray, max_iter: int, tol: float, time_limit: float | None
    ) -> Claim:
        problem, deadline = state.problem, Deadline(time_limit)
        if problem.has_singular_program:
            return run_backends(problem, impulse, max_iter, tol, deadline)
        counts: tuple[int, ...] | None = state.failed_call
        if counts is None and max_iter >= MIN_ITERATIONS_FOR_COMPILED_CALL:
            fraction = time_fraction(problem, deadline.remaining() or inf)
            if fraction > 0.0:
                result, counts = AUTO.attempt(problem, impulse, tol, fraction * deadline.nanoseconds())
                if result is not None and result.relative <= tol:
                    claim = AUTO.claim(problem, counts, impulse, result.relative)
                    if claim.iterations <= max_iter:
                        impulse[:] = result.impulse
                        return claim
        failed = AUTO.failed_claims(problem, counts)
        if problem.m == 0:
            return Claim(Status.CONVERGED, 0, {}, "nothing to solve")
        if deadline.passed(first_sweep_time(problem)):
            impulse[:] = best_of_islands(problem, (impulse, problem._start), (), tol)
            return Claim(Status.TIME_LIMIT, 0, {}, NO_TIME_MESSAGE)
        tree = Tree(problem, deadline)
        tree.compiled_call_failed = bool(failed) and problem.generalized is not None
        log = SolveLog(problem, tol, max_iter, deadline)
        log.begin(impulse)
        try:
            if max_iter > 0 and log.best > tol and not log.done():
                for name, claim in failed:
                    log.note(name, claim, log.best)
                solve(log, tree)
        except KeyboardInterrupt:
            log.interrupted = True  # The best impulse is returned all the same.
        except BREAKDOWN as error:
            log.failure = format_error(error)
        impulse[:] = log.result if log.best > tol else log.impulse
        return log.claim()


def program_backends() -> list[SolverSpec]:
    """Return the specs of the installed `PROGRAM_BACKENDS`."""
    return [get(name) for name in PROGRAM_BACKENDS if not specs()[name].missing()]


@np.errstate(all="ignore")  # Results that overflow are judged.
def run_backends(
    problem: Problem, impulse: FloatArray, max_iter: int, tol: float, deadline: Deadline
) -> Claim:
    """Solve a program with a singular P by the first backend that reaches tol, or search for a certificate.

    If none reaches tol, the result is the one with the smallest error of the program.
    """
    log, start = SolveLog(problem, tol, max_iter, deadline), impulse.copy()
    log.offer(impulse)
    error, best = program_error(problem, log.impulse), log.impulse
    try:
        for spec in program_backends():
            if log.done() and (log.status is not Status.ROUNDOFF_LIMIT or error <= tol):
                break
            solver, before, trial = spec.load()(), log.best, start.copy()
            state = solver.prepare(problem)
            claim = solver.run(state, trial, min(log.left, spec.max_iter), tol, log.time_left)
            log.offer(trial)
            log.note(spec.name, claim, before)
            for result in (trial, log.impulse if log.best <= tol else log.result):
                if program_error(problem, result) < error:
                    error, best = program_error(problem, result), result.copy()
            if tol == 0.0:
                break
        if error > tol > 0.0 and not log.done():
            linear_programs(log)
    except KeyboardInterrupt:
        log.interrupted = True
    except BREAKDOWN as failure:
        log.failure = format_error(failure)
    claim = log.claim()
    if log.best <= tol:
        impulse[:] = log.impulse
    else:
        impulse[:] = best
        if claim.status is Status.ROUNDOFF_LIMIT:  # This is only true for the impulse of the log.
            claim = replace(claim, status=Status.STALLED)
    return claim


def program_error(problem: Problem, impulse: FloatArray) -> float:
    """Return `QPSolution.error` of x and the multipliers (n + m,); inf if it is not a number."""
    error = float(problem.qp.solution(impulse).error)
    return error if error == error else inf


@np.errstate(all="ignore")  # Results that overflow are judged.
def solve(log: SolveLog, tree: Tree) -> None:
    """Run the stages of the tree until one solves the problem or no stage remains; then search for a certificate."""
    steps: dict[str, Step] = {}
    if log.deadline.is_set and tree.is_late and not log.problem.cones.has_round:
        Sweeps("anderson", log).finish()
        return
    lines = iter(tree)
    while not log.done():  # Checked before the tree computes the costs of the next stage.
        stage = next(lines, None)
        if stage is None:
            break
        if stage.solver == "certificate":
            if not log.ends_late(stage.cost):
                (linear_programs if log.problem.generalized is None else certify_by_least_violation)(log)
            continue
        step = steps.get(stage.solver)
        if step is None:
            step = steps[stage.solver] = make_step(stage.solver, log, tree)
        if log.deadline.is_set and not step.over:
            if isinstance(step, Sweeps):
                if not tree_goes_on(
                    tree, steps, min(stage.cost, SWEEPS_TIME_FRACTION * log.deadline.nanoseconds())
                ):
                    step.finish()
                    return
            elif step.name == "direct" or isinstance(step, Newton):
                cost = step.state.cost if isinstance(step, Newton) else stage.cost
                step.over = step.late = not tree.has_time(METHODS[stage.solver][0], cost)
            elif step.state is None:
                step.over = log.deadline.passed(RELIABLE_BUDGET_RATIO * setup_time(stage.solver, log.problem))
        if step.over:
            tree.remaining_cost += stage.cost
        else:
            step.least = stage.least
            step.run(stage.iterations)
            tree.best = log.best
    if log.best > log.tol and log.certificate is None and (log.left > 0 or log.last_stage_failed):
        certify_infeasibility(log)


def tree_goes_on(tree: Tree, steps: dict[str, Step], cost: float) -> bool:
    """Return whether a factorising solver can have a result in time after work of this cost [ns], or all have ended."""
    if "states" not in vars(tree):
        return tree.has_time("newton", tree.min_newton_cost, cost)
    unfinished = [name for name in tree.states if name not in steps or not steps[name].over]
    if tree.states and not unfinished and not any(steps[name].late for name in tree.states):
        return True
    return bool(unfinished) and tree.has_time("newton", tree.newton, cost)


def make_step(name: str, log: SolveLog, tree: Tree) -> Step:
    """Create the step of this name; Newton's method gets the state of the tree."""
    kinds = {"anderson": Sweeps, "direct": Step, "newton": Newton, "newton over rows": Newton}
    step = kinds.get(name, Iterations)(name, log)
    if isinstance(step, Newton):
        step.state = tree.states[name]
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
