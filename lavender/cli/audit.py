"""Define `lavender audit`."""

from __future__ import annotations

import os
from itertools import count
from pathlib import Path
from typing import Any

import click

from lavender.base.errors import REPORT_PACKAGES, require_packages
from lavender.base.exits import EXIT_UNMET
from lavender.cli.completion import complete_file_or_word
from lavender.cli.measuring import show_page, show_progress
from lavender.cli.options import (
    FILE,
    FOLDER,
    add_worlds_options,
    limit_option,
    limit_to_one_thread,
    precision_option,
    print_escaped,
    quiet_option,
    reject_options_without_effect,
    threshold_option,
    workers_option,
)
from lavender.io.stored import check_writable


@click.command()
@click.argument("model", metavar="MODEL.xml|MODEL.mjb|SCENE.py", type=FILE)
@add_worlds_options(worlds=None, steps=200)
@click.option(
    "--engine",
    default="mujoco",
    show_default=True,
    help="Engine that steps the worlds.",
    type=click.Choice(["mujoco", "mjx", "mujoco_warp", "kamino", "newton-mujoco", "genesis"]),
)
@click.option(
    "--against",
    type=FILE,
    metavar="MODEL.xml|MODEL.mjb",
    help="Another model, such as one with other options, that solves the same steps.",
)
@limit_option
@click.option(
    "--keep",
    type=int,
    metavar="N",
    help="Keep the N worst steps; default: the worst step of each of three worlds.",
)
@click.option(
    "--save-states",
    type=(click.Choice(["contact", "worst"]), FILE),
    metavar="contact|worst FILE.npz",
    shell_complete=complete_file_or_word("contact", "worst"),
    help="Write the states before steps with contact (about 1000 at most), or before the worst steps, for "
    "--states of tune, slip, record and report.",
)
@threshold_option
@precision_option
@click.option(
    "--njmax",
    type=int,
    metavar="N",
    help="Rows of a world for mujoco_warp, as in your simulation; default: as many as needed.",
)
@workers_option
@click.option(
    "--backend", default="loky", show_default=True, help="A backend of joblib, such as dask."
)
@click.option(
    "--out",
    type=FOLDER,
    default=Path("lavender-audit"),
    show_default=True,
    help="Folder of the page, the records and the worst worlds.",
)
@quiet_option
@click.pass_context
def audit(
    context: click.Context,
    /,
    model: Path,
    out: Path,
    quiet: bool,
    save_states: tuple[str, Path] | None,
    **options: Any,
) -> None:
    """Judge every step of many worlds of a MuJoCo model.

    MODEL is an MJCF file, or an .mjb file of a model that was changed after loading. For kamino, newton-mujoco and
    genesis, SCENE.py is a Python file whose function build() returns a newton.ModelBuilder, or build(worlds) a built
    genesis.Scene; or it is the name of a builder in newton.tests.utils.basics. The page then compares what the engine
    claims about each solve with the verdict.

    Without --worlds the audit takes about a minute; the remaining time is shown. The page
    shows how many steps were judged, how many of these stopped before convergence,
    their errors with time and body, and the numbers of rows and contacts. The worst worlds are problem files in
    OUT/worst; OUT/states.npz holds the states before them, from which --states starts again. An earlier audit in OUT
    is moved to OUT-1, OUT-2, ... before this one is written.

    Exit code 1: a world diverged, a step could not be judged, too few steps have contact, the engine dropped rows, or
    an answer that is not at its floor has a velocity error above --max-velocity-error. Exit code 130: stopped by
    Ctrl-C; the page shows the completed steps.
    """
    require_packages("lavender audit", *REPORT_PACKAGES)
    from lavender.audit.audit import audit as run
    from lavender.report.text import format_count

    reject_options_without_effect(context, other_engine=options["engine"] != "mujoco")
    check_writable(out, folder=True)
    limit_to_one_thread()
    with show_progress(quiet) as watch:
        result = run(
            model,
            watch=watch,
            keep_contact_states=save_states is not None and save_states[0] == "contact",
            **options,
        )
    if (out / "records.npz").exists():
        os.replace(
            out, next(p for i in count(1) if not (p := out.with_name(f"{out.name}-{i}")).exists())
        )
    result.write(out)
    if save_states is not None:
        n = result.save_states(*save_states)
        if not quiet:
            print_escaped(f"{save_states[1]}: {format_count(n, 'state')} for --states")
    show_page(result.page, out, quiet)
    if result.is_unmet:
        raise click.exceptions.Exit(EXIT_UNMET)
