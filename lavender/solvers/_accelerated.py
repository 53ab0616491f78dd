"""Base class of `nncg` and `anderson`: sweeps over rows of A, bodies or J and M, with `pgs` or exact blocks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from lavender.base.errors import InputError, check_name
from lavender.judge.solution import Claim
from lavender.problem import Problem
from lavender.problem.ordering import Order, compute_block_order
from lavender.solvers.costs import RATES, get_sweep_rate_name
from lavender.solvers.sweeping import (
    Sweeping,
    SweepState,
    choose_sweep_data,
    form_name,
    is_sweep_over_jacobian_cheaper,
    make_order_plan,
)
from lavender_ext.accelerate import accelerated
from lavender_ext.core.order import SYMMETRIC

SWEEP_NAMES = ("pgs", "blocks")
MAX_MEMORY = 16
# An accelerated sweep stops as STALLED after this many iterations without progress. At large mass ratios, the residual
# of conjugate gradients first rises for hundreds of iterations.
ACCELERATED_PATIENCE = 500
# Sweeps use the rows of A instead of body velocities up to this many entries per row and in total. Measured: rows of A
# are 1.65 times as fast at 300 to 8,000 rows of 16 entries, 1.4 times at 1,600 rows of 26, 1.1 to 1.25 times at 27,570
# rows of 17, which exceed the second-level cache.
MAX_ENTRIES_PER_ROW, MAX_SWEPT_ENTRIES = 40, 600_000
CONVEX_OPTION = (
    "iterations under the cone law before those under Coulomb's law, for piles that stick"
)
AUTOMATIC = -1  # Value of the kernel's `convex`: it selects the law by tests.
SWEEP_OPTION = (
    "'pgs' or 'blocks' (each contact and joint is solved exactly); "
    "default 'pgs', under the cone law 'blocks'"
)


class AcceleratedState(SweepState):
    """State of an accelerated sweep, with the memory of the acceleration."""

    def __init__(
        self,
        problem: Problem,
        data: Any,
        order: Order,
        exact: bool,
        convex: int,
        memory: int,
        keeps: bool,
    ) -> None:
        sweeps = accelerated.AcceleratedSweeps(
            data, *make_order_plan(order), exact, memory, convex, keeps
        )
        super().__init__(problem, data, order, sweeps, ACCELERATED_PATIENCE)
        self.exact = exact


@dataclass(frozen=True)
class Accelerated(Sweeping):
    """Base class of accelerated sweeps."""

    sweep: str | None = None
    convex: int | None = 0

    def _get_acceleration(self) -> tuple[int, bool]:
        """Return the memory of Anderson acceleration, 0 for nncg, and whether nncg restarts only against the sweep."""
        raise NotImplementedError

    def prepare(self, problem: Problem) -> AcceleratedState:
        """Build the state: sweep order, memory, and the diagonal blocks of A if blocks are solved exactly."""
        if self.sweep is not None:
            check_name("sweep", self.sweep, SWEEP_NAMES)
        if self.sweep == "pgs" and problem.law == "cone":
            raise InputError(
                "sweep='pgs' cannot solve this problem, because it has no update for the cone law: give sweep='blocks'"
            )
        if self.convex is not None and (not isinstance(self.convex, int) or self.convex < 0):
            raise InputError(
                f"convex is {self.convex!r}; a whole number of iterations >= 0 is needed"
            )
        state: AcceleratedState = super().prepare(problem)
        return state

    def estimate_iteration_cost(self, problem: Problem) -> float:
        """Estimate the cost of one sweep over the data of `choose_sweep_operator` [ns] by (2) of `costs.py`."""
        rate = RATES[get_sweep_rate_name(problem)]
        return float(RATES["sweep row"] * problem.m + rate * estimate_sweep_work(problem))

    def _build_state(
        self, problem: Problem, order: Order, before: AcceleratedState | None
    ) -> AcceleratedState:
        return self._build_state_over_data(problem, order, choose_sweep_operator(problem))

    def _build_state_over_data(self, problem: Problem, order: Order, data: Any) -> AcceleratedState:
        exact = self.sweep == "blocks" or (self.sweep is None and problem.law == "cone")
        convex = AUTOMATIC if self.convex is None else self.convex
        convex = convex if problem.law == "coulomb" else 0
        return AcceleratedState(problem, data, order, exact, convex, *self._get_acceleration())

    def _add_work_to_claim(self, state: AcceleratedState, claim: Claim, restarts: int) -> Claim:
        """Add the counts of sweeps and restarts, and the name of the form, to a claim."""
        done = claim.iterations
        work = {"sweeps": 2 * done if state.order.mode == SYMMETRIC else done, "restarts": restarts}
        sweep = "blocks" if state.exact else "pgs"
        return replace(claim, work=work, form=f"{sweep} on {form_name(state.data)}")


def build_state_in_given_form(solver: Accelerated, problem: Problem) -> AcceleratedState:
    """Return the state of sweeps over the form in which the problem was given, without forming A."""
    return solver._build_state_over_data(
        problem, compute_block_order(problem, solver.order), problem.metric
    )


def choose_sweep_operator(problem: Problem) -> Any:
    """Return the data that sweeps run over: rows of A if contacts have one row and few neighbours, else the given form.

    For contacts of one row, a sweep over rows of A costs as much as one over body velocities, and combining iterates
    needs no recomputation of velocities.
    """
    return choose_sweep_data(problem) if _max_entries(problem) is None else problem.csr_data


def estimate_sweep_work(problem: Problem) -> int:
    """Estimate the multiply-adds of one sweep over the data of `choose_sweep_operator`, without forming A."""
    entries = _max_entries(problem)
    if (
        entries is None
        and problem.generalized is not None
        and not is_sweep_over_jacobian_cheaper(problem)
    ):
        entries = min(int(problem.metric.entries_of_matrix), problem.m**2)
    return int(choose_sweep_data(problem).work) if entries is None else entries + 4 * problem.m


def _max_entries(problem: Problem) -> int | None:
    """Return the number of entries of A if sweeps over rows of A are faster than over body velocities, else None."""
    rows = problem.rows
    if rows is None or problem.law != "lcp" or rows.n_joints or problem.m > problem.n_blocks:
        return None
    entries = int(problem._couplings[0])
    return entries if entries <= min(MAX_ENTRIES_PER_ROW * problem.m, MAX_SWEPT_ENTRIES) else None
