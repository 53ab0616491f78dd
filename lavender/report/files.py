"""Write the folder of a report."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

from lavender.base.errors import InputError
from lavender.io.stored import make_folder, write_atomically, write_text
from lavender.report.findings import Report
from lavender.report.page import render_page
from lavender.report.records import Records
from lavender.report.runner import Event
from lavender.report.table import escape_markdown
from lavender.report.text import list_cases_not_loaded

LONG_TABLES = ("cases", "failures", "runs", "skipped")  # Tables that are not written as LaTeX and Markdown.


def write(
    source: Records | Report,
    folder: str | Path,
    *,
    figures: bool = True,
    watch: Callable[[Event], None] = lambda event: None,
) -> Path:
    """Write `records.csv`, `tables/*.csv`, `tables/*.tex`, `figures/*.svg`, `summary.md` and `index.html`.

    If pyarrow is installed, `records.parquet` is written, too.

    Parameters
    ----------
    source : Records or Report
        Records, or a report of them with earlier records and budgets. Times are compared within the newest run alone;
        `records.csv` holds all runs.
    folder : path
    figures : bool
        False leaves out the figures, which take the largest part of the time.
    watch : callable (Event), optional
        Called before each file.

    Returns
    -------
    Path
        Path of index.html.

    Raises
    ------
    InputError
        `source` is neither records nor a report, or the folder cannot be written.
    """
    report = Report(source) if isinstance(source, Records) else source
    if not isinstance(report, Report):
        raise InputError(
            f"source is a {type(source).__name__}; Records (the result of lavender.report.run) or a Report is needed"
        )
    folder = make_folder(folder)
    frame = report.records.frame
    names, count = ["records.csv", "tables", "index.html", "summary.md", *report.sections], 0

    def begin(name: str) -> None:
        """Report that the next file is written."""
        nonlocal count
        watch(Event(count, len(names), name, "", phase="writing"))
        count += 1

    begin("records.csv")
    write_atomically(folder / "records.csv", lambda path: frame.to_csv(path, index=False))
    if importlib.util.find_spec("pyarrow") is not None:
        write_atomically(folder / "records.parquet", lambda path: frame.to_parquet(path, index=False))
    begin("tables")
    tables = make_folder(folder / "tables")
    for name, section in report.sections.items():
        begin(name)
        write_text(tables / f"{name}.csv", section.frame.to_csv(index=False))
        if name not in LONG_TABLES:
            write_text(
                tables / f"{name}.tex", section.frame.to_latex(index=False, escape=True, float_format="%.3g")
            )
    begin("summary.md")
    write_text(folder / "summary.md", summarise(report))
    begin("index.html, with its figures")
    index = folder / "index.html"
    # `write_text` replaces a file only when the new one is complete: on a full disk, the earlier page stays.
    write_text(index, render_page(report, figures, folder / "figures"))
    return index


def summarise(report: Report) -> str:
    """Return recommendations and tables in Markdown, to paste into a pull request."""
    lines = ["## lavender report", ""]
    for run in list(report.records.runs.values())[-1:]:
        machine = f"{run.cpu}, {run.threads} thread; lavender {run.lavender}, Python {run.python}"
        lines += [escape_markdown(f"{machine}; run {run.run}, {run.started}"), ""]
    if report.busy_warning:
        lines += [f"**{escape_markdown(report.busy_warning)}**", ""]
    for statement in report.statements:
        lines += [escape_markdown(statement.text), ""]
        lines += ["```python", *statement.code, "```", ""] if statement.code else []
    for cases, reason in list_cases_not_loaded(report.records):
        lines += [escape_markdown(f"Left out of all numbers: {cases}: {reason}"), ""]
    for name, section in report.sections.items():
        if name not in LONG_TABLES:
            lines += [f"**{escape_markdown(section.title)}** {escape_markdown(section.note)}".rstrip(), ""]
            lines += [*section.table.format_markdown(), ""]
    return "\n".join(lines)
