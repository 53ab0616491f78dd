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

from lavender.judge.solution import Claim
from lavender.problem import Problem
from lavender.problem.ordering import Order
from lavender.solvers.registry import SolverSpec
from lavender.solvers.setup_times import forming
from lavender.solvers.sweeping import Sweeping, SweepState, over, plan_of, reads_whitened, swept
from lavender_ext.sweep import serial


@dataclass(frozen=True)
class BlockGaussSeidel(Sweeping):
    """Block Gauss-Seidel; `order`, `ground`, `seed` as in `lavender.problem.ordering`."""

    def _forming(self, problem: Problem) -> float:
        return forming(problem) if problem.rows is None and not reads_whitened(problem) else 0.0

    def _state(self, problem: Problem, order: Order, before: SweepState | None) -> SweepState:
        data = swept(problem)
        return SweepState(problem, data, order, serial.Sweeps(data, *plan_of(order), exact=True))

    def _told(self, state: SweepState, claim: Claim, again: int) -> Claim:
        return replace(claim, work={**claim.work, "fallbacks": again}, form=over(state.data))


SPEC = SolverSpec(
    name="block_gauss_seidel",
    factory=BlockGaussSeidel,
    laws=frozenset({"linear", "lcp", "coulomb", "cone"}),
    box_friction_laws=frozenset({"coulomb", "cone"}),
    operators=frozenset({"rows", "matrix", "generalized"}),
    order=True,
    seed=True,
    round_cones=True,
    supports_rolling=True,
    max_iter=1000,
    summary="Gauss-Seidel over contacts and joints, each solved exactly",
    reference="Jourdan, Alart, Jean 1998; Acary, Bremond, Huber 2018 (NSGS with an exact local solver)",
)
