"""Whether a warm-started engine stays on one branch of motions: what `lavender bench branches` measures.

A run of LavenderSim is searched every few steps. Where Coulomb's law leaves several motions, the impulses of the
step before, which the engine starts from, lie nearest to one of them. Sweeps from there, as many as the engine has,
are on their way to a motion: it is the nearest one, or another. The same number of sweeps from nothing, and
`newton` from nothing, show what the start has to do with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from lavender import motion
from lavender._arrays import FloatArray
from lavender.engine import Simulation
from lavender.motion.error import SAME
from lavender.problem import Problem
from lavender.registry import available
from lavender.scene import Scene
from lavender.solve import solve

__all__ = ["RUNS", "WAYS", "Crossing", "follow", "pushed"]

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
