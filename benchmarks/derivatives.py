"""Derivatives of solutions beside differences of solves: do they agree, are disagreements flagged, what do they cost?

    python -m benchmarks derivatives [--draws 300] [--steps 250] [--models MODEL.xml]... [--out FILE]

A direction of v* (of b, where only a matrix is known) is drawn for each problem. The change of the slack along it is
compared with central differences of solutions whose residual is at most 1e-12 or at its floor. Their step h is the one
of STEPS whose neighbours differ least, and that difference is their own error; a derivative agrees within TIMES that,
or within 1e-6 of its size. Steps at whose ends a block is in another state cross a switch, and are left out: where none
remains a switch is nearer than differences can see, and nothing is compared. A derivative counts as flagged where a
block is about to switch, or what is compared is not unique.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import lavender as lv
from benchmarks.output import markdown
from lavender import suite

STEPS = 10.0 ** -np.arange(3.0, 10.5, 0.5)
AGREES = 1e-6
TIMES = 5.0
SOLVED = 1e-12
ROWS = 300
DRAWS = "wild(seed={}, rows=300)"


@dataclass(frozen=True)
class Compared:
    """One problem and direction."""

    source: str
    law: str
    operator: str
    rows: int
    flagged: str  # why; empty where it is not
    off: float  # - of the derivative's size
    error: float  # - of the differences


def robots(models: tuple[str, ...], steps: int) -> Iterator[lv.Problem]:
    """Steps of MuJoCo models under random controls, under their own law and with cones of two tangents."""
    import mujoco as mj

    from lavender.io import from_mujoco

    for path in models:
        for cone in (mj.mjtCone.mjCONE_PYRAMIDAL, mj.mjtCone.mjCONE_ELLIPTIC):
            model = mj.MjModel.from_xml_path(path)
            model.opt.cone = cone
            data, rng, count = mj.MjData(model), np.random.default_rng(1), 0
            low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-1.0, 1.0]).T
            for step in range(20 * steps):
                if step % 20 == 0:
                    data.ctrl[:] = rng.uniform(low, np.maximum(low, high))
                mj.mj_step(model, data)
                if step % 5 == 0 and data.nefc and count < steps:
                    mj.mj_forward(model, data)
                    count += 1
                    yield from_mujoco(model, data)


def sources(draws: int, steps: int, models: tuple[str, ...]) -> Iterator[tuple[str, lv.Problem]]:
    """(source, problem) of at most ROWS rows."""
    import benchmarks.drawn.wild  # noqa: F401 - registers the family

    for seed in range(draws):
        yield "drawn", suite.case(DRAWS.format(seed)).problem
    for case in (*suite.cases("default"), *suite.cases("hard")):
        yield "suite", case.problem
    for problem in robots(models, steps) if models else ():
        yield "robots", problem
        if problem.law == "cone":
            yield "robots", problem.relaxed("coulomb") if not problem.cones.has_round else problem


def solved(problem: lv.Problem, start: Any = None) -> lv.Solution | None:
    """A solution with a residual of at most 1e-12 or at its floor, or None."""
    solution = lv.solve(problem, tol=1e-14, impulse=start, time_limit=2.0)
    return solution if solution.residual.relative <= SOLVED or solution.residual.at_floor else None


def along(problem: lv.Problem, h: float, change: np.ndarray) -> lv.Problem:
    """The problem with h times a change of v*, or of b."""
    return replace(problem, b=problem.b + h * change, guess=None)


def compared(source: str, problem: lv.Problem, seed: int = 0) -> Compared | None:
    """Derivative beside differences; None where the problem is not solved."""
    rng, solution = np.random.default_rng(seed), solved(problem)
    if solution is None:
        return None
    d = lv.derivative(problem, solution)
    if problem.matrix is None:
        n = problem.jacobian.shape[1]
        change = -(problem.jacobian @ rng.standard_normal(n))  # of b, by v*
    else:
        change = rng.standard_normal(problem.m)
    size = float(np.abs(problem.b).max(initial=1e-3)) / max(float(np.abs(change).max(initial=0.0)), 1e-300)
    change = change * size
    found = d.jvp(b=change).slack
    told = []
    if d.switching:
        told.append("switching")
    if not d.unique.slack.all():
        told.append("slack")
    if problem.matrix is not None and not d.unique.target.all():
        told.append("target")
    weight = 1.0 / np.sqrt(problem.disk.d)

    def norm(x: np.ndarray) -> float:
        return float(np.linalg.norm(weight * x))

    # From nothing: a start at its floor would be kept as it is. Of several motions the nearest is wanted.
    start = solution.impulse if problem.law == "coulomb" else None
    best, error, before = None, np.inf, None
    for h in STEPS:
        low, high = (solved(along(problem, x, change), start) for x in (-h, h))
        if low is None or high is None:
            continue
        if any(not np.array_equal(x.states.case, solution.states.case) for x in (low, high)):
            continue
        now = (high.slack - low.slack) / (2.0 * h)
        # What the residuals leave in w, or rounding does: sqrt(J), as `norm` has it.
        left = sum(max(x.residual.energy, x.residual.floor * x.residual.energy_start) for x in (low, high))
        if before is not None and max(norm(now - before), left / (2.0 * h)) < error:
            best, error = now, max(norm(now - before), left / (2.0 * h))
        before = now
    if best is None:
        return Compared(source, problem.law, problem.operator, problem.m, " and ".join(told), np.nan, np.nan)
    scale = max(norm(best), norm(change) * 1e-3, 1e-300)
    off = norm(found - best) / scale
    return Compared(source, problem.law, problem.operator, problem.m, " and ".join(told), off, error / scale)


def agrees(line: Compared) -> bool:
    """Within 1e-6, or what differences know."""
    return line.off <= max(AGREES, TIMES * line.error)


def agreement(lines: list[Compared]) -> str:
    """By source, law and operator."""
    keys = sorted({(x.source, x.law, x.operator) for x in lines})
    rows: list[tuple[Any, ...]] = []
    for key in [*keys, None]:
        of = [x for x in lines if key is None or (x.source, x.law, x.operator) == key]
        seen = [x for x in of if not np.isnan(x.off)]
        free, wrong = [x for x in seen if not x.flagged], [x for x in seen if not agrees(x)]
        rows.append(
            (
                *(key or ("all", "", "")),
                len(of),
                f"{sum(bool(x.flagged) for x in of) / len(of):.1%}",
                len(of) - len(seen),
                f"{sum(map(agrees, free))} of {len(free)}",
                f"{sum(bool(x.flagged) for x in wrong)} of {len(wrong)}",
            )
        )
    head = (
        "source",
        "law",
        "given as",
        "problems",
        "flagged",
        "beyond differences",
        "agree of those not flagged",
        "flagged of those that disagree",
    )
    return markdown(head, rows)
