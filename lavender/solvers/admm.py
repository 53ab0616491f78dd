"""Proximal splitting (ADMM) with factorisation reused and Anderson mixing: for redundant, ill-conditioned problems.

    z = Pi_K(u),  y = rho (u - z),  (B + rho) x = c - s + rho z - y,  u <- u + alpha (x - z), then mixed

in the metric of d: B = D^-1/2 A D^-1/2, c = D^-1/2 b, K the bounds and cones of all blocks at once, s De
Saxce's shift of Coulomb's law (`lavender_ext/accelerate/admm.pyx`). An iteration is one triangular solve instead of
a sweep. So large mass ratios and long chains need more factorisations (rho is adapted, ever more rarely), not more
iterations. Coulomb friction starts from the solution of the convex relaxation.
The factorisation is L L^T by panels of A, or of the body form if that has fewer unknowns than rows; L U by panels if A
is not symmetric, or belongs to a linear system and is not definite.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Deadline, Stopwatch, TooLate
from lavender.base.errors import BREAKDOWN, InputError
from lavender.base.lazy_import import import_numerics
from lavender.base.lazy_import import sparse as sp
from lavender.judge.residuals import get_reference
from lavender.judge.solution import Claim, Status
from lavender.problem import Problem
from lavender.solvers._accelerated import LARGEST_MEMORY
from lavender.solvers.factors import GENERAL_LIMIT, PANELS_WORK, TINY, Panels, mirrored, rows_of
from lavender.solvers.newton_systems.sparse import BACKWARD
from lavender.solvers.registry import Solver, SolverSpec
from lavender.solvers.setup_times import (
    ANALYSED,
    CALLS,
    DENSE,
    EACH,
    LAID_OUT,
    SCIPY,
    START,
    WHOLE,
    analysed,
    compared,
    dense_work,
    forming,
    loading,
)
from lavender.solvers.sweeping import claim, watch_over
from lavender_ext.accelerate import admm
from lavender_ext.factor.sparse import SparsePanels
from lavender_ext.newton.coupled import scaled_entries
from lavender_ext.newton.solve import Layout

_PANELS, _BODIES = 1, 2  # as the kernel names them
_START_RHO = 0.1  # B has unit diagonal, so 1 is its scale; measured
_PATIENCE = 5000  # iterations: on mass ratios the residual rises while rho finds its place


_LATE = "the next factorisation, or the analysis before it, would end after the time limit"
AT_ONCE = 5e-3  # s, that scaling may be expected to take for `prepare` to do it
_SCALED = 1e-8  # s for each entry of A
_JACOBIAN, _NORMAL = 24, 18  # entries: two for each of a row over bodies; of J^T J for each velocity
# s for each multiply-add of a factor by panels, and of L U in one panel.
_PANELS_WORK, _ONE_PANEL = 1e-9 * PANELS_WORK, 4e-10


class _Failed(Exception):
    """A factorisation broke down; the text says how."""


class AdmmState:
    """Scaled problem, factorisation for the current rho, and the vectors of the run, which `open` makes."""

    def __init__(self, problem: Problem, memory: int, relaxation: float) -> None:
        get_reference(problem)
        self.problem, self.memory, self.relaxation = problem, memory, relaxation
        self.deadline = Deadline()  # nothing is begun that is expected to end later
        self.factorisations = self.reported = 0  # factors: all, and those that an earlier run has told
        self.watch: Any = None
        self.factor: Any = None
        self.is_scaled = self.is_analysed = False
        self.seconds = _scaling(problem)  # of what comes next: scaling, analysis, then each factor
        if self.seconds <= AT_ONCE:
            self._scale()

    def open(self) -> None:
        """Scale, analyse and factor; what is expected to end after the deadline is not begun."""
        if not self.is_scaled:
            self._ask()
            self._scale()
        if not self.is_analysed:
            self._ask()
            self.seconds = self._expected()
            self.is_analysed = True
        if self.factor is None:
            self.factor = self._factor()

    def _ask(self) -> None:
        if self.deadline.passed(self.seconds):
            raise TooLate

    def _scale(self) -> None:
        problem = self.problem
        self.data = problem.data
        self.watch = watch_over(problem, problem.data, _PATIENCE)
        self.splitting = admm.Splitting(self.data, self.memory, _START_RHO, self.relaxation)
        self.matrix: Any = None
        self.panels: Any = None  # analysed, of the matrix
        self.lu = self.full = False  # L U, and of a matrix with an entry everywhere
        if _is_over_bodies(problem):
            form = problem.velocity_form()
            # In the metric of D = diag d of the judge, which is the scale of the form.
            self.kind, self.theta, self.jacobian = _BODIES, form.theta, form.jacobian
            self.is_scaled, self.seconds = True, 0.0  # no matrix to analyse before the first factor
            return
        a = problem.csr
        values = scaled_entries(a.indptr, a.indices, a.data, 1.0 / np.sqrt(problem.d))
        self.matrix = sp.csr_array((values, a.indices, a.indptr), shape=a.shape)
        self.lu = not problem.is_symmetric
        self.kind = _PANELS
        if problem.m:
            self.matrix = mirrored(self.matrix)
            self.panels = Panels(*rows_of(self.matrix)[:2])
        self.is_scaled, self.seconds = True, analysed(problem) if problem.m else 0.0

    def _expected(self) -> float:
        # What the first factor takes, from structure; the next ones take as long as it did.
        problem = self.problem
        if self.kind == _BODIES:
            assert problem.rows is not None
            rows, n = problem.rows, 6 * problem.rows.n_bodies
            made = CALLS + LAID_OUT * _JACOBIAN * problem.m + ANALYSED * _NORMAL * n
            return float(made + EACH * n + _PANELS_WORK * Layout(rows.block_bodies, rows.n_bodies, 6).work)
        return EACH * problem.m + _PANELS_WORK * _analysed(self.panels, self.lu).work if problem.m else 0.0

    @property
    def best(self) -> tuple[float, FloatArray | None]:
        """(relative residual, impulse) of the best check."""
        return (np.inf, None) if self.watch is None else self.watch.best

    @property
    def sweeps_per_decade(self) -> float:
        """Iterations in which the residual falls tenfold; NaN where it does not."""
        return np.nan if self.watch is None else float(self.watch.sweeps_per_decade)

    def _factor(self) -> tuple[int, int, tuple[Any, ...]]:
        self._ask()
        watch = Stopwatch()
        made = self._make_factor()
        self.factorisations += 1
        self.seconds = watch.seconds
        return made

    def _make_factor(self) -> tuple[int, int, tuple[Any, ...]]:
        m, rho = self.problem.m, self.splitting.rho
        if m == 0:
            return self.kind, 0, ()
        panels, matrix, shift = self.panels, self.matrix, rho
        extra: tuple[Any, ...] = ()
        if self.kind == _BODIES:
            k = self.jacobian
            e = 1.0 / (self.theta + rho)
            matrix, shift = mirrored(sp.csr_array(k.T @ sp.diags_array(e) @ k)), 1.0
            # Analysed each time: an entry may cancel at one rho and not at another, or alone of a pair.
            panels = Panels(*rows_of(matrix)[:2])
            extra = (*rows_of(k), e)
        done = _factored(panels, matrix, shift, self.lu)
        if not done and self.kind == _PANELS and not self.lu and self.problem.law == "linear":
            # A linear system need not be definite, which L L^T is for.
            self.lu = True
            done = _factored(panels, matrix, shift, True)
        if not done and self.lu and not self.full and m <= GENERAL_LIMIT:
            # It needs pivots across panels: of a full matrix there is one panel.
            if self.deadline.passed(_ONE_PANEL * dense_work(m)):
                raise TooLate
            self.full = True
            self.matrix = matrix = _full(matrix)
            self.panels = panels = Panels(*rows_of(matrix)[:2])
            done = _factored(panels, matrix, shift, True)
        if not done:
            raise _Failed(f"the factor of A + rho D broke down at rho = {rho:.1e}")
        return self.kind, matrix.shape[0], (_analysed(panels, self.lu), *extra)


def _is_over_bodies(problem: Problem) -> bool:
    rows = problem.rows
    return rows is not None and 0 < 6 * rows.n_bodies < problem.m


def _scaling(problem: Problem) -> float:
    """What scaling is expected to take [s]."""
    if _is_over_bodies(problem):
        return 3.0 * CALLS + LAID_OUT * _JACOBIAN * problem.m  # J, the root of M^-1, and their product
    entries, formed = problem.max_entries, forming(problem)
    if problem.generalized is not None and entries == float(problem.m) ** 2:  # one product of dense matrices
        formed = min(formed, START + WHOLE * entries + DENSE * float(problem.metric.products_of_a))
    return START + formed + compared(problem) + _SCALED * entries


def _analysed(panels: Panels, lu: bool) -> SparsePanels:
    try:
        return panels.analysed(lu)
    except OverflowError as error:
        raise _Failed(str(error)) from None


def _factored(panels: Panels, matrix: sp.csr_array, shift: float, lu: bool) -> bool:
    # Whether M = matrix + shift has its factor; of L U also whether what it solves is exact:
    # max |r - M x| <= BACKWARD (max |M_ij| max |x| + max |r|).
    values, n = rows_of(matrix)[2], matrix.shape[0]
    made = _analysed(panels, lu)
    if not np.isfinite(values).all() or made.factor(values, np.ones(n), shift, TINY):
        return False
    if not lu:
        return True
    r = np.linspace(1.0, 2.0, n)
    x = made.solve(r)
    left = np.abs(r - matrix @ x - shift * x).max()
    return bool(left <= BACKWARD * ((np.abs(values).max() + shift) * np.abs(x).max() + 2.0))


def _full(matrix: sp.csr_array) -> sp.csr_array:
    # The same with an entry everywhere.
    n = matrix.shape[0]
    indptr, indices = np.arange(n + 1, dtype=np.int32) * n, np.tile(np.arange(n, dtype=np.int32), n)
    return sp.csr_array((matrix.toarray().ravel(), indices, indptr), shape=matrix.shape)


@dataclass(frozen=True)
class ADMM(Solver):
    """Proximal splitting with spectral penalty and Anderson mixing."""

    memory: int = 10
    relaxation: float = 1.6

    def __post_init__(self) -> None:
        if not isinstance(self.memory, int) or not 0 <= self.memory <= LARGEST_MEMORY:
            raise InputError(
                f"memory is {self.memory!r}; a whole number from 0 to {LARGEST_MEMORY} is needed"
            )
        if not 0.0 < self.relaxation < 2.0:
            raise InputError(f"relaxation is {self.relaxation!r}; a number between 0 and 2 is needed")

    needs_scipy = True

    def setup_time(self, problem: Problem) -> float:
        """What `prepare` takes [s], as counted; what it leaves is begun behind it if it fits there."""
        scaling = _scaling(problem)
        return (scaling if scaling <= AT_ONCE else 0.0) + loading(*SCIPY)

    def prepare(self, problem: Problem) -> AdmmState:
        """Scale, where that takes little."""
        import_numerics()
        return AdmmState(problem, self.memory, self.relaxation)

    @np.errstate(all="ignore")  # what overflows is judged
    def set_deadline(self, state: AdmmState, deadline: Deadline) -> None:
        """Let nothing begin that is expected to end after `deadline`; what ends before it is set up here."""
        state.deadline = deadline
        with suppress(TooLate, _Failed, *BREAKDOWN):  # which `run` meets again, and tells
            state.open()

    @np.errstate(all="ignore")  # what overflows is judged
    def run(
        self,
        state: AdmmState,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None = None,
    ) -> Claim:
        """n iterations, or fewer where a check ends them."""
        try:
            state.open()
        except _Failed as failure:
            return Claim(Status.NUMERICAL_ERROR, 0, {}, str(failure))
        except TooLate:
            return Claim(Status.TIME_LIMIT, 0, {}, _LATE)
        splitting = state.splitting
        if state.watch.total == 0:
            # y of the start: minus its slack, shifted; at a solution the first iteration stays there.
            splitting.start(impulse, state.problem.slack(impulse))
        undone, message, total = splitting.undone, "", state.watch.total

        def iterate(count: int, first: bool) -> None:
            while count:
                rho = splitting.rho
                count -= splitting.run(impulse, count, state.factor)
                if splitting.rho != rho:
                    state.factor = state._factor()

        try:
            result = claim(*state.watch.run_python(iterate, impulse, max_iter, tol))
        except _Failed as failure:
            result, message = Claim(Status.NUMERICAL_ERROR, state.watch.total), str(failure)
        except TooLate:
            result, message = Claim(Status.TIME_LIMIT, state.watch.total - total), _LATE
        work = {
            "solves": result.iterations,
            "factorisations": state.factorisations - state.reported,
            "undone": splitting.undone - undone,
        }
        state.reported = state.factorisations
        form = "Cholesky over bodies" if state.kind == _BODIES else "LU" if state.lu else "Cholesky"
        return replace(result, work=work, form=form, message=message)


SPEC = SolverSpec(
    name="admm",
    factory=ADMM,
    laws=frozenset({"linear", "lcp", "coulomb", "cone"}),
    box_friction_laws=frozenset({"coulomb", "cone"}),
    round_cones=True,
    supports_rolling=True,
    max_iter=2000,
    options={
        "memory": "iterations that Anderson mixing combines, 0 (none) to 16; default 10",
        "relaxation": "alpha between 0 and 2; default 1.6",
    },
    summary="proximal splitting, factorisation reused, Anderson-mixed",
    reference="Boyd et al. 2011; Carpentier, Le Lidec, Montaut 2024 (contact); Acary et al. 2011 (De Saxce shift)",
)
