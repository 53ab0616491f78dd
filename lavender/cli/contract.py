"""Define `lavender contract`."""

from __future__ import annotations

import click

from lavender.base.exits import EXIT_UNMET
from lavender.cli.options import limit_to_one_thread, print_escaped


@click.command()
@click.argument("name")
@click.option(
    "--list", "list_only", is_flag=True, help="List the requirements that apply to the solver; run nothing."
)
@click.pass_context
def contract(context: click.Context, name: str, list_only: bool) -> None:
    """Check that a solver meets the requirements on every solver.

    NAME is a built-in solver or an installed plug-in. Each capability that the spec of the solver lists is exercised on
    twelve small problems; each requirement that is not met is explained in a sentence. A plug-in runs in another
    process, so that a crash costs one check.

    Exit code 1: a requirement is not met.
    """
    from lavender.contract import CHECKS, check_solver, list_checks
    from lavender.solvers import registry

    limit_to_one_thread()
    spec = registry.get(name)
    if list_only:
        for check in list_checks(spec):
            print_escaped(f"{check.requirement}\n    {check.name}, {check.applies_to}")
        return
    unmet = total = 0
    for check, failure in check_solver(name):
        total += 1
        style = "bold red" if failure else ""
        print_escaped(f"{'NOT MET' if failure else 'met    '}  {check.requirement}", style=style)
        if failure:
            unmet += 1
            print_escaped(f"         {failure}")
    skipped = [f"{check.name} ({check.applies_to})" for check in CHECKS.values() if not check.applies(spec)]
    print_escaped(f"{name} meets {total - unmet} of {total} requirements")
    if skipped:
        print_escaped("\n    ".join(["not required of this solver, and not tested:", *skipped]))
    if unmet:
        context.exit(EXIT_UNMET)
