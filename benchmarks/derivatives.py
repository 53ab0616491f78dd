"""Derivatives of solutions: agreement with finite differences, flags of those that disagree, and cost.

    python -m benchmarks derivatives [--draws 300] [--steps 125] [--models MODEL.xml]...

A random direction of v* (of b, if only a matrix is known) is drawn for each problem. The change of the slack along it
is compared with central differences of solutions with a residual of at most 1e-12 or at the round-off floor. The step h
has the smallest error estimate: the difference between neighbouring steps, or the residuals of both ends over 2 h.
A derivative agrees if it is within TIMES that error, or within 1e-6 of its size. Steps that change the state of a block
cross a switch and are not used; if no step remains, a switch is closer than differences can resolve, and the problem is
not compared. A derivative counts as flagged if a block is close to a switch, if the compared quantity is not unique, or
if the derivative raises an error along this direction.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np

import lavender as lv
from benchmarks.output import markdown
from lavender import suite

DIFFERENCE_STEPS = 10.0 ** -np.arange(3.0, 10.5, 0.5)
AGREES = 1e-6
TIMES = 5.0
SOLVED = 1e-12
ROWS = 300
REFUSED = "refused"
AGAIN = 8  # additional calls, timed together: one call is close to the resolution of the clock


@dataclass(frozen=True)
class Compared:
    """Comparison of one problem along one direction."""

    source: str
    law: str
    operator: str
    rows: int
    flagged: str  # reason; empty if not flagged
    off: float  # difference relative to the derivative's size
    error: float  # estimated relative error of the differences


def robots(models: tuple[str, ...], steps: int) -> Iterator[lv.Problem]:
    """Yield steps of MuJoCo models under random controls, with their own law and with cones of two tangents."""
    import mujoco as mj

    from lavender.io import from_mujoco

    for path in models:
        for cone in (mj.mjtCone.mjCONE_PYRAMIDAL, mj.mjtCone.mjCONE_ELLIPTIC):
            model = mj.MjModel.from_xml_path(path)
            model.opt.cone = cone
            data = mj.MjData(model)
            rng = np.random.default_rng(1)
            count = 0
            low, high = np.where(
                model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-1.0, 1.0]
            ).T
            for step in range(20 * steps):
                if step % 20 == 0:
                    data.ctrl[:] = rng.uniform(low, np.maximum(low, high))
                mj.mj_step(model, data)
                if step % 5 == 0 and data.nefc and count < steps:
                    mj.mj_forward(model, data)
                    count += 1
                    yield from_mujoco(model, data)


def sources(draws: int, steps: int, models: tuple[str, ...]) -> Iterator[tuple[str, lv.Problem]]:
    """Yield (source, problem) with at most ROWS rows."""
    from benchmarks.random_families import wild

    for seed in range(draws):
        problem = wild(seed=seed, rows=ROWS).problem
        if 0 < problem.m <= ROWS:
            yield "drawn", problem
    for case in (*suite.cases("default"), *suite.cases("hard")):
        if 0 < case.problem.m <= ROWS:
            yield "suite", case.problem
    for problem in robots(models, steps) if models else ():
        yield "robots", problem
        if problem.law == "cone":
            yield "robots", problem.relaxed("coulomb") if not problem.cones.has_round else problem


def solved(problem: lv.Problem, start: Any = None) -> lv.Solution | None:
    """Return a solution with a residual of at most 1e-12 or at the floor, or None."""
    solution = lv.solve(problem, tol=1e-14, impulse=start, time_limit=2.0)
    return solution if solution.residual.relative <= SOLVED or solution.residual.at_floor else None


def along(problem: lv.Problem, h: float, change: np.ndarray) -> lv.Problem:
    """Return the problem with v*, or b, changed by h times `change`."""
    return replace(problem, b=problem.b + h * change, guess=None)


def compared(source: str, problem: lv.Problem, seed: int = 0) -> Compared | None:
    """Compare the derivative with differences; return None if the problem is not solved."""
    rng = np.random.default_rng(seed)
    solution = solved(problem)
    if solution is None:
        return None
    d = lv.derivative(problem, solution)
    if problem.matrix is None:
        n = problem.jacobian.shape[1]
        change = -(problem.jacobian @ rng.standard_normal(n))  # change of b due to v*
    else:
        change = rng.standard_normal(problem.m)
    size = float(np.abs(problem.b).max(initial=1e-3)) / max(
        float(np.abs(change).max(initial=0.0)), 1e-300
    )
    change = change * size
    try:
        found = d.jvp(b=change).slack
    except lv.CapabilityError:  # the direction changes one of several rows that share a load
        return Compared(source, problem.law, problem.operator, problem.m, REFUSED, np.nan, np.nan)
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

    # Start from zero: a start at the floor would be returned unchanged. If there are several motions, use the nearest.
    start = solution.impulse if problem.law == "coulomb" else None
    best = None
    error = np.inf
    before = None
    for h in DIFFERENCE_STEPS:
        low, high = (solved(along(problem, x, change), start) for x in (-h, h))
        if low is None or high is None:
            continue
        if any(not np.array_equal(x.states.case, solution.states.case) for x in (low, high)):
            continue
        now = (high.slack - low.slack) / (2.0 * h)
        # Error of w from the residuals, or from rounding: sqrt(J), as in `norm`.
        left = sum(
            max(x.residual.energy, x.residual.roundoff_floor * x.residual.energy_at_zero)
            for x in (low, high)
        )
        if before is not None and max(norm(now - before), left / (2.0 * h)) < error:
            best = now
            error = max(norm(now - before), left / (2.0 * h))
        before = now
    if best is None:
        return Compared(
            source, problem.law, problem.operator, problem.m, " and ".join(told), np.nan, np.nan
        )
    scale = max(norm(best), norm(change) * 1e-3, 1e-300)
    off = norm(found - best) / scale
    return Compared(
        source, problem.law, problem.operator, problem.m, " and ".join(told), off, error / scale
    )


def agrees(line: Compared) -> bool:
    """Return whether the derivative agrees within 1e-6 or the error of the differences."""
    return line.off <= max(AGREES, TIMES * line.error)


def agreement(lines: list[Compared]) -> str:
    """Return the table of agreement by law and operator."""
    keys = sorted({(x.law, x.operator) for x in lines})
    rows: list[tuple[Any, ...]] = []
    for key in [*keys, None]:
        of = [x for x in lines if key in (None, (x.law, x.operator))]
        refused = sum(x.flagged == REFUSED for x in of)
        seen = [x for x in of if not np.isnan(x.off)]
        free = [x for x in seen if not x.flagged]
        wrong = [x for x in seen if not agrees(x)]
        rows.append(
            (
                *(key or ("all", "")),
                len(of),
                f"{sum(bool(x.flagged) for x in of) / len(of):.1%}",
                refused,
                len(of) - len(seen) - refused,
                f"{sum(map(agrees, free))} of {len(free)}",
                f"{sum(bool(x.flagged) for x in wrong)} of {len(wrong)}",
            )
        )
    head = (
        "law",
        "given as",
        "problems",
        "flagged",
        "of these refused",
        "beyond differences",
        "agree of those not flagged",
        "flagged of those that disagree",
    )
    return markdown(head, rows)


# -- cost ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cost:
    """Times [s] of one problem, or of a batch."""

    source: str
    law: str
    operator: str
    rows: int
    solve: float  # cold solve by newton
    first: float  # the derivative and one vjp
    more: float  # another vjp


def fresh(problem: lv.Problem) -> lv.Problem:
    """Return a copy without derived data."""
    kind, values = problem.__reduce__()  # type: ignore[misc]
    made: lv.Problem = kind(*values)
    return made


def took(work: Callable[[], Any]) -> tuple[float, Any]:
    """Return the CPU time [s] of one call and its result."""
    start = time.process_time()
    found = work()
    return time.process_time() - start, found


def cost(source: str, problem: lv.Problem, repeats: int = 3) -> Cost | None:
    """Return the smallest times of a few runs without derived data, or None if `newton` does not solve the problem."""
    best = np.full(3, np.inf)
    for _ in range(repeats):
        own = fresh(problem)
        solve, solution = took(lambda own=own: lv.solve(own, "newton", tol=1e-10))  # type: ignore[misc]
        if not (solution.residual.relative <= 1e-8 or solution.residual.at_floor):
            return None
        weights = {"slack": np.ones(own.m)}
        if own.matrix is None:
            weights = {"velocity": np.ones(own.velocity(solution.impulse).shape)}
        answer = solution.impulse

        def both(
            own: lv.Problem = own, answer: Any = answer, weights: dict[str, Any] = weights
        ) -> lv.Derivative:
            d = lv.derivative(own, answer)
            d.vjp(**weights).b  # noqa: B018 - read
            return d

        try:
            first, d = took(both)
        except lv.CapabilityError:  # the weighted quantity is not unique
            return None
        more, _ = took(lambda d=d, weights=weights: [d.vjp(**weights).b for _ in range(AGAIN)])  # type: ignore[misc]
        best = np.minimum(best, (solve, first, more / AGAIN))
    return Cost(source, problem.law, problem.operator, problem.m, *best.tolist())


def batch(source: str, problems: list[lv.Problem], repeats: int = 20) -> Cost:
    """Return the times of a batch, from `solve_many` to arrays of all problems."""
    best = np.full(3, np.inf)
    for _ in range(repeats):
        own = [fresh(p) for p in problems]
        solve, solutions = took(lambda own=own: lv.solve_many(own, "newton", tol=1e-10))  # type: ignore[misc]
        ones = [np.ones(p.generalized.nv) for p in own]  # type: ignore[union-attr]

        def both(own: Any = own, solutions: Any = solutions, ones: Any = ones) -> Any:
            d = lv.derivatives(own, solutions)
            d.vjp(velocity=ones).b  # noqa: B018 - read
            return d

        first, d = took(both)
        more, _ = took(lambda d=d, ones=ones: [d.vjp(velocity=ones).b for _ in range(AGAIN)])  # type: ignore[misc]
        best = np.minimum(best, (solve, first, more / AGAIN))
    first_of = problems[0]
    return Cost(source, first_of.law, first_of.operator, sum(p.m for p in problems), *best.tolist())


def costs(lines: list[Cost]) -> str:
    """Return the table of median times by source and size."""
    rows = []
    for source in dict.fromkeys(x.source for x in lines):
        for low, high in ((0, 10), (10, 30), (30, 100), (100, 10**9)):
            of = [x for x in lines if x.source == source and low <= x.rows < high]
            if of:
                first, more = (
                    np.array([getattr(x, name) / x.solve for x in of]) for name in ("first", "more")
                )
                rows.append(
                    (
                        source,
                        f"{low} to {high - 1}" if high < 10**9 else f"{low} and more",
                        len(of),
                        f"{1e6 * np.median([x.solve for x in of]):.0f}",
                        f"{np.median(first):.2f}",
                        f"{np.mean(first <= 1.0):.0%}",
                        f"{np.median(more):.2f}",
                        f"{np.mean(more <= 0.2):.0%}",
                    )
                )
    head = (
        "source",
        "rows",
        "problems",
        "`newton` [us]",
        "first vjp / solve",
        "at most 1",
        "another / solve",
        "at most 0.2",
    )
    return markdown(head, rows)


def jacobians(path: str, steps: int = 200) -> tuple[Any, ...]:
    """Return times [us] of d v+ / d controls at one step of a model by vjp, differences of solves and MuJoCo."""
    import mujoco as mj

    from lavender.io import from_mujoco

    model = mj.MjModel.from_xml_path(path)
    data = mj.MjData(model)
    rng = np.random.default_rng(1)
    low, high = np.where(
        model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-1.0, 1.0]
    ).T
    for _ in range(steps):
        data.ctrl[:] = rng.uniform(low, np.maximum(low, high))
        mj.mj_step(model, data)
    mj.mj_forward(model, data)
    problem = from_mujoco(model, data)
    g = problem.generalized
    assert g is not None
    # v* = ... + dt M^-1 (moment^T gain u): derivative of v* by the controls, (nv, nu).
    free = np.zeros((model.nv, model.nu))
    for i in range(model.nu):
        ends = []
        for sign in (-1.0, 1.0):
            other = mj.MjData(model)
            mj.mj_copyData(other, model, data)
            other.ctrl[i] += sign * 1e-3
            mj.mj_forward(model, other)
            ends.append(other.qfrc_actuator.copy())
        free[:, i] = model.opt.timestep * g.solve((ends[1] - ends[0]) / 2e-3)
    unit = np.eye(g.nv)
    found = None

    def implicit() -> np.ndarray:
        d = lv.derivative(problem, solution)
        return np.array([d.vjp(velocity=y).v_free for y in unit]) @ free

    def differences() -> np.ndarray:
        out = np.empty((g.nv, model.nu))
        for i in range(model.nu):
            ends = []
            for h in (-1e-6, 1e-6):
                b = problem.b - h * (problem.jacobian @ free[:, i])
                x = lv.solve(
                    replace(problem, b=b, guess=None), "newton", tol=1e-12, impulse=solution.impulse
                ).impulse
                ends.append(g.v_free + h * free[:, i] + g.change(x))
            out[:, i] = (ends[1] - ends[0]) / 2e-6
        return out

    def of_mujoco() -> None:
        b = np.zeros((2 * model.nv + model.na, model.nu))
        mj.mjd_transitionFD(model, data, 1e-6, True, None, b, None, None)

    solution = lv.solve(problem, "newton", tol=1e-12)
    ways = []
    for way in (implicit, differences, of_mujoco):
        if way is of_mujoco and model.opt.integrator == mj.mjtIntegrator.mjINT_RK4:
            ways.append((math.nan, None))  # mjd_transitionFD does not support it
            continue
        best = min(took(way)[0] for _ in range(5))
        found = way()
        ways.append((best, found))
    off = float(np.abs(ways[0][1] - ways[1][1]).max() / max(np.abs(ways[1][1]).max(), 1e-300))
    return (
        Path(path).stem,
        problem.m,
        model.nv,
        model.nu,
        *("refused" if math.isnan(t) else f"{1e6 * t:.0f}" for t, _ in ways),
        f"{off:.1e}",
    )


@click.command("derivatives")
@click.option("--draws", default=300, show_default=True, help="Problems of `wild`.")
@click.option(
    "--steps", default=125, show_default=True, help="Steps of each model, under each of its cones."
)
@click.option(
    "--models", multiple=True, type=click.Path(exists=True, dir_okay=False), help="A MuJoCo model."
)
@click.option("--only", type=click.Choice(("agreement", "costs")), help="One part alone.")
def command(draws: int, steps: int, models: tuple[str, ...], only: str | None) -> None:
    """Compare derivatives with differences of solves: agreement, flags, times."""
    lines: list[Any] = []
    given = list(sources(draws, steps, models))
    if only != "costs":
        lines = [x for source, p in given if (x := compared(source, p)) is not None]
        click.echo(agreement(lines))
    if only != "agreement":
        measured = [x for source, p in given if (x := cost(source, p)) is not None]
        for path in models:
            for i, made in enumerate(_chunks(list(robots((path,), 64)), 64)):
                measured.append(
                    batch(f"64 of {Path(path).stem}, {('pyramids', 'cones')[i % 2]}", made)
                )
        click.echo("\n" + costs(measured))
        lines += measured
        if models:
            head = (
                "model",
                "rows",
                "nv",
                "nu",
                "vjp [us]",
                "differences of solves [us]",
                "mjd_transitionFD [us]",
                "off [-]",
            )
            click.echo("\n" + markdown(head, [jacobians(path) for path in models]))


def _chunks(problems: list[lv.Problem], size: int) -> Iterator[list[lv.Problem]]:
    for i in range(0, len(problems), size):
        yield problems[i : i + size]
