"""Factor and solve; with bounds, block principal pivoting on the same factorisation.

    linear   A lambda = b by band, dense or sparse factorisation, then lambda <- lambda - A^-1 w (refinement)
    boxed    w = A lambda - b complementary to lower <= lambda <= upper: guess which rows are free (all of a
             narrow band, else those that a few sweeps leave free), solve them, exchange the rows of the
             wrong sign, repeat (`lavender_ext/pivot/principal.pyx`)
    singular the same on A + s D, s = 1e-10, around the last answer c: (A + s D) lambda = b + s D c. A fixed
             point solves A itself (proximal point method); on the rows it settles on, each pass is one
             refinement that shrinks what A sees by s / (s + sigma). On a problem without a solution the
             passes keep walking along some y >= 0 with A y = 0, b.y > 0: the certificate.

Positive definite A: finite and exact to rounding, whatever `tol`. Singular positive semidefinite A: the
message says so, and what cannot be refined to rounding is STALLED with the best iterate. Linear systems
that are asymmetric or indefinite get LU with pivoting, and where that is singular its rank from an SVD.
Bounded rows whose A is asymmetric are exchanged by LU: finite where exchanges do not go round in circles, which no
energy then ends. Friction of boxes comes as such rows (`polyhedral.py`); where its exchanges do, complementary pivots
follow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from lavender._arrays import FloatArray
from lavender.certificates import check_certificate
from lavender.deadline import Deadline
from lavender.problem import Problem
from lavender.registry import SolverSpec
from lavender.residuals import at_floor, judged, remember
from lavender.solution import Claim, Status
from lavender.solvers._factor import SMALL_SIZE, GeneralFactor, PanelsLU
from lavender.solvers.pivoting import PivotState
from lavender.solvers.small import DIRECT
from lavender_ext.judge import measure
from lavender_ext.pivot.principal import INDEFINITE, ROUNDS, SMALL, SOLVED, STUCK

# -, s: the last is far above the rounding of a factorisation and below what a mass ratio of 1e8 leaves.
PATH = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)
SHIFT_STEP = 100.0
GOOD = 1e-13  # relative residual at which refinement ends, where the floor allows it
RUNAWAY = 1e-6
PASSES = 100  # proximal passes at most
PATIENCE = 6  # passes without halving the best residual
CORRECTIONS = 100  # refinements at a time at most; each halves the residual
BATCH = 32  # rounds between two looks at the clock and the judge


@dataclass
class DirectState:
    """Factor of a linear system, or the rows of a boxed one; fresh before each run."""

    problem: Problem
    pivot: PivotState | None = None
    general: GeneralFactor | PanelsLU | None = None
    outcome: int = SOLVED  # of the factorisation of a linear system
    begun: int = 0  # factorisations before `general` that came to nothing
    note: str = ""


@dataclass(frozen=True)
class Direct:
    """Direct solution of linear systems and of boxed LCPs, positive semidefinite or asymmetric."""

    patience: ClassVar[bool] = True  # to go on where pivoting on one shift is stuck
    exact: ClassVar[bool] = True  # to rounding, whatever the tolerance

    def otherwise(self) -> Any:
        """What follows where exchanges go round in circles on friction as bounded rows: one pivot after the other."""
        from lavender.solvers.lemke import Lemke

        return Lemke()

    def prepare(self, problem: Problem, like: PivotState | None = None) -> DirectState:
        linear = problem.law == "linear"
        if linear and not problem.is_symmetric and problem.m > SMALL_SIZE:
            return _unsymmetric(problem)
        state = DirectState(problem, PivotState(problem, like))
        if linear and state.pivot is not None:
            state.outcome = state.pivot.factorise(whole=True)
            if state.outcome == INDEFINITE:
                return _general(problem, "A is indefinite")
            if not problem.is_symmetric:
                state.note = "A is not symmetric"
                if state.outcome != SOLVED:
                    return _general(problem, state.note)
        return state

    def update(self, state: DirectState, problem: Problem) -> DirectState:
        return self.prepare(problem, state.pivot)

    def run(
        self, state: DirectState, impulse: FloatArray, n: int, tol: float, time_limit: float | None = None
    ) -> Claim:
        run = _Run(state, impulse, n, tol, time_limit, self.patience, self.exact)
        if state.problem.m == 0:
            return run.claim(Status.CONVERGED)
        if n == 0:
            return run.claim(Status.MAX_ITERATIONS)
        try:
            return run.pivoting() if state.general is None else run.linear_general(state.general)
        finally:
            run.put_best()


class Impatient(Direct):
    """As `auto` asks first: bounded rows on which pivoting is stuck, or one shift singular, end it at once, STALLED."""

    patience: ClassVar[bool] = False


@dataclass(frozen=True)
class Enough(Direct):
    """As `auto` asks where every row is free: what meets the tolerance is not refined."""

    exact: ClassVar[bool] = False


@np.errstate(all="ignore")  # what overflows is judged
def _unsymmetric(problem: Problem) -> DirectState:
    """LU by panels where A has few entries, else with pivoting."""
    why = "A is not symmetric"
    if not PanelsLU.takes(problem):
        return _general(problem, why)
    factor = PanelsLU(problem)
    if factor.usable:
        return DirectState(problem, general=factor, note=why)
    return replace(_general(problem, f"{why}; LU by panels lost a pivot"), begun=1)


@np.errstate(all="ignore")  # what overflows is judged
def _general(problem: Problem, why: str) -> DirectState:
    factor = GeneralFactor(problem)
    if not factor.usable:
        why += "; LU is singular and A too large for a decomposition that reveals its rank"
    elif factor.rank < problem.m:
        why += f"; A is singular, rank {factor.rank} of {problem.m}"
    return DirectState(problem, general=factor, note=why)


class _Run:
    """One solve: the best judged iterate so far, and what was spent."""

    def __init__(
        self,
        state: DirectState,
        impulse: FloatArray,
        n: int,
        tol: float,
        time_limit: float | None,
        patient: bool,
        exact: bool,
    ) -> None:
        self.patient = patient
        self.least = GOOD if exact else max(GOOD, tol)  # relative residual that is good whatever the floor
        self.state, self.problem, self.impulse, self.budget, self.tol = state, state.problem, impulse, n, tol
        self.deadline = Deadline(time_limit)
        self.kept: measure.Judged | None = None
        self.best, self.floor, self.last = np.inf, 0.0, np.inf
        self.iterations = 0
        self.work: dict[str, int] = {}
        self.notes = [state.note] if state.note else []

    # -- judging ---------------------------------------------------------------------------------

    def judge(self, x: FloatArray) -> float:
        """Relative residual of x, which must not change any more; the best becomes the result."""
        found = judged(self.problem, x)
        relative: float = found.relative
        if relative < self.best:
            self.kept, self.best, self.floor = found, relative, found.floor
        self.last = relative
        return relative

    def put_best(self) -> None:
        if self.kept is not None:
            self.impulse[:] = self.kept.impulse
            remember(self.problem, self.kept)

    @property
    def impulse_now(self) -> FloatArray:
        """The best so far, (m,) N s; not to be changed."""
        return self.impulse if self.kept is None else self.kept.impulse

    def good(self) -> bool:
        # A floor above 1e-6 belongs to an impulse that ran away, not to the problem.
        return self.best <= max(self.least, min(self.floor, RUNAWAY))

    def rounded(self) -> bool:
        """Good, or where refinement ends: at what counts as the floor."""
        return self.good() or at_floor(self.best, min(self.floor, RUNAWAY))

    @property
    def spent(self) -> bool:
        """No rounds or no time left."""
        return self.iterations >= self.budget or self.out_of_time

    @property
    def out_of_time(self) -> bool:
        pivot = self.state.pivot
        late = pivot is not None and pivot.late and self.deadline.is_set
        return late or self.deadline.passed()

    def claim(self, status: Status, **more: Any) -> Claim:
        state = self.state
        form = "LU" if state.general is not None else state.pivot.form if state.pivot is not None else ""
        work = dict(self.work)
        if state.pivot is not None:
            work.update(state.pivot.work)
        return Claim(status, self.iterations, work, "; ".join(self.notes), form=form, **more)

    def verdict(self) -> Claim:
        """What the best iterate deserves, when nothing is left to do."""
        if self.best <= self.tol:
            return self.claim(Status.CONVERGED)
        if at_floor(self.best, self.floor):
            return self.claim(Status.FLOOR)
        return self.claim(Status.STALLED)

    # -- linear systems that are not symmetric definite -------------------------------------------

    @np.errstate(all="ignore")  # what overflows is judged
    def linear_general(self, factor: GeneralFactor | PanelsLU) -> Claim:
        problem = self.problem
        self.iterations = 1
        self.work = {"factorisations": 1 + self.state.begun}
        if not factor.usable:
            return self.claim(Status.NUMERICAL_ERROR)
        singular = factor.rank < problem.m
        x = self.impulse_now if singular else np.zeros(problem.m)
        w = np.empty(problem.m)
        previous = np.inf
        for k in range(8):
            measure.slack(problem.csr_data, x, w)
            x = x - factor.solve(w)
            relative = self.judge(x)
            self.work["refinements"] = k
            if self.good() or not relative < 0.5 * previous:
                break
            previous = relative
        if isinstance(factor, PanelsLU):
            if not self.rounded() and not self.out_of_time:
                return self.general(f"{self.notes[0]}; LU by panels did not refine")
        elif not self.good() and singular:
            # What least squares in the metric of D leaves of b is orthogonal to the range of A.
            measure.slack(problem.csr_data, x, w)
            proof = self.certificate(-w / problem.csr_data.d) or self.certificate(factor.outside(problem.b))
            if proof is not None:
                return proof
        return self.verdict()

    # -- symmetric A -------------------------------------------------------------------------------

    def pivoting(self) -> Claim:
        pivot = self.state.pivot
        assert pivot is not None
        rows = pivot.rows
        code = self.state.outcome
        if self.problem.law == "linear":
            if code == SOLVED:
                pivot.solve_free()
                self.iterations = 1
                relative = self.judge(pivot.impulse())
                if not self.good():
                    rows.slack()
                    self.refine(pivot, relative)
                    if self.rounded():
                        return self.verdict()
                    if not pivot.symmetric:
                        return self.general("A is not symmetric")
        else:
            # Which rows will be free? All, or where a few sweeps put them.
            sweeps = pivot.sweeps
            code, self.iterations, swept = pivot.solve(
                self.impulse, sweeps, min(BATCH, self.budget), self.deadline
            )
            if swept:
                self.work["sweeps"] = 2 * sweeps
            code = self.after_rounds(pivot, code)
            if code == ROUNDS and not self.spent:
                code = self.rounds(pivot)
        if self.good():
            return self.verdict()
        if code == ROUNDS and self.spent:
            return self.out_of_budget()
        if code == INDEFINITE:
            return self.indefinite()
        if code == SMALL:
            self.note_singular(pivot, self.patient or pivot.symmetric)
        if code == STUCK and not pivot.symmetric:
            return self.circling()
        if not self.patient and not (code == SMALL and pivot.symmetric):
            return self.verdict()
        return self.proximal(pivot, code == STUCK)

    def circling(self) -> Claim:
        self.notes.append(
            "exchanges go round in circles, and A is not symmetric: no energy to descend on; see lemke"
        )
        if not self.best <= 1.0:
            self.judge(self.problem.start())
        return self.verdict()

    def rounds(self, pivot: PivotState) -> int:
        """Rounds to the end of this pass, refined and judged, within the budget and the time."""
        while True:
            code, done = pivot.rounds(min(BATCH, self.budget - self.iterations), self.deadline)
            self.iterations += done
            code = self.after_rounds(pivot, code)
            # Signs that differ by rounding alone exchange for ever; the judge sees that nothing is wrong.
            if code != ROUNDS or self.good() or self.spent:
                return code

    def after_rounds(self, pivot: PivotState, code: int) -> int:
        """Judge what rounds left, and refine it."""
        if code in (SMALL, INDEFINITE):
            return code
        relative = self.judge(pivot.impulse())
        if code == SOLVED and pivot.rows.shift == 0.0 and not self.good():
            pivot.rows.slack()
            code = self.refine(pivot, relative)
        return code

    def refine(self, pivot: PivotState, relative: float) -> int:
        """x <- x - A_FF^-1 w while that halves the residual; ROUNDS where it changes a sign."""
        previous = np.inf
        for _ in range(CORRECTIONS):
            if self.good() or not relative < 0.5 * previous:
                break
            previous = relative
            pivot.correct()
            self.work["refinements"] = self.work.get("refinements", 0) + 1
            if pivot.exchange():
                return ROUNDS
            relative = self.judge(pivot.impulse())
        return SOLVED

    def out_of_budget(self) -> Claim:
        if not self.best <= 1.0:
            self.judge(self.problem.start())
        return self.claim(Status.TIME_LIMIT if self.iterations < self.budget else Status.MAX_ITERATIONS)

    def indefinite(self, symmetric: bool = True) -> Claim:
        why = "A is indefinite" if symmetric else "A is not symmetric, and singular under every shift,"
        self.notes.append(f"{why} on the free rows: no solution by this method, see lemke")
        return self.claim(Status.NUMERICAL_ERROR)

    def note_singular(self, pivot: PivotState, shifted: bool) -> None:
        if self.problem.law == "linear":
            rank = pivot.rank()
            self.notes.append(f"A is singular, rank {rank} of {self.problem.m}")
            self.work["rank"] = rank
        else:
            self.notes.append("A is singular on the free rows" + ": shifted and refined" * shifted)

    @np.errstate(all="ignore")  # what overflows is judged
    def proximal(self, pivot: PivotState, stuck: bool) -> Claim:
        """Passes on A + s D around the last answer; where pivoting is stuck, descent along falling s."""
        problem, rows = self.problem, pivot.rows
        ended = self.rounded if problem.law == "linear" else self.good
        path = list(PATH if stuck else PATH[-1:])
        reference, waited = np.inf, 0
        rows.x[:] = self.impulse_now if self.floor <= RUNAWAY else self.impulse
        self.work["shifts"] = 0
        shift = 0.0
        for _ in range(PASSES):
            rows.recenter()
            if path:
                shift = path.pop(0)
                pivot.start(shift)
                self.work["shifts"] += 1
            rows.restart()
            code = self.descend(pivot) if stuck else self.rounds(pivot)
            if ended():
                break
            if code == ROUNDS:
                return self.out_of_budget()
            if code == STUCK and not pivot.symmetric:
                return self.circling()
            if code != SOLVED and not self.patient:
                break
            if code == STUCK:
                stuck, path = True, list(PATH)
                np.clip(rows.center, problem.cones.lower, problem.cones.upper, out=rows.x)
                continue
            if code in (SMALL, INDEFINITE):
                if shift >= PATH[0]:
                    linear = problem.law == "linear"
                    return self.general("A is indefinite") if linear else self.indefinite(pivot.symmetric)
                path = [shift * SHIFT_STEP]
                rows.x[:] = rows.center
                continue
            step = rows.x - rows.center
            self.settle(pivot)
            if ended():
                break
            if path or self.best <= 0.5 * reference:
                reference, waited = self.best, 0
                continue
            waited += 1
            proof = self.certificate(step)
            if proof is not None:
                return proof
            if waited >= PATIENCE or self.out_of_time:
                break
        if problem.law == "linear" and self.best > max(self.tol, 2.0 * self.floor) and not self.out_of_time:
            return self.general("A is indefinite")
        return self.verdict()

    def descend(self, pivot: PivotState) -> int:
        rows, c = pivot.rows, self.problem.cones
        np.clip(rows.x, c.lower, c.upper, out=rows.x)
        code, done = pivot.descend(self.budget - self.iterations, self.deadline)
        self.iterations += done
        if code in (SOLVED, ROUNDS):
            self.judge(pivot.impulse())
        return code

    def settle(self, pivot: PivotState) -> None:
        """Refine on the rows found, whatever signs rounding gives: more passes with the same factor."""
        rows, previous = pivot.rows, np.inf
        relative = self.last  # of this x
        for _ in range(CORRECTIONS):
            if self.good() or not relative < 0.5 * previous:
                break
            kept, previous = rows.x.copy(), relative
            rows.recenter()
            rows.slack()
            pivot.correct()
            self.work["refinements"] = self.work.get("refinements", 0) + 1
            relative = self.judge(pivot.impulse())
            if not relative < previous:
                rows.x[:] = kept

    def general(self, why: str) -> Claim:
        """A linear system by LU that tells the rank."""
        before = dict(self.work)
        before.pop("rank", None)  # not a count: the claim's is of a decomposition
        if self.state.pivot is not None:
            before.update(self.state.pivot.work)
        self.state = _general(self.problem, why)
        self.notes = [self.state.note]
        assert isinstance(self.state.general, GeneralFactor)
        claim = self.linear_general(self.state.general)
        work = {kind: before.get(kind, 0) + claim.work.get(kind, 0) for kind in {**claim.work, **before}}
        return replace(claim, work=work)

    def certificate(self, step: FloatArray) -> Claim | None:
        """INFEASIBLE where `step`, cut to the directions the bounds allow, proves it."""
        c = self.problem.cones
        y = np.where(np.isfinite(c.upper), np.minimum(step, 0.0), step)
        y = np.where(np.isfinite(c.lower), np.maximum(y, 0.0), y)
        size = np.abs(y).max(initial=0.0)
        if not 0.0 < size < np.inf:
            return None
        y = y / size
        y[np.abs(y) < 1e-13] = 0.0
        if check_certificate(self.problem, y) is not None:
            return None
        self.notes.append("no impulse meets every row: certificate found")
        return self.claim(Status.INFEASIBLE, certificate=y)


SPEC = SolverSpec(
    name="direct",
    factory=Direct,
    laws=frozenset({"linear", "lcp"}),
    boxes=frozenset({"coulomb", "cone"}),
    operators=frozenset({"matrix"}),
    exact=True,
    resumable=False,
    max_iter=1000,
    few=DIRECT,
    summary="factorisation; boxed LCP by block principal pivoting",
    reference="Golub, Van Loan 2013, chapter 4; Judice, Pires 1994, Computers and Operations Research 21",
)
