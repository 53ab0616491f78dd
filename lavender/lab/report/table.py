"""Define tables as data. Each output format has one writer of them.

These are `terminal`, `markdown`, `latex_export`, and the template `table.html.j2` for pages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

#: Heads of columns of words; all other columns have numbers.
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
    """

    text: str
    lead: str = ""
    after: str = ""
    more: str = ""
    title: str = ""
    link: str = ""
    value: float | None = None
    mark: str = ""

    def __str__(self) -> str:
        return f"{self.lead} {self.text}".strip() + self.after


@dataclass(frozen=True)
class Table:
    """Heads of columns and the cells of each row, a text or a `Cell`.

    Parameters
    ----------
    heads, rows : heads of the columns, cells of the rows
    marks : key of `COLOURS` for each row; empty without marks
    folds : whether cells have several words, which are wrapped in a narrow table
    words : heads of columns of words
    """

    heads: Sequence[str]
    rows: Sequence[Sequence[str | Cell]]
    marks: Sequence[str] = ()
    folds: bool = False
    words: frozenset[str] = field(default=WORDS, repr=False)

    @classmethod
    def of(cls, rows: Sequence[Mapping[str, str | Cell]], marks: Sequence[str] = ()) -> Table:
        """Create a table from rows that map the same heads to cells."""
        return cls(list(rows[0]) if rows else [], [list(row.values()) for row in rows], marks)

    def without(self, *heads: str) -> Table:
        """Return the table without some of its columns."""
        columns = [i for i, head in enumerate(self.heads) if head not in heads]
        rows = [[row[i] for i in columns] for row in self.rows]
        return Table([self.heads[i] for i in columns], rows, self.marks, self.folds, self.words)

    def is_number(self, head: str) -> bool:
        """Return whether a column has numbers, which are aligned to the right."""
        return not self.folds and head not in self.words

    @property
    def texts(self) -> list[list[str]]:
        """The text of each cell, as every format shows it."""
        return [[str(cell) for cell in row] for row in self.rows]

    @property
    def lines(self) -> list[tuple[list[Cell], bool]]:
        """Cells of each row, and whether the row is marked as bad."""
        marks = self.marks or [""] * len(self.rows)
        return [
            ([c if isinstance(c, Cell) else Cell(c) for c in row], mark == "bad")
            for row, mark in zip(self.rows, marks, strict=True)
        ]
