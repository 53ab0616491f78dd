"""Write tables and the summary of a report as Markdown."""

from __future__ import annotations

import re

from lavender.report.bench import statistics
from lavender.report.findings import Report
from lavender.report.table import Table
from lavender.report.table_specs import list_sections
from lavender.report.text import list_cases_not_loaded


def format_markdown(table: Table) -> list[str]:
    """Return the lines of a table."""
    lines = ["| " + " | ".join(table.heads) + " |", "|---" * len(table.heads) + "|"]
    return lines + ["| " + " | ".join(map(escape_markdown, row)) + " |" for row in table.cell_texts]


def escape_markdown(text: str) -> str:
    """Return a text on one line, with Markdown and HTML in it escaped."""
    text = " ".join(text.split()).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"([\\`*\[\]|])", r"\\\1", text)


def summarise_report(report: Report) -> str:
    """Return recommendations, all tables and the number of failures, to paste into a pull request."""
    records = report.ranked_records
    lines = ["## lavender report", ""]
    for run in records.runs.values():
        machine = f"{run.cpu}, {run.threads} thread; lavender {run.lavender}, Python {run.python}"
        lines += [escape_markdown(f"{machine}; run {run.run}, {run.started}"), ""]
    for warning in (report.stopped_warning, report.busy_warning):
        lines += [f"**{escape_markdown(warning)}**", ""] if warning else []
    for statement in report.verdict.statements:
        code = ["```python", *statement.code, "```", ""] if statement.code else []
        lines += [escape_markdown(statement.text), "", *code]
    for what, reason in list_cases_not_loaded(records):
        lines += [escape_markdown(f"Left out of all numbers: {what}: {reason}"), ""]
    for section in list_sections(report):
        lines += [f"**{escape_markdown(section.title)}** ({escape_markdown(section.note)})", ""]
        lines += [*(format_markdown(section.table) if section.table.rows else [section.empty]), ""]
    failures = statistics.list_failures(records)
    if failures:
        lines += [
            f"{len(failures)} runs missed their target or made a false claim; see the page.",
            "",
        ]
    return "\n".join(lines)
