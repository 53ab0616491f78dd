"""Everything that a report leaves in its folder."""

from __future__ import annotations

from pathlib import Path

from lavender.base.errors import InputError
from lavender.io.stored import make_folder, write_text
from lavender.lab.bench.store import Records, write_csv, write_json
from lavender.lab.report import curves
from lavender.lab.report.draw import save
from lavender.lab.report.findings import Report
from lavender.lab.report.markdown import summary
from lavender.lab.report.page import page


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
