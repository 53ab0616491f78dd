"""Write the folder of a report."""

from __future__ import annotations

from pathlib import Path

from lavender.base.errors import InputError
from lavender.io.stored import make_folder, write_text
from lavender.report.bench.store import Records, write_csv, write_json
from lavender.report.figures import build_figures
from lavender.report.findings import Report
from lavender.report.markdown import summarise_report
from lavender.report.page import render_page
from lavender.report.plotting import assign_styles, save_figures

MAX_BANDS = 2  # More bands of one figure would hide each other.


def write(source: Records | Report, folder: str | Path, *, figures: bool = True) -> Path:
    """Write `records.csv`, `records.json`, `figures/*.svg`, `figures/*.png`, `summary.md` and `index.html`.

    Parameters
    ----------
    source : Records or Report
        Records, or a report of them with earlier records and budgets. Times are compared within the newest run alone;
        csv and json hold all runs.
    folder : path
    figures : bool
        False leaves out the SVG and PNG files, which take the largest part of the time.

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
            f"source is a {type(source).__name__}; Records (the result of lavender.report.bench.run) or a "
            "Report is needed"
        )
    drawn = build_figures(report.ranked_records)
    folder = make_folder(folder)
    write_csv(report.all_records, folder / "records.csv")
    write_json(report.all_records, folder / "records.json")
    index = folder / "index.html"
    # `write_text` replaces a file only when the new one is complete: on a full disk, the earlier page stays.
    write_text(index, render_page(report, drawn, saved=figures))
    write_text(folder / "summary.md", summarise_report(report))
    if figures:
        solvers = {*report.all_records.solvers, *(c.solver for figure in drawn for c in figure.curves)}
        save_figures(drawn, folder / "figures", assign_styles(solvers), report.verdict.leaders[:MAX_BANDS])
    return index
