"""Successive over-relaxation on free rows: lambda_i <- lambda_i - omega w_i / d_i with the current w.

It converges for symmetric positive definite A and 0 < omega < 2 (Ostrowski, Reich).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from lavender.base.arrays import check_float
from lavender.base.errors import InputError
from lavender.problem import Problem
from lavender.problem.ordering import Order
from lavender.solvers.sweeping import SWEEPS, Sweeping, SweepState
from lavender_ext.sweep import serial


@dataclass(frozen=True)
class SOR(Sweeping):
    """Successive over-relaxation.

    Parameters
    ----------
    omega : float, default 1.5
        Relaxation, 0 < omega < 2.
    """

    omega: float = 1.5

    def __post_init__(self) -> None:
        if not 0.0 < check_float("omega", self.omega) < 2.0:
            raise InputError(
                f"omega is {self.omega}; a number between 0 and 2 is needed, because SOR diverges outside of this range"
            )

    def _build_state(self, problem: Problem, order: Order, before: Any) -> SweepState:
        return SweepState(
            problem,
            problem.csr_data,
            order,
            keeps_last=self.keeps_last,
            method=serial.SOR,
            omega=self.omega,
        )


SPEC = replace(
    SWEEPS,
    name="sor",
    plain_sweeps=True,
    factory=SOR,
    laws=frozenset({"linear"}),
    box_friction_laws=frozenset(),
    operators=frozenset({"matrix"}),
    supports_rolling=False,
    bounded_hint=": 'pgs' with omega= is this method with bounds (PSOR)",
    options={"omega": "relaxation factor, 0 < omega < 2; default 1.5"},
    summary="successive over-relaxation of a linear system",
    reference="Young 1971, Iterative Solution of Large Linear Systems",
)
