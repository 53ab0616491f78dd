"""A summary to paste into a pull request."""

from __future__ import annotations

from collections.abc import Sequence

from lavender.bench.record import level_name
from lavender.bench.store import Records
from lavender.report import tables
from lavender.report.text import in_time, residual, seconds, to_level

__all__ = ["summary"]


def summary(records: Records, times: Sequence[float] = ()) -> str:
    """Markdown: recommendations, then every case and solver, then what failed."""
    levels = tables.levels_of(records)
    times = tuple(times) or tables.time_budgets(records)
    lines = ["## lavender report", ""]
    for run in records.runs.values():
        machine = f"{run.cpu}, {run.threads} thread; lavender {run.lavender}, Python {run.python}"
        lines += [f"{machine}; run {run.run}, {run.started}", ""]
    advice = [] if tables.is_campaign(records) else tables.advice(records, times)
    if advice:
        head = [*(f"to {level_name(x)}" for x in levels), *(f"in {seconds(t)}" for t in times)]
        lines += ["| structure | " + " | ".join(head) + " |", "|---" * (len(head) + 1) + "|"]
        for line in advice:
            cells = [*map(to_level, line.by_level.values()), *map(in_time, line.by_time.values())]
            lines.append(f"| {_cell(line.name)} | " + " | ".join(cells) + " |")
        lines.append("")
    lines += ["| case | solver | " + " | ".join(f"to {level_name(x)}" for x in levels) + " | best | status |"]
    lines += ["|---" * (len(levels) + 4) + "|"]
    for r in tables.reaches(records):
        solver = r.solver if r.start == "cold" else f"{r.solver} ({r.start})"
        mark = " **claim contradicted**" if r.contradicted else ""
        reached = " | ".join(seconds(r.times[x]) for x in levels)
        lines.append(f"| {_cell(r.case)} | {solver} | {reached} | {residual(r.best)} | {r.status}{mark} |")
    wrong = tables.failures(records)
    if wrong:
        lines += ["", f"{len(wrong)} runs missed what they were asked for, or claimed falsely; see the page."]
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
