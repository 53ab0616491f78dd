"""Output of the benchmarks: tables as markdown, lines as JSON."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from lavender.io.stored import check_writable, write_text
from lavender.report import machine


def markdown(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a markdown table. Columns of numbers are not aligned specially, so that diffs stay small."""
    lines = [
        "| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |"
        for line in (head, *rows)
    ]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:]])


def out_option(
    text: str, name: str = "--out"
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return the option `--out FILE`; the command receives a writable path or None."""

    def checked(context: click.Context, option: click.Parameter, path: Path | None) -> Path | None:
        return None if path is None else check_writable(path)

    return click.option(name, type=click.Path(path_type=Path), callback=checked, help=text)


def write_json(path: Path, lines: Iterable[Any], **more: Any) -> None:
    """Write lines (dataclasses or dictionaries) with machine and package versions; the file is written atomically."""
    rows = [line if isinstance(line, dict) else asdict(line) for line in lines]
    more = {
        "cpu": machine.get_cpu_name(),
        "versions": machine.get_versions(),
        **more,
        "lines": rows,
    }
    write_text(path, json.dumps(more, indent=1) + "\n")
