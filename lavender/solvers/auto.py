"""Chooses and combines other solvers: this tree, by two counted costs (`costs.py`).

    the start is a solution     nothing is done
    a small problem             at most 64 rows, or small islands under friction, or velocities that cost less than 100
                                sweeps, but not many contacts of bodies: one compiled call (`small.py`); if that does
                                not solve it, as any other
    a matrix                    `direct`: linear to its end, bounded rows of a narrow band for ROUNDS times the
                                factorisations that `newton` is counted for; as long, but after sweeps, bounded rows
                                whose factor is dense
    sweeps (`anderson`)         for Newton's cost, or until they predict that they will cost more than it; linear rows
                                and, but for a matrix, bounded ones and cones only where 200 cost less than it; of a
                                matrix each contact is solved exactly
    a loose pile                contacts of PILE rows or more under Coulomb's law, nearly each of another pair: for as
                                much again, sweeps of a conjugate gradient (`nncg`), at first of the cone law, but not
                                of what rolls
    Newton's method (`newton`)  for up to MOST times its cost: over bodies or rows; of J and M over velocities and over
                                rows of A, the cheaper first; what stalls from another's impulse begins from nothing
    a certificate               of J and M with a rigid row: does the least violation prove that none solves it? After
                                SURE times that cost, or MOST where it costs more; over rows, of bounded ones that
                                failed in the compiled call
    all in turn                 with doubled work, until nobody gains in two turns: `newton` (of J and M over rows, too,
                                at up to MOST times the cost or LITTLE), `admm`, `nncg`, and sweeps as long as these
                                gain; all together LAST times Newton's cost, and no longer than LONG
    at last                     a certificate of others, by a linear program (`certify.py`)

Each goes on where it stopped, and the result is the best impulse of all. Costs are counted, never timed, so the same
problem is solved in the same way on every machine. Under a time limit the tree is the same, but whoever factors begins
only if a result would be there in time, all are swept first where SURE times its cost do not fit, sweeps before it
have at most half of what is left, and sweeps have the rest if it had no time.
`Solution.turns` lists what ran, `lavender.explain` what would run.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from math import inf, nan

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import NEVER, Deadline
from lavender.base.errors import BREAKDOWN, last_words
from lavender.judge.solution import Claim, Status
from lavender.problem import OPERATORS, Problem
from lavender.problem.derived import cached_property
from lavender.solvers import costs
from lavender.solvers.certify import certify, least_violation
from lavender.solvers.islands import pairs
from lavender.solvers.newton import NewtonState
from lavender.solvers.registry import SMALL_ROWS, Solver, SolverSpec, get
from lavender.solvers.setup_times import forming, over_rows, sweeping
from lavender.solvers.small import AUTO, NO_TIME, QUARTER, call_ends_within
from lavender.solvers.solve_log import GAIN, SolveLog
from lavender.solvers.steps import METHODS, PROBE, Direct, Iterations, Newton, Step, Sweeps, setup_time

MOST = 10.0  # times its counted cost, that Newton's method has before both go in turn
ROUNDS = 4.0  # times the factorisations that Newton's method is counted for, that `direct` has
TURNS = 6  # that all have with doubled work
LAST = 200.0  # times Newton's counted cost, that all have together
LONG = 6e10  # ns of counted cost that turns have at most, and Newton's method, if SURE times its own are not more
LITTLE = 5e6  # ns of Newton's method over rows, which are worth a trial in any case
FEW = 32.0  # sweeps before a factor that may fill
MANY = (
    200.0  # sweeps that cost less come before Newton's method; of a matrix, and under Coulomb's law, all do
)
SPARSE, DENSE = 0.05, 0.5  # shares of entries, below which A is sparse, and above which it is dense
FILLS = 8.0  # entries of each row of a sparse A, from which a factor may fill in
PILE = 390  # rows of contacts, below which Newton's method ends sooner than sweeps of a conjugate gradient before it
BAND = 100  # half bandwidth up to which `direct` comes first, if it is at most a quarter of the rows
SURE = 4.0  # times the counted cost, within which nine in ten end
EARLY = 0.25  # of the counted cost, after which an interior point has an impulse that is worth having
# Sweeps start from a given guess up to this relative residual, even if doing nothing has less, because the guess tells
# which rows are free.
STALE = 1e3
ONE_CALL = 200  # iterations that a problem of few rows, solved in one call, takes, unless its path is long
NOTHING_TOLD = Claim(Status.MAX_ITERATIONS, 0)


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

    def add_rows(self, most: float) -> None:
        """Analyse A of J and M as well, if that is counted to cost less and is there in time, with what of SciPy reads
        it; last what has failed.
        """
        p, states = self.problem, self.states
        if "newton over rows" in states or self.formed >= most or self.is_late:
            return
        if self.deadline.is_set and self.deadline.passed(over_rows(p) + 3.0 * forming(p)):
            return
        states |= self.prepared("newton over rows")
        self.states = dict(
            sorted(states.items(), key=lambda of: (self.tried and of[1].general is not None, of[1].cost))
        )

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
        set_up, p = setup_time(name, self.problem), self.problem
        fills = p.matrix is not None and FILLS * p.m < len(p._compressed[1]) < SPARSE * p.m**2
        if fills and name == "direct":
            set_up *= SURE  # a factor of what fills in takes longer than is counted
        return not self.deadline.passed(set_up + needed)

    @property
    def may_fill(self) -> bool:
        """A matrix of few entries without a narrow band."""
        p = self.problem
        return len(p._compressed[1]) < SPARSE * p.m**2 and max(p.bandwidth) > BAND

    @property
    def is_narrow(self) -> bool:
        """Bounded rows of a symmetric matrix, given as such, of a narrow band: a factor costs little."""
        p = self.problem
        if p.matrix is None or self.law != "lcp" or len(p._compressed[1]) > (2.0 * BAND + 1.0) * p.m:
            return False
        return max(p.bandwidth) <= min(BAND, p.m // 4) and bool(p.is_symmetric)

    @property
    def is_dense(self) -> bool:
        """Bounded rows of a matrix of most entries, or of an unsymmetric one that is not sparse: `direct` factors only
        rows that are free.
        """
        p = self.problem
        if p.matrix is None or self.law != "lcp":
            return False
        return len(p._compressed[1]) > (DENSE if p.is_symmetric else SPARSE) * p.m**2

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
            if self.may_fill:
                yield Stage("anderson", FEW, FEW * self.sweep, "a sparse matrix whose factor may fill", FEW)
            yield Stage("direct", inf, self.least, "linear, a matrix")
        if self.is_narrow:
            yield self.rounds(self.least, "bounded rows of a narrow band")
        # Fill is most of what J and M cost, and only an analysis tells it: they are swept as long as is usual before.
        usual = self.problem.generalized is not None and self.law == "coulomb"
        yield from self.sweeps_first(max(self.least, costs.SWEEPS * self.sweep if usual else 0.0))
        yield from self.sweeps_first(min(self.newton, self.formed))
        self.add_rows((MOST if self.tried else 1.0) * self.newton)
        yield from self.sweeps_first(self.newton)
        if self.is_dense:
            yield self.rounds(self.newton, "a dense factor, of the rows that are free")
        if self.problem.generalized is not None and not np.all(self.problem.compliance):
            if self.tried and self.law == "lcp":
                self.add_rows(LITTLE)
            of = self.states.get("newton")  # over velocities, as the least violation is found
            cost = self.newton if of is None else of.cost
            sooner = cost <= max(MOST * self.newton, LITTLE)
            yield from islice(self.factorisations(SURE if sooner else MOST), 1)
            yield Stage("certificate", 1.0, cost, "whether the least violation proves that there is none")
        yield from self.factorisations(MOST)
        unit = self.newton if self.newton < inf else costs.SWEEPS * self.sweep
        if "newton over rows" not in self.states:
            self.add_rows(max(MOST * self.newton, LITTLE))
            unit = min(max((state.cost for state in self.states.values()), default=unit), max(unit, LITTLE))
        self.left = min((LAST - MOST) * unit, LONG) - self.begun
        for k in range(TURNS):
            before = self.best
            for stage in self.in_turn(2.0**k):
                if self.left < 1.0:  # ns
                    return
                share = min(1.0, self.left / stage.cost)
                self.left -= share * stage.cost
                yield replace(stage, iterations=share * stage.iterations, cost=share * stage.cost)
            if k > 0 and self.best > GAIN * before:
                return

    def factorisations(self, times: float) -> Iterator[Stage]:
        """Newton's method for so many times its counted cost."""
        for name, state in self.states.items():
            share = min(times, max(SURE, LONG / state.cost))
            why = f"{share:.3g} times its counted cost of {words(state.cost)}"
            yield Stage(name, share * state.steps, share * state.cost, why)

    def rounds(self, cost: float, why: str) -> Stage:
        """Of `direct`, so many times what Newton's method is counted for."""
        why = f"{why}: {ROUNDS:g} times newton's factorisations"
        return Stage("direct", ROUNDS * costs.factorisations(self.law), cost, why)

    def sweeps_first(self, newton: float) -> Iterator[Stage]:
        """For Newton's cost: first what that is at least, then what it is counted for, of J and M once A is formed."""
        cost = newton - self.begun
        # Newton's method then takes what it is counted for, if that is there.
        sure = self.law == "linear" or (self.law != "coulomb" and self.problem.matrix is None)
        sure = sure and not self.deadline.passed(1e-9 * SURE * newton)
        pays = not sure or MANY * self.sweep <= newton
        if pays and 0.0 < cost < inf and not self.problem.cones.has_round:
            self.begun += cost
            why = f"{words(cost)} of what newton costs"
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
        yield self.iterations("admm", cost, why)
        yield self.iterations("nncg", cost, why)
        if not self.swept and not self.problem.cones.has_round:
            before = self.best
            yield self.sweeps(cost, why)
            self.swept = self.best > GAIN * before


def words(ns: float) -> str:
    """A time."""
    unit, word = (1e9, "s") if ns >= 1e9 else (1e6, "ms") if ns >= 1e6 else (1e3, "us")
    return f"{ns / unit:.3g} {word}"


@dataclass
class State:
    """What `auto` has prepared: nothing."""

    problem: Problem
    log: SolveLog | None = None  # of the solve that has ended, as long as it is not told


@dataclass(frozen=True)
class Auto(Solver):
    """Chooses and combines other solvers; the solution's message and `turns` name them."""

    def prepare(self, problem: Problem) -> State:
        return State(problem)

    def run(
        self, state: State, impulse: FloatArray, max_iter: int, tol: float, time_limit: float | None = None
    ) -> Claim:
        problem, state.log = state.problem, None
        deadline, failed = Deadline(time_limit), list[tuple[str, Claim]]()
        if max_iter >= ONE_CALL and call_ends_within(problem, deadline.left()):
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
        tree, sweeps = Tree(problem, deadline), None
        tree.tried = bool(failed) and problem.generalized is not None
        if deadline.is_set and not problem.cones.has_round:
            if deadline.passed(sweeping(problem)):
                return Claim(Status.TIME_LIMIT, 0, {}, NO_TIME)
            if tree.is_late:
                sweeps = Sweeps(problem, deadline)
        log = SolveLog(problem, tol, max_iter, deadline, None if sweeps is None else sweeps.state.data)
        log.offer(impulse)
        if log.best > 1.0:
            log.given = impulse.copy() if log.best < STALE else None
            log.offer(problem.start())  # doing nothing is better
        state.log = log
        try:
            if max_iter > 0 and log.best > tol and not log.done():
                for name, claim in failed:
                    log.note(name, claim, log.best)
                solve(log, tree, sweeps)
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


@np.errstate(all="ignore")  # what overflows is judged
def solve(log: SolveLog, tree: Tree, sweeps: Sweeps | None = None) -> None:
    """The lines of the tree, until one solves the problem or none has more to do; `sweeps` that are set up."""
    steps: dict[str, Step] = {}
    if sweeps is not None:
        sweeps.begin(log)
        sweeps.finish()
        return
    lines = iter(tree)
    while not log.done():  # before the next line counts what it needs
        stage = next(lines, None)
        if stage is None:
            break
        if stage.solver == "certificate":
            if not log.ends_late(stage.cost):
                least_violation(log)
            continue
        step = steps.get(stage.solver)
        if step is None:
            step = steps[stage.solver] = make(stage.solver, log, tree)
        if log.deadline.is_set and not step.over:
            most = PROBE * log.deadline.nanoseconds()
            if isinstance(step, Sweeps) and not tree_goes_on(tree, steps, min(stage.cost, most)):
                step.finish()
                return
            if isinstance(step, Newton | Direct):
                cost = step.state.cost if isinstance(step, Newton) else stage.cost
                step.over = step.late = not tree.has_time(METHODS[stage.solver][0], cost)
            elif step.state is None and isinstance(step, Iterations):
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
    if name == "anderson":
        sweeps = Sweeps(log.problem, log.deadline)
        sweeps.begin(log)
        return sweeps
    if name.startswith("newton"):
        newton = Newton(name, log)
        newton.state = tree.states[name]
        return newton
    return (Direct if name == "direct" else Iterations)(name, log)


SPEC = SolverSpec(
    name="auto",
    factory=Auto,
    laws=frozenset({"linear", "lcp", "coulomb", "cone"}),
    boxes=frozenset({"coulomb", "cone"}),
    operators=frozenset(OPERATORS),
    round_cones=True,
    parts=True,
    small=AUTO,
    resumable=False,
    delegates=True,
    max_iter=1_000_000,
    summary="chooses and combines other solvers by counted cost",
)
