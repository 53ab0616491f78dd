"""`lavender record`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lavender.errors import InputError

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
    import numpy as np

    from lavender.io import record as record_steps

    try:
        import mujoco as mj
    except ImportError:
        raise InputError("mujoco cannot be imported: pip install mujoco") from None
    try:
        made = mj.MjModel.from_xml_path(str(model))
    except ValueError as error:  # MuJoCo's word about a file that it cannot read
        raise InputError(f"{model}: {error}") from None
    control: Any = controls
    if controls not in ("zero", "random"):
        try:
            control = np.load(controls, allow_pickle=False)
        except (OSError, ValueError) as error:
            raise InputError(f"--controls {controls}: {error}") from None
    found = record_steps(made, mj.MjData(made), out, steps, every=every, control=control, seed=seed)
    click.echo(str(found))
    if not found.files:
        raise InputError("no step had a constraint that could be kept: more --steps, or other --controls")
