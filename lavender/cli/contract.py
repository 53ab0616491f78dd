"""Define `lavender contract`."""

from __future__ import annotations

from pathlib import Path

import click

from lavender.base.exits import EXIT_UNMET
from lavender.cli.options import limit_to_one_thread, print_escaped


@click.command()
@click.argument("name")
@click.option(
    "--list", "list_only", is_flag=True, help="List the requirements that apply to the solver; run nothing."
)
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("lavender-contract"),
    show_default=True,
    help="Folder for the problems on which requirements are not met; created for the first one.",
)
@click.pass_context
def contract(context: click.Context, name: str, list_only: bool, out: Path) -> None:
    """Check that a solver meets the requirements on every solver.

    NAME is a built-in solver or an installed plug-in. Each capability that the spec of the solver lists is exercised on
    twelve small problems; each requirement that is not met is explained in a sentence. A plug-in runs in another
    process, so that a crash costs one check. The problem of each requirement that is not met is written to the folder
    --out.

    Exit code 1: a requirement is not met.
    """
    from lavender.contract import CHECKS, check_solver, list_checks, make_problems
    from lavender.io.stored import check_writable, make_folder
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
        style = "bold red" if failure.text else ""
        print_escaped(f"{'NOT MET' if failure.text else 'met    '}  {check.requirement}", style=style)
        if failure.text:
            unmet += 1
            print_escaped(f"         {failure.text}")
        if failure.problem:
            make_folder(check_writable(out, folder=True))
            path = out / f"{check.name}.npz"
            make_problems()[failure.problem].save(path)
            print_escaped(f"         problem: {path}")
    skipped = [f"{check.name} ({check.applies_to})" for check in CHECKS.values() if not check.applies(spec)]
    print_escaped(f"{name} meets {total - unmet} of {total} requirements")
    if skipped:
        print_escaped("\n    ".join(["not required of this solver, and not tested:", *skipped]))
    if unmet:
        context.exit(EXIT_UNMET)
