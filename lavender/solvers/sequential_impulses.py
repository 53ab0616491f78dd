"""Sequential impulses: projected Gauss-Seidel on body velocities, without forming A.

    w_i = J_i v - b_i + c_i lambda_i,   lambda_i <- update of `lavender_ext/core/block.pxd`,
    v <- v + M^-1 J_i^T (change of lambda_i)

with v = M^-1 J^T lambda, the change of velocity. A sweep equals a sweep of `pgs` in the same order up to rounding, but
the cost of a contact does not depend on the number of its neighbours. In a fixed order, contacts and joints are swept
in pairs, without changing the result by a bit (`lavender_ext/sweep/packed.pyx`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.judge.solution import Claim
from lavender.problem import Problem
from lavender.problem.ordering import Order
from lavender.solvers import pgs
from lavender.solvers.layout import Layout, copy_problem_in_block_order, is_reordered_copy_faster
from lavender.solvers.sweeping import Sweeping, SweepState


class ImpulseState(SweepState):
    """State of sweeps over bodies: v = M^-1 J^T lambda is formed once and updated by the sweeps.

    A large problem that is swept in another order than its own is copied in that order (`solvers/layout.py`); the
    sweeps then use `sweep_impulse`.
    """

    sweep_impulse: FloatArray | None = (
        None  # Impulse (m,) [N s] at the end of the last run, in sweep order.
    )
    layout: Layout | None

    def __init__(self, problem: Problem, order: Order, earlier: ImpulseState | None) -> None:
        layout, sweeps = (None, None) if earlier is None else (earlier.layout, earlier.sweeps)
        data = problem.data
        swept = order
        self.layout = None
        if is_reordered_copy_faster(problem, order):
            self.layout = copy_problem_in_block_order(problem, order.blocks, layout)
            data = self.layout.data
            swept = replace(order, blocks=np.arange(problem.n_blocks, dtype=np.int32))
        super().__init__(problem, data, swept, keeps_last=True, before=sweeps)
        self.plan = order

    @property
    def best(self) -> tuple[float, FloatArray | None]:
        """(relative residual, impulse (m,) [N s]) of the best check, in the problem's order."""
        relative, ordered = super().best
        if ordered is None or self.layout is None:
            return relative, ordered
        impulse = np.empty_like(ordered)
        self.layout.from_sweep_order(ordered, impulse)
        return relative, impulse

    def keep_best(self, impulse: FloatArray, tol: float) -> None:
        """Replace `impulse` (m,) by the best of it and all checked iterates in each island, unless it meets tol."""
        if self.layout is None:
            self.watch.keep_best(impulse, tol)
            return
        ordered = self.layout.to_sweep_order(impulse)
        self.watch.keep_best(ordered, tol)
        self.layout.from_sweep_order(ordered, impulse)


@dataclass(frozen=True)
class SequentialImpulses(Sweeping):
    """Matrix-free projected Gauss-Seidel; `order`, `ground` and `seed` as in `lavender.problem.ordering`."""

    keeps_last = True

    def _build_state(
        self, problem: Problem, order: Order, earlier: ImpulseState | None
    ) -> ImpulseState:
        return ImpulseState(problem, order, earlier)

    def run(
        self,
        state: ImpulseState,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None = None,
    ) -> Claim:
        lam = impulse
        if state.layout is not None:
            if state.sweep_impulse is None:
                state.sweep_impulse = state.layout.to_sweep_order(impulse)
            lam = state.sweep_impulse
        claim = super().run(state, lam, max_iter, tol)
        if state.layout is not None:
            state.layout.from_sweep_order(lam, impulse)
        return claim


SPEC = replace(
    pgs.SPEC,
    name="sequential_impulses",
    factory=SequentialImpulses,
    options={},
    operators=frozenset({"rows"}),
    summary="projected Gauss-Seidel on body velocities, matrix-free",
    reference="Catto 2005, Iterative Dynamics with Temporal Coherence; Guendelman, Bridson, Fedkiw 2003",
)
