"""A summary to paste into a pull request."""

from __future__ import annotations

from lavender.lab.report import tables
from lavender.lab.report.contents import sections
from lavender.lab.report.findings import Report
from lavender.lab.report.table import markdown, plain
from lavender.lab.report.text import left_out


def summary(report: Report) -> str:
    """Markdown: recommendations, then every case and solver, then what failed."""
    records, found = report.records, report.verdict
    lines = ["## lavender report", ""]
    for run in records.runs.values():
        machine = f"{run.cpu}, {run.threads} thread; lavender {run.lavender}, Python {run.python}"
        lines += [plain(f"{machine}; run {run.run}, {run.started}"), ""]
    lines += [f"**{plain(report.busy)}**", ""] if report.busy else []
    for told in found.told:
        lines += [plain(told.text), "", *(["```python", *told.code, "```", ""] if told.code else [])]
    for what, reason in left_out(records):
        lines += [plain(f"Left out, and in no number here: {what}: {reason}"), ""]
    for section in sections(report):
        lines += [f"**{plain(section.title)}** ({plain(section.note)})", ""]
        lines += [*(markdown(section.table) if section.table.rows else [section.empty]), ""]
    wrong = tables.failures(records)
    if wrong:
        lines += [f"{len(wrong)} runs missed what they were asked for, or claimed falsely; see the page.", ""]
    return "\n".join(lines)
