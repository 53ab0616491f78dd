"""Define `lavender slip`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lavender.base.errors import REPORT_PACKAGES, require_packages
from lavender.base.exits import EXIT_UNMET
from lavender.cli.measuring import show_progress
from lavender.cli.options import (
    FILE,
    FOLDER,
    add_worlds_options,
    limit_to_one_thread,
    make_console,
    print_escaped,
    workers_option,
)
from lavender.io.stored import check_writable, write_text


@click.command()
@click.argument("model", metavar="MODEL.xml|MODEL.mjb", type=FILE)
@add_worlds_options(
    worlds=None,
    steps=1,
    control="hold",
    default_worlds="one for each state of --states, or 1",
)
@click.option(
    "--contact",
    "contacts",
    multiple=True,
    metavar="GEOM",
    help="Contacts of geoms whose names contain this; may be repeated. Default: all.",
)
@workers_option
@click.option(
    "--out",
    type=FOLDER,
    help="Folder of a page with the slip over time, of forces.csv and numbers.json.",
)
def slip(model: Path, contacts: tuple[str, ...], out: Path | None, **options: Any) -> None:
    """Explain why contacts of a MuJoCo model slip.

    MODEL is an MJCF or .mjb file. The last of the --steps of each world is explained. The first table shows the speed
    of each contact along its surface after the step, and the largest part of this speed with its cause: unfinished
    solving, the integrator, softness, shape of the cone, convex relaxation, or sliding at the friction limit. The step
    is compared with the same step by the rigid laws, and each part is a mean over all orders in which the causes can be
    exchanged, as by `lavender compare`. The second table has the contact forces [N] and their errors where the bodies
    determine them. Settings of MuJoCo are then simulated. The last table shows the speed of the fastest contact with
    each, in the same step and as a mean of the next 25 steps; the last lines name the settings that help.

    Exit code 1: no state has a contact with friction.
    """
    require_packages("lavender slip", *REPORT_PACKAGES)
    from lavender.audit.provenance import format_provenance
    from lavender.audit.slip_states import explain_slip_of_states
    from lavender.report.render import print_table
    from lavender.report.text import format_count

    if out is not None:
        check_writable(out, folder=True)
    limit_to_one_thread()
    with show_progress() as watch:
        result = explain_slip_of_states(model, contacts=contacts or None, watch=watch, **options)
    for note in result.notes:
        print_escaped(note)
    touching = [contact for explanation in result.explanations for contact in explanation.contacts]
    for name in contacts:
        if not any(name in contact for contact in touching):
            print_escaped(f"{name!r} touches nothing with friction in these states.")
    if not result.explanations:
        print_escaped(
            f"{model}: no contact with friction in these states; give other --states, or more --steps"
        )
        raise click.exceptions.Exit(EXIT_UNMET)
    console = make_console()
    worst = result.worst
    print_table(console, result.table, optional=("points",))
    n = len(result.explanations)
    print_escaped(
        f"slip: mean over the points of {format_count(n, 'state')} with contact, in one step of each"
    )
    print_escaped("\n".join(["", result.verdict, *result.sentences]))
    if len(result.fastest_forces):
        print_escaped(f"\nContact forces in state {result.fastest.state}:")
        print_table(console, result.fastest_forces, optional=("contact",))
    if worst.remedies:
        print_escaped(
            f"\nSettings simulated from {format_count(worst.n_states, 'state')}, mean slip of {worst.followed} "
            "(any geoms of the two bodies):"
        )
        print_table(console, worst.remedies_table)
        print_escaped("\n".join(worst.advice))
    if out is not None:
        page = result.page.write(out)
        write_text(out / "forces.csv", result.forces.to_csv(index=False))
        print_escaped(f"\nPage: {page}")
    print_escaped(f"\n{format_provenance(result.provenance)}")
