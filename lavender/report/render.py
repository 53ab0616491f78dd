"""Show DataFrames: `print_table` and `print_page` on a terminal, `render_page` as HTML, `write_files` in a folder.

A command describes its result once, as sentences (`Statement`) and sections (`Section`) of DataFrames and figures:

    sections = [Section("Errors", [frame], note="Errors above their floor.", figures=[figure], short=4)]
    statements = [Statement("3 of 200 steps stopped early.")]
    print_page(console, statements, sections)
    page = render_page("Audit", statements, sections, folder=folder / "figures")
    write_files(folder, {"index.html": page, "numbers.json": numbers, "tables/errors.csv": frame})

A frame holds numbers, and the names of its columns hold their units, which decide how `format_cells` writes them:

- floats under "... [s]" are times: all times of a frame get one unit, s, ms or µs, with three digits,
- floats under another unit, such as "[m/s]", "[√J]" or "[-]", are sizes: all sizes of a frame get one format,
  with two digits and an exponent if one of them needs it,
- other floats, such as a percentage under "[%]", are written with up to six digits,
- missing numbers are dashes; texts stay as they are. Texts that consist of a number with "%" or "times" are aligned
  like numbers.

Rows with a text that contains "✗" are marked on every output. Columns without texts and numbers are left out.
"""

from __future__ import annotations

import functools
import json
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from lavender.base.errors import require_packages
from lavender.report.text import (
    NONE,
    escape_markdown,
    escape_unprintable,
    format_sizes,
    format_times_in_one_unit,
    make_file_name,
)

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Console
    from rich.table import Table as Grid

    from lavender.report.figures import Figure

MAX_ROWS = 500  # Largest number of rows of a table on a page and in Markdown; files have all rows.
MIN_HEAD_WIDTH = 8  # [columns] Heads do not fold at a smaller width.
MIN_WORD_WIDTH = 9  # [columns] A column of words does not become narrower: "CONVERGED".
#: Matches texts that are aligned like numbers, to the right.
NUMBER_CELL = re.compile(r"|–|[-+]?(?:\d[\d.]*(?:e[-+]?\d+)?|inf|nan)(?: %| times)?")
#: Matches texts that are not broken across lines: a number with exponent or unit, a unit in brackets, or an option.
NUMBER = re.compile(
    r"(?<![\w.])\d[\d.]*(?:e-?\d+(?:\s(?:m/s|N\ss|√J))?|\s(?:µs|ms|s|m/s|rad/s|N\ss|√J|%|times|iterations?|sweeps?))"
    r"(?!\w)|(?<![\w-])--[a-z][a-z-]*|\[[^\]]{1,24}\]|(?<![\w-])[a-z_]{2,}=[\w.+-]+"
)


class Statement(NamedTuple):
    """A sentence, and the lines of Python that it describes."""

    text: str
    code: Sequence[str] = ()

    @property
    def call_line(self) -> str:
        """The line of `code` with the call, without the lines of a loop around it; empty if there is no code."""
        return next((line.strip() for line in self.code if "lv.solve" in line), "")


class Section(NamedTuple):
    """A heading with its tables, figures and lines to copy.

    Parameters
    ----------
    title : str
    frames : DataFrames of numbers with units in the names of their columns
    note : meaning of the numbers, one paragraph in each line
    figures : figures, drawn on the page only
    code : lines to copy
    short : number of rows of the first frame that a terminal shows
    short_frame : DataFrame that a terminal shows instead of these rows
    name : name as a file and as the target of a link; by default made from the title
    """

    title: str
    frames: Sequence[pd.DataFrame] = ()
    note: str = ""
    figures: Sequence[Figure] = ()
    code: Sequence[str] = ()
    short: int = 0
    short_frame: pd.DataFrame | None = None
    name: str = ""

    @property
    def is_shown(self) -> bool:
        """Whether the section has contents: a table with rows, a figure with curves, lines to copy, or only a note."""
        has_contents = any(map(len, self.frames)) or any(f.curves for f in self.figures)
        return has_contents or bool(self.code) or not (self.frames or self.figures)


# -- tables ------------------------------------------------------------------------------------------------


def format_cells(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the texts of a frame's cells under heads with the units of its times, without empty columns."""
    heads = list(map(str, frame.columns))
    columns = [values.tolist() for _, values in frame.items()]
    is_float = [values.dtype.kind == "f" for _, values in frame.items()]
    times = [i for i, head in enumerate(heads) if is_float[i] and head.endswith(" [s]")]
    sizes = [
        i for i, head in enumerate(heads) if is_float[i] and re.search(r"\[[^%]+\]$", head) and i not in times
    ]
    texts = [[_format_cell(x, is_float[i]) for x in column] for i, column in enumerate(columns)]
    unit, texts_of_times = format_times_in_one_unit([x for i in times for x in columns[i]])
    texts_of_sizes, n = format_sizes([x for i in sizes for x in columns[i]]), len(frame)
    for group, written in ((times, texts_of_times), (sizes, texts_of_sizes)):
        for k, i in enumerate(group):
            texts[i] = written[k * n : (k + 1) * n]
    heads = [f"{h.removesuffix(' [s]')} [{unit}]" if i in times else h for i, h in enumerate(heads)]
    import pandas as pd

    shown = [i for i in range(len(heads)) if not n or {*texts[i]} - {"", NONE}]
    return pd.DataFrame({heads[i]: texts[i] for i in shown}, dtype=object)


def _format_cell(value: Any, is_float: bool) -> str:
    """Return the text of a cell that is neither a time nor a size."""
    if value is None or value != value:
        return NONE
    return f"{value:g}" if is_float else escape_unprintable(str(value))


def list_number_heads(texts: pd.DataFrame) -> set[str]:
    """Return the heads of the columns that are aligned to the right: those with numbers only."""
    return {head for head, cells in texts.items() if all(map(NUMBER_CELL.fullmatch, cells)) and any(cells)}


def format_markdown(frame: pd.DataFrame) -> list[str]:
    """Return the lines of a table in Markdown, with its first `MAX_ROWS` rows."""
    texts = format_cells(frame.head(MAX_ROWS))
    lines = ["| " + " | ".join(texts) + " |", "|---" * texts.shape[1] + "|"]
    return lines + ["| " + " | ".join(map(escape_markdown, row)) + " |" for row in texts.to_numpy().tolist()]


def print_table(
    console: Console, frame: pd.DataFrame, grouped: bool = False, cut: bool = False,
    optional: Sequence[str] = (),
) -> None:  # fmt: skip
    """Print a frame within the width of the terminal. Its texts are not read as markup.

    In a table that is too wide, heads and words fold and numbers stay whole. If that is not enough, each cell becomes
    a line below the first cell of its row; with `cut`, the last columns are left out instead. Before that, the columns
    `optional` of the frame are left out one by one; then the words of the first column stay whole, too. `grouped`
    shows the first cell only if it differs from the row above, and separates such groups.
    """
    left_out = [head for head in optional if head in frame]
    texts = format_cells(frame)
    while True:
        grid = _make_grid(texts, grouped)
        width = console.measure(grid, options=console.options.update(width=100_000)).maximum
        if width <= console.width or _fold_words(grid, texts, bool(optional)) <= console.width:
            console.print(grid, highlight=False)
            return
        if left_out:
            frame = frame.drop(columns=left_out.pop(0))
            texts = format_cells(frame)
        elif cut and texts.shape[1] > 2:
            texts = texts.iloc[:, :-1]
        else:
            break
    width = max(map(len, texts.columns[1:]), default=0)
    for name, *row in texts.to_numpy().tolist():
        console.print(name, highlight=False, markup=False)
        for head, text in zip(texts.columns[1:], row, strict=True):
            console.print(f"  {head:<{width}}  {text}", highlight=False, markup=False)


def _make_grid(texts: pd.DataFrame, grouped: bool) -> Grid:
    """Make rich's table, in which no text folds."""
    from rich.table import Table as Grid
    from rich.text import Text

    grid, numbers = Grid(box=None, pad_edge=False, header_style="bold"), list_number_heads(texts)
    for head in texts:
        grid.add_column(Text(head), justify="right" if head in numbers else "left", no_wrap=True)
    above = ""
    for row in texts.to_numpy().tolist():
        cells = [Text(text) for text in row]
        if grouped and row[0] == above:
            cells[0] = Text("")
        elif grouped and above:
            grid.add_section()
        grid.add_row(*cells, style="red" if any("✗" in text for text in row) else "")
        above = row[0]
    return grid


def _fold_words(grid: Grid, texts: pd.DataFrame, whole_first: bool = False) -> int:
    """Let heads and columns of words fold, and return the smallest width at which numbers stay whole.

    With `whole_first` the words of the first column stay whole, too.
    """
    from rich.text import Text

    width, numbers = 2 * (texts.shape[1] - 1), list_number_heads(texts)
    for i, (column, (head, cells)) in enumerate(zip(grid.columns, texts.items(), strict=True)):
        if head in numbers:
            lines = textwrap.wrap(head, max(map(len, ["x" * MIN_HEAD_WIDTH, *cells, *head.split()])))
            smallest = max(map(len, [*cells, *lines]))
            column.header = Text("\n".join(lines))
        else:
            smallest = max((len(word) for text in (head, *cells) for word in text.split()), default=1)
            if whole_first and not i:
                column.width = smallest  # Rich narrows other columns only, so that none exceeds the terminal.
            smallest = column.width or min(MIN_WORD_WIDTH, smallest)
            column.min_width, column.no_wrap, column.overflow = smallest, False, "fold"
        width += smallest
    return width


# -- pages -------------------------------------------------------------------------------------------------


def print_page(
    console: Console, statements: Sequence[Statement], sections: Sequence[Section],
    warnings: Sequence[str] = (),
) -> None:  # fmt: skip
    """Print the short form of a page: sentences, warnings, lines to copy, and rows of each section's first table."""
    for i, statement in enumerate(statements):
        console.print(statement.text, style="" if i else "bold", highlight=False, markup=False)
    for text in warnings:
        console.print(text, style="yellow", highlight=False, markup=False)
    for section in sections:
        for line in section.code:
            console.print(f"    {line}", highlight=False, markup=False, soft_wrap=True)
        if section.code and section.note:
            console.print(section.note, highlight=False, markup=False)
        rows = section.frames[0].head(section.short) if section.frames else None
        frame = rows if section.short_frame is None else section.short_frame
        if frame is not None and len(frame):
            console.print()
            print_table(console, frame, cut=True)


def render_page(
    title: str, statements: Sequence[Statement], sections: Sequence[Section], *, warnings: Sequence[str] = (),
    first_figure: Figure | None = None, folded: bool = False, folder: Path | None = None,
) -> str:  # fmt: skip
    """Return a page as one HTML file without external parts, for dark and light themes, phones and print.

    Parameters
    ----------
    title : str
    statements : sentences at the top, the first one in large letters, with their lines to copy
    sections : sections; one without contents is left out
    warnings : sentences below the statements, in the colour of warnings
    first_figure : figure next to the statements
    folded : whether the sections are folded, and unfold by a click; the solvers of figures then have fixed colours
    folder : folder to which each figure is also written as an SVG file, to which the page does not refer

    Every text is escaped.
    """
    from lavender.report.figures import assign_styles, draw_figure, number_styles

    shown = [section for section in sections if section.is_shown]
    first = [] if first_figure is None else [first_figure]
    every = [*first, *(f for section in shown for f in section.figures if f.curves)]
    solvers = list(dict.fromkeys(curve.solver for figure in every for curve in figure.curves))
    styles = (assign_styles if folded else number_styles)(solvers)
    drawn = [draw_figure(figure, styles, folder) for figure in first]
    parts = [
        (s, map(render_table, s.frames), [draw_figure(f, styles, folder) for f in s.figures if f.curves])
        for s in shown
    ]
    return str(
        _get_template().render(
            title=title, statements=statements, warnings=warnings, parts=parts, folded=folded,
            first="".join(drawn),
        )
    )  # fmt: skip


def render_table(frame: pd.DataFrame) -> str:
    """Return the first `MAX_ROWS` rows of a frame as an HTML table, which a reader can sort by each column."""
    texts = format_cells(frame.head(MAX_ROWS))
    numbers = list_number_heads(texts)
    formatters: dict[str, Callable[[str], str]] = {
        head: _mark_number if head in numbers else _mark_text for head in texts
    }
    heads = {head: (_mark_number if head in numbers else keep_numbers_together)(head) for head in texts}
    texts = texts.apply(lambda column: column.map(formatters[column.name])).rename(columns=heads)
    import pandas as pd

    with pd.option_context("display.max_colwidth", None):
        table = texts.to_html(index=False, escape=False, border=0, classes="sortable", justify="unset")
    return re.sub(r"(?<=\n) +| style=\"text-align: unset;\"", "", table) if len(texts) else ""


def _mark_number(text: str) -> str:
    """Return escaped HTML of a text that is aligned to the right."""
    from html import escape

    return f'<span class="n">{escape(text)}</span>'


def _mark_text(text: str) -> str:
    """Return escaped HTML of a text, marked if it contains ✗."""
    html = str(keep_numbers_together(text))
    return f'<span class="bad">{html}</span>' if "✗" in text else html


def keep_numbers_together(text: str) -> Any:
    """Return escaped HTML in which each number stays on one line with its exponent and unit."""
    from jinja2.filters import do_forceescape, do_mark_safe

    return do_mark_safe(NUMBER.sub(r'<span class="v">\g<0></span>', str(do_forceescape(text))))


@functools.cache
def _get_template() -> Any:
    """Compile the template, once."""
    require_packages("the page of a report", "jinja2")
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("lavender.report"), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters.update(anchor=make_file_name, numbers=keep_numbers_together)
    environment.globals.update(max_rows=MAX_ROWS)
    return environment.get_template("page.html.j2")


def write_files(
    folder: str | Path, files: Mapping[str, Any], begin: Callable[[str], object] = lambda name: None
) -> Path:
    """Write each entry of `files` to its path in a folder: texts as they are, frames and data by the path's suffix.

    A frame becomes .csv or .tex, other data .json. A file is replaced only when the new one is complete.

    Parameters
    ----------
    folder : path
    files : {path in the folder: text, DataFrame, JSON data, or function that returns one of these}
    begin : function that is called with each path before its file is written

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError
        The folder cannot be written.
    """
    from lavender.io.stored import make_folder, write_text

    folder = make_folder(folder)
    for name, content in files.items():
        begin(name)
        content = content() if callable(content) else content
        path = make_folder((folder / name).parent) / Path(name).name
        if path.suffix == ".csv":
            write_text(path, content.to_csv(index=False))
        elif path.suffix == ".tex":
            write_text(path, content.to_latex(index=False, escape=True, float_format="%.3g"))
        else:
            write_text(path, content if isinstance(content, str) else json.dumps(content, indent=1) + "\n")
    return folder
