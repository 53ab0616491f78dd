"""`lavender bench branches`."""

from __future__ import annotations

from pathlib import Path

import click

from lavender.bench.branches import RUNS, Crossing, follow
from lavender.bench.motions import write_csv
from lavender.errors import InputError
from lavender.report.branches import table

__all__ = ["branches"]


@click.command("branches")
@click.option("--steps", type=click.IntRange(1), default=120, show_default=True, help="Of each run.")
@click.option(
    "--every", type=click.IntRange(1), default=3, show_default=True, help="Search one step of these."
)
@click.option("--sweeps", type=click.IntRange(4, 64), default=16, show_default=True, help="Of the engine.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder for branches.csv.")
def branches(steps: int, every: int, sweeps: int, out: Path | None) -> None:
    """Whether a warm-started engine stays on one branch where a step has several motions.

    Six scenes whose bodies are pushed in directions of their own.
    """
    if out is not None and not out.is_dir():
        raise InputError(f"--out {out}: there is no such folder")
    found: list[Crossing] = []
    for name, parameters, speed in RUNS:
        own = follow(name, speed, steps=steps, every=every, sweeps=sweeps, **parameters)
        found += own
        click.echo(f"{own[0].run if own else name}: {len(own)} steps", err=True)
    click.echo(table(found))
    if out is not None:
        write_csv(found, out / "branches.csv")
