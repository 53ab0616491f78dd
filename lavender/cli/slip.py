"""Define `lavender slip`."""

from __future__ import annotations

from pathlib import Path

import click

from lavender.base.errors import REPORT_PACKAGES, require_packages
from lavender.base.exits import EXIT_UNMET
from lavender.cli.completion import complete_file_or_word
from lavender.cli.measuring import show_progress
from lavender.cli.options import FILE, FOLDER, limit_to_one_thread, make_console, print_escaped
from lavender.io.stored import check_writable


@click.command()
@click.argument("model", metavar="MODEL.xml|MODEL.mjb", type=FILE)
@click.option(
    "--states",
    metavar="FILE.npz|keyframes",
    shell_complete=complete_file_or_word("keyframes"),
    help="States to explain, such as states.npz of an audit; default: the initial state.",
)
@click.option(
    "--steps",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Steps simulated from each state, with its controls; the last one is explained.",
)
@click.option(
    "--contact",
    "contacts",
    multiple=True,
    metavar="GEOM",
    help="Contacts of geoms whose names contain this; may be repeated. Default: all.",
)
@click.option(
    "--out", type=FOLDER, help="Folder of a page with the slip over time and of numbers.json."
)
def slip(
    model: Path, states: str | None, steps: int, contacts: tuple[str, ...], out: Path | None
) -> None:
    """Explain why contacts of a MuJoCo model slip.

    MODEL is an MJCF or .mjb file. The first table shows the speed of each contact along its surface after the step, and
    the largest part of this speed with its cause: unfinished solving, the integrator, softness, shape of the cone,
    convex relaxation, or sliding at the friction limit. The step is compared with the same step by the rigid laws, and
    each part is a mean over all orders in which the causes can be exchanged, as by `lavender compare`. Settings of
    MuJoCo are then simulated. The second table shows the speed of the fastest contact with each, in the same step and
    as a mean of the next 25 steps; the last lines name the settings that help.

    Exit code 1: no state has a contact with friction.
    """
    require_packages("lavender slip", *REPORT_PACKAGES)
    from lavender.audit.provenance import format_provenance
    from lavender.audit.slip_states import explain_slip_of_states
    from lavender.io.start_states import can_sleep, load_model
    from lavender.report.render import print_table
    from lavender.report.text import format_count

    if out is not None:
        check_writable(out, folder=True)
    limit_to_one_thread()
    mj, loaded = load_model(model)
    with show_progress() as watch:
        result = explain_slip_of_states(
            loaded, states, contacts=contacts or None, steps=steps, watch=watch
        )
    if can_sleep(mj, loaded):
        print_escaped('Sleep was off, although the model has <flag sleep="enable"/>.')
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
    if n > 1:
        print_escaped(f"\nState {worst.state} (counted from 0) has the fastest contact:")
    print_escaped("\n".join(worst.sentences))
    if worst.remedies:
        print_escaped(
            f"\nSettings simulated from {format_count(worst.n_states, 'state')}, mean slip of {worst.followed} "
            "(any geoms of the two bodies):"
        )
        print_table(console, worst.remedies_table)
        print_escaped("\n".join(worst.advice))
    if out is not None:
        print_escaped(f"\nPage: {result.page.write(out)}")
    print_escaped(f"\n{format_provenance(result.provenance | {'model': model.name})}")
