"""Projected Gauss-Seidel: update one block after the other with the current w = A lambda - b.

    row       lambda <- clip(lambda - omega w / d, lower, upper)
    contact   lambda_n <- max(0, lambda_n - omega w_n / d_n), then the tangents together with one scalar step
              omega / lambda_max(A_tt) projected radially on mu lambda_n, then spin

It converges linearly for symmetric positive semidefinite A. With omega other than 1 it is projected successive
over-relaxation (PSOR, Cryer 1971), which converges for symmetric positive definite A, bounded rows and 0 < omega < 2,
and always sweeps over A. On a chain of rows whose set of rows at a bound no longer changes, with the spectral radius
rho of the Jacobi iteration, a sweep at omega = 1 multiplies the error by rho^2, and at the best omega,
2 / (1 + sqrt(1 - rho^2)), by omega - 1 (Young 1954). A sweep calls `relax_rows_block` of
`lavender_ext/sweep/pgs.pyx` for one block after the other. In generalised coordinates it keeps u = Y^T lambda instead,
with J M^-1 J^T = Y Y^T and w = Y u - b, if that costs less than forming A.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lavender.base.arrays import check_float
from lavender.base.errors import InputError
from lavender.judge.solution import Claim
from lavender.problem import Problem
from lavender.problem.ordering import Order
from lavender.solvers.sweeping import (
    SWEEPS,
    Sweeping,
    SweepState,
    form_name,
    is_sweep_over_jacobian_cheaper,
    make_order_plan,
)
from lavender_ext.sweep import serial

_NO_ORDER = np.empty(0, np.int32)


@dataclass(frozen=True)
class PGS(Sweeping):
    """Projected Gauss-Seidel; `order`, `ground` and `seed` as in `lavender.problem.ordering`.

    Parameters
    ----------
    omega : float, default 1
        Factor of the steps [-], 0 < omega < 2; above 1 over-relaxation.
    """

    omega: float = 1.0
    keeps_last = True

    def __post_init__(self) -> None:
        if not 0.0 < check_float("omega", self.omega) < 2.0:
            raise InputError(
                f"omega is {self.omega}; a number between 0 and 2 is needed, because PSOR diverges outside"
            )

    def _add_work_to_claim(self, state: SweepState, claim: Claim, count: int) -> Claim:
        return replace(claim, form=form_name(state.data)) if state.data.is_general else claim

    def _build_state(self, problem: Problem, order: Order, before: Any) -> SweepState:
        if self.omega != 1.0:
            return SweepState(
                problem,
                problem.csr_data,
                order,
                keeps_last=self.keeps_last,
                method=serial.SOR,
                omega=self.omega,
            )
        if is_sweep_over_jacobian_cheaper(problem):
            return SweepState(problem, problem.metric, order, keeps_last=self.keeps_last)
        data = problem.csr_data
        (blocks, *rest) = make_order_plan(order)
        # In the given order, pass no order to the kernel: it then skips two lookups per row. The bits do not change.
        row_by_row = data.single_rows and order.is_given
        sweeps = serial.Sweeps(data, _NO_ORDER if row_by_row else blocks, *rest)
        return SweepState(problem, data, order, sweeps, keeps_last=self.keeps_last)


SPEC = replace(
    SWEEPS,
    name="pgs",
    plain_sweeps=True,
    factory=PGS,
    laws=SWEEPS.laws - {"cone"},
    box_friction_laws=frozenset({"coulomb"}),
    operators=frozenset({"matrix", "generalized"}),
    options={"omega": "relaxation factor of PSOR, 0 < omega < 2; default 1"},
    summary="projected Gauss-Seidel on the rows of A, or on J and M; projected SOR",
    reference="Cottle, Pang, Stone 1992, section 5.2; Cryer 1971 for omega; Jourdan, Alart, Jean 1998 for friction",
)
