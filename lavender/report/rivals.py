"""The page's part on other engines and solvers, from a run that `lavender.bench.peers` keeps.

Named `rivals`, since `peers` is the run itself. Ratios and tables are those of `compared`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from lavender.bench.peers import Peers
from lavender.bench.peers.contest import SCRATCH, TARGETS, Result
from lavender.bench.peers.engines import Step
from lavender.bench.record import level_name
from lavender.report import compared
from lavender.report.curves import TINY, Curve, Figure
from lavender.report.text import seconds

__all__ = ["content", "figures"]

OURS, THEIRS = 4, 8  # curves of a problem: the fastest of each side


def figures(peers: Peers) -> dict[str, tuple[Figure, ...]]:
    """By place on the page: "over" all problems, "scenes" of engines, "problems" of solvers."""
    over = (_ratios(peers.results),) if peers.results else ()
    scenes = tuple(_scene(name, peers.steps) for name in dict.fromkeys(s.scene for s in peers.steps))
    problems = tuple(
        _problem(name, peers.results) for name in dict.fromkeys(r.problem for r in peers.results)
    )
    drawn = {"over": over, "scenes": scenes, "problems": problems}
    return {place: tuple(f for f in some if f.curves) for place, some in drawn.items()}


def content(peers: Peers) -> dict[str, Any]:
    """Heads and rows of the tables, each row with whether ours lost it, and what was not measured."""
    found = compared.compare(peers.results)
    reached = [c for c in found if math.isfinite(min(c.our_time, c.peer_time))]
    return {
        "cpu": peers.cpu,
        "versions": peers.versions,
        "absent": peers.absent,
        "notes": [f"{r.solver} on {r.problem}: {r.note}" for r in peers.results if r.note],
        "means": compared.mean_table(peers.results),
        "compared": compared.solver_table(reached),
        "steps": compared.step_table(peers.steps),
        "lost": len(compared.losses(found)),
        "known": sum(math.isfinite(c.peer_time) for c in found),
    }


def _ratios(results: Sequence[Result]) -> Figure:
    """Time of ours over the fastest peer's against the number of rows, one curve for each error."""
    curves = []
    for target in TARGETS:
        some = [c for c in compared.compare(results) if c.target == target and 0.0 < c.ratio < math.inf]
        some.sort(key=lambda c: (c.rows, c.problem))
        label = "to " + level_name(target)
        curves.append(
            Curve(
                label,
                label,
                tuple(float(c.rows) for c in some),
                tuple(c.ratio for c in some),
                tuple(
                    f"{c.problem}: {c.ours} {seconds(c.our_time)}, {c.peer} {seconds(c.peer_time)}"
                    for c in some
                ),
                points=True,
            )
        )
    return Figure(
        "peers", "ours over the fastest peer, below 1: ours is faster", "rows", "ratio of times",
        tuple(c for c in curves if c.x), levels=(1.0,),
    )  # fmt: skip


def _scene(scene: str, steps: Sequence[Step]) -> Figure:
    """Speed left against the time of a step, one point for each engine."""
    curves = tuple(
        Curve(s.engine, s.engine, (s.time,), (max(s.speed, TINY),), points=True)
        for s in steps
        if s.scene == scene and math.isfinite(s.time) and math.isfinite(s.speed)
    )
    return Figure("peers scene " + scene, scene, "time of a step [s]", "speed left [m/s]", curves)


def _problem(problem: str, results: Sequence[Result]) -> Figure:
    """Error against time of the fastest of both sides."""
    here = [r for r in results if r.problem == problem and r.runs and not r.solver.endswith(SCRATCH)]
    shown: list[Result] = []
    for peer, most in ((False, OURS), (True, THEIRS)):
        side = sorted((r for r in here if r.peer is peer), key=_score)
        shown += side[:most]
    curves = []
    for r in shown:
        times, residuals = zip(*r.runs, strict=True)
        drawn = tuple(max(x, TINY) for x in residuals)
        curves.append(Curve(r.solver, r.solver, times, drawn, thin=r.peer).front)
    return Figure(
        "peers " + problem, f"{problem} (thin: of others)", "time: set-up and solve [s]", "relative residual [-]",
        tuple(curves), levels=TARGETS,
    )  # fmt: skip


def _score(r: Result) -> tuple[int, float]:
    """Most errors reached first, then the least product of times."""
    times = [r.time(target) for target in TARGETS]
    reached = [t for t in times if math.isfinite(t)]
    return -len(reached), math.prod(reached) ** (1.0 / max(len(reached), 1))
