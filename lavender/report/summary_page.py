"""Write a page of tables and figures under one sentence, its short form on a terminal, and its numbers as JSON."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lavender.io.stored import make_folder, write_text
from lavender.report.figures import Figure, list_solvers
from lavender.report.page import create_environment
from lavender.report.plotting import draw_figures, number_styles
from lavender.report.table import Table
from lavender.report.terminal import print_table

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class PageSection:
    """A heading with its tables, figures and lines to copy.

    Parameters
    ----------
    title, tables, figures, note : heading, tables, figures, note
    code : lines to copy
    short : number of rows of the first table that a terminal shows
    terminal_table : table that a terminal shows instead of the first rows of the first table
    """

    title: str
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()
    note: str = ""
    code: Sequence[str] = ()
    short: int = 0
    terminal_table: Table | None = None

    @property
    def is_shown(self) -> bool:
        """Whether the section has contents: a table with rows, a figure with curves, or lines to copy."""
        has_contents = any(t.rows for t in self.tables) or any(f.curves for f in self.figures)
        return has_contents or bool(self.code) or not (self.tables or self.figures)


@dataclass(frozen=True)
class SummaryPage:
    """A title, the sentence that summarises the page, sections, and numbers for programs.

    Parameters
    ----------
    title, head : title, summarising sentence
    sections : sections
    numbers : content of numbers.json
    stopped : whether the measurement ended early, so that all numbers describe only its completed part
    warning : a sentence on the measurement, such as a busy machine
    """

    title: str
    head: str
    sections: Sequence[PageSection]
    numbers: dict[str, Any]
    stopped: bool = False
    warning: str = ""

    def render_html(self, folder: Path | None = None) -> str:
        """Return one file without external parts; every text is escaped. With `folder`, also write figures there."""
        figures = [f for part in self.sections for f in part.figures if f.curves]
        styles = number_styles(list_solvers(figures))
        sections = [
            (part, draw_figures([f for f in part.figures if f.curves], styles, folder))
            for part in self.sections
            if part.is_shown
        ]
        template = create_environment().get_template("summary_page.html.j2")
        return str(template.render(title=self.title, page=self, sections=sections))

    def write(self, folder: str | os.PathLike[str]) -> Path:
        """Write `index.html`, `numbers.json` and `figures/*.svg`; return the path of the page."""
        folder = make_folder(folder)
        write_text(folder / "index.html", self.render_html(folder / "figures"))
        write_text(folder / "numbers.json", json.dumps(self.numbers, indent=1) + "\n")
        return folder / "index.html"

    def print_short(self, console: Console) -> None:
        """Print the sentence, lines to copy, and the first rows of each section's first table."""
        console.print(self.head, style="bold", highlight=False, markup=False)
        if self.warning:
            console.print(self.warning, style="yellow", highlight=False, markup=False)
        for part in self.sections:
            for line in part.code:
                console.print(f"    {line}", highlight=False, markup=False, soft_wrap=True)
            if part.code and part.note:
                console.print(part.note, highlight=False, markup=False)
            tables = [t.with_rows(part.short) for t in part.tables[:1]]
            for table in tables if part.terminal_table is None else [part.terminal_table]:
                if table.rows:
                    console.print()
                    print_table(console, table, cut=True)
