"""Select and combine other solvers by their estimated costs (`solvers/costs.py`).

    start            if the start is a solution, nothing runs
    compiled call    one call for small problems, for small islands with friction, and for J and M if Newton's method
                     is estimated to cost no more than the first sweeps (`small.py`); attempted once. One island of
                     bounded rows and contacts over at most 40 velocities gets 6 sweeps and Newton steps over its rows
                     first, with the bits of worlds in lanes (`lavender_ext/batch/lanes_body.h`)
    large problems   under Coulomb's law, from `relaxed_rows` rows on (of J and M, if the velocities belong to free
                     bodies). The convex relaxation has the same solution if no contact slips, so it comes first, and
                     every iterate is judged under Coulomb's law. Islands that a stage has solved do not continue. If
                     bodies touch at several points and Newton's method costs few sweeps, 1 and 2 do not run
                     1. `anderson` under the cone law, while the sweeps that it predicts cost less than Newton's method
                     2. the same after an analysis of Newton's matrix, for at least `sweep_fraction` of its cost
                     3. interior points of `newton` on the relaxation. Contacts slip if their residual of it falls below
                        `slip_ratio` times Coulomb's. They then end if Coulomb's is above `trial_residual`, or if few
                        contacts are near sliding
                     4. `admm` from the relaxation's solution, `trial_iterations` at a time while it is predicted to end
                     The alternation follows
    sweeps           `anderson`, unless the problem is linear or large: `first_sweeps` sweeps. Sweeping continues up to
                     the cost of the cheapest factorising solver, unless more sweeps are predicted to be needed
    factorisations   `newton` (over velocities, bodies or rows of A), and for bounded rows of a matrix `direct`, the
                     cheapest first, each up to `budget_ratio` times its estimated cost
    certificate      a search for a proof that no solution exists: for J and M from the smallest violation of the
                     constraints, for other problems under Coulomb's law by a linear program
    alternation      the factorising solvers, `admm` and sweeps in turn, with doubled work in each round, until none
                     improves the residual in two rounds or the total cost exceeds `total_ratio` times the cheapest's.
                     On large problems with friction, sweeps do not run, `newton` begins with `turn_factorisations`, or
                     `cheap_turn`, which its last `turn_extension` extend while they halve the residual, and continues
                     its own plan; `admm` starts from the best impulse. After the last round `newton` uses the rest
    end              a search for a certificate by a linear program, if none was tried before (`certify.py`)

Linear problems given by a matrix, and others with a narrow band as A, start with `direct`. A program with a singular P
is solved by backends in turn (`lavender/programs`). The result is the best impulse of all stages. Costs are estimated,
never measured, so the same problem is solved in the same way on every machine. Under a time limit, a factorising solver
starts only if its estimated cost fits in the remaining time; sweeps before it use at most the fraction `time_share` of
the time, or all of it if no factorising solver fits. These are `nncg` under Coulomb's law, except on few bodies, and
else `anderson`. `Solution.stages` lists the stages that ran, `lavender.explain` the stages that would run. The
decisions depend on these numbers (`decisions.py`):

"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Deadline
from lavender.base.errors import BREAKDOWN, format_error
from lavender.judge.residuals import (
    choose_start,
    combine_best_islands,
    find_relative_at_zero,
    reuse_or_judge_impulse,
)
from lavender.judge.solution import Claim, SolverStage, Status, sum_work_counts
from lavender.problem import OPERATORS, Problem
from lavender.solvers import certify
from lavender.solvers.decisions import DECISIONS, SMALL_ROWS, describe_numbers
from lavender.solvers.islands import get_rows_of_blocks, restrict_to_blocks
from lavender.solvers.registry import Solver, SolverSpec, get, program_backends
from lavender.solvers.small import AUTO, describe_stages, describe_work
from lavender.solving.compiled_call import choose_call_deadline, fits_in_time
from lavender.solving.log import Recorder, SolveLog
from lavender.solving.loop import EMPTY_CLAIM, Loop
from lavender.solving.stages import DecisionTree
from lavender.solving.steps import Iterations, Sweeps, make_solver, prepare_sweeps
from lavender_ext.judge.measure import residuals_by_island

assert __doc__ is not None
__doc__ += describe_numbers() + "\n"


#: Claims of a solve that has time and iterations left.
FAILURES = Status.STALLED, Status.NUMERICAL_ERROR, Status.INFEASIBLE


@dataclass
class AutoState:
    """State of one solve."""

    problem: Problem
    failed_call: tuple[int, ...] | None = None  # Counts of a compiled call that has failed.
    loop: Loop | None = None  # Loop of the solve, if it records a history.
    recorder: Recorder | None = None  # Writes the history if it is requested.
    first_stage: int = (
        1  # Position of the first stage that has not run on a problem with more islands.
    )
    # Whether the user gave the start, so that a solve that fails from it begins again from the zero impulse.
    has_given_start: bool = False
    # Claim of the solve that has failed from the start, to which this solve from the zero impulse is added.
    first_claim: Claim = EMPTY_CLAIM


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
        self,
        state: AutoState,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None,
    ) -> Claim:
        if state.loop is not None:
            state.recorder = Recorder(state.loop)
            state.recorder.record_impulse("start", 0, impulse)
        deadline = Deadline(time_limit)
        claim = self._run(state, impulse, max_iter, tol, deadline)
        if state.has_given_start and claim.status in FAILURES and not deadline.has_passed():
            claim = self._run_from_zero(state, claim, impulse, max_iter, tol, deadline)
        if state.recorder is not None:
            last = claim.stages[-1].solver if claim.stages else "start"
            state.recorder.record_impulse(last, claim.iterations, impulse)
        return claim

    def _run_from_zero(
        self,
        state: AutoState,
        first: Claim,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        deadline: Deadline,
    ) -> Claim:
        """Solve once more from the zero impulse, and keep the better result in each island: a start never costs."""
        problem = state.problem
        if problem.has_singular_program or first.iterations >= max_iter:
            return first
        state.first_claim, state.failed_call = first, None
        again = problem._start.copy()
        claim = self._run(state, again, max_iter, tol, deadline)
        if claim.status is not Status.CONVERGED:
            is_proved = Status.INFEASIBLE in (first.status, claim.status)
            again = combine_best_islands(problem, impulse, (again,), tol, by_energy=is_proved)
            if claim.status is not Status.INFEASIBLE and claim.status is not Status.INTERRUPTED:
                claim = replace(claim, status=first.status, certificate=first.certificate)
        impulse[:] = again
        return replace(claim, message=f"{claim.message}; begun again from the zero impulse")

    def _run(
        self, state: AutoState, impulse: FloatArray, max_iter: int, tol: float, deadline: Deadline
    ) -> Claim:
        """Run as `run`, with a deadline."""
        problem, recorder = state.problem, state.recorder
        if problem.has_singular_program:
            backend, *others = program_backends()
            solver: Any = backend.load()()
            left = deadline.get_remaining_seconds()
            form = solver.prepare(problem)
            claim: Claim = solver.run(form, impulse, max_iter, tol, left, tuple(others))
            return claim
        counts: tuple[int, ...] | None = state.failed_call
        first: FirstSweeps | None = None
        if (
            deadline.is_set
            and problem.m > SMALL_ROWS
            and not problem.cones.has_round
            and recorder is None
        ):
            sweeps = FirstSweeps(problem, deadline)
            if not sweeps.newton_fits(DECISIONS.ample_time):
                first = sweeps
                result_of_sweeps = first.run(impulse, tol, max_iter)
                if result_of_sweeps is not None:
                    return add_claim(state.first_claim, result_of_sweeps)
        may_call = counts is None and max_iter >= DECISIONS.call_iterations
        if may_call and (first is not None or fits_in_time(problem, deadline)):
            # The impulse of sweeps is returned if the call does not end.
            own = deadline if first is not None else choose_call_deadline(problem, deadline)
            result, counts = AUTO.call.solve(problem, impulse, tol, own)
            if result is not None and result.relative <= tol:
                claim = add_claim(
                    state.first_claim,
                    AUTO.make_claim(problem, counts, impulse, result.relative),
                )
                if claim.iterations <= max_iter:
                    impulse[:] = result.impulse
                    return replace(claim, judged=result)
        failed = AUTO.list_claims_of_failed_call(problem, counts)
        if problem.m == 0:
            return Claim(Status.CONVERGED, 0)
        log = SolveLog(problem, tol, max_iter, deadline, state.first_claim)
        call_failed = bool(failed) and problem.generalized is not None
        tree = DecisionTree(
            problem,
            deadline,
            log,
            state.first_stage,
            call_failed=call_failed,
            started_from_zero=call_failed and not (impulse - problem._start).any(),
            has_swept=first is not None,
        )
        log.start_from_better_impulse(impulse)
        log.recorder = recorder
        if first is not None:
            log.record_stage(first.name, first.claim, first.before)
        try:
            if max_iter > 0 and log.best > tol and not log.done():
                for name, claim in failed:
                    log.record_stage(name, claim, log.best)
                solve(log, tree)
        except KeyboardInterrupt:
            log.interrupted = True  # Return the best impulse so far also after Ctrl-C.
        except BREAKDOWN as error:
            log.failure = format_error(error)
        impulse[:] = log.choose_result()
        return log.make_claim()


def add_claim(first: Claim, claim: Claim) -> Claim:
    """Return a claim with the stages and the work of an earlier one before its own."""
    if not first.iterations:
        return claim
    stages = first.stages + claim.stages
    return replace(
        claim,
        iterations=first.iterations + claim.iterations,
        work=sum_work_counts((first.work, claim.work)),
        message=describe_stages(stages),
        stages=stages,
    )


class FirstSweeps:
    """Sweeps under a tight time limit, before the costs of choosing stages, which may exceed the limit.

    They have all of the time if no factorisation fits in it, and else their share. They measure the time of counted
    work on this machine, and continue if a factorisation would then end too late.
    """

    def __init__(self, problem: Problem, deadline: Deadline) -> None:
        self.problem, self.deadline = problem, deadline
        self.newton = get("newton").load()()
        self.min_newton_cost = self.newton.estimate_total_cost(problem)  # [ns]

    def newton_fits(self, margin: float) -> bool:
        """Return whether this multiple of the least cost of Newton's method fits in the remaining time."""
        fits = self.deadline.fits
        cost = margin * self.min_newton_cost
        return fits(cost) and fits(cost + margin * self.newton.estimate_setup_cost(self.problem))

    @np.errstate(all="ignore")  # Results that overflow are judged.
    def run(self, impulse: FloatArray, tol: float, max_iter: int) -> Claim | None:
        """Sweep; return the claim of the solve, or None if other solvers continue from the result."""
        problem = self.problem
        deadline = self.deadline
        start = impulse.copy()
        # Under Coulomb's law `nncg`, except on few bodies.
        is_small = problem.rows is not None and problem.m <= DECISIONS.island_rows
        self.name = "anderson" if problem.law != "coulomb" or is_small else "nncg"
        solver = make_solver(self.name, problem)
        state = prepare_sweeps(solver, problem, deadline)
        loop = Loop(problem=problem, solver=solver, state=state, impulse=impulse, tol=tol)
        # Newton's method may follow: leave its time.
        share = 1.0
        left = deadline.get_remaining_nanoseconds()
        margin = DECISIONS.assumed_pace if problem.law == "coulomb" else DECISIONS.newton_time
        if self.newton_fits(margin):
            newton_cost = self.min_newton_cost + self.newton.estimate_setup_cost(problem)
            rest = 1.0 - margin * newton_cost / left
            share = min(max(rest, DECISIONS.min_share), DECISIONS.time_share)
        loop.deadline = deadline if share == 1.0 else Deadline(1e-9 * share * left)
        # Check the first sweep only if its start is not judged, since the zero impulse may replace the start.
        at_start = find_relative_at_zero(problem, start)
        claim = loop.run_chunks(1) if at_start is None else EMPTY_CLAIM
        self.before = state.watch.best[0] if at_start is None else at_start
        if claim.status is Status.MAX_ITERATIONS:
            loop.tol = 0.0
            claim = loop.run_chunks(min(int(DECISIONS.unchecked_sweeps), max_iter))
            loop.tol = tol
        if claim.status is Status.MAX_ITERATIONS:
            claim = loop.run_chunks(max_iter)
        if share < 1.0 and claim.status is Status.TIME_LIMIT:
            counted = loop.done * solver.estimate_iteration_cost(problem)
            pace = (
                DECISIONS.pace_margin
                * (left - deadline.get_remaining_nanoseconds())
                / max(counted, 1.0)
            )
            if not self.newton_fits(max(pace, 1.0)):
                share = 1.0
                loop.deadline = deadline
                claim = loop.run_chunks(max_iter)
        loop._keep_best(claim)
        self.claim = claim
        judged = reuse_or_judge_impulse(problem, impulse, loop.judged)
        if not judged.relative <= max(tol, self.before):  # Sweeps may raise the error.
            impulse[:] = choose_start(problem, start, tol)
            judged = reuse_or_judge_impulse(problem, impulse)
        is_over = claim.status in (Status.MAX_ITERATIONS, Status.TIME_LIMIT) and share == 1.0
        if not is_over and claim.status is not Status.CONVERGED:
            return None
        status = Status.CONVERGED if judged.relative <= tol else claim.status
        stages = (SolverStage(self.name, dict(claim.work), self.before, judged.relative),)
        text = describe_work(self.name, claim.work)
        return replace(claim, status=status, message=text, form="", stages=stages, judged=judged)


@np.errstate(all="ignore")  # Results that overflow are judged.
def solve(log: SolveLog, tree: DecisionTree) -> None:
    """Run the stages of the tree until one solves the problem or no stage remains. Then search for a certificate."""
    has_time = not log.deadline.is_set or tree.has_time("newton", tree.min_newton_cost)
    is_late = not (has_time or log.problem.cones.has_round)
    stages = iter(tree)
    # Check `done` first, because the tree computes costs before it yields the next stage.
    while not (is_late or log.done()) and (stage := next(stages, None)) is not None:
        if stage.solver == "certificate":
            if log.deadline.fits(stage.cost):
                is_matrix = log.problem.generalized is None
                (
                    certify.certify_by_linear_programs
                    if is_matrix
                    else certify.certify_by_least_violation
                )(log)
            continue
        step = tree.get_step(stage.solver)
        is_sweeps = isinstance(step, Sweeps)
        has_swept = tree.has_swept and all(
            isinstance(other, Iterations) for other in tree.steps.values()
        )
        if is_sweeps and has_swept:
            tree.give_back(stage)
            continue
        if log.deadline.is_set and not step.over and not tree.leaves_time(stage, step):
            is_late = is_sweeps or tree.has_swept
            log.timed_out = True
            if is_late:
                break
            step.over = step.late = True
        if step.over or (isinstance(step, Sweeps) and step.is_hopeless(stage.least)):
            tree.give_back(stage)
        else:
            step.least = stage.least
            step.run(stage.iterations)
        if stage.position and not log.done() and solve_unsolved_islands(log, stage.position + 1):
            return
    if is_late:
        sweep_until_deadline(log, tree)
        return
    newton = tree.steps.get("newton")
    if newton is not None and not newton.over and not log.done():
        assert tree.newton_state is not None
        rest = max(tree.remaining_cost if tree.is_large else 0.0, DECISIONS.last_cost)
        newton.run(
            min(get("newton").max_iter, rest / (tree.newton_state.cost / tree.newton_state.steps))
        )
    if log.timed_out and not log.done():
        sweep_until_deadline(log, tree)
    last_failed = bool(log.stages) and log.best >= log.stages[-1].before
    can_continue = log.remaining_iterations > 0 or last_failed
    if (
        log.best > log.tol
        and log.certificate is None
        and can_continue
        and not log.deadline.has_passed()
    ):
        certify.certify_infeasibility(log)


def solve_unsolved_islands(log: SolveLog, first_stage: int) -> bool:
    """Solve the unsolved islands as a problem of their own, from `first_stage` on; return whether there are others."""
    problem = log.problem
    island_of_block, table = residuals_by_island(problem.metric, log.result)
    unsolved = table[:, 0] > log.tol
    if unsolved.all():
        return False
    blocks = np.flatnonzero(unsolved[island_of_block]).astype(np.int32)
    rows = get_rows_of_blocks(problem, blocks)
    state = AutoState(restrict_to_blocks(problem, blocks, rows), first_stage=first_stage)
    impulse = log.result[rows]
    result = log.result.copy()
    claim = Auto().run(state, impulse, log.remaining_iterations, log.tol, log.time_left)
    result[rows] = impulse
    log.judge_and_store_best(result)
    log.record_part(claim, rows)
    return True


def sweep_until_deadline(log: SolveLog, tree: DecisionTree) -> None:
    """Use the remaining time for sweeps, on large problems with friction a quarter of it for `admm`."""
    log.timed_out = True
    fits = log.deadline.fits
    shared = ("anderson", "admm from zero") if tree.is_large else ()
    for k, name in enumerate((*shared, "anderson")):
        step = tree.get_step(name)
        assert isinstance(step, Iterations)
        setup = 0.0 if step.state is not None else step.solver.estimate_setup_cost(log.problem)
        has_time = fits(DECISIONS.admm_sweeps * tree.pace * tree.sweep) and fits(setup)
        if not step.over and (name == "anderson" or has_time):
            step.least = inf
            step.time_fraction = DECISIONS.time_share if k < len(shared) else 1.0
            step.run(inf)
        if log.done():
            return


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
