"""Define `lavender check`."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import click

from lavender.base.errors import REPORT_PACKAGES, InputError, require_packages
from lavender.cli.completion import complete_case_or_file, complete_solver
from lavender.cli.options import (
    ErrorReporter,
    ListCommand,
    ListType,
    is_option_set,
    limit_to_one_thread,
    make_console,
    precision_option,
    print_escaped,
    threshold_option,
)
from lavender.io.stored import format_json

if TYPE_CHECKING:
    from lavender.report.cases import Item
    from lavender.report.check import CrossCheck


# Columns that a narrow terminal leaves out, in this order.
NARROW_CHECK_OMITS = (
    "objective [J]",
    "allowed [√J]",
    "floor [-]",
    "distance [√J]",
    "what ran",
    "time [s]",
    "relative [-]",
)


@click.command(cls=ListCommand)
@click.argument(
    "files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...", shell_complete=complete_case_or_file
)
@click.option(
    "--solvers",
    type=ListType(str),
    shell_complete=complete_solver,
    help="Solvers by name; default: all that accept the problem.",
)
@click.option(
    "--reference",
    default="osqp",
    show_default=True,
    shell_complete=complete_solver,
    help="Reference solver, with which the others are compared.",
)
@click.option(
    "--tol", type=float, default=1e-6, show_default=True, help="Relative residual to reach."
)
@click.option("--time-limit", type=float, metavar="S", help="Time limit of each solve.")
@precision_option
@threshold_option
@click.option(
    "--json",
    "as_json",
    is_flag=True,
    help="Print the comparisons as JSON, one entry for each problem.",
)
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
    as_json: bool,
) -> None:
    """Compare solvers with a reference solver and with the judge.

    The judge checks the claim of each solver. For a case of the suite whose exact solution is known, the distance of
    each answer from it is printed. A solution stored in a file is judged, too: it is at the floor of its precision,
    close enough (--threshold), or its solver stopped early.

    Each solver stops at its default number of iterations (pgs: 1000 sweeps), with the status MAX_ITERATIONS. In a
    report, solvers that can stop after any iteration run until --time-limit instead.

    Exit code 1: a claim is contradicted; a solver named by --solvers accepts a problem but does not solve it; without
    this option, no solver solves a problem; none of the solvers accepts a problem; a file in a folder cannot be read;
    or, with --precision or --threshold, a stored solution is neither at its floor nor close enough.
    Exit code 2: a named file cannot be read, or no file has a stored solution for these options.
    """
    require_packages("lavender check", *REPORT_PACKAGES)
    from lavender import report
    from lavender.base.arrays import check_float
    from lavender.judge.residuals import AT_FLOOR, CLOSE
    from lavender.report.check import cross_check
    from lavender.report.render import print_table
    from lavender.report.text import format_count, format_residual, format_tolerance
    from lavender.solving.limits import check_time_limit

    limit_to_one_thread()
    show = partial(print_escaped, err=as_json)  # With --json, only the JSON is on stdout.
    entries: list[dict[str, Any]] = []
    for name in files:
        if name.endswith(".jsonl"):
            raise InputError(
                f"{name} holds records; only problems can be checked. `lavender report {name}` shows them again"
            )
    contradicted = unsolved = unaccepted = solutions = above = unmet = 0
    errors = ErrorReporter(partial(show, style="yellow"))
    reason = ""
    judges_stored = precision is not None or is_option_set(context, "threshold")
    report.select_solver_names([*(solvers or ()), reference])
    check_float("tol", tol, low=0.0)
    check_float("threshold", threshold, low=0.0)
    check_time_limit(time_limit)
    for item in report.resolve_sources(files):
        with errors(item):
            comparison = cross_check(
                item.problem, solvers, reference, tol=tol, time_limit=time_limit
            )
            stored = item.judge_stored_answer(precision, threshold)
            if (
                item.name != item.problem.name
            ):  # The description begins with the problem's own name.
                show(item.name, style="bold")
            show(comparison.description, style="bold" if item.name == item.problem.name else "")
            if comparison.reference is None and comparison.reference_note != reason:
                reason = comparison.reference_note  # Problems that follow usually have the same.
                show(f"no reference: {reason}")
            print_table(make_console(stderr=as_json), comparison.frame, optional=NARROW_CHECK_OMITS)
            if (exact := _describe_distances(item, comparison)) is not None:
                show(exact)
            entries.append(
                {
                    "case": item.name,
                    "rows": item.problem.m,
                    "law": item.problem.law,
                    "reference": comparison.reference,
                    "solvers": comparison.frame.to_dict("records"),
                    "stored_verdict": None if stored is None else stored.verdict,
                    "stored_velocity_error": None if stored is None else stored.velocity,
                }
            )
            if stored is not None:
                solutions += 1
                above += stored.verdict != AT_FLOOR
                unmet += stored.verdict not in (AT_FLOOR, CLOSE)
                show(f"stored solution ({stored.precision}): {stored.verdict_in_words}")
                error = f"{format_residual(stored.velocity)} {stored.velocity_unit}"
                show(f"    worst row {stored.worst_name or 'none'}: {error}")
            contradicted += len(comparison.contradicted)
            unaccepted += len(comparison.refused) == len(comparison.rows)
            if solvers or len(comparison.unsolved) + len(comparison.refused) == len(
                comparison.rows
            ):
                unsolved += len(comparison.unsolved)
    if contradicted:
        show(f"{contradicted} claims are contradicted", style="bold red")
    if unsolved:
        show(f"{unsolved} of the solves did not solve their problem", style="bold red")
    if unaccepted:
        show(
            f"{format_count(unaccepted, 'problem')} not accepted by any of these solvers",
            style="bold red",
        )
    if judges_stored and not solutions:
        raise InputError(
            "--precision and --threshold apply to stored solutions, and no file has one (entry `impulse`): "
            "leave them out, or give files with solutions"
        )
    if solutions:
        shares = f"{above} of {solutions} above their floor, {unmet} also more than"
        show(f"stored solutions: {shares} {format_tolerance(threshold)} m/s off")
    if as_json:
        click.echo(format_json(entries, indent=1))
    errors.exit(contradicted or unsolved or unaccepted or (judges_stored and unmet))


def _describe_distances(item: Item, comparison: CrossCheck) -> str | None:
    """Describe the distance of each answer from the exact solution of a case; None if no solution is known."""
    import numpy as np

    from lavender import suite
    from lavender.report.cases import is_path
    from lavender.report.text import format_residual

    if item.in_memory is not None or is_path(item.source):
        return None
    reference = suite.case(item.source).reference
    if reference is None or reference.impulse is None or reference.compare == "error":
        return None
    unique = reference.compare == "impulse"
    exact = reference.impulse if unique else item.problem.slack(reference.impulse)
    distances = []
    for row in comparison:
        if row.solution is not None:
            found = row.solution.impulse if unique else row.solution.slack
            distances.append(f"{row.solver} {format_residual(np.abs(found - exact).max())}")
    quantity = "impulses [N s]" if unique else "slacks [m/s]"
    return f"distance of the {quantity} from the exact solution ({reference.source}): {', '.join(distances)}"
