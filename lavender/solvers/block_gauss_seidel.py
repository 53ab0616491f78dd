"""Block Gauss-Seidel: one contact or joint after the other, each solved exactly with all others fixed.

    find lam_i:   w_i = A_ii lam_i + q_i complementary to lam_i,   q_i = sum_{j != i} A_ij lam_j - b_i

A contact is open, sticks, or slips in the direction that a scalar Newton iteration finds
(`lavender_ext/local/exact.pxd`). The rows of a joint are a small boxed problem, solved by pivoting. So normal and
friction of one contact are solved together, unlike in `pgs`; different contacts are still coupled only by sweeps. Works
on the rows of A, on body velocities if the problem has rows, on J and M if that costs less than A. `work["fallbacks"]`
counts blocks without an exact solution, which got the update of `pgs` instead.
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
from lavender.solvers.sweeping import Sweeping, SweepState, claim, over, swept
from lavender_ext.judge import measure
from lavender_ext.local import gauss_seidel


class BlockState(SweepState):
    """A sweep state with the prepared numbers of every block, and v = M^-1 J^T lambda where there are rows."""

    velocity: FloatArray | None = None  # (n + 1, 6); of J and M u = Y^T lambda (nv + 1, 1)

    def __init__(self, problem: Problem, data: Any, order: Order) -> None:
        super().__init__(problem, data, order)
        self.prepared = gauss_seidel.prepare(data)


@dataclass(frozen=True)
class BlockGaussSeidel(Sweeping):
    """Block Gauss-Seidel; `order`, `ground`, `seed` as in `lavender.ordering`."""

    def _state(self, problem: Problem, order: Order, before: BlockState | None) -> BlockState:
        return BlockState(problem, swept(problem), order)

    def run(
        self,
        state: BlockState,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None = None,
    ) -> Claim:
        o, data = state.order, state.data
        if state.velocity is None:
            state.velocity = np.zeros(
                (data.n_velocities + 1, 1) if data.is_general else (data.n_bodies + 1, 6)
            )
            if data.factored or data.is_general:
                measure.velocity_change(data, impulse, state.velocity)
        status, done, fallbacks = gauss_seidel.run(
            data,
            state.watch,
            impulse,
            max_iter,
            tol,
            *state.prepared,
            state.velocity,
            o.blocks,
            o.split,
            o.mode,
            o.rng,
        )
        form = over(data)
        return replace(claim(status, done), work={"sweeps": done, "fallbacks": fallbacks}, form=form)


SPEC = SolverSpec(
    name="block_gauss_seidel",
    factory=BlockGaussSeidel,
    laws=frozenset({"linear", "lcp", "coulomb", "cone"}),
    boxes=frozenset({"coulomb", "cone"}),
    operators=frozenset({"rows", "matrix", "generalized"}),
    order=True,
    seed=True,
    round_cones=True,
    rolling=True,
    max_iter=1000,
    summary="Gauss-Seidel over contacts and joints, each solved exactly",
    reference="Jourdan, Alart, Jean 1998; Acary, Bremond, Huber 2018 (NSGS with an exact local solver)",
)
