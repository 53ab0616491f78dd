"""Damped projected Jacobi: every block is updated with the same w = A lambda - b.

    lambda <- Pi(lambda - omega w / d),   omega = min(1, 1.6 / max_i sum_j |A_ij| / sqrt(d_i d_j)) by default

The row sum, the same in every unit, bounds the largest eigenvalue L of D^-1 A, and symmetric positive semidefinite A
needs omega < 2 / L. Without damping (omega = 1), k coincident contacts multiply the error by k - 1 and never
converge for k >= 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lavender.base.arrays import FloatArray, number
from lavender.judge.solution import Claim
from lavender.problem import Problem
from lavender.problem.ordering import block_order
from lavender.solvers.registry import Solver, SolverSpec
from lavender.solvers.setup_times import summed
from lavender.solvers.sweeping import SweepState, run_kernel
from lavender_ext.sweep import serial


class JacobiState(SweepState):
    """A sweep state with its damping."""

    def __init__(self, problem: Problem, omega: float) -> None:
        super().__init__(problem, problem.csr_data, block_order(problem))
        self.omega = omega


@dataclass(frozen=True)
class Jacobi(Solver):
    """Damped (projected) Jacobi.

    Parameters
    ----------
    omega : float or None
        Damping; None: the safe value above.
    """

    omega: float | None = None

    def __post_init__(self) -> None:
        if self.omega is not None:
            number("omega", self.omega, above=0.0)

    def setup_time(self, problem: Problem) -> float:
        """What `prepare` takes [s], as counted."""
        return summed(problem)

    def prepare(self, problem: Problem) -> JacobiState:
        return JacobiState(problem, safe_damping(problem) if self.omega is None else self.omega)

    def run(
        self,
        state: JacobiState,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None = None,
    ) -> Claim:
        return run_kernel(state, impulse, max_iter, tol, serial.JACOBI, state.omega)


@np.errstate(all="ignore")  # what overflows is judged
def safe_damping(problem: Problem) -> float:
    """min(1, 1.6 / max_i sum_j |A_ij| sqrt(s_i s_j)), s the steps [kg] (1/d, on tangents 1/lambda_max)."""
    if problem.m == 0:
        return 1.0
    root = np.sqrt(problem.csr_data.step)
    bound = float((abs(problem.csr) @ root * root).max())
    return min(1.0, 1.6 / bound) if bound > 0.0 else 1.0


SPEC = SolverSpec(
    name="jacobi",
    factory=Jacobi,
    laws=frozenset({"linear", "lcp", "coulomb"}),
    boxes=frozenset({"coulomb"}),
    operators=frozenset({"matrix"}),
    parts=True,
    max_iter=1000,
    options={"omega": "damping, default safe for symmetric positive semidefinite A"},
    summary="damped Jacobi, projected",
    reference="Saad 2003, section 4.1; Tasora, Anitescu 2011 for the projected form",
)
