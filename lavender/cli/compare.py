"""Define `lavender compare`."""

from __future__ import annotations

from pathlib import Path

import click

from lavender.base.errors import REPORT_PACKAGES, InputError, require_packages
from lavender.cli.completion import complete_file_or_word
from lavender.cli.options import FILE, FOLDER, limit_to_one_thread, make_console, print_escaped
from lavender.io.stored import check_writable


@click.command()
@click.argument("a", metavar="MODEL.xml|STEP.npz", type=FILE)
@click.argument("b", metavar="[MODEL.xml|STEP.npz]", type=FILE, required=False)
@click.option(
    "--option",
    "options",
    multiple=True,
    metavar="NAME=VALUE",
    help="Option of the second model, as in <option>; without a second model, of a copy of the first. Repeatable.",
)
@click.option(
    "--states",
    metavar="FILE.npz|keyframes",
    shell_complete=complete_file_or_word("keyframes"),
    help="States to compare, such as states.npz of an audit; default: the initial state.",
)
@click.option(
    "--steps",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Steps of the first model from each state; the last one is compared.",
)
@click.option("--save", type=Path, help="File .npz for the first step, to compare versions.")
@click.option("--out", type=FOLDER, help="Folder of a page with pictures and of numbers.json.")
def compare(
    a: Path,
    b: Path | None,
    options: tuple[str, ...],
    states: str | None,
    steps: int,
    save: Path | None,
    out: Path | None,
) -> None:
    """Explain why two models, versions or engines differ after one step.

    Both do the same step from the same state. The difference of their velocities is divided into parts: mass, force,
    integrator, rows, softness, friction, and what the solvers leave. Each part is a mean over all orders in which the
    ingredients can be exchanged, with the interval of all orders. The output names what differs, and what to try, which
    is solved first. Without a second argument and --option, the model is compared with the rigid laws.

    A step of another version or engine is a file: --save, or lavender.io.save_step in Python.
    """
    require_packages("lavender compare", *REPORT_PACKAGES)
    from lavender.audit.page import ResultPage
    from lavender.causes.states import compare_at_states
    from lavender.io.step_record import save_step
    from lavender.report.render import print_table

    if out is not None:
        check_writable(out, folder=True)
    limit_to_one_thread()
    named = {}
    for text in options:
        name, sign, value = text.partition("=")
        if not (name and sign and value):
            raise InputError(
                f"--option is {text!r}; NAME=VALUE is needed, such as integrator=Euler"
            )
        named[name.strip()] = value.strip()
    result, records = compare_at_states(a, b, states=states, steps=steps, options=named)
    if save is not None:
        save_step(records[0], save)
    console = make_console()
    if len(result.states) > 1:
        print_table(console, result.table)
        print_escaped(
            f"\nState {result.largest.state} (counted from 0) has the largest difference:"
        )
    print_escaped(str(result.largest.comparison))
    if out is not None:
        page = ResultPage(result.make_page, result.numbers)
        print_escaped(f"\nPage: {page.write(out)}")
