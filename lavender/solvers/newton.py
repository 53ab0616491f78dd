"""Second-order solver for every law: active sets, interior points, proximal damped Newton.

    z = D^1/2 lambda,   H = D^-1/2 A D^-1/2,   s = H z - g complementary to z on every block

0. A warm start over bodies is judged first. If it does not meet tol, up to 64 sweeps (counted in `work`) continue from
   it, or one banded factorisation if all rows belong to joints (`lavender_ext/newton/warm_start.pxd`). It suffices for
   most steps of a simulation at rest and for chains of joints. Otherwise 1 to 4 continue from the original start.
1. Bounded rows: active-set exchanges (Newton's method on the natural map) from the warm start and from the solution of
   H z = g.
2. Bounded rows and cones: a cold-started Mehrotra interior point. When the active rows are identified, the solution on
   them is computed to the round-off limit of float64.
3. If rows are nearly dependent and 1 and 2 fail: an interior point on the augmented system of the bodies, then
   proximal damped Newton.
4. Coulomb friction: proximal damped Newton on the Alart-Curnier map, and interior points on De Saxce's form of the
   law, in which the convex problem changes with every step. If these stall near a solution, or if few contacts slide at
   the solution of the convex law, proximal points of this form follow from there (`lavender_ext/newton/flow.pxd`).
   Otherwise, or if they stall too, a path of smoothed problems (Chen, Mangasarian 1996) is followed, each step by the
   coordinate that changes fastest (Rheinboldt 1986), through folds at which contacts change from stick to slip.
   Proximal points from the best point follow if that fails, too.

Problems in generalised coordinates are first solved over their velocities (`newton_systems/general.py`), without
forming A. Unless rows far outnumber velocities, this kernel runs method 4 over a dense A under Coulomb's law, and
methods 1 and 2 if bounded rows with a compliance below 0.005 d have two bounds. A sparse A is formed if its factor is
estimated to cost less, or a tenth if the law is not Coulomb's. Methods 1 to 4 over the rows of A are also used if they
are estimated to cost less than a tenth (few rows of a soft body), and afterwards if the method over velocities fails,
unless form="velocity". If the velocities belong to free rigid bodies and every block couples at most two of these,
methods 1 to 4 run over the bodies and not over A; under Coulomb's law, and if many contacts are rigid, they then
replace the method over velocities (`SmallCall.cost_limit`).

Methods 1 to 4 are compiled and run one factorisation at a time; `lavender_ext/newton/plan.pxd` has the table of their
states. Between factorisations, Python checks the clock, Ctrl-C and certificates. `newton_systems/` builds the linear
systems. The form "velocity" factors I + K^T V K over the bodies and does not square J; "impulse" factors over the
rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_choice
from lavender.base.deadline import UNLIMITED, Deadline, TooLate, limit_forming
from lavender.base.errors import CapabilityError, InputError
from lavender.judge.residuals import get_zero_impulse_reference, judge_impulse
from lavender.judge.solution import Claim, Status, format_work_count, sum_work_counts
from lavender.problem import OPERATORS, Problem
from lavender.problem.derived import cached_property
from lavender.solvers.costs import (
    Count,
    count_dense_work,
    estimate_analysis_cost,
    estimate_elimination_cost,
    estimate_factorisation_count,
    estimate_formation_cost,
    estimate_matrix_setup_cost,
    estimate_newton_cost,
)
from lavender.solvers.newton_systems import general
from lavender.solvers.newton_systems.systems import (
    System,
    find_bodies,
    make_system,
    run_newton_method,
)
from lavender.solvers.registry import Solver, SolverSpec
from lavender.solvers.small import NEWTON, estimate_velocity_newton_cost
from lavender_ext.core.method import OUTCOMES
from lavender_ext.newton.solve import COUNTED, uses_dense_rows
from lavender_ext.newton.warm_start import JUDGED, SOLVED, SWEPT, UNDECIDED, solve_from_guess

FORMS = ("auto", "velocity", "impulse")
# The row form is used if the velocity form is estimated to cost more than this multiple of the row form.
VELOCITY_MAX_COST_RATIO = 10.0
# If the velocity form fails, A is formed and the row form continues if A has up to this many rows.
MAX_FORMED_ROWS = 3000
SPARSE_WORK_RATIO = (
    4.0  # Time of a multiply-add of a sparse factor as a multiple of one of a dense factor.
)
INTERRUPT_CHECK_INTERVAL = 0.05  # Longest estimated time [s] between two checks for Ctrl-C.
#: Message for each code of the first phase; None if it did not solve the problem.
WARM_START_MESSAGES = {
    UNDECIDED: None,
    JUDGED: "",
    SWEPT: "warm sweeps",
    SOLVED: "joints solved directly",
}
# The row form starts from the result of the velocity form if its relative residual does not exceed this,
# otherwise from the default start.
WARM_START_MAX_RESIDUAL = 1e-3


@dataclass
class NewtonState:
    """The linear system of a problem, built once."""

    problem: Problem
    system: (
        System | None
    )  # None if no body in a row can move, or for the driver in generalised coordinates.
    general: Any = None  # Driver in generalised coordinates, or None.
    begun: bool = False  # Whether `advance` has been called, so that the next call continues.

    @property
    def kernel(self) -> Any:
        """The compiled method; None if nothing can move."""
        return self.general if self.system is None else self.system.solve

    @cached_property
    def count(self) -> Count:
        """Operation counts of one step over rows or bodies, from the analysis of the matrix."""
        problem, system = self.problem, self.system
        if system is None:
            return Count("dense", 0.0, 0.0, float(problem.m))
        if system.form == "velocity":
            return Count("bodies", system.work, float(problem.metric.work), float(problem.m))
        set_up = 0.0 if problem.generalized is None else estimate_formation_cost(problem, False)
        kind = "dense" if system.dense else "panels"
        return Count(kind, system.work, system.entries, float(problem.m), set_up)

    @property
    def steps(self) -> float:
        """Expected number of iterations; over velocities, an iteration is a step of one island."""
        islands = 1 if self.general is None else max(1, self.general.islands)
        return estimate_factorisation_count(self.problem) * islands

    @cached_property
    def cost(self) -> float:
        """Estimated cost of all iterations [ns]."""
        if self.general is not None:
            return estimate_velocity_newton_cost(self.problem, self.general.work)
        return estimate_newton_cost(self.count, self.problem)


@dataclass(frozen=True)
class Newton(Solver):
    """Interior point and semismooth Newton.

    Parameters
    ----------
    form : {"auto", "velocity", "impulse"}
        Unknowns of the factorisation: velocities (needs J and M) or the rows of A. "auto": velocities if the problem
        has J and M or bodies, unless the rows of A are estimated to cost less than a tenth.
    """

    form: str = "auto"

    lazy_modules = ("scipy.sparse.linalg",)

    def estimate_setup_cost(self, problem: Problem) -> float:
        """Estimate the cost of `prepare` with the form "auto" [ns]."""
        if problem.generalized is not None:
            rows = 0.0
            entries = float(problem.metric.entries_of_matrix)
            if problem.law == "coulomb" and not uses_dense_rows(entries, float(problem.m), False):
                rows = estimate_matrix_setup_cost(problem) + estimate_analysis_cost(problem)
            return rows + estimate_elimination_cost(problem, "velocity elimination")
        if problem.rows is not None and problem.rows.n_bodies > 0:
            return estimate_elimination_cost(problem, "body elimination")
        is_sparse = not uses_dense_rows(problem.max_entries, problem.m, problem.law == "cone")
        return estimate_matrix_setup_cost(problem) + (
            estimate_analysis_cost(problem) if is_sparse else 0.0
        )

    def estimate_total_cost(self, problem: Problem) -> float:
        """Return a lower bound of the cost of all steps with the form "auto" [ns] (`NewtonState.cost`)."""
        if problem.generalized is not None:
            return estimate_velocity_newton_cost(problem, 0.0)
        count = Count("bodies", 0.0, float(problem.metric.work), float(problem.m))
        return estimate_newton_cost(count, problem)

    def prepare(self, problem: Problem) -> NewtonState:
        """Build the linear system of a problem, or the driver over its velocities."""
        return self._choose_form_and_build_state(problem, None)

    def _choose_form_and_build_state(self, problem: Problem, like: System | None) -> NewtonState:
        """Choose the form and build the state; the layout of the system `like` may be reused."""
        if self.form not in FORMS:
            check_choice("form", self.form, FORMS)
        if self.form == "velocity" and problem.matrix is not None:
            raise InputError(
                "form='velocity' needs J and M, and this problem was given as a matrix A"
            )
        if not len(problem.b):
            return NewtonState(problem, None)
        bodies = kernel = None
        over_velocities = problem.generalized is not None and self.form != "impulse"
        if over_velocities:
            max_cost = inf
            m = float(problem.m)
            if self.form == "auto" and m <= MAX_FORMED_ROWS and not problem.cones.has_round:
                # Compare with the method over a full A.
                count = Count(
                    "dense",
                    count_dense_work(problem.m),
                    m * m,
                    m,
                    estimate_formation_cost(problem, False),
                )
                max_cost = VELOCITY_MAX_COST_RATIO * estimate_newton_cost(count, problem)
            fixed = estimate_velocity_newton_cost(problem, 0.0)
            slope = estimate_velocity_newton_cost(problem, 1.0) - fixed
            kernel = general.prepare_islands(problem, (max_cost - fixed) / slope)
            if (
                kernel is not None
                and self.form == "auto"
                and _is_sparse_matrix_faster(problem, kernel.work)
            ):
                kernel = None
        if self.form != "impulse" and (kernel is None or NEWTON.cost_limit(problem, kernel) == 0.0):
            bodies = find_bodies(
                problem
            )  # Interior points over bodies are faster here than the driver.
        if bodies is None and kernel is not None:
            return NewtonState(problem, None, kernel)
        if bodies is None and over_velocities and self.form == "velocity":
            raise CapabilityError(
                f"form='velocity' needs more than {general.MAX_MATRIX_ENTRIES:.1e} values for the matrix over the "
                "velocities of an island: give form='impulse', or use a sweep solver"
            )
        if problem.cones._blocks.has_round:
            raise CapabilityError(
                "round cones of more than two tangents need form='velocity', and more than "
                f"{general.MAX_MATRIX_ENTRIES:.1e} values for the matrix of an island: use fewer tangents"
            )
        form = "impulse" if bodies is None else "velocity"
        system = make_system(problem, form, like, bodies)
        return NewtonState(problem, system if system.solve.m else None)

    def complete(self, state: NewtonState) -> None:
        """Form a dense H of A or of J and M; it stays while only b changes."""
        kernel = state.kernel
        if kernel is not None:
            kernel.keep_matrix()
            kernel.start(state.problem._start, 0.0, 1)

    def update(self, state: NewtonState, problem: Problem) -> NewtonState:
        """Build the state for new numbers: with the system if only b is new, with the order of the same bodies."""
        kernel = state.kernel
        if kernel is not None and problem.has_operator_of(state.problem):
            get_zero_impulse_reference(problem)
            kernel.keep_matrix()
            kernel.use_rhs(problem.metric)
            return NewtonState(problem, state.system, state.general)
        return self._choose_form_and_build_state(problem, state.system)

    def run(
        self,
        state: NewtonState,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None,
    ) -> Claim:
        problem, system = state.problem, state.system
        if not len(problem.b):
            return Claim(Status.CONVERGED, 0)
        if system is not None and system.dense:
            return self._run_system(problem, system, impulse, max_iter, tol, Deadline(time_limit))
        with np.errstate(all="ignore"):  # Results that overflow are judged.
            if state.general is not None:
                return self._run_over_velocities(
                    state, impulse, max_iter, tol, Deadline(time_limit)
                )
            return self._run_system(problem, system, impulse, max_iter, tol, Deadline(time_limit))

    @np.errstate(all="ignore")  # Results that overflow are judged.
    def advance(
        self,
        state: NewtonState,
        impulse: FloatArray,
        n: int,
        tol: float,
        time_limit: float | None = None,
        remaining: int | None = None,
    ) -> Claim:
        """Run about n steps, at most `remaining`, continuing the last call. The first call starts at `impulse` (m,).

        In generalised coordinates, only the method over velocities runs, without a continuation over rows.
        """
        is_continued = state.begun
        state.begun = True
        deadline = Deadline(time_limit)
        if state.general is None:
            most = min(remaining or SPEC.max_iter, SPEC.max_iter)
            return self._run_system(
                state.problem, state.system, impulse, n, tol, deadline, is_continued, most
            )
        claim = general.run_newton_steps(
            state.problem, state.general, impulse, n, tol, deadline, is_continued
        )
        if claim.status is Status.MAX_ITERATIONS and state.general.how != OUTCOMES["more"]:
            return Claim(Status.STALLED, claim.iterations, claim.work)
        return claim

    def prepare_continuation(self, state: NewtonState) -> NewtonState | None:
        """Build the state over bodies or over the rows of A that continues the method over velocities.

        Return None if `form` is "velocity", or if A has more than `MAX_FORMED_ROWS` rows or round cones.
        """
        problem = state.problem
        bodies = find_bodies(problem)
        if bodies is None and (
            self.form == "velocity" or problem.m > MAX_FORMED_ROWS or problem.cones.has_round
        ):
            return None
        system = make_system(problem, "impulse" if bodies is None else "velocity", bodies=bodies)
        return NewtonState(problem, system if system.solve.m else None)

    def _run_over_velocities(
        self, state: NewtonState, impulse: FloatArray, max_iter: int, tol: float, deadline: Deadline
    ) -> Claim:
        """Solve over generalised velocities; if that fails, continue over bodies or over the rows of A.

        The row form runs only if iterations remain and A has at most `MAX_FORMED_ROWS` rows. `impulse` (m,) [N s]
        holds the better of the two results on return.
        """
        problem = state.problem
        claim = general.run_newton_steps(problem, state.general, impulse, max_iter, tol, deadline)
        remaining = max_iter - claim.iterations
        if (
            claim.status not in (Status.STALLED, Status.NUMERICAL_ERROR, Status.DIVERGED)
            or remaining <= 0
        ):
            return claim
        try:
            with limit_forming(deadline) if deadline.is_set else UNLIMITED:
                continuation = self.prepare_continuation(state)
        except TooLate:
            return replace(claim, status=Status.TIME_LIMIT)
        if continuation is None:
            return claim
        first = judge_impulse(problem, impulse.copy())
        if first.above_floor <= tol:
            return claim
        if not first.relative <= WARM_START_MAX_RESIDUAL:
            impulse[:] = problem.start()
        second = self._run_system(problem, continuation.system, impulse, remaining, tol, deadline)
        if not judge_impulse(problem, impulse).relative <= first.relative:
            impulse[:] = first.impulse
        work = sum_work_counts((claim.work, second.work))
        form = f"{claim.form}, then {second.form or 'impulse'}"
        total = claim.iterations + second.iterations
        return Claim(
            second.status, total, work, second.message, form=form, certificate=second.certificate
        )

    def _run_system(
        self,
        problem: Problem,
        system: System | None,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        deadline: Deadline,
        is_continued: bool = False,
        max_total: int | None = None,
    ) -> Claim:
        """Run the method over bodies or rows (`run_newton_method`). Over bodies, a warm start is tried first."""
        if system is None:
            system = make_system(problem, "impulse")
            system.solve.start(impulse, tol, 1)
            impulse[:] = system.solve.view_arrays().fixed
            return Claim(Status.STALLED, 0, {"factorisations": 0}, "no row can move")
        sweeps = warm_factorisations = 0
        over_bodies = (
            self.form == "auto" and problem.rows is not None and problem.friction == "coulomb"
        )
        if over_bodies and not is_continued and tol > 0.0 and max_iter > 0:
            counts = solve_from_guess(problem.data, impulse, tol, deadline)
            _, sweeps, warm_factorisations = counts
            claim = make_warm_start_claim(*counts)
            if claim is not None:
                judged = judge_impulse(problem, impulse.copy())
                if judged.relative <= tol:
                    return replace(claim, judged=judged)
        solve = system.solve
        steps = max(1, int(INTERRUPT_CHECK_INTERVAL / max(system.factor_seconds, 1e-6)))
        run = run_newton_method(
            problem,
            solve,
            impulse,
            max_iter - warm_factorisations,
            tol,
            deadline,
            steps,
            max_total,
            is_continued,
        )
        factorisations = warm_factorisations + run.counts[0]
        counted = zip(solve.counts, COUNTED, strict=True)
        message = ", ".join([format_work_count(n, kind) for n, kind in counted if n])
        work = {"factorisations": factorisations} | ({"sweeps": sweeps} if sweeps else {})
        return Claim(
            run.status, factorisations, work, message, form=system.form, certificate=run.certificate
        )


def make_warm_start_claim(code: int, sweeps: int, factorisations: int) -> Claim | None:
    """Return the claim for the code and counts of the first phase; None if the phase decided nothing."""
    message = WARM_START_MESSAGES[code]
    if message is None:
        return None
    work = {"factorisations": factorisations} | ({"sweeps": sweeps} if sweeps else {})
    form = "impulse" if code == SOLVED else "velocity"
    return Claim(Status.CONVERGED, factorisations, work, message, form=form)


def _is_sparse_matrix_faster(problem: Problem, work: float) -> bool:
    """Return whether Newton's method over a sparse A of J and M takes less time than over velocities.

    Over velocities a factor takes `work` multiply-adds, and over A without fill entries^2 / (3 m), each
    `SPARSE_WORK_RATIO` times as long. Under Coulomb's law, a solve over rows takes a third to a tenth of the steps.
    Under the other laws, the estimate must be a tenth.
    """
    entries = float(problem.metric.entries_of_matrix)
    m = float(problem.m)
    if problem.cones.has_round or uses_dense_rows(entries, m, problem.law == "cone"):
        return False
    ratio = 1.0 if problem.law == "coulomb" else VELOCITY_MAX_COST_RATIO
    return ratio * SPARSE_WORK_RATIO * entries**2 / (3.0 * m) <= work


def _get_refusal_reason(problem: Problem) -> str | None:
    """Return a reason not to accept round cones without J and M, else None."""
    if problem.cones._blocks.has_round and problem.generalized is None:
        return (
            "takes round cones of more than two tangents with J and M alone (Problem.from_jacobian)"
        )
    return None


SPEC = SolverSpec(
    name="newton",
    factory=Newton,
    laws=frozenset({"linear", "lcp", "coulomb", "cone"}),
    box_friction_laws=frozenset({"coulomb", "cone"}),
    operators=frozenset(OPERATORS),
    round_cones=True,
    supports_rolling=True,
    refusal=_get_refusal_reason,
    small=NEWTON,
    resumable=False,
    max_iter=2500,
    options={
        "form": "unknowns: 'velocity' (of bodies), 'impulse' (of rows) or 'auto' (the default)"
    },
    summary="interior point, active-set polish and proximal semismooth Newton",
    reference="Mehrotra 1992; Nesterov, Todd 1997; Hintermueller, Ito, Kunisch 2002; Alart, Curnier 1991; "
    "De Saxce, Feng 1998",
)
