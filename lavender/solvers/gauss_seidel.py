"""Gauss-Seidel on free rows: lambda_i <- lambda_i - w_i / d_i with the current w (SOR with omega = 1)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from lavender.solvers import sor


@dataclass(frozen=True)
class GaussSeidel(sor.SOR):
    """Gauss-Seidel; `order`, `ground` and `seed` as in `lavender.problem.ordering`."""

    keeps_last = True
    omega: float = field(default=1.0, init=False)


SPEC = replace(
    sor.SPEC,
    name="gauss_seidel",
    factory=GaussSeidel,
    options={},
    bounded_hint=": 'pgs' is this method with bounds",
    bounded_variant="pgs",
    summary="Gauss-Seidel iteration of a linear system",
    reference="Saad 2003, Iterative Methods for Sparse Linear Systems, section 4.1",
)
