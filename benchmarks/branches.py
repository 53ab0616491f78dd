"""Whether a warm-started engine stays on one branch of motions: `python -m benchmarks branches`.

A run of LavenderSim is searched every few steps. Where Coulomb's law leaves several motions, the impulses of the
step before, which the engine starts from, lie nearest to one of them. Sweeps from there, as many as the engine has,
are on their way to a motion: it is the nearest one, or another. The same number of sweeps from nothing, and
`newton` from nothing, show what the start has to do with it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import click
import numpy as np

from benchmarks.output import markdown
from lavender import motion
from lavender.base.arrays import FloatArray
from lavender.lab.motion.error import SAME
from lavender.problem import Problem
from lavender.sim.engine import Simulation
from lavender.sim.scene import Scene
from lavender.solvers.registry import available
from lavender.solving.solve import solve

# Scene, its parameters, and the speed [m/s] that every body is pushed at, each in a direction of its own.
RUNS: tuple[tuple[str, dict[str, object], float], ...] = (
    ("pyramid", {"base": 4}, 0.5),
    ("pyramid", {"base": 4}, 2.0),
    ("pile", {}, 2.0),
    ("stack", {"n": 6}, 1.0),
    ("card_house", {}, 1.0),
    ("bridge", {}, 1.0),
)
WAYS = ("warm", "cold", "newton")
SEARCH = 6  # runs of each search
SEED = 5  # of the directions of pushes


@dataclass(frozen=True)
class Crossing:
    """One step of a run whose motions were searched. Distances are those of velocities, from the step before."""

    run: str
    step: int
    rows: int
    motions: int  # that the search and the three ways found; 0 where nothing ended at a solution
    spread: float  # m/s
    unique: str  # criterion that proves one motion, or empty
    nearest: float  # m/s, from where the step comes from to the nearest motion
    warm: str  # "nearest", "another" or "" (one motion): where the engine's sweeps from the warm start lead
    warm_distance: float  # m/s, from where the step comes from; nan where sweeps led to no solution
    cold: str  # the same of as many sweeps from nothing
    cold_distance: float
    newton: str  # the same of `newton` from nothing
    newton_distance: float


def pushed(name: str, speed: float, **parameters: object) -> Scene:
    """A scene of the gallery whose bodies each move sideways at `speed` [m/s] in a direction of their own."""
    scene = Scene(name, **parameters)
    angle = np.random.default_rng(SEED).uniform(0.0, 2.0 * np.pi, len(scene.bodies))
    for i, body in enumerate(scene.bodies):
        if not body.is_static:
            way = np.array([math.cos(angle[i]), math.sin(angle[i]), 0.0])
            scene.bodies[i] = replace(body, velocity=body.velocity + speed * way)
    return scene


def follow(
    name: str, speed: float, *, steps: int = 120, every: int = 3, sweeps: int = 16, **parameters: object
) -> list[Crossing]:
    """Run a pushed scene with warm starts and search the motions of every `every`-th step that has contacts.

    Parameters
    ----------
    name : str
        Of the gallery.
    speed : float, m/s
    steps, every, sweeps : int
    **parameters
        Of the scene.
    """
    told = ", ".join(f"{key}={value}" for key, value in parameters.items())
    label = f"{name}({told}), {speed:g} m/s"
    scene = pushed(name, speed, solver_iterations=sweeps, warm_start=True, **parameters)
    simulation = Simulation(scene)
    found = []
    for step in range(steps):
        if step % every == 0:
            problem = simulation.constraint_problem()
            if problem.m and problem.guess is not None:
                found.append(_crossing(label, step, problem, sweeps))
        if simulation.step()[2]:  # lost
            break
    return found


def _crossing(run: str, step: int, problem: Problem, sweeps: int) -> Crossing:
    assert problem.guess is not None
    searched = motion.motions(problem, SEARCH)
    known = [one.impulse for one in searched]
    ends: dict[str, FloatArray | None] = {}
    for way in WAYS:
        ends[way] = None
        if way == "newton" and "newton" not in available(problem):
            continue
        if way == "newton":
            end = solve(problem, "newton", impulse=problem.start(), tol=1e-11).impulse
        else:
            start = problem.guess if way == "warm" else problem.start()
            end = solve(problem, "sequential_impulses", impulse=start, tol=0.0, max_iter=sweeps).impulse
        own = motion.branch(problem, end)
        if not own.accepted:
            continue
        ends[way] = own.impulse
        if not searched.unique and all(motion.distance(problem, own.impulse, x).share > SAME for x in known):
            known.append(own.impulse)
    apart = [motion.distance(problem, x, y).speed for i, x in enumerate(known) for y in known[:i]]
    far = [motion.distance(problem, x, problem.guess).energy for x in known]
    values: dict[str, str | float] = {}
    for way, end_ in ends.items():
        values[way], values[f"{way}_distance"] = "", math.nan
        if end_ is not None:
            values[f"{way}_distance"] = motion.distance(problem, end_, problem.guess).speed
            if len(known) > 1:
                place = int(np.argmin([motion.distance(problem, end_, x).energy for x in known]))
                values[way] = "nearest" if place == int(np.argmin(far)) else "another"
    nearest = min((motion.distance(problem, x, problem.guess).speed for x in known), default=math.nan)
    return Crossing(
        run=run,
        step=step,
        rows=problem.m,
        motions=len(known),
        spread=max(apart, default=0.0),
        unique=searched.unique,
        nearest=nearest,
        **values,  # type: ignore[arg-type]
    )


HEAD = (
    *("run", "steps searched", "proved unique", "several motions", "median, largest spread"),
    *("warm", "cold", "`newton`", "by chance"),
)


def table(found: Sequence[Crossing]) -> str:
    """For each run, as markdown: steps with several motions, and how often each way ends at the nearest one.

    By chance: how many of them would, if each way ended at any motion of a step alike.
    """
    rows = []
    groups: dict[str, list[Crossing]] = {}
    for one in found:
        groups.setdefault(one.run, []).append(one)
        groups.setdefault("all", []).append(one)
    for run, group in sorted(groups.items(), key=lambda item: item[0] == "all"):
        several = [one for one in group if one.motions > 1]
        spread = [one.spread for one in several]
        text = f"{np.median(spread):.2g}, {max(spread):.2g} m/s" if spread else ""
        ways = []
        for way in WAYS:
            told = [getattr(one, way) for one in several if getattr(one, way)]
            ways.append(f"{sum(word == 'nearest' for word in told)} of {len(told)}" if told else "")
        proved = sum(bool(one.unique) for one in group)
        chance = f"{sum(1.0 / one.motions for one in several):.0f}" if several else ""
        rows.append((run, len(group), proved, len(several), text, *ways, chance))
    lines = [markdown(HEAD, rows)]
    several = [one for one in found if one.motions > 1]
    if several:
        lines += [
            "",
            "Distance from where the step comes from, median over steps with several motions [m/s]:",
            "",
        ]
        columns = ("nearest", *(f"{way}_distance" for way in WAYS))
        middles: list[str] = []
        for column in columns:
            told = [x for one in several if not math.isnan(x := getattr(one, column))]
            middles.append(f"{np.median(told):.2g}" if told else "")
        lines.append(markdown(("to the nearest motion", "warm", "cold", "`newton`"), [middles]))
    return "\n".join(lines)


@click.command("branches")
@click.option("--steps", type=click.IntRange(1), default=120, show_default=True, help="Of each run.")
@click.option(
    "--every", type=click.IntRange(1), default=3, show_default=True, help="Search one step of these."
)
@click.option("--sweeps", type=click.IntRange(4, 64), default=16, show_default=True, help="Of the engine.")
def command(steps: int, every: int, sweeps: int) -> None:
    """Whether a warm-started engine stays on one branch where a step has several motions.

    Six scenes whose bodies are pushed in directions of their own.
    """
    found: list[Crossing] = []
    for name, parameters, speed in RUNS:
        own = follow(name, speed, steps=steps, every=every, sweeps=sweeps, **parameters)
        found += own
        click.echo(f"{own[0].run if own else name}: {len(own)} steps", err=True)
    click.echo(table(found))
