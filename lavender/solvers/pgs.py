"""Projected Gauss-Seidel: one block after the other on w = A lambda - b of this moment.

    row       lambda <- clip(lambda - w / d, lower, upper)
    contact   lambda_n <- max(0, lambda_n - w_n / d_n), then the tangents together with one scalar step
              1 / lambda_max(A_tt) projected radially on mu lambda_n, then spin

Linear convergence for symmetric positive semidefinite A; the update is that of `lavender_ext/core/block.pxd`.
"""

from __future__ import annotations

from dataclasses import dataclass

from lavender._arrays import FloatArray
from lavender.registry import SolverSpec
from lavender.solution import Claim
from lavender.solvers._sweeping import SweepState, Threaded, run_kernel, run_threads
from lavender_ext.sweep import serial


@dataclass(frozen=True)
class PGS(Threaded):
    """Projected Gauss-Seidel; `order`, `ground`, `seed` as in `lavender.ordering`; `threads` with "colored"."""

    def run(
        self, state: SweepState, impulse: FloatArray, n: int, tol: float, time_limit: float | None = None
    ) -> Claim:
        if self.uses_threads(state):
            return run_threads(state, impulse, n, tol, self.threads)
        return run_kernel(state, impulse, n, tol, serial.PGS)


SPEC = SolverSpec(
    name="pgs",
    factory=PGS,
    laws=frozenset({"linear", "lcp", "coulomb"}),
    operators=frozenset({"matrix"}),
    order=True,
    seed=True,
    threads=True,
    max_iter=1000,
    summary="projected Gauss-Seidel on the rows of A",
    reference="Cottle, Pang, Stone 1992, section 5.2; Jourdan, Alart, Jean 1998 for friction",
)
