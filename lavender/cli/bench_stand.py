"""`lavender bench stand`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from importlib import metadata
from pathlib import Path

import click

from lavender.bench import machine
from lavender.bench.stand import ENGINES, Line, installed, lines, missing
from lavender.errors import InputError, UnknownName
from lavender.io.stored import write_text
from lavender.report.stand import table
from lavender.scene.scene import SCENE_ORDERS

__all__ = ["stand"]


def _numbers(text: str, what: str, low: int) -> list[int]:
    words = text.replace(",", " ").split()
    if not words or not all(w.isdecimal() and int(w) >= low for w in words):
        raise InputError(f"{what} {text!r}: whole numbers of at least {low} are needed, with commas between")
    return [int(w) for w in words]


@click.command("stand")
@click.option("--engines", default=None, help="Names with commas; default: all that are installed.")
@click.option("--boxes", default="6,10,20", show_default=True, help="Heights of the towers.")
@click.option(
    "--sweeps", default="4,8,16", show_default=True, help="Sweeps of a substep, for whoever takes a number."
)
@click.option("--rates", default="60,120", show_default=True, help="Steps a second.")
@click.option(
    "--substeps", default="0,1,2,4", show_default=True, help="Substeps of a step; 0: the engine's own number."
)
@click.option("--orders", default=None, help="Sweep orders of LavenderSim; default: that of the scene.")
@click.option(
    "--seconds", type=click.FloatRange(min=3.0), default=60.0, show_default=True, help="Simulated at most."
)
@click.option("--out", type=click.Path(path_type=Path), help="JSON of the lines.")
def stand(
    engines: str | None,
    boxes: str,
    sweeps: str,
    rates: str,
    substeps: str,
    orders: str | None,
    seconds: float,
    out: Path | None,
) -> None:
    """How long towers of boxes stand, how far they move and what a step costs, in every engine that is installed.

    Rapier and Jolt take part where npm has installed them in this folder: npm install @dimforge/rapier3d-compat
    jolt-physics.
    """
    names = installed() if engines is None else engines.replace(",", " ").split()
    for name in names:
        if name not in ENGINES:
            raise UnknownName("engine", name, ENGINES)
        if missing(name):
            raise InputError(f"{name} cannot run here: {missing(name)}")
    asked: list[str | None] = [None] if orders is None else [*orders.replace(",", " ").split()]
    for order in asked:
        if order is not None and order not in SCENE_ORDERS:
            raise UnknownName("order", order, SCENE_ORDERS)
    if out is not None and not out.parent.is_dir():
        raise InputError(f"--out {out}: there is no such folder")
    plan = (
        _numbers(boxes, "--boxes", 1), _numbers(sweeps, "--sweeps", 4), _numbers(rates, "--rates", 1),
        _numbers(substeps, "--substeps", 0),
    )  # fmt: skip
    found = []
    for line in lines(names, *plan, seconds=seconds, orders=asked):
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
            _write(found, names, out)
    click.echo(table(found))
    left = [f"{name} ({missing(name)})" for name in ENGINES if missing(name)] if engines is None else []
    if left:
        click.echo(f"\nNot installed: {', '.join(left)}.")


def _write(found: Sequence[Line], names: Sequence[str], out: Path) -> None:
    packages = [p for p in (ENGINES[n].needs for n in names if not isinstance(ENGINES[n].make, str)) if p]
    versions = {p: metadata.version(p) for p in sorted(set(packages))}
    text = json.dumps(
        {"cpu": machine.cpu_name(), "versions": versions, "lines": [asdict(line) for line in found]}, indent=1
    )
    write_text(out, text + "\n")
