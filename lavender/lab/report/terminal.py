"""What a terminal shows of a report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

from lavender.lab.bench.record import printable
from lavender.lab.report import tables
from lavender.lab.report.contents import NOT_COMPARED, sections, short_table
from lavender.lab.report.findings import Report
from lavender.lab.report.moved import idle
from lavender.lab.report.table import Table, print_table
from lavender.lab.report.text import count, left_out, residual, suspicions

if TYPE_CHECKING:
    from rich.console import Console

LINES = 25  # of a report in short, with those that a command adds
ADDED = 5  # of them: a blank one, where the page is, what was reused, what a paper has, what did not load
MOST = 20  # notes of a kind, where all is printed


def print_report(report: Report, console: Console, whole: bool = False) -> None:
    """What the terminal shows after a run: the recommendation, a table to the middle level, and what to know besides.

    In short no more than `LINES` lines, none wider than the terminal; `whole` prints every sentence, table and warning.
    """
    from rich.text import Text

    said: list[Text] = []
    for i, told in enumerate(report.verdict.told):
        if whole or i == 0 or told.asked:
            said.append(Text(told.text, style="" if i else "bold"))
            around = "  # the lines around it: --tables" if len(told.code) > 1 else ""
            in_c = (f"# in C: {told.in_c}",) * bool(told.in_c)
            code = (*told.code, *in_c) if whole else (told.line + around,) * bool(told.line)
            said += [Text(f"    {line}") for line in code]
    said += [Text(warning, style="yellow") for warning in (report.stopped, report.busy) if warning]
    notes = [Text.assemble((text, style)) for text, style in _notes(report, MOST if whole else 1)]
    for text in said:
        console.print(text, highlight=False)
    if whole:
        for section in sections(report):
            note = f" ({section.note})" if section.table.rows else f": {section.empty}"
            console.print(Text.assemble("\n", (section.title, "bold"), note))
            if section.table.rows:
                print_table(console, section.table, grouped=section.grouped)
    else:
        used = sum(len(text.wrap(console, console.width)) for text in said)
        _print_short(short_table(report), console, LINES - ADDED - used - len(notes))
    for text in notes:
        console.print(text, highlight=False, no_wrap=not whole, overflow="fold" if whole else "ellipsis")


def _print_short(table: Table, console: Console, room: int) -> None:
    """As many rows as there is room for, and how many more there are."""
    if not table.rows:
        return
    rows = table.rows if len(table.rows) <= room - 2 else table.rows[: max(1, room - 3)]
    console.print()
    print_table(console, replace(table, rows=rows), cut=True)
    if len(rows) < len(table.rows):
        console.print(f"{len(table.rows) - len(rows)} more: --tables", highlight=False, style="dim")


def _notes(report: Report, most: int) -> Iterator[tuple[str, str]]:
    """What to know besides, each with a style; of each kind so many, and how many there are."""
    records = report.records
    wrong = [
        f"{r.case}, {r.solver}: {r.status_conflict}" for r in tables.failures(records) if r.status_conflict
    ]
    kinds = {
        "false claim": ("red", wrong),
        "suspicious": ("yellow", [f"{case}: {told}" for case, told in suspicions(records)]),
        "same answer without an iteration": (
            "yellow",
            [f"{d.case}: {', '.join(d.same)}" for d in tables.difficulties(records) if d.same],
        ),
        "left out": ("yellow", [f"{what}: {reason}" for what, reason in left_out(records)]),
    }
    for kind, (style, texts) in kinds.items():
        for i, text in enumerate(texts[:most], 1):
            place = f" ({i} of {len(texts)})" if most > 1 else f", the first of {len(texts)}"
            yield f"{kind}{place if len(texts) > 1 else ''}: {text}", style
    pairs = [s.reason.partition(":")[0] for s in records.skips if s.solver]
    stand_ins = Counter(pair for pair in pairs if " → " in pair)
    for pair, n in stand_ins.items():
        yield (
            f"{pair} on {count(n, 'case')} with bounds: the same method; the first takes free rows alone",
            "",
        )
    refused = len(pairs) - stand_ins.total()
    if refused:
        yield (
            f"{count(refused, 'pair')} of case and solver not run, or not to the end: the page says why",
            "dim",
        )
    if report.before is not None:
        found = tables.changes(report.before, records)
        kinds_of = Counter(c.kind for c in found if c.kind != "same")
        told = ", ".join(f"{n} {kind}" for kind, n in sorted(kinds_of.items()))
        told = told or ("nothing beyond noise" if found else NOT_COMPARED)
        yield f"Against {printable(report.before.source)}: {told}", ""
    still = idle(report.every)
    if still:
        worst = max(still, key=lambda case: case.velocity)
        said = f"{count(len(still), 'case')} with nothing to do; at worst {residual(worst.velocity)} m/s, by "
        yield said + f"{worst.solver or 'nobody'} on {worst.case}", "dim"
