"""Wrapper for solvers of other packages: they get copies, and everything that they return is checked.

A plug-in may keep the arrays that it was given, change them later, or return an invalid claim. So it works on copies of
the problem and of the impulse; the caller and the judge never read its arrays.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, number, read_only
from lavender.base.deadline import Deadline
from lavender.base.errors import InputError
from lavender.judge.residuals import reference, residual
from lavender.judge.solution import Claim, Status
from lavender.problem import Problem
from lavender.solvers.registry import Solver
from lavender_ext.judge.measure import all_finite


class Foreign(Solver):
    """A solver of another package, of which `prepare` and `run` suffice."""

    def __init__(self, name: str, solver: Any) -> None:
        self.name, self.solver = name, solver
        missing = [m for m in ("prepare", "run") if not callable(getattr(solver, m, None))]
        if missing:
            raise InputError(
                f"solver {name!r}: its factory made a {type(solver).__name__} without {' and '.join(missing)}; "
                "prepare and run are needed (lavender.registry.Solver)"
            )

    def _call(self, method: str, *arguments: Any) -> Any:
        """What its method returns; an error where that would end the process, and every other run with it."""
        try:
            return getattr(self.solver, method)(*arguments)
        except SystemExit as error:
            raise RuntimeError(
                f"solver {self.name!r} called sys.exit({error.code!r:.60}) in {method}; an exception, or a claim "
                "that says what failed, is needed"
            ) from error

    def _has(self, method: str) -> bool:
        return getattr(self.solver, method, None) is not None

    def _if_there(self, method: str, *arguments: Any) -> Any:
        return self._call(method, *arguments) if self._has(method) else None

    def setup_time(self, problem: Problem) -> float:
        """What its `prepare` takes [s]; 0 where it does not say."""
        counted = self._if_there("setup_time", problem)
        return 0.0 if counted is None else number(f"setup_time of solver {self.name!r}", counted, low=0.0)

    def start_workers(self, held: Held, time_limit: float) -> None:
        """Start processes."""
        self._if_there("start_workers", held.state, time_limit)

    def set_deadline(self, held: Held, deadline: Deadline) -> None:
        """Begin no long step that would end after that."""
        self._if_there("set_deadline", held.state, deadline)

    def prepare(self, problem: Problem) -> Held:
        """Factor, colour, allocate, for a copy of the problem."""
        return Held(problem, self._call("prepare", _private(problem)))

    def update(self, held: Held, problem: Problem) -> Held:
        """The same structure with new numbers: prepared anew where it has no `update`, which has the same result."""
        if not self._has("update"):
            return self.prepare(problem)
        return Held(problem, self._call("update", held.state, _private(problem)))

    def run(
        self, held: Held, impulse: FloatArray, max_iter: int, tol: float, time_limit: float | None
    ) -> Claim:
        """`max_iter` more iterations on a copy of the impulse; what it has come to is copied back."""
        handed = impulse.copy()
        try:
            claim = self._call("run", held.state, handed, max_iter, tol, time_limit)
        except KeyboardInterrupt:
            _copy_back(handed, impulse)
            raise
        kept = _copy_back(handed, impulse)
        wrong = (
            "" if kept else f"made of the impulse an array of shape {handed.shape} and dtype {handed.dtype}"
        )
        return self._checked(claim, wrong, len(impulse), max_iter)

    def _checked(self, claim: Any, wrong: str, m: int, max_iter: int) -> Claim:
        """The claim with every field checked, or a NUMERICAL_ERROR that says what is wrong."""
        if type(claim) is not Claim:
            wrong = wrong or f"returned a {type(claim).__name__} ({claim!r:.60}); a lavender.Claim is needed"
            return Claim(Status.NUMERICAL_ERROR, 0, {}, f"solver {self.name!r} {wrong}")
        said: Any = claim  # whose fields may hold anything
        iterations = int(said.iterations) if _counts(said.iterations) else 0
        work, certificate, dual = said.work, said.certificate, said.dual
        if not isinstance(said.status, Status):
            wrong = wrong or f"claims the status {claim.status!r:.60}; a lavender.Status is needed"
        elif said.status is Status.INVALID_PROBLEM:
            wrong = (
                wrong
                or "claims the status INVALID_PROBLEM, which only `solve_many` gives, to data that are no problem"
            )
        elif not _counts(claim.iterations):
            wrong = wrong or f"claims {claim.iterations!r:.60} iterations; a whole number from 0 is needed"
        elif iterations > max_iter:
            wrong = wrong or f"claims {iterations} iterations, where {max_iter} were asked for at most"
        elif not isinstance(work, Mapping) or not all(
            isinstance(k, str) and _counts(n) for k, n in work.items()
        ):
            wrong = wrong or f"claims the work {work!r:.60}; counts by name are needed"
        elif not isinstance(said.message, str) or not isinstance(said.form, str):
            wrong = (
                wrong
                or f"claims the message {claim.message!r:.60} and form {claim.form!r:.60}; texts are needed"
            )
        if certificate is not None:
            try:
                certificate = read_only(np.array(certificate).astype(np.float64, casting="same_kind"))
            except (TypeError, ValueError):
                wrong = wrong or f"gives a certificate that is no array of {m} numbers ({certificate!r:.60})"
        if wrong:
            return Claim(Status.NUMERICAL_ERROR, iterations, {}, f"solver {self.name!r} {wrong}")
        return replace(
            claim,
            iterations=iterations,
            work={_one_line(k): int(n) for k, n in work.items()},
            dual=read_only(dual.copy()) if isinstance(dual, np.ndarray) else dual,
            certificate=certificate,
            message=_one_line(claim.message),
            form=_one_line(claim.form),
            stages=(),
        )


class Held:
    """What `prepare` of the wrapped solver returned, with the problem by which its results are judged."""

    def __init__(self, problem: Problem, state: Any) -> None:
        self.problem, self.state = problem, state

    @property
    def best(self) -> tuple[float, FloatArray] | None:
        """Its best iterate by its own account, judged here; None if it has none, or none of finite numbers."""
        found = getattr(self.state, "best", None)
        if not isinstance(found, tuple) or len(found) != 2 or not isinstance(found[1], np.ndarray):
            return None
        if found[1].shape != (self.problem.m,) or found[1].dtype != np.float64:
            return None
        impulse = found[1].copy()
        return (residual(self.problem, impulse).relative, impulse) if all_finite(impulse) else None

    @property
    def sweeps_per_decade(self) -> float:
        """Its `sweeps_per_decade`; NaN if that is not a number."""
        found = getattr(self.state, "sweeps_per_decade", math.nan)
        return float(found) if isinstance(found, (int, float, np.number)) and found > 0.0 else math.nan


def _copy_back(handed: FloatArray, impulse: FloatArray) -> bool:
    """Whether what a solver had in its hands is an array of the same kind still."""
    kept = handed.shape == impulse.shape and handed.dtype == impulse.dtype
    if kept:
        impulse[:] = handed
    return kept


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _counts(n: Any) -> bool:
    return isinstance(n, (int, np.integer)) and not isinstance(n, bool) and bool(0 <= n < 2**63)


def _private(problem: Problem) -> Problem:
    """A copy of the problem with arrays of its own."""
    made = replace(
        problem,
        cones=deepcopy(problem.cones),
        rows=deepcopy(problem.rows),
        generalized=deepcopy(problem.generalized),
        copy=True,
    )
    reference(made)  # the judge's norms, fixed before the solver sees the copy
    return made
