"""Accelerated sweeps as `auto` runs them: a glance, and looks at what they promise.

rest = n log(now / tol) / log(before / now)         sweeps left, by the contraction of the last n    (1)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender._arrays import FloatArray
from lavender.problem import Problem
from lavender.registry import FEW
from lavender.residuals import judged, known, remember
from lavender.solution import Claim, Status
from lavender.solvers import _rates as rates
from lavender.solvers._accelerated import AcceleratedState, operator
from lavender.solvers._counts import finite_least, formed_cost, sweep_cost, velocities_cost
from lavender.solvers._few import said
from lavender.solvers._first import first_look, is_carried, is_glanced
from lavender.solvers._sweeping import STATUS
from lavender.solvers._trail import CLOCK, Trail, usable
from lavender.solvers.anderson import Anderson
from lavender_ext.few.looks import Looks, sweeps_left
from lavender_ext.judge.watch import RUNNING

__all__ = ["SWEEPER", "Glance", "Sweeps", "look_first"]

CONVERGED = Status.CONVERGED  # looked up once
SWEEPER = "anderson"  # whose sweeps come first
HOPE = 0.25  # share of a finite solver's cost that sweeps may take without promising an end
BELIEVED = 2.0  # times a finite solver's cost that sweeps may take, whatever they promise
APART = 10.0  # islands' worth of Python from which a finite solver is compared with islands solved apart
PORTION = 0.25  # of a time limit that sweeps may take that will not get there within it


class Glance:
    """A first look at sweeps of `anderson`, before anything else is looked at; they go on from here."""

    __slots__ = ("before", "impulse", "looks", "problem", "told")

    def __init__(self, problem: Problem, looks: Looks | None, impulse: FloatArray, before: float) -> None:
        self.problem = problem
        self.looks = looks  # None where the start is a solution
        self.impulse = impulse  # (m,) N s
        self.before = before  # relative residual before its last sweeps
        self.told = 0  # sweeps that the trail knows of

    @property
    def best(self) -> float:
        """The relative residual now."""
        return self.before if self.looks is None else float(self.looks.now.relative)

    @property
    def last(self) -> int:
        """Sweeps since `before`."""
        return 0 if self.looks is None else int(self.looks.last)

    @property
    def done(self) -> int:
        """All sweeps."""
        return 0 if self.looks is None else int(self.looks.done)

    @property
    def status(self) -> Status:
        return Status.CONVERGED if self.looks is None else STATUS[self.looks.status]

    @property
    def work(self) -> dict[str, int]:
        return {} if self.looks is None else {"sweeps": self.looks.sweeps, "restarts": self.looks.restarts}

    def sweeper(self) -> tuple[Any, Any]:
        """The solver and its state, to go on with."""
        return Anderson(), AcceleratedState.after(self.problem, self.looks)

    def claim(self) -> Claim:
        """Of the end, where `best` meets the tolerance."""
        looks = self.looks
        if looks is None:
            return Claim(CONVERGED, 0, {}, "the start is a solution")
        work = self.work
        return Claim(CONVERGED, looks.done, work, said(SWEEPER, work))


def look_first(
    problem: Problem,
    impulse: FloatArray,
    n: int,
    tol: float,
    failed: bool,
    time_limit: float | None,
    crowded: bool = False,
    largest: int = 0,
) -> Glance | None:
    """Sweeps from an impulse (m,) where a first look at them costs no more than to find out what else there is.

    `failed`: few rows whose factor did not end it at once. `crowded`: bounded rows of J and M whose factors over the
    velocities fill so much that to count them costs more than a look. `largest`: velocities of the largest island, 0
    where newton has no room for them. Where one body carries many rows some sweeps are tried before what would come
    first. No look is begun, or gone on with, that is counted for longer than `time_limit` [s].
    """
    general = problem.generalized is not None
    few = problem.m <= FEW
    carried = general and is_carried(problem)
    if problem.cones.has_round or (
        general and not (crowded or carried) and (problem.law != "coulomb" or not few)
    ):
        return None
    per = sweep_cost(problem)
    if not (carried or failed or is_glanced(problem, per)):
        carried = not general and is_carried(problem)
        if not carried:
            return None
    sweeps = rates.TRIED if carried else first_look(per)
    limit = np.inf if time_limit is None else 1e9 * time_limit
    if n < sweeps or sweeps * per > limit:
        return None
    lam = impulse.copy()
    before = known(problem, impulse)
    if before is None:
        before = judged(problem, impulse.copy()).relative
    if before <= tol:
        return Glance(problem, None, lam, before)
    split = 0 if problem.rows is None else problem.rows.n_joints
    # Of few rows over J and M A is not formed: that costs more than to sweep over them.
    data = problem.metric if general and few else operator(problem)
    looks = Looks(problem.metric, data, problem.law == "cone", split)
    most = min(n, 2**31 - 1)
    # What else there is is asked for where the first look is not the end: of a matrix that takes reading it.
    looks.run(lam, before, most, tol, sweeps, rates.FIRST_LOOK, per, 0.0, 0.0)
    if looks.now.relative > tol and not carried:
        left = limit - looks.done * per
        if few:
            per = rates.FEW_SWEEP_ROW * problem.m if general else per + rates.FEW_SWEEP
        for least, believed in _allowed(problem, few, largest, left):
            now = looks.now.relative
            if not now > tol or looks.status != RUNNING or looks.done >= most:
                break
            rest = sweeps_left(looks.last, looks.before, now, tol)
            if rest * per <= least and looks.done * per <= believed:
                more = min(max(looks.done // 2, rates.FIRST_LOOK), most - looks.done)
                looks.run(lam, now, most, tol, more, rates.FIRST_LOOK, per, least, believed)
    if looks.now.relative <= tol:
        remember(problem, looks.now)
    return Glance(problem, looks, lam, looks.before)


def _allowed(problem: Problem, few: bool, largest: int, left: float) -> list[tuple[float, float]]:
    """How long a first look goes on [ns], in stages: while the rest is promised for so much, until so much is spent.

    Of `few` rows Python takes as long to compare costs as many sweeps: as much as these then have on hope, they have
    here. `largest` as of `look_first`, `left`: until the time limit.
    """
    general = problem.generalized is not None
    if general and few and largest:
        # Newton over velocities comes next: as long as it mostly takes, whatever they promise.
        return [(np.inf, min(velocities_cost(problem, largest), left))]
    least = formed_cost(problem) + finite_least(problem, True if general else None)
    least = min(least, left / BELIEVED)
    promised = (least, BELIEVED * least)
    return [(np.inf, HOPE * least), promised] if few else [promised]


class Sweeps:
    """Accelerated sweeps of one problem, which go on where they stood, or where a glance at them did."""

    def __init__(
        self, trail: Trail, name: str = SWEEPER, glance: Glance | None = None, **options: Any
    ) -> None:
        self.trail, self.name, self.glance = trail, name, glance
        spec = usable(name, trail.problem)
        self.usable = spec is not None
        if glance is not None:
            (self.solver, self.state), self.impulse = glance.sweeper(), glance.impulse
        elif spec is not None:
            self.solver = spec.load()(**options)
            self.state = self.solver.prepare(trail.problem)
            self.impulse = trail.impulse.copy()
        # Of one iteration [ns]: the symmetric order sweeps twice in it.
        self.per = trail.costs.sweep * (2.0 if options.get("order") == "symmetric" else 1.0)
        self.tol = trail.tol
        self.done = 0 if glance is None else glance.done  # iterations
        self.begun = 0 if glance is None else glance.told  # those that the trail knows of,
        self.total = {} if glance is None or glance.told else dict(glance.work)  # and the work of the others
        self.last, self.at = trail.best, 0  # residual of the last look, and when it was
        self.aside = 0.0  # ns that were spent beside them
        self.rest = np.inf  # sweeps that were then expected to be left
        self.ended = False  # by a claim of its own, or because the residual does not fall

    def look(self, step: int) -> float:
        """So many more iterations, or what a glance was: the relative residual; fewer where a claim ends them."""
        trail = self.trail
        before, status = self.done, Status.MAX_ITERATIONS
        if self.glance is not None:
            glance, self.glance = self.glance, None
            status, before = glance.status, 0
            self.last, self.at = glance.before, glance.done - glance.last
        else:
            # In short runs for the clock and Ctrl-C alone: cut anywhere, sweeps give the same bits.
            chunk = max(1, int(CLOCK * 1e9) // max(1, trail.problem.metric.work))
            for start in range(0, step, chunk):
                n = min(chunk, step - start)
                claim: Claim = self.solver.run(self.state, self.impulse, n, self.tol, None)
                status = claim.status
                self.done += claim.iterations
                for kind, count in claim.work.items():
                    self.total[kind] = self.total.get(kind, 0) + count
                if status is not Status.MAX_ITERATIONS or trail.late:
                    break
        now = self.judge(status)
        if now > trail.tol and not (status is Status.MAX_ITERATIONS and self.done > before):
            self.ended = self.stopped(status)
        self.rest = sweeps_left(self.done - self.at, self.last, now, trail.tol)
        self.last, self.at = now, self.done
        return now

    def judge(self, status: Status) -> float:
        """The residual that counts, and the trail's if it is the best."""
        return self.trail.offer(self.impulse)

    def stopped(self, status: Status) -> bool:
        """Whether a claim above the tolerance is the end."""
        return True

    def next_look(self) -> int:
        """Iterations until the next one: half as many as were done."""
        return first_look(self.per) if not self.done else max(rates.FIRST_LOOK, self.done // 2)

    def note(self, prefix: str = "") -> None:
        """Tell the trail what was done since the last time."""
        if self.done > self.begun:
            self.trail.add(
                prefix + self.name, Claim(Status.MAX_ITERATIONS, self.done - self.begun, self.total)
            )
            self.trail.swept = self.impulse
        self.begun, self.total = self.done, {}

    def run(self, budget: int, worth: float | None = None, cap: int | None = None) -> bool:
        """Sweep while the rest is expected to cost at most `worth` [ns]; a share of that may be spent on hope alone.

        Without `worth`, that is the cheapest finite solver. With `cap`, no more than so many, whatever they promise.
        """
        trail = self.trail
        if not self.usable or self.ended:
            return trail.done
        begun, looks = self.done, 0
        # A glance is for nothing as far as it may come before anything else is found out.
        free = rates.GLANCED if trail.costs.over_velocities == np.inf else 0.0
        glanced = 0.0 if self.glance is None else max(0.0, self.done * self.per - free)
        while not trail.late and not self.ended:
            step = min(self.next_look(), budget - trail.iterations - (self.done - self.begun))
            if cap is not None:
                step = min(step, cap - self.done)
            if step <= 0:
                break
            now = self.look(step)
            looks += 1
            if now <= trail.tol:
                break
            if cap is None and self.dearer(
                self.cost, glanced + looks * rates.LOOK + (self.done - begun) * self.per, worth
            ):
                break
        self.note()
        return trail.done

    @property
    def too_late(self) -> bool:
        """Sweeps alone will not get there within the time limit, by the contraction before the last look."""
        return (self.done + self.rest) * self.per > self.trail.limit

    @property
    def cost(self) -> float:
        """What is left, by the contraction before the last look [ns]."""
        return np.inf if self.ended else self.rest * self.per

    def dearer(self, rest: float, spent: float, worth: float | None) -> bool:
        """Whether what is left costs more than what else there is; looked at closely only where it may."""

        def than(other: float) -> bool:
            # What was promised before and did not come about is not believed for ever.
            return (rest > other and spent > HOPE * other) or spent > BELIEVED * other

        trail = self.trail
        factored = trail.problem.law in ("linear", "lcp")
        if factored and self.done * self.per > PORTION * trail.limit and self.too_late:
            # Sweeps will not get there in time; a factorisation that is in luck may.
            costs, left = trail.costs, trail.limit - spent
            return costs.formed < left and any(other.once < left for other in costs.exact)
        if worth is not None:
            return than(worth)
        if min(rest, spent) > APART * rates.ISLAND and than(trail.apart_cost()):
            return True
        costs = trail.costs
        # To ask closely takes time, and of J and M forms A, unless what needs none costs less: not before as much was
        # swept.
        if trail.late_by(rates.WITH_A * costs.formed):
            return than(costs.over_velocities)
        if not (than(costs.least) and than(costs.guess)):
            return False
        return spent > min(costs.formed + costs.asking, costs.over_velocities) and than(costs.cheapest)
