"""Where sweeps under Coulomb's law stall: patches of blocks around what is wrong, each solved apart.

    A_pp lam_p - b_p' complementary to lam_p,    b_p' = b_p - A_pr lam_r       p a patch, r all other blocks      (1)

On piles that stall two thirds of the squared error sit in ten contacts: there the impulse creeps along one line, step
after step, until a contact far along it changes side. Sweeps over the patch alone cost a hundredth, and Newton's
method on the Alart-Curnier map goes there at once, since all else is at rest; sweeps over all of them spread what it
did. Patches that bring nothing give way to wider ones, and all plans to the same around more bodies.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lavender._arrays import FloatArray, IntArray
from lavender.problem import Problem
from lavender.residuals import judged, quick
from lavender.solvers import _rates as rates
from lavender.solvers._counts import sweep_cost
from lavender.solvers._islands import block_bodies, restrict, rows_of
from lavender.solvers._newton.proximal import Proximal
from lavender.solvers._newton.run import Run
from lavender.solvers._newton.systems import AUGMENTED, make_system
from lavender.solvers._sweepers import Sweeps
from lavender.solvers._trail import Trail
from lavender.solvers._walks import walk_step
from lavender.solvers.nncg import NNCG
from lavender_ext.factor import graph

ROUND = 50  # sweeps of all blocks between two rounds of patches
BAD = 0.3  # share of the largest block's error from which a block is the core of a patch
HELD = 0.2  # share of the squared error that the cores have to hold for patches to be worth a beginning
IDLE = 5  # times that all plans may gain nothing
GAIN = 0.8  # of the residual that a plan has to leave
CLOSER = 1e-3  # of a patch's own residual, to which it is solved
BLOCKS = 400  # of a patch that Newton's method is asked for
# What is asked, with how many bodies around the core, in turn while nothing is gained; then with one more each.
PLANS = (("newton", 1), ("nncg", 1), ("newton", 2), ("nncg", 2), ("nncg", 3))
SHARE = 2.0  # of what a round's sweeps of all cost, that those of a patch may
SWEEPS, FACTORS = 3000, 25  # of one patch at most
WEIGHT = 1e-6  # proximal weight that Newton's method begins with


class Patches(Sweeps):
    """Sweeps of `anderson`, and between two looks patches; begins where the trail is best."""

    def __init__(self, trail: Trail) -> None:
        super().__init__(trail)
        self.bodies = block_bodies(trail.problem)
        self.block = np.repeat(np.arange(len(self.bodies)), np.diff(trail.problem.cones.ptr))
        self.reached, self.plan = np.inf, 0
        self.least = trail.best
        self.idle = 0  # times that all plans were through and nothing was gained

    @property
    def spent(self) -> float:
        """Cost of what it did [ns]."""
        return self.done * (self.per + rates.LOOK / ROUND) + self.aside

    @property
    def gains(self) -> bool:
        """Some plan gained lately."""
        return self.done > 0 and self.idle <= 1

    @property
    def is_concentrated(self) -> bool:
        """What is wrong where the trail is best sits in few blocks; where it is spread patches bring little."""
        self.impulse[:] = self.trail.impulse
        self.aside += rates.LOOK
        error, core = self._core()
        return bool(error[core].sum() >= HELD * error.sum())

    def mend(self, worth: float, budget: int) -> bool:
        """At most `budget` more sweeps, while that gains and costs at most `worth` [ns] in all; is the trail done."""
        trail, last = self.trail, self.done + budget
        while not trail.late and self.idle < IDLE and self.done < last and self.spent < worth:
            if self.look(min(ROUND, last - self.done)) <= trail.tol:
                break
        return trail.done

    def look(self, step: int) -> float:
        """So many sweeps of all; then patches, to be swept over by the next."""
        self.state = self.solver.prepare(self.trail.problem)  # forgets what patches moved
        now = super().look(step)
        self.ended = False
        if now > self.trail.tol and not self.trail.late:
            if now < GAIN * self.least:
                self.least, self.idle = now, 0
            if now < GAIN * self.reached:
                self.reached, self.plan = now, 0
            else:
                self.plan += 1
                if self.plan == len(PLANS):
                    self.reached, self.plan = np.inf, 0
                    self.idle += 1
            name, width = PLANS[self.plan]
            self._mend(name, width + self.idle)  # the same patches would end where they did
        return now

    def _core(self) -> tuple[Any, Any]:
        """Squared error of each block (k,), and which of them are cores."""
        error = np.bincount(self.block, self.trail.problem.d * self._error() ** 2)
        return error, error >= BAD * BAD * error.max(initial=0.0)

    def _mend(self, name: str, width: int) -> None:
        problem = self.trail.problem
        label = self._labels(self._core()[1], width)
        rest = self.impulse.copy()
        rest[label[self.block] >= 0] = 0.0
        shifted = -problem.slack(rest)
        for i in range(label.max(initial=-1) + 1):
            blocks = np.flatnonzero(label == i).astype(np.int32)
            if self.trail.late:
                break
            if name == "nncg" or len(blocks) <= BLOCKS:
                self._solve(blocks, shifted, name)

    def _error(self) -> FloatArray:
        """What the judge finds wrong in every row (m,) [N s]."""
        quick(self.trail.problem, self.impulse, self.trail.w, self.trail.e)
        return self.trail.e

    def _labels(self, core: Any, width: int) -> IntArray:
        """The patch of each block (k,), -1 of none: of blocks on bodies of the core, `width` times over."""
        n = self.trail.problem.rows.n_bodies  # type: ignore[union-attr]
        chosen = core
        for _ in range(width):
            touched = np.zeros(n + 1, bool)  # the last entry is body -1
            touched[self.bodies[chosen]] = True
            touched[-1] = False
            chosen = touched[self.bodies].any(axis=1) | chosen
        label = np.full(len(core), -1, np.int32)
        label[chosen] = graph.body_components(np.ascontiguousarray(self.bodies[chosen]), n)[1]
        return label

    def _solve(self, blocks: IntArray, shifted: FloatArray, name: str) -> None:
        """(1) by one method, from where the patch stands; what it ends with is kept, whatever it is."""
        problem = self.trail.problem
        rows = rows_of(problem, blocks)
        part = replace(restrict(problem, blocks, rows), b=shifted[rows], copy=False)
        impulse = self.impulse[rows]
        tol = CLOSER * judged(part, impulse.copy()).relative
        if name == "newton":
            impulse = self._walk(part, impulse, tol)
        else:
            self._sweep(part, impulse, tol)
        if np.isfinite(impulse).all():
            self.impulse[rows] = impulse
        self.aside += rates.LOOK

    def _walk(self, part: Problem, impulse: FloatArray, tol: float) -> FloatArray:
        """Newton's method on the Alart-Curnier map, from an impulse: the best that it met."""
        system = make_system(part, "velocity")
        if not (system.sc.m and system.sc.has_friction):
            return impulse
        system.factorisations = 0
        run = Run(system, tol, FACTORS, self.trail.deadline)
        Proximal(system.sc.unknown(impulse), AUGMENTED, WEIGHT).advance(run, FACTORS)
        count = system.factorisations
        self.total["factorisations"] = self.total.get("factorisations", 0) + count
        self.aside += count * walk_step(system)
        return system.sc.impulse(run.best_z)

    def _sweep(self, part: Problem, impulse: FloatArray, tol: float) -> None:
        """Sweeps that keep their direction, on an impulse in place."""
        solver = NNCG(restart="against")
        steps = min(SWEEPS, int(SHARE * ROUND * self.trail.problem.n_blocks / part.n_blocks))
        claim = solver.run(solver.prepare(part), impulse, steps, tol)
        for kind, count in claim.work.items():
            self.total[kind] = self.total.get(kind, 0) + count
        self.aside += claim.work["sweeps"] * sweep_cost(part)
