"""Gauss-Seidel on free rows: lambda_i <- lambda_i - w_i / d_i with the current w (SOR with omega = 1)."""

from __future__ import annotations

from dataclasses import dataclass, field

from lavender.solvers.registry import SolverSpec
from lavender.solvers.sor import SOR


@dataclass(frozen=True)
class GaussSeidel(SOR):
    """Gauss-Seidel; `order`, `ground` and `seed` as in `lavender.problem.ordering`."""

    omega: float = field(default=1.0, init=False)


SPEC = SolverSpec(
    name="gauss_seidel",
    factory=GaussSeidel,
    laws=frozenset({"linear"}),
    operators=frozenset({"matrix"}),
    order=True,
    seed=True,
    max_iter=1000,
    bounded_hint=": 'pgs' is this method with bounds",
    bounded_variant="pgs",
    summary="Gauss-Seidel iteration of a linear system",
    reference="Saad 2003, Iterative Methods for Sparse Linear Systems, section 4.1",
)
