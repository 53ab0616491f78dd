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
    combine_best_islands,
    find_relative_at_zero,
    reuse_or_judge_impulse,
)
from lavender.judge.solution import Claim, Status, sum_work_counts
from lavender.problem import OPERATORS, Problem
from lavender.solvers import certify
from lavender.solvers.decisions import DECISIONS, SMALL_ROWS, describe_numbers
from lavender.solvers.islands import get_rows_of_blocks, restrict_to_blocks
from lavender.solvers.registry import Solver, SolverSpec, get, program_backends
from lavender.solvers.small import AUTO, describe_stages
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
        if problem.m == 0:
            return Claim(Status.CONVERGED, 0)
        log = SolveLog(problem, tol, max_iter, deadline, state.first_claim)
        log.recorder = recorder
        solved: Claim | None = None
        try:
            solved = run_stages(state, log, impulse)
        except KeyboardInterrupt:
            log.interrupted = True  # Return the best impulse so far also after Ctrl-C.
        except BREAKDOWN as error:
            log.failure = format_error(error)
        if solved is not None:
            return solved
        impulse[:] = log.choose_result()
        return log.make_claim()


def run_stages(state: AutoState, log: SolveLog, impulse: FloatArray) -> Claim | None:
    """Run the compiled call and the stages; return the claim of a call that has solved the problem, else None.

    Under a tight time limit sweeps run before the call. It then starts from their result, with all of the time.
    """
    problem, tol, deadline = log.problem, log.tol, log.deadline
    has_swept = sweep_first(log, impulse)
    if has_swept and log.done():
        return None
    start = log.impulse if has_swept else impulse
    counts: tuple[int, ...] | None = state.failed_call
    may_call = counts is None and log.budget >= DECISIONS.call_iterations
    if may_call and (has_swept or fits_in_time(problem, deadline)):
        own = deadline if has_swept else choose_call_deadline(problem, deadline)
        result, counts = AUTO.call.solve(problem, start, tol, own)
        if result is not None and result.relative <= tol:
            made = AUTO.make_claim(problem, counts, start, result.relative)
            claim = add_claim(state.first_claim, made)
            if claim.iterations <= log.budget:
                impulse[:] = result.impulse
                return replace(claim, judged=result)
    failed = AUTO.list_claims_of_failed_call(problem, counts)
    call_failed = bool(failed) and problem.generalized is not None
    tree = DecisionTree(
        problem,
        deadline,
        log,
        state.first_stage,
        call_failed=call_failed,
        started_from_zero=call_failed and not (start - problem._start).any(),
        has_swept=has_swept,
    )
    if not has_swept:
        log.start_from_better_impulse(impulse)
    if log.budget > 0 and log.best > tol and not log.done():
        for name, claim in failed:
            log.record_stage(name, claim, log.best)
        solve(log, tree)
    return None


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


@np.errstate(all="ignore")  # Results that overflow are judged.
def sweep_first(log: SolveLog, impulse: FloatArray) -> bool:
    """Sweep from `impulse` before a stage is chosen, if the costs of this may exceed a limit; return whether it was so.

    The sweeps have all of the time if no factorisation fits in it, and else their share. They measure the time of
    counted work on this machine, and continue if a factorisation would then end too late.
    """
    problem, deadline, fits = log.problem, log.deadline, log.deadline.fits
    is_open = log.recorder is None and not problem.cones.has_round
    if not (deadline.is_set and is_open and problem.m > SMALL_ROWS):
        return False
    newton = get("newton").load()()
    least = newton.estimate_total_cost(problem)  # [ns]

    def newton_fits(margin: float) -> bool:
        """Return whether this multiple of the least cost of Newton's method fits in the remaining time."""
        return fits(margin * least) and fits(margin * (least + newton.estimate_setup_cost(problem)))

    if newton_fits(DECISIONS.ample_time):
        return False
    # Under Coulomb's law `nncg`, except on few bodies.
    is_small = problem.rows is not None and problem.m <= DECISIONS.island_rows
    name = "anderson" if problem.law != "coulomb" or is_small else "nncg"
    solver = make_solver(name, problem)
    state = prepare_sweeps(solver, problem, deadline)
    # Newton's method may follow: leave its time.
    share = 1.0
    left = deadline.get_remaining_nanoseconds()
    margin = DECISIONS.assumed_pace if problem.law == "coulomb" else DECISIONS.newton_time
    if newton_fits(margin):
        rest = 1.0 - margin * (least + newton.estimate_setup_cost(problem)) / left
        share = min(max(rest, DECISIONS.min_share), DECISIONS.time_share)
    own = deadline if share == 1.0 else Deadline(1e-9 * share * left)
    loop = Loop(problem, solver, state, impulse.copy(), log.tol, own)
    # Check the first sweep only if its start is not judged, since the zero impulse may replace the start.
    at_start = find_relative_at_zero(problem, impulse)
    claim = loop.run_chunks(1) if at_start is None else EMPTY_CLAIM
    before = state.watch.best[0] if at_start is None else at_start
    if claim.status is Status.MAX_ITERATIONS:
        loop.tol = 0.0
        claim = loop.run_chunks(min(int(DECISIONS.unchecked_sweeps), log.budget))
        loop.tol = log.tol
    if claim.status is Status.MAX_ITERATIONS:
        claim = loop.run_chunks(log.budget)
    if share < 1.0 and claim.status is Status.TIME_LIMIT:
        counted = max(loop.done * solver.estimate_iteration_cost(problem), 1.0)
        spent = left - deadline.get_remaining_nanoseconds()
        if not newton_fits(max(DECISIONS.pace_margin * spent / counted, 1.0)):
            loop.deadline = own = deadline
            claim = loop.run_chunks(log.budget)
    loop._keep_best(claim)
    judged = reuse_or_judge_impulse(problem, loop.impulse, loop.judged)
    is_over = own is deadline and claim.status in (Status.MAX_ITERATIONS, Status.TIME_LIMIT)
    if judged.relative <= (max(log.tol, before) if is_over else log.tol):
        log.store_last_impulse(judged)
    else:  # Other solvers continue, or sweeps have raised the error.
        log.start_from_better_impulse(impulse)
        log.judge_and_store_best(loop.impulse, judged)
    log.record_stage(name, claim, before)
    return True


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
