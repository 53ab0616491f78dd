"""Every scene of the gallery for minutes: what moves that should rest, what energy comes from nowhere, what it costs.

    E = sum over the moving bodies of m v.v / 2 + omega.(R I R^T omega) / 2 - m g.x                      [J]

relative to E of the start, but for a motor that drives. A passive scene may lose energy, in contacts and impacts,
and gains none beyond what the position projection lifts: `gain` is the largest E over that of the start.
`drift` is the largest distance of a body from where it was after two seconds: for a scene that stands, of what its
solver left behind; for one that swings or rolls, its motion.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from time import process_time
from typing import Any

import click
import numpy as np

from benchmarks.output import markdown
from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.sim.engine import Simulation
from lavender.sim.scene import SCENES, Scene
from lavender.sim.scene.parts import rotation

STEPS_PER_SECOND = (60, 120)
SETTLED = 2.0  # s
LOOKS = 10  # a second


@dataclass(frozen=True)
class Stay:
    """One scene for some time."""

    scene: str
    solver: str
    dt: float  # s
    seconds: float  # s, simulated: less than asked for where the state was lost
    lost: str  # name of the body whose state was no longer finite, or empty
    start: float  # J, energy at the start
    end: float  # J
    gain: float  # J, largest energy above that of the start
    drift: float  # m, largest distance of a body from where it was after two seconds
    speed: float  # m/s, largest speed of a centre at the end
    depth: float  # m, deepest penetration after two seconds
    failed: int  # solves that failed
    cost: float  # s, processor time of a step


def energy(scene: Scene, observation: dict[str, Any]) -> float:
    """Mechanical energy [J] of the moving bodies."""
    total, g = 0.0, np.array(scene.parameters.gravity)
    for i, body in enumerate(scene.bodies):
        if body.is_static:
            continue
        x, v = observation["positions"][i], observation["velocities"][i]
        omega = rotation(observation["quaternions"][i]).T @ v[3:]
        total += 0.5 * body.mass * float(v[:3] @ v[:3]) + 0.5 * float(omega @ body.inertia @ omega)
        total -= body.mass * float(g @ x)
    return total


@np.errstate(over="ignore", invalid="ignore")  # a run about to be lost
def stay(
    name: str, dt: float, seconds: float, *, solver: str = "sequential_impulses", **parameters: Any
) -> Stay:
    """Run one scene.

    Parameters
    ----------
    name : str
        Of the gallery.
    dt, seconds : float, s
    solver : str
    **parameters
        Of the scene.
    """
    simulation = Simulation(Scene(name, dt=dt, solver=solver, **parameters))
    scene = simulation.scene
    every = max(1, round(1.0 / (LOOKS * dt)))
    observation = simulation.reset()[0]
    start = end = most = energy(scene, observation)
    settled: FloatArray | None = None
    drift = depth = cost = speed = 0.0
    info: dict[str, Any] = {"failed_solves": 0}
    lost, steps = "", round(seconds / dt)
    for step in range(1, steps + 1):
        begun = process_time()
        observation, _, terminated, _, info = simulation.step()
        cost += process_time() - begun
        if terminated:
            lost = info["lost_body"]
            break
        if step % every and step != steps:
            continue
        end = energy(scene, observation)
        most = max(most, end)
        x = observation["positions"]
        speed = float(np.linalg.norm(observation["velocities"][:, :3], axis=1).max())
        if step * dt >= SETTLED - 1e-9:
            settled = x.copy() if settled is None else settled
            drift = max(drift, float(np.linalg.norm(x - settled, axis=1).max()))
            depth = max(depth, float(observation["contacts"]["depth"].max(initial=0.0)))
    done = simulation.steps
    return Stay(
        scene=name,
        solver=solver,
        dt=dt,
        seconds=done * dt,
        lost=lost,
        start=start,
        end=end,
        gain=most - start,
        drift=drift,
        speed=speed,
        depth=depth,
        failed=info["failed_solves"],
        cost=cost / max(done, 1),
    )


HEAD = (
    *("scene", "solver", "1/dt", "s", "E start [J]", "E end [J]", "gain [J]", "drift [mm]", "speed [m/s]"),
    *("depth [mm]", "failed", "µs a step", "lost"),
)


def table(found: Iterable[Stay]) -> str:
    """A line a run, markdown."""
    return markdown(
        HEAD,
        [
            (
                f.scene, f.solver, round(1 / f.dt), f"{f.seconds:.0f}", f"{f.start:.4g}", f"{f.end:.4g}",
                f"{f.gain:.2g}", f"{1e3 * f.drift:.3g}", f"{f.speed:.2g}", f"{1e3 * f.depth:.3g}", f.failed,
                f"{1e6 * f.cost:.0f}", f.lost,
            )
            for f in found
        ],
    )  # fmt: skip


@click.command("gallery")
@click.argument("scenes", nargs=-1, metavar="[SCENES]...")
@click.option("--seconds", type=float, default=600.0, show_default=True, help="Simulated, of each run.")
@click.option(
    "--solvers",
    default="sequential_impulses",
    show_default=True,
    help="Solvers of the substeps, commas between them.",
)
def command(scenes: tuple[str, ...], seconds: float, solvers: str) -> None:
    """Run scenes of the gallery for ten minutes, at 60 and at 120 steps a second: energies, drifts, times.

    SCENES: names; without any, the whole gallery.
    """
    if not seconds > 0.0:
        raise InputError(f"seconds is {seconds:g}; more than 0 is needed")
    found: list[Stay] = []
    for name in scenes or tuple(SCENES):
        for solver in solvers.split(","):
            for rate in STEPS_PER_SECOND:
                found.append(stay(name, 1.0 / rate, seconds, solver=solver))
                lines = table(found[-1:]).splitlines()
                click.echo("\n".join(lines if len(found) == 1 else lines[2:]))
