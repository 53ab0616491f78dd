"""Define `lavender tune`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lavender.base.errors import REPORT_PACKAGES, require_packages
from lavender.base.exits import EXIT_UNMET
from lavender.cli.measuring import show_page, show_progress
from lavender.cli.options import (
    FILE,
    FOLDER,
    add_worlds_options,
    limit_option,
    limit_to_one_thread,
    quiet_option,
    threshold_option,
)
from lavender.io.stored import check_writable


@click.command()
@click.argument("model", metavar="MODEL.xml|MODEL.mjb", type=FILE)
@add_worlds_options(worlds=16, steps=200)
@click.option(
    "--horizon", default=10, show_default=True, help="Steps after which the motion is compared."
)
@click.option("--repeats", default=5, show_default=True, help="Times that each setting is timed.")
@limit_option
@threshold_option
@click.option(
    "--out",
    type=FOLDER,
    default=Path("lavender-tune"),
    show_default=True,
    help="Folder of the page.",
)
@quiet_option
def tune(model: Path, out: Path, quiet: bool, **options: Any) -> None:
    """Find faster or more accurate settings of MuJoCo for a model.

    MODEL is an MJCF file or an .mjb file. The time and the error of a step are measured with many settings on worlds of
    the model. The table has two choices: one that is faster and as accurate as the present setting, and one
    that is more accurate and as fast. Both are chosen on half of the worlds and validated on the other half. With
    --max-velocity-error E, the first sentence names the fastest setting whose errors do not exceed E on all worlds, or
    the one with the smallest error if there is none. Nothing is recommended if fewer than 20 % of the steps have
    contact: then start from states with contact (--states).

    Exit code 1: too few steps have contact, or no setting is within --max-velocity-error. Exit code 130: stopped by
    Ctrl-C; the page shows the completed part.
    """
    require_packages("lavender tune", *REPORT_PACKAGES)
    from lavender.audit.tune import tune as run

    check_writable(out, folder=True)
    limit_to_one_thread()
    with show_progress(quiet) as watch:
        tuning = run(model, watch=watch, **options)
    show_page(tuning.page, out, quiet)
    if tuning.reason_without_line or (
        tuning.error_limit is not None and tuning.within_limit is None
    ):
        raise click.exceptions.Exit(EXIT_UNMET)
