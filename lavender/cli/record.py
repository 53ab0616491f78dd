"""`lavender record`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lavender.cli.options import precision_option, refuse_unused

__all__ = ["record"]


@click.command()
@click.argument("model", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--steps", default=500, show_default=True, help="Number of simulation steps.")
@click.option("--every", default=5, show_default=True, help="Record every n-th step.")
@click.option(
    "--controls",
    "control",
    default="zero",
    show_default=True,
    metavar="zero|random|FILE",
    help="FILE: an .npy array of shape (any, nu).",
)
@click.option("--seed", default=0, show_default=True, help="Seed of random controls.")
@click.option(
    "--out", required=True, type=click.Path(file_okay=False, path_type=Path), help="Folder for the problems."
)
@click.option(
    "--replace", is_flag=True, help="First delete the problems of an earlier recording in the folder."
)
@precision_option
@click.pass_context
def record(
    context: click.Context, /, model: Path, out: Path, steps: int, precision: str | None, **asked: Any
) -> None:
    """Simulate a MuJoCo model (MJCF) and write its constraint problems, for `lavender report OUT`."""
    from lavender.io.recording import record_file

    if asked["control"] != "random":
        refuse_unused(context, ["seed"], "without --controls random")
    click.echo(str(record_file(model, out, steps, precision=precision or "float64", **asked)))
