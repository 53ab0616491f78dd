"""Proximal splitting (ADMM) with a reused factor or none, and Anderson mixing, for redundant, ill-conditioned problems.

    z = Pi_K(u),  y = rho (u - z),  (B + rho) x = c - s + rho z - y,  u <- u + alpha (x - z), then mixed

in the metric of d: B = D^-1/2 A D^-1/2, c = D^-1/2 b, K the product of all bounds and cones, s De Saxce's shift of
Coulomb's law (`lavender_ext/accelerate/admm.pyx`), alpha the over-relaxation. An iteration is a forward and a backward
substitution instead of a sweep. Large mass ratios and long chains need more factorisations (rho is adapted, at
increasing intervals), but not more iterations. With Coulomb friction, the iteration runs without the shift until
contacts slip at the solution of the convex relaxation, unless the start is close to a solution with slip. A is
factored as L L^T in supernodes. If the bodies have fewer unknowns than there are rows, their matrix is factored
instead; if this takes too much work, it is solved by conjugate gradients without a factor. L U replaces L L^T if A is
not symmetric, or if the problem is linear and A is not definite.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import NEVER, UNLIMITED, Deadline, TooLate, limit_forming
from lavender.base.errors import BREAKDOWN, InputError
from lavender.base.lazy_import import import_numerical_modules
from lavender.base.lazy_import import sparse as sp
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.judge.solution import Claim, Status
from lavender.problem import Problem
from lavender.solvers._accelerated import MAX_MEMORY
from lavender.solvers.factors import (
    MAX_DENSE_RANK_ROWS,
    PIVOT_TOLERANCE,
    USE_WIDE_LANES,
    get_sorted_csr_arrays,
    make_pattern_symmetric,
)
from lavender.solvers.registry import Solver, SolverSpec
from lavender.solvers.sweeping import create_stopping_test, make_claim
from lavender_ext.accelerate import admm
from lavender_ext.factor.linear import BACKWARD_TOLERANCE, LinearSystem
from lavender_ext.newton.solve import Layout

_START_RHO = (
    0.1  # [-] First penalty rho, relative to the unit diagonal of B; found by measurements.
)
# The solver stops as STALLED after this many iterations without progress. At large mass ratios, the residual rises
# while rho is adapted.
_ADMM_PATIENCE = 5000
# Above this number of multiply-adds of a factor over bodies, per entry of K, conjugate gradients replace factors. Piles
# of spheres then take 0.7 times as long at 1,300 (7,143 rows), 0.5 at 3,400 and 0.3 at 8,000. Towers and walls have 7
# to 140, and take 2 to 7 times as long.
MAX_FACTOR_WORK_PER_ENTRY = 2000.0
_LATE_MESSAGE = "the time limit ended the factorisation, or came before it"


class _Breakdown(Exception):
    """A factorisation broke down; the message contains the reason."""


class _OutOfTime(Exception):
    """The deadline has passed."""


class AdmmState:
    """Scaled problem, factorisation for the current rho, and the vectors of the run; `open` builds them."""

    def __init__(self, problem: Problem, memory: int, relaxation: float) -> None:
        get_zero_impulse_reference(problem)
        self.problem, self.memory, self.relaxation = problem, memory, relaxation
        self.deadline = NEVER
        # Number of all factorisations, and number of those that earlier claims have reported.
        self.factorisations = self.reported = 0
        self.watch: Any = None
        self.factor: Any = None
        self.next_steps = [
            self._begin_run,
            self._scale_matrix,
            self._analyse_matrix,
            self.update_factor,
        ]
        # Attributes that do not depend on b: of the matrix, and of its factor for the first rho if that is kept.
        self.operator: dict[str, Any] = {}
        self.first: dict[str, Any] = {}

    def renew(self, problem: Problem) -> AdmmState:
        """Return the state for another b, with the scaled matrix and a kept factor of this state."""
        new = AdmmState(problem, self.memory, self.relaxation)
        if self.operator:
            new.operator, new.first = self.operator, self.first
            vars(new).update(self.operator | self.first)
            new.next_steps = [new._begin_run, *(() if self.first else (new.update_factor,))]
            # A claim counts the kept factor as its own, so that it does not depend on the call before.
            new.factorisations = int(bool(self.first) and new.has_factor)
        return new

    def scale_and_factor(self) -> None:
        """Scale, analyse and factor, unless that was done; raise `_OutOfTime` after the deadline."""
        while self.next_steps:
            if self.deadline.has_passed():
                raise _OutOfTime
            self.next_steps[0]()
            del self.next_steps[0]

    def _begin_run(self) -> None:
        """Build the stopping test and the splitting."""
        problem = self.problem
        with limit_forming(self.deadline) if self.deadline.is_set else UNLIMITED:
            self.data = problem.data
        self.watch = create_stopping_test(problem, problem.data, _ADMM_PATIENCE)
        self.splitting = admm.Splitting(self.data, self.memory, _START_RHO, self.relaxation)

    def _scale_matrix(self) -> None:
        """Build the scaled form of the problem."""
        problem = self.problem
        self.matrix: Any = None
        self.system: Any = None  # Linear system of the matrix.
        self.lu = self.full = False  # Whether the factor is L U, and whether its matrix is full.
        if _is_over_bodies(problem):
            form = problem.velocity_form()
            # `velocity_form` has scaled K and theta by the judge's d.
            self.is_over_bodies = True
            self.theta = form.theta
            self.jacobian = form.jacobian
            rows = problem.rows
            assert rows is not None
            # Work of one factorisation.
            self.body_work = float(Layout(rows.moving_block_bodies, rows.n_bodies, 6).work)
            self.body_solve = None
            self.has_factor = self.body_work <= MAX_FACTOR_WORK_PER_ENTRY * form.jacobian.nnz
            return
        a = problem.csr
        scale = 1.0 / np.sqrt(problem.d)
        values = np.repeat(scale, np.diff(a.indptr)) * a.data * scale[a.indices]
        self.matrix = sp.csr_array((values, a.indices, a.indptr), shape=a.shape)
        self.lu = not problem.is_symmetric
        self.is_over_bodies, self.has_factor = False, True
        if problem.m:
            self.matrix = make_pattern_symmetric(self.matrix)
            self.system = LinearSystem(get_sorted_csr_arrays(self.matrix)[:2], USE_WIDE_LANES)

    def _analyse_matrix(self) -> None:
        """Analyse the matrix, if there is one."""
        if not self.is_over_bodies and self.problem.m:
            _analyse_panels(self.system)
        names = ["matrix", "system", "lu", "full", "is_over_bodies", "has_factor"]
        names += ["theta", "jacobian", "body_work", "body_solve"] if self.is_over_bodies else []
        self.operator = {name: getattr(self, name) for name in names}

    @property
    def inner_iterations(self) -> int:
        """Number of iterations of conjugate gradients; 0 with factors."""
        return 0 if self.has_factor or self.body_solve is None else int(self.body_solve.iterations)

    @property
    def form_name(self) -> str:
        """Name of the system that is solved in each iteration."""
        if not self.has_factor:
            return "conjugate gradients over bodies"
        return "Cholesky over bodies" if self.is_over_bodies else "LU" if self.lu else "Cholesky"

    @property
    def best(self) -> tuple[float, FloatArray | None]:
        """(relative residual, impulse (m,) [N s]) of the best check."""
        return (np.inf, None) if self.watch is None else self.watch.best

    @property
    def sweeps_per_decade(self) -> float:
        """Number of iterations in which the residual falls tenfold; NaN if it does not fall."""
        return np.nan if self.watch is None else float(self.watch.sweeps_per_decade)

    def update_factor(self) -> None:
        """Set the factor, or conjugate gradients, for the present rho; raise `_OutOfTime` after the deadline."""
        if self.deadline.has_passed():
            raise _OutOfTime
        if self.first and self.system is self.first["system"] is not None:
            pattern = self.problem.m if self.full else get_sorted_csr_arrays(self.matrix)[:2]
            self.system = LinearSystem(
                pattern, USE_WIDE_LANES
            )  # The kept one has the factor for the first rho.
        self.factor = self._factor_with_fallbacks()
        self.factorisations += self.has_factor

    def _factor_with_fallbacks(self) -> tuple[Any, ...]:
        """Factor the matrix. If that breaks down, try L U, then L U of the full matrix, if these are allowed.

        Raise `_Breakdown` if no factorisation succeeds.
        """
        m, rho = self.problem.m, self.splitting.rho
        if m == 0:
            return ()
        system = self.system
        matrix = self.matrix
        shift = rho
        extra: tuple[Any, ...] = ()
        if self.is_over_bodies:
            k = self.jacobian
            e = 1.0 / (self.theta + rho)
            extra = (*get_sorted_csr_arrays(k), e)
            if not self.has_factor:
                self.body_solve = admm.BodySolve(*extra, k.shape[1], self.body_solve)
                return self.body_solve, *extra
            matrix = make_pattern_symmetric(sp.csr_array(k.T @ sp.diags_array(e) @ k))
            shift = 1.0
            # Analyse the pattern for each rho, because entries may cancel for some values of rho.
            system = LinearSystem(get_sorted_csr_arrays(matrix)[:2], USE_WIDE_LANES)
        done = _factor_shifted_matrix(system, matrix, shift, self.lu, self.deadline)
        if not done and not self.is_over_bodies and not self.lu and self.problem.law == "linear":
            # L L^T failed, as for an indefinite matrix: try L U.
            self.lu = True
            done = _factor_shifted_matrix(system, matrix, shift, True, self.deadline)
        if not done and self.lu and not self.full and m <= MAX_DENSE_RANK_ROWS:
            # L U by supernodes failed, since it cannot exchange rows across supernodes: try L U of a full matrix.
            self.full = True
            self.matrix = matrix = matrix.toarray()
            self.system = system = LinearSystem(m, USE_WIDE_LANES)
            done = _factor_shifted_matrix(system, matrix, shift, True, self.deadline)
        if not done:
            raise _Breakdown(f"the factor of A + rho D broke down at rho = {rho:.1e}")
        return system, *extra


def _is_over_bodies(problem: Problem) -> bool:
    rows = problem.rows
    return rows is not None and 0 < 6 * rows.n_bodies < problem.m


def _analyse_panels(system: LinearSystem) -> LinearSystem:
    try:
        system.analyse()
    except OverflowError as error:
        raise _Breakdown(str(error)) from None
    return system


def _factor_shifted_matrix(
    system: LinearSystem, matrix: Any, shift: float, lu: bool, deadline: Deadline
) -> bool:
    """Factor M = matrix + shift; return whether the factorisation succeeded. Raise `_OutOfTime` after the deadline.

    L U must also solve a test system with a backward error within `BACKWARD_TOLERANCE`:
    max |r - M x| <= BACKWARD_TOLERANCE (max |M_ij| max |x| + max |r|).
    """
    n = matrix.shape[0]
    # Copy a full matrix, because L U overwrites it.
    values = matrix.copy() if isinstance(matrix, np.ndarray) else get_sorted_csr_arrays(matrix)[2]
    largest = np.abs(values).max()
    if not np.isfinite(largest):
        return False
    lost = _analyse_panels(system).factor(
        values, None, shift, PIVOT_TOLERANCE, lu, deadline=deadline
    )
    if lost < 0:
        raise _OutOfTime
    if lost:
        return False
    if not lu:
        return True
    r = np.linspace(1.0, 2.0, n)
    x = system.solve(r)
    error = np.abs(r - matrix @ x - shift * x).max()
    return bool(error <= BACKWARD_TOLERANCE * ((largest + shift) * np.abs(x).max() + 2.0))


@dataclass(frozen=True)
class ADMM(Solver):
    """Proximal splitting with spectral penalty and Anderson mixing."""

    # Only a prepared state has a stopping test before the start is chosen.
    checks_start: ClassVar[bool] = False
    memory: int = 10
    relaxation: float = 1.6

    def __post_init__(self) -> None:
        if not isinstance(self.memory, int) or not 0 <= self.memory <= MAX_MEMORY:
            raise InputError(
                f"memory is {self.memory!r}; a whole number from 0 to {MAX_MEMORY} is needed"
            )
        if not 0.0 < self.relaxation < 2.0:
            raise InputError(
                f"relaxation is {self.relaxation!r}; a number between 0 and 2 is needed"
            )

    lazy_modules = ("scipy.sparse.linalg",)

    def prepare(self, problem: Problem) -> AdmmState:
        """Build the state. The problem is scaled, analysed and factored later, with the clock at hand."""
        import_numerical_modules()
        if not _is_over_bodies(problem):
            problem.check_matrix_fits()
        return AdmmState(problem, self.memory, self.relaxation)

    @np.errstate(all="ignore")  # Results that overflow are judged.
    def complete(self, state: AdmmState) -> None:
        """Scale and factor; matrix and factor stay while only b changes."""
        with suppress(_Breakdown):  # `run` repeats the set-up and reports the error.
            state.scale_and_factor()
            names = ("factor", "lu", "full", "matrix", "system")
            state.first = {name: getattr(state, name) for name in names}

    def update(self, state: AdmmState, problem: Problem) -> AdmmState:
        """Build the state for new numbers; matrix and factor stay if only b is new."""
        return (
            state.renew(problem)
            if problem.has_operator_of(state.problem)
            else self.prepare(problem)
        )

    @np.errstate(all="ignore")  # Results that overflow are judged.
    def set_deadline(self, state: AdmmState, deadline: Deadline) -> None:
        """Set the deadline, and do the set-up now, so that the time of an iteration is measured without it."""
        state.deadline = deadline
        with suppress(
            _OutOfTime, _Breakdown, *BREAKDOWN
        ):  # `run` repeats the set-up and reports the error.
            state.scale_and_factor()

    @np.errstate(all="ignore")  # Results that overflow are judged.
    def run(
        self,
        state: AdmmState,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None,
    ) -> Claim:
        """Run `max_iter` iterations, or fewer if a check, a breakdown or the deadline ends them."""
        try:
            state.scale_and_factor()
        except _Breakdown as failure:
            return Claim(Status.NUMERICAL_ERROR, 0, {}, str(failure))
        except (_OutOfTime, TooLate):
            return Claim(Status.TIME_LIMIT, 0, {}, _LATE_MESSAGE)
        splitting, inner = state.splitting, state.inner_iterations
        if state.watch.total == 0:
            splitting.start(impulse, state.problem.slack(impulse))
        undone = splitting.undone
        message = ""
        total = state.watch.total

        def iterate(count: int, first: bool) -> None:
            while count:
                rho = splitting.rho
                count -= splitting.run(impulse, count, state.factor)
                if splitting.rho != rho:
                    state.update_factor()

        try:
            result = make_claim(*state.watch.run_python(iterate, impulse, max_iter, tol))
        except _Breakdown as failure:
            result = Claim(Status.NUMERICAL_ERROR, state.watch.total)
            message = str(failure)
        except _OutOfTime:
            result = Claim(Status.TIME_LIMIT, state.watch.total - total)
            message = _LATE_MESSAGE
        work = {
            "solves": result.iterations,
            "factorisations": state.factorisations - state.reported,
            "undone": splitting.undone - undone,
        }
        if not state.has_factor:
            work["inner"] = state.inner_iterations - inner
        state.reported = state.factorisations
        return replace(result, work=work, form=state.form_name, message=message)


SPEC = SolverSpec(
    name="admm",
    factory=ADMM,
    laws=frozenset({"linear", "lcp", "coulomb", "cone"}),
    box_friction_laws=frozenset({"coulomb", "cone"}),
    round_cones=True,
    supports_rolling=True,
    max_iter=2000,
    options={
        "memory": "number of iterations that Anderson mixing combines, from 0 (no mixing) to 16; default 10",
        "relaxation": "over-relaxation parameter alpha, between 0 and 2; default 1.6",
    },
    summary="proximal splitting (ADMM) with one factorisation and Anderson mixing",
    reference="Boyd et al. 2011; Carpentier, Le Lidec, Montaut 2024 (contact); Acary et al. 2011 (De Saxce shift)",
)
