"""Define `lavender tune`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lavender.cli.measuring import progress, show_page
from lavender.cli.options import FILE, FOLDER, set_one_thread, threshold_option, worlds_options
from lavender.io.stored import lock_output


@click.command()
@click.argument("model", metavar="MODEL.xml", type=FILE)
@worlds_options(worlds=16, steps=200)
@click.option(
    "--ahead", default=10, show_default=True, help="Number of steps after which the motion is compared."
)
@click.option(
    "--rounds", default=5, show_default=True, help="Rounds of timing, in which the settings alternate."
)
@threshold_option
@click.option("--out", type=FOLDER, default=Path("lavender-tune"),
              show_default=True, help="Folder for the page.")  # fmt: skip
@click.pass_context
def tune(context: click.Context, /, model: Path, out: Path, **options: Any) -> None:
    """Find MuJoCo settings that are faster or more accurate.

    Measures time and error of a step on worlds of a model (MJCF). Prints the <option> line that is as accurate as the
    present one and faster, and the one that is as fast and more accurate. Both are chosen on half of the worlds and
    tested on the other half. No line is printed if fewer than 20 % of the steps have contact: give states with contact
    (--states).

    Exit code 130: stopped by Ctrl-C; the page shows the results so far.
    """
    from lavender.lab.tune import tune as run

    context.with_resource(lock_output(out, folder=True))
    set_one_thread()
    with progress() as watch:
        result = run(model, watch=watch, **options)
    show_page(result.summary_page, out)
