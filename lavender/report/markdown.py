"""A summary to paste into a pull request."""

from __future__ import annotations

from lavender.bench.store import Records
from lavender.report import contents, tables
from lavender.report.engine import ENGINES
from lavender.report.findings import Report
from lavender.report.table import markdown, plain

__all__ = ["summary"]

MOTION = "**By motion error** (how wrong the body moves that is furthest off)"


def summary(report: Report) -> str:
    """Markdown: recommendations, then every case and solver, then what failed."""
    records, found = report.records, report.verdict
    lines = ["## lavender report", ""]
    for run in records.runs.values():
        machine = f"{run.cpu}, {run.threads} thread; lavender {run.lavender}, Python {run.python}"
        lines += [plain(f"{machine}; run {run.run}, {run.started}"), ""]
    if found.sentences:
        lines += [plain(found.text), "", "```python", *found.code, "```", ""]
    if report.is_campaign:
        lines += markdown(contents.robustness_table(tables.robustness(records), report.levels))
        if by_speed := tables.robustness(report.by_speed):
            lines += ["", MOTION, "", *markdown(contents.robustness_table(by_speed, report.speeds, " m/s"))]
        return "\n".join([*lines, *_failed(records)]) + "\n"
    for table in (contents.advice_table(report), contents.sweeps_table(report.lines)):
        lines += [*markdown(table), ""] if table.rows else []
    if report.engines:
        lines += [ENGINES, "", *markdown(contents.engine_table(report.engines)), ""]
    if report.speeds:  # who gets to each motion error, by structure and by case
        lines += [MOTION, "", *markdown(contents.speed_table(report)), ""]
        lines += [*markdown(contents.moved_table(report)), ""]
    lines += markdown(contents.reach_table(tables.reaches(records), report.levels).without("form"))
    return "\n".join([*lines, *_failed(records)]) + "\n"


def _failed(records: Records) -> list[str]:
    wrong = tables.failures(records)
    if not wrong:
        return []
    return ["", f"{len(wrong)} runs missed what they were asked for, or claimed falsely; see the page."]
