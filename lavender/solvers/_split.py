"""Islands solved in one compiled call, and what is said of them; `lavender_ext/few/islands.pyx` has the loop.

Each goes the way of a problem of few rows, to its share of the whole tolerance. What that does not end is left.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender._arrays import IntArray
from lavender.registry import FEW
from lavender.residuals import reference
from lavender.solution import Claim, Status
from lavender.solvers import _rates as rates
from lavender.solvers._few import WARM
from lavender.solvers._gates import FIRST_LOOK, GENERAL_GATE, NO_GATE
from lavender.solvers._log import CLOCK, SolveLog
from lavender.solvers._newton import general
from lavender_ext.core import assemble
from lavender_ext.few.islands import BY_PIVOTS, BY_SWEEPS, BY_VELOCITIES, LEFT, Islands
from lavender_ext.few.many import Gate
from lavender_ext.local import gauss_seidel

__all__ = ["solve_together"]

BAND_APART = 1e6  # ns of `direct` on a narrow band of an island, up to which it comes before sweeps
LARGEST = 2000  # rows of an island that is solved so
# Sweeps of an island go on whatever they promise for such a share of what else there is, and for so many times that.
HOPE, BELIEVED = 0.25, 2.0
# What Newton's method may cost in an island of J and M [ns]: there is no other there.
GATE = Gate((*GENERAL_GATE[:3], 1e7, 0.0, GENERAL_GATE[5], NO_GATE))
ENTRIES = 100  # of A for each row, up to which it is formed for pivots where bodies are given
COUNTS: dict[
    int, tuple[str, tuple[tuple[str, int, int], ...]]
] = {  # solver; of its work: place and unit of a count
    BY_PIVOTS: (
        "direct",
        (
            ("sweeps", 1, 4),
            ("shifts", 5, 1),
            ("refinements", 2, 1),
            ("factorisations", 3, 1),
            ("pivots", 4, 1),
        ),
    ),
    BY_SWEEPS: ("anderson", (("sweeps", 1, 1), ("restarts", 2, 1))),
    BY_VELOCITIES: (
        "newton",
        (("factorisations", 1, 1), ("updates", 2, 1), ("Coulomb rounds", 3, 1), ("line evaluations", 4, 1)),
    ),
}


def asked(log: SolveLog, share: float, n: int, each: float) -> tuple[Any, ...]:
    """What `Islands.run` is asked for: n sweeps of an island at most, fewer by what else there is for a row [ns]."""
    problem = log.problem
    law = problem.law
    velocity = reference(problem)[1]
    pivots = law in ("linear", "lcp") and problem.generalized is None
    return (
        log.tol, share, log.tol * velocity, WARM, min(n, 2**31 - 1),
        pivots and _entries_fit(log), law == "linear", problem.rows is not None,
        law != "linear", law == "cone", FEW, rates.NARROW, rates.DIRECT.get(law, 0.0) * rates.BAND, BAND_APART,
        rates.SWEEP[law], rates.SWEEP_ROW, FIRST_LOOK, each, HOPE, BELIEVED,
    )  # fmt: skip


def _entries_fit(log: SolveLog) -> bool:
    problem = log.problem
    return problem.rows is None or int(assemble.bound(problem.data)[0]) <= ENTRIES * problem.m


def takes(log: SolveLog) -> bool:
    """Whether there are islands that may be solved so."""
    problem = log.problem
    if problem.cones.has_rolling or (problem.generalized is None and problem.cones.has_round):
        return False
    return log.islands[0] > 1


def solve_together(log: SolveLog, budget: int, each: float) -> IntArray:
    """Solve every small island that misses its share of the tolerance; those that are left, in order.

    Sweeps of an island are given up where they cost more than `each` [ns] for each of its rows, as what else there is.

    The log is offered the impulse and told what ran. Iterations are those of the island that took most: they go on
    side by side.
    """
    problem = log.problem
    count, label = log.islands
    wrong, of_row, share = log.wrong_islands()
    if not takes(log):
        return wrong
    small = np.bincount(of_row, minlength=count) <= LARGEST
    if len(problem.metric.empty):
        small[of_row[problem.metric.empty]] = False
    wanted = np.zeros(count, np.int32)
    wanted[wrong] = small[wrong]
    if not wanted.any():
        return wrong
    options = asked(log, share, budget - log.iterations, each)
    pivots = options[5]
    matrix = problem.csr_data if pivots and problem.rows is not None else None
    exact = problem.law == "cone" and problem.generalized is None
    prepared = gauss_seidel.prepare(problem.metric) if exact else None
    impulse, before = log.impulse.copy(), log.best
    work = Islands(problem.metric, matrix, label, wanted, impulse, prepared)
    more, late = True, False
    try:
        while more and not late:  # a cut for Ctrl-C and the clock, which changes no bit
            more = work.run(options, GATE, general.ROOM, 1e9 * CLOCK, impulse)
            late = log.late
    finally:
        report = work.report()
        found = log.offer(impulse)
        if not found <= log.best:
            # An island that came nearer by its own measure may have moved away by the whole's.
            back = (report[:, 0] == LEFT)[of_row]
            impulse[back] = log.impulse[back]
            found = log.offer(impulse)
        if found == log.best:
            log.impulse = impulse  # the worst row may be that of another island
        _tell(log, report[(wanted != 0) & (report[:, 0] != LEFT)], before)
    left: IntArray = wrong[report[wrong, 0] == LEFT]
    return left


def _tell(log: SolveLog, report: Any, before: float) -> None:
    for end, (name, counts) in COUNTS.items():
        rows = report[report[:, 0] == end]
        if len(rows):
            own = rows[rows[:, 8] == 0]  # those that are not like another
            work = {what: int(unit * own[:, 1 + place].sum(dtype=np.int64)) for what, place, unit in counts}
            work = {what: count for what, count in work.items() if count}
            islands = "an island" if len(rows) == 1 else f"{len(rows)} islands"
            log.note(
                f"{name} on {islands}", Claim(Status.MAX_ITERATIONS, int(rows[:, 1].max()), work), before
            )
