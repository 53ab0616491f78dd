"""Sweeps under Coulomb's law race those of the convex relaxation, and others that begin where these stand.

rest = n log(now / tol) / log(before / now)         sweeps left, by the contraction of all n    (1)
"""

from __future__ import annotations

import numpy as np

from lavender.solution import Status
from lavender.solvers import _rates as rates
from lavender.solvers._patches import Patches
from lavender.solvers._sweepers import SWEEPER, Sweeps
from lavender.solvers._trail import Trail
from lavender_ext.few.looks import sweeps_left

__all__ = ["race"]

SLOW = (
    2.0  # times the cost that the relaxation promises by all that it did, at which its last look slows down
)
EARLY = 500  # sweeps of all racers together before patches begin, some rounds of theirs
STALLED = 0.6  # share of its residual that the later half of a racer's work has to leave
FOLLOWING = ("given", "symmetric")  # orders of sweeps that begin where the relaxation slows down, in turn


class Relaxed(Sweeps):
    """Sweeps of the convex relaxation, judged by Coulomb's law, whose answer it has wherever contacts stick."""

    def __init__(self, trail: Trail) -> None:
        convex = Trail(trail.problem.relaxed("cone"), trail.tol, trail.deadline, trail.limit)
        super().__init__(convex)
        self.outer = trail
        self.last = trail.best

    def look(self, step: int) -> float:
        """As of all sweeps; one that finds the relaxation solved before the first of them promises what was."""
        before, rest, at = self.done, self.rest, self.at
        now = super().look(step)
        if self.done == before:
            self.rest, self.at = rest, at
        return now

    def judge(self, status: Status) -> float:
        now = self.outer.offer(self.impulse)
        if status is Status.CONVERGED:
            self.tol *= 0.1  # solved; Coulomb's residual may follow to a closer one
        return now

    def stopped(self, status: Status) -> bool:
        return status is not Status.CONVERGED

    def note(self, prefix: str = "relaxation: ") -> None:
        trail, self.trail = self.trail, self.outer
        super().note(prefix)
        self.trail = trail


class Racer:
    """One of those that race; `before` [ns] was spent, and `best` reached, on what it goes on from."""

    def __init__(self, sweeps: Sweeps, start: float, before: float = 0.0, best: float = np.inf) -> None:
        self.sweeps, self.start, self.before, self.best = sweeps, start, before, best
        self.tol = sweeps.tol
        self.looks = 0
        self.past: list[tuple[float, float]] = []  # (spent, best) of each look

    @property
    def spent(self) -> float:
        """Cost of what it did itself [ns]."""
        return self.looks * rates.LOOK + self.sweeps.done * self.sweeps.per + self.sweeps.aside

    @property
    def promised(self) -> float:
        """Cost of what is left, by the mean contraction since the start (1) [ns]; nothing is known before a look."""
        if self.sweeps.ended:
            return np.inf
        if self.best == np.inf:
            return 0.0
        return sweeps_left(self.before + self.spent, self.start, self.best, self.tol)

    @property
    def stalls(self) -> bool:
        """The half of what it did last brought the residual down by less than STALLED."""
        before = [best for spent, best in self.past if spent <= 0.5 * self.spent]
        return bool(before) and self.best > STALLED * before[-1]

    def look(self, budget: int) -> float:
        self.looks += 1
        now = self.sweeps.look(min(self.sweeps.next_look(), budget))
        self.best = min(self.best, now)
        self.past.append((self.spent, self.best))
        return now


def race(trail: Trail, own: Sweeps, budget: int) -> bool:
    """Sweeps under Coulomb's law, those of its relaxation, and the former from where the latter slow down.

    Look by look whichever promises to cost less from there, so that none is dropped while it moves. From where the
    relaxation stands others begin whenever it did twice as much: which of them end soon is a matter of luck. Where
    even the most promising stalls, no sooner than EARLY sweeps, and few blocks hold much of the error, patches take
    turns with all of them, at the same cost, and so they do on however many before others than sweeps are asked, which
    they are not while patches gain.
    """
    relaxed = Relaxed(trail)
    start = trail.best
    relaxed.impulse[:] = trail.problem.start()
    slow = Racer(relaxed, 1.0)
    racers, followers, last = [Racer(own, start), slow], list[Sweeps](), 0
    mended: Patches | None = None

    def left() -> int:
        done = sum(r.sweeps.done for r in racers) + (0 if mended is None else mended.done)
        return budget - trail.iterations - done

    while not trail.late and left() > 0:
        racer = min(racers, key=lambda r: (r.promised, r.spent))
        if racer.sweeps.ended or racer.look(left()) <= trail.tol:
            break
        spent = sum(r.spent for r in racers)
        slows = racer is slow and slow.looks > 1 and SLOW * slow.promised < relaxed.cost
        if slows and relaxed.done >= 2 * last:
            last = relaxed.done
            racers.insert(0, Racer(_from(relaxed, own, len(followers)), 1.0, slow.spent, slow.best))
            followers.append(racers[0].sweeps)
        leaves = slow.looks > 0 and own.dearer(min(r.sweeps.cost for r in racers), spent, None)
        swept = sum(r.sweeps.done for r in racers)
        if (racer.stalls and swept >= EARLY) or leaves:
            mended = mended or Patches(trail)
            if (mended.done or leaves or mended.is_concentrated) and mended.mend(spent, left()):
                break
            if leaves and not mended.gains:
                break
    relaxed.note()
    for follower in followers:
        follower.note("from there: ")
    if mended is not None and mended.done:
        mended.note("patches, ")
    own.note()
    return trail.done


def _from(relaxed: Relaxed, own: Sweeps, count: int) -> Sweeps:
    """Sweeps under Coulomb's law from where the relaxation stands, `count` of which there are.

    On few rows the first of them are those that race from the start; else directions are kept.
    """
    if count == 0 and own.name == SWEEPER:
        follower = Sweeps(relaxed.outer)
    else:
        follower = Sweeps(relaxed.outer, "nncg", order=FOLLOWING[count % len(FOLLOWING)], restart="against")
    follower.impulse[:] = relaxed.impulse
    follower.last = relaxed.last
    return follower
