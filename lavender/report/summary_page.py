"""Keep pages of tables of texts for `lavender.audit` until it uses `lavender.report.render`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lavender.report.figures import Figure
from lavender.report.render import Section, Statement, print_page, render_page, write_files
from lavender.report.table import Table

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class PageSection:
    """A heading with its tables, figures and lines to copy; see `lavender.report.render.Section`."""

    title: str
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()
    note: str = ""
    code: Sequence[str] = ()
    short: int = 0
    terminal_table: Table | None = None


@dataclass(frozen=True)
class SummaryPage:
    """A title, the sentence that summarises the page, sections, and numbers for programs."""

    title: str
    head: str
    sections: Sequence[PageSection]
    numbers: dict[str, Any]
    stopped: bool = False
    warning: str = ""

    @property
    def _sections(self) -> list[Section]:
        """The sections with DataFrames."""
        return [
            Section(
                title=s.title, frames=[t.frame for t in s.tables], note=s.note, figures=s.figures, code=s.code,
                short=s.short, short_frame=None if s.terminal_table is None else s.terminal_table.frame,
            )
            for s in self.sections
        ]  # fmt: skip

    def render_html(self, folder: Path | None = None) -> str:
        """Return the page as HTML."""
        stopped = "Stopped before the end: the numbers contain only the completed part." * self.stopped
        warnings = [text for text in (self.warning, stopped) if text]
        return render_page(
            self.title, [Statement(self.head)], self._sections, warnings=warnings, folder=folder
        )

    def write(self, folder: str | os.PathLike[str]) -> Path:
        """Write `index.html`, `numbers.json` and `figures/*.svg`; return the path of the page."""
        page = self.render_html(Path(folder) / "figures")
        return write_files(Path(folder), {"index.html": page, "numbers.json": self.numbers}) / "index.html"

    def print_short(self, console: Console) -> None:
        """Print the sentence, lines to copy, and the first rows of each section's first table."""
        print_page(console, [Statement(self.head)], self._sections, [self.warning] if self.warning else [])
