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
    one_thread,
    precision_option,
    threshold_option,
    was_given,
    worlds_options,
)
from lavender.io.stored import lock_output


@click.command()
@click.argument("model", metavar="MODEL.xml", type=FILE)
@worlds_options(worlds=None, steps=200)
@click.option(
    "--engine",
    default="mujoco",
    show_default=True,
    metavar="mujoco|mjx|mujoco_warp",
    help="Engine that steps the worlds.",
)
@click.option("--max-velocity-error", type=float, metavar="M/S",
              help="Exit with 1 if a step that is not at its floor has a larger velocity error [m/s].")  # fmt: skip
@threshold_option
@precision_option
@click.option("--workers", type=int, default=-1, help="Processes, for mujoco; -1: one for each core.")
@click.option("--backend", default="loky", show_default=True, help="A backend of joblib, such as dask.")
@click.option("--out", type=FOLDER, default=Path("lavender-audit"),
              show_default=True, help="Folder of the page, the records and the worst worlds.")  # fmt: skip
@click.pass_context
def audit(
    context: click.Context, /, model: Path, out: Path, max_velocity_error: float | None, **options: Any
) -> None:
    """Judge every step of many worlds of a MuJoCo model.

    MODEL.xml is an MJCF file. Without --worlds the audit takes about a minute; the remaining time is shown. The page
    shows how many steps were judged, how many of these stopped before convergence,
    their errors with time and body, and the numbers of rows and contacts. The worst worlds are problem files in
    OUT/worst; OUT/states.npz holds the states before them, from which --states starts again.

    Exit code 1: a world diverged, a step could not be judged, or an answer that is not at its floor has a velocity
    error above --max-velocity-error. Exit code 130: stopped by Ctrl-C; the page shows the completed steps.
    """
    from lavender.lab.audit import audit as run

    if max_velocity_error is not None and not max_velocity_error >= 0.0:
        raise InputError(f"--max-velocity-error is {max_velocity_error}; a velocity error in m/s is needed")
    if options["engine"] != "mujoco":
        for name in ("workers", "backend", "precision"):
            if was_given(context, name):
                raise InputError(f"--{name} needs --engine mujoco: leave it out")
    context.with_resource(lock_output(out, folder=True))
    one_thread()
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
