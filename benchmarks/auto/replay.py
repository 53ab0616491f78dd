"""The schedule of `auto` on recorded curves: what a solve would have taken, by other rates too, without solving.

The candidates are those of `lavender/solvers/methods.py`, with a curve in place of a solver; turns, remainders and
their order are made by the same code. Beside the curves' own times a call and each turn cost what Python takes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from types import SimpleNamespace
from typing import Any

from benchmarks.auto.curves import LEVELS, Curve
from benchmarks.auto.regret import SHIFT
from lavender import registry
from lavender.deadline import NEVER
from lavender.solution import Claim, Status
from lavender.solvers.costs import METHODS, Costs, candidates
from lavender.solvers.methods import FIRST, Candidate
from lavender.solvers.schedule import race
from lavender.solvers.structure import Structure
from lavender_ext.small.checked_sweeps import sweeps_left

__all__ = ["CALL", "TURN", "regret", "replayed"]

# s that Python takes for a solve by any of them, for what `auto` counts before, and for each turn and look
CALL, COUNTED, TURN = 35e-6, 45e-6, 20e-6
LOST = 100.0  # times the best, that a solve which does not end counts for


class Replayed(Candidate):
    """A candidate whose turns are read off a curve, to `level`."""

    def __init__(self, name: str, log: Any, costs: Any, curve: Curve, level: float) -> None:
        super().__init__(name, log, costs, registry.get(METHODS[name][0]))
        self.tape: Any = log
        self.curve, self.level = curve, level
        self.is_finite = not self.spec.resumable
        self.done, self.seconds, self.relative, self.rest_of = 0, 0.0, 1.0, math.inf

    def at(self, n: int) -> tuple[float, float]:
        """CPU time [s] and residual after n iterations, between the points of the curve."""
        before = (0, self.curve.setup, 1.0)
        for point in self.curve.points:
            if point[0] > n:
                if self.is_finite or point[0] == before[0]:  # a run is cut, its residual unknown
                    return point[1] * n / max(point[0], 1), 1.0
                share = (n - before[0]) / (point[0] - before[0])
                return before[1] + share * (point[1] - before[1]), before[2]
            before = point
        return before[1], before[2]

    def turn(self, n: int) -> Claim:
        end = self.curve.iterations(self.level)
        last = self.curve.points[-1][0] if self.curve.points else 0
        begun = self.done
        spent = self.at(begun)[0] if begun else 0.0
        total, now = begun + n, begun
        while now < total:
            now = min(total, now + max(now // 2, FIRST)) if self.name == "anderson" else total
            self.tape.seconds += TURN
            if now >= end or now > last:
                break
            if self.name == "anderson" and self._gives_way(now):
                break
        solved = now >= end
        seconds = self.curve.time(self.level) if solved else self.at(now)[0]
        self.tape.seconds += seconds - spent
        self.tape.solved = self.tape.solved or solved
        self.done = now
        stuck = not solved and now > last
        return Claim(Status.STALLED if stuck else Status.MAX_ITERATIONS, now - begun)

    def _gives_way(self, now: int) -> bool:
        before, at = self.relative, self.done
        self.relative = self.at(now)[1]
        self.rest_of = sweeps_left(now - at, before, self.relative, self.level) * self.cost.each
        self.done = now
        return self.rest_of > self.others

    def promise(self) -> float:
        return self.rest_of if self.name == "anderson" else 0.0


def replayed(
    structure: Structure, curves: Mapping[str, Curve], level: float, rates: Mapping[str, Any] | None = None
) -> float:
    """What `auto` would take to `level` [s], by these rates; inf where no candidate gets there.

    Parameters
    ----------
    structure : of the problem
    curves : candidate -> its curve
    rates : as in `rates.json`, which is read if None
    """
    log = SimpleNamespace(
        problem=structure.problem, deadline=NEVER, left=2**31, best=1.0, seconds=CALL + COUNTED, solved=False,
        ends_late=lambda cost: False, note=lambda *what: None,
    )  # fmt: skip
    costs = Costs(structure.problem, level, rates, structure)
    found: list[Candidate] = []
    for name in candidates(structure):
        over = name == "newton" and structure.problem.generalized is not None
        curve = curves.get("newton over velocities" if over else name)
        if curve is not None and curve.points:
            found.append(Replayed(name, log, costs, curve, level))
    race(list(found), lambda: log.solved)
    return log.seconds if log.solved else math.inf


def regret(
    cases: Iterable[tuple[Structure, Mapping[str, Curve]]], rates: Mapping[str, Any] | None = None
) -> list[float]:
    """(t + SHIFT) / (t_best + SHIFT) of each case and level that somebody ended, replayed by these rates."""
    found = []
    for structure, curves in cases:
        for level in LEVELS:
            best = CALL + min(curve.time(level) for curve in curves.values())
            if math.isfinite(best):
                t = min(replayed(structure, curves, level, rates), LOST * best)
                found.append((t + SHIFT) / (best + SHIFT))
    return found
