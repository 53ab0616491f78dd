"""Towers of boxes in several engines: time until they fall, drift, and cost of a step.

Every engine stacks the same n unit boxes of 1 kg on a plane, friction 0.5, without sleeping, and steps. With p(t) the
centres of the boxes,

    drift = max over boxes and t >= 2 s of |p(t) - p(2 s)|,                                     (1)

sampled ten times per second. The tower has fallen when a box is half an edge below its start
(`has_fallen`); the run then ends. Lines are sorted by the sweeps per simulated second:
sweeps x substeps / dt.

LavenderSim is stepped by its public interface, with observations; the others by their own step functions. MuJoCo,
PyBullet and lavendersim are Python packages; Rapier (`@dimforge/rapier3d-compat`) and Jolt (`jolt-physics`) run under
Node.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.engines import (
    PACKAGES_OF_NODE,
    Stepping,
    create_engine,
    get_missing_installation_command,
    get_npm_versions,
)
from benchmarks.output import markdown, out_option, write_json
from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError, UnknownName
from lavender.cli.options import ListType
from lavender.report.machine import get_versions
from lavender.sim.scene import Scene
from lavender.sim.scene.parameters import SCENE_ORDERS

FRICTION = 0.5
SETTLE = 2.0  # s
LOOK = 0.1  # s


def has_fallen(start: FloatArray, now: FloatArray) -> bool:
    """Return whether a box is half an edge lower than at the start, or a position is not finite.

    Parameters
    ----------
    start, now : (n, 3) m
        Centres of the boxes.
    """
    return not (start[:, 2] - now[:, 2]).max() <= 0.5


@dataclass(frozen=True)
class Tower:
    """Settings of one run."""

    boxes: int
    dt: float  # s, time of one step call
    sweeps: int | None = None  # None: the engine's own number
    substeps: int | None = None  # None: the engine's own number
    order: str | None = None  # sweep order of LavenderSim
    seconds: float = 60.0  # s, simulated


@dataclass(frozen=True)
class Line:
    """Result of one run."""

    engine: str
    boxes: int
    dt: float  # s
    sweeps: int  # of one substep; 0: solved to a tolerance
    substeps: int  # of one step
    seconds: float  # s, maximum simulated time
    stood: float  # s, time until it fell, else `seconds`
    drift: float  # m, equation (1), until it fell
    cost: float  # s, CPU time of one step

    @property
    def stands(self) -> bool:
        """Whether the tower was upright until the end."""
        return self.stood >= self.seconds

    @property
    def work(self) -> float:
        """Sweeps per simulated second; 0 if solved to a tolerance."""
        return self.sweeps * self.substeps / self.dt


@dataclass(frozen=True)
class Standing:
    """One engine with one tower and its settings."""

    engine: Stepping
    name: str
    sweeps: int  # of one substep; 0: solved to a tolerance
    substeps: int  # of one step

    def centres(self) -> FloatArray:
        """Return the centres of the boxes (n, 3) [m]."""
        x: FloatArray = self.engine.get_state()[0][1:]
        return x.copy()


@dataclass(frozen=True)
class Contestant:
    """An engine of `benchmarks.engines` with its requirements and options."""

    name: str
    module: str = "own"
    needs: str = ""  # Python package, or npm package
    default: int = 0  # default number of sweeps; LavenderSim's is in the scene
    sweeps: str = "sweeps"  # name of the option for sweeps; empty: solved to a tolerance
    substeps: bool = False
    options: Mapping[str, Any] = field(
        default_factory=dict
    )  # of the engine; LavenderSim: of the scene

    def step(self, build: Callable[..., Scene], tower: Tower) -> Stepping:
        """Build the engine with a scene for a tower's step, sweeps, substeps and order."""
        if self.module == "own":
            asked = {"solver_iterations": tower.sweeps, "order": tower.order} if self.sweeps else {}
            return create_engine(
                "own", build(dt=tower.dt, substeps=tower.substeps, **asked, **self.options)
            )
        sweeps = self.default if tower.sweeps is None else tower.sweeps
        options = {"dt": tower.dt, **self.options, **({self.sweeps: sweeps} if self.sweeps else {})}
        options |= {"substeps": tower.substeps or 1} if self.substeps else {}
        return create_engine(self.module, build(), **options)

    def make(self, tower: Tower) -> Standing:
        """Build the engine with a tower."""
        made: Any = self.step(partial(Scene, "stack", n=tower.boxes, friction=FRICTION), tower)
        if self.module != "own":
            sweeps = (self.default if tower.sweeps is None else tower.sweeps) if self.sweeps else 0
            parts = (tower.substeps or 1) if self.substeps else getattr(made, "substeps", 1)
            return Standing(made, self.name, sweeps, parts)
        p = made.scene.parameters
        name = f"{self.name}, {p.order}" if self.sweeps and tower.order is not None else self.name
        return Standing(made, name, made.sim.solver_iterations if self.sweeps else 0, p.substeps)


_ELLIPTIC = {"cone": "elliptic"}
#: Engines by their names in `--engines`. Joints of all engines are constraints between bodies.
ENGINES: dict[str, Contestant] = {
    "lavender": Contestant("lavender", substeps=True),
    "newton": Contestant("lavender newton", sweeps="", options={"solver": "newton"}),
    "lavendersim": Contestant("lavendersim", "lavender_sim", "lavendersim", 22),
    "mujoco_newton": Contestant("mujoco Newton", "mujoco", "mujoco", sweeps="", options=_ELLIPTIC),
    "mujoco_pgs": Contestant("mujoco PGS", "mujoco", "mujoco", 100, options=_ELLIPTIC),
    "pybullet": Contestant("pybullet", "bullet", "pybullet", 50, substeps=True),
    "rapier": Contestant(
        "rapier",
        "node",
        PACKAGES_OF_NODE["rapier"],
        4,
        sweeps="iterations",
        options={"engine": "rapier", "sleep": False},
    ),
    "jolt": Contestant(
        "jolt",
        "node",
        PACKAGES_OF_NODE["jolt"],
        10,
        options={
            "engine": "jolt",
            "substeps": 1,
            "gyroscopic": False,
            "sleep": False,
            "damping": 0,
        },
    ),
}


def missing(name: str) -> str:
    """Return the missing requirement of an engine, empty if it can run."""
    return get_missing_installation_command(ENGINES[name].needs)


def installed() -> list[str]:
    """Return the names of the engines that can run here."""
    return [name for name in ENGINES if not missing(name)]


def check_installed(name: str) -> None:
    """Raise an error if an engine cannot run here.

    Raises
    ------
    UnknownName
        The engine does not exist.
    InputError
        The engine is not installed; the message names the missing package.
    """
    if name not in ENGINES:
        raise UnknownName("engine", name, ENGINES)
    if missing(name):
        raise InputError(f"{name} cannot run here: {missing(name)}")


def measure(engine: str, tower: Tower) -> Line:
    """Step one tower in one engine for at most `tower.seconds`; errors as in `check_installed`."""
    check_installed(engine)
    made = ENGINES[engine].make(tower)
    try:
        return _watch(made, tower)
    finally:
        made.engine.close()


def _watch(made: Standing, tower: Tower) -> Line:
    every = max(1, round(LOOK / tower.dt))
    looks = max(1, round(tower.seconds / (every * tower.dt)))
    spent = 0.0
    drift = 0.0
    start = None
    stood = tower.seconds
    steps = 0
    first = made.centres()
    for _ in range(looks):
        begin = made.engine.get_cpu_time()
        made.engine.advance(every)
        spent += made.engine.get_cpu_time() - begin
        steps += every
        time = steps * tower.dt
        now = made.centres()
        if has_fallen(first, now):
            stood = time
            break
        if time >= SETTLE - 1e-9:
            start = now if start is None else start
            drift = max(drift, float(np.linalg.norm(now - start, axis=1).max()))
    return Line(
        engine=made.name,
        boxes=tower.boxes,
        dt=tower.dt,
        sweeps=made.sweeps,
        substeps=made.substeps,
        seconds=tower.seconds,
        stood=stood,
        drift=drift,
        cost=spent / steps,
    )


def lines(
    engines: Iterable[str],
    boxes: Sequence[int],
    sweeps: Sequence[int],
    rates: Sequence[float],
    substeps: Sequence[int],
    *,
    seconds: float = 60.0,
    orders: Sequence[str | None] = (None,),
) -> Iterator[Line]:
    """Yield the result lines, tower by tower; `substeps` = 0: the engine's default.

    Engines that iterate to a tolerance give one line per tower and step. Other sweeping engines also give a line with
    their default number of sweeps.
    """
    for n, rate, name in product(boxes, rates, engines):
        c = ENGINES[name]
        own = c.module == "own" and bool(c.sweeps)
        budgets: list[int | None] = [*(sweeps if c.sweeps else ()), *(() if own else (None,))]
        seen = set()
        for budget, part, order in product(
            budgets, substeps if c.substeps else (0,), orders if own else (None,)
        ):
            tower = Tower(
                boxes=n,
                dt=1.0 / rate,
                sweeps=budget,
                substeps=part or None,
                order=order,
                seconds=seconds,
            )
            line = measure(name, tower)
            key = (line.engine, line.sweeps, line.substeps)
            if key not in seen:
                seen.add(key)
                yield line


def table(found: Sequence[Line]) -> str:
    """Return the results as a markdown table, by tower, step and sweeps per second."""
    head = (
        *(
            "boxes",
            "dt [s]",
            "engine",
            "sweeps",
            "substeps",
            "sweeps a second",
            "stood [s]",
            "drift [mm]",
        ),
        "µs a step",
    )
    rows = [
        (
            line.boxes,
            f"1/{round(1 / line.dt)}",
            line.engine,
            line.sweeps or "to a tolerance",
            line.substeps,
            f"{line.work:,.0f}" if line.sweeps else "–",
            f"{line.seconds:g}" if line.stands else f"**fell at {line.stood:.1f}**",
            f"{1e3 * line.drift:.2g}" if line.stands else "–",
            f"{1e6 * line.cost:,.3g}",
        )
        for line in sorted(found, key=lambda x: (x.boxes, -x.dt, x.work))
    ]
    return markdown(head, rows)


def _at_least(low: int, **lists: Sequence[int]) -> None:
    for name, numbers in lists.items():
        if not numbers or min(numbers) < low:
            raise InputError(
                f"--{name}: whole numbers of at least {low} are needed, with commas between"
            )


@click.command("stand")
@click.option("--engines", type=ListType(str), help="Default: all that are installed.")
@click.option(
    "--boxes",
    type=ListType(int),
    default="6,10,20",
    show_default=True,
    help="Heights of the towers.",
)
@click.option(
    "--sweeps",
    type=ListType(int),
    default="4,8,16",
    show_default=True,
    help="Sweeps of a substep, for whoever takes a number.",
)
@click.option(
    "--rates", type=ListType(int), default="60,120", show_default=True, help="Steps a second."
)
@click.option(
    "--substeps",
    type=ListType(int),
    default="0,1,2,4",
    show_default=True,
    help="Substeps of a step; 0: the engine's own number.",
)
@click.option(
    "--orders", type=ListType(str), help="Sweep orders of LavenderSim; default: that of the scene."
)
@click.option(
    "--seconds",
    type=click.FloatRange(min=3.0),
    default=60.0,
    show_default=True,
    help="Simulated at most.",
)
@out_option("JSON of the lines.")
def command(
    engines: tuple[str, ...] | None,
    boxes: tuple[int, ...],
    sweeps: tuple[int, ...],
    rates: tuple[int, ...],
    substeps: tuple[int, ...],
    orders: tuple[str, ...] | None,
    seconds: float,
    out: Path | None,
) -> None:
    """Measure how long towers of boxes stay upright, how far they drift and the cost of a step, in installed engines.

    Rapier and Jolt are included if npm has installed them in this folder: npm install @dimforge/rapier3d-compat
    jolt-physics.
    """
    names = installed() if engines is None else engines
    for name in names:
        check_installed(name)
    for order in orders or ():
        if order not in SCENE_ORDERS:
            raise UnknownName("order", order, SCENE_ORDERS)
    _at_least(1, boxes=boxes, sweeps=sweeps, rates=rates)
    _at_least(0, substeps=substeps)
    found = []
    for line in lines(
        names, boxes, sweeps, rates, substeps, seconds=seconds, orders=orders or (None,)
    ):
        found.append(line)
        how = (
            f"stood {line.seconds:g} s, {1e3 * line.drift:.3g} mm"
            if line.stands
            else f"fell at {line.stood:.1f} s"
        )
        click.echo(
            f"{line.boxes} boxes, 1/{round(1 / line.dt)} s, {line.engine}, {line.sweeps} x {line.substeps}: {how}",
            err=True,
        )
        if out is not None:
            write_json(out, found, engines=_versions(names))
    click.echo(table(found))
    left = (
        [f"{name} ({missing(name)})" for name in ENGINES if missing(name)]
        if engines is None
        else []
    )
    if left:
        click.echo(f"\nNot installed: {', '.join(left)}.")


def _versions(names: Sequence[str]) -> dict[str, str]:
    needed = {p for n in names if (p := ENGINES[n].needs)}
    return {p: v for p, v in (get_versions(needed) | get_npm_versions()).items() if p in needed}
