"""The only solver that hands over to others: which ones, by law, size, structure, form and tol.

    linear            direct; newton where that stops early
    lcp, symmetric    direct on narrow bands and few rows; newton on wider bands, and where there are more
                      rows than the bodies can tell apart or mass ratios of 1e3; else anderson as long as it
                      gets on, then newton
    lcp, other        newton, lemke
    cone              newton on faces that rest on faces; else anderson as long as it gets on, then newton
    coulomb           anderson as long as it gets on, then newton; a few contacts by a dozen sweeps of
                      block_gauss_seidel too; loose and large piles first
                      through the convex relaxation, whose answer is the Coulomb answer wherever
                      contacts stick

Sweeps get on as long as their contraction so far promises an end within a fixed number of them: counted,
never timed. Islands are solved apart once sweeps over all of them have not ended it, each to its share
of the whole error. What is left unsolved is asked for a certificate that it has no solution. The message
and `work` say what ran.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np

from lavender._arrays import FloatArray, IntArray
from lavender.errors import SolverUnavailable, UnknownName
from lavender.problem import Problem
from lavender.registry import SolverSpec, get
from lavender.residuals import at_floor, check_certificate, known, quick, reference
from lavender.solution import Claim, Status
from lavender.solvers._islands import block_bodies, islands, restrict, rows_of
from lavender_ext.factor import graph

NARROW = 12  # half-bandwidth up to which a band factorisation costs less than anything else
FEW = 64  # rows up to which a dense factorisation does
HEAVY = 1e3  # mass ratio at which sweeps are not tried
LARGE = 4000  # rows from which friction goes through the relaxation
BANDED = 1200.0  # multiply-adds of a band's factor for each nonzero of A up to which sweeps are not tried
HUGE = 40_000  # rows from which friction is left to sweeps before any factorisation
FIRST_LOOK = 16  # sweeps before the first look at the residual
CLOCK = 0.01  # s between two looks at the clock, at a nanosecond for each unit of work
CAP = 800  # sweeps that may be promised; twice that for large problems
WARM = 1e-3  # relative residual from which an iterate is worth starting from
HOPELESS = 0.5  # relative residual after the first sweeps of a few contacts with which they end
NEARLY = 1e-2  # relative residual after the first sweeps from which more of them are worth it
CERTIFICATE_ROWS = 3000  # rows up to which a linear program is asked for a certificate
CERTIFICATE_STEPS = 100  # of the simplex method for each row at most


@dataclass
class Trail:
    """What ran, what it cost, and the best impulse of one (sub)problem."""

    problem: Problem
    tol: float
    deadline: float
    best: float = np.inf
    impulse: FloatArray = field(init=False)
    steps: list[str] = field(default_factory=list)
    work: dict[str, int] = field(default_factory=dict)
    iterations: int = 0
    certificate: FloatArray | None = None
    tried: set[str] = field(default_factory=set)  # solvers run on the whole of it

    def __post_init__(self) -> None:
        m = self.problem.m
        self.impulse = self.problem.start()
        self.w, self.e = np.empty(m), np.empty(m)

    def offer(self, impulse: FloatArray) -> float:
        """Judge an impulse and keep it if it is the best."""
        found = known(self.problem, impulse)
        relative = quick(self.problem, impulse, self.w, self.e)[0] if found is None else found
        if relative < self.best:
            self.best, self.impulse = relative, impulse.copy()
        return relative

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
        done = ", ".join(f"{count} {kind}" for kind, count in claim.work.items() if count)
        self.steps.append(f"{name} {done}".strip())


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
        deadline = np.inf if time_limit is None else perf_counter() + time_limit
        trail = Trail(problem, tol, deadline)
        if problem.m == 0:
            return Claim(Status.CONVERGED, 0, {}, "nothing to solve")
        trail.offer(impulse)
        interrupted = False
        try:
            if n > 0 and not trail.best <= tol:
                _solve(trail, n)
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


def _whole(trail: Trail, name: str, budget: int) -> bool:
    """Run a solver to its end from the best impulse; True when nothing is left to do."""
    spec = _usable(name, trail.problem)
    if spec is None or budget <= trail.iterations:
        return trail.done
    trail.tried.add(name)
    solver = spec.load()()
    state = solver.prepare(trail.problem)
    # Half-finished sweeps mislead a Newton method; Pi(0) does not.
    impulse = trail.impulse.copy() if trail.best <= WARM else trail.problem.start()
    left = None if np.isinf(trail.deadline) else max(trail.deadline - perf_counter(), 1e-3)
    limit = min(spec.max_iter, budget - trail.iterations)
    claim: Claim = solver.run(state, impulse, limit, trail.tol, left)
    trail.add(name, claim)
    if np.isfinite(impulse).all():
        trail.offer(impulse)
    if claim.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    if claim.certificate is not None and check_certificate(trail.problem, claim.certificate) is None:
        trail.certificate = claim.certificate
    return trail.done


def _sweeps(trail: Trail, name: str, budget: int, cap: int, patient: bool = False, **options: Any) -> bool:
    """Sweep from the best impulse as long as an end within `cap` sweeps is promised, or up to `cap` if patient."""
    problem = trail.problem
    spec = _usable(name, problem)
    if spec is None:
        return trail.done
    tol = trail.tol
    solver: Any = spec.load()(**options)
    state = solver.prepare(problem)
    impulse = trail.impulse.copy()
    total: dict[str, int] = {}
    done, step = 0, FIRST_LOOK
    last = trail.best
    chunk = max(1, int(CLOCK * 1e9) // max(1, problem.data.work))
    while not trail.late:
        step = min(step, cap - done, budget - trail.iterations - done)
        if step <= 0:
            break
        # In short runs for the clock and Ctrl-C alone: cut anywhere, sweeps give the same bits.
        before = done
        for start in range(0, step, chunk):
            claim: Claim = solver.run(state, impulse, min(chunk, step - start), tol, None)
            done += claim.iterations
            for kind, count in claim.work.items():
                total[kind] = total.get(kind, 0) + count
            if claim.status is not Status.MAX_ITERATIONS or trail.late:
                break
        now = trail.offer(impulse)
        if claim.status is not Status.MAX_ITERATIONS or now <= tol or done == before:
            break
        if done > 2 * FIRST_LOOK and not patient:
            gain = np.log(last / now) if 0.0 < now < last else 0.0
            if gain <= 0.0 or done + step * np.log(now / max(tol, 1e-16)) / gain > cap:
                break
        last = now
        step = max(FIRST_LOOK, done // 2)
    trail.add(name, Claim(Status.MAX_ITERATIONS, done, total))
    return trail.done


# -- the plan ---------------------------------------------------------------------------------------


def _solve(trail: Trail, budget: int) -> None:
    problem = trail.problem
    if problem.law == "linear":
        # A sparse factorisation takes islands apart by itself.
        _connected(trail, budget, swept=False)
        return
    swept = _sweeps_first(problem)
    if swept and _sweep(trail, budget):
        return
    # A band factorisation takes islands apart by itself, too.
    narrow = not swept and problem.law == "lcp" and problem.is_symmetric and _bandwidth(problem) <= NARROW
    if narrow and _whole(trail, "direct", budget):
        return
    count, label = islands(problem)
    if count <= 1:
        _connected(trail, budget, swept)
    else:
        _apart(trail, count, label, budget)


def _sweeps_first(problem: Problem) -> bool:
    """Whether sweeps are worth a try, by what is known without looking closer."""
    if problem.law == "lcp":
        return problem.is_symmetric and not (
            _is_small_or_narrow(problem)
            or _is_heavy(problem)
            or _is_redundant(problem)
            or _is_banded(problem)
        )
    if problem.law == "cone" and _is_redundant(problem) and not _is_loose(problem):
        return False  # faces on faces: the same weight rests on several points, and sweeps hardly move it
    return not _is_heavy(problem)


def _sweep(trail: Trail, budget: int) -> bool:
    problem = trail.problem
    if problem.law == "lcp":
        return _sweeps(trail, "anderson", budget, _cap(problem))
    few = problem.law == "coulomb" and problem.m <= FEW
    if problem.law == "coulomb" and not few and problem.rows is not None:
        if (problem.m >= LARGE or _is_loose(problem)) and _relaxation(trail, budget):
            return True
        if problem.m >= HUGE:
            # A factorisation is out of reach: sweeps, however many they take.
            return _sweeps(trail, "nncg", budget, 10 * CAP, patient=True, order="symmetric")
    if few:
        # A few contacts end within a dozen sweeps, accelerated or exact on each contact, or hardly ever.
        for name in ("anderson", "block_gauss_seidel"):
            if trail.best > HOPELESS and trail.iterations:
                return False
            if _sweeps(trail, name, budget, FIRST_LOOK):
                return True
        return trail.best <= NEARLY and _sweeps(trail, "anderson", budget, _cap(problem))
    return _sweeps(trail, "anderson", budget, _cap(problem))


@np.errstate(all="ignore")  # what overflows is judged
def _apart(trail: Trail, count: int, label: IntArray, budget: int) -> None:
    """Solve every island that misses its share of the whole tolerance."""
    problem = trail.problem
    energy, velocity = reference(problem)
    quick(problem, trail.impulse, trail.w, trail.e)
    of_row = np.repeat(label, np.diff(problem.cones.ptr))
    d, weight = problem.d, problem.data.weight
    share = trail.tol * energy / np.sqrt(count)
    own_energy = np.sqrt(np.bincount(of_row, d * trail.e**2, minlength=count))
    own_velocity = np.zeros(count)
    np.maximum.at(own_velocity, of_row, weight * np.abs(trail.e))
    # A pair of tangents counts by its norm, at most sqrt(2) times its larger entry.
    wrong = (own_energy > share) | (np.sqrt(2.0) * own_velocity > trail.tol * velocity)
    order = np.argsort(label, kind="stable")
    ends = np.searchsorted(label[order], np.arange(count + 1))
    kinds: dict[str, int] = {}
    impulse = trail.impulse.copy()
    for i in np.flatnonzero(wrong):
        blocks: IntArray = order[ends[i] : ends[i + 1]].astype(np.int32)
        rows = rows_of(problem, blocks)
        part = restrict(problem, blocks, rows)
        e0, v0 = reference(part)
        tol = min(share / e0 if e0 > 0.0 else np.inf, trail.tol * velocity / v0 if v0 > 0.0 else np.inf)
        sub = Trail(part, min(tol, 1.0) if np.isfinite(tol) else trail.tol, trail.deadline)
        sub.offer(impulse[rows])
        swept = part.m < problem.m // 2 and _sweeps_first(part)
        try:
            if not (swept and _sweep(sub, budget - trail.iterations)):
                _connected(sub, budget - trail.iterations, swept)
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
    trail.steps.append(f"{int(wrong.sum())} of {count} islands: {parts}")


def _connected(trail: Trail, budget: int, swept: bool) -> None:
    """One island after its sweeps, or a linear system."""
    problem = trail.problem
    if trail.best <= trail.tol or budget <= trail.iterations:
        return
    names: tuple[str, ...]
    if problem.law == "linear":
        names = ("direct", "newton")
    elif problem.law != "lcp":
        names = ("newton",)
    elif not problem.is_symmetric:
        names = ("newton", "lemke")
    elif not swept and _is_small_or_narrow(problem):
        names = ("direct", "newton", "lemke")
    else:
        names = ("newton", "direct", "lemke")
    for name in names:
        if name not in trail.tried and _whole(trail, name, budget):
            return
    if problem.law == "coulomb" and _sweeps(trail, "block_gauss_seidel", budget, 10 * CAP):
        return
    _certify(trail)


def _relaxation(trail: Trail, budget: int) -> bool:
    """Sweep the convex relaxation, to tighter and tighter residuals as long as Coulomb's follows."""
    problem = trail.problem
    convex = Trail(problem.relaxed("cone"), trail.tol, trail.deadline)
    convex.offer(trail.impulse)
    for k in range(4):
        before = trail.best
        if problem.m >= HUGE and k == 1:
            break
        convex.tol = trail.tol * 0.1**k
        _sweeps(convex, "anderson", budget - trail.iterations, _cap(problem))
        trail.offer(convex.impulse)
        if trail.done or trail.best > 0.5 * before or convex.best > convex.tol:
            break
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


# -- what a problem looks like ------------------------------------------------------------------------


def _is_small_or_narrow(problem: Problem) -> bool:
    return problem.m <= FEW or _bandwidth(problem) <= NARROW


def _cap(problem: Problem) -> int:
    return CAP if problem.m < LARGE else 2 * CAP


def _is_heavy(problem: Problem) -> bool:
    if problem.rows is None:
        return False
    moving = problem.rows.inv_mass[problem.rows.inv_mass > 0.0]
    return len(moving) > 0 and bool(moving.max() >= HEAVY * float(moving.min()))


def _is_redundant(problem: Problem) -> bool:
    """More rows than degrees of freedom: sweeps then converge slowly, and a factorisation over bodies is small."""
    if problem.rows is None:
        return False
    return problem.m > 6 * problem.rows.n_bodies and bool(np.all(problem.compliance == 0.0))


def _is_banded(problem: Problem) -> bool:
    """A matrix so narrow that a dozen factorisations cost less than the sweeps that would be promised."""
    if problem.rows is not None:
        return False
    from lavender.solvers._ipm import BAND_SHARE  # loads SciPy's sparse solvers, which few problems need

    width = max(problem.bandwidth)
    return width <= BAND_SHARE * problem.m and problem.m * width**2 <= BANDED * problem.csr.nnz


def _is_loose(problem: Problem) -> bool:
    """Nearly every contact between two bodies of its own, not one of a face: sweeps then settle which ones stick."""
    assert problem.rows is not None
    bodies = np.sort(block_bodies(problem), axis=1)
    pairs = bodies[:, 0].astype(np.int64) * problem.rows.n_bodies + bodies[:, 1]
    return 4 * len(np.unique(pairs)) > 3 * len(pairs)


def _bandwidth(problem: Problem) -> int:
    if problem.rows is None:
        return max(problem.bandwidth)
    spread = problem.derived.spread
    if spread is None:
        spread = graph.body_spread(problem.cones.ptr, block_bodies(problem), problem.rows.n_bodies)
        problem.derived.spread = spread
    return spread


SPEC = SolverSpec(
    name="auto",
    factory=Auto,
    laws=frozenset({"linear", "lcp", "coulomb", "cone"}),
    resumable=False,
    delegates=True,
    max_iter=1_000_000,
    summary="chooses and chains the other solvers, island by island; says what ran",
)
