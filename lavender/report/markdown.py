"""A summary to paste into a pull request."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from lavender.bench.record import level_name
from lavender.bench.store import Records
from lavender.report import tables
from lavender.report.engine import ENGINES, Contestant
from lavender.report.engine import lines as engine_lines
from lavender.report.moved import advice_by_speed, moved, robustness_by_speed, speed_levels, speed_name
from lavender.report.text import count, in_time, residual, seconds, to_level
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
        head = [*(f"to {level_name(x)}" for x in levels), *(f"in {seconds(t)}" for t in times)]
        lines += ["| structure | " + " | ".join(head) + " |", "|---" * (len(head) + 1) + "|"]
        for line in advice:
            cells = [line.name, *map(to_level, line.by_level.values()), *map(in_time, line.by_time.values())]
            lines.append("| " + " | ".join(map(_cell, cells)) + " |")
        lines.append("")
        budgets = sorted({n for line in advice for n in line.by_sweeps})
        rows = [[line.name, *map(in_time, line.by_sweeps.values())] for line in advice if line.by_sweeps]
        lines += (
            [*_table(["structure", *(count(int(n), "sweep") for n in budgets)], rows), ""] if rows else []
        )
    if tables.is_campaign(records):
        lines += _campaign(tables.robustness(records), [f"to {level_name(x)}" for x in levels])
        if by_speed := robustness_by_speed(records):
            lines += ["", MOTION, "", *_campaign(by_speed, [f"to {speed_name(x)}" for x in speeds])]
        return "\n".join([*lines, *_failed(records)]) + "\n"
    if engines:
        lines += [ENGINES, "", *engine_lines(engines), ""]
    lines += _motion(records, speeds)
    lines += ["| case | solver | " + " | ".join(f"to {level_name(x)}" for x in levels) + " | best | status |"]
    lines += ["|---" * (len(levels) + 4) + "|"]
    for r in tables.reaches(records):
        solver = r.solver if r.start == "cold" else f"{r.solver} ({r.start})"
        mark = " **claim contradicted**" if r.contradicted else ""
        cells = [r.case, solver, *(seconds(r.times[x]) for x in levels), residual(r.best), r.status]
        lines.append("| " + " | ".join(map(_cell, cells)) + f"{mark} |")
    return "\n".join([*lines, *_failed(records)]) + "\n"


def _failed(records: Records) -> list[str]:
    wrong = tables.failures(records)
    if not wrong:
        return []
    return ["", f"{len(wrong)} runs missed what they were asked for, or claimed falsely; see the page."]


def _motion(records: Records, levels: Sequence[float]) -> list[str]:
    """Who gets to each motion error, by structure and by case; nothing where none was told."""
    if not levels:
        return []
    by_family: dict[str, list[str]] = {}
    for advice in advice_by_speed(records):
        by_family.setdefault(advice.family, []).append(to_level(advice))
    heads = [f"to {speed_name(x)}" for x in levels]
    lines = [
        MOTION,
        "",
        *_table(["structure", *heads], [[name, *row] for name, row in by_family.items()]),
        "",
    ]
    rows = []
    for m in moved(records, levels):
        solver = m.solver if m.start == "cold" else f"{m.solver} ({m.start})"
        known = [
            f"{residual(x)}{unit}" if math.isfinite(x) else "–"
            for x, unit in ((m.best, " m/s"), (m.relative, ""), (m.bound, " √J"))
        ]
        rows.append([m.case, solver, *(seconds(m.times[x]) for x in levels), *known])
    return [*lines, *_table(["case", "solver", *heads, "best", "relative", "bound"], rows), ""]


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
