"""Wrapper of solvers of plug-ins, whose claims are checked."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

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
                f"solver {name!r} is a {type(solver).__name__} without {' and '.join(missing)}; both are needed"
            )
        for method in ("prepare", "update", "start_workers", "set_deadline"):
            if getattr(solver, method, None) is not None:
                setattr(self, method, getattr(solver, method))

    def run(
        self, state: Any, impulse: FloatArray, max_iter: int, tol: float, time_limit: float | None
    ) -> Claim:
        """Run the solver; a claim of too many iterations becomes a claim of NUMERICAL_ERROR.

        The solver gets a copy of the iterate: if its state keeps a view of it, a later run cannot change the result.
        """
        iterate = impulse.copy()
        claim = self.solver.run(state, iterate, max_iter, tol, time_limit)
        impulse[:] = iterate
        if claim.iterations > max_iter:
            message = (
                f"solver {self.name!r} claims the iterations {claim.iterations}; "
                f"a whole number from 0 to {max_iter} is needed"
            )
            return Claim(Status.NUMERICAL_ERROR, claim.iterations, {}, message)
        return replace(claim, message=" ".join(claim.message.split()), stages=(), judged=None)
