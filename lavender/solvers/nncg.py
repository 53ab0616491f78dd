"""Nonsmooth nonlinear conjugate gradients over sweeps of projected Gauss-Seidel.

    x_k = y_{k-1} + beta_{k-1} p_{k-2},    y_k = S(x_k),    g_k = x_k - y_k
    beta_k = g_k.D g_k / g_{k-1}.D g_{k-1},    p_k = beta_k p_{k-1} - g_k,    D = diag d

A sweep S stands in for a gradient step, Fletcher and Reeves' beta for the line search; beta > 1 restarts.
One sweep and three passes over vectors an iteration; on piles a third of the sweeps of `pgs` to 1e-9.
With order="symmetric" an iteration is a sweep and the same sweep backwards, near to a preconditioned
conjugate gradient: slower where `pgs` is fast, much faster on tall stacks and mass ratios.
"""

from __future__ import annotations

from dataclasses import dataclass

from lavender.registry import SolverSpec
from lavender.solvers._accelerated import CONVEX_OPTION, SWEEP_OPTION, Accelerated


@dataclass(frozen=True)
class NNCG(Accelerated):
    """Nonsmooth nonlinear conjugate gradients; `order`, `ground`, `seed` as in `lavender.ordering`."""


SPEC = SolverSpec(
    name="nncg",
    factory=NNCG,
    laws=frozenset({"linear", "lcp", "coulomb", "cone"}),
    operators=frozenset({"rows", "matrix", "generalized"}),
    order=True,
    seed=True,
    round_cones=True,
    max_iter=1000,
    options={"sweep": SWEEP_OPTION, "convex": CONVEX_OPTION},
    summary="nonlinear conjugate gradients over Gauss-Seidel sweeps",
    reference="Silcowitz-Hansen, Niebe, Erleben 2010, A nonsmooth nonlinear conjugate gradient method",
)
