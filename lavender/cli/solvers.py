"""Define `lavender solvers`."""

from __future__ import annotations

import click

from lavender.cli.options import escape_markup, make_console


@click.command()
def solvers() -> None:
    """List the solvers and their capabilities.

    Solvers that are not installed show the package to install.
    """
    from rich.table import Table

    from lavender.problem import LAWS, OPERATORS
    from lavender.solvers import registry

    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("solver", "laws", "reads", "capabilities", "description"):
        table.add_column(name, no_wrap=name == "solver", overflow="fold")
    reasons = registry.known()
    # Installed solvers come first.
    order = sorted(registry.specs().items(), key=lambda pair: (reasons[pair[0]] is not None, pair[0]))
    for name, spec in order:
        abilities = [
            word
            for word, has in (
                ("exact", spec.exact),
                ("boxes", bool(spec.box_friction_laws)),
                ("warm start", spec.impulse),
                ("budget", spec.resumable),
                ("order", spec.order),
                ("seed", spec.seed),
                ("history", spec.history),
            )
            if has
        ]
        reason = reasons[name]
        description = escape_markup(spec.summary) if reason is None else f"[yellow]{escape_markup(reason)}[/]"
        laws = [law for law in LAWS if law in spec.laws]
        table.add_row(
            escape_markup(name),
            " ".join(laws),
            " ".join(o for o in OPERATORS if o in spec.operators),
            ", ".join(abilities),
            description,
            style="" if reason is None else "dim",
        )
    make_console().print(table)
