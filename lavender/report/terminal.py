"""Print tables and reports on a terminal."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from lavender.report.table import Table

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table as RichTable

    from lavender.report.findings import Report

MAX_LINES = 25  # Largest number of lines of a short report, including the lines that the command adds.
# Number of lines that the command adds: a blank line, page, reused runs, cases that did not load.
COMMAND_LINES = 5
MIN_HEAD_WIDTH = 8  # [columns] Heads do not fold at a smaller width.
MIN_WORD_WIDTH = 9  # [columns] A column of words does not become narrower: "CONVERGED".
MAX_NOTES = 20  # Largest number of notes of one kind in a complete report.


def print_table(
    console: Console, table: Table, grouped: bool = False, cut: bool = False, optional: Sequence[str] = ()
) -> None:
    """Print a table within the width of the terminal. Its texts are not read as markup.

    In a table that is too wide, heads and words fold and numbers stay whole. If that is not enough, each cell becomes
    a line below the first cell of its row; with `cut`, the last columns are left out instead. Before that, the columns
    with the heads `optional` are left out one by one; then the words of the first column stay whole, too. `grouped`
    shows the first cell only if it differs from the row above, and separates such groups. Columns without any text are
    left out.
    """
    texts = table.cell_texts
    empty = [head for i, head in enumerate(table.heads) if texts and not any(row[i] for row in texts)]
    table = table.without_columns(*empty)
    left_out = [head for head in optional if head in table.heads]
    while True:
        grid = _make_grid(table, grouped)
        width = console.measure(grid, options=console.options.update(width=100_000)).maximum
        if width <= console.width or _fold_words(grid, table, bool(optional)) <= console.width:
            break
        if left_out:
            table = table.without_columns(left_out.pop(0))
        elif cut and len(table.heads) > 2:
            table = table.without_columns(table.heads[-1])
        else:
            _print_rows_as_lines(console, table)
            return
    console.print(grid, highlight=False)


def _make_grid(table: Table, grouped: bool) -> RichTable:
    """Make rich's table, in which no text folds."""
    from rich.table import Table as RichTable
    from rich.text import Text

    grid = RichTable(box=None, pad_edge=False, header_style="bold")
    for head in table.heads:
        grid.add_column(
            Text(head), justify="right" if table.is_numeric_column(head) else "left", no_wrap=True
        )
    above = ""
    for row in table.cell_texts:
        cells = [Text(text) for text in row]
        if grouped and row[0] == above:
            cells[0] = Text("")
        elif grouped and above:
            grid.add_section()
        grid.add_row(*cells, style="red" if any("✗" in text for text in row) else "")
        above = row[0]
    return grid


def _fold_words(grid: RichTable, table: Table, whole_first: bool = False) -> int:
    """Let heads and columns of words fold, and return the smallest width at which numbers stay whole.

    With `whole_first` the words of the first column stay whole, too.
    """
    from rich.text import Text

    width = 2 * (len(table.heads) - 1)
    for i, (column, head) in enumerate(zip(grid.columns, table.heads, strict=True)):
        texts = [row[i] for row in table.cell_texts]
        if table.is_numeric_column(head):
            lines = textwrap.wrap(head, max(map(len, ["x" * MIN_HEAD_WIDTH, *texts, *head.split()])))
            smallest = max(map(len, [*texts, *lines]))
            column.header = Text("\n".join(lines))
        else:
            words = [word for text in (head, *texts) for word in text.split()]
            smallest = max(map(len, words), default=1)
            if whole_first and not i:
                column.width = smallest  # Rich narrows other columns only, so that none exceeds the terminal.
            smallest = column.width or min(MIN_WORD_WIDTH, smallest)
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
    for i, statement in enumerate(report.statements):
        lines.append(Text(statement.text, style="" if i else "bold"))
        is_cut = len(statement.code) > 1 and not complete
        code = [statement.call_line, "# all lines: --tables"] if is_cut else statement.code
        lines += [Text(f"    {line}") for line in code]
    if report.busy_warning:
        lines.append(Text(report.busy_warning, style="yellow"))
    for text in lines:
        console.print(text, highlight=False)
    notes = [Text(text, style=style) for text, style in _list_notes(report, MAX_NOTES if complete else 1)]
    if complete:
        for section in report.sections.values():
            note = f": {section.note}" if section.note else ""
            console.print(Text.assemble("\n", (section.title, "bold"), note))
            print_table(console, section.table, grouped=section.file in ("runs", "sequences", "times"))
    else:
        used = sum(len(text.wrap(console, console.width)) for text in lines)
        print_first_rows(console, report.overview.table, MAX_LINES - COMMAND_LINES - used - len(notes))
    for text in notes:
        console.print(
            text, highlight=False, no_wrap=not complete, overflow="fold" if complete else "ellipsis"
        )


def print_first_rows(console: Console, table: Table, height: int) -> None:
    """Print a blank line, as many rows as fit into `height` lines, and the number of rows left out."""
    n = len(table.rows)
    if n:
        shown = n if n <= height - 2 else max(1, height - 3)
        console.print()
        print_table(console, table.with_rows(shown), cut=True)
        if shown < n:
            console.print(f"{n - shown} more: --tables", highlight=False, style="dim")


def _list_notes(report: Report, longest: int) -> Iterator[tuple[str, str]]:
    """Yield (note, style): at most `longest` notes of each kind; if there are more, a note has their number."""
    from lavender.report.tables import select_failures
    from lavender.report.text import format_count, format_residual, list_cases_not_loaded, list_diagnostics

    records = report.records
    failures = select_failures(report) if len(report.frame) else report.frame
    false = failures[failures["status_conflict"].astype(str) != ""]
    kinds = {
        "false claim": (
            "red",
            [
                f"{c}, {s}: {x}"
                for c, s, x in zip(false["case"], false["solver"], false["status_conflict"], strict=True)
            ],
        ),
        "suspicious": ("yellow", [f"{case}: {reason}" for case, reason in list_diagnostics(records)]),
        "left out": ("yellow", [f"{cases}: {reason}" for cases, reason in list_cases_not_loaded(records)]),
    }
    for kind, (style, texts) in kinds.items():
        for i, text in enumerate(texts[:longest], 1):
            place = f" ({i} of {len(texts)})" if longest > 1 else f", the first of {len(texts)}"
            yield f"{kind}{place if len(texts) > 1 else ''}: {text}", style
    skipped = [s.reason.partition(":")[0] for s in records.skips if s.solver]
    replacements = Counter(pair for pair in skipped if " → " in pair)
    for pair, n in replacements.items():
        cases = format_count(n, "case")
        yield f"{pair} on {cases} with bounds: the same method; the first accepts only free rows", ""
    refused = len(skipped) - replacements.total()
    if refused:
        pairs = format_count(refused, "pair")
        yield f"{pairs} of case and solver not run, or not to the end: the page has the reasons", "dim"
    if "changes" in report.sections:
        section = report.sections["changes"]
        counts = sorted(Counter(section.frame["change"].astype(str)).items())
        text = ", ".join(f"{n} {kind}" if "target" in section.frame else kind for kind, n in counts)
        yield f"{section.title}: {text} ({section.note})", ""
    if "idle" in report.sections:
        frame = report.sections["idle"].frame
        case, _, solver, velocity, _ = frame.iloc[-1]
        cases, speed = format_count(len(frame), "case"), format_residual(velocity)
        yield f"{cases} solved by the zero impulse; largest error {speed} m/s, by {solver} on {case}", "dim"
