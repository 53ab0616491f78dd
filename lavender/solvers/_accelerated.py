"""What `nncg` and `anderson` share: sweeps over rows of A, body velocities or J and M, by `pgs` or by exact blocks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from lavender.base.errors import InputError, check_name
from lavender.judge.solution import Claim
from lavender.problem import Problem
from lavender.problem.ordering import Order, block_order
from lavender.solvers.setup_times import forming
from lavender.solvers.sweeping import Sweeping, SweepState, over, plan_of, reads_whitened, swept
from lavender_ext.accelerate import accelerated
from lavender_ext.core.order import SYMMETRIC

SWEEPS = ("pgs", "blocks")
LARGEST_MEMORY = 16
PATIENCE = 500  # iterations: on mass ratios the residual of a conjugate gradient rises for hundreds first
# Entries of A for each row, and in all, up to which its rows are faster than body velocities (measured: 1.65 times as
# fast at 300 to 8,000 rows of 16 entries, 1.4 at 1,600 of 26, 1.1 to 1.25 at 27,570 of 17, which leave the
# second-level cache).
NEIGHBOURS, ENTRIES = 40, 600_000
CONVEX_OPTION = "iterations under the cone law first, for piles that stick; default 0"
SWEEP_OPTION = (
    "'pgs' or 'blocks' (each contact and joint solved exactly); default: pgs, blocks for the cone law"
)


class AcceleratedState(SweepState):
    """A sweep state with the memory of the acceleration."""

    def __init__(
        self, problem: Problem, data: Any, order: Order, exact: bool, memory: int, convex: int, keeps: bool
    ) -> None:
        sweeps = accelerated.AcceleratedSweeps(data, *plan_of(order), exact, memory, convex, keeps)
        super().__init__(problem, data, order, sweeps, PATIENCE)
        self.exact = exact


@dataclass(frozen=True)
class Accelerated(Sweeping):
    """Life cycle of an accelerated sweep; `memory` 0 is nncg."""

    sweep: str | None = None
    convex: int = 0

    @property
    def _memory(self) -> int:
        return 0

    @property
    def _keeps(self) -> bool:
        return False

    def prepare(self, problem: Problem) -> AcceleratedState:
        """Order, memory, and each block's own part of A where blocks are solved exactly."""
        self._check(problem)
        state: AcceleratedState = super().prepare(problem)
        return state

    def _forming(self, problem: Problem) -> float:
        over_a = _entries(problem) is not None or not (problem.rows is not None or reads_whitened(problem))
        return forming(problem) if over_a else 0.0

    def _check(self, problem: Problem) -> None:
        if self.sweep is not None:
            check_name("sweep", self.sweep, SWEEPS)
        if self.sweep == "pgs" and problem.law == "cone":
            raise InputError("sweep='pgs' has no update for the cone law; sweep='blocks' has")
        if not isinstance(self.convex, int) or self.convex < 0:
            raise InputError(f"convex is {self.convex!r}; a whole number of iterations >= 0 is needed")

    def _state(self, problem: Problem, order: Order, before: AcceleratedState | None) -> AcceleratedState:
        return self._over(problem, order, operator(problem))

    def _over(self, problem: Problem, order: Order, data: Any) -> AcceleratedState:
        exact = self.sweep == "blocks" or (self.sweep is None and problem.law == "cone")
        convex = self.convex if problem.law == "coulomb" else 0
        return AcceleratedState(problem, data, order, exact, self._memory, convex, self._keeps)

    def _told(self, state: AcceleratedState, claim: Claim, again: int) -> Claim:
        done = claim.iterations
        work = {"sweeps": 2 * done if state.order.mode == SYMMETRIC else done, "restarts": again}
        sweep = "blocks" if state.exact else "pgs"
        return replace(claim, work=work, form=f"{sweep} on {over(state.data)}")


def as_given(solver: Accelerated, problem: Problem) -> AcceleratedState:
    """The state of sweeps over the form that is given: A is not formed."""
    return solver._over(problem, block_order(problem, solver.order), problem.metric)


def operator(problem: Problem) -> Any:
    """The form that sweeps run over: rows of A if contacts have one row and few neighbours, otherwise as given.

    For contacts of one row, rows of A cost as much as body velocities, and mixing does not recompute velocities.
    """
    return swept(problem) if _entries(problem) is None else problem.csr_data


def sweep_work(problem: Problem) -> int:
    """Rough number of multiply-adds of one sweep, over what it runs over (`Data.work`), without forming that."""
    entries = _entries(problem)
    if entries is None and problem.generalized is not None and not reads_whitened(problem):
        entries = min(int(problem.metric.entries_of_a), problem.m**2)
    return int(swept(problem).work) if entries is None else entries + 4 * problem.m


def _entries(problem: Problem) -> int | None:
    """The most entries of A for which sweeps over its rows are faster than over body velocities."""
    rows = problem.rows
    if rows is None or problem.law != "lcp" or rows.n_joints or problem.m > problem.n_blocks:
        return None
    entries = int(problem._n_couplings)
    return entries if entries <= min(NEIGHBOURS * problem.m, ENTRIES) else None
