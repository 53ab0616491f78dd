"""Define tables as data, independent of the output format.

The modules `terminal` and `markdown`, and the template `table.html.j2` for pages, write them. All
times of a table have one unit, and all sizes of a column have one format.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from lavender.report.text import format_sizes, format_times_in_one_unit

#: Heads of the columns that contain words; all other columns contain numbers.
WORDS = frozenset({
    "case", "solver", "status", "claim", "form", "structure", "law", "change", "target", "hardest", "sequence",
    "message", "worst row", "reason", "residual by order", "recorded", "engine's own", "first here",
    "furthest off",
})  # fmt: skip
COLOURS = {"good": "green", "warn": "yellow", "bad": "red"}


@dataclass(frozen=True)
class Cell:
    """The text of a cell, and additions that a page can show.

    Parameters
    ----------
    text, lead, after : text, name before it, remark after it
    more : further remark, only on the page
    title : text that the page shows while the pointer is on the cell
    link : id of the part of the page that the cell links to
    value : number by which the page sorts
    mark : key of `COLOURS`
    quantity : "time" [s] or "size"; the table then formats `value` like its other times, or like the column's other
    sizes
    """

    text: str
    lead: str = ""
    after: str = ""
    more: str = ""
    title: str = ""
    link: str = ""
    value: float | None = None
    mark: str = ""
    quantity: str = ""

    @classmethod
    def time(cls, value: float, after: str = "", **more: Any) -> Cell:
        """Create the cell of a time [s]."""
        return cls("", after=after, value=value, quantity="time", **more)

    @classmethod
    def size(cls, value: float, **more: Any) -> Cell:
        """Create the cell of a number of any magnitude; the column chooses its format."""
        return cls("", value=value, quantity="size", **more)

    def __str__(self) -> str:
        return f"{self.lead} {self.text}".strip() + self.after


def _get_cell_value(cell: Cell) -> float:
    return math.nan if cell.value is None else cell.value


@dataclass(frozen=True)
class Table:
    """Heads of columns and the cells of each row, a text or a `Cell`.

    Parameters
    ----------
    heads, rows : heads of the columns, cells of the rows
    marks : key of `COLOURS` for each row; empty without marks
    folds : whether cells contain several words, so that a narrow terminal shows each cell on a line of its own
    words : heads of the columns that contain words
    """

    heads: Sequence[str]
    rows: Sequence[Sequence[str | Cell]]
    marks: Sequence[str] = ()
    folds: bool = False
    words: frozenset[str] = field(default=WORDS, repr=False)

    def __post_init__(self) -> None:
        """Write all times in one unit, which the heads name, and the sizes of each column in one format."""
        heads, rows = list(self.heads), [list(row) for row in self.rows]
        cells = [(row, i, c) for row in rows for i, c in enumerate(row) if isinstance(c, Cell) and c.quantity]
        times = [entry for entry in cells if entry[2].quantity == "time"]
        unit, texts = format_times_in_one_unit([_get_cell_value(cell) for _, _, cell in times])
        for (row, i, cell), text in zip(times, texts, strict=True):
            row[i] = replace(cell, text=text, quantity="")
        for i in {i for _, i, _ in times}:
            heads[i] = f"{heads[i]} [{unit}]"
        for column in {i for _, i, cell in cells if cell.quantity == "size"}:
            sizes = [(row, cell) for row, i, cell in cells if i == column]
            for (row, cell), text in zip(
                sizes, format_sizes([_get_cell_value(c) for _, c in sizes]), strict=True
            ):
                row[column] = replace(cell, text=text, quantity="")
        object.__setattr__(self, "heads", heads)
        object.__setattr__(self, "rows", rows)

    @classmethod
    def from_rows(cls, rows: Sequence[Mapping[str, str | Cell]], marks: Sequence[str] = ()) -> Table:
        """Create a table from rows that map the same heads to cells."""
        return cls(list(rows[0]) if rows else [], [list(row.values()) for row in rows], marks)

    def without_columns(self, *heads: str) -> Table:
        """Return the table without some of its columns."""
        columns = [i for i, head in enumerate(self.heads) if head not in heads]
        rows = [[row[i] for i in columns] for row in self.rows]
        return Table([self.heads[i] for i in columns], rows, self.marks, self.folds, self.words)

    def is_numeric_column(self, head: str) -> bool:
        """Return whether a column has numbers, which are aligned to the right."""
        return not self.folds and head not in self.words

    @property
    def cell_texts(self) -> list[list[str]]:
        """The text of each cell, as every format shows it."""
        return [[str(cell) for cell in row] for row in self.rows]

    @property
    def marked_rows(self) -> list[tuple[list[Cell], bool]]:
        """Cells of each row, and whether the row is marked as bad."""
        marks = self.marks or [""] * len(self.rows)
        return [
            ([c if isinstance(c, Cell) else Cell(c) for c in row], mark == "bad")
            for row, mark in zip(self.rows, marks, strict=True)
        ]
