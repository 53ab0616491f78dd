"""Problems of few rows in one compiled call (`lavender_ext/few/chain.pyx`), and the claim that goes with its counts.

What Python costs outweighs such a problem. The call ends with a solution or not at all: then the solver runs as on any
problem, from the beginning.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import nan
from typing import Any

import numpy as np

from lavender._arrays import FloatArray
from lavender.problem import Problem
from lavender.registry import FEW
from lavender.residuals import judged, reference
from lavender.solution import Claim, Status, Turn
from lavender.solvers import _rates as rates
from lavender.solvers._counts import sweep_cost
from lavender.solvers._gates import (
    CARRIED_GATE,
    GENERAL_GATE,
    NO_GATE,
    first_look,
    general_cost,
    general_first,
    is_carried,
)
from lavender.solvers._newton import general
from lavender_ext.few.chain import PIVOTS, SWEEPS, VELOCITIES, Chain
from lavender_ext.few.many import Gate, solve_first

FEW_GENERAL = 1000  # rows in generalised coordinates, where nothing of Python's grows with them
GATE, ANY = Gate(GENERAL_GATE, CARRIED_GATE), Gate(None)
LOOSE = Gate(
    (*GENERAL_GATE[:6], NO_GATE), CARRIED_GATE
)  # of `newton`, before which no sweeps come on few rows
WARM = 1e-3  # relative residual from which an iterate is worth starting from


def prepared(problem: Problem) -> Chain | None:
    """The chain of a problem, kept with it; None where it has none."""
    kept = problem.derived.chain
    if kept is None:
        kept = problem.derived.chain = _make(problem) or False
    return kept or None


def _make(problem: Problem) -> Chain | None:
    if not 0 < problem.m <= (FEW if problem.generalized is None else FEW_GENERAL):
        return None
    reference(problem)
    data, start = problem.metric, problem._start
    relative = data.start_relative
    if len(data.empty) or relative < 0.0:
        return None
    if problem.generalized is not None:
        if is_carried(problem):
            return None
        looked = general.looked_at(problem)
        if looked.crowded and problem.m > FEW and problem.law in ("linear", "lcp"):
            return None  # sweeps, or `direct`, may be the end before what fills is counted
        kernel = general.prepare(problem) if looked.crowded else looked if looked.fits else None
        if kernel is None:
            problem.derived.first = False
            return None
        problem.derived.first = general_first(problem, kernel.largest)
        if not problem.derived.first and general_cost(problem, kernel.largest) > rates.GENERAL_FIRST:
            return None
        return Chain(data, start, relative, newton=kernel)
    if problem.cones.has_round or problem.cones.has_rolling:
        return None
    law = problem.law
    if law in ("linear", "lcp"):
        symmetric = problem.is_symmetric
        band = max(problem.bandwidth) if symmetric else problem.m - 1
        linear = law == "linear"
        return Chain(
            data, start, relative, matrix=problem.csr_data, band=band, linear=linear, symmetric=symmetric
        )
    split = 0 if problem.rows is None else problem.rows.n_joints
    return Chain(
        data, start, relative, split=split, exact=law == "cone", first_look=first_look(sweep_cost(problem))
    )


@dataclass(frozen=True)
class Few:
    """What `SolverSpec.few` holds: problems of few rows as that solver solves them."""

    name: str
    kinds: tuple[int, ...]
    looks: bool = False  # a start that is a solution is the result, one that is none is not started from

    def solve(self, problem: Problem, impulse: FloatArray | None, tol: float) -> Any:
        """(what the judge finds, counts) from an impulse (m,) or from doing nothing; None where it is left."""
        kept = problem.derived
        if problem.generalized is not None and VELOCITIES not in self.kinds:
            return None
        if kept.chain is None and kept.view is not None and VELOCITIES in self.kinds:
            # Its first solve: what repeated ones are spared, room and islands, is not kept yet.
            if kept.seen or not 0 < problem.m <= FEW_GENERAL:
                chain = prepared(problem)
            else:
                kept.seen = True
                gate = GATE if self.looks else LOOSE
                found = solve_first(kept.view, impulse, tol, gate, general.ROOM) if tol > 0.0 else None
                if found is not None:
                    return found or None  # the chain would take the same steps in vain
                chain = prepared(problem)
        else:
            chain = prepared(problem)
        if chain is None or chain.kind not in self.kinds or not tol > 0.0:
            return None
        if self.looks and kept.first is False:
            return None  # sweeps come before
        return chain.run(impulse, tol, self.looks, WARM, self.looks)

    def turns(
        self, problem: Problem, claim: Claim, start: FloatArray | None, after: float
    ) -> tuple[Turn, ...]:
        """Of `auto`, which hands over."""
        return turns_of(problem, claim, start, after) if self.looks else ()

    def claim(self, problem: Problem, counts: tuple[int, ...] | None) -> Claim:
        """What the solver says of a chain that did so much, word for word."""
        if counts is None:
            return Claim(Status.CONVERGED, 0, {}, "the start is a solution")
        kind = VELOCITIES if problem.generalized is not None else problem.derived.chain.kind
        if kind == VELOCITIES:
            return general.named(general.claim(Status.CONVERGED, counts), self.name)
        if kind == PIVOTS:
            done, swept, refined, factored, exchanged, shifts, rank, path = counts
            named = {
                "sweeps": 4 * swept,
                "rank": rank,
                "shifts": shifts,
                "refinements": refined,
                "factorisations": factored,
                "pivots": exchanged,
            }
            work = {what: count for what, count in named.items() if count}
            if self.name == "direct":
                symmetric = problem.is_symmetric
                note = "A is not symmetric" if problem.law == "linear" and not symmetric else ""
                if rank:
                    note = f"A is singular, rank {rank} of {problem.m}"
                elif shifts and problem.law != "linear":
                    note = "A is singular on the free rows: shifted and refined"
                return Claim(Status.CONVERGED, done, work, note, form="band" if symmetric else "LU")
            message = said("direct", work)
            if path:
                message += " -> " + said("lemke", {"pivots": path})
                work["pivots"] = exchanged + path
            return Claim(Status.CONVERGED, done + path, work, message)
        done, sweeps, restarts = counts
        work = {"sweeps": sweeps, "restarts": restarts}
        return Claim(Status.CONVERGED, done, work, said("anderson", work))


def turns_of(problem: Problem, claim: Claim, start: FloatArray | None, after: float) -> tuple[Turn, ...]:
    """The turns of `auto` in one compiled call from a start (m,) [N s], or from none, to the residual `after`."""
    if not claim.work:
        return ()
    cold = start is None or np.array_equal(start, problem._start)
    assert start is not None or cold
    before = float(problem.metric.start_relative) if cold else judged(problem, start.copy()).relative  # type: ignore
    names = [part.split()[0] for part in claim.message.split(" -> ")]
    if len(names) == 1:
        return (Turn(names[0], dict(claim.work), before, after),)
    path = int(
        claim.message.split()[-2]
    )  # of `lemke`, after exchanges that were stuck; nobody looked between them
    work = dict(claim.work) | {"pivots": claim.work["pivots"] - path}
    return Turn(names[0], work, before, nan), Turn(names[1], {"pivots": path}, nan, after)


def said(name: str, work: Mapping[str, int]) -> str:
    """What a solver did, in words."""
    between = " "
    for kind, count in work.items():
        if count:
            name += f"{between}{count} {kind}"
            between = ", "
    return name


AUTO = Few("auto", (VELOCITIES, PIVOTS, SWEEPS), looks=True)
DIRECT = Few("direct", (PIVOTS,))
NEWTON = Few("newton", (VELOCITIES,))
