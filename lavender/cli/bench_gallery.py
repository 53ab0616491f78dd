"""`lavender bench gallery`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import click

from lavender.bench.endurance import STEPS_PER_SECOND, Stay, stay
from lavender.errors import InputError
from lavender.io.stored import write_text
from lavender.report.endurance import table
from lavender.scene import SCENES

__all__ = ["gallery"]


@click.command("gallery")
@click.argument("scenes", nargs=-1, metavar="[SCENES]...")
@click.option("--seconds", type=float, default=600.0, show_default=True, help="Simulated, of each run.")
@click.option(
    "--solvers",
    default="sequential_impulses",
    show_default=True,
    help="Solvers of the substeps, commas between them.",
)
@click.option("--out", type=click.Path(dir_okay=False), default=None, help="Also write the numbers as JSON.")
def gallery(scenes: tuple[str, ...], seconds: float, solvers: str, out: str | None) -> None:
    """Run scenes of the gallery for ten minutes, at 60 and at 120 steps a second: energies, drifts, times.

    SCENES: names; without any, the whole gallery.
    """
    if not seconds > 0.0:
        raise InputError(f"seconds is {seconds:g}; more than 0 is needed")
    found: list[Stay] = []
    say: Callable[[str], Any] = click.echo
    for name in scenes or tuple(SCENES):
        for solver in solvers.split(","):
            for rate in STEPS_PER_SECOND:
                found.append(stay(name, 1.0 / rate, seconds, solver=solver))
                lines = table(found[-1:]).splitlines()
                say("\n".join(lines if len(found) == 1 else lines[1:]))
    if out is not None:
        write_text(out, json.dumps([asdict(f) for f in found], indent=1))
