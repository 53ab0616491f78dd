"""Finite solvers as `auto` runs them: one to the end of its allowance, and all of them in turn with sweeps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np

from lavender._arrays import FloatArray
from lavender.certificates import check_certificate
from lavender.registry import FEW
from lavender.solution import Claim, Status
from lavender.solvers._costs import VELOCITY_KEY, Exact
from lavender.solvers._few import WARM
from lavender.solvers._newton import general
from lavender.solvers._sweepers import Sweeps
from lavender.solvers._trail import CLOCK, Trail, usable
from lavender.solvers._walks import sweeps_of
from lavender.solvers.direct import Impatient
from lavender.solvers.newton import NewtonState

__all__ = ["VELOCITY", "Turns", "note", "velocities_left", "whole"]

CHUNK_WORK = 8  # sweeps' work that an iteration of admm is
ROUNDS = 8  # times that sweeps and finite solvers take turns, the allowance doubled each time
STILL = 4  # turns in a row, each twice as long, that gain next to nothing: then nobody gets anywhere
GAIN = 0.99  # of the residual before a turn, below which it gained something
ALIKE = ("direct", "lemke")  # do the same wherever they start
VELOCITY = VELOCITY_KEY


def whole(
    trail: Trail,
    chosen: Exact,
    budget: int,
    limit: int = 0,
) -> bool:
    """Run a finite solver from the best impulse, to its end or `limit` iterations; True when nothing is left to do."""
    name = chosen.name
    spec = usable(name, trail.problem)
    if spec is None or budget <= trail.iterations:
        return trail.done
    if chosen.key == VELOCITY and trail.kernel is not None:
        return _over_velocities(trail, chosen, budget, limit or spec.max_iter)
    own = name == "newton" and trail.problem.generalized is None
    kept = trail.kept.get(chosen.key)
    if kept is not None:
        solver, state = kept
    else:
        options = dict(chosen.options)
        hasty = not options.pop("patience", True)
        solver = Impatient() if hasty else spec.load()(**options)
        if own:
            state = _newton_state(trail)
        else:
            state = solver.prepare(trail.problem)
    # Half-finished sweeps mislead a Newton method; Pi(0) does not. Under a convex law a step is lost on them even
    # where they came close; not on a start that was.
    before = trail.best
    close = before if trail.problem.law == "coulomb" or not own else trail.given
    warm = close <= WARM
    impulse = trail.impulse.copy() if warm else trail.problem.start()
    if name == "direct" and trail.problem.law == "lcp" and trail.swept is not None:
        impulse = trail.swept.copy()
    if own and trail.problem.law == "lcp":
        singular = any(key.startswith("direct") for key in trail.ended)
        if trail.swept is not None and not singular and trail.problem.m > FEW and trail.problem.is_symmetric:
            # Which rows are free is known from sweeps, however far they are. Where A is singular on them exchanges,
            # which is what direct does, go round in circles; so they do where A is asymmetric and sweeps got nowhere.
            impulse = trail.swept.copy()
    if kept is not None:
        impulse = trail.left[chosen.key]
    left = None if np.isinf(trail.deadline) else max(trail.deadline - perf_counter(), 1e-3)
    most = min(limit or spec.max_iter, spec.max_iter, budget - trail.iterations)
    claim: Claim
    if spec.resumable:
        if hasattr(solver, "until"):
            solver.until(state, trail.deadline)
        claim = _in_chunks(trail, solver, state, impulse, most)
        trail.kept[chosen.key], trail.left[chosen.key] = (solver, state), impulse
    else:
        resumes = hasattr(solver, "resume")
        claim = (solver.resume if resumes else solver.run)(state, impulse, most, trail.tol, left)
        if resumes:
            trail.kept[chosen.key], trail.left[chosen.key] = (solver, state), impulse
    note(trail, chosen, claim, impulse, before)
    return trail.done


def _over_velocities(trail: Trail, chosen: Exact, budget: int, limit: int) -> bool:
    """Newton's method over generalised velocities, on from where its steps were used up."""
    before = trail.best
    impulse = trail.left.get(VELOCITY)
    again = impulse is not None
    if impulse is None:
        impulse = trail.impulse.copy() if trail.begun and before <= WARM else trail.problem.start()
    left = None if np.isinf(trail.deadline) else max(trail.deadline - perf_counter(), 1e-3)
    most = min(limit, budget - trail.iterations)
    claim = general.run(trail.problem, trail.kernel, impulse, most, trail.tol, left, again)
    velocities_left(trail, claim, impulse)
    note(trail, chosen, claim, impulse, before)
    return trail.done


def velocities_left(trail: Trail, claim: Claim, impulse: FloatArray) -> None:
    """Newton's method over generalised velocities has begun, and goes on from here where it only ran out of steps."""
    trail.begun = True
    trail.left.pop(VELOCITY, None)
    if claim.status is Status.MAX_ITERATIONS and trail.kernel.waits:
        trail.left[VELOCITY] = impulse


def note(trail: Trail, chosen: Exact, claim: Claim, impulse: FloatArray, before: float) -> None:
    """Tell the trail what a finite solver did, from the residual `before` to an impulse (m,)."""
    trail.add(chosen.name, claim)
    if np.isfinite(impulse).all():
        trail.offer(impulse)
    if claim.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    if claim.status is not Status.MAX_ITERATIONS:
        trail.gave_up(chosen.key, before)
    if claim.certificate is not None and check_certificate(trail.problem, claim.certificate) is None:
        trail.certificate = claim.certificate


def _in_chunks(trail: Trail, solver: Any, state: Any, impulse: FloatArray, n: int) -> Claim:
    """At most n iterations of a solver that goes on where it stood, with looks at the clock and for Ctrl-C."""
    done, work = 0, dict[str, int]()
    chunk = max(1, int(CLOCK * 1e9) // max(1, CHUNK_WORK * trail.problem.metric.work))
    while True:
        claim: Claim = solver.run(state, impulse, min(chunk, n - done), trail.tol, None)
        done += claim.iterations
        for kind, count in claim.work.items():
            work[kind] = work.get(kind, 0) + count
        if claim.status is not Status.MAX_ITERATIONS or done >= n or trail.late or claim.iterations == 0:
            return replace(claim, iterations=done, work=work)


def _newton_state(trail: Trail) -> NewtonState:
    """What `newton` prepares, from the system whose cost was looked at."""
    system = trail.costs.system
    return NewtonState(trail.problem, system if system.sc.m else None)


class Turns:
    """Turns of what there is: every finite solver with its allowance, then sweeps; twice as much in the next turn."""

    def __init__(self, trail: Trail, sweeps: Sweeps | None, budget: int) -> None:
        self.trail, self.sweeps, self.budget = trail, sweeps, budget
        self.taken = 0
        self.allowance = 0.0  # of sweeps [ns]
        self.still = 0  # turns in a row that gained nothing
        self.over = False  # nothing gets anywhere

    def left(self) -> bool:
        return self.taken < ROUNDS and not self.over

    def candidates(self) -> Iterator[Exact]:
        """Each finite solver once, the cheapest first, by what is known of them when it is asked for."""
        asked = set[str]()
        while left := [e for e in self.trail.costs.exact if e.key not in asked]:
            asked.add(left[0].key)
            yield left[0]

    def take(self) -> bool:
        """One turn; True when nothing is left to do."""
        trail, costs, k = self.trail, self.trail.costs, self.taken
        before, spent = trail.best, trail.iterations
        for candidate in self.candidates():
            if trail.best <= trail.tol or self.budget <= trail.iterations:
                return True
            started = trail.ended.get(candidate.key)
            if started is not None and (candidate.name in ALIKE or not trail.best <= 0.1 * started):
                continue  # it gave up, and would do so again
            if np.isfinite(candidate.once) and perf_counter() + 1e-9 * candidate.once > trail.deadline:
                continue  # its first factor would come too late
            # The one before gave up, or needs more than was expected of it.
            sweeps = self.sweeps
            cheaper = sweeps is not None and trail.iterations > spent and sweeps.cost < candidate.cost
            if (
                cheaper
                and sweeps is not None
                and not sweeps.too_late
                and sweeps.run(self.budget, candidate.cost)
            ):
                return True
            if whole(trail, candidate, self.budget, candidate.limit << k):
                return True
        self.taken += 1
        self.allowance = max(2.0 * self.allowance, 2.0 * costs.cheapest)
        self.sweeps = self.sweeps or sweeps_of(trail, self.budget)
        if self.sweeps.run(self.budget, self.allowance):
            return True
        self.still = 0 if trail.best < GAIN * before else self.still + 1
        self.over = trail.late or spent == trail.iterations or self.still >= STILL
        return False
