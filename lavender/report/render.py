"""Write DataFrames as texts: cells with units, tables of a terminal and of Markdown, and files of a folder.

A frame holds numbers, and the names of its columns hold their units, which decide how `format_cells` writes them:

- floats under "... [s]" are times: all times of a frame get one unit, s, ms or µs, with three digits,
- floats under another unit, such as "[m/s]", "[√J]" or "[-]", are sizes: all sizes of a frame get one format,
  with two digits and an exponent if one of them needs it,
- other floats, such as a percentage under "[%]", are written with up to six digits,
- missing numbers are dashes; texts stay as they are. Texts that consist of a number with a unit are aligned like
  numbers.

Columns without texts and numbers are left out.
"""

from __future__ import annotations

import json
import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lavender.base.lazy_import import pandas as pd
from lavender.report.text import NONE, escape_unprintable, format_sizes, format_times_in_one_unit

if TYPE_CHECKING:
    from rich.console import Console

MAX_PIPED_WIDTH = 120  # [columns] Largest width of a table in a file or pipe.
MIN_HEAD_WIDTH = 8  # [columns] Heads do not fold at a smaller width.
MAX_WORD_WIDTH = (
    24  # [columns] A column of words becomes as narrow as its longest word, or as this width.
)
#: Matches texts that are aligned like numbers, to the right.
NUMBER_CELL = re.compile(
    r"|–|[-+]?(?:\d[\d.\u202f]*(?:e[-+]?\d+)?|inf|nan)"
    r"(?:[ \u00a0](?:%|times|[mµ]?s|[mµ]?m/s|[mµ]?rad/s))?|\d+/\d+"
)


def format_cells(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the texts of a frame's cells under heads with the units of its times, without empty columns."""
    heads = list(map(str, frame.columns))
    columns = [values.tolist() for _, values in frame.items()]
    is_float = [values.dtype.kind == "f" for _, values in frame.items()]
    times = [i for i, head in enumerate(heads) if is_float[i] and head.endswith(" [s]")]
    sizes = [i for i, head in enumerate(heads) if is_float[i] and re.search(r"\[[^%]+\]$", head)]
    sizes = [i for i in sizes if i not in times]

    def write(x: Any, number: bool) -> str:
        if x is None or x != x or x in (math.inf, -math.inf):
            return NONE
        return f"{x:g}" if number else escape_unprintable(str(x))

    texts = [
        [write(x, number) for x in column] for column, number in zip(columns, is_float, strict=True)
    ]
    unit, texts_of_times = format_times_in_one_unit([x for i in times for x in columns[i]])
    texts_of_sizes = format_sizes([x for i in sizes for x in columns[i]])
    n = len(frame)
    for group, written in ((times, texts_of_times), (sizes, texts_of_sizes)):
        for k, i in enumerate(group):
            texts[i] = written[k * n : (k + 1) * n]
    heads = [f"{h.removesuffix(' [s]')} [{unit}]" if i in times else h for i, h in enumerate(heads)]
    shown = [i for i in range(len(heads)) if not n or {*texts[i]} - {"", NONE}]
    return pd.DataFrame({heads[i]: texts[i] for i in shown}, dtype=object)


def list_number_heads(texts: pd.DataFrame) -> set[str]:
    """Return the heads of the columns that are aligned to the right: those with numbers only."""
    return {
        head
        for head, cells in texts.items()
        if all(map(NUMBER_CELL.fullmatch, cells)) and any(cells)
    }


def format_markdown(frame: pd.DataFrame) -> list[str]:
    """Return the lines of a table in Markdown, with Markdown and HTML in its texts escaped."""
    texts = format_cells(frame)
    rows = [list(texts), ["---"] * texts.shape[1], *texts.to_numpy().tolist()]
    return ["| " + " | ".join(map(escape_markdown, row)) + " |" for row in rows]


def escape_markdown(text: str) -> str:
    """Return a text on one line, with Markdown and HTML in it escaped."""
    text = " ".join(text.split()).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"([\\`*\[\]|])", r"\\\1", text)


def print_table(console: Console, frame: pd.DataFrame, optional: Sequence[str] = ()) -> None:
    """Print a frame within the width of the terminal, or `MAX_PIPED_WIDTH`. Its texts are not read as markup.

    Heads fold between words and numbers stay whole. In a table that is too wide, heads fold within words; then columns
    are left out and named: first `optional` in its order, then the last ones.
    """
    from rich.table import Table
    from rich.text import Text

    remaining = [head for head in optional if head in frame]
    left_out = list[str]()
    keeps_words = True
    limit = console.width if console.is_terminal else min(console.width, MAX_PIPED_WIDTH)
    while True:
        texts = format_cells(frame)
        numbers = list_number_heads(texts)
        width = 2 * (texts.shape[1] - 1)
        grid = Table(box=None, pad_edge=False, header_style="bold")
        for head, cells in texts.items():
            if head in numbers:
                longest = (
                    min(max(map(len, head.split()), default=0), MAX_WORD_WIDTH)
                    if keeps_words
                    else 0
                )
                lines = textwrap.wrap(head, max(MIN_HEAD_WIDTH, longest, *map(len, cells)))
                smallest = max(map(len, [*cells, *lines]))
                grid.add_column(Text("\n".join(lines)), justify="right", no_wrap=True)
            else:
                longest = max(
                    (len(word) for text in (head, *cells) for word in text.split()), default=1
                )
                smallest = min(longest, MAX_WORD_WIDTH)
                grid.add_column(Text(head), overflow="fold", min_width=smallest)
            width += smallest
        if width <= limit or (texts.shape[1] <= 2 and not keeps_words):
            break
        if keeps_words:
            keeps_words = False
        else:
            left_out.append(remaining.pop(0) if remaining else str(frame.columns[-1]))
            frame = frame.drop(columns=left_out[-1])
    for row in texts.to_numpy().tolist():
        grid.add_row(*map(Text, row), style="red" if any("✗" in text for text in row) else "")
    console.print(grid, highlight=False, width=max(limit, width))
    if left_out and len(texts):
        console.print(
            f"not shown: {', '.join(left_out)}", style="dim", highlight=False, markup=False
        )


def write_files(
    folder: str | Path, files: Mapping[str, Any], begin: Callable[[str], object] = lambda name: None
) -> Path:
    """Write each entry of `files` to its path in a folder: texts as they are, a frame as .csv, other data as .json.

    An entry may be a function that returns one of these. `begin` is called with each path before its file is written.
    A file is replaced only when the new one is complete. Return the folder.
    """
    from lavender.io.stored import make_folder, write_text

    folder = make_folder(folder)
    for name, content in files.items():
        begin(name)
        content = content() if callable(content) else content
        path = make_folder((folder / name).parent) / Path(name).name
        if path.suffix == ".csv":
            write_text(path, content.to_csv(index=False))
        else:
            write_text(
                path, content if isinstance(content, str) else json.dumps(content, indent=1) + "\n"
            )
    return folder
