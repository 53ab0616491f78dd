"""What each solver does alone on a problem, turn by turn, and `auto` beside them, in one run.

    points     (iterations, CPU time [s] with the set-up, least relative residual)

A solver that goes on where it stopped has one curve; one that does not, and `auto`, a run from the beginning for each
level.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from time import process_time
from typing import Any

import numpy as np

import lavender as lv
from lavender import registry
from lavender.base import deadline
from lavender.judge.residuals import reference
from lavender.judge.solution import Status
from lavender.lab.bench.running.timing import one_thread
from lavender.problem import Problem
from lavender.solvers.loop import Loop
from lavender.solvers.steps import METHODS, MOST, made

__all__ = ["LEVELS", "SOLVERS", "Record", "records"]

LEVELS = (1e-3, 1e-6, 1e-9)
SHORT = 0.03  # s of CPU time below which a run is made three times
FAR, LEAST = 12.0, 0.05  # times the least time to the middle level, and s, after which a solver is given up
LONG = 30.0  # times the limit of one curve, that `auto` has: a limit that may be short changes its tree
SOLVERS: dict[str, tuple[str, dict[str, Any]]] = METHODS | {"auto": ("auto", {})}
Points = list[tuple[int, float, float]]


@dataclass(frozen=True)
class Record:
    """One solver on one problem."""

    case: str
    solver: str  # of SOLVERS
    setup: float  # s
    points: Points

    def to(self, level: float) -> tuple[float, float]:
        """(s, iterations) to that level; inf where it was not reached."""
        there = ((t, n) for n, t, relative in self.points if relative <= level)
        return min(there, default=(math.inf, math.inf))


def takes(problem: Problem, name: str) -> bool:
    """Whether the solver is one for this problem, and not another's twin on it."""
    if name == "newton over rows" and (problem.generalized is None or problem.cones.has_round):
        return False
    return problem.m > 0 and registry.get(SOLVERS[name][0]).refuses(problem) is None


def records(cases: Iterable[tuple[str, Problem]], time_limit: float = 1.0) -> Iterator[Record]:
    """All solvers on each problem, one after the other; `time_limit`: s of CPU time of one curve."""
    clock = deadline.perf_counter
    deadline.perf_counter = process_time  # or what else this machine does would end solvers early
    try:
        for case, problem in cases:
            least = math.inf
            for name in filter(lambda name: takes(problem, name), SOLVERS):
                run = resumed if registry.get(SOLVERS[name][0]).resumable else repeated
                limit = min(time_limit, max(LEAST, FAR * least)) if name != "auto" else LONG * time_limit
                found = [run(problem, name, limit)]
                if found[0][1][-1][1] < SHORT:
                    found += [run(problem, name, limit) for _ in range(2)]
                one = Record(case, name, *min(found, key=lambda run: run[1][-1][1]))
                least = min(least, one.to(LEVELS[1])[0])
                yield one
    finally:
        deadline.perf_counter = clock


@np.errstate(all="ignore")
def resumed(problem: Problem, name: str, limit: float) -> tuple[float, Points]:
    """One curve; what judges its points takes no time of it."""
    fresh = replace(problem.disk, copy=False)
    reference(fresh)
    solver: Any = made(name, fresh)
    with one_thread():
        begun = process_time()
        state = solver.prepare(fresh)
        setup = process_time() - begun
        loop = Loop(
            problem=fresh, solver=solver, state=state, impulse=fresh.start(), tol=LEVELS[-1],
            deadline=deadline.Deadline(limit), records=[],
        )  # fmt: skip
        loop.run(MOST)
    found: Any = loop.recorded()
    least = np.fmin.accumulate(found.relative)
    return setup, np.column_stack((found.iterations, setup + found.time, least)).tolist()


def repeated(problem: Problem, name: str, limit: float) -> tuple[float, Points]:
    """One run from the beginning for each level."""
    points, setup, most = Points(), 0.0, 0.0
    for level in LEVELS:
        fresh = replace(problem.disk, copy=False)
        reference(fresh)
        with one_thread():
            begun = process_time()
            prepared = lv.prepare(fresh, SOLVERS[name][0], **SOLVERS[name][1])
            setup = process_time() - begun
            found = prepared.solve(tol=level, time_limit=limit)
            most = max(most, process_time() - begun)
        proven = found.status in (Status.FLOOR, Status.INFEASIBLE) and found.claim_check == "confirmed"
        points.append((found.iterations, most, min(found.residual.relative, level if proven else math.inf)))
        if points[-1][2] > level or most > limit:
            break
    return setup, points
