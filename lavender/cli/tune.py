"""`lavender tune`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lavender.cli.measuring import progress, show_page
from lavender.cli.options import FILE, FOLDER, one_thread, threshold_option, worlds_options
from lavender.io.stored import lock_output


@click.command()
@click.argument("model", metavar="MODEL.xml", type=FILE)
@worlds_options(worlds=16, steps=200)
@click.option("--horizon", default=10, show_default=True, help="Steps after which the motion is compared.")
@click.option("--repeats", default=5, show_default=True, help="Times that each setting is timed.")
@threshold_option
@click.option("--out", type=FOLDER, default=Path("lavender-tune"),
              show_default=True, help="Folder of the page.")  # fmt: skip
@click.pass_context
def tune(context: click.Context, /, model: Path, out: Path, **asked: Any) -> None:
    """Measure MuJoCo's settings on worlds of a model (MJCF): time of a step beside error.

    Prints the <option> line that is as accurate as now and faster, and the one that is as fast as now and more
    accurate. Both are chosen on half of the worlds and tried on the other half. No line is printed if fewer than 20 %
    of the steps have contact: give states that have, with --states.

    Exit code 130: stopped by Ctrl-C; the page tells of what was done.
    """
    from lavender.lab.tune import tune as run

    context.with_resource(lock_output(out, folder=True))
    one_thread()
    with progress() as watch:
        found = run(model, watch=watch, **asked)
    show_page(found.summary_page, out)
