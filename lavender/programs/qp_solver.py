"""Run a QP backend as a solver: write the problem as a program in the form that suits the backend, and run it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from lavender.base.arrays import FloatArray, check_bool
from lavender.base.deadline import Deadline, stop_clock
from lavender.base.errors import CapabilityError, InputError
from lavender.base.lazy_import import import_numerical_modules
from lavender.judge.certificates import check_certificate
from lavender.judge.residuals import judge_impulse
from lavender.judge.solution import Claim, SolverStage, Status, sum_work_counts
from lavender.problem import Problem
from lavender.problem.program import QuadraticProgram
from lavender.programs.backend import Backend
from lavender.programs.convex import ConvexProgram
from lavender.programs.forms import Form, build_form, choose_program_form, get_program
from lavender.programs.isolated import run_isolated, start_process
from lavender.programs.judges import ContactJudge, ProgramJudge, is_false_claim
from lavender.programs.running import BackendResult, call_backend_until_accepted
from lavender.programs.task import ProgramTask, Run
from lavender.solvers.registry import Solver, SolverSpec

MAX_DENSE_SIZE = (
    2**30
)  # [bytes] A backend for dense matrices rejects a problem with a larger matrix.
# Components of a program that misses tol are solved alone unless there are more of them.
MAX_SINGLE_COMPONENTS = 50
OPTION_HELP = {
    "isolate": "run the backend in another process, which the call leaves at the time limit: True always, False never, "
    "None (default) under a limit if the backend has none of its own",
    "form": "'program' (P, q and rows of from_qp), 'impulse', 'velocity' (bodies, J and M) or 'auto' (default)",
    "settings": "mapping of options of the backend, which override the options that are set from tol",
}


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
            with stop_clock(deadline):
                self.start_workers(None, 0.0)
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
        others: tuple[SolverSpec, ...] = (),
    ) -> Claim:
        """Run the backend, and for a program `others` after it until one meets tol."""
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
        deadline = Deadline(time_limit)
        if form.name == "program":
            return self._run_program(form, impulse, max_iter, tol, deadline, others)
        start = form.make_start(impulse) if self.backend.starts and impulse.any() else None
        judge = ContactJudge(form, impulse, tol)
        result = self._call(form.program, judge, max_iter, tol, deadline, start)
        error, above = judge.relative, judge.above
        certificate = None
        if result.point is not None and (
            result.status is Status.INFEASIBLE or is_false_claim(result.status, error, tol)
        ):
            # A point of a program without a solution may be a certificate, because it grows without limit.
            candidates = form.list_certificates(*result.point)
            certificate = next(
                (y for y in candidates if check_certificate(form.problem, y) is None), None
            )
        return Claim(
            _choose_status(result, error, above, tol, certificate),
            result.iterations,
            result.work,
            result.message,
            form.name,
            dual=judge.dual,
            certificate=certificate,
        )

    def _run_program(
        self,
        form: Form,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        deadline: Deadline,
        others: tuple[SolverSpec, ...],
    ) -> Claim:
        """Run the task of a program by this backend and the others in turn, until the residual meets tol."""
        problem = form.problem
        start = impulse.copy() if impulse.any() else None
        task = ProgramTask(problem.qp, problem, tol, deadline, max_iter, start)
        stages: list[SolverStage] = []
        relative = judge_impulse(problem, impulse).relative
        above = np.inf
        for solver in (self, *(cast("QPSolver", spec.load()()) for spec in others)):
            left = max_iter - sum(run.work.get("iterations", 0) for run in task.runs)
            task.call_backend(solver, min(left, solver.backend.max_iter) if others else left)
            before = relative
            if task.judge.x is not None:
                judged = judge_impulse(problem, task.impulse)
                relative, above = judged.relative, judged.above_floor
            run = task.runs[-1]
            stages.append(SolverStage(run.name, MappingProxyType(run.work), before, relative))
            is_stopped = run.status is Status.INTERRUPTED or deadline.has_passed()
            if above <= tol or is_stopped or tol == 0.0:
                break
        run, has_point = task.best_run, task.judge.x is not None
        if tol > 0.0:
            task.prove(run.status is not Status.MAX_ITERATIONS)
        if has_point:
            impulse[:] = task.impulse
        certificate = task.certificate
        if certificate is not None and check_certificate(problem, certificate) is not None:
            certificate = None
        work = sum_work_counts(run.work for run in task.runs)
        message = f"{', '.join(stage.solver for stage in stages)}; {run.message}"
        return Claim(
            _choose_status(run, task.judge.error, above, tol, certificate),
            work.get("iterations", 0),
            work,
            message if others else run.message,
            form.name,
            dual=form.recover_bound_multiplier(impulse, impulse, impulse),
            certificate=certificate,
            stages=tuple(stages) if others else (),
        )

    def start_workers(self, state: Form | None, time_limit: float) -> None:
        """Import the backend's code, in the process that runs it, before the clock of a time limit starts."""
        if self.is_isolated:
            start_process(self.backend)
        else:
            import_numerical_modules(*self.backend.modules)


def _choose_status(
    claim: BackendResult | Run, error: float, above: float, tol: float, certificate: Any
) -> Status:
    """Return the status of a claim with an error, the residual above rounding, and a certificate or None."""
    status = claim.status
    if certificate is not None:
        return Status.INFEASIBLE
    if status is not Status.INFEASIBLE and above <= tol and tol > 0.0:
        return Status.CONVERGED
    is_false = is_false_claim(status, error, tol) and not claim.shift
    if status in (Status.CONVERGED, Status.NUMERICAL_ERROR) and not is_false:
        # The backend's tests use other norms than the judge, or another P, so its claim is not false.
        return Status.STALLED if np.isfinite(error) else Status.NUMERICAL_ERROR
    return status


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
