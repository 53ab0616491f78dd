"""Write the page of an audit or a tuning, and print its short form on a terminal."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lavender.io.stored import format_json
from lavender.report.render import Section, Statement, print_page, render_page, write_files

if TYPE_CHECKING:
    from rich.console import Console

STOPPED_NOTE = "Stopped before the end: the numbers contain only the completed part."


@dataclass(frozen=True)
class ResultPage:
    """Contents of a page.

    Parameters
    ----------
    title : str
    headline : list of str
        Up to three sentences with the result, one on each line.
    sections : list of Section
    numbers : dict
        Contents of `numbers.json`.
    notes : list of str
        Sentences with advice and warnings; a terminal shows them below its tables.
    is_stopped : bool
        Whether the measurement ended early, so that all numbers describe only its completed part.
    """

    title: str
    headline: Sequence[str]
    sections: Sequence[Section]
    numbers: dict[str, Any]
    notes: Sequence[str] = ()
    is_stopped: bool = False

    def write(self, folder: str | os.PathLike[str]) -> Path:
        """Write `index.html`, `numbers.json` and `figures/*.svg`; return the path of the page."""
        notes = [*self.notes, *([STOPPED_NOTE] if self.is_stopped else [])]
        statements = list(map(Statement, self.headline))
        page = render_page(
            self.title, statements, self.sections, warnings=notes, folder=Path(folder) / "figures"
        )
        numbers = format_json(self.numbers, indent=1) + "\n"
        return write_files(Path(folder), {"index.html": page, "numbers.json": numbers}) / "index.html"

    def print_short(self, console: Console) -> None:
        """Print the headline, the first rows of each section's first table, and the notes."""
        print_page(console, list(map(Statement, self.headline)), self.sections)
        for i, note in enumerate(self.notes):
            console.print(f"{'' if i else chr(10)}{note}", style="yellow", highlight=False, markup=False)
