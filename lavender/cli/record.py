"""`lavender record`."""

from __future__ import annotations

from pathlib import Path

import click

__all__ = ["record"]


@click.command()
@click.argument("model", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--steps", default=500, show_default=True, help="Steps of the simulation.")
@click.option("--every", default=5, show_default=True, help="Steps between two problems.")
@click.option(
    "--controls", default="zero", show_default=True, metavar="zero|random|FILE", help="FILE: .npy, (any, nu)."
)
@click.option("--seed", default=0, show_default=True, help="Of random controls.")
@click.option(
    "--out", required=True, type=click.Path(file_okay=False, path_type=Path), help="Folder of the problems."
)
def record(model: Path, steps: int, every: int, controls: str, seed: int, out: Path) -> None:
    """Run a MuJoCo model (MJCF) and keep its constraint problems, for `lavender report OUT`."""
    from lavender.io.recording import record_file

    found = record_file(model, out, steps, every=every, control=controls, seed=seed)
    click.echo(str(found))
