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

__all__ = ["write"]


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
    from lavender.report.curves import figures as figures_of
    from lavender.report.markdown import summary
    from lavender.report.moved import working
    from lavender.report.page import page

    folder = Path(folder)
    shown = records.latest()
    busy = working(shown)
    drawn = figures_of(busy)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_csv(records, folder / "records.csv")
        write_json(records, folder / "records.json")
        index = folder / "index.html"
        before = None if old is None else old.latest()
        # Whole or not at all: on a full disk the page of the last time stays.
        write_text(
            index,
            page(
                shown,
                drawn,
                old=before,
                budgets=times,
                sweeps=sweeps,
                saved=figures,
                engines=engines,
            ),
        )
        write_text(folder / "summary.md", summary(busy, times, engines, sweeps))
        if figures and list(drawn):
            _save(drawn, {r.solver for r in shown}, folder / "figures")
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
