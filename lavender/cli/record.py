"""`lavender record`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lavender.cli.options import precision_option, refuse_unused

__all__ = ["record"]


@click.command()
@click.argument("model", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--steps", default=500, show_default=True, help="Steps of the simulation.")
@click.option("--every", default=5, show_default=True, help="Steps between two problems.")
@click.option(
    "--controls",
    "control",
    default="zero",
    show_default=True,
    metavar="zero|random|FILE",
    help="FILE: .npy, (any, nu).",
)
@click.option("--seed", default=0, show_default=True, help="Of random controls.")
@click.option(
    "--out", required=True, type=click.Path(file_okay=False, path_type=Path), help="Folder of the problems."
)
@click.option(
    "--replace", is_flag=True, help="Take the problems of another recording out of the folder first."
)
@precision_option
@click.pass_context
def record(
    context: click.Context, /, model: Path, out: Path, steps: int, precision: str | None, **asked: Any
) -> None:
    """Run a MuJoCo model (MJCF) and keep its constraint problems, for `lavender report OUT`."""
    from lavender.io.recording import record_file

    if asked["control"] != "random":
        refuse_unused(context, ["seed"], "without --controls random")
    click.echo(str(record_file(model, out, steps, precision=precision or "float64", **asked)))
