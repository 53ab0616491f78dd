"""Define `lavender judge`."""

from __future__ import annotations

from pathlib import Path

import click

from lavender.base.errors import InputError
from lavender.base.exits import EXIT_UNMET
from lavender.cli.completion import complete_case_or_file
from lavender.cli.options import (
    PATH,
    limit_to_one_thread,
    make_console,
    precision_option,
    print_escaped,
    threshold_option,
)
from lavender.io.stored import check_writable, format_json, write_text

# Columns that a narrow terminal leaves out, in this order.
NARROW_JUDGE_OMITS = ("unique", "gap [mm]", "bodies")


@click.command()
@click.argument("file", shell_complete=complete_case_or_file)
@precision_option
@threshold_option
@click.option(
    "--rows",
    type=click.IntRange(min=1),
    default=20,
    show_default=True,
    help="Rows that are printed.",
)
@click.option("--csv", "output", type=PATH, help="Write the table of all rows to this file.")
@click.option("--json", "as_json", is_flag=True, help="Print the verdict and all rows as JSON.")
def judge(
    file: str,
    precision: str | None,
    threshold: float,
    rows: int,
    output: Path | None,
    as_json: bool,
) -> None:
    """Judge the answer that is stored in a file, row by row.

    FILE is a problem with an impulse: of `lav_dump_named` or `lav_dump_answer` of the C library, of
    `lavender.io.save(problem, path, impulse=..., gap=...)`, or a step of a recording or an audit. The table has the
    rows with the largest errors: their bodies, the gap if the file has it, the stored impulse, an exact impulse (of
    `auto`, to a relative residual of 1e-10), whether all solutions share it, the error in m/s or rad/s, and the state
    of the row.

    Exit code 0: the answer is at its floor or close enough (--threshold). 1: its solver stopped early, or it is wrong.
    Exit code 2: the file has no answer, or is a quadratic program.
    """
    from lavender import io, report
    from lavender.base.arrays import check_float
    from lavender.judge.residuals import AT_FLOOR, CLOSE
    from lavender.report.render import print_table
    from lavender.report.rows import tabulate_rows
    from lavender.report.text import format_count
    from lavender.solving.solve import solve

    limit_to_one_thread()
    check_float("threshold", threshold, low=0.0)
    if output is not None:
        check_writable(output)
    (item, *more) = report.resolve_sources([file])
    if more:
        raise InputError(f"{file} holds {len(more) + 1} problems; give one file")
    problem, impulse = item.problem, item.load_stored()
    judged = item.judge_stored_answer(precision, threshold)
    if judged is None or impulse is None:
        raise InputError(
            f"{file} has no answer of {problem.m} impulses (entry 'impulse'), or is a quadratic program: store one "
            "with lavender.io.save(problem, path, impulse=...), or compare solvers with `lavender check`"
        )
    solution = solve(problem, impulse=impulse, tol=1e-10)
    is_solved = solution.residual.relative <= 1e-8 or solution.residual.at_floor
    gap = io.read(item.source).gap if item.source.endswith(".npz") else None
    table = tabulate_rows(problem, impulse, judged, solution if is_solved else None, gap)
    if output is not None:
        write_text(output, table.to_csv(index=False))
    if as_json:
        facts = {
            "case": item.name,
            "verdict": judged.verdict,
            "relative": judged.relative,
            "energy": judged.energy,
            "velocity": judged.velocity,
            "unit": judged.velocity_unit,
            "worst_row": judged.worst_label,
            "roundoff_floor": judged.roundoff_floor,
            "rows": table.to_dict("records"),
        }
        click.echo(format_json(facts, indent=1))
    else:
        print_escaped(f"{item.name}: {judged.verdict_in_words}", style="bold")
        print_escaped(str(judged))
        if not is_solved:
            print_escaped(f"no exact impulse: {solution}")
        shown = table.head(rows).drop(columns="error [m/s, rad/s]")
        print_table(
            make_console(),
            shown.replace({"unique": {True: "yes", False: "no"}}),
            NARROW_JUDGE_OMITS,
        )
        if len(table) > rows:
            left = f"{len(table) - rows} of {format_count(len(table), 'row')}"
            print_escaped(f"{left} have smaller errors (--rows, --csv)")
        if not table["unique"].all():
            print_escaped(
                "not unique: another solution has another impulse there, and the same motion"
            )
    if judged.verdict not in (AT_FLOOR, CLOSE):
        raise click.exceptions.Exit(EXIT_UNMET)
