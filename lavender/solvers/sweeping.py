"""Base classes of sweep solvers: sweep order, sweep count, residual checks.

The checks are in `lavender_ext/judge/stopping_test.pxd` and use the judge's arithmetic. The next check is made after
half of the sweeps that are predicted to be needed, so it depends only on the numbers of the problem.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lavender.base.arrays import FloatArray
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.judge.solution import Claim, Status
from lavender.problem import LAWS, OPERATORS, Problem
from lavender.problem.ordering import Order, compute_block_order
from lavender.solvers.registry import Solver, SolverSpec
from lavender_ext.judge.stopping_test import (
    AT_FLOOR,
    CONVERGED,
    DIVERGED,
    RUNNING,
    STALLED,
    StoppingTest,
)
from lavender_ext.sweep import serial

STATUS = {
    RUNNING: Status.MAX_ITERATIONS,
    CONVERGED: Status.CONVERGED,
    DIVERGED: Status.DIVERGED,
    STALLED: Status.STALLED,
    AT_FLOOR: Status.ROUNDOFF_LIMIT,
}
SWEEP_PATIENCE = (
    64  # A run stops as STALLED after this many sweeps without a smaller residual at a check.
)


def create_stopping_test(
    problem: Problem, data: Any, patience: int = SWEEP_PATIENCE, keeps_last: bool = False
) -> StoppingTest:
    """Create the stopping test of a run over `data`, such as `problem.csr_data`, for solvers in Cython and Python.

    A solver in Python calls `watch.run_python(iterate, impulse, n, tol)`: it calls `iterate(count, first)` between
    checks by the judge and returns a status, for `make_claim`, and the number of iterations. As `watch` of the state of
    a solver, the test also keeps the impulse that the solve returns. If A was formed from J and M, the test is
    confirmed on J and M. A run stops as STALLED after `patience` iterations without a smaller residual at a check.
    """
    if problem.metric.reference_energy < 0.0:
        get_zero_impulse_reference(problem)
    data.share_reference(
        problem.metric
    )  # Make residuals over `data` relative to the judge's reference.
    formed = problem.matrix is None and not (data.factored or data.is_general)
    return StoppingTest(data, patience, problem.metric if formed else None, keeps_last)


class SweepState:
    """State of a run of sweeps. Its stopping test `watch` counts sweeps and stores the best checked iterate."""

    def __init__(
        self,
        problem: Problem,
        data: Any,
        order: Order,
        sweeps: Any = None,
        patience: int = SWEEP_PATIENCE,
        keeps_last: bool = False,
        **options: Any,
    ) -> None:
        self.problem = problem
        self.data = data  # lavender_ext.core.problem.Data for the sweeps and the checks.
        # `plan` is the order in terms of the problem's blocks; `order` may be replaced.
        self.order = self.plan = order
        self.watch = create_stopping_test(problem, data, patience, keeps_last)
        # lavender_ext.sweep.serial.Sweeps with these options; by default, relaxed updates of the blocks.
        self.sweeps = (
            serial.Sweeps(data, *make_order_plan(order), **options) if sweeps is None else sweeps
        )

    @property
    def best(self) -> tuple[float, FloatArray | None]:
        """(relative residual, impulse (m,) [N s]) of the best check."""
        return self.watch.best

    @property
    def sweeps_per_decade(self) -> float:
        """Sweeps in which the residual falls tenfold; NaN if it does not fall."""
        return float(self.watch.sweeps_per_decade)


def make_claim(status: int, done: int, counted: str = "sweeps") -> Claim:
    """Return the claim for the status code and the number of iterations that a stopping test returned."""
    return Claim(STATUS[status], done, {counted: done})


def make_order_plan(order: Order) -> tuple[Any, ...]:
    """Return (blocks, split, mode, rng) of an order, as the kernels expect them."""
    return order.blocks, order.split, order.mode, order.rng


def is_sweep_over_jacobian_cheaper(problem: Problem) -> bool:
    """Return whether a sweep over J and M (twice the entries of Y) costs less than one over A, without forming A."""
    if problem.generalized is None:
        return False
    data = problem.metric
    return bool(
        data.work - 4 * problem.m < data.entries_of_matrix
    )  # `work` counts each entry of Y twice.


def choose_sweep_data(problem: Problem) -> Any:
    """Return the data that sweeps use: bodies or a matrix as given; for J and M, the cheaper of J and M and A."""
    return problem.metric if is_sweep_over_jacobian_cheaper(problem) else problem.data


def form_name(data: Any) -> str:
    """Return the name of the operator form that the sweeps used."""
    return "whitened J" if data.is_general else "body velocities" if data.factored else "rows of A"


class SweepSolver(Solver):
    """A solver with a `SweepState` as its state."""

    def run(
        self,
        state: Any,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None = None,
    ) -> Claim:
        """Run `max_iter` sweeps in one call of the kernel, fewer if a check ends them; tol = 0 disables the checks."""
        status, done, count = state.sweeps.run(state.watch, impulse, max_iter, tol)
        return self._add_work_to_claim(state, make_claim(status, done), count)

    def _add_work_to_claim(self, state: Any, claim: Claim, count: int) -> Claim:
        """Add solver-specific work to a claim; `count` is the number of fallbacks of exact blocks, or of restarts."""
        return claim


@dataclass(frozen=True)
class Sweeping(SweepSolver):
    """Base class of sweep solvers over A in compressed rows, with their options."""

    order: Any = "given"
    ground: Any = None
    seed: int = 0

    def prepare(self, problem: Problem) -> Any:
        """Build the state before the first sweep, with a new order."""
        order = compute_block_order(problem, self.order, seed=self.seed, ground=self.ground)
        return self._build_state(problem, order, None)

    def update(self, state: Any, problem: Problem) -> Any:
        """Build the state for new numbers, and reuse levels, colours and permutations of a fixed order."""
        if not state.plan.is_fixed:
            return self.prepare(problem)
        return self._build_state(problem, state.plan, state)

    def _build_state(self, problem: Problem, order: Order, before: Any) -> SweepState:
        """Build the state; `before` is the state of a problem of the same structure and order, or None."""
        return SweepState(problem, problem.csr_data, order)


# Capabilities that sweeps share; the specs of the solvers replace fields.
SWEEPS = SolverSpec(
    name="sweeps",
    factory=Sweeping,
    laws=frozenset(LAWS),
    box_friction_laws=frozenset({"coulomb", "cone"}),
    operators=frozenset(OPERATORS),
    order=True,
    seed=True,
    supports_rolling=True,
    summary="sweeps over blocks",
)
