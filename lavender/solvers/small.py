"""Small problems in one compiled call, and the claim that goes with its counts.

Few rows of bodies or of A (`lavender_ext/few/chain.pyx`), islands of few rows under friction, as many as are swept in
`LONGEST` (`lavender_ext/few/islands.pyx`), generalised coordinates where Newton's method is counted to cost little
(`lavender_ext/few/many.pyx`): what Python costs outweighs such a problem. The call ends with a solution or not at all:
then the solver runs as on any problem, from the beginning.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import nan
from typing import Any

import numpy as np

from lavender._arrays import FloatArray
from lavender.problem import LAWS, Problem
from lavender.registry import SMALL_ROWS
from lavender.residuals import judged, reference
from lavender.solution import Claim, Status, Turn
from lavender.solvers import weights
from lavender.solvers._counts import sweep_cost
from lavender.solvers.islands import islands
from lavender.solvers.newton_systems import general
from lavender_ext.few.chain import Chain
from lavender_ext.few.islands import Islands
from lavender_ext.few.many import Gate, solve_first

FIRST_LOOK, LAST_LOOK = 16, 64  # sweeps before the first look at the residual: so many at least and at most,
LOOKED = 60e3  # ns, or as cost so much: a look and a cut in the sweeps are not free
WARM = 1e-3  # relative residual from which an iterate is worth starting from
# Rows of an island at most: dense factors of so many cost less than the sweeps and factors of all islands together,
# which under the cone law are few.
ISLAND = {"coulomb": 150, "cone": 12}
SWEPT = 16  # sweeps of an island at most, before its factors
IN_ALL = 10  # times as long, as sweeps and factors of all islands mostly take
FACTORED = 0.05  # ns of a multiply-add of factors of islands
LONGEST = 2.5e8  # ns of SWEPT sweeps of all islands at most
# All that `general_cost` reads, by law.
GENERAL = (
    weights.GENERAL_START,
    tuple(weights.GENERAL_ROW[law] for law in LAWS),
    tuple(weights.GENERAL[law] for law in LAWS),
    tuple(weights.GENERAL_COUNT[law] for law in LAWS),
)


def general_cost(problem: Problem, largest: int) -> float:
    """Newton over generalised velocities, `largest` of them in one island [ns]."""
    law = problem.law
    step = weights.GENERAL_ROW[law] * problem.m + weights.GENERAL[law] * general.factor_flops(
        problem, largest
    )
    return weights.GENERAL_START + weights.GENERAL_COUNT[law] * step


def first_look(per: float) -> int:
    """Sweeps, each of cost `per` [ns], before their residual is looked at."""
    return int(min(max(FIRST_LOOK, LOOKED / per), LAST_LOOK))


def call_ends_within(problem: Problem, time_limit: float | None) -> bool:
    """The compiled call takes a quarter of the limit [s] at most: without an end it leaves nothing."""
    if time_limit is None or (problem.generalized is None and problem.law in ("linear", "lcp")):
        return True
    if problem.generalized is not None:
        cost = general_cost(problem, problem.generalized.nv)
    else:
        per = sweep_cost(problem)
        cost = (first_look(per) if problem.m <= SMALL_ROWS else IN_ALL * SWEPT) * per
        if problem.m > SMALL_ROWS and 4e-9 * cost <= time_limit:
            parts = prepared(problem)
            cost += FACTORED * (0.0 if parts is None else parts.most_factored)
    return 4e-9 * cost <= time_limit


def prepared(problem: Problem) -> Any:
    """The chain of a problem of few rows, or its islands of few, kept with it; None where it has neither."""
    kept = problem.derived.chain
    if kept is None:
        kept = problem.derived.chain = _make(problem) or False
    return kept or None


def _make(problem: Problem) -> Chain | Islands | None:
    if problem.m > SMALL_ROWS:
        return _divided(problem)
    reference(problem)
    data, start = problem.metric, problem._start
    relative = data.start_relative
    if len(data.empty) or relative < 0.0 or problem.cones.has_round or problem.cones.has_rolling:
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
    look = first_look(sweep_cost(problem))
    return Chain(data, start, relative, split=split, exact=law == "cone", first_look=look)


def _divided(problem: Problem) -> Islands | None:
    cones = problem.cones
    if problem.law in ("linear", "lcp") or cones.has_round or cones.has_rolling:
        return None
    if SWEPT * sweep_cost(problem) > LONGEST:
        return None
    count, label = islands(problem)
    if count == 1 or np.bincount(label, np.diff(cones.ptr)).max() > ISLAND[problem.law]:
        return None
    reference(problem)
    data = problem.metric
    if len(data.empty) or data.start_relative < 0.0:
        return None
    return Islands(data, problem.csr_data, problem._start, label, count, SWEPT)


@dataclass(frozen=True)
class Few:
    """What `SolverSpec.few` holds: small problems as that solver solves them."""

    name: str
    gate: Gate | None  # what it may cost over generalised velocities; None: not at all
    pivots: bool  # bounded rows
    sweeps: bool  # and cones
    looks: bool = False  # a start that is a solution is the result, one that is none is not started from

    def solve(self, problem: Problem, impulse: FloatArray | None, tol: float) -> Any:
        """(what the judge finds, counts) from an impulse (m,) or from doing nothing; None where it is left."""
        kept = problem.derived
        if not tol > 0.0 or problem.m == 0:
            return None
        if kept.vain is not None:
            at = (problem._start if impulse is None else impulse).tobytes()
            if kept.vain == (self.name, tol, at):
                return None
        if problem.generalized is not None:
            if self.gate is None:
                return None
            found = solve_first(kept.view, impulse, tol, self.gate, general.ROOM) or False
        else:
            chain = prepared(problem) if problem.m <= SMALL_ROWS or self.sweeps else None
            if chain is None or not (self.pivots if chain.pivots else self.sweeps):
                return None
            found = chain.run(impulse, tol, self.looks, WARM, self.looks)
            if found is None:  # another thread has its room
                found = _make(problem).run(impulse, tol, self.looks, WARM, self.looks)  # type: ignore[union-attr]
        if found is False:  # the steps of who solves it the long way need not come twice before
            kept.vain = (self.name, tol, (problem._start if impulse is None else impulse).tobytes())
        return found or None

    def turns(
        self, problem: Problem, claim: Claim, start: FloatArray | None, after: float
    ) -> tuple[Turn, ...]:
        """Of `auto`, which hands over."""
        return turns_of(problem, claim, start, after) if self.looks else ()

    def claim(self, problem: Problem, counts: tuple[int, ...] | None) -> Claim:
        """What the solver says of a chain that did so much, word for word."""
        if counts is None:
            return Claim(Status.CONVERGED, 0, {}, "the start is a solution")
        if problem.generalized is not None:
            return general.named(general.claim(Status.CONVERGED, counts), self.name)
        if problem.derived.chain.pivots:
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
        done, sweeps, restarts, *more = counts
        work = {"sweeps": sweeps, "restarts": restarts}
        if not more:
            return Claim(Status.CONVERGED, done, work, said("anderson", work))
        factorisations, driven, count = more
        message = said(f"anderson on {count} islands", work)
        if factorisations:
            work["factorisations"] = factorisations
            message += " -> " + said(f"newton on {driven} islands", {"factorisations": factorisations})
        return Claim(Status.CONVERGED, done, work, message)


def turns_of(problem: Problem, claim: Claim, start: FloatArray | None, after: float) -> tuple[Turn, ...]:
    """The turns of `auto` in one compiled call from a start (m,) [N s], or from none, to the residual `after`."""
    if not claim.work:
        return ()
    cold = start is None or np.array_equal(start, problem._start)
    assert start is not None or cold
    before = float(problem.metric.start_relative) if cold else judged(problem, start.copy()).relative  # type: ignore
    parts = claim.message.split(" -> ")
    if len(parts) == 1:
        return (Turn(_who(parts[0]), dict(claim.work), before, after),)
    # Of `lemke` after exchanges that were stuck, of `newton` on islands; nobody looked between the two.
    count, what = parts[1].split()[-2:]
    work = dict(claim.work)
    work[what] -= int(count)
    first = {kind: done for kind, done in work.items() if done}
    return Turn(_who(parts[0]), first, before, nan), Turn(_who(parts[1]), {what: int(count)}, nan, after)


def _who(words: str) -> str:
    """The solver in what is said of it, and on how many islands."""
    name, on, _ = words.partition(" islands")
    return name + on if on else name.split()[0]


def said(name: str, work: Mapping[str, int]) -> str:
    """What a solver did, in words."""
    between = " "
    for kind, count in work.items():
        if count:
            name += f"{between}{count} {kind}"
            between = ", "
    return name


AUTO = Few("auto", Gate(GENERAL, tuple(weights.GENERAL_FIRST[law] for law in LAWS)), True, True, looks=True)
DIRECT = Few("direct", None, True, False)
NEWTON = Few("newton", Gate(GENERAL, len(LAWS) * (weights.GENERAL_MOST,)), False, False)
