"""Wrapper for solvers of other packages: they receive copies, and everything that they return is checked.

A plug-in may store the arrays that it receives, change them later, or return an invalid claim. It therefore works on
copies of the problem and of the impulse, and the caller and the judge never read the arrays that the plug-in holds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, mark_read_only
from lavender.base.deadline import Deadline
from lavender.base.errors import InputError
from lavender.judge.residuals import get_zero_impulse_reference, residual
from lavender.judge.solution import Claim, Status
from lavender.problem import Problem
from lavender.solvers.registry import Solver
from lavender_ext.judge.measure import all_finite


class ForeignSolver(Solver):
    """Wrapper of a solver of another package, which must have the methods `prepare` and `run`."""

    def __init__(self, name: str, solver: Any) -> None:
        self.name, self.solver = name, solver
        missing = [m for m in ("prepare", "run") if not callable(getattr(solver, m, None))]
        if missing:
            raise InputError(
                f"the factory of solver {name!r} returned a {type(solver).__name__} without the methods "
                f"{' and '.join(missing)}; prepare and run are needed (lavender.registry.Solver)"
            )

    def _call_method(self, method: str, *arguments: Any) -> Any:
        """Call a method of the solver; raise RuntimeError instead of SystemExit, which would end the process."""
        try:
            return getattr(self.solver, method)(*arguments)
        except SystemExit as error:
            raise RuntimeError(
                f"solver {self.name!r} called sys.exit({error.code!r:.60}) in {method}; an exception, or a claim "
                "with a message, is needed"
            ) from error

    def _has_method(self, method: str) -> bool:
        return getattr(self.solver, method, None) is not None

    def _call_optional(self, method: str, *arguments: Any) -> Any:
        return self._call_method(method, *arguments) if self._has_method(method) else None

    def start_workers(self, state: State, time_limit: float) -> None:
        """Start worker processes before the clock of a time limit starts."""
        self._call_optional("start_workers", state.state, time_limit)

    def set_deadline(self, state: State, deadline: Deadline) -> None:
        """Pass the deadline to the wrapped solver, which starts no long operation that would end after it."""
        self._call_optional("set_deadline", state.state, deadline)

    def prepare(self, problem: Problem) -> State:
        """Call the wrapped solver's `prepare` (factor, colour, allocate) with a copy of the problem."""
        return State(problem, self._call_method("prepare", _copy_problem(problem)))

    def update(self, state: State, problem: Problem) -> State:
        """Update the state to a problem of the same structure; a solver without `update` prepares it again."""
        if not self._has_method("update"):
            return self.prepare(problem)
        return State(problem, self._call_method("update", state.state, _copy_problem(problem)))

    def run(
        self, state: State, impulse: FloatArray, max_iter: int, tol: float, time_limit: float | None
    ) -> Claim:
        """Run up to `max_iter` more iterations on a copy of the impulse, and copy the result to `impulse`."""
        iterate = impulse.copy()
        try:
            claim = self._call_method("run", state.state, iterate, max_iter, tol, time_limit)
        except KeyboardInterrupt:
            _copy_iterate_to_impulse(iterate, impulse)
            raise
        is_valid = _copy_iterate_to_impulse(iterate, impulse)
        fault = f"changed the impulse to an array of shape {iterate.shape} and dtype {iterate.dtype}"
        return self._check_claim(claim, "" if is_valid else fault, len(impulse), max_iter)

    def _check_claim(self, claim: Any, fault: str, m: int, max_iter: int) -> Claim:
        """Return the claim with checked fields, or a claim of NUMERICAL_ERROR with a message.

        The latter is returned if `fault` is not empty or a field is invalid.
        """
        fault = fault or _find_fault(claim, max_iter)
        certificate = getattr(claim, "certificate", None)
        if certificate is not None and not fault:
            try:
                certificate = mark_read_only(np.array(certificate).astype(np.float64, casting="same_kind"))
            except (TypeError, ValueError):
                fault = f"gives a certificate that is not an array of {m} numbers ({certificate!r:.60})"
        if fault:
            count = getattr(claim, "iterations", 0) if type(claim) is Claim else 0
            iterations = int(count) if _is_count(count) else 0
            return Claim(Status.NUMERICAL_ERROR, iterations, {}, f"solver {self.name!r} {fault}")
        return replace(
            claim,
            iterations=int(claim.iterations),
            work={_join_lines(k): int(n) for k, n in claim.work.items()},
            dual=mark_read_only(claim.dual.copy()) if isinstance(claim.dual, np.ndarray) else claim.dual,
            certificate=certificate,
            message=_join_lines(claim.message),
            form=_join_lines(claim.form),
            stages=(),
            judged=None,
        )


def _find_fault(claim: Any, max_iter: int) -> str:
    """Return a phrase about the first invalid field of a claim, or an empty text."""
    if type(claim) is not Claim:
        return f"returned a {type(claim).__name__} ({claim!r:.60}); a lavender.Claim is needed"
    unchecked: Any = claim  # The fields of a plug-in's claim may have any type.
    status, iterations, work, texts = (
        unchecked.status,
        unchecked.iterations,
        unchecked.work,
        (unchecked.message, unchecked.form),
    )
    if not isinstance(status, Status):
        return f"claims the status {status!r:.60}; a lavender.Status is needed"
    if status is Status.INVALID_PROBLEM:
        return "claims the status INVALID_PROBLEM, which only `solve_many` returns, for invalid data"
    if not _is_count(iterations):
        return f"claims {iterations!r:.60} iterations; a whole number of at least 0 is needed"
    if iterations > max_iter:
        return f"claims {iterations} iterations, more than the limit of {max_iter}"
    if not isinstance(work, Mapping) or not all(isinstance(k, str) and _is_count(n) for k, n in work.items()):
        return f"claims the work {work!r:.60}; counts by name are needed"
    if not all(isinstance(text, str) for text in texts):
        return f"claims the message {texts[0]!r:.60} and form {texts[1]!r:.60}; texts are needed"
    return ""


class State:
    """State that the wrapped solver's `prepare` returned, with the problem for which its results are judged."""

    def __init__(self, problem: Problem, state: Any) -> None:
        self.problem, self.state = problem, state

    @property
    def best(self) -> tuple[float, FloatArray] | None:
        """Best iterate that the solver reports, with its judged residual; None without a valid one."""
        best = getattr(self.state, "best", None)
        if not isinstance(best, tuple) or len(best) != 2 or not isinstance(best[1], np.ndarray):
            return None
        if best[1].shape != (self.problem.m,) or best[1].dtype != np.float64:
            return None
        impulse = best[1].copy()
        return (residual(self.problem, impulse).relative, impulse) if all_finite(impulse) else None

    @property
    def sweeps_per_decade(self) -> float:
        """The solver's `sweeps_per_decade`; NaN if it is not a positive number."""
        value = getattr(self.state, "sweeps_per_decade", math.nan)
        return float(value) if isinstance(value, (int, float, np.number)) and value > 0.0 else math.nan


def _copy_iterate_to_impulse(iterate: FloatArray, impulse: FloatArray) -> bool:
    """Copy an iterate to `impulse` if it still has the same shape and dtype; return whether it has."""
    is_valid = iterate.shape == impulse.shape and iterate.dtype == impulse.dtype
    if is_valid:
        impulse[:] = iterate
    return is_valid


def _join_lines(text: str) -> str:
    return " ".join(text.split())


def _is_count(n: Any) -> bool:
    return isinstance(n, (int, np.integer)) and not isinstance(n, bool) and bool(0 <= n < 2**63)


def _copy_problem(problem: Problem) -> Problem:
    """Copy a problem with all of its arrays."""
    copied = replace(
        problem,
        cones=deepcopy(problem.cones),
        rows=deepcopy(problem.rows),
        generalized=deepcopy(problem.generalized),
        copy=True,
    )
    get_zero_impulse_reference(copied)  # Compute the judge's norms before the solver has access to the copy.
    return copied
