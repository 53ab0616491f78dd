"""Sequential impulses: projected Gauss-Seidel on body velocities, without forming A.

    w_i = J_i v - b_i + c_i lambda_i,   lambda_i <- update of `lavender_ext/core/block.pxd`,
    v <- v + M^-1 J_i^T (change of lambda_i)

with v = M^-1 J^T lambda, the change of velocity. In the same order, each sweep equals one of `pgs` up to rounding,
but the cost of a contact does not depend on the number of its neighbours. In a fixed order, contacts and joints are
swept in pairs, with the same bits (`lavender_ext/sweep/packed.pxd`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.judge.solution import Claim
from lavender.problem import Problem
from lavender.problem.ordering import Order
from lavender.solvers.layout import Layout, lay_out
from lavender.solvers.layout import pays as layout_pays
from lavender.solvers.registry import SolverSpec
from lavender.solvers.sweeping import Sweeping, SweepState, plan_of
from lavender_ext.sweep import serial


class ImpulseState(SweepState):
    """A sweep state over bodies: v = M^-1 J^T lambda is formed once and kept by the sweeps.

    A large problem with an order of its own is copied in that order; the impulse of the sweeps is then `laid`.
    """

    laid: FloatArray | None = None  # (m,) impulse in sweep order, as the last run left it
    layout: Layout | None

    def __init__(self, problem: Problem, order: Order, before: ImpulseState | None) -> None:
        layout, sweeps = (None, None) if before is None else (before.layout, before.sweeps)
        self.layout = lay_out(problem, order.blocks, layout) if layout_pays(problem, order) else None
        data, swept = problem.data, order
        if self.layout is not None:
            data = self.layout.data
            swept = replace(order, blocks=np.arange(problem.n_blocks, dtype=np.int32))
        sweeps = serial.Sweeps(data, *plan_of(swept), before=sweeps)
        super().__init__(problem, data, swept, sweeps)
        self.plan = order

    @property
    def best(self) -> tuple[float, FloatArray | None]:
        relative, laid = super().best
        if laid is None or self.layout is None:
            return relative, laid
        impulse = np.empty_like(laid)
        self.layout.put(laid, impulse)
        return relative, impulse

    def keep_best(self, impulse: FloatArray, tol: float) -> None:
        """Replace `impulse` (m,), unless it meets tol, by the best of each island of it and of all checks."""
        if self.layout is None:
            self.watch.keep_best(impulse, tol)
            return
        laid = self.layout.take(impulse)
        self.watch.keep_best(laid, tol)
        self.layout.put(laid, impulse)


@dataclass(frozen=True)
class SequentialImpulses(Sweeping):
    """Matrix-free projected Gauss-Seidel; `order`, `ground`, `seed` as in `lavender.problem.ordering`."""

    def _forming(self, problem: Problem) -> float:
        return 0.0

    def _state(self, problem: Problem, order: Order, before: ImpulseState | None) -> ImpulseState:
        return ImpulseState(problem, order, before)

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
            if state.laid is None:
                state.laid = state.layout.take(impulse)
            lam = state.laid
        claim = super().run(state, lam, max_iter, tol)
        if state.layout is not None:
            state.layout.put(lam, impulse)
        return claim


SPEC = SolverSpec(
    name="sequential_impulses",
    factory=SequentialImpulses,
    laws=frozenset({"linear", "lcp", "coulomb"}),
    box_friction_laws=frozenset({"coulomb"}),
    operators=frozenset({"rows"}),
    order=True,
    seed=True,
    supports_rolling=True,
    max_iter=1000,
    summary="projected Gauss-Seidel on body velocities, matrix-free",
    reference="Catto 2005, Iterative Dynamics with Temporal Coherence; Guendelman, Bridson, Fedkiw 2003",
)
