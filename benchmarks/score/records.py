"""The table of results: one row for each engine, column of settings, rate and scene."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from lavender.io.stored import write_text

PATH = Path(__file__).with_name("records.csv")


@dataclass
class Record:
    """One cell. Without an error, `note` has the reason, which begins with "cannot", "too slow" or "failed"."""

    engine: str
    version: str
    level: str  # "default" or "accurate"
    rate: int  # steps a second
    scene: str
    runs: int  # repetitions
    error: float  # of the first run, in the unit of the scene
    spread: float  # largest minus smallest error of the runs
    cost: float  # µs of CPU a step, smallest of the runs
    slowest: float  # µs of CPU a step, largest of the runs
    residual: float  # m/s, largest of the steps that were read; nan if the engine cannot be read
    note: str = ""
    curve: str = ""  # JSON list of the values of a curve
    settings: str = ""  # identifies the options of the engine, see `run.get_settings_key`

    @property
    def key(self) -> tuple[str, str, int, str]:
        """What identifies the cell."""
        return self.engine, self.level, self.rate, self.scene

    @property
    def values(self) -> list[float]:
        """Values of the curve."""
        return [math.nan if value is None else value for value in json.loads(self.curve or "[]")]


def read_records(path: Path = PATH) -> dict[tuple[str, str, int, str], Record]:
    """Return the rows of a file by their keys; none if the file does not exist."""
    if not path.exists():
        return {}
    numbers = {
        "rate": int,
        "runs": int,
        "error": float,
        "spread": float,
        "cost": float,
        "slowest": float,
        "residual": float,
    }
    with path.open(encoding="utf-8", newline="") as file:
        rows = [
            Record(**{k: numbers.get(k, str)(v) for k, v in row.items()})
            for row in csv.DictReader(file)
        ]
    return {row.key: row for row in rows}


def write_records(rows: Iterable[Record], path: Path = PATH) -> None:
    """Write rows, sorted, atomically."""
    lines = [",".join(field.name for field in fields(Record))]
    for row in sorted(rows, key=lambda row: row.key):
        values = [f"{v:.4g}" if isinstance(v, float) else str(v) for v in asdict(row).values()]
        lines.append(
            ",".join(
                '"' + v.replace('"', '""') + '"' if set(v) & set(',"\n') else v for v in values
            )
        )
    write_text(path, "\n".join(lines) + "\n")
