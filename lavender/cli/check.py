"""`lavender check`."""

from __future__ import annotations

import click

from lavender.cli.options import (
    EXIT_BAD_INPUT,
    EXIT_UNMET,
    ManyValues,
    Names,
    console,
    one_thread,
    plain,
)
from lavender.errors import InputError, LavenderError

__all__ = ["check"]


@click.command(cls=ManyValues)
@click.argument("files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...")
@click.option("--solvers", type=Names(), help="Solvers by name; all that take the problem if not given.")
@click.option("--reference", default="osqp", show_default=True, help="Whose answer to compare with.")
@click.option("--tol", type=float, default=1e-6, show_default=True)
def check(files: tuple[str, ...], solvers: tuple[str, ...] | None, reference: str, tol: float) -> None:
    """Compare solvers with a reference and with the judge.

    Exits with 1 when a claim is contradicted or a file met in a folder cannot be read, with 2 when one that was
    named cannot.
    """
    from lavender import bench
    from lavender.check import cross_check

    one_thread()
    out = console()
    contradicted = unread = missing = 0
    bench.solver_names(solvers)
    for item in bench.resolve(files):
        try:
            found = cross_check(item.problem, solvers=solvers, reference=reference, tol=tol)
        except LavenderError as error:
            out.print(f"{item.name}: {plain(str(error))}", style="yellow", highlight=False)
            unread += isinstance(error, InputError) and not item.named
            missing += isinstance(error, InputError) and item.named
            continue
        finally:
            item.forget()
        out.print(f"[bold]{plain(item.name)}[/]", highlight=False)
        out.print(str(found), highlight=False, markup=False)
        contradicted += len(found.contradicted)
    if contradicted:
        out.print(f"[bold red]{contradicted} claims are contradicted[/]")
    if missing:
        raise click.exceptions.Exit(EXIT_BAD_INPUT)
    if contradicted or unread:
        raise click.exceptions.Exit(EXIT_UNMET)
