"""Everything that a report leaves in its folder."""

from __future__ import annotations

from pathlib import Path

from lavender.base.errors import InputError
from lavender.io.stored import make_folder, write_text
from lavender.lab.bench.store import Records, write_csv, write_json
from lavender.lab.report import curves, tables
from lavender.lab.report.contents import sections
from lavender.lab.report.draw import save
from lavender.lab.report.findings import Report
from lavender.lab.report.page import page
from lavender.lab.report.table import markdown, plain
from lavender.lab.report.text import left_out


def write(found: Records | Report, folder: str | Path, *, figures: bool = True) -> Path:
    """Write `records.csv`, `records.json`, `figures/*.svg`, `figures/*.png`, `summary.md` and `index.html`.

    Parameters
    ----------
    found : Records or Report
        Records, or a report of them, which says besides what they are compared with and what was asked. Times are
        compared within the newest run alone; csv and json hold all of them.
    folder : path
    figures : bool
        False leaves out the SVG and PNG files, which take most of the time.

    Returns
    -------
    Path
        Of index.html.

    Raises
    ------
    InputError
        Neither records nor a report; the folder cannot be written.
    """
    report = Report(found) if isinstance(found, Records) else found
    if not isinstance(report, Report):
        raise InputError(
            f"found is a {type(found).__name__}; Records, as lavender.lab.bench.run returns them, or a Report"
        )
    drawn = curves.figures(report.records)
    folder = make_folder(folder)
    write_csv(report.given, folder / "records.csv")
    write_json(report.given, folder / "records.json")
    index = folder / "index.html"
    # Whole or not at all: on a full disk the page of the last time stays.
    write_text(index, page(report, drawn, saved=figures))
    write_text(folder / "summary.md", summary(report))
    if figures:
        save(drawn, folder / "figures", {r.solver for r in report.every})
    return index


def summary(report: Report) -> str:
    """To paste into a pull request, as Markdown: recommendations, then every case and solver, then what failed."""
    records, found = report.records, report.verdict
    lines = ["## lavender report", ""]
    for run in records.runs.values():
        machine = f"{run.cpu}, {run.threads} thread; lavender {run.lavender}, Python {run.python}"
        lines += [plain(f"{machine}; run {run.run}, {run.started}"), ""]
    for warning in (report.stopped, report.busy):
        lines += [f"**{plain(warning)}**", ""] if warning else []
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
