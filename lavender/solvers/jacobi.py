"""Damped projected Jacobi: every block is updated with the same w = A lambda - b.

    lambda <- Pi(lambda - omega w / d),   omega = min(1, 1.6 / max_i sum_j |A_ij| / sqrt(d_i d_j)) by default

The maximum of the row sums, which does not depend on units, bounds the largest eigenvalue L of D^-1 A. For a symmetric
positive semidefinite A, convergence requires omega < 2 / L. Without damping (omega = 1), k coincident contacts
multiply the error by k - 1 in each iteration and do not converge for k >= 2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from lavender.base.arrays import check_float
from lavender.problem import Problem
from lavender.problem.ordering import compute_block_order
from lavender.solvers.sweeping import SWEEPS, SweepSolver, SweepState
from lavender_ext.sweep import serial


@dataclass(frozen=True)
class Jacobi(SweepSolver):
    """Damped (projected) Jacobi.

    Parameters
    ----------
    omega : float or None
        Damping factor [-]; None selects the default in the formula above, with which the iteration converges.
    """

    omega: float | None = None

    def __post_init__(self) -> None:
        if self.omega is not None:
            check_float("omega", self.omega, above=0.0)

    def prepare(self, problem: Problem) -> SweepState:
        data = problem.csr_data
        order = compute_block_order(problem)
        omega = serial.jacobi_damping_of_matrix(data) if self.omega is None else self.omega
        return SweepState(problem, data, order, method=serial.JACOBI, omega=omega)


SPEC = replace(
    SWEEPS,
    name="jacobi",
    plain_sweeps=True,
    factory=Jacobi,
    laws=SWEEPS.laws - {"cone"},
    box_friction_laws=frozenset({"coulomb"}),
    operators=frozenset({"matrix"}),
    order=False,
    seed=False,
    options={
        "omega": "damping factor; the default is safe for every symmetric positive semidefinite A"
    },
    summary="damped Jacobi, projected",
    reference="Saad 2003, section 4.1; Tasora, Anitescu 2011 for the projected form",
)
