"""The only solver that hands over to others: each in its turn, by what it would cost from here on.

    linear            direct, newton
    few rows          a symmetric linear system or LCP: direct; else sweeps first, and on as below; all in one
                      call (`_few.py`) where that is the end
    J and M           newton over the velocities at once where that costs next to nothing; else it is one of the
                      finite solvers below, beside those that form A
    others            a finite solver at once where its factor costs less than sweeps usually do; else anderson
                      as long as what it still needs, by its contraction so far, costs less than the cheapest
                      finite solver (direct, newton, lemke, admm, as the law allows); then that one, with twice the
                      factorisations that it is expected to need; then anderson again, from where it stood, with
                      twice the allowance; and so on
    coulomb           loose and large piles whose sweeps promise no end go through the convex relaxation, whose answer
                      is the Coulomb answer wherever contacts stick; where it is not, on from where they stood

Costs are counted from the structure (`_costs.py`) and from the contraction of sweeps that were done, never timed:
the same problem is solved the same way everywhere. Islands are solved apart, each to its share of the
whole error, where that costs less than the whole. What is left unsolved is asked for a certificate that it
has no solution. The message and `work` say what ran.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from time import perf_counter
from typing import Any

import numpy as np

from lavender._arrays import FloatArray, IntArray
from lavender.certificates import check_certificate
from lavender.errors import SolverUnavailable, UnknownName
from lavender.problem import OPERATORS, Problem
from lavender.registry import FEW, SolverSpec, get
from lavender.residuals import at_floor, judged, known, quick, reference, remember
from lavender.solution import Claim, Status
from lavender.solvers._costs import (
    FIRST_LOOK,
    ISLAND,
    LOOK,
    Costs,
    Exact,
    factors_at_once,
    finite_least,
    first_look,
    general_first,
    is_glanced,
    is_loose,
    islands_cost,
    sweep_cost,
)
from lavender.solvers._few import AUTO, WARM, said
from lavender.solvers._islands import islands, restrict, rows_of
from lavender.solvers._newton import general
from lavender.solvers.newton import NewtonState

LARGE = 4000  # rows from which friction goes through the relaxation
HUGE = 40_000  # rows from which friction is left to sweeps before any factorisation
ONE_CALL = 200  # iterations that a problem of few rows, solved in one call, takes at most
CLOCK = 0.01  # s between two looks at the clock, at a nanosecond for each unit of work
CHUNK_WORK = 8  # sweeps' work that an iteration of admm is
NEARER = 0.1  # share of the residual of sweeps that it must have for them to start from there
FOLLOWS = 100.0  # times the tolerance that Coulomb's residual may be where the relaxation is at it
CAP = 400  # sweeps of the relaxation that may be promised; twice that for large problems
FEW_JOINTS = 300  # rows up to which a linear system is not looked at more closely
SWEEPER = "anderson"  # whose sweeps come first
RELAXED = 1e6  # ns that sweeps usually take from which Coulomb's law is relaxed first: a problem of its own
HOPE = 0.4  # share of a finite solver's cost that sweeps may take without promising an end
BELIEVED = 2.0  # times a finite solver's cost that sweeps may take, whatever they promise
GLANCE = 0.35  # share of a finite solver's cost for which a first look at sweeps is always worth it
APART = 10.0  # islands' worth of Python from which a finite solver is compared with islands solved apart
PORTION = 0.25  # of a time limit that sweeps may take that will not get there within it
ROUNDS = 8  # times that sweeps and finite solvers take turns, the allowance doubled each time
GENERAL_STEPS = 256  # that it then has
VELOCITY = "newton velocity"  # key of newton over generalised velocities
CERTIFICATE_ROWS = 3000  # rows up to which a linear program is asked for a certificate
CERTIFICATE_STEPS = 100  # of the simplex method for each row at most


@dataclass
class Trail:
    """What ran, what it cost, and the best impulse of one (sub)problem."""

    problem: Problem
    tol: float
    deadline: float
    limit: float = np.inf  # ns that the whole solve may take, as it was asked
    largest: int = 0  # velocities of the largest island, 0 where newton has no room for them
    best: float = np.inf
    impulse: FloatArray = field(init=False)
    steps: list[str] = field(default_factory=list)
    work: dict[str, int] = field(default_factory=dict)
    iterations: int = 0
    certificate: FloatArray | None = None
    begun: bool = False  # newton over generalised velocities was
    ended: dict[str, float] = field(
        default_factory=dict
    )  # finite solvers that gave up: residual they started from

    # Finite solvers that go on where they stood: solver and state, and the impulse (m,) that goes with them.
    kept: dict[str, tuple[Any, Any]] = field(default_factory=dict)
    left: dict[str, FloatArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        m = self.problem.m
        self.costs = Costs(self.problem, self.tol, self.largest)
        self.impulse = self.problem.start()
        self.w, self.e = np.empty(m), np.empty(m)

    def offer(self, impulse: FloatArray) -> float:
        """Judge an impulse and keep it if it is the best."""
        found = known(self.problem, impulse)
        relative = quick(self.problem, impulse, self.w, self.e)[0] if found is None else found
        if relative < self.best:
            self.best, self.impulse = relative, impulse.copy()
        return relative

    @cached_property
    def islands(self) -> tuple[int, IntArray]:
        """How many, and the island of each block."""
        return islands(self.problem)

    def wrong_islands(self) -> tuple[IntArray, IntArray]:
        """Which islands (count,) miss their share of the whole tolerance, and the island of each row (m,)."""
        count, label = self.islands
        problem = self.problem
        energy, velocity = reference(problem)
        quick(problem, self.impulse, self.w, self.e)
        of_row = np.repeat(label, np.diff(problem.cones.ptr))
        own_energy = np.sqrt(np.bincount(of_row, problem.d * self.e**2, minlength=count))
        own_velocity = np.zeros(count)
        np.maximum.at(own_velocity, of_row, problem.metric.weight * np.abs(self.e))
        # A pair of tangents counts by its norm, at most sqrt(2) times its larger entry.
        wrong = (own_energy > self.tol * energy / np.sqrt(count)) | (
            np.sqrt(2.0) * own_velocity > self.tol * velocity
        )
        return np.flatnonzero(wrong).astype(np.int32), of_row.astype(np.int32)

    def apart_cost(self) -> float:
        """Of the islands that are wrong, each solved apart [ns]; inf where there is one island."""
        if self.islands[0] <= 1:
            return np.inf
        wrong, of_row = self.wrong_islands()
        return islands_cost(self.problem, np.bincount(of_row, minlength=self.islands[0])[wrong])

    @property
    def done(self) -> bool:
        return self.best <= self.tol or self.certificate is not None or self.late or self.at_floor()

    @property
    def late(self) -> bool:
        return perf_counter() >= self.deadline

    def at_floor(self) -> bool:
        if self.best > 1e-5:
            return False
        return at_floor(*quick(self.problem, self.impulse, self.w, self.e, True))

    def add(self, name: str, claim: Claim) -> None:
        self.iterations += claim.iterations
        for kind, count in claim.work.items():
            self.work[kind] = self.work.get(kind, 0) + count
        self.steps.append(said(name, claim.work))


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
        if problem.m <= FEW and n >= ONE_CALL and (problem.law == "linear" or factors_at_once(problem)):
            made = AUTO.solve(problem, impulse, tol)
            if made is not None:
                impulse[:] = made[0].impulse
                return AUTO.claim(problem, made[1])
        deadline = np.inf if time_limit is None else perf_counter() + time_limit
        lam, claim = impulse.copy(), None
        largest = 0
        if problem.generalized is not None and problem.m and n > 0:
            # Newton over the velocities ends nearly all robots: nothing is looked at, and nothing noted, before.
            kernel = general.prepare(problem)
            largest = 0 if kernel is None else kernel.largest
            if kernel is not None and general_first(problem, largest):
                claim = general.run(problem, kernel, lam, min(n, GENERAL_STEPS), tol, time_limit)
                if claim.status is Status.CONVERGED:
                    impulse[:] = lam
                    return general.named(claim, "auto")
        if problem.m == 0:
            return Claim(Status.CONVERGED, 0, {}, "nothing to solve")
        glance = _glance(problem, impulse, n, tol)
        if glance is not None and glance.best <= tol:
            impulse[:] = glance.impulse
            return Claim(Status.CONVERGED, glance.done, glance.work, glance.message)
        limit = np.inf if time_limit is None else 1e9 * time_limit
        trail = Trail(problem, tol, deadline, limit, largest)
        trail.offer(impulse)
        if claim is not None:
            trail.add("newton", claim)
            trail.begun = True
            if claim.status is not Status.MAX_ITERATIONS:
                trail.ended[VELOCITY] = trail.best
            if np.isfinite(lam).all():
                trail.offer(lam)
        interrupted = False
        try:
            if n > 0 and not trail.best <= tol:
                _solve(trail, n, glance)
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
        message = " -> ".join(trail.steps) or "the start is a solution"
        return Claim(status, trail.iterations, trail.work, message, certificate=trail.certificate)


# -- one candidate ----------------------------------------------------------------------------------


def _usable(name: str, problem: Problem) -> SolverSpec | None:
    try:
        spec = get(name)
    except (UnknownName, SolverUnavailable):
        return None
    return spec if spec.refuses(problem) is None else None


def _whole(
    trail: Trail,
    chosen: Exact,
    budget: int,
    limit: int = 0,
    more: Callable[[FloatArray], int] | None = None,
) -> bool:
    """Run a finite solver from the best impulse, to its end or `limit` iterations; True when nothing is left to do.

    `more`: where Newton's method comes to that limit, it is asked for more iterations, 0 to stop.
    """
    name = chosen.name
    spec = _usable(name, trail.problem)
    if spec is None or budget <= trail.iterations:
        return trail.done
    own = name == "newton" and trail.problem.generalized is None
    kept = trail.kept.get(chosen.key)
    if kept is not None:
        solver, state = kept
    else:
        solver = spec.load()(**dict(chosen.options), **({"more": more} if own and more is not None else {}))
        state = _newton_state(trail) if own else solver.prepare(trail.problem)
    # Half-finished sweeps mislead a Newton method; Pi(0) does not.
    before = trail.best
    warm = before <= WARM and (own or chosen.key != VELOCITY or trail.begun)
    impulse = trail.impulse.copy() if warm else trail.problem.start()
    if kept is not None:
        impulse = trail.left[chosen.key]
    trail.begun = trail.begun or chosen.key == VELOCITY
    left = None if np.isinf(trail.deadline) else max(trail.deadline - perf_counter(), 1e-3)
    most = min(limit or spec.max_iter, spec.max_iter, budget - trail.iterations)
    claim: Claim
    if spec.resumable:
        claim = _in_chunks(trail, solver, state, impulse, most)
        trail.kept[chosen.key], trail.left[chosen.key] = (solver, state), impulse
    else:
        claim = solver.run(state, impulse, most, trail.tol, left)
    trail.add(name, claim)
    if np.isfinite(impulse).all():
        trail.offer(impulse)
    if claim.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    if claim.status is not Status.MAX_ITERATIONS:
        trail.ended[chosen.key] = before
    if claim.certificate is not None and check_certificate(trail.problem, claim.certificate) is None:
        trail.certificate = claim.certificate
    return trail.done


def _in_chunks(trail: Trail, solver: Any, state: Any, impulse: FloatArray, n: int) -> Claim:
    """At most n iterations of a solver that goes on where it stood, with looks at the clock and for Ctrl-C."""
    done, work = 0, dict[str, int]()
    chunk = max(1, int(CLOCK * 1e9) // max(1, CHUNK_WORK * trail.problem.data.work))
    while True:
        claim: Claim = solver.run(state, impulse, min(chunk, n - done), trail.tol, None)
        done += claim.iterations
        for kind, count in claim.work.items():
            work[kind] = work.get(kind, 0) + count
        if claim.status is not Status.MAX_ITERATIONS or done >= n or trail.late or claim.iterations == 0:
            return replace(claim, iterations=done, work=work)


def _newton_state(trail: Trail) -> NewtonState:
    """What `newton` prepares, from the system whose cost was looked at."""
    system = trail.costs.system
    return NewtonState(trail.problem, system if system.sc.m else None)


@dataclass
class Glance:
    """A first look at sweeps of `anderson`, before anything else is looked at; they go on from here."""

    solver: Any
    state: Any
    impulse: FloatArray  # (m,) N s
    before: float  # relative residual before its last sweeps,
    last: int  # so many,
    best: float  # and after them
    status: Status
    done: int  # sweeps
    work: dict[str, int]

    @property
    def message(self) -> str:
        return said(SWEEPER, self.work) if self.done else "the start is a solution"


def _glance(problem: Problem, impulse: FloatArray, n: int, tol: float) -> Glance | None:
    """Sweeps from an impulse (m,) where a first look at them costs no more than to find out what else there is."""
    if problem.generalized is not None or problem.law == "linear" or problem.cones.has_round:
        return None
    per = sweep_cost(problem)
    sweeps = first_look(per)
    if n < sweeps or not is_glanced(problem, per):
        return None
    spec = _usable(SWEEPER, problem)
    if spec is None:
        return None
    lam = impulse.copy()
    found = known(problem, impulse)
    before = judged(problem, impulse.copy()).relative if found is None else found
    if before <= tol:
        return Glance(None, None, lam, before, 0, before, Status.CONVERGED, 0, {})
    solver = spec.load()()
    state = solver.prepare(problem)
    least, done, work = finite_least(problem), 0, dict[str, int]()
    while True:
        claim: Claim = solver.run(state, lam, sweeps, tol, None)
        for kind, count in claim.work.items():
            work[kind] = work.get(kind, 0) + count
        done += claim.iterations
        now = judged(problem, lam.copy())
        if now.relative <= tol:
            remember(problem, now)
        if now.relative <= tol or claim.status is not Status.MAX_ITERATIONS or done >= n:
            break
        rest = _sweeps_left(claim.iterations, before, now.relative, tol)
        if rest * per > least or done * per > BELIEVED * least:
            break
        before, sweeps = now.relative, min(n - done, max(FIRST_LOOK, done // 2))
    return Glance(solver, state, lam, before, claim.iterations, now.relative, claim.status, done, work)


def _sweeps_left(done: int, before: float, now: float, tol: float) -> float:
    """At the contraction of the last `done` sweeps."""
    gain = np.log(before / now) if 0.0 < now < before else 0.0
    return done * float(np.log(now / max(tol, 1e-16)) / gain) if gain > 0.0 else np.inf


class _Sweeps:
    """Accelerated sweeps of one problem, which go on where they stood, or where a glance at them did."""

    def __init__(
        self, trail: Trail, name: str = SWEEPER, glance: Glance | None = None, **options: Any
    ) -> None:
        self.trail, self.name, self.glance = trail, name, glance
        spec = _usable(name, trail.problem)
        self.usable = spec is not None
        if glance is not None:
            self.solver, self.state, self.impulse = glance.solver, glance.state, glance.impulse
        elif spec is not None:
            self.solver = spec.load()(**options)
            self.state = self.solver.prepare(trail.problem)
            self.impulse = trail.impulse.copy()
        self.done = 0  # sweeps
        self.last, self.at = trail.best, 0  # residual of the last look, and when it was
        self.rest = np.inf  # sweeps that were then expected to be left
        self.ended = False  # by a claim of its own, or because the residual does not fall

    def run(self, budget: int, worth: float | None = None, cap: int | None = None) -> bool:
        """Sweep while the rest is expected to cost at most `worth` [ns]; a share of that may be spent on hope alone.

        Without `worth`, that is the cheapest finite solver. With `cap`, an end within that many sweeps must be
        promised instead.
        """
        trail, problem, tol = self.trail, self.trail.problem, self.trail.tol
        if not self.usable or self.ended:
            return trail.done
        per = trail.costs.sweep
        chunk = max(1, int(CLOCK * 1e9) // max(1, problem.data.work))
        begun, looks, total = self.done, 0, dict[str, int]()
        step = first_look(per)
        while not trail.late:
            before = self.done
            if self.glance is not None:
                glance, self.glance = self.glance, None
                status, self.done, total = glance.status, glance.done, dict(glance.work)
                self.last, self.at = glance.before, glance.done - glance.last
            else:
                step = min(step, budget - trail.iterations - (self.done - begun))
                if cap is not None:
                    step = min(step, cap - self.done)
                if step <= 0:
                    break
                # In short runs for the clock and Ctrl-C alone: cut anywhere, sweeps give the same bits.
                for start in range(0, step, chunk):
                    claim: Claim = self.solver.run(
                        self.state, self.impulse, min(chunk, step - start), tol, None
                    )
                    status = claim.status
                    self.done += claim.iterations
                    for kind, count in claim.work.items():
                        total[kind] = total.get(kind, 0) + count
                    if status is not Status.MAX_ITERATIONS or trail.late:
                        break
            now = trail.offer(self.impulse)
            looks += 1
            if status is not Status.MAX_ITERATIONS or now <= tol or self.done == before:
                self.ended = not now <= tol
                break
            rest = self.rest = self.expected(now, tol)
            self.last, self.at = now, self.done
            if cap is not None:
                if self.done - begun > 2 * FIRST_LOOK and self.done + rest > cap:
                    break
            elif self.dearer(rest * per, looks * LOOK + (self.done - begun) * per, worth):
                break
            step = max(FIRST_LOOK, self.done // 2)
        trail.add(self.name, Claim(Status.MAX_ITERATIONS, self.done - begun, total))
        return trail.done

    @property
    def too_late(self) -> bool:
        """Sweeps alone will not get there within the time limit, by the contraction before the last look."""
        return (self.done + self.rest) * self.trail.costs.sweep > self.trail.limit

    @property
    def cost(self) -> float:
        """What is left, by the contraction before the last look [ns]."""
        return np.inf if self.ended else self.rest * self.trail.costs.sweep

    def dearer(self, rest: float, spent: float, worth: float | None) -> bool:
        """Whether what is left costs more than what else there is; looked at closely only where it may."""

        def than(other: float) -> bool:
            # What was promised before and did not come about is not believed for ever.
            return (rest > other and spent > HOPE * other) or spent > BELIEVED * other

        if worth == np.inf:
            return False
        if self.done * self.trail.costs.sweep > PORTION * self.trail.limit and self.too_late:
            # Sweeps will not get there in time; a factorisation that is in luck may.
            return any(spent + other.once < self.trail.limit for other in self.trail.costs.exact)
        if worth is not None:
            return than(worth)
        if min(rest, spent) > APART * ISLAND and than(self.trail.apart_cost()):
            return True
        costs = self.trail.costs
        return than(costs.least) and than(costs.guess) and than(costs.exact[0].cost)

    def expected(self, now: float, tol: float) -> float:
        """Sweeps left at the contraction since the last look."""
        return _sweeps_left(self.done - self.at, self.last, now, tol)


# -- the plan ---------------------------------------------------------------------------------------


@np.errstate(all="ignore")  # what overflows is judged
def _solve(trail: Trail, budget: int, glance: Glance | None = None) -> None:
    problem = trail.problem
    costs = trail.costs
    if problem.law == "linear":
        # A sparse factorisation takes islands apart by itself; newton where that stops early.
        exact = costs.exact if problem.m > FEW_JOINTS else [Exact("direct", 0.0, 0), Exact("newton", 0.0, 0)]
        if not any(_whole(trail, e, budget) for e in exact if e.key not in trail.ended):
            _certify(trail)
        return
    if problem.cones.has_round:
        # Nothing else takes them; what it began with may have been cut short.
        if trail.largest:
            _whole(trail, Exact("newton", 0.0, 0, (("form", "velocity"),)), budget)
        return
    sweeps = None
    if glance is None and factors_at_once(problem):
        # START of sweeps alone costs more than this factor.
        if _whole(trail, Exact("direct", 0.0, 0), budget):
            return
    elif glance is not None or not _at_once(costs):
        sweeps = _Sweeps(trail, glance=glance)
        if problem.m > FEW and _may_relax(trail):
            # Where contacts stick, and Coulomb's own sweeps promise no end, the relaxation has the answer.
            if sweeps.run(budget, np.inf, cap=_cap(problem)) or _relaxation(trail, budget):
                return
            if trail.best <= FOLLOWS * trail.tol and trail.best <= NEARER * sweeps.last:
                sweeps = _Sweeps(trail)  # from the relaxation's answer
        if sweeps.run(budget):
            return
    whole = costs.exact[0].cost
    if whole > 2.0 * ISLAND and trail.apart_cost() < whole and _apart(trail, budget):
        return
    _finish(trail, sweeps, budget)


def _at_once(costs: Costs) -> bool:
    """A finite solver costs less than sweeps usually do, and even a first look at them would be dear beside it."""
    glance = costs.glance(FIRST_LOOK)

    def dear(cost: float) -> bool:
        return cost > costs.sweeping or (glance < GLANCE * cost and not costs.redundant)

    return not dear(costs.guess) and not dear(costs.exact[0].cost)


def _may_relax(trail: Trail) -> bool:
    problem = trail.problem
    if problem.law != "coulomb" or problem.rows is None or trail.costs.sweeping < RELAXED:
        return False
    return problem.m >= LARGE or is_loose(problem)


def _finish(trail: Trail, sweeps: _Sweeps | None, budget: int) -> None:
    """Finite solvers and sweeps in turn, the allowance doubled each time, until one is there or all have given up."""
    problem = trail.problem
    if problem.law == "coulomb" and problem.m >= HUGE and problem.rows is not None:
        # A factorisation is out of reach: sweeps, however many they take.
        last = _Sweeps(trail, "nncg", order="symmetric")
        if last.run(budget, np.inf, cap=20 * CAP):
            return
    turns = _Turns(trail, sweeps, budget)
    while turns.left():
        if turns.take():
            return
    if problem.law == "coulomb" and _Sweeps(trail, "block_gauss_seidel").run(budget, np.inf, cap=20 * CAP):
        return
    _certify(trail)


class _Turns:
    """Turns of what there is: every finite solver with its allowance, then sweeps; twice as much in the next turn.

    Newton's method, which cannot go on where it stood once it has returned, takes the turns of the others from
    within: where its allowance is used up, they have theirs.
    """

    def __init__(self, trail: Trail, sweeps: _Sweeps | None, budget: int) -> None:
        self.trail, self.sweeps, self.budget = trail, sweeps, budget
        self.taken = 0
        self.allowance = 0.0  # of sweeps [ns]
        self.over = False  # nothing gets anywhere
        self.inside: Exact | None = None  # Newton's method, where it waits for a turn to end

    def left(self) -> bool:
        return self.taken < ROUNDS and not self.over

    def take(self) -> bool:
        """One turn; True when nothing is left to do."""
        trail, costs, k = self.trail, self.trail.costs, self.taken
        before, spent = trail.best, trail.iterations
        for candidate in costs.exact:
            if trail.best <= trail.tol or self.budget <= trail.iterations:
                return True
            if candidate is self.inside:
                continue
            started = trail.ended.get(candidate.key)
            if started is not None and not trail.best <= 0.1 * started:
                continue  # it gave up, and would do so again
            # The one before gave up, or needs more than was expected of it.
            sweeps = self.sweeps
            cheaper = sweeps is not None and trail.iterations > spent and sweeps.cost < candidate.cost
            if (
                cheaper
                and sweeps is not None
                and not sweeps.too_late
                and sweeps.run(self.budget, candidate.cost)
            ):
                return True
            if _whole(trail, candidate, self.budget, candidate.limit << k, self.more(candidate)):
                return True
            if self.taken > k:
                break  # turns were taken meanwhile
        else:
            self.taken += 1
            self.allowance = max(2.0 * self.allowance, 2.0 * costs.exact[0].cost)
            self.sweeps = self.sweeps or _Sweeps(trail)
            if self.sweeps.run(self.budget, self.allowance):
                return True
            self.over = trail.late or (spent == trail.iterations and trail.best >= before)
        return False

    def more(self, newton: Exact) -> Callable[[FloatArray], int] | None:
        """What Newton's method asks where its allowance is used up."""
        if self.inside is not None:
            return None

        def ask(impulse: FloatArray) -> int:
            self.trail.offer(impulse)
            self.inside = newton
            try:
                done = self.trail.done or not self.left() or self.take()
            finally:
                self.inside = None
            return 0 if done or self.trail.late else newton.limit << min(self.taken, ROUNDS)

        return ask


def _apart(trail: Trail, budget: int) -> bool:
    """Solve every island that misses its share of the whole tolerance."""
    problem = trail.problem
    count, label = trail.islands
    energy, velocity = reference(problem)
    share = trail.tol * energy / np.sqrt(count)
    wrong, _ = trail.wrong_islands()
    order = np.argsort(label, kind="stable")
    ends = np.searchsorted(label[order], np.arange(count + 1))
    kinds: dict[str, int] = {}
    impulse = trail.impulse.copy()
    for i in wrong:
        blocks: IntArray = order[ends[i] : ends[i + 1]].astype(np.int32)
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
        sweeps = _Sweeps(trail)
        if sweeps.run(budget):
            return
    _finish(trail, sweeps, budget)


def _relaxation(trail: Trail, budget: int) -> bool:
    """Sweep the convex relaxation, to tighter and tighter residuals as long as Coulomb's follows."""
    problem = trail.problem
    convex = Trail(problem.relaxed("cone"), trail.tol, trail.deadline, trail.limit)
    convex.offer(problem.start())
    last = FOLLOWS * trail.tol
    for k in range(4):
        if problem.m >= HUGE and k == 1:
            break
        convex.tol = trail.tol * 0.1**k
        _Sweeps(convex).run(budget - trail.iterations, np.inf, cap=_cap(problem))
        now = trail.offer(convex.impulse)
        if trail.done or now > last or convex.best > convex.tol:
            break
        last = 0.5 * now
    trail.iterations += convex.iterations
    for kind, count in convex.work.items():
        trail.work[kind] = trail.work.get(kind, 0) + count
    trail.steps += [f"relaxation: {step}" for step in convex.steps]
    return trail.done


@np.errstate(all="ignore")  # what overflows is judged
def _certify(trail: Trail) -> None:
    """Look for a proof that an LCP without upper bounds has no solution, whatever its A."""
    problem = trail.problem
    cones = problem.cones
    if (
        problem.law not in ("linear", "lcp")
        or problem.m > CERTIFICATE_ROWS
        or trail.best < 1e-6
        or trail.late
    ):
        return
    free = np.isneginf(cones.lower) & np.isposinf(cones.upper)
    if not np.all(free | ((cones.lower == 0.0) & np.isposinf(cones.upper))):
        return
    from scipy.optimize import linprog  # 0.1 s to import, needed only here

    # max b.y, A^T y <= 0 (= 0 on free rows), 0 <= y <= 1, in units of d.
    scale = 1.0 / np.sqrt(problem.d)
    at = (problem.csr.T.multiply(scale[:, None])).multiply(scale[None, :]).tocsr()
    if not (np.isfinite(at.data).all() and np.isfinite(scale * problem.b).all()):
        return
    bounds = np.stack([np.where(free, -1.0, 0.0), np.ones(problem.m)], 1)
    options: dict[str, Any] = {"maxiter": CERTIFICATE_STEPS * problem.m}
    if trail.deadline < np.inf:
        options["time_limit"] = max(trail.deadline - perf_counter(), 1e-3)
    found = linprog(
        -(scale * problem.b),
        A_ub=at[~free] if (~free).any() else None, b_ub=np.zeros(int((~free).sum())) if (~free).any() else None,
        A_eq=at[free] if free.any() else None, b_eq=np.zeros(int(free.sum())) if free.any() else None,
        bounds=bounds, method="highs", options=options,
    )  # fmt: skip
    trail.steps.append("linear program for a certificate")
    trail.work["certificates"] = trail.work.get("certificates", 0) + 1
    if found.x is not None:
        y = np.where((found.x > 0.0) | free, found.x, 0.0) * scale
        if check_certificate(problem, y) is None:
            trail.certificate = y


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


# -- what a problem looks like ------------------------------------------------------------------------


def _cap(problem: Problem) -> int:
    return CAP if problem.m < LARGE else 2 * CAP


def _refusal(problem: Problem) -> str | None:
    return get("newton").refuses(problem) if problem.cones.has_round else None


SPEC = SolverSpec(
    name="auto",
    factory=Auto,
    laws=frozenset({"linear", "lcp", "coulomb", "cone"}),
    operators=frozenset(OPERATORS),
    round_cones=True,
    refusal=_refusal,
    few=AUTO,
    resumable=False,
    delegates=True,
    max_iter=1_000_000,
    summary="chooses and chains the other solvers, island by island; says what ran",
)
