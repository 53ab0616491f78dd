"""What every sweep solver shares: an order, a count of sweeps, and checks at fixed counts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lavender._arrays import FloatArray
from lavender.ordering import Order, block_order
from lavender.problem import Problem
from lavender.residuals import quick
from lavender.solution import Claim, Status

GROWTH = 1e6  # relative residual this much above its start means divergence
PATIENCE = 8  # times the sweeps of the best check, without a better one, means stalled


def next_check(n: int) -> int:
    """Sweeps at the check after n: 1, 2, ... 16, then an eighth more each time; a check costs about a sweep."""
    return n + max(1, n >> 3)


@dataclass
class SweepState:
    """Where a run stands. `best` is the best checked (relative residual, impulse)."""

    problem: Problem
    data: Any  # lavender_ext.problem.Data that the kernel sweeps over
    order: Order
    velocity: FloatArray | None = None  # (n + 1, 6) M^-1 J^T lambda, sequential impulses only
    total: int = 0
    check_at: int = 0
    start: float = 0.0  # relative residual at the first check
    best: tuple[float, FloatArray | None] = (np.inf, None)
    best_at: int = 0
    w: FloatArray = field(init=False)  # (m,) scratch
    e: FloatArray = field(init=False)  # (m,) scratch

    def __post_init__(self) -> None:
        self.w = np.empty(self.problem.m)
        self.e = np.empty(self.problem.m)

    @property
    def first(self) -> bool:
        return self.total == 0

    def check(self, impulse: FloatArray, tol: float) -> Status | None:
        """Status that ends the run here, or None; sets the next check."""
        relative, _ = quick(self.problem, impulse, self.w, self.e)
        if self.total == 0:
            self.start = relative
        self.check_at = next_check(self.total)
        if relative <= tol:
            return Status.CONVERGED
        if relative < self.best[0]:
            self.best = (relative, impulse.copy())
            self.best_at = self.total
            return None
        if not np.isfinite(relative) or relative > GROWTH * max(self.start, 1.0):
            return self._end(impulse, Status.DIVERGED)
        # No better than before: perhaps rounding is all that is left.
        if self.best[0] <= 1e-6 and self.best[1] is not None:
            best, floor = quick(self.problem, self.best[1], self.w, self.e, floor=True)
            if best <= 2.0 * floor:
                return self._end(impulse, Status.FLOOR)
        if self.total > PATIENCE * self.best_at + 64:
            return self._end(impulse, Status.STALLED)
        return None

    def _end(self, impulse: FloatArray, status: Status) -> Status:
        if self.best[1] is not None:
            impulse[:] = self.best[1]
        return status


def run_sweeps(
    state: SweepState, impulse: FloatArray, n: int, tol: float, sweep: Callable[[int], None]
) -> Claim:
    """n sweeps, or fewer where a check ends them; tol = 0 checks nothing."""
    done = 0
    status = Status.MAX_ITERATIONS
    while done < n:
        if tol > 0.0 and state.total == state.check_at:
            found = state.check(impulse, tol)
            if found is not None:
                status = found
                break
        step = min(n - done, state.check_at - state.total) if tol > 0.0 else n - done
        sweep(step)
        done += step
        state.total += step
    return Claim(status, done, {"sweeps": done})


@dataclass(frozen=True)
class Sweeping:
    """Options and life cycle of a sweep solver over A in compressed rows."""

    order: Any = "given"
    ground: Any = None
    seed: int = 0

    def prepare(self, problem: Problem) -> SweepState:
        order = block_order(problem, self.order, seed=self.seed, ground=self.ground)
        return SweepState(problem, problem.csr_data, order)

    def update(self, state: SweepState, problem: Problem) -> SweepState:
        # Levels and colours come from the structure, but are cheap beside a sweep; made anew they are never stale.
        return self.prepare(problem)
