"""`lavender check`."""

from __future__ import annotations

from functools import partial

import click

from lavender.base.errors import InputError
from lavender.cli.options import (
    Listed,
    ManyValues,
    Reading,
    one_thread,
    precision_option,
    say,
    threshold_option,
    was_given,
)


@click.command(cls=ManyValues)
@click.argument("files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...")
@click.option("--solvers", type=Listed(str), help="Solvers by name; default: all that accept the problem.")
@click.option(
    "--reference", default="osqp", show_default=True, help="Solver whose answer the others are compared with."
)
@click.option("--tol", type=float, default=1e-6, show_default=True, help="Relative residual to reach.")
@click.option(
    "--time-limit", type=float, metavar="S", help="Limit of the time of each solver, as of `solve`."
)
@precision_option
@threshold_option
@click.pass_context
def check(
    context: click.Context,
    files: tuple[str, ...],
    solvers: tuple[str, ...] | None,
    reference: str,
    tol: float,
    time_limit: float | None,
    precision: str | None,
    threshold: float,
) -> None:
    """Compare solvers with a reference solver, and their claims with the judge.

    A solution stored in a file is judged too: is it at the floor of its precision, close enough (--threshold), or did
    its solver stop early?

    Exit code 1: a claim is contradicted; none of the solvers takes a problem; a file in a folder cannot be read; or,
    with --precision or --threshold, a stored solution is neither at its floor nor close enough.
    Exit code 2: a named file cannot be read, or these options find no stored solution.
    """
    from lavender.base.arrays import check_float
    from lavender.judge.residuals import AT_FLOOR, CLOSE
    from lavender.lab import bench
    from lavender.lab.check import cross_check
    from lavender.solving.solve import seconds_of

    one_thread()
    for name in files:
        if name.endswith(".jsonl"):
            raise InputError(
                f"{name}: problems are checked, not records; `lavender report {name}` shows them again"
            )
    contradicted = untaken = answers = above = unmet = 0
    reading = Reading(partial(say, style="yellow"))
    asked = precision is not None or was_given(context, "threshold")
    bench.solver_names([*(solvers or ()), reference])
    check_float("tol", tol, low=0.0)
    check_float("threshold", threshold, low=0.0)
    seconds_of(time_limit)
    for item in bench.resolve(files):
        with reading(item):
            found = cross_check(
                item.problem, solvers=solvers, reference=reference, tol=tol, time_limit=time_limit
            )
            stored = item.judged(precision, threshold)
            say(item.name, style="bold")
            say(str(found))
            if stored is not None:
                answers += 1
                above += stored.verdict != AT_FLOOR
                unmet += stored.verdict not in (AT_FLOOR, CLOSE)
                say(f"stored answer: {stored.verdict_in_words} of {stored.precision}; {stored}")
            contradicted += len(found.contradicted)
            untaken += len(found.refused) == len(found.rows)
    if contradicted:
        say(f"{contradicted} claims are contradicted", style="bold red")
    if untaken:
        say(f"{untaken} problems are taken by none of these solvers", style="bold red")
    if asked and not answers:
        raise InputError("--precision, --threshold: no file holds an answer to judge (an entry `impulse`)")
    if answers:
        shares = f"{above} of {answers} above their floor, {unmet} also more than {threshold:g} m/s off"
        say(f"stored answers: {shares}")
    reading.end(contradicted or untaken or (asked and unmet))
