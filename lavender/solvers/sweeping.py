"""What every sweep solver shares: an order, a count of sweeps, and residual checks.

The checks are in `lavender_ext/judge/watch.pxd`. They use the judge's arithmetic; each comes half way to the expected
end, so their places depend only on the numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lavender.base.arrays import FloatArray
from lavender.judge.residuals import get_reference
from lavender.judge.solution import Claim, Status
from lavender.problem import Problem
from lavender.problem.ordering import Order, block_order
from lavender.solvers.registry import Solver
from lavender.solvers.setup_times import forming, ordered
from lavender_ext.judge.watch import AT_FLOOR, CONVERGED, DIVERGED, RUNNING, STALLED, Watch
from lavender_ext.sweep import serial

STATUS = {
    RUNNING: Status.MAX_ITERATIONS,
    CONVERGED: Status.CONVERGED,
    DIVERGED: Status.DIVERGED,
    STALLED: Status.STALLED,
    AT_FLOOR: Status.ROUNDOFF_LIMIT,
}
PATIENCE = 64  # sweeps that may always pass without a better check


def watch_over(problem: Problem, data: Any, patience: int) -> Watch:
    """The watch of a run over `data`; of A that was formed of J and M, the form that was given has the last word."""
    formed = problem.matrix is None and not (data.factored or data.is_general)
    return Watch(data, patience, problem.metric if formed else None)


class SweepState:
    """State of a run; the watch counts sweeps and keeps the best checked iterate."""

    def __init__(
        self, problem: Problem, data: Any, order: Order, sweeps: Any = None, patience: int = PATIENCE
    ) -> None:
        self.problem = problem
        self.data = data  # lavender_ext.core.problem.Data that the kernel sweeps over, and that checks read
        self.order = self.plan = order  # `plan` is of the problem's own blocks
        get_reference(problem)
        data.share_reference(problem.metric)  # residuals in any form are relative to the judge's reference
        self.watch = watch_over(problem, data, patience)
        # What the kernel runs over, a `lavender_ext.sweep.serial.Sweeps`; of blocks as they stand, relaxed, by default.
        self.sweeps = serial.Sweeps(data, *plan_of(order)) if sweeps is None else sweeps

    @property
    def best(self) -> tuple[float, FloatArray | None]:
        """(relative residual, impulse) of the best check."""
        return self.watch.best

    @property
    def sweeps_per_decade(self) -> float:
        """Sweeps in which the residual falls tenfold; NaN if it does not fall."""
        return float(self.watch.sweeps_per_decade)


def claim(status: int, done: int) -> Claim:
    """The claim from what a kernel of sweeps returns: how it ended, and after how many sweeps."""
    return Claim(STATUS[status], done, {"sweeps": done})


def plan_of(order: Order) -> tuple[Any, ...]:
    """(blocks, split, mode, rng) of an order, as kernels take it."""
    return order.blocks, order.split, order.mode, order.rng


def reads_whitened(problem: Problem) -> bool:
    """Whether a sweep over J and M, twice the entries of Y, costs less than one over A, without forming A."""
    if problem.generalized is None:
        return False
    data = problem.metric
    return bool(data.work - 4 * problem.m < data.entries_of_a)  # `work` counts Y twice


def swept(problem: Problem) -> Any:
    """What sweeps run over: rows or a matrix as given; of J and M, those or A, whichever a sweep costs less on."""
    return problem.metric if reads_whitened(problem) else problem.data


def over(data: Any) -> str:
    """The form that sweeps ran over, in words."""
    return "whitened J" if data.is_general else "body velocities" if data.factored else "rows of A"


class Swept(Solver):
    """A solver whose state is a `SweepState`."""

    def run(
        self,
        state: Any,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None = None,
    ) -> Claim:
        """`max_iter` sweeps in one call of the kernel, or fewer where a check ends them; tol = 0 checks nothing."""
        status, done, again = state.sweeps.run(state.watch, impulse, max_iter, tol)
        return self._told(state, claim(status, done), again)

    def _told(self, state: Any, claim: Claim, again: int) -> Claim:
        """The claim with what else is to tell: `again` counts fallbacks of exact blocks, or restarts."""
        return claim


@dataclass(frozen=True)
class Sweeping(Swept):
    """Options and life cycle of a sweep solver over A in compressed rows."""

    order: Any = "given"
    ground: Any = None
    seed: int = 0

    def setup_time(self, problem: Problem) -> float:
        """What `prepare` takes [s], as counted."""
        return ordered(problem, self.order) + self._forming(problem)

    def _forming(self, problem: Problem) -> float:
        return forming(problem)

    def prepare(self, problem: Problem) -> Any:
        """The state at the first sweep; its order is found anew."""
        order = block_order(problem, self.order, seed=self.seed, ground=self.ground)
        return self._state(problem, order, None)

    def update(self, state: Any, problem: Problem) -> Any:
        """The state for new numbers; levels, colours and places of a fixed order are kept."""
        if not state.plan.is_fixed:
            return self.prepare(problem)
        return self._state(problem, state.plan, state)

    def _state(self, problem: Problem, order: Order, before: Any) -> SweepState:
        """`before`: the state of a problem of the same structure and order, None the first time."""
        return SweepState(problem, problem.csr_data, order)
