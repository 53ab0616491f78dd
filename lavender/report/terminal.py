"""Tables for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from lavender.bench.record import level_name, printable
from lavender.bench.store import Records
from lavender.report import tables
from lavender.report.moved import idle, robustness_by_speed, speed_levels, working
from lavender.report.text import (
    advice_rows,
    count,
    moved_rows,
    residual,
    seconds,
    speed_rows,
    suspicions,
    sweeps_rows,
    who,
)
from lavender.report.verdict import verdict

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["print_report"]

GOOD = ("CONVERGED", "FLOOR")


class _Plain:
    """A table of rich whose cells are taken as they are: names of files and messages hold no markup of ours."""

    def __init__(self, table: Any) -> None:
        self.table = table
        self.add_column, self.add_section = table.add_column, table.add_section

    def add_row(self, *cells: Any, style: str = "") -> None:
        from rich.text import Text

        self.table.add_row(*(Text(c) if isinstance(c, str) else c for c in cells), style=style)

    def __rich__(self) -> Any:
        return self.table


def _width(console: Console, table: Any) -> int:
    """Characters that a table takes where there is room."""
    return console.measure(table, options=console.options.update(width=100_000)).maximum


def _show(console: Console, table: Any) -> None:
    """A table within the terminal: where it is wider, its cells fold; nothing is cut."""
    inner = table.__rich__()
    if _width(console, inner) > console.width:
        for column in inner.columns:
            column.no_wrap, column.overflow = False, "fold"
    console.print(inner, highlight=False)


def _table() -> _Plain:
    from rich.table import Table

    return _Plain(Table(box=None, pad_edge=False, header_style="bold"))


def reach_table(records: Records, levels: Sequence[float]) -> Any:
    """Per case and solver: time to each level, best residual, status, and whether the claim holds."""
    from rich.text import Text

    table = _table()
    table.add_column("case", overflow="fold")
    table.add_column("solver", no_wrap=True)
    for level in levels:
        table.add_column(f"to {level_name(level)}", justify="right", no_wrap=True)
    table.add_column("best", justify="right", no_wrap=True)
    table.add_column("status", no_wrap=True)
    table.add_column("claim", no_wrap=True)
    shown = ""
    for row in tables.reaches(records, levels):
        name = who(row.solver, row.start)
        cells = [
            Text(seconds(row.times[level]), style="" if row.times[level] < float("inf") else "dim")
            for level in levels
        ]
        best = residual(row.best) + ("*" if row.at_floor else " ")
        status = Text(row.status, style="green" if row.status in GOOD else "yellow")
        claim = Text("✗ contradicted", style="bold red") if row.contradicted else Text("")
        if shown and row.case != shown:
            table.add_section()
        table.add_row("" if row.case == shown else row.case, name, *cells, best, status, claim)
        shown = row.case
    return table


def _folding(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> Any:
    """A table whose columns but the first fold where the terminal is narrow."""
    table = _table()
    table.add_column(heads[0])
    for head in heads[1:]:
        table.add_column(head, overflow="fold")
    for row in rows:
        table.add_row(*row)
    return table


def _show_advice(console: Console, table: Any) -> None:
    """The table of recommendations; in a narrow terminal a line for each level and time under each structure."""
    inner = table.__rich__()
    if _width(console, inner) <= console.width:
        console.print(inner, highlight=False)
        return
    heads, *columns = inner.columns
    room = max(len(str(column.header)) for column in columns)
    for i, name in enumerate(heads.cells):
        console.print(name, highlight=False)
        for column in columns:
            line = f"  {column.header!s:<{room}}  {list(column.cells)[i]}"
            console.print(line, highlight=False, markup=False)


def pass_table(records: Records) -> Any:
    """Sequences: residual and time, carried against cold."""
    table = _table()
    for name in ("sequence", "solver", "asked", "steps", "residual carried", "cold", "time carried", "cold"):
        table.add_column(
            name, no_wrap=True, justify="left" if name in ("sequence", "solver", "asked") else "right"
        )
    for w in tables.passes(records):
        cells = [residual(w.middle(s)) if s in w.residuals else "–" for s in ("carried", "cold")]
        cells += [seconds(w.time[s]) if s in w.time else "–" for s in ("carried", "cold")]
        table.add_row(w.sequence, w.solver, w.asked, str(w.steps), *cells)
    return table


def robustness_table(rows: Sequence[tables.Robustness], levels: Sequence[float], unit: str = "") -> Any:
    """Campaigns: shares of cases solved, false claims, residual (motion error) by budget."""
    budgets = sorted({n for row in rows for n in row.budgets})
    table = _table()
    table.add_column("structure", no_wrap=True)
    table.add_column("solver", no_wrap=True)
    for name in ("cases", *(f"to {level_name(x)}{unit}" for x in levels), "false claims", "died"):
        table.add_column(name, justify="right", no_wrap=True)
    for n in budgets:
        table.add_column(f"{n}: median, 95 %", justify="right", no_wrap=True)
    shown = ""
    for row in rows:
        reached = [f"{100 * row.reached[x] / row.cases:.1f} %" for x in levels]
        ends = [", ".join(map(residual, row.budgets[n])) if n in row.budgets else "–" for n in budgets]
        name = "" if row.family == shown else row.family
        table.add_row(name, row.solver, str(row.cases), *reached, str(row.wrong), str(row.died), *ends)
        shown = row.family
    return table


def change_table(old: Records, new: Records) -> Any:
    """What differs from an earlier run beyond noise; None if nothing does."""
    found = [c for c in tables.changes(old, new) if c.kind != "same"]
    if not found:
        return None
    table = _table()
    for name in ("case", "solver", "level", "before", "now", "change"):
        table.add_column(name, no_wrap=True)
    for c in found:
        bad = c.kind in ("lost", "slower")
        factor = f" {c.new / c.old:.3g} times" if c.kind in ("faster", "slower") else ""
        cells = (
            c.case,
            who(c.solver, c.start),
            level_name(c.level),
            seconds(c.old),
            seconds(c.new),
            c.kind + factor,
        )
        table.add_row(*cells, style="red" if bad else "green")
    return table


BY_MOTION = "\n[bold]By motion error[/] (how wrong the body moves that is furthest off)"
FEW = 20  # lines: a report that has no more is printed whole


def print_report(
    records: Records,
    console: Console,
    old: Records | None = None,
    times: Sequence[float] = (),
    sweeps: Sequence[int] = (),
    whole: bool = False,
) -> None:
    """What the terminal shows after a run: the recommendation first; every case and sequence where `whole`.

    A report of few lines is shown whole anyhow.
    """
    still = idle(records)
    records = working(records)
    levels = tables.levels_of(records)
    campaign = tables.is_campaign(records)
    if campaign:
        console.print(
            "[bold]Campaign[/] (no times; share of cases brought to a level, residual at each budget)"
        )
        _show(console, robustness_table(tables.robustness(records), levels))
        if by_speed := robustness_by_speed(records):
            console.print(BY_MOTION, highlight=False)
            _show(console, robustness_table(by_speed, speed_levels(records), " m/s"))
    elif len(records):
        found = verdict(records, times, sweeps)
        console.print(found.text, style="bold", highlight=False, markup=False)
        for line in found.code:
            console.print(f"    {line}", highlight=False, markup=False, soft_wrap=True)
        console.print(
            "\n[bold]By structure[/] (to a level: mean time, share of cases that get there, budget; in a time or with "
            "sweeps: share of cases served, residual at the 90th percentile; ≈ as good within noise)",
            highlight=False,
        )
        asked = tuple(times) or tables.time_budgets(records)
        advice = tables.advice(records, asked)
        _show_advice(console, _folding(*advice_rows(records, advice, asked)))
        heads, rows = sweeps_rows(advice)
        if rows:
            console.print("\n[bold]By sweeps[/]", highlight=False)
            _show_advice(console, _folding(heads, rows))
        _print_motion(records, console, whole)
    for case in still[:FEW]:
        console.print(
            f"nothing to do: {case.case}; at worst {residual(case.velocity)} m/s by {case.solver or 'nobody'}",
            highlight=False,
            markup=False,
            style="dim",
        )
    if len(still) > FEW:
        console.print(f"and {len(still) - FEW} more with nothing to do", highlight=False, style="dim")
    _print_lost(records, console)
    _print_suspicions(records, console)
    if not campaign:
        _print_tables(records, console, levels, whole)
    if old is not None:
        table = change_table(old, records)
        said = f"\nAgainst {printable(old.source)}{'' if table else ': nothing beyond noise'}"
        console.print(said, highlight=False, markup=False, style="bold")
        if table:
            _show(console, table)
    wrong = [r for r in records if r.contradicted]
    if wrong:
        console.print(f"\n[bold red]{len(wrong)} claims are contradicted by the judge:[/]")
        for r in wrong[:FEW]:
            console.print(f"  {r.case}, {r.solver}: {r.contradicted}", highlight=False, markup=False)
        if len(wrong) > FEW:
            console.print(f"  and {len(wrong) - FEW} more", highlight=False)


def _print_motion(records: Records, console: Console, whole: bool) -> None:
    """Who gets to each motion error, by structure; each case where that is asked for or few."""
    if not speed_levels(records):
        return
    console.print(BY_MOTION, highlight=False)
    _show_advice(console, _folding(*speed_rows(records)))
    heads, rows = moved_rows(records)
    if not whole and len(rows) > FEW:
        return
    table = _table()
    table.add_column(heads[0], overflow="fold")
    table.add_column(heads[1], no_wrap=True)
    for head in heads[2:]:
        table.add_column(head, justify="right", no_wrap=True)
    shown = ""
    for case, *cells in rows:
        table.add_row("" if case == shown else case, *cells)
        shown = case
    console.print()
    _show(console, table)


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
    for case, told in found[:FEW]:
        console.print("[yellow]suspicious:[/]", end=" ")
        console.print(f"{case}: {told}", highlight=False, markup=False)
    if len(found) > FEW:
        console.print(f"and {len(found) - FEW} more, on the page", highlight=False, style="dim")


def _print_tables(records: Records, console: Console, levels: Sequence[float], whole: bool) -> None:
    lines = len(tables.reaches(records, levels)) + len(tables.passes(records))
    if not whole and lines > FEW:
        console.print(
            f"{count(lines, 'line')} of single cases and sequences: --tables prints them",
            highlight=False,
            style="dim",
        )
        return
    if any(r.step < 0 for r in records):
        console.print()
        _show(console, reach_table(records, levels))
        console.print("* at the floor: rounding to float64 allows no better", style="dim", highlight=False)
    if any(r.step >= 0 for r in records):
        console.print(
            "\n[bold]Sequences[/] (median residual, time of all steps; carried from step to step, or cold)"
        )
        _show(console, pass_table(records))
