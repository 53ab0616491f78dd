"""The only solver that hands over to others: each in its turn, by what it would cost from here on.

    linear            direct, newton
    few rows          linear or bounded: direct, in one call (`_few.py`), with Lemke's path where exchanges are stuck,
                      as more of a narrow band (`_at_once.py`), where that is the end; else a glance at sweeps
                      (`_sweepers.py`) before anything is counted, and on as below
    J and M           newton over the velocities at once where that costs next to nothing, on few rows under Coulomb's
                      law after a glance at sweeps, unless contacts are soft (`_opening.py`); else it is one of the
                      finite solvers below, beside those that form A
    others            a finite solver at once where its factor costs less than sweeps usually do; else anderson
                      as long as what it still needs, by its contraction so far, costs less than the cheapest
                      finite solver (direct, newton, lemke, admm, as the law allows); then that one, with twice the
                      factorisations that it is expected to need; then anderson again, from where it stood, with
                      twice the allowance; and so on (`_turns.py`), newton from where it stood too
    coulomb           loose and large piles: sweeps (nncg in both directions from LARGE rows on) race those of the
                      convex relaxation, whose answer is the Coulomb answer wherever contacts stick; where they stall,
                      what is wrong is solved in patches between sweeps (`_race.py`, `_patches.py`); between sweeps of
                      rows or of a matrix Newton's method walks a few steps, few rows have turns of other sweeps
                      instead (`_walks.py`), over velocities it takes turns with them (`_velocities.py`)

Costs are counted from the structure (`_costs.py`) and from the contraction of sweeps that were done, never timed:
the same problem is solved the same way everywhere. Islands are solved apart, each to its share of the whole error,
where that costs less than the whole: small ones in one compiled call (`_split.py`), before sweeps over all of them;
those that it leaves, and large ones, each as a problem of its own. What is left unsolved is asked for a
certificate that it has no solution. The message and `work` say what ran.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lavender._arrays import FloatArray
from lavender.problem import OPERATORS, Problem
from lavender.registry import FEW, SolverSpec
from lavender.residuals import reference
from lavender.solution import Claim, Status
from lavender.solvers import _rates as rates
from lavender.solvers._at_once import HASTY, JOINTS
from lavender.solvers._certify import certify
from lavender.solvers._costs import Costs, Exact
from lavender.solvers._counts import is_loose
from lavender.solvers._few import AUTO
from lavender.solvers._first import factors_at_once, general_first
from lavender.solvers._islands import blocks_of_each, restrict, rows_of
from lavender.solvers._newton import general
from lavender.solvers._opening import Opening
from lavender.solvers._race import race
from lavender.solvers._sweepers import Glance, Sweeps
from lavender.solvers._together import solve_islands, worth_together
from lavender.solvers._trail import Trail
from lavender.solvers._turns import VELOCITY, Turns, whole
from lavender.solvers._velocities import alternate
from lavender.solvers._walks import Walks, in_turns, sweeps_of

LARGE = 4000  # rows of J from which friction is swept both ways, and beside its relaxation
HUGE = 40_000  # rows from which friction is left to sweeps before any factorisation
ONE_CALL = 200  # iterations that a problem of few rows, solved in one call, takes, unless its path is long
LAST = 8000  # sweeps that friction is left to where nothing else is left
RELAXED = 1e6  # ns that sweeps usually take from which Coulomb's law is relaxed first: a problem of its own
FRICTION_APART = 2.0  # times the cost of the whole that islands with friction may take
ROUND_SWEEPS = 1000  # of nncg on round cones given by A, before admm is asked


@dataclass(frozen=True)
class Auto:
    """Chooses solvers, chains them, and says so."""

    def prepare(self, problem: Problem) -> Problem:
        return problem

    def update(self, state: Problem, problem: Problem) -> Problem:
        return problem

    def run(
        self, state: Problem, impulse: FloatArray, n: int, tol: float, time_limit: float | None = None
    ) -> Claim:
        problem = state
        few = problem.m <= FEW and n >= ONE_CALL and (problem.law == "linear" or factors_at_once(problem))
        if few:
            made = AUTO.solve(problem, impulse, tol)
            claim = None if made is None else AUTO.claim(problem, made[1])
            if made is not None and claim is not None and claim.iterations <= n:
                impulse[:] = made[0].impulse
                return claim
        if problem.m == 0:
            return Claim(Status.CONVERGED, 0, {}, "nothing to solve")
        opening = Opening(problem, impulse, n, tol, time_limit, few)
        end = opening.run()
        if end is not None:
            return end
        trail = opening.trail()
        interrupted = False
        try:
            if n > 0 and not (trail.best <= tol if opening.first is None else trail.done):
                _solve(trail, n, opening.glance, opening.fills)
        except KeyboardInterrupt:
            interrupted = True  # the best impulse goes back all the same
        impulse[:] = trail.impulse
        if interrupted:
            status = Status.INTERRUPTED
        elif trail.certificate is not None:
            status = Status.INFEASIBLE
        elif trail.best <= tol:
            status = Status.CONVERGED
        elif trail.at_floor():
            status = Status.FLOOR
        elif trail.late:
            status = Status.TIME_LIMIT
        else:
            status = Status.MAX_ITERATIONS if n == 0 or trail.iterations >= n else Status.STALLED
        nothing = "the start is a solution" if trail.best <= tol else "no time for anything"
        message = " -> ".join(trail.steps) or nothing
        return Claim(status, trail.iterations, trail.work, message, certificate=trail.certificate)


# -- the plan ---------------------------------------------------------------------------------------


@np.errstate(all="ignore")  # what overflows is judged
def _solve(trail: Trail, budget: int, glance: Glance | None = None, fills: bool = False) -> None:
    """To the end; `fills`: the factor of a linear system was counted, and slow sweeps cost less."""
    problem = trail.problem
    costs = trail.costs
    if problem.law == "linear":
        # A sparse factorisation takes islands apart by itself; newton where that stops early.
        if glance is not None:
            Sweeps(trail, glance=glance).note()
        elif fills:
            # What would end after the time limit is no alternative.
            worth = costs.cheapest if costs.whole_factor <= trail.limit else np.inf
            if Sweeps(trail).run(budget, worth=worth):
                return
        # Of a matrix newton makes the same factor as direct.
        look = problem.m > rates.FEW_JOINTS and problem.matrix is None
        exact = costs.exact if look else [JOINTS, Exact("newton", 0.0, 0)]
        if not any(whole(trail, e, budget) for e in exact if e.key not in trail.ended):
            certify(trail)
        return
    if problem.cones.has_round:
        # What it began with may have been cut short. Few others take them, over the rows of A.
        if trail.largest and whole(trail, Exact("newton", 0.0, 0, (("form", "velocity"),)), budget):
            return
        for name, limit in (("nncg", ROUND_SWEEPS), ("admm", 0), ("nncg", 0)):
            if whole(trail, Exact(name, 0.0, 0), budget, limit) or trail.late:
                return
        return
    sweeps = None
    # START of sweeps alone costs more than this factor; where one shift is stuck, sweeps are asked before others.
    at_once = glance is None and HASTY.key not in trail.ended and factors_at_once(problem)
    if at_once and whole(trail, HASTY, budget):
        return
    swept = glance is not None or not _at_once(costs)
    together = (
        (swept or costs.exact[0].key == VELOCITY)
        and problem.m > FEW
        and budget - trail.iterations >= ONE_CALL
        and worth_together(trail, glance)
    )
    if together:
        if glance is not None:
            Sweeps(trail, glance=glance).note()
            trail.offer(glance.impulse)
        if solve_islands(trail, budget):
            return
    relax = swept and problem.m > FEW and _may_relax(trail)
    if relax or (swept and not together):
        # What sweeps have not ended island by island, they hardly end together.
        large = problem.law == "coulomb" and problem.m >= LARGE and problem.rows is not None
        glance = None if together else glance
        options = {"name": "nncg", "order": "symmetric"} if large else {"glance": glance}
        sweeps = sweeps_of(trail, budget, **options)
        if relax and race(trail, sweeps, budget):
            return
        if sweeps.run(budget):
            return
        few = problem.m <= FEW and problem.law == "coulomb" and problem.generalized is None
        if few and in_turns(trail, sweeps, budget):
            return
    if costs.few_bounded and whole(trail, HASTY, budget):
        return
    if trail.largest and problem.law == "coulomb" and alternate(trail, sweeps, budget):
        return
    least = costs.cheapest
    if least > 2.0 * rates.ISLAND and _worth_apart(trail, least, together) and _apart(trail, budget):
        return
    _finish(trail, sweeps, budget)


def _worth_apart(trail: Trail, least: float, left: bool) -> bool:
    """Islands apart cost less than the whole; friction's may cost more, since each finds its own solver.

    `left`: compiled code has solved those that are easy.
    """
    if trail.islands[0] <= 1:
        return False
    friction = trail.problem.law in ("cone", "coulomb") and not left
    return trail.apart_cost() < (FRICTION_APART if friction else 1.0) * least


def _at_once(costs: Costs) -> bool:
    """A finite solver costs less than sweeps usually do, and even a first look at them would be dear beside it."""
    glance = costs.glance(rates.FIRST_LOOK)

    def dear(cost: float) -> bool:
        formed = 0.0 if cost >= costs.over_velocities else costs.formed
        return cost > costs.sweeping or (glance < formed + rates.GLANCE * cost and not costs.redundant)

    return not dear(costs.guess) and not dear(costs.cheapest)


def _may_relax(trail: Trail) -> bool:
    problem = trail.problem
    if problem.law != "coulomb" or problem.rows is None or trail.costs.sweeping < RELAXED:
        return False
    return problem.m >= LARGE or is_loose(problem)


def _finish(trail: Trail, sweeps: Sweeps | None, budget: int) -> None:
    """Finite solvers and sweeps in turn, the allowance doubled each time, until one is there or all have given up."""
    problem = trail.problem
    if isinstance(sweeps, Walks) and sweeps.give_way():
        return
    if problem.law == "coulomb" and problem.m >= HUGE and problem.rows is not None:
        # A factorisation is out of reach: sweeps, however many they take.
        last = Sweeps(trail, "nncg", order="symmetric")
        if last.run(budget, np.inf, cap=LAST):
            return
    turns = Turns(trail, sweeps, budget)
    while turns.left():
        if turns.take():
            return
    if problem.law == "coulomb" and Sweeps(trail, "block_gauss_seidel").run(budget, np.inf, cap=LAST):
        return
    certify(trail)


def _apart(trail: Trail, budget: int) -> bool:
    """Solve every island that misses its share of the whole tolerance."""
    problem = trail.problem
    count = trail.islands[0]
    velocity = reference(problem)[1]
    wrong, _, share = trail.wrong_islands()
    blocks_of = blocks_of_each(*trail.islands)
    kinds: dict[str, int] = {}
    impulse = trail.impulse.copy()
    for i in wrong:
        blocks = blocks_of[i]
        rows = rows_of(problem, blocks)
        part = restrict(problem, blocks, rows)
        e0, v0 = reference(part)
        tol = min(share / e0 if e0 > 0.0 else np.inf, trail.tol * velocity / v0 if v0 > 0.0 else np.inf)
        sub = Trail(part, min(tol, 1.0) if np.isfinite(tol) else trail.tol, trail.deadline, trail.limit)
        sub.offer(impulse[rows])
        try:
            if not sub.done:
                _solve_island(sub, budget - trail.iterations)
        except KeyboardInterrupt:
            impulse[rows] = sub.impulse
            trail.offer(impulse)
            raise
        impulse[rows] = sub.impulse
        trail.iterations += sub.iterations
        for kind, number in sub.work.items():
            trail.work[kind] = trail.work.get(kind, 0) + number
        text = " -> ".join(sub.steps)
        kinds[text] = kinds.get(text, 0) + 1
        if sub.certificate is not None:
            trail.certificate = np.zeros(problem.m)
            trail.certificate[rows] = sub.certificate
            break
        if trail.late or trail.iterations >= budget:
            break
    trail.offer(impulse)
    parts = "; ".join(f"{number} x {text}" if number > 1 else text for text, number in kinds.items())
    trail.steps.append(f"{len(wrong)} of {count} islands: {parts}")
    return trail.done


def _solve_island(trail: Trail, budget: int) -> None:
    sweeps = None
    if not _at_once(trail.costs):
        sweeps = sweeps_of(trail, budget)
        if sweeps.run(budget):
            return
    _finish(trail, sweeps, budget)


def begins(problem: Problem, tol: float) -> tuple[str, str]:
    """What a solve to tol begins with, and the finite solver that would be asked first; nothing is run."""
    kernel = None if problem.generalized is None else general.prepare(problem)
    largest = 0 if kernel is None else kernel.largest
    costs = Costs(problem, tol, largest)
    finite = costs.exact[0].key
    if kernel is not None and general_first(problem, largest):
        return VELOCITY, finite
    if problem.law == "linear" or (problem.m > FEW and _at_once(costs)):
        return finite, finite
    return "sweeps", finite


SPEC = SolverSpec(
    name="auto",
    factory=Auto,
    laws=frozenset({"linear", "lcp", "coulomb", "cone"}),
    operators=frozenset(OPERATORS),
    round_cones=True,
    few=AUTO,
    resumable=False,
    delegates=True,
    max_iter=1_000_000,
    summary="chooses and chains the other solvers, island by island; says what ran",
)
