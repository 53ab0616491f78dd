"""A summary to paste into a pull request."""

from __future__ import annotations

import re
from collections.abc import Sequence

from lavender.bench.record import level_name
from lavender.bench.store import Records
from lavender.report import tables
from lavender.report.engine import ENGINES, Contestant
from lavender.report.engine import lines as engine_lines
from lavender.report.moved import robustness_by_speed, speed_levels, speed_name
from lavender.report.text import advice_rows, moved_rows, residual, seconds, speed_rows, sweeps_rows, who
from lavender.report.verdict import verdict

__all__ = ["summary"]

MOTION = "**By motion error** (how wrong the body moves that is furthest off)"


def summary(
    records: Records,
    times: Sequence[float] = (),
    engines: Sequence[Contestant] = (),
    sweeps: Sequence[int] = (),
) -> str:
    """Markdown: recommendations, then every case and solver, then what failed."""
    levels = tables.levels_of(records)
    asked = tuple(times)
    times = asked or tables.time_budgets(records)
    speeds = speed_levels(records)
    lines = ["## lavender report", ""]
    for run in records.runs.values():
        machine = f"{run.cpu}, {run.threads} thread; lavender {run.lavender}, Python {run.python}"
        lines += [_cell(f"{machine}; run {run.run}, {run.started}"), ""]
    found = verdict(records, asked, sweeps)
    if found.sentences:
        lines += [_cell(found.text), "", "```python", *found.code, "```", ""]
    advice = [] if tables.is_campaign(records) else tables.advice(records, times)
    if advice:
        lines += [*_table(*advice_rows(records, advice, times)), ""]
        heads, rows = sweeps_rows(advice)
        lines += [*_table(heads, rows), ""] if rows else []
    if tables.is_campaign(records):
        lines += _campaign(tables.robustness(records), [f"to {level_name(x)}" for x in levels])
        if by_speed := robustness_by_speed(records):
            lines += ["", MOTION, "", *_campaign(by_speed, [f"to {speed_name(x)}" for x in speeds])]
        return "\n".join([*lines, *_failed(records)]) + "\n"
    if engines:
        lines += [ENGINES, "", *engine_lines(engines), ""]
    if speeds:  # who gets to each motion error, by structure and by case
        lines += [MOTION, "", *_table(*speed_rows(records)), "", *_table(*moved_rows(records)), ""]
    heads = ["case", "solver", *(f"to {level_name(x)}" for x in levels), "best", "status"]
    rows = [
        [r.case, who(r.solver, r.start), *(seconds(r.times[x]) for x in levels), residual(r.best), r.status]
        for r in tables.reaches(records)
    ]
    marks = [" **claim contradicted**" if r.contradicted else "" for r in tables.reaches(records)]
    first = _table(heads, rows)
    lines += first[:2]
    lines += [f"{line[:-2]}{mark} |" for line, mark in zip(first[2:], marks, strict=True)]
    return "\n".join([*lines, *_failed(records)]) + "\n"


def _failed(records: Records) -> list[str]:
    wrong = tables.failures(records)
    if not wrong:
        return []
    return ["", f"{len(wrong)} runs missed what they were asked for, or claimed falsely; see the page."]


def _campaign(rows: Sequence[tables.Robustness], heads: Sequence[str]) -> list[str]:
    """Shares of cases brought to each level, by structure and solver."""
    return _table(
        ["structure", "solver", "cases", *heads, "false claims", "died", "hardest"],
        [
            [
                r.family,
                r.solver,
                str(r.cases),
                *(f"{100 * n / r.cases:.1f}%" for n in r.reached.values()),
                str(r.wrong),
                str(r.died),
                r.hardest,
            ]
            for r in rows
        ],
    )


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    return lines + ["| " + " | ".join(map(_cell, row)) + " |" for row in rows]


def _cell(text: str) -> str:
    """Text on one line as Markdown and the HTML in it would show it, with no meaning of its own."""
    plain = " ".join(text.split()).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"([\\`*\[\]|])", r"\\\1", plain)
