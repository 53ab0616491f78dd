"""A summary to paste into a pull request."""

from __future__ import annotations

from lavender.bench.record import level_name
from lavender.bench.store import Records
from lavender.report import tables
from lavender.report.text import residual, seconds

__all__ = ["summary"]


def summary(records: Records) -> str:
    """Markdown: recommendations, then every case and solver, then what failed."""
    levels = tables.levels_of(records)
    lines = ["## lavender report", ""]
    for run in records.runs.values():
        machine = f"{run.cpu}, {run.threads} thread; lavender {run.lavender}, Python {run.python}"
        lines += [f"{machine}; run {run.run}, {run.started}", ""]
    rows = tables.advice_by_level(records)
    if rows:
        lines += ["| structure | " + " | ".join(f"to {level_name(x)}" for x in levels) + " |"]
        lines += ["|---" * (len(levels) + 1) + "|"]
        for family in dict.fromkeys(a.family for a in rows):
            cells = []
            for level in levels:
                best = next(a for a in rows if a.family == family and a.target == level).best
                cells.append(
                    f"{best.solver} {seconds(best.typical)} ({best.solved}/{best.cases})"
                    if best
                    else "nobody"
                )
            lines.append(f"| {family} | " + " | ".join(cells) + " |")
        lines.append("")
    lines += ["| case | solver | " + " | ".join(f"to {level_name(x)}" for x in levels) + " | best | status |"]
    lines += ["|---" * (len(levels) + 4) + "|"]
    for r in tables.reaches(records):
        solver = r.solver if r.start == "cold" else f"{r.solver} ({r.start})"
        mark = " **claim contradicted**" if r.contradicted else ""
        times = " | ".join(seconds(r.times[x]) for x in levels)
        lines.append(f"| {_cell(r.case)} | {solver} | {times} | {residual(r.best)} | {r.status}{mark} |")
    wrong = tables.failures(records)
    if wrong:
        lines += ["", f"{len(wrong)} runs missed what they were asked for, or claimed falsely; see the page."]
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
