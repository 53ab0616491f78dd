"""Sweeps under Coulomb's law, and whenever they cost as much a short walk of Newton's method from where they stand.

Sweeps soon find which contacts stick, slide and lift, and then need long for what these carry, which Newton's method on
the Alart-Curnier map has in a few steps. From elsewhere it gets nowhere: a walk is short, and the next one begins
when sweeps have cost as much again. Before they give way to the solvers that factor from the start, sweeps of another
kind begin anew, with walks of their own: which of both ends soon is a matter of luck.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender.problem import Problem
from lavender.registry import FEW
from lavender.solution import Claim, Status
from lavender.solvers import _rates as rates
from lavender.solvers._counts import dense_factor, filled, newton_factor
from lavender.solvers._newton.desaxce import apart
from lavender.solvers._newton.proximal import Proximal
from lavender.solvers._newton.run import Run
from lavender.solvers._newton.systems import AUGMENTED, DENSE_ROWS, System, is_full
from lavender.solvers._sweepers import SWEEPER, Glance, Sweeps
from lavender.solvers._trail import Trail

__all__ = ["OTHER", "Walks", "in_turns", "sweeps_of"]

WALK = 8  # factorisations of a walk,
EARLY, GAIN = 3, 0.95  # of which so many have to leave that share of the residual
READY = 0.25  # of a walk's cost, that sweeps have to have cost where they give way to another solver
OTHER: dict[str, Any] = {"name": "nncg", "order": "symmetric", "restart": "against"}
STEPS = 6  # Newton steps of one of a walk's proximal rounds
WEIGHT = 1e-6  # proximal weight there at most
OWN = 400  # sweeps from which others begin anew
MOST = 40_000  # rows from which friction is left to sweeps


class Walks(Sweeps):
    """Sweeps that walk; `budget` iterations of the whole solve."""

    def __init__(
        self, trail: Trail, budget: int, name: str = SWEEPER, glance: Glance | None = None, **options: Any
    ) -> None:
        super().__init__(trail, name, glance, **options)
        self.budget = budget
        self.walked = 0  # iterations that were done before the last walk

    def look(self, step: int) -> float:
        """As of all sweeps, and a walk where one is due; the sweeps stay where they are."""
        now = super().look(step)
        if now > self.trail.tol and not self.ended and self._due(1.0):
            now = min(now, self._walk())
        return now

    def give_way(self) -> bool:
        """Before solvers that cost more: a walk, and sweeps of another kind from the beginning; is the trail done."""
        trail = self.trail
        if not self.ended and self._due(READY):
            self._walk()
        if trail.done or self.name == OTHER["name"] or not OWN < self.done < self.budget:
            return trail.done
        other = Walks(trail, self.budget, **OTHER)
        other.impulse, other.last = trail.problem.start(), 1.0
        if not other.run(self.budget) and not other.ended and other._due(READY):
            other._walk()
        return trail.done

    @property
    def since(self) -> float:
        """Cost of the sweeps since the last walk [ns]."""
        return (self.done - self.walked) * self.per

    def _due(self, share: float) -> bool:
        """Sweeps since the last walk cost that share of one, and promise no end within its cost."""
        trail = self.trail
        if trail.late or self.since < share * WALK * least_step(trail.problem):
            return False
        cost = WALK * walk_step(trail.costs.system)
        return self.since >= share * cost and self.cost > cost

    def _walk(self) -> float:
        """From where the sweeps stand; the relative residual of its best."""
        trail, system = self.trail, self.trail.costs.system
        allowed = max(self.since, WALK * walk_step(system))
        most = min(WALK, self.budget - trail.iterations - (self.done - self.begun))
        self.walked = self.done
        if most <= 0 or not system.sc.has_friction:
            return np.inf
        system.factorisations = 0
        z = system.sc.unknown(self.impulse)
        run = _Walk(system, trail.tol, most, trail.deadline, allowed=allowed)
        run.start = relative = run.score(z)
        apart(run, Proximal(z, AUGMENTED, min(WEIGHT, relative), STEPS), most)
        count = system.factorisations
        self.aside += count * walk_step(system)
        self.note()
        trail.add("newton's walk", Claim(Status.MAX_ITERATIONS, count, {"factorisations": count}))
        return trail.offer(system.sc.impulse(run.best_z))


@dataclass
class _Walk(Run):
    """One walk, of steps that cost no more than is `allowed` [ns]: what one costs, the first factor tells."""

    allowed: float = np.inf
    start: float = np.inf  # residual that it began with

    def spent(self) -> bool:
        done = self.system.factorisations
        if done >= EARLY and self.best > GAIN * self.start:
            return True
        return (done > 0 and (done + 1) * walk_step(self.system) > self.allowed) or super().spent()


def walk_step(system: System) -> float:
    """One step of a walk [ns]."""
    return (
        rates.STEP["newton"]
        + rates.NEWTON_ROW["coulomb"] * system.sc.m
        + rates.UNSYMMETRIC * newton_factor(system)
    )


def least_step(problem: Problem) -> float:
    """What a step of a walk costs at least [ns], before its system is made."""
    m = problem.m
    found = rates.STEP["newton"] + rates.NEWTON_ROW["coulomb"] * m
    if problem.matrix is not None and m > DENSE_ROWS:
        nnz = len(problem._compressed[1])
        if is_full(nnz, m, False):
            return found + rates.UNSYMMETRIC * float(dense_factor(m))
        return found + rates.UNSYMMETRIC * filled(nnz, 0.0)
    return found


def sweeps_of(trail: Trail, budget: int, **options: Any) -> Sweeps:
    """Those that a problem has first: with walks under Coulomb's law, where A is at hand."""
    problem = trail.problem
    if problem.law != "coulomb" or problem.generalized is not None or not FEW < problem.m < MOST:
        return Sweeps(trail, **options)
    return Walks(trail, budget, **options)


def in_turns(trail: Trail, sweeps: Sweeps, budget: int) -> bool:
    """Few rows, where sweeps gave way: others from the beginning and these in turns, each from where it stood.

    Twice as many in each turn as were done, as long as that is counted for less than a finite solver; True when nothing
    is left to do.
    """
    other = Sweeps(trail, **OTHER)
    other.impulse, other.last = trail.problem.start(), 1.0
    while sweeps.done * sweeps.per <= trail.costs.cheapest:
        before = trail.iterations
        for each in (other, sweeps):
            if each.run(budget, cap=2 * sweeps.done):
                return True
        if trail.iterations == before:
            break  # nobody is left
    return trail.done
