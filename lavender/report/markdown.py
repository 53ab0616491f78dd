"""A summary to paste into a pull request."""

from __future__ import annotations

import re
from collections.abc import Sequence

from lavender.bench.record import level_name
from lavender.bench.store import Records
from lavender.report import tables
from lavender.report.text import in_time, residual, seconds, to_level
from lavender.report.verdict import verdict

__all__ = ["summary"]


def summary(records: Records, times: Sequence[float] = ()) -> str:
    """Markdown: recommendations, then every case and solver, then what failed."""
    levels = tables.levels_of(records)
    times = tuple(times) or tables.time_budgets(records)
    lines = ["## lavender report", ""]
    for run in records.runs.values():
        machine = f"{run.cpu}, {run.threads} thread; lavender {run.lavender}, Python {run.python}"
        lines += [_cell(f"{machine}; run {run.run}, {run.started}"), ""]
    found = verdict(records, times)
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
    lines += ["| case | solver | " + " | ".join(f"to {level_name(x)}" for x in levels) + " | best | status |"]
    lines += ["|---" * (len(levels) + 4) + "|"]
    for r in tables.reaches(records):
        solver = r.solver if r.start == "cold" else f"{r.solver} ({r.start})"
        mark = " **claim contradicted**" if r.contradicted else ""
        cells = [r.case, solver, *(seconds(r.times[x]) for x in levels), residual(r.best), r.status]
        lines.append("| " + " | ".join(map(_cell, cells)) + f"{mark} |")
    wrong = tables.failures(records)
    if wrong:
        lines += ["", f"{len(wrong)} runs missed what they were asked for, or claimed falsely; see the page."]
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    """Text on one line as Markdown and the HTML in it would show it, with no meaning of its own."""
    plain = " ".join(text.split()).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"([\\`*\[\]|])", r"\\\1", plain)
