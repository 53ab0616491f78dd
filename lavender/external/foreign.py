"""Wrapper of solvers of plug-ins, whose claims are checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.judge.solution import Claim, Status
from lavender.solvers.registry import Solver


class ForeignSolver(Solver):
    """Wrapper of a plug-in's solver, which must have the methods `prepare` and `run`; others have defaults."""

    def __init__(self, name: str, solver: Any) -> None:
        self.name, self.solver = name, solver
        missing = [m for m in ("prepare", "run") if not callable(getattr(solver, m, None))]
        if missing:
            raise InputError(
                f"the factory of solver {name!r} returned a {type(solver).__name__} without the methods "
                f"{' and '.join(missing)}; prepare and run are needed (lavender.registry.Solver)"
            )
        for method in ("prepare", "update", "start_workers", "set_deadline"):
            if getattr(solver, method, None) is not None:
                setattr(self, method, getattr(solver, method))

    def run(
        self, state: Any, impulse: FloatArray, max_iter: int, tol: float, time_limit: float | None
    ) -> Claim:
        """Run the solver; an invalid claim becomes a claim of NUMERICAL_ERROR with a message."""
        claim = self.solver.run(state, impulse, max_iter, tol, time_limit)
        fault = _find_fault(claim, max_iter)
        if fault:
            count = getattr(claim, "iterations", 0)
            return Claim(
                Status.NUMERICAL_ERROR, count if _is_count(count) else 0, {}, f"solver {self.name!r} {fault}"
            )
        return replace(claim, message=" ".join(claim.message.split()), stages=(), judged=None)


def _find_fault(claim: Any, max_iter: int) -> str:
    """Return a phrase about the first invalid field of a claim, or an empty text."""
    if type(claim) is not Claim:
        return f"returned a {type(claim).__name__} ({claim!r:.60}); a lavender.Claim is needed"
    unchecked: Any = claim  # The fields of a plug-in's claim may have any type.
    status, count, work, certificate = claim.status, claim.iterations, unchecked.work, claim.certificate
    is_status = isinstance(status, Status) and status is not Status.INVALID_PROBLEM
    texts = (unchecked.message, unchecked.form, *(work if isinstance(work, Mapping) else ()))
    is_work = isinstance(work, Mapping) and all(map(_is_count, work.values()))
    for name, is_valid, needed in (
        ("status", is_status, "a lavender.Status other than INVALID_PROBLEM"),
        ("iterations", _is_count(count) and count <= max_iter, f"a whole number from 0 to {max_iter}"),
        ("work", is_work, "a mapping of names to counts"),
        (
            "message",
            all(isinstance(text, str) for text in texts),
            "a text, like its form and the names of work,",
        ),
        ("certificate", certificate is None or isinstance(certificate, np.ndarray), "an array"),
    ):
        if not is_valid:
            return f"claims the {name} {getattr(claim, name)!r:.60}; {needed} is needed"
    return ""


def _is_count(n: Any) -> bool:
    return isinstance(n, (int, np.integer)) and not isinstance(n, bool) and bool(n >= 0)
