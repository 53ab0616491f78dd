"""Define `lavender audit`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lavender.base.errors import InputError
from lavender.cli.measuring import progress, show_page
from lavender.cli.options import (
    EXIT_UNMET,
    FILE,
    FOLDER,
    precision_option,
    set_one_thread,
    threshold_option,
    was_given,
    worlds_options,
)
from lavender.io.stored import lock_output


@click.command()
@click.argument("model", metavar="MODEL.xml", type=FILE)
@worlds_options(worlds=4096, steps=200)
@click.option(
    "--engine",
    default="mujoco",
    show_default=True,
    metavar="mujoco|mjx|mujoco_warp",
    help="Engine that steps the worlds.",
)
@click.option("--accept", type=float, metavar="M/S",
              help="Velocity error [m/s] up to which a step above its round-off floor is accepted.")  # fmt: skip
@threshold_option
@precision_option
@click.option(
    "--workers", type=int, default=-1, help="Number of processes for mujoco; -1: one for each core."
)
@click.option("--backend", default="loky", show_default=True, help="joblib backend, such as dask.")
@click.option("--out", type=FOLDER, default=Path("lavender-audit"),
              show_default=True, help="Folder for the page, the records and the worst worlds.")  # fmt: skip
@click.pass_context
def audit(context: click.Context, /, model: Path, out: Path, accept: float | None, **options: Any) -> None:
    """Judge an engine's answer to every step of a MuJoCo model.

    Simulates worlds of the model (MJCF). The page shows how many steps were judged, how many of these stopped before
    convergence, their errors and worst rows, and how many rows and contacts they have. The worst worlds are written as
    problem files to OUT/worst; OUT/states.npz holds the states before them, from which --states starts again.

    Exit code 1: a world diverged, or a step could not be judged; with --accept, an answer above its floor has a larger
    error. Exit code 130: stopped by Ctrl-C; the page shows the steps so far.
    """
    from lavender.lab.audit import audit as run

    if accept is not None and not accept >= 0.0:
        raise InputError(f"--accept is {accept}; a velocity error in m/s is needed")
    if options["engine"] != "mujoco":
        for name in ("workers", "backend", "precision"):
            if was_given(context, name):
                raise InputError(f"--{name} has no effect without --engine mujoco: leave it out")
    context.with_resource(lock_output(out, folder=True))
    set_one_thread()
    with progress() as watch:
        result = run(model, watch=watch, **options)
    result.write(out)
    show_page(result.summary_page, out)
    if (
        result.diverged
        or result.unjudged
        or (max_velocity_error is not None and result.largest > max_velocity_error)
    ):
        raise click.exceptions.Exit(EXIT_UNMET)
