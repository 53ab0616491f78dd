"""Factor and solve; with bounds, block principal pivoting on the same factorisation.

    linear   A lambda = b by band, dense or sparse factorisation, then lambda <- lambda - A^-1 w (refinement)
    boxed    w = A lambda - b complementary to lower <= lambda <= upper: guess the set of free rows (all rows if A has
             a narrow band, otherwise the rows that are free after a few sweeps), solve for them, exchange the rows
             with the wrong sign, repeat (`lavender_ext/pivot/principal.pyx`)
    singular the boxed method on A + s D with s = 1e-10, around the last solution c: (A + s D) lambda = b + s D c. A
             fixed point solves the problem with A (proximal point method). Once the set of free rows no longer
             changes, each pass is one step of refinement: it multiplies the error along an eigenvector of eigenvalue
             sigma by s / (s + sigma). If the problem has no solution, the passes diverge along some y >= 0 with A y =
             0 and b.y > 0, which is the certificate.

All of this runs in `lavender_ext/pivot/direct.pyx`.

For a positive definite A, the method is finite and exact to rounding, for any `tol`. A singular positive semidefinite
A is reported in the message; if refinement does not reach rounding, the status is STALLED, with the best iterate.
Linear systems that are asymmetric or indefinite are factored by LU with pivoting; if that is singular, an SVD gives
the rank. For bounded rows with an asymmetric A, exchanges use LU. They may cycle, because no energy decreases. Box
friction is converted to such rows (`polyhedral.py`); if the exchanges cycle, Lemke's method follows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Deadline
from lavender.judge.certificates import MAX_POLISHED_SLACK as CERTIFICATE_TOLERANCE
from lavender.judge.certificates import check_certificate
from lavender.judge.residuals import MAX_EXCUSED_RESIDUAL, judge_impulse
from lavender.judge.solution import Claim, Status, sum_work_counts
from lavender.problem import Problem
from lavender.solvers.costs import (
    RATES,
    estimate_factorisation_count,
    estimate_first_factor_cost,
    estimate_matrix_setup_cost,
)
from lavender.solvers.factors import MAX_COMPILED_FACTOR_ROWS, PanelsLU, RankRevealingFactor
from lavender.solvers.pivoting import PivotState
from lavender.solvers.registry import Solver, SolverSpec
from lavender.solvers.small import DIRECT
from lavender_ext.judge import measure
from lavender_ext.pivot.direct import CYCLING, PASS_ENDED, PASSES_USED
from lavender_ext.pivot.principal import INDEFINITE, SMALL_PIVOT, SOLVED, STUCK

# Refinement ends at this relative residual, or at the round-off floor if that is larger.
REFINEMENT_RESIDUAL = 1e-13
ROUNDS_PER_CHECK = (
    32  # Number of rounds of exchanges between two checks of the clock and the residual.
)


@dataclass
class DirectState:
    """State of one solve, which `run` continues."""

    problem: Problem
    pivot: PivotState | None = None  # State of the exchanges, for a boxed or symmetric problem.
    # Factor of an asymmetric or indefinite linear system.
    general: RankRevealingFactor | PanelsLU | None = None
    failed_factorisations: int = 0  # Number of factorisations that failed before `general`.
    is_running: bool = False  # Whether `run` was called.
    note: str = ""  # Part of the message.


@dataclass(frozen=True)
class Direct(Solver):
    """Direct solution of linear systems and of boxed LCPs, positive semidefinite or asymmetric."""

    # Whether the solver continues with another shift if pivoting makes no progress.
    patience: ClassVar[bool] = True
    exact: ClassVar[bool] = True  # Whether the solver solves to rounding, whatever the tolerance.

    def fallback(self) -> Solver:
        """Return Lemke's method, which continues if exchanges cycle on friction written as bounded rows."""
        from lavender.solvers.lemke import Lemke

        return Lemke()

    lazy_modules = ("scipy.sparse.linalg",)

    def estimate_setup_cost(self, problem: Problem) -> float:
        """Estimate the cost of `prepare` [ns], which includes the factor of a linear problem."""
        is_linear = problem.law == "linear"
        factor = estimate_first_factor_cost(problem.m, problem.max_entries) if is_linear else 0.0
        return estimate_matrix_setup_cost(problem) + factor

    def estimate_total_cost(self, problem: Problem) -> float:
        """Estimate the cost of exchanges [ns] by (3) of `costs.py`."""
        m = float(problem.m)
        work = m * (1.0 + problem.max_bandwidth) ** 2
        if (
            work < m**3 and not problem.is_symmetric
        ):  # The check of symmetry reads all entries, so it comes last.
            work = m**3
        return estimate_factorisation_count(problem) * (
            RATES["pivot row"] * m + RATES["pivot work"] * work
        )

    def prepare(self, problem: Problem, like: PivotState | None = None) -> DirectState:
        linear = problem.law == "linear"
        if linear and not problem.is_symmetric and problem.m > MAX_COMPILED_FACTOR_ROWS:
            return _factor_asymmetric(problem)
        state = DirectState(problem, PivotState(problem, like))
        if linear and state.pivot is not None:
            outcome = state.pivot.rows.factor_all()
            if outcome == INDEFINITE:
                return _factor_by_rank_revealing_lu(problem, "A is indefinite")
            if not problem.is_symmetric:
                state.note = "A is not symmetric"
                if outcome != SOLVED:
                    return _factor_by_rank_revealing_lu(problem, state.note)
        return state

    def update(self, state: DirectState, problem: Problem) -> DirectState:
        return self.prepare(problem, state.pivot)

    def run(
        self,
        state: DirectState,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None,
    ) -> Claim:
        run = _Run(state, impulse, max_iter, tol, Deadline(time_limit), self)
        if state.problem.m == 0:
            return run.make_claim(Status.CONVERGED)
        if max_iter == 0:
            return run.make_claim(Status.MAX_ITERATIONS)
        try:
            if state.general is not None:
                claim = run.solve_linear_with_lu(state.general)
            else:
                assert state.pivot is not None
                claim = run.run_pivoting_rounds(state.pivot)
        finally:
            pivot = run.state.pivot
            if pivot is not None and pivot.rows.relative < run.best:
                # If an error or Ctrl-C ended the run between two rounds, the kernel's best iterate was not stored yet.
                run.store_if_best(pivot.rows.best)
            if run.best_pass is not None:
                impulse[:] = run.best_pass.impulse
        return replace(claim, judged=run.best_pass)


@dataclass(frozen=True)
class SufficientDirect(Direct):
    """Direct solver for `auto`. If all rows are free, it does not refine a solution that meets the tolerance."""

    exact: ClassVar[bool] = False


@np.errstate(all="ignore")  # Results that overflow are judged.
def _factor_asymmetric(problem: Problem) -> DirectState:
    """Factor an asymmetric A by panels if it is sparse and that succeeds, else by LU with pivoting."""
    why = "A is not symmetric"
    if not PanelsLU.accepts(problem):
        return _factor_by_rank_revealing_lu(problem, why)
    factor = PanelsLU(problem)
    if factor.usable:
        return DirectState(problem, general=factor, note=why)
    state = _factor_by_rank_revealing_lu(problem, f"{why}; LU by panels lost a pivot")
    return replace(state, failed_factorisations=1)


@np.errstate(all="ignore")  # Results that overflow are judged.
def _factor_by_rank_revealing_lu(problem: Problem, why: str) -> DirectState:
    """Factor A by a rank-revealing LU factorisation; `why` begins the message."""
    factor = RankRevealingFactor(problem)
    if not factor.usable:
        why += "; LU is singular and A too large for a decomposition that reveals its rank"
    elif factor.rank < problem.m:
        why += f"; A is singular, rank {factor.rank} of {problem.m}"
    return DirectState(problem, general=factor, note=why)


class _Run:
    """State of one call of `run`: the best judged iterate so far, and the work done."""

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
        # The solver stops at a relative residual up to this value, whatever the round-off floor is.
        self.sufficient_residual = (
            REFINEMENT_RESIDUAL if solver.exact else max(REFINEMENT_RESIDUAL, tol)
        )
        self.state = state
        self.problem = state.problem
        self.impulse = impulse
        self.max_iter, self.tol, self.deadline = max_iter, tol, deadline
        self.best_pass: measure.Judged | None = None
        self.iterations = 0
        self.work: dict[str, int] = {}
        self.reported: dict[str, int] = {}  # Work that earlier runs of this state have reported.
        self.notes = [state.note] if state.note else []

    # -- judging ---------------------------------------------------------------------------------

    def judge_iterate(self, x: FloatArray) -> float:
        """Return the relative residual of x (m,), which must not change afterwards; keep the best x as the result."""
        result = judge_impulse(self.problem, x)
        self.store_if_best(result)
        return float(result.relative)

    def judge_start_unless_better(self) -> None:
        """Judge the zero impulse if no iterate is better."""
        if not self.best <= 1.0:
            self.judge_iterate(self.problem.start())

    def store_if_best(self, result: measure.Judged | None) -> None:
        """Store a judged iterate if it has the smallest residual so far."""
        if result is not None and result.relative < self.best:
            self.best_pass = result

    @property
    def best(self) -> float:
        """Relative residual of the best iterate."""
        return np.inf if self.best_pass is None else self.best_pass.relative

    def is_good(self) -> bool:
        """Return whether the best residual is sufficient or at the round-off floor."""
        floor = 0.0 if self.best_pass is None else self.best_pass.roundoff_floor
        return self.best <= max(self.sufficient_residual, min(floor, MAX_EXCUSED_RESIDUAL))

    def is_at_floor(self) -> bool:
        return self.best_pass is not None and self.best_pass.above_floor <= self.tol

    @property
    def out_of_time(self) -> bool:
        pivot = self.state.pivot
        return (pivot is not None and pivot.rows.late) or self.deadline.has_passed()

    @property
    def pivot_work(self) -> dict[str, int]:
        """Work of exchanges in this run."""
        work = {} if self.state.pivot is None else self.state.pivot.rows.work
        new = {kind: n - self.reported.get(kind, 0) for kind, n in work.items()}
        return {kind: n for kind, n in new.items() if n > 0}

    def make_claim(self, status: Status, **more: Any) -> Claim:
        """Return a claim with this status, the work and the notes."""
        state = self.state
        work = self.work | self.pivot_work
        form = "LU" if state.pivot is None else state.pivot.form
        return Claim(status, self.iterations, work, "; ".join(self.notes), form=form, **more)

    def make_claim_for_best_iterate(self) -> Claim:
        """Return the claim for the best iterate when no step remains."""
        if self.best <= self.tol:
            return self.make_claim(Status.CONVERGED)
        if self.is_at_floor():
            return self.make_claim(Status.ROUNDOFF_LIMIT)
        return self.make_claim(Status.STALLED)

    # -- linear systems that are not symmetric definite -------------------------------------------

    @np.errstate(all="ignore")  # Results that overflow are judged.
    def solve_linear_with_lu(self, factor: RankRevealingFactor | PanelsLU) -> Claim:
        """Solve and refine a linear system with an LU factor; search for a certificate if A is singular."""
        problem = self.problem
        self.iterations = 1
        self.work = {"factorisations": 1 + self.state.failed_factorisations}
        if not factor.usable:
            return self.make_claim(Status.NUMERICAL_ERROR)
        singular = factor.rank < problem.m
        x = np.zeros(problem.m)
        if singular:
            x = self.impulse if self.best_pass is None else self.best_pass.impulse
        w = np.empty(problem.m)
        previous = np.inf
        for k in range(8):
            measure.compute_slack(problem.csr_data, x, w)
            x = x - factor.solve(w)
            relative = self.judge_iterate(x)
            self.work["refinements"] = k
            if self.is_good() or not relative < 0.5 * previous:
                break
            previous = relative
        if isinstance(factor, PanelsLU):
            rounded = self.is_good() or self.is_at_floor()
            if not rounded and not self.out_of_time:
                return self.solve_with_rank_revealing_lu(
                    f"{self.notes[0]}; LU by panels did not refine"
                )
        elif not self.is_good() and singular:
            # Try the residual of least squares in the metric of D, which is orthogonal to the range of A.
            measure.compute_slack(problem.csr_data, x, w)
            for direction in (-w / problem.csr_data.d, factor.compute_left_null_part(problem.b)):
                proof = self.make_infeasibility_claim(direction)
                if proof is not None:
                    return proof
        return self.make_claim_for_best_iterate()

    def solve_with_rank_revealing_lu(self, why: str) -> Claim:
        """Solve a linear system again by a rank-revealing LU factorisation; `why` begins the message."""
        before = self.work | self.pivot_work
        before.pop(
            "rank", None
        )  # The rank cannot be added to another; the new factorisation computes it.
        self.state = _factor_by_rank_revealing_lu(self.problem, why)
        self.notes = [self.state.note]
        assert isinstance(self.state.general, RankRevealingFactor)
        claim = self.solve_linear_with_lu(self.state.general)
        return replace(claim, work=sum_work_counts((claim.work, before)))

    # -- symmetric A, and bounded rows -------------------------------------------------------------

    @np.errstate(all="ignore")  # Results that overflow are judged.
    def run_pivoting_rounds(self, pivot: PivotState) -> Claim:
        """Run rounds of the kernel, continuing where the last run of this state stopped."""
        rows = pivot.rows
        before = pivot.rows.n_rounds
        pivot.set_deadline(self.deadline)
        if self.state.is_running:
            self.reported = rows.work
        else:
            rows.set_start(self.impulse, self.sufficient_residual, pivot.sweeps)
            self.state.is_running = True
        while True:
            code = rows.advance(min(ROUNDS_PER_CHECK, self.max_iter - self.iterations))
            self.iterations = rows.n_rounds - before
            if code == SMALL_PIVOT and rows.passes == 0:
                self.add_singularity_note(pivot, self.patient or pivot.symmetric)
            proof = (
                self.make_infeasibility_claim(rows.changed)
                if code in (PASS_ENDED, PASSES_USED)
                else None
            )
            if proof is not None:
                return proof
            is_shifted = rows.passes > 0 or not pivot.symmetric
            is_stuck = code == STUCK or (code == SMALL_PIVOT and is_shifted)
            if rows.is_over or (is_stuck and not self.patient):
                self.store_if_best(rows.best)
                return self.make_claim_of_final_code(pivot, code)
            if self.iterations >= self.max_iter or self.out_of_time:
                self.store_if_best(rows.best)
                self.judge_start_unless_better()
                is_late = self.iterations < self.max_iter
                return self.make_claim(Status.TIME_LIMIT if is_late else Status.MAX_ITERATIONS)

    def make_claim_of_final_code(self, pivot: PivotState, code: int) -> Claim:
        """Return the claim after the final code of the kernel."""
        if code == CYCLING:
            self.notes.append(
                "the exchanges cycle, and A is not symmetric: no energy decreases; see lemke"
            )
            self.judge_start_unless_better()
        elif self.problem.law != "linear":
            if code == INDEFINITE:
                why = (
                    "A is indefinite"
                    if pivot.symmetric
                    else "A is not symmetric, and singular under every shift,"
                )
                self.notes.append(f"{why} on the free rows: no solution by this method, see lemke")
                return self.make_claim(Status.NUMERICAL_ERROR)
        elif code != SOLVED:
            met = self.best <= self.tol or self.is_at_floor() or self.out_of_time
            if not (code == PASSES_USED and pivot.symmetric and met):
                return self.solve_with_rank_revealing_lu(
                    "A is indefinite" if pivot.symmetric else "A is not symmetric"
                )
        return self.make_claim_for_best_iterate()

    def add_singularity_note(self, pivot: PivotState, shifted: bool) -> None:
        """Add a note that A is singular, with its rank for linear systems."""
        if self.problem.law == "linear":
            rank = pivot.rank()
            self.notes.append(f"A is singular, rank {rank} of {self.problem.m}")
            self.work["rank"] = rank
        else:
            self.notes.append("A is singular on the free rows" + ": shifted and refined" * shifted)

    def make_infeasibility_claim(self, step: FloatArray) -> Claim | None:
        """Return an INFEASIBLE claim if `step` (m,), restricted to the directions that the bounds allow, proves it."""
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
        if np.any(np.sign(y) * pull > CERTIFICATE_TOLERANCE * (length @ np.abs(y)) * length):
            return None  # w.y = 0 is reached by a large impulse along y, so y proves nothing.
        if check_certificate(self.problem, y, self.tol, self.deadline) is not None:
            return None
        self.notes.append("no impulse meets every row: certificate found")
        return self.make_claim(Status.INFEASIBLE, certificate=y)


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
