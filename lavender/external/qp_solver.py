"""Run a QP backend as a solver: write the problem as a program in the form that suits the backend, and run it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_bool
from lavender.base.deadline import Deadline
from lavender.base.errors import CapabilityError, InputError
from lavender.base.lazy_import import import_numerical_modules
from lavender.external.backend import Backend
from lavender.external.convex import ConvexProgram
from lavender.external.forms import Form, build_form, choose_program_form, get_program
from lavender.external.isolated import run_isolated, start_process
from lavender.external.running import BackendResult, call_backend_until_accepted
from lavender.judge.certificates import check_certificate
from lavender.judge.residuals import judge_impulse
from lavender.judge.solution import Claim, Status, sum_work_counts
from lavender.problem import Problem
from lavender.problem.program import QuadraticProgram
from lavender.solvers.registry import Solver

MAX_DENSE_SIZE = (
    2**30
)  # [bytes] A backend for dense matrices rejects a problem with a larger matrix.
# [-] A claim "solved" is false if the error exceeds this multiple of tol, and at least MIN_FALSE_CLAIM: the tests of
# backends use other norms.
FALSE_CLAIM_RATIO, MIN_FALSE_CLAIM = 1e3, 1e-6
MAX_STEPS = 3  # Newton steps with updated active rows; further steps follow only while the error exceeds tol.
STEP_ERROR = 1e-12  # A point of a program with a larger error is improved by a Newton step.
MAX_STEP_SIZE = 20_000  # No Newton step is done with more variables and active rows.
# [s] With less time left, steps of more equations than MAX_SHORT_STEP_SIZE are not done: 300 take 2 ms, 1000 take 50.
LONG_STEP_TIME, MAX_SHORT_STEP_SIZE = 0.05, 300
# With more variables and rows, the Newton step is done only if the error exceeds tol.
MAX_FREE_STEP_SIZE = 500
# Components of a program that misses tol are solved alone unless there are more of them.
MAX_SINGLE_COMPONENTS = 50
OPTION_HELP = {
    "isolate": "run the backend in another process, which the call leaves at the time limit: True always, False never, "
    "None (default) under a limit if the backend has none of its own",
    "form": "'program' (P, q and rows of from_qp), 'impulse', 'velocity' (bodies, J and M) or 'auto' (default)",
    "settings": "mapping of options of the backend, which override the options that are set from tol",
}


def get_false_claim_error(tol: float) -> float:
    """Return the error above which a claim "solved" at tol is false."""
    return max(FALSE_CLAIM_RATIO * tol, MIN_FALSE_CLAIM)


class ProgramJudge:
    """Judges points of a quadratic program, improves them by a Newton step, and keeps the best.

    Attributes
    ----------
    x, lam : (n,), (m,)
        The best point, with complementary multipliers; None without a point.
    error, strict_error, hidden_error : float
        Its errors by `judge_program`; the strict one compares rows and columns with their right-hand
        side and q alone, the hidden one is that of rows with a right-hand side that is rounding or 0.
    """

    def __init__(self, program: ConvexProgram, tol: float, deadline: Deadline) -> None:
        self.program, self.tol, self.deadline = program, tol, deadline
        self.error = self.strict_error = self.hidden_error = np.inf
        self.x: FloatArray | None = None
        self.lam: FloatArray | None = None
        self.has_step = False

    def accepts(self, x: FloatArray, lam: FloatArray, is_last: bool = True) -> bool:
        """Judge a point and its Newton steps; return whether the best point meets tol.

        Steps of degenerate vertices are done only if `is_last`: they seldom succeed where a second call would not.
        """
        _, active, complementary = self.keep(x, lam)
        size = len(x) + len(lam)
        if self.strict_error > (
            STEP_ERROR if size <= MAX_FREE_STEP_SIZE else max(self.tol, STEP_ERROR)
        ):
            first = self._polish(x, lam, self.program.compare_multipliers_with_slacks(x, lam))
            near = None
            if not is_last:
                return self.error <= self.tol
            if (
                self.error > self.tol
            ):  # Rows of almost no slack may be active with a multiplier of 0.
                near = self._take_step(x, lam, self.program.find_near_rows(x))
            if near is not None:
                for multipliers in (near[1], complementary, lam if first is None else first[1]):
                    self.keep(near[0], multipliers, True)
                if self.error > self.tol and not self.deadline.has_passed():
                    fitted = self.program.fit_multipliers(
                        near[0], self.program.find_near_rows(near[0])
                    )
                    if fitted is not None:
                        self.keep(near[0], fitted, True)
            if self.error > self.tol:
                self._polish(x, complementary, active)
        return self.error <= self.tol

    def _take_step(
        self, x: FloatArray, lam: FloatArray, active: Any
    ) -> tuple[FloatArray, FloatArray] | None:
        """Return the Newton step of a point; None if it is not possible, or too long before the deadline."""
        left = self.deadline.get_remaining_seconds() if self.deadline.is_set else LONG_STEP_TIME
        max_size = (
            MAX_STEP_SIZE if left >= LONG_STEP_TIME else MAX_SHORT_STEP_SIZE if left > 0.0 else 0
        )
        return self.program.polish(x, lam, active, max_size) if max_size else None

    def _polish(
        self, x: FloatArray, lam: FloatArray, active: Any
    ) -> tuple[FloatArray, FloatArray] | None:
        """Judge the Newton steps from a point with these active rows (m,); return the first one."""
        first = None
        for _ in range(MAX_STEPS):
            point = self._take_step(x, lam, active)
            if point is None:
                break
            first = first or point
            error, _, lam = self.keep(*point, True)
            # Steps from a point without a right digit lead nowhere.
            if self.error <= self.tol or not error <= 1.0:
                break
            x = point[0]
            active = self.program.update_active_rows(*point, active, self.tol)
        return first

    def keep(
        self, x: FloatArray, lam: FloatArray, has_step: bool = False
    ) -> tuple[float, Any, FloatArray]:
        """Judge a point, clipped to the bounds of the variables, and store it if it is the best."""
        x = self.program.clip_to_bounds(x)
        error, strict_error, _, _, active, complementary, hidden = self.program.judge(x, lam)
        if error > self.tol and np.isfinite(x).all():
            for near in self.program.list_rounded_points(x):
                judged = self.program.judge(near, lam)
                if judged[0] < error:
                    x = near
                    error, strict_error, _, _, active, complementary, hidden = judged
        if error < self.error or self.x is None:
            self.x, self.lam, self.has_step = x, complementary, has_step
            self.error, self.strict_error, self.hidden_error = error, strict_error, hidden
        return error, active, complementary


class ContactJudge:
    """Judges points of a form of a constraint problem by the residual of its impulses, and keeps the best impulses.

    Parameters
    ----------
    form : Form
    impulse : (m,), N s
        Receives the best impulses.
    tol : float, -

    Attributes
    ----------
    relative, above : float, -
        Relative residual of the best impulses, and its part above rounding; inf without a point.
    """

    def __init__(self, form: Form, impulse: FloatArray, tol: float) -> None:
        self.form, self.impulse, self.tol = form, impulse, tol
        self.relative = self.above = np.inf
        self.dual: FloatArray | None = None

    def accepts(self, x: FloatArray, lam: FloatArray, is_last: bool = True) -> bool:
        """Judge a point, and its Newton step if the point does not meet tol; return whether the best point does."""
        self._keep(x, lam)
        program = self.form.program
        if self.above > self.tol and not program.cones:
            active, complementary = program.judge(x, lam)[4:6]
            point = program.polish(x, complementary, active, MAX_STEP_SIZE)
            if point is not None:
                self._keep(*point)
        return self.above <= self.tol

    def _keep(self, x: FloatArray, lam: FloatArray) -> None:
        impulse = self.form.recover_impulse(x, lam)
        if not np.isfinite(impulse).all():
            return
        judged = judge_impulse(self.form.problem, impulse)
        if judged.relative < self.relative or self.dual is None:
            self.relative = judged.relative
            self.above = judged.above_floor
            self.impulse[:] = impulse
            self.dual = self.form.recover_bound_multiplier(x, lam, impulse)


@dataclass(frozen=True)
class QPSolver(Solver):
    """A backend with its options; `OPTION_HELP` describes them."""

    backend: Backend
    form: str = "auto"
    settings: Mapping[str, Any] = field(default_factory=dict)
    isolate: bool | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.settings, Mapping):
            raise InputError(
                f"settings is a {type(self.settings).__name__}; a mapping of names is needed"
            )
        if self.isolate is not None:
            check_bool("isolate", self.isolate)

    @property
    def is_isolated(self) -> bool:
        """Whether the backend runs in another process under a time limit."""
        keeps_limit = self.backend.stoppable and not self.backend.overruns
        return not keeps_limit if self.isolate is None else self.isolate

    @np.errstate(all="ignore")  # The judge finds overflows.
    def prepare(self, problem: Problem) -> Form:
        """Write the problem as a program for the backend; raise CapabilityError if the backend cannot solve it."""
        b = self.backend
        name = choose_program_form(problem, self.form, b.needs_definite)
        form = build_form(problem, name)
        if b.needs_definite and self.form == "auto" and name == "velocity" and not form.is_definite:
            form = build_form(problem, "impulse")
        self._check_size(form.program)
        return form

    def _check_size(self, program: ConvexProgram) -> None:
        """Raise CapabilityError if the dense matrices of the backend would be too large."""
        n, m = len(program.q), len(program.t)
        if self.backend.dense and 8 * n * max(n, m) > MAX_DENSE_SIZE:
            raise CapabilityError(
                f"solver {self.backend.name!r} accepts dense matrices only: {max(n, m)} x {n} would need more "
                f"than {MAX_DENSE_SIZE >> 20} MiB; use a sparse backend (osqp, piqp, clarabel)"
            )

    def solve_program(
        self,
        qp: QuadraticProgram,
        tol: float,
        max_iter: int | None,
        deadline: Deadline,
        start: tuple[FloatArray, FloatArray] | None,
    ) -> tuple[ProgramJudge, BackendResult]:
        """Solve a quadratic program; return its best point with the judge's error, and the backend's claim."""
        program = get_program(qp)
        self._check_size(program)
        if deadline.is_set:
            begin = perf_counter()
            self.start_workers(None, 0.0)
            deadline.extend(perf_counter() - begin)
        judge = ProgramJudge(program, tol, deadline)
        # Without a limit of the user, a second call has as many iterations as the first one.
        budget = 2 * self.backend.max_iter if max_iter is None else max_iter
        result = self._call(program, judge, budget, tol, deadline, start)
        if result.status is not Status.INFEASIBLE:
            self._solve_components(program, judge, result, budget, tol, deadline)
        return judge, result

    def _solve_components(
        self,
        program: ConvexProgram,
        judge: ProgramJudge,
        result: BackendResult,
        max_iter: int,
        tol: float,
        deadline: Deadline,
    ) -> None:
        """Solve the components of a program that miss tol alone, with their own sizes, and add their work."""
        if not judge.error > tol or judge.x is None or judge.lam is None:
            return
        if not 1 < program.components[1] <= MAX_SINGLE_COMPONENTS:
            return
        x, lam = judge.x.copy(), judge.lam.copy()
        for rows, columns in program.list_components():
            if deadline.has_passed() or result.iterations >= max_iter:
                break
            part = program.select_rows_and_columns(rows, columns)
            own = ProgramJudge(part, tol, deadline)
            if own.keep(x[columns], lam[rows])[0] <= tol or len(columns) == len(x):
                continue
            answer = self._call(part, own, max_iter - result.iterations, tol, deadline, None)
            result.work = sum_work_counts((result.work, answer.work))
            if own.x is not None:
                x[columns], lam[rows] = own.x, own.lam
        judge.keep(x, lam, True)

    def _call(
        self,
        program: ConvexProgram,
        judge: Any,
        max_iter: int,
        tol: float,
        deadline: Deadline,
        start: Any,
    ) -> BackendResult:
        """Call the backend, in another process under a time limit, until the judge accepts its point."""
        b = self.backend
        is_isolated = bool(self.isolate) or (self.is_isolated and deadline.is_set)
        call = partial(run_isolated, b) if is_isolated else b.run
        result = call_backend_until_accepted(
            program,
            judge,
            call,
            max_iter=max_iter,
            tol=tol,
            deadline=deadline,
            settings=self.settings,
            start=start,
            needs_definite=b.needs_definite,
            first_tolerance=b.first_tolerance,
            interior=b.interior,
            call_iterations=int(
                min(b.max_iter, b.row_iterations * (len(program.q) + len(program.t)))
            ),
        )
        if deadline.is_set and not (b.stoppable and not b.overruns):
            limit = "reads its time limit rarely" if b.stoppable else "accepts no time limit"
            manner = "in a separate process" if is_isolated else "to its end"
            result.message = f"{result.message}; the backend {limit} and ran {manner}"
        return result

    @np.errstate(all="ignore")  # The judge finds overflows.
    def run(
        self,
        state: Form,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None = None,
    ) -> Claim:
        form = state
        no_work = {"backend_calls": 0}
        if not len(form.unknown_rows):
            impulse[:] = form.fixed
            return Claim(
                Status.CONVERGED, 0, no_work, "every impulse is determined by its bounds", form.name
            )
        if max_iter == 0:
            return Claim(Status.MAX_ITERATIONS, 0, no_work, "", form.name)
        if tol > 0.0 and judge_impulse(form.problem, impulse).relative == 0.0:
            return Claim(Status.CONVERGED, 0, no_work, "", form.name)
        start = form.make_start(impulse) if self.backend.starts and impulse.any() else None
        deadline = Deadline(time_limit)
        if form.name == "program":
            judge, result = self.solve_program(form.problem.qp, tol, max_iter, deadline, start)
            if judge.x is not None and judge.lam is not None:
                impulse[:] = form.recover_impulse(judge.x, judge.lam)
            above = judge_impulse(form.problem, impulse).above_floor
            error = judge.error
            dual: FloatArray | None = form.recover_bound_multiplier(impulse, impulse, impulse)
        else:
            contact = ContactJudge(form, impulse, tol)
            result = self._call(form.program, contact, max_iter, tol, deadline, start)
            above, dual, error = contact.above, contact.dual, contact.relative
        status = result.status
        certificate = None
        is_false = status is Status.CONVERGED and error > get_false_claim_error(tol)
        if (status is Status.INFEASIBLE or is_false) and result.point is not None:
            # A point of a program without a solution may be a certificate, because it grows without limit.
            candidates = form.list_certificates(*result.point)
            certificate = next(
                (y for y in candidates if check_certificate(form.problem, y) is None), None
            )
            status = status if certificate is None else Status.INFEASIBLE
        if status is not Status.INFEASIBLE and above <= tol and tol > 0.0:
            status = Status.CONVERGED
        elif status in (Status.CONVERGED, Status.NUMERICAL_ERROR) and not (
            is_false and not result.shift
        ):
            # The backend's tests use other norms than the judge, or another P, so its claim is not false.
            status = Status.STALLED if np.isfinite(error) else Status.NUMERICAL_ERROR
        return Claim(
            status,
            result.iterations,
            result.work,
            result.message,
            form.name,
            dual=dual,
            certificate=certificate,
        )

    def start_workers(self, state: Form | None, time_limit: float) -> None:
        """Import the backend's code, in the process that runs it, before the clock of a time limit starts."""
        if self.is_isolated:
            start_process(self.backend)
        else:
            import_numerical_modules(*self.backend.modules)


def explain_refusal(problem: Problem) -> str | None:
    """Return the reason why no QP backend accepts this problem, or None.

    The test needs no conversion and no factorisation; an indefinite A, for example, is found only later.
    """
    if problem.has_singular_program:
        return None
    if not problem.is_symmetric:
        return (
            f"needs a symmetric A; here A - A^T is {problem.asymmetry:.1e} of A "
            "(pgs accepts it; a Problem of (A + A^T)/2 is another problem, if that error is small enough)"
        )
    if problem.matrix is not None and problem.m:
        diagonal = problem.csr.diagonal()
        i = int(np.argmin(diagonal))
        if diagonal[i] < 0.0:
            return f"needs a positive semidefinite A; A[{i}, {i}] = {diagonal[i]:.3g}"
    return None
