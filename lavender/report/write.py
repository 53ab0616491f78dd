"""Everything that a report leaves in its folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lavender.bench.store import Records, write_csv, write_json
from lavender.errors import InputError
from lavender.io.stored import write_text

if TYPE_CHECKING:
    from lavender.report.curves import Figures
    from lavender.report.engine import Contestant
    from lavender.report.findings import Report

__all__ = ["write", "write_all"]


def write(
    records: Records,
    folder: str | Path,
    *,
    figures: bool = True,
    old: Records | None = None,
    times: Sequence[float] = (),
    sweeps: Sequence[int] = (),
    engines: Sequence[Contestant] = (),
) -> Path:
    """Write `records.csv`, `records.json`, `figures/*.svg`, `figures/*.png`, `summary.md` and `index.html`.

    Parameters
    ----------
    records : Records
        Times are compared within the newest run alone; csv and json hold all of them.
    folder : path
    figures : bool
        False leaves out the SVG and PNG files, which take most of the time.
    old : Records, optional
        An earlier run to compare with.
    times : s, optional
        Time budgets of the recommendation; those of the plan, or `tables.time_budgets`, if none are given.
    sweeps : int, optional
        Budgets of sweeps with which a solver is to be named; those of the plan if none are given.
    engines : sequence of Contestant
        Answers of the engines that recorded the steps: `lavender.report.engine.contestants`.

    Returns
    -------
    Path
        Of index.html.

    Raises
    ------
    InputError
        The folder cannot be written.
    """
    from lavender.report.findings import Report

    return write_all(Report(records, old, times, sweeps, engines), folder, figures=figures)


def write_all(report: Report, folder: str | Path, *, figures: bool = True) -> Path:
    """As `write`."""
    from lavender.report.curves import figures as figures_of
    from lavender.report.markdown import summary
    from lavender.report.page import page

    folder = Path(folder)
    drawn = figures_of(report.records)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_csv(report.given, folder / "records.csv")
        write_json(report.given, folder / "records.json")
        index = folder / "index.html"
        # Whole or not at all: on a full disk the page of the last time stays.
        write_text(index, page(report, drawn, saved=figures))
        write_text(folder / "summary.md", summary(report))
        if figures and list(drawn):
            _save(drawn, {r.solver for r in report.every}, folder / "figures")
    except OSError as error:
        raise InputError(
            f"cannot write {error.filename or folder} ({error.strerror or error}): make room, or give a folder that "
            "you may write to; the records are kept"
        ) from None
    return index


def _save(drawn: Figures, solvers: set[str], folder: Path) -> None:
    """Each figure as SVG and PNG."""
    from lavender.report.draw import save
    from lavender.report.style import looks

    folder.mkdir(exist_ok=True)
    look = looks(solvers | {c.solver for figure in drawn for c in figure.curves})
    for figure in drawn:
        save(figure, look, folder)
