"""Projected Gauss-Seidel: updates one block after the other with the current w = A lambda - b.

    row       lambda <- clip(lambda - w / d, lower, upper)
    contact   lambda_n <- max(0, lambda_n - w_n / d_n), then the tangents together with one scalar step
              1 / lambda_max(A_tt) projected radially on mu lambda_n, then spin

It converges linearly for symmetric positive semidefinite A. A sweep over A calls `relax_csr_block` of
`lavender_ext/sweep/pgs.pxd` for one block after the other. In generalised coordinates it keeps u = Y^T lambda instead,
with J M^-1 J^T = Y Y^T and w = Y u - b, if that costs less than forming A.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lavender._arrays import FloatArray
from lavender.ordering import Order
from lavender.problem import Problem
from lavender.registry import SolverSpec
from lavender.solution import Claim
from lavender.solvers.sweeping import SweepState, Threaded, reads_whitened, run_kernel, run_threads
from lavender_ext.judge import measure
from lavender_ext.sweep import serial


class PGSState(SweepState):
    """A sweep state, over J and M with u = Y^T lambda."""

    velocity: FloatArray | None = None  # (nv + 1,)


@dataclass(frozen=True)
class PGS(Threaded):
    """Projected Gauss-Seidel; `order`, `ground`, `seed` as in `lavender.ordering`; `threads` with "colored"."""

    def run(
        self, state: PGSState, impulse: FloatArray, max_iter: int, tol: float, time_limit: float | None = None
    ) -> Claim:
        if state.data.is_general:
            if state.velocity is None:
                state.velocity = np.zeros(state.data.n_velocities + 1)
                measure.velocity_change(state.data, impulse, state.velocity[:, None])
            made = run_kernel(state, impulse, max_iter, tol, serial.PGS, scratch=state.velocity)
            return replace(made, form="whitened J")
        if self.uses_threads(state):
            return run_threads(state, impulse, max_iter, tol, self.threads)
        return run_kernel(state, impulse, max_iter, tol, serial.PGS)

    def _state(self, problem: Problem, order: Order, before: Any) -> PGSState:
        data = problem.metric if reads_whitened(problem) else problem.csr_data
        return PGSState(problem, data, order)


SPEC = SolverSpec(
    name="pgs",
    factory=PGS,
    laws=frozenset({"linear", "lcp", "coulomb"}),
    boxes=frozenset({"coulomb"}),
    operators=frozenset({"matrix", "generalized"}),
    order=True,
    seed=True,
    threads=True,
    rolling=True,
    max_iter=1000,
    summary="projected Gauss-Seidel on the rows of A, or on J and M",
    reference="Cottle, Pang, Stone 1992, section 5.2; Jourdan, Alart, Jean 1998 for friction",
)
