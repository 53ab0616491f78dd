"""What a terminal shows of a report."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from lavender.bench.store import Records
from lavender.report import tables
from lavender.report.contents import sections
from lavender.report.findings import Report
from lavender.report.moved import idle
from lavender.report.table import print_table
from lavender.report.text import count, left_out, residual, suspicions

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["print_report"]

SHORT = 20  # lines: a report that has no more is printed whole


def print_report(report: Report, console: Console, whole: bool = False) -> None:
    """What the terminal shows after a run: the recommendation first; every case and sequence where `whole`.

    A report of few lines is shown whole anyhow.
    """
    if len(report.records) and not report.is_campaign:
        console.print(report.verdict.text, style="bold", highlight=False, markup=False)
        for line in report.verdict.code:
            console.print(f"    {line}", highlight=False, markup=False, soft_wrap=True)
    from rich.text import Text

    found = sections(report)
    lines = sum(len(s.table.rows) for s in found if s.details)
    for section in found:
        if section.details and not whole and lines > SHORT:
            continue
        said = f" ({section.note})" if section.table.rows else f": {section.empty}"
        console.print(Text.assemble("\n", (section.title, "bold"), said))
        if section.table.rows:
            print_table(console, section.table, grouped=section.grouped)
    if not whole and lines > SHORT:
        text = f"{count(lines, 'line')} of single cases and sequences: --tables prints them"
        console.print(text, highlight=False, style="dim")
    _print_idle(report, console)
    _print_lost(report.records, console)
    _print_suspicions(report.records, console)
    _print_contradicted(report.records, console)


def _print_idle(report: Report, console: Console) -> None:
    still = idle(report.every)
    if still:
        worst = max(still, key=lambda case: case.velocity)
        said = f"{count(len(still), 'case')} with nothing to do; at worst {residual(worst.velocity)} m/s, by "
        said += f"{worst.solver or 'nobody'} on {worst.case}"
        console.print(said, highlight=False, markup=False, style="dim")


def _print_lost(records: Records, console: Console) -> None:
    lost = left_out(records)
    for what, reason in lost[:SHORT]:
        console.print("[yellow]left out:[/]", end=" ")
        console.print(f"{what}: {reason}", highlight=False, markup=False)
    if len(lost) > SHORT:
        console.print(f"and {len(lost) - SHORT} more, on the page", highlight=False, style="dim")
    pairs = [(s.reason.partition(":")[0], s) for s in records.skips if s.solver]
    for pair, n in Counter(pair for pair, _ in pairs if " → " in pair).items():
        said = f"{pair} on {count(n, 'case')} with bounds: the same method; the first takes free rows alone"
        console.print(said, highlight=False, markup=False)
    refused = [s for pair, s in pairs if " → " not in pair]
    if refused:
        console.print(
            f"{count(len(refused), 'pair')} of case and solver not run, or not to the end: the page says why",
            highlight=False,
            markup=False,
            style="dim",
        )


def _print_suspicions(records: Records, console: Console) -> None:
    found = suspicions(records)
    for case, told in found[:SHORT]:
        console.print("[yellow]suspicious:[/]", end=" ")
        console.print(f"{case}: {told}", highlight=False, markup=False)
    if len(found) > SHORT:
        console.print(f"and {len(found) - SHORT} more, on the page", highlight=False, style="dim")


def _print_contradicted(records: Records, console: Console) -> None:
    wrong = [r for r in tables.failures(records) if r.contradicted]
    if wrong:
        console.print(f"\n[bold red]{len(wrong)} claims are contradicted by the judge:[/]")
        for r in wrong[:SHORT]:
            console.print(f"  {r.case}, {r.solver}: {r.contradicted}", highlight=False, markup=False)
        if len(wrong) > SHORT:
            console.print(f"  and {len(wrong) - SHORT} more", highlight=False)
