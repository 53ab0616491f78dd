"""What each solver does alone on a problem, turn by turn, and `auto` beside them: CPU time and residual.

    record     one solver: (iterations, CPU time [s], least relative residual), set-up first; of `auto` one point a level

A solver that goes on where it stopped has one curve; one that does not, a run from the beginning for each level.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

import lavender as lv
from lavender import registry
from lavender.bench.running.timing import one_thread
from lavender.errors import InputError
from lavender.problem import Problem
from lavender.residuals import judged, reference
from lavender.solution import Status

__all__ = ["LEVELS", "SOLVERS", "Record", "read", "records"]

LEVELS = (1e-3, 1e-6, 1e-9)
GROWTH = 1.25  # of the iterations between two points of a curve
SHORT = 0.03  # s of CPU time below which a run is made three times
FAR = 12.0  # times the least time to the middle level, after which the others are given up
LEAST = 0.05  # s that each has
# name: solver, options
SOLVERS: dict[str, tuple[str, dict[str, Any]]] = {
    "anderson": ("anderson", {}),
    "nncg": ("nncg", {"order": "symmetric", "restart": "against"}),
    "relaxation": ("anderson", {}),
    "newton": ("newton", {"form": "auto"}),
    "newton over rows": ("newton", {"form": "impulse"}),
    "direct": ("direct", {}),
    "admm": ("admm", {}),
    "auto": ("auto", {}),
}


@dataclass(frozen=True)
class Record:
    """One solver on one problem."""

    case: str
    rows: int
    law: str
    operator: str
    solver: str  # of SOLVERS
    setup: float  # s
    points: tuple[tuple[int, float, float], ...]  # (iterations, s with the set-up, least relative residual)
    told: str  # its last message

    def to(self, level: float) -> tuple[float, float]:
        """(s, iterations) to that level; inf where it was not reached."""
        return min(
            ((t, n) for n, t, relative in self.points if relative <= level), default=(math.inf, math.inf)
        )


def read(paths: Iterable[Path]) -> Iterator[Record]:
    """What `--record` wrote.

    Raises
    ------
    InputError
        A line that is no record.
    """
    for path in paths:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            try:
                values = json.loads(line)
                yield Record(
                    **values | {"points": tuple((int(n), float(t), float(r)) for n, t, r in values["points"])}
                )
            except (ValueError, TypeError, KeyError) as error:
                raise InputError(
                    f"{path}, line {number} is no record ({error}); `--record` writes them"
                ) from None


def as_line(record: Record) -> str:
    """As JSON."""
    return json.dumps(asdict(record)) + "\n"


def takes(problem: Problem, name: str) -> bool:
    """Whether the solver is one for this problem, and not another's twin on it."""
    solver, options = SOLVERS[name]
    if name == "relaxation":
        return problem.law == "coulomb"
    if options.get("form") == "impulse" and (problem.generalized is None or problem.cones.has_round):
        return False
    return registry.get(solver).refuses(problem) is None


def records(cases: Iterable[tuple[str, Problem]], time_limit: float = 1.0) -> Iterator[Record]:
    """All solvers on each problem, one after the other; `time_limit`: s of CPU time of one curve."""
    for case, problem in cases:
        least = math.inf
        for name in SOLVERS:
            if not problem.m or not takes(problem, name):
                continue
            limit = time_limit if name == "auto" else min(time_limit, max(LEAST, FAR * least))
            setup, points, told = several(problem, name, limit)
            made = Record(case, problem.m, problem.law, problem.operator, name, setup, tuple(points), told)
            least = min(least, made.to(LEVELS[1])[0])
            yield made


def several(problem: Problem, name: str, limit: float) -> tuple[float, list[Any], str]:
    """Short runs three times: the least time to each point, which are the same in each."""
    run = resumed if registry.get(SOLVERS[name][0]).resumable else repeated
    found = [run(problem, name, limit)]
    if found[0][1] and found[0][1][-1][1] < SHORT:
        found += [run(problem, name, limit) for _ in range(2)]
    count = min(len(points) for _, points, _ in found)
    points = [(found[0][1][i][0], min(p[i][1] for _, p, _ in found), found[0][1][i][2]) for i in range(count)]
    return min(setup for setup, _, _ in found), points, found[0][2]


@np.errstate(all="ignore")
def resumed(problem: Problem, name: str, limit: float) -> tuple[float, list[Any], str]:
    """A curve of points; the time between them is the solver's alone."""
    fresh = replace(problem.disk, copy=False)
    reference(fresh)
    solved = fresh.relaxed("cone") if name == "relaxation" else fresh
    solver: Any = registry.get(SOLVERS[name][0]).load()(**SOLVERS[name][1])
    lam, points = fresh.start(), list[tuple[int, float, float]]()
    with one_thread():
        begun = process_time()
        state = solver.prepare(solved)
        spent = setup = process_time() - begun
        done, best, step = 0, math.inf, 1
        while True:
            begun = process_time()
            claim = solver.run(state, lam, step, (1.0 if solved is fresh else 0.1) * LEVELS[-1], None)
            spent += process_time() - begun
            done += claim.iterations
            best = min(best, judged(fresh, lam.copy()).relative) if np.isfinite(lam).all() else best
            points.append((done, spent, best))
            ended = claim.status is not Status.MAX_ITERATIONS or claim.iterations < 1
            if ended or best <= LEVELS[-1] or spent > limit:
                return setup, points, claim.status.name
            step = max(1, math.ceil((GROWTH - 1.0) * done))


def repeated(problem: Problem, name: str, limit: float) -> tuple[float, list[Any], str]:
    """One run from the beginning for each level."""
    points, setup, told, worst = list[tuple[int, float, float]](), 0.0, "", 0.0
    for level in LEVELS:
        fresh = replace(problem.disk, copy=False)
        reference(fresh)
        with one_thread():
            begun = process_time()
            prepared = lv.prepare(fresh, SOLVERS[name][0], **SOLVERS[name][1])
            setup = process_time() - begun
            found = prepared.solve(tol=level, time_limit=limit if name != "auto" else None)
            worst = max(worst, process_time() - begun)
        proven = found.status in (Status.FLOOR, Status.INFEASIBLE) and not found.contradicted
        points.append((found.iterations, worst, min(found.residual.relative, level if proven else math.inf)))
        told = found.message or found.status.name
        if points[-1][2] > level or worst > limit:
            break
    return setup, points, told
