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
    precision_option,
    refuse_unused,
)
from lavender.errors import InputError, LavenderError

__all__ = ["check"]


@click.command(cls=ManyValues)
@click.argument("files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...")
@click.option("--solvers", type=Names(), help="Solvers by name; default: all that accept the problem.")
@click.option(
    "--reference", default="osqp", show_default=True, help="Solver whose answer the others are compared with."
)
@click.option("--tol", type=float, default=1e-6, show_default=True, help="Relative residual to reach.")
@precision_option
@click.pass_context
def check(
    context: click.Context,
    files: tuple[str, ...],
    solvers: tuple[str, ...] | None,
    reference: str,
    tol: float,
    precision: str | None,
) -> None:
    """Compare solvers with a reference solver, and their claims with the judge.

    A solution stored in a file is judged too: is it at the floor of its precision, or did its solver stop early?

    A records.jsonl of a report is verified: each run is repeated on the problems named after it (default: where the
    records say). Verdicts must agree; times are shown side by side.

    Exit code 1: a claim is contradicted; a verdict or problem differs from the records.jsonl; a file in a folder
    cannot be read; or, with --precision, a stored solution is not at its floor. Exit code 2: a named file cannot be
    read, or --precision finds no stored solution.
    """
    from lavender import bench
    from lavender._arrays import number
    from lavender.check import cross_check
    from lavender.residuals import AT_FLOOR

    one_thread()
    out = console()
    if files and files[0].endswith(".jsonl"):
        refuse_unused(context, ["reference", "tol", "precision"], "with a records.jsonl, which has its own")
        submission = bench.verify(bench.read(files[0]), files[1:], solvers)
        out.print(str(submission), highlight=False, markup=False, soft_wrap=True)
        raise click.exceptions.Exit(0 if submission.ok else EXIT_UNMET)
    contradicted = unread = missing = answers = unmet = 0
    bench.solver_names([*(solvers or ()), reference])
    number("tol", tol, low=0.0)
    for item in bench.resolve(files):
        try:
            found = cross_check(item.problem, solvers=solvers, reference=reference, tol=tol)
            stored = item.judged(precision)
        except LavenderError as error:
            out.print(plain(f"{item.name}: {error}"), style="yellow", highlight=False)
            unread += isinstance(error, InputError) and not item.named
            missing += isinstance(error, InputError) and item.named
            continue
        finally:
            item.forget()
        out.print(f"[bold]{plain(item.name)}[/]", highlight=False)
        out.print(str(found), highlight=False, markup=False)
        if stored is not None:
            answers += 1
            unmet += stored.verdict != AT_FLOOR
            said = f"stored answer: {stored.verdict_in_words} of {stored.precision}; {stored}"
            out.print(said, highlight=False, markup=False)
        contradicted += len(found.contradicted)
    if contradicted:
        out.print(f"[bold red]{contradicted} claims are contradicted[/]")
    if precision is not None and not answers:
        raise InputError("--precision: no file holds an answer to judge (an entry `impulse`)")
    if missing:
        raise click.exceptions.Exit(EXIT_BAD_INPUT)
    if contradicted or unread or (precision is not None and unmet):
        raise click.exceptions.Exit(EXIT_UNMET)
