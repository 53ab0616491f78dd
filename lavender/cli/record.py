"""Define `lavender record`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lavender.base.exits import EXIT_UNMET
from lavender.cli.options import (
    FILE,
    FOLDER,
    exit_after_interrupt,
    precision_option,
    print_escaped,
    recording_options,
    reject_unused_recording_options,
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
    context: click.Context, /, model: Path, out: Path, steps: int, precision: str | None, **options: Any
) -> None:
    """Simulate a MuJoCo model and write its constraint problems.

    MODEL.xml is an MJCF file. `lavender report OUT` measures solvers on the problems. Steps from different --states are
    independent problems. After Ctrl-C, the folder has the steps until then.

    Exit code 1: a step could not be recorded.
    """
    from lavender.io.recording import record_file

    reject_unused_recording_options(context, True)
    recorded = record_file(model, out, steps, precision=precision or "float64", **options)
    print_escaped(str(recorded))
    if recorded.is_interrupted:
        exit_after_interrupt()
    if recorded.left_out:
        raise click.exceptions.Exit(EXIT_UNMET)
