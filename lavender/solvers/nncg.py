"""Nonsmooth nonlinear conjugate gradients over sweeps of projected Gauss-Seidel.

    x_k = y_{k-1} + beta_{k-1} p_{k-2},    y_k = S(x_k),    g_k = x_k - y_k
    beta_k = g_k.D g_k / g_{k-1}.D g_{k-1},    p_k = beta_k p_{k-1} - g_k,    D = diag d

A sweep S replaces the gradient step, and beta is the formula of Fletcher and Reeves, without a line search. If beta >
1, the method restarts with p = 0. An iteration is one sweep and three passes over vectors. On piles it needs a third
of the sweeps of `pgs` to reach 1e-9. With order="symmetric", an iteration is a sweep followed by a sweep in reverse
order, similar to a preconditioned conjugate gradient step: slower if `pgs` converges fast, much faster on tall stacks
and at large mass ratios.

If contacts slide, g is not a gradient. Sweeps then move slowly along one direction with nearly constant g until a
contact sticks, lifts or slips, and beta > 1 does not show that p is useless. With restart="against", the method
restarts only if p also points against the sweep, p.D g > 0; otherwise it continues with beta = 1, which accelerates
the slow motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from lavender.base.errors import check_name
from lavender.solvers._accelerated import CONVEX_OPTION, SWEEP_OPTION, Accelerated
from lavender.solvers.sweeping import SWEEPS

RESTARTS = ("growth", "against")


@dataclass(frozen=True)
class NNCG(Accelerated):
    """Nonsmooth nonlinear conjugate gradients; `order`, `ground` and `seed` as in `lavender.problem.ordering`."""

    restart: str = "growth"

    def __post_init__(self) -> None:
        check_name("restart", self.restart, RESTARTS)

    def _get_acceleration(self) -> tuple[int, bool]:
        return 0, self.restart == "against"


SPEC = replace(
    SWEEPS,
    name="nncg",
    factory=NNCG,
    round_cones=True,
    options={
        "sweep": SWEEP_OPTION,
        "convex": CONVEX_OPTION + "; default 0",
        "restart": "'growth' (restart if the factor beta of the search direction exceeds 1; the default) or 'against' "
        "(restart only if the direction also points against the sweep; much faster on piles under Coulomb's law)",
    },
    summary="nonlinear conjugate gradients over Gauss-Seidel sweeps",
    reference="Silcowitz-Hansen, Niebe, Erleben 2010, A nonsmooth nonlinear conjugate gradient method",
)
