"""`lavender explain`."""

from __future__ import annotations

import json

import click

__all__ = ["explain"]


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option("--tol", type=float, default=1e-6, show_default=True, help="Relative residual asked for.")
@click.option(
    "--json", "as_data", is_flag=True, help="As data, one plan a line, for `lavender.solve(..., plan=)`."
)
def explain(files: tuple[str, ...], tol: float, as_data: bool) -> None:
    """What auto would do with problems (files, folders or cases of the suite), and what it expects that to cost.

    Nothing is run. Costs are counted from the structure of a problem, with rates that are the same everywhere.
    """
    from lavender.bench.cases import resolve
    from lavender.plan import explain as plan_of

    for item in resolve(list(files)):
        plan = plan_of(item.problem, tol)
        if as_data:
            click.echo(json.dumps(plan.data()))
        else:
            click.echo(f"{item.name}: {plan}\n")
        item.forget()
