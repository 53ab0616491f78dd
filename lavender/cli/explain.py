"""Define `lavender explain`."""

from __future__ import annotations

import json

import click

from lavender.cli.completion import complete_case_or_file
from lavender.cli.options import ErrorReporter, print_escaped


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="FILES...", shell_complete=complete_case_or_file)
@click.option("--tol", type=float, default=1e-6, show_default=True, help="Relative residual to reach.")
@click.option("--json", "as_data", is_flag=True, help="Print one decision trace per line as JSON.")
def explain(files: tuple[str, ...], tol: float, as_data: bool) -> None:
    """Print the decision trace of `auto` on problems.

    FILES are files, folders or cases of the suite. Nothing is solved. Costs are counted from the structure of a
    problem, with the same rates on every machine.

    Exit code 1: a file in a folder cannot be read; the others are explained. Exit code 2: a named file cannot be read.
    """
    from lavender.base.arrays import check_float
    from lavender.report.cases import resolve_sources
    from lavender.solving.plan import explain as explain_problem

    check_float("tol", tol, above=0.0)
    errors = ErrorReporter()
    for item in resolve_sources(list(files)):
        with errors(item):
            plan = explain_problem(item.problem, tol)
            if as_data:
                click.echo(json.dumps(plan.data()))
            else:
                print_escaped(f"{item.name}: {plan}\n")
    errors.exit()
