"""Sequential impulses: projected Gauss-Seidel on body velocities, A never formed.

    w_i = J_i v - b_i + c_i lambda_i,   lambda_i <- update of `lavender_ext/block.pxd`,
    v <- v + M^-1 J_i^T (change of lambda_i)

with v = M^-1 J^T lambda, the change of velocity. Equal to `pgs` on the same order, sweep by sweep, to
rounding; a contact costs the same whatever the number of its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lavender._arrays import FloatArray
from lavender.ordering import block_order
from lavender.problem import Problem
from lavender.registry import SolverSpec
from lavender.solution import Claim
from lavender.solvers._sweeping import SweepState, Threaded, run_kernel, run_threads
from lavender_ext import judge
from lavender_ext import sweeps as kernels


class ImpulseState(SweepState):
    """A sweep state with v = M^-1 J^T lambda (n + 1, 6), formed once and kept by the sweeps."""

    velocity: FloatArray | None = None


@dataclass(frozen=True)
class SequentialImpulses(Threaded):
    """Matrix-free projected Gauss-Seidel; `order`, `ground`, `seed` as in `lavender.ordering`;
    `threads` with "colored".
    """

    def prepare(self, problem: Problem) -> ImpulseState:
        order = block_order(problem, self.order, seed=self.seed, ground=self.ground)
        return ImpulseState(problem, problem.data, order)

    def run(
        self, state: ImpulseState, impulse: FloatArray, n: int, tol: float, time_limit: float | None = None
    ) -> Claim:
        if state.velocity is None:
            state.velocity = np.zeros((state.data.n_bodies + 1, 6))
            judge.velocity_change(state.data, impulse, state.velocity)
        velocity = state.velocity.ravel()
        if self.uses_threads(state):
            return run_threads(state, impulse, n, tol, self.threads, velocity)
        return run_kernel(state, impulse, n, tol, kernels.IMPULSES, scratch=velocity)


SPEC = SolverSpec(
    name="sequential_impulses",
    factory=SequentialImpulses,
    laws=frozenset({"linear", "lcp", "coulomb"}),
    operator="rows",
    order=True,
    seed=True,
    threads=True,
    max_iter=1000,
    summary="projected Gauss-Seidel on body velocities, matrix-free",
    reference="Catto 2005, Iterative Dynamics with Temporal Coherence; Guendelman, Bridson, Fedkiw 2003",
)
