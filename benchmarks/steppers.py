"""Motion against truth, `python -m benchmarks steppers`: how far a stepper's bodies go from a reference run, against
its CPU time.

    distance = max over bodies and looks of |x - x*|                                             (1)

x* is `impulses` with 64 sweeps and n substeps, first order in their length, extrapolated to none:

    x*(n) = 2 x(n) - x(n/2)                                                                      (2)

with n doubled until two of them agree to `AGREE` by (1); what they then differ by is the floor of a scene.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.output import markdown, out_option
from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.io.stored import write_figure
from lavender.lab.phenomena.engines import follow
from lavender.lab.phenomena.engines.own import Engine
from lavender.lab.report.curves import Curve, Figure
from lavender.lab.report.draw import looks, matplotlib_panels
from lavender.sim.scene import Scene
from lavender.sim.scene.steppers import STEPPERS, get_stepper

SECONDS = 2.0
DT = 1.0 / 60.0
AGREE = 1e-4  # m
USEFUL = 0.1  # m; a reference known no better is none
MOST_SUBSTEPS = 256
TINY = 1e-9  # m, where smaller distances are drawn
#: Scene of the gallery -> its parameters: sliding, leaning, hanging and standing, without chaos in two seconds.
SCENES: dict[str, dict[str, Any]] = {
    "ramp": {"angle": 0.6},
    "chain": {"n": 5, "tip_mass": 10.0},
    "four_bar": {},
    "stack": {"n": 10},
    "card_house": {},
    "pyramid": {"base": 5},
}
#: Substeps of 1/60 s, and sweeps of each.
BUDGETS = (
    (1, 4),
    (1, 16),
    (1, 64),
    (2, 8),
    (4, 4),
    (4, 16),
    (4, 64),
    (8, 8),
    (16, 4),
    (16, 16),
    (32, 4),
    (64, 4),
)


@dataclass(frozen=True)
class Point:
    """One run of a stepper."""

    scene: str
    stepper: str
    substeps: int
    sweeps: int  # of a substep, relaxing ones included
    distance: float  # m, equation (1); nan: lost
    cpu: float  # s for a second of simulation
    floor: float  # m, what the reference is known to
    note: str = ""

    @property
    def work(self) -> float:
        """Sweeps for a second of simulation."""
        return self.substeps * self.sweeps / DT


def _places(scene: Scene) -> tuple[FloatArray, float]:
    track = follow(Engine(scene), SECONDS, DT)
    return track.positions, track.cpu


def distance(x: FloatArray, truth: FloatArray) -> float:
    """Equation (1); nan where a run ended before the other."""
    if x.shape != truth.shape or not np.isfinite(x).all():
        return float("nan")
    return float(np.linalg.norm(x - truth, axis=2).max())


def reference(name: str, parameters: Mapping[str, Any] | None = None) -> tuple[FloatArray, float]:
    """Places (k, n, 3) [m] of the bodies every 1/60 s, and by how much the last two runs differ [m].

    Raises
    ------
    InputError
        They come no nearer to each other than `USEFUL` with 256 substeps in 1/60 s: the motion is chaotic.
    """
    own = dict(SCENES.get(name, {}) if parameters is None else parameters)
    substeps, before, truth, left = 8, None, np.zeros(0), float("nan")
    while substeps <= MOST_SUBSTEPS:
        x, _ = _places(Scene(name, **own, dt=DT, substeps=substeps, solver_iterations=64))
        if before is not None:
            better = 2.0 * x - before
            left, truth = distance(better, truth), better
            if left <= AGREE:
                break
        before, substeps = x, 2 * substeps
    if not left <= USEFUL:
        raise InputError(
            f"{name}: references of {substeps // 2} and half as many substeps differ by {left:.2g} m"
        )
    return truth, left


def measure(
    scenes: Sequence[str] = tuple(SCENES),
    steppers: Sequence[str] = tuple(STEPPERS),
    budgets: Sequence[tuple[int, int]] = BUDGETS,
    show: Callable[[Point], None] = lambda point: None,
) -> list[Point]:
    """Every stepper with every budget on every scene.

    Raises
    ------
    UnknownName
        No such stepper or scene.
    """
    found = []
    specs = [get_stepper(name) for name in steppers]
    for name in scenes:
        truth, floor = reference(name)
        for spec in specs:
            for substeps, sweeps in budgets:
                if not spec.sweeps[0] <= sweeps <= spec.sweeps[1]:
                    continue
                more = spec.values({}).get("relaxing_sweeps", 0)
                try:
                    scene = Scene(
                        name, **SCENES.get(name, {}), dt=DT, stepper=spec.name, substeps=substeps,
                        solver_iterations=sweeps,
                    )  # fmt: skip
                    x, cpu = _places(scene)
                    away, note = distance(x, truth), ""
                except InputError as error:  # a stepper that does not take the scene
                    away, cpu, note = float("nan"), float("nan"), str(error)
                point = Point(
                    scene=name, stepper=spec.name, substeps=substeps, sweeps=sweeps + int(more), distance=away,
                    cpu=cpu, floor=floor, note=note,
                )  # fmt: skip
                found.append(point)
                show(point)
    return found


def _best(points: Sequence[Point], most: float) -> str:
    some = [p for p in points if p.work <= most and p.distance == p.distance]
    if not some:
        return "–"
    best = min(some, key=lambda p: p.distance)
    return f"{1e3 * best.distance:.2g} ({best.substeps} x {best.sweeps})"


def table(points: Sequence[Point], budgets: Sequence[float] = (300.0, 1200.0, 5000.0, 20000.0)) -> str:
    """Markdown: least distance [mm] that a stepper reaches with so many sweeps a second, and how."""
    cells = []
    for scene in dict.fromkeys(p.scene for p in points):
        for stepper in dict.fromkeys(p.stepper for p in points):
            some = [p for p in points if (p.scene, p.stepper) == (scene, stepper)]
            if some:
                least = (_best(some, b) for b in budgets)
                cells.append((scene, stepper, *least, f"{1e3 * some[0].floor:.1g}"))
    heads = ("scene", "stepper", *(f"{b:g} sweeps/s" for b in budgets), "known to [mm]")
    return markdown(heads, cells)


def draw(points: Sequence[Point], path: Path) -> None:
    """Distance against CPU time, a diagram for each scene: the lower hull of each stepper over all its budgets.

    Raises
    ------
    InputError
        matplotlib is not installed, or the file cannot be written.
    """
    look = looks({p.stepper for p in points})
    figures = [_figure(scene, points) for scene in dict.fromkeys(p.scene for p in points)]
    try:
        canvas = matplotlib_panels(figures, look)
    except ImportError:
        raise InputError("a figure needs matplotlib: pip install matplotlib") from None
    write_figure(canvas, path)


def _figure(scene: str, points: Sequence[Point]) -> Figure:
    some = sorted(
        (p for p in points if p.scene == scene and p.distance == p.distance), key=lambda p: (p.stepper, p.cpu)
    )
    curves = []
    for stepper, group in itertools.groupby(some, key=lambda p: p.stepper):
        runs = list(group)
        x, y = tuple(p.cpu for p in runs), tuple(max(p.distance, TINY) for p in runs)
        best = tuple(itertools.accumulate(y, min))
        curves += [
            Curve(stepper, "", x, y, thin=True, points=True),
            Curve(stepper, stepper, x, best, steps=True),
        ]
    return Figure(
        name=scene,
        title=scene,
        x_title="CPU time for a second of simulation [s]",
        y_title="largest distance from the reference in two seconds [m]",
        curves=tuple(curves),
        floor=max(some[0].floor, TINY) if some else math.nan,
    )


@click.command("steppers")
@click.option("--steppers", default=",".join(STEPPERS), show_default=True, help="Names with commas.")
@out_option("Figure (.svg, .png).", "--plot")
def command(steppers: str, plot: Path | None) -> None:
    """Steppers' distance from a reference on six scenes, against CPU time."""

    def show(point: Point) -> None:
        words = point.note or f"{1e3 * point.distance:.3g} mm, {1e3 * point.cpu:.3g} ms a second"
        click.echo(f"{point.scene}, {point.stepper} {point.substeps} x {point.sweeps}: {words}", err=True)

    found = measure(steppers=steppers.replace(",", " ").split(), show=show)
    if plot is not None:
        draw(found, plot)
    click.echo(table(found))
