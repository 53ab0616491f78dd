"""`lavender explain`."""

from __future__ import annotations

import json

import click

from lavender.base.errors import InputError
from lavender.cli.options import EXIT_UNMET, say


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option("--tol", type=float, default=1e-6, show_default=True, help="Relative residual to reach.")
@click.option("--json", "as_data", is_flag=True, help="Print one way per line as JSON.")
def explain(files: tuple[str, ...], tol: float, as_data: bool) -> None:
    """Print the way of `auto` through its tree with problems (files, folders or cases of the suite).

    Nothing is solved. Costs are counted from the structure of a problem, with the same rates on every machine.

    Exit code 1: a file in a folder cannot be read; the others are explained. Exit code 2: a named file cannot be read.
    """
    from lavender.lab.bench.cases import resolve
    from lavender.solving.plan import explain as plan_of

    unread = False
    for item in resolve(list(files)):
        try:
            problem = item.problem
        except InputError as error:
            if item.named:
                raise
            say(f"{item.name}: {error}", err=True)
            unread = True
            continue
        item.forget()
        plan = plan_of(problem, tol)
        if as_data:
            click.echo(json.dumps(plan.data()))
        else:
            say(f"{item.name}: {plan}\n")
    if unread:
        raise click.exceptions.Exit(EXIT_UNMET)
