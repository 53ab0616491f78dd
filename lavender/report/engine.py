"""Read and rank the answers of the engine that recorded a folder of steps.

The judge computes the residuals of these answers, as of all results. The engine measures the time itself: the time
includes neither a copy of the problem nor the judge, and the engine starts from its previous step. The engine is
ranked as solvers are ranked: by the number of cases solved to a tolerance, then by the mean time.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lavender.io.stored import ENGINE, SUFFIXES, read_whole_file
from lavender.judge.residuals import AT_FLOOR, UNCONVERGED, WRONG
from lavender.report.ranking import compute_mean
from lavender.report.records import Records, escape_unprintable

_NUMERIC_KEYS = ("rows", "seconds", "relative")
INSIDE = "inside the engine, warm-started, without copy and judge"


@dataclass(frozen=True)
class EngineAnswers:
    """Answers of an engine to one folder of recorded steps."""

    folder: str
    source: str  # Path of the folder as in the records.
    solver: str
    steps: int
    left_out: int  # Number of steps that could not be recorded.
    rows: float  # Median number of rows.
    relative: float  # Median relative residual, and the largest.
    worst: float
    above_floor: int  # Number of answers above the round-off floor.
    unconverged: (
        int  # Number of answers with an error above the recording's threshold that rounding does not explain.
    )
    velocity: (
        float  # [m/s] Largest velocity error of a row, nan if it was not recorded; and the name of that row.
    )
    where: str
    answers: Mapping[
        str, tuple[float, float]
    ]  # Time inside the engine [s] and relative residual by file name.

    def contains(self, source: str) -> bool:
        """Return whether the source of a case is a file of the engine's folder."""
        return str(Path(source).parent) == self.source

    def rank(
        self, records: Records, cases: Sequence[str], tolerance: float, limit: float
    ) -> dict[str, Any] | None:
        """Return the engine's result on cases as solvers are ranked; None if it did not answer every case."""
        sources = [records.cases[name].source for name in cases]
        answers = [self.answers.get(Path(s).name) for s in sources if self.contains(s)]
        if not cases or None in answers or len(answers) < len(cases):
            return None
        times = [t if x <= tolerance else math.inf for t, x in filter(None, answers)]
        mean = float(compute_mean([t if math.isfinite(t) else limit for t in times]))
        solved = sum(map(math.isfinite, times))
        return {"solver": self.solver, "solved": solved, "cases": len(cases), "mean": mean}


def read_engine_answers(sources: Sequence[str], records: Records) -> list[EngineAnswers]:
    """Read the engine's answers in the folders among `sources`, and in the folders of the records' files.

    Lines that cannot be read are left out.
    """
    parents = (Path(x.source).parent for x in records.cases.values() if x.source.endswith(SUFFIXES))
    engines = (_read_folder(folder) for folder in dict.fromkeys([*map(Path, sources), *parents]))
    return [engine for engine in engines if engine is not None]


def _read_folder(folder: Path) -> EngineAnswers | None:
    """Read the answers in one folder; return None if it has none."""
    path = folder / ENGINE
    if not path.is_file():
        return None
    entries, left_out, answers = [], 0, {}
    for line in read_whole_file(path, "the engine's answers").decode(errors="replace").splitlines():
        try:
            entry = json.loads(line)
            left_out += "left_out" in entry
            rows, time, relative = (float(entry[name]) for name in _NUMERIC_KEYS)
            row = float(entry.get("velocity", math.nan)), str(entry.get("worst", ""))
            verdict = str(entry["verdict"])
            entries.append((rows, relative, row, verdict, escape_unprintable(str(entry["solver"]))))
            if math.isfinite(time) and time >= 0.0:
                answers[escape_unprintable(str(entry.get("file", "")))] = time, relative
        except (ValueError, KeyError, TypeError, RecursionError):
            continue
    if not entries:
        return None
    sizes, relatives, worst_rows, verdicts, solvers = zip(*entries, strict=True)
    velocity, where = max(worst_rows, key=lambda row: (row[0] == row[0], row[0]))
    return EngineAnswers(
        folder=folder.name, source=escape_unprintable(str(folder)),
        solver=max(set(solvers), key=solvers.count).replace("NEWTON", "Newton"), steps=len(entries), left_out=left_out,
        rows=float(np.median(sizes)), relative=float(np.median(relatives)), worst=float(np.max(relatives)),
        above_floor=sum(verdict != AT_FLOOR for verdict in verdicts),
        unconverged=sum(verdict in (UNCONVERGED, WRONG) for verdict in verdicts), velocity=velocity,
        where=escape_unprintable(where), answers=answers,
    )  # fmt: skip
