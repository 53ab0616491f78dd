"""A table as data, and its three forms in text: Markdown, LaTeX and a terminal's. The page has a macro for it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

#: Heads of columns that hold words; what stands under any other is a number.
WORDS = frozenset({
    "case", "solver", "status", "claim", "form", "structure", "law", "change", "asked", "hardest", "sequence",
    "message", "worst row", "reason", "residual by order", "recorded", "engine's own", "first here",
    "furthest off",
})  # fmt: skip
COLOURS = {"good": "green", "warn": "yellow", "bad": "red"}


@dataclass(frozen=True)
class Cell:
    """Text, and what a page can show of it besides."""

    text: str
    lead: str = ""  # a name before it
    after: str = ""  # behind it, quieter
    more: str = ""  # on the page alone, quieter still
    title: str = ""  # on the page, where the pointer rests
    link: str = ""  # part of the page
    value: float | None = None  # what the page sorts by
    mark: str = ""  # of `COLOURS`

    def __str__(self) -> str:
        return f"{self.lead} {self.text}".strip() + self.after


@dataclass(frozen=True)
class Table:
    """Heads of columns and the cells of each row, a text or a `Cell`."""

    heads: Sequence[str]
    rows: Sequence[Sequence[str | Cell]]
    marks: Sequence[str] = ()  # of each row, of `COLOURS`; none where it is empty
    folds: bool = False  # cells of several words, which fold where there is little room
    words: frozenset[str] = field(default=WORDS, repr=False)

    @classmethod
    def of(cls, rows: Sequence[Mapping[str, str | Cell]], marks: Sequence[str] = ()) -> Table:
        """Of rows that say their heads beside each cell, all the same ones."""
        return cls(list(rows[0]) if rows else [], [list(row.values()) for row in rows], marks)

    def without(self, *heads: str) -> Table:
        """The table without some of its columns."""
        kept = [i for i, head in enumerate(self.heads) if head not in heads]
        rows = [[row[i] for i in kept] for row in self.rows]
        return Table([self.heads[i] for i in kept], rows, self.marks, self.folds, self.words)

    def is_number(self, head: str) -> bool:
        """Its column is ruled to the right."""
        return not self.folds and head not in self.words

    @property
    def texts(self) -> list[list[str]]:
        """What every form shows."""
        return [[str(cell) for cell in row] for row in self.rows]

    @property
    def lines(self) -> list[tuple[list[Cell], bool]]:
        """Rows of the page, each with whether it is marked as bad."""
        marks = self.marks or [""] * len(self.rows)
        return [
            ([c if isinstance(c, Cell) else Cell(c) for c in row], mark == "bad")
            for row, mark in zip(self.rows, marks, strict=True)
        ]


# -- Markdown ----------------------------------------------------------------------------------------------


def markdown(table: Table) -> list[str]:
    """Lines of Markdown."""
    lines = ["| " + " | ".join(table.heads) + " |", "|---" * len(table.heads) + "|"]
    return lines + ["| " + " | ".join(map(plain, row)) + " |" for row in table.texts]


def plain(text: str) -> str:
    """Text on one line as Markdown and the HTML in it would show it, with no meaning of its own."""
    text = " ".join(text.split()).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"([\\`*\[\]|])", r"\\\1", text)


# -- LaTeX -------------------------------------------------------------------------------------------------

_SPECIAL = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "µ": r"$\mu$", "≈": r"$\approx$",
    "✗": r"$\times$", "–": "--", **{c: "\\" + c for c in "&%$#_{}"},
}  # fmt: skip


def tex(text: str) -> str:
    """Text as LaTeX prints it, with no meaning of its own."""
    made = re.sub(r"[\\~^&%$#_{}µ≈✗–]", lambda found: _SPECIAL[found[0]], " ".join(text.split()))
    return f"{{}}{made}" if made.startswith(("[", "*")) else made  # no argument of the line's end before it


def latex(table: Table, caption: str, label: str) -> str:
    """A floating table (booktabs)."""
    line = " & ".join
    body = "".join(f"{line(map(tex, row))} \\\\\n" for row in table.texts)
    return (
        f"\\begin{{table}}\n\\centering\n\\caption{{{tex(caption)}}}\n\\label{{tab:{label}}}\n"
        f"\\begin{{tabular}}{{l{'r' * (len(table.heads) - 1)}}}\n\\toprule\n{line(map(tex, table.heads))} \\\\\n"
        f"\\midrule\n{body}\\bottomrule\n\\end{{tabular}}\n\\end{{table}}\n"
    )


# -- a terminal --------------------------------------------------------------------------------------------


def print_table(console: Console, table: Table, grouped: bool = False, cut: bool = False) -> None:
    """Within the terminal: nothing is cut, or, with `cut`, what stands first, so that a row is a line.

    Where a table is wider its cells fold; one that `folds` becomes a line for each cell under the first of its row.
    `grouped` says what stands first only where it is another than in the row above, and parts such groups. Texts are
    taken as they are: names of files and messages hold no markup of ours.
    """
    from rich.table import Table as RichTable
    from rich.text import Text

    made = RichTable(box=None, pad_edge=False, header_style="bold")
    for head in table.heads:
        made.add_column(
            Text(head), justify="right" if table.is_number(head) else "left", no_wrap=not table.folds
        )
    made.columns[0].no_wrap = not (table.folds or cut)  # where there is little room it gives way
    before = ""
    for i, row in enumerate(table.rows):
        cells = [Text(str(c), style=COLOURS.get(c.mark, "") if isinstance(c, Cell) else "") for c in row]
        if cut:
            cells[0].no_wrap, cells[0].overflow = True, "ellipsis"
        first = str(row[0])
        if grouped and first == before:
            cells[0] = Text("")
        elif grouped and before:
            made.add_section()
        made.add_row(*cells, style=COLOURS.get(table.marks[i], "") if table.marks else "")
        before = first
    wide = console.measure(made, options=console.options.update(width=100_000)).maximum > console.width
    if wide and table.folds and not cut:
        room = max(map(len, table.heads[1:]))
        for name, *cells_of in table.texts:
            console.print(name, highlight=False, markup=False)
            for head, text in zip(table.heads[1:], cells_of, strict=True):
                console.print(f"  {head:<{room}}  {text}", highlight=False, markup=False)
        return
    if wide and not cut:
        for column in made.columns:
            column.no_wrap, column.overflow = False, "fold"
    console.print(made, highlight=False)
