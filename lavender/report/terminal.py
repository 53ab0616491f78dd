"""What a terminal shows of a report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from lavender.bench.record import printable
from lavender.bench.store import Records
from lavender.report import contents, tables
from lavender.report.findings import Report
from lavender.report.moved import idle
from lavender.report.table import print_table
from lavender.report.text import count, residual, suspicions

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["print_report"]

BY_MOTION = "\n[bold]By motion error[/] (how wrong the body moves that is furthest off)"
SHORT = 20  # lines: a report that has no more is printed whole


def print_report(report: Report, console: Console, whole: bool = False) -> None:
    """What the terminal shows after a run: the recommendation first; every case and sequence where `whole`.

    A report of few lines is shown whole anyhow.
    """
    records, still = report.records, idle(report.every)
    if report.is_campaign:
        console.print(
            "[bold]Campaign[/] (no times; share of cases brought to a level, residual at each budget)"
        )
        by_residual = contents.robustness_table(tables.robustness(records), report.levels)
        print_table(console, by_residual, grouped=True)
        if by_speed := tables.robustness(report.by_speed):
            console.print(BY_MOTION, highlight=False)
            by_motion = contents.robustness_table(by_speed, report.speeds, " m/s")
            print_table(console, by_motion, grouped=True)
    elif len(records):
        console.print(report.verdict.text, style="bold", highlight=False, markup=False)
        for line in report.verdict.code:
            console.print(f"    {line}", highlight=False, markup=False, soft_wrap=True)
        console.print(
            "\n[bold]By structure[/] (to a level: mean time, share of cases that get there, budget; in a time or with "
            "sweeps: share of cases served, residual at the 90th percentile; ≈ as good within noise)",
            highlight=False,
        )
        print_table(console, contents.advice_table(report))
        swept = contents.sweeps_table(report.lines)
        if swept.rows:
            console.print("\n[bold]By sweeps[/]", highlight=False)
            print_table(console, swept)
        if report.speeds:
            _print_motion(report, console, whole)
    for case in still[:SHORT]:
        console.print(
            f"nothing to do: {case.case}; at worst {residual(case.velocity)} m/s by {case.solver or 'nobody'}",
            highlight=False,
            markup=False,
            style="dim",
        )
    if len(still) > SHORT:
        console.print(f"and {len(still) - SHORT} more with nothing to do", highlight=False, style="dim")
    _print_lost(records, console)
    _print_suspicions(records, console)
    if not report.is_campaign:
        _print_tables(records, console, report.levels, whole)
    if report.before is not None:
        changed = contents.change_table(report.before, records)
        said = (
            f"\nAgainst {printable(report.before.source)}{'' if changed.rows else ': nothing beyond noise'}"
        )
        console.print(said, highlight=False, markup=False, style="bold")
        if changed.rows:
            print_table(console, changed)
    wrong = [r for r in tables.failures(records) if r.contradicted]
    if wrong:
        console.print(f"\n[bold red]{len(wrong)} claims are contradicted by the judge:[/]")
        for r in wrong[:SHORT]:
            console.print(f"  {r.case}, {r.solver}: {r.contradicted}", highlight=False, markup=False)
        if len(wrong) > SHORT:
            console.print(f"  and {len(wrong) - SHORT} more", highlight=False)


def _print_motion(report: Report, console: Console, whole: bool) -> None:
    """Who gets to each motion error, by structure; each case where that is asked for or few."""
    console.print(BY_MOTION, highlight=False)
    print_table(console, contents.speed_table(report))
    moved = contents.moved_table(report)
    if whole or len(moved.rows) <= SHORT:
        console.print()
        print_table(console, moved, grouped=True)


def _print_lost(records: Records, console: Console) -> None:
    for skip in records.skips:
        if not skip.solver:
            console.print("[yellow]not run:[/]", end=" ")
            console.print(f"{skip.case}: {skip.reason}", highlight=False, markup=False)
    refused = [s for s in records.skips if s.solver]
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


def _print_tables(records: Records, console: Console, levels: Sequence[float], whole: bool) -> None:
    lines = len(tables.reaches(records, levels)) + len(tables.passes(records))
    if not whole and lines > SHORT:
        console.print(
            f"{count(lines, 'line')} of single cases and sequences: --tables prints them",
            highlight=False,
            style="dim",
        )
        return
    if any(r.step < 0 for r in records):
        console.print()
        reached = contents.reach_table(tables.reaches(records, levels), levels)
        print_table(console, reached.without("form"), grouped=True)
        console.print("floor: rounding to float64 allows no better", style="dim", highlight=False)
    if any(r.step >= 0 for r in records):
        console.print(
            "\n[bold]Sequences[/] (median residual, time of all steps; carried from step to step, or cold)"
        )
        print_table(console, contents.pass_table(tables.passes(records)), grouped=True)
