"""Wrapper of backends and of solvers of plug-ins, whose claims are checked."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from lavender.base.arrays import FloatArray
from lavender.base.deadline import NEVER, Deadline
from lavender.base.errors import InputError
from lavender.judge.solution import INFEASIBLE, Claim, Status
from lavender.problem import Problem
from lavender.solvers.certify import check_infeasibility_claim
from lavender.solvers.registry import Solver, SolverSpec


class ForeignSolver(Solver):
    """Wrapper of a foreign solver, which must have the methods `prepare` and `run`; others have defaults."""

    problem: Problem  # Of the last state.
    deadline = NEVER  # Of the next run of a resumable solver.

    def __init__(self, spec: SolverSpec, solver: Any) -> None:
        self.spec, self.solver = spec, solver
        missing = [m for m in ("prepare", "run") if not callable(getattr(solver, m, None))]
        if missing:
            raise InputError(
                f"solver {spec.name!r} is a {type(solver).__name__} without {' and '.join(missing)}; both are needed"
            )

    def prepare(self, problem: Problem) -> Any:
        """Build the state of a solve."""
        self.problem = problem
        return self.solver.prepare(problem)

    def update(self, state: Any, problem: Problem) -> Any:
        """Return the state for a problem of the same structure."""
        self.problem = problem
        update = getattr(self.solver, "update", None)
        return self.solver.prepare(problem) if update is None else update(state, problem)

    def start_workers(self, state: Any, time_limit: float) -> None:
        """Start the solver's processes, if it has any."""
        if hasattr(self.solver, "start_workers"):
            self.solver.start_workers(state, time_limit)

    def set_deadline(self, state: Any, deadline: Deadline) -> None:
        """Set the deadline of the next run."""
        self.deadline = deadline
        if hasattr(self.solver, "set_deadline"):
            self.solver.set_deadline(state, deadline)

    def run(
        self, state: Any, impulse: FloatArray, max_iter: int, tol: float, time_limit: float | None
    ) -> Claim:
        """Run the solver and check its claim: its iterations, and a proof that there is no solution."""
        deadline = self.deadline if time_limit is None else Deadline(time_limit)
        run = self.solver.run if self.spec.builtin else self._run_plugin
        claim: Claim = run(state, impulse, max_iter, tol, time_limit)
        if claim.status is INFEASIBLE:
            return check_infeasibility_claim(self.problem, claim, tol, deadline)
        return claim

    def _run_plugin(
        self, state: Any, impulse: FloatArray, max_iter: int, tol: float, time_limit: float | None
    ) -> Claim:
        """Run a plug-in; a claim of too many iterations becomes a claim of NUMERICAL_ERROR.

        The solver gets a copy of the iterate: if its state keeps a view of it, a later run cannot change the result.
        """
        iterate = impulse.copy()
        claim = self.solver.run(state, iterate, max_iter, tol, time_limit)
        impulse[:] = iterate
        if claim.iterations > max_iter:
            message = (
                f"solver {self.spec.name!r} claims the iterations {claim.iterations}; "
                f"a whole number from 0 to {max_iter} is needed"
            )
            return Claim(Status.NUMERICAL_ERROR, claim.iterations, {}, message)
        message = " ".join(claim.message.split())
        return replace(claim, message=message, stages=(), judged=None, refutation="")
