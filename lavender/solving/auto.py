"""Select and combine other solvers by their estimated costs (`Solver.cost`).

    start            if the start is a solution, nothing runs
    compiled call    one call for small problems, for small islands with friction, and for J and M if Newton's method
                     is estimated to cost no more than the first sweeps (`small.py`); attempted once
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
                     On large problems with friction, sweeps do not run, `newton` begins with `turn_factorisations`,
                     which its last 30 extend while they halve the residual, and continues its own plan; `admm` starts
                     from the best impulse. After the last round `newton` uses the rest
    end              a search for a certificate by a linear program, if none was tried before (`certify.py`)

Linear problems given by a matrix, and others with a narrow band as A, start with `direct`. A program with a singular P
is solved by backends (`singular_programs.py`). The result is the best impulse of all stages. Costs are estimated, never
measured, so the same problem is solved in the same way on every machine. Under a time limit, a factorising solver
starts only if its estimated cost fits in the remaining time; sweeps before it use at most the fraction `time_share` of
the time, or all of it if no factorising solver fits. These are `nncg` under Coulomb's law, except on few bodies, and
else `anderson`. `Solution.stages` lists the stages that ran, `lavender.explain`
the stages that would run. The decisions depend on these numbers (`decisions.py`):

"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, isnan, nan

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Deadline
from lavender.base.errors import BREAKDOWN, format_error
from lavender.judge.residuals import (
    choose_start,
    find_relative_at_zero,
    judge_impulse,
    reuse_or_judge_impulse,
)
from lavender.judge.solution import Claim, SolverStage, Status
from lavender.problem import OPERATORS, Problem
from lavender.solvers.certify import (
    certify_by_least_violation,
    certify_by_linear_programs,
    certify_infeasibility,
)
from lavender.solvers.decisions import DECISIONS, SMALL_ROWS, describe_numbers
from lavender.solvers.islands import get_rows_of_blocks, restrict_to_blocks
from lavender.solvers.registry import Solver, SolverSpec, get
from lavender.solvers.small import AUTO, describe_work
from lavender.solving import steps as step_types
from lavender.solving.compiled_call import choose_call_deadline, fits_in_time
from lavender.solving.log import Recorder, SolveLog
from lavender.solving.loop import EMPTY_CLAIM, Loop
from lavender.solving.singular_programs import program_backends, run_program_backends
from lavender.solving.stages import DecisionTree
from lavender.solving.steps import Iterations, Step, Sweeps, estimate_cost, starts_relaxed
from lavender_ext.judge.measure import residuals_by_island

assert __doc__ is not None
__doc__ += describe_numbers() + "\n"

# Under a time limit below this multiple of the least cost of Newton's method, sweeps use their share of the time first.
AMPLE_TIME = 8.0
# Newton's method follows them if this multiple of its cost fits. The sweeps leave as much time for it, but have at
# least MIN_SWEEP_SHARE. The number of its steps varies more with friction.
NEWTON_TIME, NEWTON_TIME_WITH_FRICTION, MIN_SWEEP_SHARE = 1.4, 2.0, 0.25
# A factorising solver is assumed to take this multiple of the time that sweeps take per counted work: these and their
# checks take 1.2 to 2.8 of it.
PACE_MARGIN = 0.6
UNCHECKED_SWEEPS = 32  # Checks would take as long as these sweeps.
MIN_ITERATIONS_FOR_COMPILED_CALL = 200  # With fewer allowed, the compiled call is not made.
# Under a time limit, `admm` follows sweeps if the time of this many sweeps remains.
MIN_ADMM_SWEEPS = 500.0
# [ns] Newton's method that has not ended runs on up to this cost: nine rows of masses over many orders took 4.4e7.
MAX_LAST_NEWTON_COST = 1e8


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
        can_sweep = deadline.is_set and problem.m > SMALL_ROWS and not problem.cones.has_round
        first: FirstSweeps | None = None
        if can_sweep and recorder is None and not (time := FactoringTime(problem, deadline)).fits(AMPLE_TIME):
            first = FirstSweeps(problem, impulse, tol, time)
            result_of_sweeps = first.run(max_iter)
            if result_of_sweeps is not None:
                return result_of_sweeps
        may_call = counts is None and max_iter >= MIN_ITERATIONS_FOR_COMPILED_CALL
        if may_call and (first is not None or fits_in_time(problem, deadline)):
            # The impulse of sweeps is returned if the call does not end.
            own = deadline if first is not None else choose_call_deadline(problem, deadline)
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
        if first is not None:
            tree.pace, tree.has_swept = 1.0, True
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


class FactoringTime:
    """The least cost of Newton's method on a problem, compared with the remaining time."""

    def __init__(self, problem: Problem, deadline: Deadline) -> None:
        self.deadline, self.cost = deadline, get("newton").load()().cost(problem)
        self.total, self.has_friction = self.cost.total, problem.law == "coulomb"  # [ns]

    def fits(self, margin: float = 1.0) -> bool:
        """Return whether this multiple of the cost fits."""
        fits = self.deadline.fits
        return fits(margin * self.total) and fits(margin * (self.total + self.cost.setup))

    def choose_sweep_share(self) -> float:
        """Return the fraction of the remaining time for sweeps before Newton's method; 1 if it does not follow."""
        margin = NEWTON_TIME_WITH_FRICTION if self.has_friction else NEWTON_TIME
        if not self.fits(margin):
            return 1.0
        rest = 1.0 - margin * (self.total + self.cost.setup) / self.deadline.get_remaining_nanoseconds()
        return min(max(rest, MIN_SWEEP_SHARE), DECISIONS.time_share)


class FirstSweeps:
    """Sweeps under a tight time limit, before the costs of choosing stages, which may exceed the limit.

    They have all of the time if no factorisation fits in it, and else their share. They measure the time of counted
    work on this machine, and continue if a factorisation would then end too late.
    """

    def __init__(self, problem: Problem, impulse: FloatArray, tol: float, time: FactoringTime) -> None:
        deadline = time.deadline
        self.problem, self.tol, self.time = problem, tol, time
        self.name = step_types.name_limited_sweeps(problem)
        self.start = impulse.copy()
        at_start = find_relative_at_zero(problem, self.start)
        self.before = nan if at_start is None else at_start
        solver = step_types.make_solver(self.name, problem)
        state = step_types.prepare_sweeps(solver, problem, deadline)
        self.loop = Loop(problem=problem, solver=solver, state=state, impulse=impulse, tol=tol)

    def sweep_without_checks(self, max_iter: int) -> Claim:
        """Run the first sweeps without checks, except of a start that the zero impulse may replace."""
        loop, claim = self.loop, EMPTY_CLAIM
        if isnan(self.before):
            claim, self.before = loop.run_chunks(1), loop.state.watch.best[0]
        if claim.status is Status.MAX_ITERATIONS:
            loop.tol = 0.0
            claim = loop.run_chunks(min(UNCHECKED_SWEEPS, max_iter))
            loop.tol = self.tol
        return claim

    @np.errstate(all="ignore")  # Results that overflow are judged.
    def run(self, max_iter: int) -> Claim | None:
        """Sweep; return the claim of the solve, or None if other solvers continue from the result."""
        loop, deadline, problem = self.loop, self.time.deadline, self.problem
        share = self.time.choose_sweep_share()
        loop.deadline, left = deadline, deadline.get_remaining_nanoseconds()
        if share < 1.0:
            loop.deadline = Deadline(1e-9 * share * left)
        claim = self.sweep_without_checks(max_iter)
        if claim.status is Status.MAX_ITERATIONS:
            claim = loop.run_chunks(max_iter)
        if share < 1.0 and claim.status is Status.TIME_LIMIT:
            counted = loop.done * estimate_cost(self.name, problem).iteration
            pace = PACE_MARGIN * (left - deadline.get_remaining_nanoseconds()) / max(counted, 1.0)
            if not self.time.fits(max(pace, 1.0)):
                share, loop.deadline = 1.0, deadline
                claim = loop.run_chunks(max_iter)
        loop._keep_best()
        self.claim = claim
        judged = reuse_or_judge_impulse(problem, loop.impulse, loop.judged)
        if not judged.relative <= max(self.tol, self.before):  # Sweeps may raise the error.
            loop.impulse[:] = choose_start(problem, self.start, self.tol)
            judged = judge_impulse(problem, loop.impulse.copy())
        is_over = claim.status in (Status.MAX_ITERATIONS, Status.TIME_LIMIT) and share == 1.0
        if not is_over and claim.status is not Status.CONVERGED:
            return None
        status = Status.CONVERGED if judged.relative <= self.tol else claim.status
        if claim.status is Status.CONVERGED is not status:
            return None
        stages = (SolverStage(self.name, dict(claim.work), self.before, judged.relative),)
        text = describe_work(self.name, claim.work)
        return replace(claim, status=status, message=text, form="", stages=stages, judged=judged)


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
        has_swept = tree.has_swept and not steps.keys() & {"newton", "direct", "newton on the relaxation"}
        if has_swept and isinstance(step, Sweeps):
            tree.skip(stage)
            continue
        if log.deadline.is_set and not step.over:
            if isinstance(step, Sweeps):
                cost = min(stage.cost, DECISIONS.time_share * log.deadline.get_remaining_nanoseconds())
                if not stage.position and not tree.has_time_to_factorise_after(steps, cost):
                    sweep_until_deadline(log, tree, steps)
                    return
            elif not tree.leaves_time(stage, step):
                step.over = step.late = log.timed_out = True
                if tree.has_swept:
                    sweep_until_deadline(log, tree, steps)
                    return
        if step.over or (isinstance(step, Sweeps) and step.is_hopeless(stage.least)):
            tree.skip(stage)
        else:
            step.least = stage.least
            step.run(stage.iterations)
        if stage.position and not log.done() and solve_unsolved_islands(log, stage.position + 1):
            return
    newton = steps.get("newton")
    if newton is not None and not newton.over and not log.done():
        state = tree.newton_state
        step_cost = tree.solver_costs["newton"] / state.steps if state is not None else inf
        rest = tree.remaining_cost if starts_relaxed(log.problem) else 0.0
        newton.run(min(get("newton").max_iter, max(rest, MAX_LAST_NEWTON_COST) / step_cost))
    if log.timed_out and not log.done():
        sweep_until_deadline(log, tree, steps)
    can_continue = log.remaining_iterations > 0 or log.last_stage_failed
    if log.best > log.tol and log.certificate is None and can_continue and not log.deadline.has_passed():
        certify_infeasibility(log)


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
    impulse, result = log.result[rows], log.result.copy()
    claim = Auto()._run(state, impulse, log.remaining_iterations, log.tol, log.time_left)
    result[rows] = impulse
    log.judge_and_store_best(result)
    log.record_part(claim, rows)
    return True


def sweep_until_deadline(log: SolveLog, tree: DecisionTree, steps: dict[str, Step]) -> None:
    """Use the remaining time for sweeps, on large problems with friction a quarter of it for `admm`."""
    log.timed_out = True
    shared = ("anderson", "admm from zero") if starts_relaxed(log.problem) else ()
    for k, name in enumerate((*shared, "anderson")):
        if name != "anderson" and not log.deadline.fits(MIN_ADMM_SWEEPS * tree.pace * tree.sweep):
            continue
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
    step = step_types.STEP_CLASSES.get(name, Iterations)(name, log)
    if isinstance(step, step_types.RelaxedNewton):
        step.like = tree.newton_state
    if isinstance(step, step_types.Newton):
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
