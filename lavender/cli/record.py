"""`lavender record`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lavender.cli.options import (
    FILE,
    FOLDER,
    precision_option,
    recording_options,
    refuse_unused_recording,
    say,
)


@click.command()
@click.argument("model", metavar="MODEL.xml", type=FILE)
@recording_options
@click.option("--out", required=True, type=FOLDER, help="Folder for the problems.")
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

    refuse_unused_recording(context, True)
    say(str(record_file(model, out, steps, precision=precision or "float64", **asked)))
