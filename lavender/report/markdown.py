"""A summary to paste into a pull request."""

from __future__ import annotations

from collections.abc import Sequence

from lavender.bench.store import Records
from lavender.report import contents, tables
from lavender.report.engine import ENGINES, Contestant
from lavender.report.moved import robustness_by_speed, speed_levels
from lavender.report.table import markdown, plain
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
        lines += [plain(f"{machine}; run {run.run}, {run.started}"), ""]
    found = verdict(records, asked, sweeps)
    if found.sentences:
        lines += [plain(found.text), "", "```python", *found.code, "```", ""]
    if tables.is_campaign(records):
        lines += markdown(contents.robustness_table(tables.robustness(records), levels))
        if by_speed := robustness_by_speed(records):
            lines += ["", MOTION, "", *markdown(contents.robustness_table(by_speed, speeds, " m/s"))]
        return "\n".join([*lines, *_failed(records)]) + "\n"
    advice = tables.advice(records, times)
    shown = [contents.advice_table(records, advice, times), contents.sweeps_table(advice)]
    for table in shown:
        lines += [*markdown(table), ""] if table.rows else []
    if engines:
        lines += [ENGINES, "", *markdown(contents.engine_table(engines)), ""]
    if speeds:  # who gets to each motion error, by structure and by case
        lines += [MOTION, "", *markdown(contents.speed_table(records)), ""]
        lines += [*markdown(contents.moved_table(records)), ""]
    lines += markdown(contents.reach_table(tables.reaches(records), levels).without("form"))
    return "\n".join([*lines, *_failed(records)]) + "\n"


def _failed(records: Records) -> list[str]:
    wrong = tables.failures(records)
    if not wrong:
        return []
    return ["", f"{len(wrong)} runs missed what they were asked for, or claimed falsely; see the page."]
