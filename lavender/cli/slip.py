"""Define `lavender slip`."""

from __future__ import annotations

from pathlib import Path

import click

from lavender.base.exits import EXIT_UNMET
from lavender.cli.options import FILE, limit_to_one_thread, make_console, print_escaped
from lavender.io.stored import check_figure_path, check_writable, write_figure

# Columns that a narrow terminal leaves out, in this order.
NARROW_SLIP_OMITS = ("steps x points", "coulomb [m/s]", "hard [m/s]", "disk [m/s]")


@click.command()
@click.argument("model", metavar="MODEL.xml", type=FILE)
@click.option(
    "--states",
    metavar="FILE.npz|keyframes",
    help="States to explain, such as states.npz of an audit; default: the initial state.",
)
@click.option("--steps", type=int, default=1, show_default=True,
              help="Steps simulated from each state, with its controls; the last one is explained.")  # fmt: skip
@click.option("--contact", "contacts", multiple=True, metavar="GEOM",
              help="Contacts of geoms whose names contain this; may be repeated. Default: all.")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE.png|svg|pdf",
              help="Draw the parts of the slip of each contact.")  # fmt: skip
def slip(model: Path, states: str | None, steps: int, contacts: tuple[str, ...], out: Path | None) -> None:
    """Explain why contacts of a MuJoCo model slip.

    MODEL.xml is an MJCF file. For each contact, the table shows its mean sliding speed in the engine's answer, in the
    exact solution of the same problem, with round cones, with friction that is not softened, and with Coulomb's law.
    The dominant cause is the replacement that changes the speed most, or a load above the friction limit. The sentence
    below the table names the cause of the fastest contact, and a remedy. Settings of MuJoCo are then tried: the second
    table shows the slip of this contact with each, in the same step and 25 steps later.

    Exit code 1: no state has a contact with friction.
    """
    from lavender.audit.slip import explain_slip_of_states, summarize_slip
    from lavender.audit.slip_figure import draw_slip
    from lavender.base.arrays import check_int
    from lavender.io.recorder import can_sleep, load_model
    from lavender.report.terminal import print_table

    steps = check_int("steps", steps, 1)
    if out is not None:
        out = check_writable(check_figure_path(out))
    limit_to_one_thread()
    mj, loaded = load_model(model)
    explanations = explain_slip_of_states(loaded, states, contacts=contacts or None, steps=steps)
    if can_sleep(mj, loaded):
        print_escaped('Sleep was off, although the model has <flag sleep="enable"/>.')
    touching = [contact for explanation in explanations for contact in explanation.contacts]
    for name in contacts:
        if not any(name in contact for contact in touching):
            print_escaped(f"{name!r} touches nothing with friction in these states.")
    if not explanations:
        print_escaped(
            f"{model}: no contact with friction in these states; give other --states, or more --steps"
        )
        raise click.exceptions.Exit(EXIT_UNMET)
    if out is not None:
        write_figure(draw_slip(explanations), out)
    print_table(make_console(), summarize_slip(explanations), optional=NARROW_SLIP_OMITS)
    worst = max(explanations, key=lambda e: float(e.variants[0].speeds.max(initial=0.0)))
    n = next(i for i, e in enumerate(explanations, 1) if e is worst)
    place = f"State {n} of {len(explanations)} with contact: " if len(explanations) > 1 else ""
    print_escaped(place + worst.sentence)
    if worst.remedies:
        print_table(make_console(), worst.remedies_table)
