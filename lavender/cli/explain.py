"""`lavender explain`."""

from __future__ import annotations

import json

import click

__all__ = ["explain"]


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option("--tol", type=float, default=1e-6, show_default=True, help="Relative residual to reach.")
@click.option(
    "--json",
    "as_data",
    is_flag=True,
    help="Print one plan per line as JSON, for `lavender.solve(..., plan=)`.",
)
def explain(files: tuple[str, ...], tol: float, as_data: bool) -> None:
    """Print what `auto` would do with problems (files, folders or cases of the suite), and the expected costs.

    Nothing is solved. Costs are counted from the structure of a problem, with the same rates on every machine.
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
