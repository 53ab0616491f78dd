"""A page of a few tables and figures under one sentence, its short form on a terminal, and its numbers as JSON."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lavender.io.stored import make_folder, write_text
from lavender.lab.report.curves import Figure
from lavender.lab.report.draw import save
from lavender.lab.report.page import environment
from lavender.lab.report.svg import svg
from lavender.lab.report.table import Table, print_table

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Part:
    """A heading and what stands under it."""

    title: str
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()
    note: str = ""
    code: Sequence[str] = ()  # lines to copy
    short: int = 0  # rows of the first table that a terminal shows

    @property
    def is_shown(self) -> bool:
        """Whether there is anything under the heading: tables without rows and figures without curves do not count."""
        filled = any(t.rows for t in self.tables) or any(f.curves for f in self.figures)
        return filled or bool(self.code) or not (self.tables or self.figures)


@dataclass(frozen=True)
class Sheet:
    """A title, the sentence that sums it up, parts, and the numbers for machines."""

    title: str
    head: str
    parts: Sequence[Part]
    numbers: dict[str, Any]
    stopped: bool = False  # before its end: all is of what was done until then

    def html(self) -> str:
        """One file that needs nothing else; every text is escaped."""
        names = list(dict.fromkeys(c.solver for part in self.parts for f in part.figures for c in f.curves))
        number = {name: i for i, name in enumerate(names)}
        shown = [part for part in self.parts if part.is_shown]
        parts = [(part, [svg(f, number, names) for f in part.figures if f.curves]) for part in shown]
        return str(environment().get_template("sheet.html.j2").render(sheet=self, parts=parts, number=number))

    def write(self, folder: str | os.PathLike[str]) -> Path:
        """`index.html`, `numbers.json` and `figures/*.svg, *.png`; the path of the page."""
        folder = make_folder(folder)
        write_text(folder / "index.html", self.html())
        write_text(folder / "numbers.json", json.dumps(self.numbers, indent=1) + "\n")
        save((f for part in self.parts for f in part.figures if f.curves), folder / "figures")
        return folder / "index.html"

    def show(self, console: Console) -> None:
        """The sentence, what is to be copied, and the first rows of each part's first table."""
        console.print(self.head, style="bold", highlight=False, markup=False)
        for part in self.parts:
            for line in part.code:
                console.print(f"    {line}", highlight=False, markup=False, soft_wrap=True)
            for table in part.tables[:1] if part.short else ():
                if table.rows:
                    console.print()
                    print_table(console, replace(table, rows=table.rows[: part.short]), cut=True)
