"""What each candidate of `auto` does alone, turn by turn: work, CPU time, and the residual that came of it.

    curve      (iterations, CPU time [s], relative residual), set-up first; best so far

A solver that goes on where it stood has one curve; one that does not, a run from the beginning for each level.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from lavender import registry
from lavender.bench.running.timing import one_thread
from lavender.errors import InputError
from lavender.problem import Problem
from lavender.residuals import judged, reference
from lavender.solution import Status

__all__ = ["CANDIDATES", "LEVELS", "Curve", "curves", "read", "write"]

LEVELS = (1e-3, 1e-6, 1e-9)
GROWTH = 1.25  # of the iterations between two points of a curve
SHORT = 0.03  # s of CPU time below which a run is made three times
FAR = 12.0  # times the least time to the middle level, after which the others are given up
LEAST = 0.05  # s that each has
# name: solver, options, whether it runs on the convex relaxation
CANDIDATES: dict[str, tuple[str, dict[str, Any], bool]] = {
    "anderson": ("anderson", {}, False),
    "nncg": ("nncg", {"order": "symmetric", "restart": "against"}, False),
    "relaxed": ("anderson", {}, True),
    "newton": ("newton", {}, False),
    "newton over rows": ("newton", {"form": "impulse"}, False),
    "newton over velocities": ("newton", {"form": "velocity"}, False),
    "direct": ("direct", {}, False),
    "admm": ("admm", {}, False),
    "lemke": ("lemke", {}, False),
}


@dataclass(frozen=True)
class Curve:
    """One candidate on one problem."""

    case: str
    reason: str
    rows: int
    law: str
    operator: str
    candidate: str
    setup: float  # s
    points: tuple[tuple[int, float, float], ...]  # (iterations, s with the set-up, least relative residual)
    status: str

    def time(self, level: float) -> float:
        """To that level [s]; inf where it was not reached."""
        return min((t for _, t, relative in self.points if relative <= level), default=math.inf)

    def iterations(self, level: float) -> float:
        """The same in iterations."""
        return min((n for n, _, relative in self.points if relative <= level), default=math.inf)


def write(path: Path, found: Iterable[Curve]) -> int:
    """One curve a line, as JSON; how many."""
    count = 0
    with path.open("w", encoding="utf-8") as file:
        for curve in found:
            file.write(json.dumps(asdict(curve)) + "\n")
            count += 1
    return count


def read(paths: Iterable[Path]) -> Iterator[Curve]:
    """What `write` wrote.

    Raises
    ------
    InputError
        A line that is no curve.
    """
    for path in paths:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            try:
                values = json.loads(line)
                yield Curve(
                    **values | {"points": tuple((int(n), float(t), float(r)) for n, t, r in values["points"])}
                )
            except (ValueError, TypeError, KeyError) as error:
                raise InputError(
                    f"{path}, line {number} is no curve ({error}); `--record` writes them"
                ) from None


def takes(problem: Problem, candidate: str) -> bool:
    """Whether the candidate is one for this problem, and not another's twin on it."""
    name, options, relaxed = CANDIDATES[candidate]
    if relaxed:
        return problem.law == "coulomb"
    if registry.get(name).refuses(problem) is not None:
        return False
    if options.get("form") == "impulse":
        return problem.matrix is None and not problem.cones.has_round
    return options.get("form") != "velocity" or problem.generalized is not None


def curves(
    cases: Iterable[tuple[str, str, Problem]], *, time_limit: float = 1.0, candidates: Sequence[str] = ()
) -> Iterator[Curve]:
    """The curve of each candidate on each problem, one after the other.

    Parameters
    ----------
    cases : iterable of (name, reason, problem)
    time_limit : s of CPU time, of one curve
    candidates : names of `CANDIDATES`; all of them if empty
    """
    for case, reason, problem in cases:
        least = math.inf
        for candidate in candidates or CANDIDATES:
            if not problem.m or not takes(problem, candidate):
                continue
            limit = min(time_limit, max(LEAST, FAR * least))
            setup, points, status = _several(problem, candidate, limit)
            made = Curve(
                case=case, reason=reason, rows=problem.m, law=problem.law, operator=problem.operator,
                candidate=candidate, setup=setup, points=tuple(points), status=status,
            )  # fmt: skip
            least = min(least, made.time(LEVELS[1]))
            yield made


def _several(problem: Problem, candidate: str, limit: float) -> tuple[float, list[Any], str]:
    """Short runs three times: the least time to each point, which are the same in each."""
    spec = registry.get(CANDIDATES[candidate][0])
    run = _resumed if spec.resumable else _repeated
    found = run(problem, candidate, limit)
    if found[1] and found[1][-1][1] < SHORT:
        more = [found, run(problem, candidate, limit), run(problem, candidate, limit)]
        count = min(len(points) for _, points, _ in more)
        points = [(found[1][i][0], min(p[i][1] for _, p, _ in more), found[1][i][2]) for i in range(count)]
        return min(s for s, _, _ in more), points, found[2]
    return found


def _fresh(problem: Problem, candidate: str) -> tuple[Problem, Problem, Any]:
    """Nothing derived yet: the problem, what is solved in its place, and the solver."""
    name, options, relaxed = CANDIDATES[candidate]
    fresh = replace(problem.disk, copy=False)
    reference(fresh)
    return fresh, fresh.relaxed("cone") if relaxed else fresh, registry.get(name).load()(**options)


@np.errstate(all="ignore")
def _resumed(problem: Problem, candidate: str, limit: float) -> tuple[float, list[Any], str]:
    fresh, solved, solver = _fresh(problem, candidate)
    lam = fresh.start()
    points: list[tuple[int, float, float]] = []
    with one_thread():
        begun = process_time()
        try:
            state = solver.prepare(solved)
        except Exception as error:  # what cannot be prepared is no candidate here
            return process_time() - begun, [], f"{type(error).__name__}"
        spent = setup = process_time() - begun
        done, best, step = 0, math.inf, 1
        while True:
            begun = process_time()
            claim = solver.run(
                state, lam, step, 0.1 * LEVELS[-1] if solved is not fresh else LEVELS[-1], None
            )
            spent += process_time() - begun
            done += claim.iterations
            best = min(best, judged(fresh, lam.copy()).relative) if np.isfinite(lam).all() else best
            points.append((done, spent, best))
            ended = claim.status is not Status.MAX_ITERATIONS or claim.iterations < 1
            if ended or best <= LEVELS[-1] or spent > limit:
                return setup, points, claim.status.name
            step = max(1, math.ceil((GROWTH - 1.0) * done))


@np.errstate(all="ignore")
def _repeated(problem: Problem, candidate: str, limit: float) -> tuple[float, list[Any], str]:
    points: list[tuple[int, float, float]] = []
    best, setup, status = math.inf, 0.0, ""
    spec = registry.get(CANDIDATES[candidate][0])
    for level in LEVELS:
        fresh, solved, solver = _fresh(problem, candidate)
        lam = fresh.start()
        with one_thread():
            begun = process_time()
            try:
                state = solver.prepare(solved)
                setup = process_time() - begun
                claim = solver.run(state, lam, spec.max_iter, level, limit)
            except Exception as error:
                return setup, points, f"{type(error).__name__}"
            spent = process_time() - begun
        relative = judged(fresh, lam.copy()).relative if np.isfinite(lam).all() else math.inf
        best, status = min(best, relative), claim.status.name
        points.append((claim.iterations, max([spent, *(t for _, t, _ in points)]), best))
        if relative > level or spent > limit:
            break
    return setup, points, status
