"""Factor and solve; with bounds, block principal pivoting on the same factorisation.

    linear   A lambda = b by band, dense or sparse factorisation, then lambda <- lambda - A^-1 w (refinement)
    boxed    w = A lambda - b complementary to lower <= lambda <= upper: guess the set of free rows (all rows of a
             narrow band, otherwise those that a few sweeps leave free), solve for them, exchange the rows of the
             wrong sign, repeat (`lavender_ext/pivot/principal.pyx`)
    singular the same on A + s D, s = 1e-10, around the last solution c: (A + s D) lambda = b + s D c. A fixed
             point solves A itself (proximal point method). Once the set of free rows no longer changes, each pass is
             one step of refinement: it multiplies the error along an eigenvector of eigenvalue sigma by
             s / (s + sigma). On a problem without a solution the passes diverge along some y >= 0 with A y = 0,
             b.y > 0, which is the certificate.

All of this runs in `lavender_ext/pivot/direct.pyx`.

Positive definite A: finite and exact to rounding, for any `tol`. Singular positive semidefinite A: the message says so;
if refinement does not reach rounding, the status is STALLED, with the best iterate. Linear systems that are asymmetric
or indefinite are factored by LU with pivoting; if that is singular, an SVD gives the rank. Bounded rows with an
asymmetric A are exchanged with LU: finite unless the exchanges cycle, which no decreasing energy excludes. Box friction
becomes such rows (`polyhedral.py`); if its exchanges cycle, complementary pivots follow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Deadline
from lavender.judge.certificates import MAX_POLISHED_SLACK, check_certificate
from lavender.judge.residuals import MAX_EXCUSED_RESIDUAL, judge_impulse, store_result
from lavender.judge.solution import Claim, Status, summed
from lavender.problem import Problem
from lavender.solvers.factors import SMALL_SIZE, GeneralFactor, PanelsLU
from lavender.solvers.pivoting import PivotState
from lavender.solvers.registry import Solver, SolverSpec
from lavender.solvers.setup_times import factored, over_rows
from lavender.solvers.small import DIRECT
from lavender_ext.judge import measure
from lavender_ext.pivot.direct import CIRCLES, PASSED, SPENT
from lavender_ext.pivot.principal import INDEFINITE, SMALL, SOLVED, STUCK

GOOD = 1e-13  # relative residual at which refinement ends, where the floor allows it
BATCH = 32  # rounds between two checks of the clock and the residual
OVER = (SOLVED, INDEFINITE, SPENT, CIRCLES)  # turns of the kernel that are the last


@dataclass
class DirectState:
    """Factor of a linear system, or the rows of a boxed one; for one solve, which `run` continues."""

    problem: Problem
    pivot: PivotState | None = None
    general: GeneralFactor | PanelsLU | None = None
    begun: int = 0  # factorisations before `general` that came to nothing
    is_running: bool = False
    note: str = ""


@dataclass(frozen=True)
class Direct(Solver):
    """Direct solution of linear systems and of boxed LCPs, positive semidefinite or asymmetric."""

    patience: ClassVar[bool] = True  # to go on where pivoting on one shift is stuck
    exact: ClassVar[bool] = True  # to rounding, whatever the tolerance

    def fallback(self) -> Solver:
        """What follows where exchanges go round in circles on friction as bounded rows: one pivot after the other."""
        from lavender.solvers.lemke import Lemke

        return Lemke()

    needs_scipy = True

    def setup_time(self, problem: Problem) -> float:
        """What `prepare` takes [s], as counted."""
        return factored(problem) if problem.law == "linear" else over_rows(problem)

    def prepare(self, problem: Problem, like: PivotState | None = None) -> DirectState:
        linear = problem.law == "linear"
        if linear and not problem.is_symmetric and problem.m > SMALL_SIZE:
            return _unsymmetric(problem)
        state = DirectState(problem, PivotState(problem, like))
        if linear and state.pivot is not None:
            outcome = state.pivot.rows.factor_all()
            if outcome == INDEFINITE:
                return _general(problem, "A is indefinite")
            if not problem.is_symmetric:
                state.note = "A is not symmetric"
                if outcome != SOLVED:
                    return _general(problem, state.note)
        return state

    def update(self, state: DirectState, problem: Problem) -> DirectState:
        return self.prepare(problem, state.pivot)

    def run(
        self,
        state: DirectState,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None = None,
    ) -> Claim:
        run = _Run(state, impulse, max_iter, tol, Deadline(time_limit), self)
        if state.problem.m == 0:
            return run.claim(Status.CONVERGED)
        if max_iter == 0:
            return run.claim(Status.MAX_ITERATIONS)
        try:
            if state.general is not None:
                return run.linear_general(state.general)
            assert state.pivot is not None
            return run.pivoting(state.pivot)
        finally:
            run.put_best()


@dataclass(frozen=True)
class Enough(Direct):
    """For calls by `auto` with free rows only: a solution that meets the tolerance is not refined."""

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
    """One solve: the best judged iterate so far, and the work done."""

    def __init__(
        self,
        state: DirectState,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        deadline: Deadline,
        solver: Direct,
    ) -> None:
        self.patient = solver.patience
        # Relative residual that is good whatever the floor.
        self.least = GOOD if solver.exact else max(GOOD, tol)
        self.state, self.problem, self.impulse = state, state.problem, impulse
        self.max_iter, self.tol = max_iter, tol
        self.deadline = deadline
        self.kept: measure.Judged | None = None
        self.late = False  # no round was begun, as it would have ended after the deadline
        self.iterations = 0
        self.work: dict[str, int] = {}
        self.told: dict[str, int] = {}  # what the rows did in the runs before
        self.notes = [state.note] if state.note else []

    # -- judging ---------------------------------------------------------------------------------

    def judge(self, x: FloatArray) -> float:
        """Relative residual of x, which must not change any more; the best becomes the result."""
        found = judge_impulse(self.problem, x)
        self.keep(found)
        relative: float = found.relative
        return relative

    def keep(self, found: measure.Judged | None) -> None:
        if found is not None and found.relative < self.best:
            self.kept = found

    @property
    def best(self) -> float:
        """Relative residual of the best iterate."""
        return np.inf if self.kept is None else self.kept.relative

    @property
    def floor(self) -> float:
        return 0.0 if self.kept is None else self.kept.roundoff_floor

    def put_best(self) -> None:
        pivot = self.state.pivot
        if pivot is not None and pivot.rows.relative < self.best:
            self.keep(pivot.rows.best)  # an error, or Ctrl-C, ended it between two rounds
        if self.kept is not None:
            self.impulse[:] = self.kept.impulse
            store_result(self.problem, self.kept)

    def good(self) -> bool:
        return self.best <= max(self.least, min(self.floor, MAX_EXCUSED_RESIDUAL))

    def at_floor(self) -> bool:
        return self.kept is not None and self.kept.above_floor <= self.tol

    @property
    def out_of_time(self) -> bool:
        pivot = self.state.pivot
        return self.late or (pivot is not None and pivot.rows.late) or self.deadline.passed()

    @property
    def pivoted(self) -> dict[str, int]:
        """What the rows did in this run."""
        work = {} if self.state.pivot is None else self.state.pivot.rows.work
        return {kind: n - self.told.get(kind, 0) for kind, n in work.items() if n > self.told.get(kind, 0)}

    def claim(self, status: Status, **more: Any) -> Claim:
        state = self.state
        work, form = self.work | self.pivoted, "LU" if state.pivot is None else state.pivot.form
        return Claim(status, self.iterations, work, "; ".join(self.notes), form=form, **more)

    def verdict(self) -> Claim:
        """What the best iterate deserves, when nothing is left to do."""
        if self.best <= self.tol:
            return self.claim(Status.CONVERGED)
        if self.at_floor():
            return self.claim(Status.ROUNDOFF_LIMIT)
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
        x = np.zeros(problem.m)
        if singular:
            x = self.impulse if self.kept is None else self.kept.impulse
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
            rounded = self.good() or self.at_floor()
            if not rounded and not self.out_of_time:
                return self.general(f"{self.notes[0]}; LU by panels did not refine")
        elif not self.good() and singular:
            # What least squares in the metric of D leaves of b is orthogonal to the range of A.
            measure.slack(problem.csr_data, x, w)
            proof = self.certificate(-w / problem.csr_data.d) or self.certificate(factor.outside(problem.b))
            if proof is not None:
                return proof
        return self.verdict()

    def general(self, why: str) -> Claim:
        """A linear system by LU that tells the rank."""
        before = self.work | self.pivoted
        before.pop("rank", None)  # not a count: the claim's is of a decomposition
        self.state = _general(self.problem, why)
        self.notes = [self.state.note]
        assert isinstance(self.state.general, GeneralFactor)
        claim = self.linear_general(self.state.general)
        return replace(claim, work=summed((claim.work, before)))

    # -- symmetric A, and bounded rows -------------------------------------------------------------

    @np.errstate(all="ignore")  # what overflows is judged
    def pivoting(self, pivot: PivotState) -> Claim:
        """Turns of the kernel, on from where the last run of this state has stopped."""
        rows, before = pivot.rows, pivot.rows.n_rounds
        pivot.set_deadline(self.deadline)
        late = False
        if self.state.is_running:
            self.told = rows.work
        else:
            late = pivot.too_late_to_sweep(self.deadline)
            rows.begin(self.impulse, self.least, 0 if late else pivot.sweeps)
            self.state.is_running = True
        while True:
            most = 0 if late else min(BATCH, self.max_iter - self.iterations)
            code, self.late = pivot.advance(self.deadline, most)
            self.iterations = rows.n_rounds - before
            if code == SMALL and rows.passes == 0:
                self.note_singular(pivot, self.patient or pivot.symmetric)
            proof = self.certificate(rows.changed) if code in (PASSED, SPENT) else None
            if proof is not None:
                return proof
            if code in OVER or self.gives_up(code, rows.passes > 0 or not pivot.symmetric):
                self.keep(rows.best)
                return self.end(pivot, code)
            if self.iterations >= self.max_iter or self.out_of_time:
                self.keep(rows.best)
                return self.out_of_budget()

    def gives_up(self, code: int, is_shifted: bool) -> bool:
        return not self.patient and (code == STUCK or (code == SMALL and is_shifted))

    def end(self, pivot: PivotState, code: int) -> Claim:
        """What the rows deserve after the last turn."""
        if code == CIRCLES:
            return self.circling()
        if self.problem.law != "linear":
            return self.indefinite(pivot.symmetric) if code == INDEFINITE else self.verdict()
        met = self.best <= self.tol or self.at_floor() or self.out_of_time
        if code == SOLVED or (code == SPENT and pivot.symmetric and met):
            return self.verdict()
        return self.general("A is indefinite" if pivot.symmetric else "A is not symmetric")

    def circling(self) -> Claim:
        self.notes.append(
            "exchanges go round in circles, and A is not symmetric: no energy to descend on; see lemke"
        )
        if not self.best <= 1.0:
            self.judge(self.problem.start())
        return self.verdict()

    def out_of_budget(self) -> Claim:
        if not self.best <= 1.0:
            self.judge(self.problem.start())
        return self.claim(Status.TIME_LIMIT if self.iterations < self.max_iter else Status.MAX_ITERATIONS)

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
        length = np.sqrt(self.problem.d)
        pull = self.problem.csr @ y if self.problem.is_symmetric else np.zeros(1)
        if np.any(np.sign(y) * pull > MAX_POLISHED_SLACK * (length @ np.abs(y)) * length):
            return None  # an impulse without an end meets b.y there, beyond what a solver rounds
        if check_certificate(self.problem, y, self.tol, self.deadline) is not None:
            return None
        self.notes.append("no impulse meets every row: certificate found")
        return self.claim(Status.INFEASIBLE, certificate=y)


SPEC = SolverSpec(
    name="direct",
    factory=Direct,
    laws=frozenset({"linear", "lcp"}),
    box_friction_laws=frozenset({"coulomb", "cone"}),
    operators=frozenset({"matrix"}),
    exact=True,
    resumable=False,
    max_iter=1000,
    small=DIRECT,
    summary="factorisation; boxed LCP by block principal pivoting",
    reference="Golub, Van Loan 2013, chapter 4; Judice, Pires 1994, Computers and Operations Research 21",
)
