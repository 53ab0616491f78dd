"""Keep tables of texts for `lavender.audit` until it uses DataFrames and `lavender.report.render`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from lavender.report.text import format_sizes, format_times_in_one_unit

if TYPE_CHECKING:
    from rich.console import Console


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
        """Create the cell of a number of any magnitude."""
        return cls(value, "size")


@dataclass(frozen=True)
class Table:
    """Heads of columns, and the cells of each row: texts, after initialisation."""

    heads: Sequence[str]
    rows: Sequence[Sequence[str | Cell]]
    words: frozenset[str] = field(default=frozenset(), repr=False)

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

    def without_columns(self, *heads: str) -> Table:
        """Return the table without some of its columns."""
        columns = [i for i, head in enumerate(self.heads) if head not in heads]
        rows = [[row[i] for i in columns] for row in self.rows]
        return Table([self.heads[i] for i in columns], rows)

    @property
    def cell_texts(self) -> list[list[str]]:
        """The text of each cell, as every format shows it."""
        return [[str(cell) for cell in row] for row in self.rows]

    @property
    def frame(self) -> Any:
        """The texts as a DataFrame."""
        import pandas as pd

        return pd.DataFrame(self.cell_texts, columns=list(self.heads), dtype=object)


def print_table(console: Console, table: Table, optional: Sequence[str] = ()) -> None:
    """Print the texts of a table."""
    from lavender.report import render

    render.print_table(console, table.frame, optional=optional)
