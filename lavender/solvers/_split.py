"""Islands solved in one compiled call, and what is said of them; `lavender_ext/few/islands.pyx` has the loop.

Each goes the way of a problem of few rows, to its share of the whole tolerance. What that does not end is left.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender._arrays import IntArray
from lavender.registry import FEW
from lavender.residuals import reference
from lavender.solvers import _rates as rates
from lavender.solvers._few import WARM
from lavender.solvers._first import GENERAL_GATE, NO_GATE
from lavender.solvers._newton import general
from lavender.solvers._sweepers import BELIEVED, HOPE
from lavender.solvers._trail import CLOCK, Trail
from lavender_ext.core import assemble
from lavender_ext.few.islands import AT_START, BY_PIVOTS, BY_SWEEPS, BY_VELOCITIES, LEFT, Islands
from lavender_ext.few.many import Gate
from lavender_ext.local import gauss_seidel

__all__ = ["solve_together"]

BAND_APART = 1e6  # ns of `direct` on a narrow band of an island, up to which it comes before sweeps
LARGEST = 2000  # rows of an island that is solved so
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


def asked(trail: Trail, share: float, n: int, each: float) -> tuple[Any, ...]:
    """What `Islands.run` is asked for: n sweeps of an island at most, fewer by what else there is for a row [ns]."""
    problem = trail.problem
    law = problem.law
    velocity = reference(problem)[1]
    pivots = law in ("linear", "lcp") and problem.generalized is None
    return (
        trail.tol, share, trail.tol * velocity, WARM, min(n, 2**31 - 1),
        pivots and _entries_fit(trail), law == "linear", problem.rows is not None,
        law != "linear", law == "cone", FEW, rates.NARROW, rates.DIRECT.get(law, 0.0) * rates.BAND, BAND_APART,
        rates.SWEEP[law], rates.SWEEP_ROW, rates.FIRST_LOOK, each, HOPE, BELIEVED,
    )  # fmt: skip


def _entries_fit(trail: Trail) -> bool:
    problem = trail.problem
    return problem.rows is None or int(assemble.bound(problem.data)[0]) <= ENTRIES * problem.m


def takes(trail: Trail) -> bool:
    """Whether there are islands that may be solved so."""
    problem = trail.problem
    return (problem.generalized is not None or not problem.cones.has_round) and trail.islands[0] > 1


def solve_together(trail: Trail, budget: int, each: float) -> IntArray:
    """Solve every small island that misses its share of the tolerance; those that are left, in order.

    Sweeps of an island are given up where they cost more than `each` [ns] for each of its rows, as what else there is.

    The trail is offered the impulse and told what ran. Iterations are those of the island that took most: they go on
    side by side.
    """
    problem = trail.problem
    count, label = trail.islands
    wrong, of_row, share = trail.wrong_islands()
    if not takes(trail):
        return wrong
    small = np.bincount(of_row, minlength=count) <= LARGEST
    if len(problem.metric.empty):
        small[of_row[problem.metric.empty]] = False
    wanted = np.zeros(count, np.int32)
    wanted[wrong] = small[wrong]
    if not wanted.any():
        return wrong
    options = asked(trail, share, budget - trail.iterations, each)
    pivots = options[5]
    matrix = problem.csr_data if pivots and problem.rows is not None else None
    exact = problem.law == "cone" and problem.generalized is None
    prepared = gauss_seidel.prepare(problem.metric) if exact else None
    impulse = trail.impulse.copy()
    work = Islands(problem.metric, matrix, label, wanted, impulse, prepared)
    more, late = True, False
    try:
        while more and not late:  # a cut for Ctrl-C and the clock, which changes no bit
            more = work.run(options, GATE, general.ROOM, 1e9 * CLOCK, impulse)
            late = trail.late
    finally:
        report = work.report()
        found = trail.offer(impulse)
        if not found <= trail.best:
            # An island that came nearer by its own measure may have moved away by the whole's.
            back = (report[:, 0] == LEFT)[of_row]
            impulse[back] = trail.impulse[back]
            found = trail.offer(impulse)
        if found == trail.best:
            trail.impulse = impulse  # the worst row may be that of another island
        _tell(trail, report[(wanted != 0) & (report[:, 0] != LEFT)], count)
    left: IntArray = wrong[report[wrong, 0] == LEFT]
    return left


def _tell(trail: Trail, report: Any, count: int) -> None:
    parts = []
    for end, (name, counts) in COUNTS.items():
        rows = report[report[:, 0] == end]
        if not len(rows):
            continue
        own = rows[rows[:, 8] == 0]
        done = []
        for what, place, unit in counts:
            every = unit * rows[:, 1 + place]
            low, high = int(every.min()), int(every.max())
            if high:
                done.append(f"{low} to {high} {what}" if low < high else f"{high} {what}")
                total = int(unit * own[:, 1 + place].sum(dtype=np.int64))
                trail.work[what] = trail.work.get(what, 0) + total
        copies = len(rows) - len(own)
        text = f"{len(rows)} x {name} {', '.join(done)}" + (f" ({copies} alike)" if copies else "")
        parts.append(text.replace("1 x ", "", 1) if len(rows) == 1 else text)
        trail.iterations += int(rows[:, 1].max())
    solved = int((report[:, 0] != AT_START).sum())
    if parts:
        trail.steps.append(f"{solved} of {count} islands: {'; '.join(parts)}")
