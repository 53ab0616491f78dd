"""Small problems in one compiled call, and the claim that goes with its counts.

It is used for few rows of bodies or of A and for small islands under friction (`lavender_ext/small/call.pyx`), and
for generalised coordinates if Newton's method is counted to cost no more than others (`lavender_ext/batch/many.pyx`),
because Python would cost more than such a solve. If the call does not find a solution it returns nothing, and the
solver runs as on any other problem, from the beginning.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from math import inf, nan
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.judge.residuals import get_reference, judge_impulse
from lavender.judge.solution import Claim, SolverStage, Status, counted, summed
from lavender.problem import Problem
from lavender.solvers.costs import RATES, SOFT, STEPS, SWEEPS, factorisations, sweep_cost
from lavender.solvers.islands import islands
from lavender.solvers.newton_systems import general
from lavender.solvers.newton_systems.systems import DENSE_ROWS
from lavender.solvers.registry import SMALL_ROWS
from lavender.solvers.setup_times import forming
from lavender_ext.batch.many import Limits, solve_first
from lavender_ext.small.call import Islands, Rules, Small

# Keys of `Derived.cache`.
COMPILED_CALL_KEY = (
    "lavender.solvers.small: compiled call"  # a `Small` or `Islands`; False if the problem has none
)
# (solver, tol, start) of a compiled call that did not converge, and its counts: it is not repeated.
FAILED_CALL_KEY = "lavender.solvers.small: failed call"

#: Why nothing ran, by the status of a start.
NOTHING = {
    Status.CONVERGED: "the start is a solution",
    Status.ROUNDOFF_LIMIT: "the start is at its floor: what is left is rounding",
}
NO_TIME = "the time limit left no time for a solver"
WARM = 1e-3  # relative residual from which an iterate is worth starting from
# The most rows of an island: up to these, dense factors cost less than sweeps and factors of all islands together.
ISLAND = 150
SWEPT = 32  # the most sweeps of a part before its first factorisation
QUARTER = 0.25  # of the time left, that islands may take
SPLIT = 200.0  # ns for each row of what tells islands apart
TREE = 2e5  # ns, Python's share of two lines of the tree, which one compiled call does without
SHARED = 10.0  # rows for each velocity, from which N is full and small beside what it is made of
COLUMNS = 12.0  # velocities of two bodies
MOST = 1e7  # counted cost [ns] of Newton's method over generalised velocities up to which no clock is read in between
NEWTON_STEPS, AUTO_STEPS = 1500.0, 1e6  # of all islands of velocities: within what each may do by default


def limits(sweeps: float, most: float = MOST, steps: float = NEWTON_STEPS) -> Limits:
    """Of the compiled calls over generalised velocities: they may cost as much as so many sweeps, and `most` [ns], and
    take so many steps.
    """
    sweep = TREE, RATES["sweep row"], RATES["sweep cone"], sweeps
    step = RATES["entry"], RATES["work"]["velocities"], factorisations("lcp")
    rows = SMALL_ROWS, DENSE_ROWS, SHARED, COLUMNS
    return Limits(np.array([*step, STEPS, SOFT, *sweep, general.MAX_MATRIX_ENTRIES, most, *rows, steps]))


def call_ends_within(problem: Problem, seconds: float | None) -> bool:
    """Whether the compiled call is made: of more than a few rows, which may return nothing, if it is counted to end.

    It may take a quarter of the time that is left; over velocities four times what its gate lets in.
    """
    if seconds is None or problem.m <= SMALL_ROWS:
        return True
    if problem.generalized is not None:
        return QUARTER * seconds >= 4e-9 * MOST
    if problem.law in ("linear", "lcp"):
        return False
    cost = SPLIT * problem.m + 1e9 * forming(problem) + SWEPT * sweep_cost(problem)
    return 1e-9 * cost <= QUARTER * seconds


def prepared(problem: Problem) -> Any:
    """The compiled call of a small problem or of small islands, kept with the problem; None if it has none."""
    kept = problem.derived.cache.get(COMPILED_CALL_KEY)
    if kept is None:
        kept = problem.derived.cache[COMPILED_CALL_KEY] = _make(problem) or False
    return kept or None


def _make(problem: Problem) -> Small | None:
    cones, count, label, bounded = problem.cones, 1, None, pivots(problem)
    if cones.has_round or cones.has_more_parts:
        return None
    if problem.m > SMALL_ROWS:
        if bounded:
            return None
        count, label = islands(problem)
        if count == 1 or np.bincount(label, np.diff(cones.ptr)).max() > ISLAND:
            return None
    get_reference(problem)
    data = problem.metric
    if len(data.empty) or data.relative_at_zero < 0.0:
        return None
    if bounded or count == 1:
        return Small(data, problem.csr_data if bounded else data)
    # Islands are cut out of the bodies where these have fewer unknowns than rows, else out of A.
    bodies = problem.rows is not None and problem.m > 6 * problem.rows.n_bodies
    return Islands(data, data if bodies else problem.csr_data, label, count)


def pivots(problem: Problem) -> bool:
    """Whether the compiled call over A or bodies pivots: its rows are bounded."""
    return problem.law in ("linear", "lcp")


def who(problem: Problem) -> str:
    """Who solves a problem in the compiled call of `auto`, in words; "" where that is not made."""
    if problem.generalized is not None:
        kernel = general.prepare(problem)
        if kernel is None or AUTO.limits is None:
            return ""
        cost, most = AUTO.limits.cost(problem.metric, kernel.work, kernel.islands)
        return f"newton over velocities, counted to take {1e-3 * cost:.3g} us" if cost <= most else ""
    small = prepared(problem)
    if small is None:
        return ""
    if pivots(problem):
        return "direct (block pivots), then lemke where these do not end"
    count = islands(problem)[0] if problem.m > SMALL_ROWS else 1
    return "sweeps (anderson), then newton" + (f", on each of {count} islands" if count > 1 else "")


@dataclass(frozen=True)
class SmallCall:
    """What `SolverSpec.small` holds: small problems as that solver solves them."""

    name: str
    limits: Limits | None  # what it may cost over generalised velocities; None: not at all
    pivots: bool  # bounded rows
    # And friction; a start that is a solution is the result, a bad one is not started from.
    hands_over: bool = False
    rules: Rules = field(init=False)

    def __post_init__(self) -> None:
        rules = Rules(SMALL_ROWS, SWEPT, WARM, self.pivots, self.hands_over)
        object.__setattr__(self, "rules", rules)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copied or pickled it is the call of that name: what the kernels read has no pickle."""
        return _call_of, (self.name,)

    def may_cost(self, problem: Problem, kernel: Any) -> float:
        """What the call over J and M may cost as counted [ns]; 0 where it is not made whatever it costs."""
        return 0.0 if self.limits is None else float(self.limits.cost(problem.metric, 0.0, kernel.islands)[1])

    def attempt(
        self, problem: Problem, impulse: FloatArray | None, tol: float, most: float = inf
    ) -> tuple[Any, Any]:
        """(what the judge finds, counts) from an impulse (m,) or from doing nothing.

        Where it does not converge the judge finds nothing, None, and counts are of what was done in vain: () where no
        call was made. most: counted cost [ns] at which it ends with what was found by then, above tol.
        """
        cache = problem.derived.cache
        if not tol > 0.0 or not len(problem.b):
            return None, ()
        call, failed_counts = cache.get(FAILED_CALL_KEY, (None, ()))
        if call is not None and call == self._call(problem, impulse, tol):
            return None, failed_counts
        if problem.generalized is not None:
            if self.limits is None:
                return None, ()
            found = solve_first(problem.derived.view, impulse, tol, self.limits, most)
        else:
            small = cache.get(COMPILED_CALL_KEY)
            if small is None and (problem.m <= SMALL_ROWS or self.hands_over):
                small = prepared(problem)
            if not small or not (self.pivots if pivots(problem) else self.hands_over):
                return None, ()
            found = small.run(impulse, tol, self.rules, most)
        if found[0] is None and most == inf:
            self.in_vain(problem, impulse, tol, found[1])
        made: tuple[Any, Any] = found
        return made

    def in_vain(
        self, problem: Problem, impulse: FloatArray | None, tol: float, counts: tuple[int, ...]
    ) -> None:
        """The call from there left it after these counts: it need not be made again before the full solver."""
        problem.derived.cache[FAILED_CALL_KEY] = self._call(problem, impulse, tol), counts

    def _call(self, problem: Problem, impulse: FloatArray | None, tol: float) -> tuple[str, float, bytes]:
        return self.name, tol, (problem._start if impulse is None else impulse).tobytes()

    def failed(self, problem: Problem, counts: tuple[int, ...] | None) -> list[tuple[str, Claim]]:
        """Who did what in a call of these counts, which did not solve the problem."""
        if counts is None or not any(counts):  # None: of a start that was judged and is the result
            return []
        if problem.generalized is not None:
            return [("newton", replace(general.claim(Status.STALLED, counts), iterations=0))]
        done = (_by_pivots if pivots(problem) else _in_turns)(counts)
        return [(name, Claim(Status.STALLED, 0, work)) for name, work in done[1]]

    def claim(
        self,
        problem: Problem,
        counts: tuple[int, ...] | None,
        start: FloatArray | None,
        after: float,
        status: Status = Status.CONVERGED,
    ) -> Claim:
        """The claim for a call with these counts, from a start (m,) or from none to a residual `after`."""
        nothing = NOTHING.get(status, NO_TIME)
        if counts is None:
            return Claim(status, 0, {}, nothing)
        if problem.generalized is not None:
            claim = general.claim(status, counts)
            if self.name == "newton":
                return claim
            done, ran = claim.iterations, [("newton", dict(claim.work))]
            if not any(claim.work.values()):
                return Claim(status, done, {}, nothing)
        else:
            done, ran = (_by_pivots if pivots(problem) else _in_turns)(counts)
        if self.name == "direct":
            rank, shifts = ran[0][1].get("rank"), ran[0][1].get("shifts")
            symmetric = problem.is_symmetric
            note = "A is not symmetric" if problem.law == "linear" and not symmetric else ""
            if rank:
                note = f"A is singular, rank {rank} of {problem.m}"
            elif shifts and problem.law != "linear":
                note = "A is singular on the free rows: shifted and refined"
            return Claim(status, done, ran[0][1], note, form="band" if symmetric else "LU")
        stages = _stages(problem, ran, start, after)
        return Claim(
            status, done, summed(stage.work for stage in stages), told(stages) or nothing, stages=stages
        )


Ran = list[tuple[str, dict[str, int]]]  # who, and what it did


def _by_pivots(counts: tuple[int, ...]) -> tuple[int, Ran]:
    """Iterations, and what was done, by the counts of `pivot_small`."""
    done, swept, refined, factored, exchanged, shifts, rank, path = counts
    work = {
        "sweeps": 4 * swept, "rank": rank, "shifts": shifts, "refinements": refined, "factorisations": factored,
        "pivots": exchanged,
    }  # fmt: skip
    direct = "direct", {what: count for what, count in work.items() if count}
    return done, [direct, ("lemke", {"pivots": path})] if path else [direct]


def _in_turns(counts: tuple[int, ...]) -> tuple[int, Ran]:
    """The same by those of sweeps in turns."""
    done, sweeps, restarts, factorisations, driven, count, *_ = counts
    where = f" on {count} islands" if count > 1 else ""
    ran = [("anderson" + where, {"sweeps": sweeps, "restarts": restarts})]
    if not sweeps and factorisations:
        ran = []
    if factorisations:
        where = f" on {driven} islands" if count > 1 else ""
        ran.append(("newton" + where, {"factorisations": factorisations}))
    return done, ran


def _stages(problem: Problem, ran: Ran, start: FloatArray | None, after: float) -> tuple[SolverStage, ...]:
    """Turns of one compiled call; nothing was measured between two."""
    if start is None or np.array_equal(start, problem._start):
        before = float(problem.metric.relative_at_zero)
    else:
        before = float(judge_impulse(problem, start.copy()).relative)
    at = [before, *(len(ran) - 1) * [nan], after]
    return tuple(SolverStage(*of, *at[i : i + 2]) for i, of in enumerate(ran))


def told(stages: Sequence[SolverStage]) -> str:
    """What ran, in words: turns of one solver in a row are one."""
    return " -> ".join(
        said(name, summed(stage.work for stage in of))
        for name, of in groupby(stages, key=lambda stage: stage.solver)
    )


def said(name: str, work: Mapping[str, int]) -> str:
    """What a solver did, in words."""
    between = " "
    for kind, count in work.items():
        if count:
            name += between + counted(count, kind)
            between = ", "
    return name


AUTO = SmallCall("auto", limits(SWEEPS, steps=AUTO_STEPS), True, True)
DIRECT = SmallCall("direct", None, True)
NEWTON = SmallCall("newton", limits(inf), False)


def _call_of(name: str) -> SmallCall:
    return {call.name: call for call in (AUTO, DIRECT, NEWTON)}[name]
