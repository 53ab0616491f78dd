"""Run a QP backend as a solver: write the problem as a program in the form that suits the backend, and run it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_bool
from lavender.base.deadline import Deadline
from lavender.base.errors import CapabilityError, InputError
from lavender.base.lazy_import import import_numerical_modules
from lavender.external.as_qp import QP, shift_to_definite
from lavender.external.backend import Backend
from lavender.external.forms import build_program, choose_program_form
from lavender.external.isolated import ENTRY_SIZE, TRANSFER_RATE, IsolatedBackend, start_process
from lavender.external.running import call_backend_until_accepted
from lavender.judge.residuals import compute_stopping_residual
from lavender.judge.solution import Claim, Status, sum_work_counts
from lavender.problem import Problem
from lavender.solvers.costs import RATES
from lavender.solvers.registry import Cost, Solver

MAX_DENSE_SIZE = 2**30  # [bytes] A backend for dense matrices rejects a problem with a larger matrix.
OPTION_HELP = {
    "isolate": "with a time_limit, run the backend in another process, which is killed at the limit; default True",
    "form": "'program' (P, q and rows of from_qp), 'impulse', 'velocity' (bodies, J and M) or 'auto' (default)",
    "unit_diagonal": "in the impulse form, scale A to a unit diagonal; default True",
    "settings": "mapping of options of the backend, which override the options that are set from tol",
}


@dataclass(frozen=True)
class QPSolver(Solver):
    """A backend with its options; `OPTION_HELP` describes them."""

    backend: Backend
    form: str = "auto"
    unit_diagonal: bool = True
    settings: Mapping[str, Any] = field(default_factory=dict)
    isolate: bool = True

    def __post_init__(self) -> None:
        if not isinstance(self.settings, Mapping):
            raise InputError(
                f"settings is a {type(self.settings).__name__}; a mapping of names to values is needed"
            )
        check_bool("isolate", self.isolate)

    def cost(self, problem: Problem) -> Cost:
        """Estimate the cost to form the program, and to send it if the backend runs in another process."""
        entry = RATES["program entry"] + (1e9 * ENTRY_SIZE / TRANSFER_RATE if self.isolate else 0.0)
        return Cost(lambda: RATES["program"] + entry * problem.max_entries)

    @np.errstate(all="ignore")  # The judge finds overflows.
    def prepare(self, problem: Problem) -> QP:
        return self._build_program(problem, True)

    def _build_program(self, problem: Problem, fix_far_rows: bool) -> QP:
        """Write the problem as a program for the backend; raise CapabilityError if the backend cannot solve it."""
        b, qp = self.backend, None
        form = choose_program_form(problem, self.form, b.needs_definite)
        if form != "impulse":
            qp = build_program(problem, form, fix_far_rows=fix_far_rows)
        if qp is None or (b.needs_definite and self.form == "auto" and not qp.is_definite):
            qp = build_program(
                problem, "impulse", fix_far_rows=fix_far_rows, unit_diagonal=self.unit_diagonal
            )
        if b.dense and 8 * qp.n * max(qp.n, len(qp.b)) > MAX_DENSE_SIZE:
            raise CapabilityError(
                f"solver {b.name!r} accepts dense matrices only: {max(qp.n, len(qp.b))} x {qp.n} would need more "
                f"than {MAX_DENSE_SIZE >> 20} MiB; use a sparse backend (osqp, piqp, clarabel)"
            )
        return shift_to_definite(qp) if b.needs_definite else qp

    @np.errstate(all="ignore")  # The judge finds overflows.
    def run(
        self, state: QP, impulse: FloatArray, max_iter: int, tol: float, time_limit: float | None = None
    ) -> Claim:
        qp, b, no_work = state, self.backend, {"backend_calls": 0}
        if not len(qp.unknown_rows):
            impulse[:] = qp.fixed
            return Claim(Status.CONVERGED, 0, no_work, "every impulse is determined by its bounds", qp.form)
        if max_iter == 0:
            return Claim(Status.MAX_ITERATIONS, 0, no_work, "", qp.form)
        if not qp.is_representable:
            message = (
                "as a quadratic program the problem has numbers that overflow; the backend was not called"
            )
            return Claim(Status.NUMERICAL_ERROR, 0, no_work, message, qp.form)
        isolated = IsolatedBackend(b) if self.isolate and time_limit is not None else None
        deadline, start = Deadline(time_limit), impulse.copy()
        call = partial(
            call_backend_until_accepted,
            call=isolated or b.run,
            tol=tol,
            settings=self.settings,
            noisy=b.noisy,
        )
        claim = call(qp, impulse, max_iter=max_iter, time_limit=time_limit)
        has_assumed = len(qp.assumed) and not deadline.has_passed()
        if has_assumed and _violates_inactive_row_assumption(qp, impulse, claim):
            first_claim, impulse[:] = claim, start
            qp, remaining = self._build_program(qp.problem, False), max(1, max_iter - claim.iterations)
            claim = call(qp, impulse, max_iter=remaining, time_limit=deadline.get_remaining_seconds())
            work = sum_work_counts((first_claim.work, claim.work))
            claim = replace(claim, work=work, iterations=first_claim.iterations + claim.iterations)
        if time_limit is None or b.stoppable:
            return claim
        manner = "to its end" if isolated is None else isolated.manner
        return replace(claim, message=f"{claim.message}; the backend accepts no time limit and ran {manner}")

    def start_workers(self, qp: QP, time_limit: float) -> None:
        """Import the backend's code, in the process that runs it, before the clock of a time limit starts."""
        if self.isolate:
            start_process(self.backend)
        else:
            import_numerical_modules(*self.backend.modules)


def _violates_inactive_row_assumption(qp: QP, impulse: FloatArray, claim: Claim) -> bool:
    """Return whether a row that was assumed to stay at its bound leaves it, or may have caused a claim INFEASIBLE."""
    if claim.status is Status.INFEASIBLE:
        return True
    w, error = np.empty(len(impulse)), np.empty(len(impulse))
    compute_stopping_residual(qp.problem, impulse, w, error)
    return bool(np.any(error[qp.assumed] != 0.0))


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
