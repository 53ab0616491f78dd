"""Read and rank the answers of the engine that recorded a folder of steps.

The judge computes the residuals of these answers, as of all results. The engine measures the time itself: the time
includes neither a copy of the problem nor the judge, and the engine starts from its previous step. The engine is
ranked as solvers are ranked: by the number of cases solved to a tolerance, then by the mean time.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lavender.io.stored import ENGINE, SUFFIXES, read_whole_file
from lavender.judge.residuals import AT_FLOOR, UNCONVERGED, WRONG
from lavender.report.ranking import compute_mean
from lavender.report.records import Records, escape_unprintable

if TYPE_CHECKING:
    import pandas as pd

INSIDE = "inside the engine, warm-started, without copy and judge"


@dataclass(frozen=True, eq=False)
class EngineAnswers:
    """Answers of an engine to one folder of recorded steps.

    Parameters
    ----------
    folder : str
        Path of the folder, as in the records.
    left_out : int
        Number of steps that could not be recorded.
    lines : DataFrame
        One row for each answer: file, rows, seconds [s], relative, velocity [m/s] and worst (nan and "" if they were
        not recorded), verdict and solver.
    """

    folder: str
    left_out: int
    lines: pd.DataFrame

    @property
    def solver(self) -> str:
        """Name of the engine's solver, the most frequent one."""
        return str(self.lines["solver"].mode()[0]).replace("NEWTON", "Newton")

    @property
    def above_floor(self) -> int:
        """Number of answers above the round-off floor."""
        return int((self.lines["verdict"] != AT_FLOOR).sum())

    @property
    def unconverged(self) -> int:
        """Number of answers with an error above the recording's threshold that rounding does not explain."""
        return int(self.lines["verdict"].isin([UNCONVERGED, WRONG]).sum())

    def contains(self, source: str) -> bool:
        """Return whether the source of a case is a file of the engine's folder."""
        return str(Path(source).parent) == self.folder

    def rank(self, records: Records, cases: Sequence[str], tolerance: float) -> dict[str, Any] | None:
        """Return the engine's result on cases as solvers are ranked; None if it did not answer every case."""
        sources = [records.cases[name].source for name in cases]
        timed = (
            self.lines[self.lines["seconds"] >= 0.0].drop_duplicates("file", keep="last").set_index("file")
        )
        answers = timed.reindex([Path(s).name for s in sources if self.contains(s)])
        if not cases or answers["seconds"].isna().any() or len(answers) < len(cases):
            return None
        is_solved = answers["relative"] <= tolerance
        mean = float(compute_mean(answers["seconds"][is_solved]))
        return {"solver": self.solver, "solved": int(is_solved.sum()), "cases": len(cases), "mean": mean}


def read_engine_answers(sources: Sequence[str], records: Records) -> list[EngineAnswers]:
    """Read the engine's answers in the folders among `sources`, and in the folders of the records' files.

    Lines that cannot be read are left out.
    """
    parents = (Path(x.source).parent for x in records.cases.values() if x.source.endswith(SUFFIXES))
    engines = (_read_folder(folder) for folder in dict.fromkeys([*map(Path, sources), *parents]))
    return [engine for engine in engines if engine is not None]


def _read_folder(folder: Path) -> EngineAnswers | None:
    """Read the answers in one folder; return None if it has none."""
    import pandas as pd

    path = folder / ENGINE
    if not path.is_file():
        return None
    entries, left_out = [], 0
    for line in read_whole_file(path, "the engine's answers").decode(errors="replace").splitlines():
        try:
            entry = json.loads(line)
            left_out += "left_out" in entry
            numbers = {name: float(entry[name]) for name in ("rows", "seconds", "relative")}
            texts = {name: str(entry[name]) for name in ("verdict", "solver")}
            texts |= {name: str(entry.get(name, "")) for name in ("file", "worst")}
            numbers["velocity"] = float(entry.get("velocity", math.nan))
            entries.append(numbers | {name: escape_unprintable(text) for name, text in texts.items()})
        except (ValueError, KeyError, TypeError, RecursionError):
            continue
    return (
        EngineAnswers(escape_unprintable(str(folder)), left_out, pd.DataFrame(entries)) if entries else None
    )
