"""Pages of results: one HTML file without scripts or external parts, and its short form for a terminal.

A page begins with the answer: a sentence, at most three more, and lines to copy. Figures and tables follow, and folded
parts with all details. A block of a page is HTML (`Markup`), or a dictionary with one of these keys:

    pair     two lists of blocks, side by side on a wide screen
    folded   list of blocks below a `title`, `open` or not
    code     lines to copy
    bar      (percentage, colour) of the parts of a stacked bar, with the description `alt`
    rows     lines of a table, with `title`, `small`, `note`, `key`, `classes`, `heads` and `foot`; a cell is a text or
             (text, classes, title), and {"group": text, "span": columns} is a line between groups
    note     a paragraph

Every text but `Markup` is escaped.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from lavender.base.errors import InputError, require_packages
from lavender.base.lazy_import import markupsafe
from lavender.base.lazy_import import pandas as pd
from lavender.report.render import format_cells, list_number_heads

if TYPE_CHECKING:
    from rich.console import Console

# [m/s, rad/s on angular rows] Pages compare with this velocity error if none is given.
DEFAULT_ERROR_LIMIT = 1e-3
# Columns of the LaTeX table, which may have tolerances, too.
PAPER_COLUMNS = ("solved", "ratio", "slowest", "accepted", "false")
MAX_ROWS = 500  # Largest number of rows of a table on a page; files have all rows.


@dataclass
class Page:
    """Contents of a page."""

    title: str  # Name of the command.
    source: str  # Command, input and its size.
    verdict: str  # The answer in one sentence, with its size in the user's unit.
    sentences: Sequence[str] = ()  # Up to three sentences on the answer.
    code: Sequence[str] = ()  # Lines to copy.
    # Result of a comparison with a limit, shown before the verdict.
    mark: str = ""
    is_bad: bool = False
    alarms: Sequence[str] = ()  # Sentences on wrong results, shown first.
    warnings: Sequence[str] = ()  # Sentences on conditions on which shown numbers depend.
    blocks: Sequence[Any] = ()  # Blocks as the module describes them.
    footer: Sequence[Any] = field(
        default_factory=list
    )  # Files, versions, machine, date and command.

    def render(self) -> str:
        """Return the page as HTML."""
        require_packages("a page of results", "jinja2")
        import jinja2

        environment = jinja2.Environment(
            loader=jinja2.PackageLoader("lavender.report"),
            autoescape=True,
            undefined=jinja2.StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        return environment.get_template("page.html.j2").render(page=self)

    def print_head(self, console: Console) -> None:
        """Print the verdict, the sentences, the lines to copy and the warnings."""
        for text, style in (
            (f"{self.mark} {self.verdict}".strip(), "bold"),
            *((text, "bold red") for text in self.alarms),
            *((text, "") for text in self.sentences),
            *((f"    {line}", "") for line in self.code),
            *((text, "yellow") for text in self.warnings),
        ):
            text = text.replace("\u00a0", " ").replace(
                "\u202f", ""
            )  # Units do not break on a page only.
            console.print(
                text, style=style, highlight=False, markup=False, soft_wrap=text.startswith("    ")
            )


def check_columns(columns: Sequence[str], known: Sequence[str] = ()) -> None:
    """Raise InputError unless columns of the LaTeX table are of `known`; without it, `PAPER_COLUMNS` or numbers."""
    for name in columns:
        is_tolerance = re.fullmatch(r"[0-9.]+(e-?[0-9]+)?", name) and not known
        if not is_tolerance and name not in (known or PAPER_COLUMNS):
            names = ", ".join(known or (*PAPER_COLUMNS, "a tolerance such as 1e-6"))
            raise InputError(f"the table has no column {name!r}; columns are {names}")


def make_table(
    rows: Sequence[Any],
    heads: Sequence[Any] = (),
    *,
    title: str = "",
    small: str = "",
    note: str = "",
    key: Sequence[tuple[str, str]] = (),
    classes: str = "",
    foot: Sequence[Any] = (),
) -> dict[str, Any]:
    """Make the block of a table as the module describes it."""
    return {
        "rows": rows,
        "heads": heads,
        "title": title,
        "small": small,
        "note": note,
        "key": key,
        "classes": classes,
        "foot": foot,
    }


def make_shares(
    parts: Sequence[tuple[str, str, float, Sequence[str], str]], alt: str = "", **more: Any
) -> list[dict[str, Any]]:
    """Make the blocks of a table of parts and a stacked bar of their shares.

    `parts` are (name, colour, share of 1, cells, classes); `alt` begins the description of the bar.
    """
    swatch = markupsafe.Markup('<span class="swatch" style="background:{}"></span> {}')
    rows = [
        [(text, css, "") for text in (swatch.format(color, name), *cells)]
        for name, color, _, cells, css in parts
    ]
    bar = [(f"{100.0 * share:.2f}", color) for _, color, share, _, _ in parts if share]
    alt += ", ".join(f"{name} {cells[-1]}" for name, _, _, cells, _ in parts)
    return [make_table(rows, classes="full", **more), {"bar": bar, "alt": alt}]


def tabulate_frame(frame: pd.DataFrame, is_grouped: bool = False, **more: Any) -> dict[str, Any]:
    """Make the block of a table with the first `MAX_ROWS` rows of a frame, as `format_cells` writes them.

    With `is_grouped`, equal first cells of consecutive rows become one line above these rows.
    """
    texts = format_cells(frame.head(MAX_ROWS))
    numbers = list_number_heads(texts)
    rows = list[Any]()
    is_grouped = is_grouped and bool(texts.shape[1] > 1)
    first = int(is_grouped)
    group = None
    for row in texts.to_numpy().tolist():
        if is_grouped and row[0] != group:
            group = row[0]
            rows.append({"group": group, "span": texts.shape[1] - 1})
        rows.append(row[first:])
    heads = list(texts)[first:]
    # The style sheet aligns the text columns of a table; classes of cells would double the size of a page.
    classes = " ".join(f"t{i}" for i, head in enumerate(heads, 1) if head not in numbers)
    return make_table(rows, heads, classes=classes, **more)


def fold_table(
    title: str, frame: pd.DataFrame, note: str = "", is_open: bool = False, is_grouped: bool = False
) -> dict[str, Any]:
    """Make a folded block with the table of a frame."""
    more = (
        f" The first {MAX_ROWS} of {len(frame)} rows; the file has all."
        if len(frame) > MAX_ROWS
        else ""
    )
    table = tabulate_frame(frame, is_grouped, note=f"{note}{more}".strip())
    return {"folded": [table], "title": title, "open": is_open}
