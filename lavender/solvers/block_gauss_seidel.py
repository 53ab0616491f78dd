"""Block Gauss-Seidel: contacts and joints are solved exactly one after the other, with all other blocks fixed.

    find lam_i:   w_i = A_ii lam_i + q_i complementary to lam_i,   q_i = sum_{j != i} A_ij lam_j - b_i

A contact with two tangents in a disk is open, sticks, or slips under Coulomb's law in the direction that a scalar
equation determines (`lavender_ext/local/coulomb.pxd`). Sliding disks under the cone law, contacts with other
friction components and the bounded rows of a joint are solved by Newton's method
(`lavender_ext/local/block_newton.pxd`). Unlike in `pgs`, normal and friction of one contact are solved together;
different contacts are coupled only by sweeps. The sweeps use body velocities if the problem has rows, J and M if
that costs less than forming A, and otherwise the rows of A. `work["fallbacks"]` counts blocks without an exact
solution, which are updated by projected steps instead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from lavender.judge.solution import Claim
from lavender.problem import Problem
from lavender.problem.ordering import Order
from lavender.solvers.sweeping import SWEEPS, Sweeping, SweepState, choose_sweep_data, form_name


@dataclass(frozen=True)
class BlockGaussSeidel(Sweeping):
    """Block Gauss-Seidel; `order`, `ground` and `seed` as in `lavender.problem.ordering`."""

    keeps_last = True

    def _build_state(self, problem: Problem, order: Order, before: SweepState | None) -> SweepState:
        return SweepState(
            problem, choose_sweep_data(problem), order, keeps_last=self.keeps_last, exact=True
        )

    def _add_work_to_claim(self, state: SweepState, claim: Claim, fallbacks: int) -> Claim:
        return replace(
            claim, work={**claim.work, "fallbacks": fallbacks}, form=form_name(state.data)
        )


SPEC = replace(
    SWEEPS,
    name="block_gauss_seidel",
    plain_sweeps=True,
    factory=BlockGaussSeidel,
    round_cones=True,
    summary="Gauss-Seidel over contacts and joints, each solved exactly",
    reference="Jourdan, Alart, Jean 1998; Acary, Bremond, Huber 2018 (NSGS with an exact local solver)",
)
