"""Chooses and combines other solvers: this tree, by two counted costs (`costs.py`).

    the start is a solution     nothing is done
    a program with a singular P PROGRAM_BACKENDS, one after the other, and a certificate by a linear program if none
                                finds a solution
    a small problem             at most 64 rows, or small islands under friction, or velocities that cost less than 100
                                sweeps, but not many contacts of bodies: one compiled call (`small.py`); if that does
                                not solve it, as any other
    a matrix                    `direct`: linear to its end, bounded rows of a narrow band for ROUNDS times the
                                factorisations that `newton` is counted for; as long, but after sweeps, bounded rows
                                of a matrix that is not symmetric
    sweeps (`anderson`)         SWEEPS before an analysis tells Newton's cost, then for as long as that, or until they
                                predict that they will cost more; linear rows and, but for a matrix, bounded ones and
                                cones only where MANY cost less than it; of a matrix each contact is solved exactly
    a loose pile                contacts of PILE rows or more under Coulomb's law, nearly each of another pair: for as
                                much again, sweeps of a conjugate gradient (`nncg`), at first of the cone law, but not
                                of what rolls
    Newton's method (`newton`)  for up to MOST times its cost: over bodies or rows; of J and M over velocities and over
                                rows of A, the cheaper first; what stalls from another's impulse begins from nothing
    a certificate               of J and M with a rigid row: does the least violation prove that none solves it? After
                                SURE times that cost, or MOST where it costs more; of others under Coulomb's law, if
                                more than NEAR is left: does a linear program?
    alternately                 with doubled work, until no solver gains in two stages: `newton` (of J and M also over
                                rows, at up to MOST times the cost or LITTLE; sooner if the compiled call failed, or
                                before the end), `admm` (of J and M once a factor of A costs no more), `nncg`, and
                                sweeps as long as these gain; all together LAST times Newton's cost, no longer than LONG
    at last                     a certificate of others, by a linear program, if none was asked (`certify.py`)

Each goes on where it stopped, and the result is the best impulse of all. Costs are counted, never timed, so the same
problem is solved in the same way on every machine. Under a time limit the tree is the same, but whoever factors begins
only if a result would be there in time, all are swept first where SURE times its cost do not fit, sweeps before it
have at most half of what is left, and sweeps have the rest if it had no time.
`Solution.stages` lists what ran, `lavender.explain` what would run.
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
from lavender.solvers.certify import LINEAR_PROGRAM, certify, least_violation, linear_programs
from lavender.solvers.islands import pairs
from lavender.solvers.newton import WARM, NewtonState
from lavender.solvers.registry import SMALL_ROWS, Solver, SolverSpec, get, specs
from lavender.solvers.setup_times import first_factor, formed_once, forming, over_rows, sweeping
from lavender.solvers.small import AUTO, NO_TIME, QUARTER, call_ends_within
from lavender.solvers.solve_log import GAIN, SolveLog
from lavender.solvers.steps import METHODS, NEAR, PROBE, Iterations, Newton, Step, Sweeps, setup_time

MOST = 10.0  # times its counted cost, that Newton's method has before both go in turn
ROUNDS = 4.0  # times the factorisations that Newton's method is counted for, that `direct` has
TURNS = 6  # that all have with doubled work
LAST = 200.0  # times Newton's counted cost, that all have together
LONG = 6e10  # ns of counted cost that turns have at most, and Newton's method, if SURE times its own are not more
MANY = 200.0  # sweeps that cost less come before Newton's method where it is sure to end
FEW, SPARSE = 32.0, 0.05  # sweeps before a factor that may fill, of a matrix of at most this share of entries
LITTLE = 5e6  # ns of Newton's method over rows, which are worth a trial in any case
PILE = 390  # rows of contacts, below which Newton's method ends sooner than sweeps of a conjugate gradient before it
BAND = 100  # half bandwidth up to which `direct` comes first, if it is at most a quarter of the rows
SURE = 4.0  # times the counted cost, within which nine in ten end
EARLY = 0.25  # of the counted cost, after which an interior point has an impulse that is worth having
# Sweeps start from a given guess up to this relative residual, even if doing nothing has less, because the guess tells
# which rows are free.
STALE = 1e3
# A quadratic program with a singular P is solved by the first of these that is installed and solves it; osqp always
# is installed.
PROGRAM_BACKENDS = ("piqp", "clarabel", "osqp")
ONE_CALL = 200  # iterations that a problem of few rows, solved in one call, takes, unless its path is long


@dataclass(frozen=True)
class Stage:
    """One line of the tree."""

    solver: str  # of METHODS
    iterations: float  # at most
    cost: float  # ns, of these as counted
    why: str
    least: float = inf  # sweeps that may be predicted to be left


class Tree:
    """What `auto` does with a problem, line by line, and the costs that it compares [ns]."""

    begun = 0.0  # ns, of sweeps before Newton's method
    left = 0.0  # ns, for turns; who takes the lines gives back what did not run
    tried = False  # velocities of J and M, in the compiled call
    swept = False  # in vain, in turn
    best = nan  # relative residual, as who takes the lines tells

    def __init__(self, problem: Problem, deadline: Deadline = NEVER) -> None:
        self.problem, self.law, self.deadline = problem, problem.law, deadline

    @cached_property
    def sweep(self) -> float:
        """One sweep."""
        return costs.sweep_cost(self.problem)

    @cached_property
    def least(self) -> float:
        """Newton's method at least, told without its analysis."""
        return costs.newton_cost(costs.least(self.problem), self.law)

    @cached_property
    def states(self) -> dict[str, NewtonState]:
        """Newton's method after its analysis, the cheaper form first; none where it takes no form or has no time."""
        able = get("newton").refuses(self.problem) is None and not self.is_late
        return self.prepared("newton") if able else {}

    def prepared(self, name: str) -> dict[str, NewtonState]:
        """Newton's method in this form after its analysis, by name; nothing where that breaks down."""
        try:
            return {name: get("newton").load()(**METHODS[name][1]).prepare(self.problem)}
        except BREAKDOWN:
            return {}

    @cached_property
    def formed(self) -> float:
        """Newton's method over rows of an A that is yet to be formed of J and M, at least; inf where that cannot be."""
        p, state = self.problem, self.states.get("newton")
        if state is None or state.general is None or p.cones.has_round:
            return inf
        return costs.newton_cost(costs.formed(p), self.law)

    def add_rows(self, most: float) -> bool:
        """Analyse A of J and M as well, if that is counted to cost less and has time; last comes what has failed."""
        p, states = self.problem, self.states
        if "newton over rows" in states or self.formed >= most or self.is_late:
            return False
        if self.deadline.is_set and self.deadline.passed(over_rows(p) + 3.0 * forming(p)):
            return False
        both = states | self.prepared("newton over rows")
        self.states = dict(
            sorted(both.items(), key=lambda of: (self.tried and of[1].general is not None, of[1].cost))
        )
        return len(both) > len(states)

    @property
    def newton(self) -> float:
        """Newton's method, inf where there is none."""
        return min((state.cost for state in self.states.values()), default=inf)

    @property
    def is_late(self) -> bool:
        """Nobody who factors would have a result in time."""
        return not self.has_time("newton", self.least)

    def has_time(self, name: str, cost: float, before: float = 0.0) -> bool:
        """Whether who factors, at this cost, would have a result in time if begun after `before` [ns].

        Each factorisation of an interior point brings one; under Coulomb's law, and in `direct`, only the last does.
        """
        if not self.deadline.is_set:
            return True
        needed = 1e-9 * (before + (1.0 if name == "direct" or self.law == "coulomb" else EARLY) * cost)
        if name == "newton" and "states" in vars(self):
            return not self.deadline.passed(needed)
        return not self.deadline.passed(setup_time(name, self.problem) + needed)

    @property
    def pivots(self) -> str:
        """Bounded rows of a matrix of which `direct` needs little: a factor of a narrow band, or of free rows alone."""
        p, band = self.problem, min(BAND, self.problem.m // 4)
        if p.matrix is None or self.law != "lcp":
            return ""
        entries = len(p._compressed[1])
        if p.is_symmetric:
            return "a narrow band" if entries <= (2 * band + 1) * p.m and max(p.bandwidth) <= band else ""
        return "not symmetric" if entries > SPARSE * p.m**2 else ""

    @cached_property
    def is_loose(self) -> bool:
        """Contacts under Coulomb's law, nearly each between another pair of bodies or of trees of M: sweeps then decide
        what sticks.
        """
        p = self.problem
        if self.law != "coulomb" or np.count_nonzero(p.cones.contact_rows) < PILE:
            return False
        return 4 * pairs(p) > 3 * p.n_blocks

    def __iter__(self) -> Iterator[Stage]:
        """The lines."""
        if self.problem.matrix is not None and self.law == "linear":
            p = self.problem
            if len(p._compressed[1]) < SPARSE * p.m**2 and max(p.bandwidth) > BAND:
                yield Stage("anderson", FEW, FEW * self.sweep, "a sparse matrix whose factor may fill", FEW)
            yield Stage("direct", inf, self.least, "linear, a matrix")
        pivots, most = self.pivots, ROUNDS * costs.factorisations(self.law)
        if pivots == "a narrow band":
            yield Stage("direct", most, self.least, f"bounded rows, {pivots}")
        # Fill is most of what a factor costs, and only an analysis tells it: before it, as many as are usual.
        yield from self.sweeps_first(max(self.least, costs.SWEEPS * self.sweep))
        yield from self.sweeps_first(min(self.newton, self.formed))
        self.add_rows(max(MOST * self.newton, LITTLE) if self.tried else self.newton)
        yield from self.sweeps_first(self.newton)
        if pivots == "not symmetric":
            yield Stage("direct", most, self.newton, f"bounded rows, {pivots}")
        if self.problem.generalized is not None and not np.all(self.problem.compliance):
            of = self.states.get("newton")  # over velocities, as the least violation is found
            cost = self.newton if of is None else of.cost
            sooner = cost <= max(MOST * self.newton, LITTLE)
            yield from islice(self.factorisations(SURE if sooner else MOST), 1)
            yield Stage("certificate", 1.0, cost, "whether the least violation proves that there is none")
        yield from self.factorisations(MOST)
        self.add_rows(max(MOST * self.newton, LITTLE))
        if self.law == "coulomb" and self.problem.generalized is None and self.best > NEAR:
            yield Stage("certificate", 1.0, LINEAR_PROGRAM, "whether a linear program proves it")
        most = max((state.cost for state in self.states.values()), default=costs.SWEEPS * self.sweep)
        self.left = min((LAST - MOST) * min(most, max(self.newton, LITTLE)), LONG) - self.begun
        for k in range(TURNS):
            before = self.best
            for stage in self.in_turn(2.0**k):
                if self.left < 1.0:  # ns
                    return
                share = min(1.0, self.left / stage.cost)
                self.left -= share * stage.cost
                yield replace(stage, iterations=share * stage.iterations, cost=share * stage.cost)
            # From near a solution rows take a few of their factorisations.
            more = MOST if self.best <= WARM else 1.0
            if k > 0 and self.best > GAIN * before and not self.add_rows(more * self.left):
                return

    def factorisations(self, times: float) -> Iterator[Stage]:
        """Newton's method for so many times its counted cost."""
        for name, state in self.states.items():
            share = min(times, max(SURE, LONG / state.cost))
            why = f"{share:.3g} times its counted cost of {seconds(1e-9 * state.cost)}"
            yield Stage(name, share * state.steps, share * state.cost, why)

    def sweeps_first(self, newton: float) -> Iterator[Stage]:
        """For Newton's cost: first what that is at least, then what it is counted for, of J and M once A is formed."""
        cost = newton - self.begun
        # Newton's method then takes what it is counted for, if that is there.
        sure = self.law == "linear" or (self.law != "coulomb" and self.problem.matrix is None)
        sure = sure and not self.deadline.passed(1e-9 * SURE * newton)
        pays = not sure or MANY * self.sweep <= newton
        if pays and 0.0 < cost < inf and not self.problem.cones.has_round:
            self.begun += cost
            why = f"{seconds(1e-9 * cost)} of what newton costs"
            yield self.sweeps(cost, why, newton)
            if self.is_loose:
                rolls = self.problem.cones.has_more_parts
                yield self.iterations("nncg" if rolls else "nncg from the cone law", cost, why)

    def sweeps(self, cost: float, why: str, most: float = inf) -> Stage:
        """Sweeps of so much cost, as long as no more than `most` is predicted to be left."""
        return Stage("anderson", cost / self.sweep, cost, why, most / self.sweep)

    def iterations(self, name: str, cost: float, why: str) -> Stage:
        """Of a solver of which each costs as much as two sweeps."""
        return Stage(name, 0.5 * cost / self.sweep, cost, why)

    def in_turn(self, times: float) -> Iterator[Stage]:
        """All, with so many times the work of Newton's method before."""
        cost = times * MOST * (self.newton if self.newton < inf else costs.SWEEPS * self.sweep)
        why = f"in turn, {times * MOST:g} times newton's cost"
        yield from self.factorisations(times * MOST)
        p = self.problem
        # A of J and M that no line has formed, and its first factor, whatever else is known of A.
        formed = 0.0 if p.generalized is None or "newton over rows" in self.states else formed_once(p)
        if p.generalized is None or 1e9 * (formed + first_factor(p.m, float(p.metric.entries_of_a))) <= cost:
            yield self.iterations("admm", cost, why)
        yield self.iterations("nncg", cost, why)
        if not self.swept and not self.problem.cones.has_round:
            before = self.best
            yield self.sweeps(cost, why)
            self.swept = self.best > GAIN * before


@dataclass(frozen=True)
class Auto(Solver):
    """Chooses and combines other solvers; the solution's message and `stages` name them."""

    def prepare(self, problem: Problem) -> Problem:
        """Nothing."""
        return problem

    def start_workers(self, problem: Problem, time_limit: float) -> None:
        """Start the process of the backend that solves a program with a singular P."""
        if problem.has_singular_program:
            for spec in program_backends()[:1]:
                spec.load()().start_workers(problem, time_limit)

    def run(
        self, problem: Problem, impulse: FloatArray, max_iter: int, tol: float, time_limit: float | None
    ) -> Claim:
        deadline, failed = Deadline(time_limit), list[tuple[str, Claim]]()
        if problem.has_singular_program:
            return run_backends(problem, impulse, max_iter, tol, deadline)
        if max_iter >= ONE_CALL and call_ends_within(problem, deadline.remaining()):
            share = 1.0 if problem.m <= SMALL_ROWS else QUARTER
            found, counts = AUTO.attempt(problem, impulse, tol, share * deadline.nanoseconds())
            if found is not None and found.relative <= tol:
                claim = AUTO.claim(problem, counts, impulse, found.relative)
                if claim.iterations <= max_iter:
                    impulse[:] = found.impulse
                    return claim
            failed = AUTO.failed(problem, counts)
        if problem.m == 0:
            return Claim(Status.CONVERGED, 0, {}, "nothing to solve")
        if deadline.passed(sweeping(problem)):
            return Claim(Status.TIME_LIMIT, 0, {}, NO_TIME)
        tree = Tree(problem, deadline)
        tree.tried = bool(failed) and problem.generalized is not None
        log = SolveLog(problem, tol, max_iter, deadline)
        log.offer(impulse)
        if log.best > 1.0:
            log.given = impulse.copy() if log.best < STALE else None
            log.offer(problem.start())  # doing nothing is better
        try:
            if max_iter > 0 and log.best > tol and not log.done():
                for name, claim in failed:
                    log.note(name, claim, log.best)
                solve(log, tree)
        except KeyboardInterrupt:
            log.interrupted = True  # the best impulse goes back all the same
        except BREAKDOWN as error:
            log.failure = format_error(error)
        if log.best > tol and log.result is not None:
            impulse[:] = best_of_islands(problem, (impulse,), (log.result,), tol)
        else:
            impulse[:] = log.impulse
        return log.claim()


def program_backends() -> list[SolverSpec]:
    """Return the installed of PROGRAM_BACKENDS."""
    return [get(name) for name in PROGRAM_BACKENDS if not specs()[name].missing()]


@np.errstate(all="ignore")  # what overflows is judged
def run_backends(
    problem: Problem, impulse: FloatArray, max_iter: int, tol: float, deadline: Deadline
) -> Claim:
    """Solve a program with a singular P by the first backend that reaches tol, or look for a certificate.

    If none reaches tol, the result is the one with the least error of the program.
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
            for result in (trial, log.impulse if log.result is None else log.result):
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
        if claim.status is Status.ROUNDOFF_LIMIT:  # true of the impulse of the log
            claim = replace(claim, status=Status.STALLED)
    return claim


def program_error(problem: Problem, impulse: FloatArray) -> float:
    """Return `QPSolution.error` of x and the multipliers (n + m,); inf if it is not a number."""
    error = float(problem.qp.solution(impulse).error)
    return error if error == error else inf


@np.errstate(all="ignore")  # what overflows is judged
def solve(log: SolveLog, tree: Tree) -> None:
    """The lines of the tree, until one solves the problem or none has more to do."""
    steps: dict[str, Step] = {}
    if log.deadline.is_set and tree.is_late and not log.problem.cones.has_round:
        Sweeps("anderson", log).finish()
        return
    lines = iter(tree)
    while not log.done():  # before the next line counts what it needs
        stage = next(lines, None)
        if stage is None:
            break
        if stage.solver == "certificate":
            if not log.ends_late(stage.cost):
                (linear_programs if log.problem.generalized is None else least_violation)(log)
            continue
        step = steps.get(stage.solver)
        if step is None:
            step = steps[stage.solver] = make(stage.solver, log, tree)
        if log.deadline.is_set and not step.over:
            if isinstance(step, Sweeps):
                if not tree_goes_on(tree, steps, min(stage.cost, PROBE * log.deadline.nanoseconds())):
                    step.finish()
                    return
            elif step.name == "direct" or isinstance(step, Newton):
                cost = step.state.cost if isinstance(step, Newton) else stage.cost
                step.over = step.late = not tree.has_time(METHODS[stage.solver][0], cost)
            elif step.state is None:
                step.over = log.deadline.passed(SURE * setup_time(stage.solver, log.problem))
        if step.over:
            tree.left += stage.cost
        else:
            step.least = stage.least
            step.run(stage.iterations)
            tree.best = log.best
    if log.best > log.tol and log.certificate is None and (log.left > 0 or log.vain):
        certify(log)


def tree_goes_on(tree: Tree, steps: dict[str, Step], cost: float) -> bool:
    """Whether after work of this cost [ns] anybody who factors would still have a result in time, or all have ended."""
    if "states" not in vars(tree):
        return tree.has_time("newton", tree.least, cost)
    able = [name for name in tree.states if name not in steps or not steps[name].over]
    if tree.states and not able and not any(steps[name].late for name in tree.states):
        return True
    return bool(able) and tree.has_time("newton", tree.newton, cost)


def make(name: str, log: SolveLog, tree: Tree) -> Step:
    """The step of this name."""
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
