"""Define tables of texts, which the terminal, pages and Markdown show.

All times of a table have one unit, and all sizes of a table have one format.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from lavender.report.text import NONE, format_sizes, format_times_in_one_unit

#: Heads of the columns that contain words; all other columns contain numbers.
WORDS = frozenset({"case", "solver", "status", "structure", "target", "message", "worst row", "reason"})


@dataclass(frozen=True)
class Cell:
    """A number that a table formats like its other times [s] (`time`), or like its other numbers (`size`)."""

    value: float
    quantity: str

    @classmethod
    def time(cls, value: float) -> Cell:
        """Create the cell of a time [s]."""
        return cls(value, "time")

    @classmethod
    def size(cls, value: float) -> Cell:
        """Create the cell of a number of any magnitude; the table chooses its format."""
        return cls(value, "size")


@dataclass(frozen=True)
class Table:
    """Heads of columns, and the cells of each row: texts, after initialisation."""

    heads: Sequence[str]
    rows: Sequence[Sequence[str | Cell]]
    words: frozenset[str] = field(default=WORDS, repr=False)  # Heads of the columns that contain words.

    def __post_init__(self) -> None:
        """Write all times in one unit, which the heads name, and all sizes in one format."""
        heads, rows = list(self.heads), [list(row) for row in self.rows]
        cells = [(row, i, c) for row in rows for i, c in enumerate(row) if isinstance(c, Cell)]
        times, sizes = ([x for x in cells if x[2].quantity == name] for name in ("time", "size"))
        unit, texts = format_times_in_one_unit([cell.value for _, _, cell in times])
        for (row, i, _), text in zip(times, texts, strict=True):
            row[i] = text
        for i in {i for _, i, _ in times}:
            heads[i] = f"{heads[i]} [{unit}]"
        for (row, i, _), text in zip(sizes, format_sizes([cell.value for _, _, cell in sizes]), strict=True):
            row[i] = text
        object.__setattr__(self, "heads", heads)
        object.__setattr__(self, "rows", rows)

    @classmethod
    def from_frame(cls, frame: Any) -> Table:
        """Create a table from a DataFrame: columns of floats with the unit [s] are times, with another unit sizes."""
        heads: list[str] = []
        columns: list[list[str | Cell]] = []
        words: set[str] = set()
        for head, values in frame.items():
            name, kind = str(head), values.dtype.kind
            is_time = kind == "f" and name.endswith(" [s]")
            heads.append(name.removesuffix(" [s]") if is_time else name)
            words |= set() if kind in "iuf" else {heads[-1]}
            if is_time:
                columns.append([Cell.time(float(x)) for x in values])
            elif kind == "f" and name.endswith(("[-]", "[m/s]", "[√J]")):
                columns.append([Cell.size(float(x)) for x in values])
            else:
                columns.append([NONE if x != x else f"{x:g}" if kind == "f" else str(x) for x in values])
        return cls(heads, [list(row) for row in zip(*columns, strict=True)], words=frozenset(words))

    def without_columns(self, *heads: str) -> Table:
        """Return the table without some of its columns."""
        columns = [i for i, head in enumerate(self.heads) if head not in heads]
        rows = [[row[i] for i in columns] for row in self.rows]
        return Table([self.heads[i] for i in columns], rows, self.words)

    def with_rows(self, n: int) -> Table:
        """Return the table with its first n rows."""
        return replace(self, rows=self.rows[:n])

    def is_numeric_column(self, head: str) -> bool:
        """Return whether a column has numbers, which are aligned to the right."""
        return head not in self.words

    @property
    def cell_texts(self) -> list[list[str]]:
        """The text of each cell, as every format shows it."""
        return [[str(cell) for cell in row] for row in self.rows]

    def format_markdown(self) -> list[str]:
        """Return the lines of the table in Markdown."""
        lines = ["| " + " | ".join(self.heads) + " |", "|---" * len(self.heads) + "|"]
        return lines + ["| " + " | ".join(map(escape_markdown, row)) + " |" for row in self.cell_texts]


def escape_markdown(text: str) -> str:
    """Return a text on one line, with Markdown and HTML in it escaped."""
    text = " ".join(text.split()).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"([\\`*\[\]|])", r"\\\1", text)
