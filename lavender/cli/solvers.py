"""Define `lavender solvers`."""

from __future__ import annotations

import click

from lavender.cli.options import escape_markup, make_console


@click.command()
@click.argument("name", required=False)
def solvers(name: str | None) -> None:
    """List the solvers and their capabilities, or describe the solver NAME.

    Solvers that are not installed show the package to install. For a backend of another package, the description has
    its observed behaviour with small programs.
    """
    if name is None:
        _list_solvers()
    else:
        _describe_solver(name)


def _describe_solver(name: str) -> None:
    """Print summary, reference, options and observed behaviour of a solver."""
    from lavender.external.backends import describe_backend, get_observed_version
    from lavender.solvers import registry

    if name not in registry.specs():
        registry.get(name)  # Raises UnknownName with similar names.
    spec, reason = registry.specs()[name], registry.known()[name]
    lines = [f"{name}: {spec.summary}", spec.reference and f"Reference: {spec.reference}", reason]
    lines += [f"Option {option}: {text}" for option, text in spec.options.items()]
    sentences = describe_backend(name)
    if sentences:
        lines += [
            f"Observed with version {get_observed_version(name)}, called alone at its default settings:"
        ]
        lines += [f"- {sentence}" for sentence in sentences]
    elif spec.external:
        lines += ["Its behaviour was not observed."]
    console = make_console()
    for line in filter(None, lines):
        console.print(escape_markup(line), highlight=False)


def _list_solvers() -> None:
    """Print a table of the solvers."""
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
