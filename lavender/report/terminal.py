"""Print tables and reports on a terminal."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

from lavender.report.bench import statistics
from lavender.report.bench.record import escape_unprintable
from lavender.report.findings import Report
from lavender.report.table import COLOURS, Cell, Table
from lavender.report.table_specs import (
    NOT_COMPARED,
    build_short_table,
    list_cases_solved_at_zero,
    list_sections,
)
from lavender.report.text import format_count, format_residual, list_cases_not_loaded, list_diagnostics

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table as RichTable

MAX_LINES = 25  # Largest number of lines of a short report, including the lines that the command adds.
# Number of lines that the command adds: a blank line, page, reused runs, cases that did not load.
COMMAND_LINES = 5
MIN_HEAD_WIDTH = 8  # [columns] Heads do not fold at a smaller width.
MIN_WORD_WIDTH = 9  # [columns] A column of words does not become narrower: "CONVERGED".
MAX_NOTES = 20  # Largest number of notes of one kind in a complete report.


def print_table(console: Console, table: Table, grouped: bool = False, cut: bool = False) -> None:
    """Print a table within the width of the terminal. Its texts are not read as markup.

    In a table that is too wide, heads and words fold and numbers stay whole. If that is not enough, or if the table
    `folds`, each cell becomes a line below the first cell of its row. With `cut`, a row is one line and its first cell
    is shortened instead. `grouped` shows the first cell only if it differs from the row above, and separates such
    groups. Columns without any text are left out.
    """
    from rich.table import Table as RichTable
    from rich.text import Text

    empty = [
        head
        for i, head in enumerate(table.heads)
        if table.rows and not any(row[i] for row in table.cell_texts)
    ]
    table = table.without_columns(*empty)
    grid = RichTable(box=None, pad_edge=False, header_style="bold")
    for head in table.heads:
        grid.add_column(
            Text(head), justify="right" if table.is_numeric_column(head) else "left", no_wrap=not table.folds
        )
    grid.columns[0].no_wrap = not (table.folds or cut)
    above = ""
    for i, row in enumerate(table.rows):
        cells = [Text(str(c), style=COLOURS.get(c.mark, "") if isinstance(c, Cell) else "") for c in row]
        if cut:
            cells[0].no_wrap, cells[0].overflow = True, "ellipsis"
        first = str(row[0])
        if grouped and first == above:
            cells[0] = Text("")
        elif grouped and above:
            grid.add_section()
        grid.add_row(*cells, style=COLOURS.get(table.marks[i], "") if table.marks else "")
        above = first
    is_wide = console.measure(grid, options=console.options.update(width=100_000)).maximum > console.width
    if is_wide and not cut and (table.folds or _fold_words(grid, table) > console.width):
        _print_rows_as_lines(console, table)
        return
    console.print(grid, highlight=False)


def _fold_words(grid: RichTable, table: Table) -> int:
    """Let heads and columns of words fold, and return the smallest width at which numbers stay whole."""
    from rich.text import Text

    width = 2 * (len(table.heads) - 1)
    for i, (column, head) in enumerate(zip(grid.columns, table.heads, strict=True)):
        texts = [row[i] for row in table.cell_texts]
        if table.is_numeric_column(head):
            lines = textwrap.wrap(head, max(map(len, ["x" * MIN_HEAD_WIDTH, *texts, *head.split()])))
            smallest = max(map(len, [*texts, *lines]))
            column.header = Text("\n".join(lines))
        else:
            smallest = min(MIN_WORD_WIDTH, max(len(word) for text in (head, *texts) for word in text.split()))
            column.min_width, column.no_wrap, column.overflow = smallest, False, "fold"
        width += smallest
    return width


def _print_rows_as_lines(console: Console, table: Table) -> None:
    """Print each row as the line of its first cell, and a line for each other cell."""
    width = max(map(len, table.heads[1:]))
    for name, *texts in table.cell_texts:
        console.print(name, highlight=False, markup=False)
        for head, text in zip(table.heads[1:], texts, strict=True):
            console.print(f"  {head:<{width}}  {text}", highlight=False, markup=False)


def print_report(report: Report, console: Console, complete: bool = False) -> None:
    """Print the recommendation, a table to the middle tolerance, and notes.

    A short report has up to `MAX_LINES` lines, none wider than the terminal. `complete` prints every sentence, table
    and warning.
    """
    from rich.text import Text

    lines: list[Text] = []
    for i, statement in enumerate(report.verdict.statements):
        if complete or i == 0 or statement.requested or statement.one_line:
            cut = statement.one_line and not complete
            lines.append(
                Text(
                    statement.text,
                    style="" if i else "bold",
                    no_wrap=cut,
                    overflow="ellipsis" if cut else None,
                )
            )
            hint = "  # all lines: --tables" if len(statement.code) > 1 else ""
            code = statement.code if complete else (statement.call_line + hint,) * bool(statement.call_line)
            lines += [Text(f"    {line}") for line in code]
    warnings = (report.stopped_warning, report.busy_warning or report.load_warning)
    lines += [Text(warning, style="yellow") for warning in warnings if warning]
    notes = [
        Text.assemble((text, style)) for text, style in _list_notes(report, MAX_NOTES if complete else 1)
    ]
    for text in lines:
        console.print(text, highlight=False, no_wrap=text.no_wrap, overflow=text.overflow)
    if complete:
        for section in list_sections(report):
            note = f" ({section.note})" if section.table.rows else f": {section.empty}"
            console.print(Text.assemble("\n", (section.title, "bold"), note))
            if section.table.rows:
                print_table(console, section.table, grouped=section.grouped)
    else:
        used = sum(len(text.wrap(console, console.width)) for text in lines)
        print_first_rows(console, build_short_table(report), MAX_LINES - COMMAND_LINES - used - len(notes))
    for text in notes:
        console.print(
            text, highlight=False, no_wrap=not complete, overflow="fold" if complete else "ellipsis"
        )


def print_first_rows(console: Console, table: Table, height: int) -> None:
    """Print a blank line, as many rows as fit into `height` lines, and the number of rows left out."""
    if not table.rows:
        return
    rows = table.rows if len(table.rows) <= height - 2 else table.rows[: max(1, height - 3)]
    console.print()
    print_table(console, replace(table, rows=rows), cut=True)
    if len(rows) < len(table.rows):
        console.print(f"{len(table.rows) - len(rows)} more: --tables", highlight=False, style="dim")


def _list_notes(report: Report, most: int) -> Iterator[tuple[str, str]]:
    """Yield (note, style): at most `most` notes of each kind; if there are more, a line has their number."""
    records = report.ranked_records
    false_claims = [
        f"{r.case}, {r.solver}: {r.status_conflict}"
        for r in statistics.list_failures(records)
        if r.status_conflict
    ]
    kinds = {
        "false claim": ("red", false_claims),
        "suspicious": ("yellow", [f"{case}: {reason}" for case, reason in list_diagnostics(records)]),
        "same answer without an iteration": (
            "yellow",
            [f"{d.case}: {', '.join(d.same)}" for d in statistics.compute_difficulties(records) if d.same],
        ),
        "left out": ("yellow", [f"{what}: {reason}" for what, reason in list_cases_not_loaded(records)]),
    }
    for kind, (style, texts) in kinds.items():
        for i, text in enumerate(texts[:most], 1):
            place = f" ({i} of {len(texts)})" if most > 1 else f", the first of {len(texts)}"
            yield f"{kind}{place if len(texts) > 1 else ''}: {text}", style
    skipped = [s.reason.partition(":")[0] for s in records.skips if s.solver]
    replacements = Counter(pair for pair in skipped if " → " in pair)
    for pair, n in replacements.items():
        cases = format_count(n, "case")
        yield f"{pair} on {cases} with bounds: the same method; the first accepts only free rows", ""
    refused = len(skipped) - replacements.total()
    if refused:
        pairs = format_count(refused, "pair")
        yield f"{pairs} of case and solver not run, or not to the end: the page says why", "dim"
    if report.earlier_run is not None:
        changes = statistics.compare_times(report.earlier_run, records)
        by_kind = Counter(c.kind for c in changes if c.kind != "same")
        text = ", ".join(f"{n} {kind}" for kind, n in sorted(by_kind.items()))
        text = text or ("nothing beyond noise" if changes else NOT_COMPARED)
        yield f"Against {escape_unprintable(report.earlier_run.source)}: {text}", ""
    idle = list_cases_solved_at_zero(report.newest_run)
    if idle:
        case, _, solver, velocity, _ = max(idle, key=lambda entry: entry[3])
        cases, speed = format_count(len(idle), "case"), format_residual(velocity)
        yield (
            f"{cases} solved by the zero impulse; largest error {speed} m/s, by {solver or 'no solver'} on {case}",
            "dim",
        )
