"""Stages of `auto` for a problem, from estimated costs; `auto.py` has the rule, `decisions.py` its numbers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count, islice
from math import inf, nan
from typing import Any

import numpy as np

from lavender.base.deadline import NEVER, Deadline, format_seconds
from lavender.base.errors import BREAKDOWN
from lavender.problem import Problem
from lavender.problem.derived import cached_property
from lavender.solvers.costs import (
    RATES,
    estimate_first_factor_cost,
    estimate_formation_cost,
    get_loose_limit,
)
from lavender.solvers.decisions import DECISIONS
from lavender.solvers.newton import NewtonState
from lavender.solvers.newton_systems.systems import find_bodies
from lavender.solvers.registry import get
from lavender.solving.log import get_relaxation
from lavender.solving.steps import STEP_CLASSES, Iterations, Step, make_solver


@dataclass(frozen=True)
class Stage:
    """One stage of the tree."""

    solver: str  # Name of a step, which begins with the solver's, or "certificate".
    iterations: float  # Largest number of iterations.
    cost: float  # [ns] Estimated cost of these iterations.
    why: str  # Reason, for `lavender.explain`.
    least: float = (
        inf  # Sweeps stop if they predict that more than this number of sweeps is still needed.
    )
    position: int = (
        0  # Among the stages after which only unsolved islands continue; 0 for other stages.
    )


class DecisionTree:
    """The stages of `auto` for a problem, as an iterable, their steps, and the costs that it compares [ns].

    `log.best` is the smallest relative residual so far; without a log, no stage runs. Stages before `first_stage` have
    run on a problem with more islands. `call_failed`: the compiled call over velocities of J and M has failed, which
    perhaps started from the zero impulse. `has_swept`: sweeps have had their share before the first stage.
    """

    def __init__(
        self,
        problem: Problem,
        deadline: Deadline = NEVER,
        log: Any = None,
        first_stage: int = 1,
        *,
        call_failed: bool = False,
        started_from_zero: bool = False,
        has_swept: bool = False,
    ) -> None:
        self.compiled_call_failed = call_failed
        self.started_from_zero = started_from_zero
        self.has_swept = has_swept
        # Time of counted work on this machine as a multiple of its cost.
        self.pace = 1.0 if has_swept else DECISIONS.assumed_pace
        self.remaining_cost = 0.0  # [ns] Cost that the alternation may still use.
        self.sweeps_failed = (
            False  # Whether sweeps did not improve the residual in the alternation.
        )
        self.is_analysed = False  # Whether Newton's matrix has been analysed.
        self._newton_state: NewtonState | None = None
        self.problem = problem
        self.law = problem.law
        self.deadline = deadline
        self.log = log
        self.first_stage = first_stage
        self.steps = dict[str, Step]()
        self.sweep = make_solver("anderson", problem).estimate_iteration_cost(
            problem
        )  # [ns] Cost of one sweep.
        self.first = DECISIONS.first_sweeps * self.sweep  # [ns] Cost of the first sweeps.
        # [ns] Lower bound of the cost of Newton's method, without its analysis.
        self.min_newton_cost = make_solver("newton", problem).estimate_total_cost(problem)

    @property
    def best(self) -> float:
        """Smallest relative residual so far; NaN if no stage runs."""
        return nan if self.log is None else float(self.log.best)

    def get_step(self, name: str) -> Step:
        """Return the step of a solver, which is created when it is first needed."""
        if name not in self.steps:
            self.steps[name] = STEP_CLASSES.get(name, Iterations)(name, self.log, self)
        return self.steps[name]

    @cached_property
    def is_large(self) -> bool:
        """Return whether the convex relaxation is solved first, as on large problems under Coulomb's law.

        Of J and M, this requires that the velocities belong to free bodies. Over the rows of a sparse A, Newton's
        method on Coulomb's law takes fewer steps than on the relaxation.
        """
        problem = self.problem
        large = problem.law == "coulomb" and problem.m >= DECISIONS.relaxed_rows
        if not large or problem.cones.has_round or not problem.is_symmetric:
            return False
        return problem.generalized is None or find_bodies(problem) is not None

    @cached_property
    def relaxed_sweep(self) -> float:
        """Cost of one sweep over the convex relaxation [ns]."""
        relaxation = get_relaxation(self.problem)
        return float(make_solver("anderson", relaxation).estimate_iteration_cost(relaxation))

    @property
    def newton_state(self) -> NewtonState | None:
        """Newton's method after its analysis; None if it refuses the problem, fails or would end after the deadline."""
        if not self.is_analysed:
            spec = get("newton")
            if not spec.refuses(self.problem) and self.has_time("newton", self.min_newton_cost):
                with suppress(*BREAKDOWN):
                    self._newton_state = spec.load()().prepare(self.problem)
            self.is_analysed = True
        return self._newton_state

    def give_back(self, stage: Stage) -> None:
        """Let the alternation use the cost of a stage that does not run."""
        self.remaining_cost += stage.cost

    @cached_property
    def has_cheap_newton(self) -> bool:
        """Whether Newton's method over bodies that touch at several points costs so little that no sweeps precede it.

        Bodies with one contact for each pair, as in piles of balls, fill the factor, so their sweeps need no analysis.
        """
        rows = self.problem.rows
        if rows is None:
            return False
        body = rows.contact_body.astype(np.int64)
        if len(body) < DECISIONS.face_contacts * len(
            np.unique(body[:, 0] * (1 << 32) + body[:, 1])
        ):
            return False
        state = self.newton_state
        return state is not None and state.cost < DECISIONS.cheap_newton * self.relaxed_sweep

    @property
    def solver_costs(self) -> dict[str, float]:
        """Estimated costs [ns] of the factorising solvers, the cheapest first; a failed `newton` comes last."""
        found = {} if self.newton_state is None else {"newton": self.newton_state.cost}
        if self.direct < inf:
            found["direct"] = self.direct
        failed = "newton" if self.compiled_call_failed else ""
        return dict(sorted(found.items(), key=lambda item: (item[0] == failed, item[1])))

    @cached_property
    def direct(self) -> float:
        """Cost of `direct` [ns] and to form A, cached or not, for bounded rows, or linear ones of bodies; else inf.

        It is inf also if A is neither given nor cheap.
        """
        if self.law != "lcp" and (self.law != "linear" or self.problem.rows is None):
            return inf
        formation = estimate_formation_cost(self.problem, self.problem.matrix is not None)
        is_cheap = formation <= (self.first if self.law == "lcp" else self.min_newton_cost)
        if not is_cheap or not self.deadline.fits(formation / DECISIONS.time_share):
            return inf
        return formation + float(
            make_solver("direct", self.problem).estimate_total_cost(self.problem)
        )

    @property
    def newton(self) -> float:
        """Cost of the cheapest factorising solver [ns]; inf if none is possible."""
        return min(self.solver_costs.values(), default=inf)

    @property
    def unit(self) -> float:
        """Cost [ns] of the cheapest factorising solver, or of the first sweeps if there is none."""
        return self.newton if self.newton < inf else self.first

    def has_time(self, name: str, cost: float, before: float = 0.0) -> bool:
        """Return whether a factorising solver of this cost [ns] ends in time if it starts after `before` [ns]."""
        fits = self.deadline.fits
        needed = before + self.pace * cost
        if name == "newton" and self.is_analysed:
            return fits(needed)
        loose = get_loose_limit(self.problem)
        if fits(loose + needed):
            return True
        return fits(make_solver(name, self.problem).estimate_setup_cost(self.problem) + needed)

    def leaves_time(self, stage: Stage, step: Step) -> bool:
        """Return whether a stage can end before the deadline; sweeps end by themselves after their share."""
        if stage.solver == "anderson":
            return True
        if self.newton_state is not None and stage.solver.startswith("newton"):
            return self.has_time("newton", self.newton_state.cost)
        if stage.solver == "direct":
            return self.has_time("direct", self.direct if self.direct < inf else stage.cost)
        if step.state is not None:
            return True
        setup = make_solver(stage.solver, self.problem).estimate_setup_cost(self.problem)
        return self.deadline.fits(setup / DECISIONS.time_share)

    @cached_property
    def factorises_first(self) -> bool:
        """Whether a factorising solver costs less than the first sweeps, or sweeps do not accept the problem.

        The cost to factor a sparse A depends on its fill-in, which only an analysis computes. Before the first sweeps,
        therefore, only the costs of `direct` and of Newton's method over bodies or velocities are compared.
        """
        p = self.problem
        if self.law == "linear" or p.cones.has_round or self.direct < self.first:
            return True
        # Started at the same point as a failed compiled call, Newton's method would stall again.
        if self.compiled_call_failed or p.matrix is not None:
            return False
        return self.min_newton_cost < self.first and self.newton < self.first

    def __iter__(self) -> Iterator[Stage]:
        """Yield the stages in order. The caller runs a stage only if the stages before it did not solve the problem."""
        p, ratio, first = self.problem, DECISIONS.budget_ratio, self.first
        if p.matrix is not None and self.law == "linear":
            yield Stage("direct", inf, self.min_newton_cost, "linear, a matrix")
        if self.is_large:
            yield from self.iterate_relaxed_stages()
        max_cost = self.min_newton_cost if self.law == "linear" else first
        pivots_first = self.factorises_first and self.direct < max_cost
        if pivots_first:
            n = ratio * DECISIONS.pivot_factorisations
            yield Stage("direct", n, ratio * self.direct, "a narrow band: before any analysis")
        elif not (self.is_large or self.factorises_first):
            yield self.sweeps(first, "the first sweeps, before any analysis")
        if not self.is_large and not self.factorises_first and first < self.newton < inf:
            why = f"up to {format_seconds(1e-9 * self.newton)}, as much as {next(iter(self.solver_costs))} costs"
            yield self.sweeps(self.newton - first, why, self.newton)
        if p.generalized is not None and not np.all(p.compliance):
            yield from islice(self.iterate_factorising_stages(0.25 * ratio), 1)
            # The certificate's smallest violation is computed over velocities.
            cost = self.newton if self.newton_state is None else self.newton_state.cost
            yield Stage(
                "certificate", 1.0, cost, "whether the least violation proves that there is none"
            )
        if not self.is_large:
            for stage in self.iterate_factorising_stages(ratio):
                if not (pivots_first and stage.solver == "direct"):  # It has had this budget.
                    yield stage
            cost = RATES["linear program"]
            if self.law == "coulomb" and p.generalized is None and ratio * self.unit >= cost:
                yield Stage("certificate", 1.0, cost, "whether a linear program proves it")
        yield from self.iterate_alternating_stages()

    def iterate_relaxed_stages(self) -> Iterator[Stage]:
        """Yield the first stages of a large problem with friction, unless they have run on a larger problem."""
        if self.first_stage <= 1 and not self.has_cheap_newton:
            cost = self.min_newton_cost
            yield Stage(
                "anderson", inf, cost, "before any analysis", cost / self.relaxed_sweep, position=1
            )
        state = self.newton_state
        if state is None:
            return
        if self.first_stage <= 2 and not self.has_cheap_newton:
            why = f"up to {format_seconds(1e-9 * state.cost)}, as much as newton costs"
            yield Stage(
                "anderson", inf, state.cost, why, least=state.cost / self.relaxed_sweep, position=2
            )
        if self.first_stage <= 3:
            n = DECISIONS.relaxed_ratio * state.steps
            why = "exact if no contact slips"
            yield Stage("newton on the relaxation", n, state.cost, why, position=3)
        if self.log is None or self.log.relaxed is not None:
            n = DECISIONS.trial_iterations
            why = "from the relaxation, while it is predicted to end soon"
            yield from self.repeat_while_converging(
                Stage("admm", n, n * self.relaxed_sweep, why), 2
            )

    def iterate_factorising_stages(self, times: float) -> Iterator[Stage]:
        """Yield stages of the factorising solvers; each may cost `times` the estimated cost of the cheapest of them."""
        budget = times * self.newton
        for name, cost in self.solver_costs.items():
            if cost <= budget:
                why = f"{times:.3g} times its estimated cost of {format_seconds(1e-9 * cost)}"
                yield self.factorisation(name, times * cost, why)

    def iterate_alternating_stages(self) -> Iterator[Stage]:
        """Yield all solvers in rounds with doubled work, until no solver improves the residual in two rounds."""
        self.remaining_cost = DECISIONS.total_ratio * self.unit
        times = DECISIONS.budget_ratio
        if self.is_large:
            turn = DECISIONS.cheap_turn if self.has_cheap_newton else DECISIONS.turn_factorisations
            times = turn / DECISIONS.factorisations
        for k in count():
            before = self.best
            for stage in self.iterate_one_round(times * 2.0**k):
                if self.remaining_cost < 1.0:  # Less than 1 ns remains.
                    return
                fraction = min(1.0, self.remaining_cost / stage.cost)
                self.remaining_cost -= fraction * stage.cost
                yield replace(
                    stage, iterations=fraction * stage.iterations, cost=fraction * stage.cost
                )
            if k > 0 and self.best >= before:
                return

    def iterate_one_round(self, times: float) -> Iterator[Stage]:
        """Yield one round, in which each solver may cost `times` the cheapest factorising solver."""
        p = self.problem
        cost = times * self.unit
        setup = 0.0
        why = f"in turn, {times:.3g} times the cheapest factorising solver's cost"
        yield from (self.factorisation(name, cost, why) for name in self.solver_costs)
        if self.is_large:
            # An iteration costs as much as a sweep under the cone law.
            n = DECISIONS.admm_fraction * cost / self.relaxed_sweep
            yield from self.repeat_while_converging(
                Stage("admm", n, DECISIONS.admm_fraction * cost, why)
            )
            return
        n = 0.5 * cost / self.sweep  # An iteration of `admm` costs as much as two sweeps.
        if p.generalized is not None:
            # `admm` forms and factors A of J and M. Its set-up cost does not depend on cached data.
            setup = estimate_formation_cost(p, False)
            setup += estimate_first_factor_cost(p.m, float(p.metric.entries_of_matrix))
        if setup <= cost:
            yield from self.repeat_while_converging(Stage("admm", n, cost, why))
        if not self.sweeps_failed and not p.cones.has_round:
            before = self.best
            yield self.sweeps(cost, why)
            self.sweeps_failed = self.best >= before

    def repeat_while_converging(self, stage: Stage, max_more: int = 1) -> Iterator[Stage]:
        """Yield a stage, on large problems with friction repeatedly: while `max_more` of the same gain reach tol."""
        is_converging = True
        while is_converging:
            before = self.best
            yield stage
            gains = self.is_large and self.best < before
            is_converging = gains and self.best * (self.best / before) ** max_more <= self.log.tol

    def factorisation(self, name: str, cost: float, why: str) -> Stage:
        """Return the stage of a factorising solver with the budget `cost` [ns]."""
        steps = DECISIONS.pivot_factorisations
        if name == "newton" and self.newton_state is not None:
            steps = self.newton_state.steps
        return Stage(name, cost / self.solver_costs[name] * steps, cost, why)

    def sweeps(self, cost: float, why: str, max_remaining: float = inf) -> Stage:
        """Return a stage of sweeps that may cost `cost` [ns]; it ends if more than `max_remaining` is predicted."""
        return Stage("anderson", cost / self.sweep, cost, why, max_remaining / self.sweep)
