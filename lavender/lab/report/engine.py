"""The answer of the engine that recorded a folder of steps, as a contestant: judged like the others, timed inside it.

Its time holds neither a copy of the problem nor the judge, and it starts from what the engine kept of the step before;
so it stands beside the table, not in it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lavender.io.stored import ENGINE, whole_file
from lavender.judge.residuals import AT_FLOOR, UNCONVERGED, VERDICTS_OF_OLD, WRONG
from lavender.lab.bench.record import Record, printable
from lavender.lab.bench.store import Records

_NUMBERS = ("rows", "seconds", "relative")


@dataclass(frozen=True)
class Contestant:
    """One folder of recorded steps; times in s, residuals relative."""

    folder: str
    solver: str  # of the engine
    steps: int
    left_out: int  # steps of the recording that could not be kept
    rows: float  # median
    seconds: float  # median, inside the engine
    relative: float  # median
    worst: float
    above_floor: int  # answers that rounding does not explain
    # of these, answers that stopped early or are wrong, by more than the threshold of the recording
    early: int
    velocity: float  # m/s, of the worst row of all answers; nan where the recording does not say
    where: str  # that row
    ours: str  # the fastest solver that reached the level in every step, its start, the level; empty if none did
    our_seconds: float  # median
    our_worst: float


def contestants(words: Sequence[str], records: Records) -> list[Contestant]:
    """Of the folders among `words` in which an engine left its own answers; lines that cannot be read are left out."""
    out = []
    for word in words:
        path = Path(word) / ENGINE
        if not path.is_file():
            continue
        found, lost = [], 0
        for line in whole_file(path, "the engine's answers").decode(errors="replace").splitlines():
            try:
                entry = json.loads(line)
                lost += "left_out" in entry
                numbers = [float(entry[name]) for name in _NUMBERS]
                row = float(entry.get("velocity", math.nan)), str(entry.get("worst", ""))
                found.append(
                    (
                        *numbers,
                        row,
                        VERDICTS_OF_OLD.get(str(entry["verdict"]), str(entry["verdict"])),
                        str(entry["solver"]),
                    )
                )
            except (ValueError, KeyError, TypeError, RecursionError):
                continue
        if not found:
            continue
        rows, seconds, relative, worst_rows, verdicts, solvers = zip(*found, strict=True)
        velocity, where = max(worst_rows, key=lambda row: (row[0] == row[0], row[0]))
        name, ours, worst = _fastest(Path(word), records, float(np.max(relative)))
        out.append(
            Contestant(
                folder=Path(word).name,
                solver=f"{max(set(solvers), key=solvers.count).capitalize()} (inside the engine)",
                steps=len(found),
                left_out=lost,
                rows=float(np.median(rows)),
                seconds=float(np.median(seconds)),
                relative=float(np.median(relative)),
                worst=float(np.max(relative)),
                above_floor=sum(said != AT_FLOOR for said in verdicts),
                early=sum(said in (UNCONVERGED, WRONG) for said in verdicts),
                velocity=velocity,
                where=where,
                ours=name,
                our_seconds=ours,
                our_worst=worst,
            )
        )
    return out


def _fastest(folder: Path, records: Records, engine: float) -> tuple[str, float, float]:
    """The fastest at the loosest level that is no worse than the engine's worst residual, else at the closest."""
    inside = printable(str(folder))  # as the records have it
    working = {
        name for name, info in records.cases.items()
        if not info.nothing_to_do and str(Path(info.source).parent) == inside
    }  # fmt: skip
    runs = [r for r in records if r.mode == "tol" and not r.turns and r.case in working]
    levels = {r.tol for r in runs}
    level = max((tol for tol in levels if tol <= engine), default=min(levels, default=math.nan))
    by_solver: dict[tuple[str, str], list[Record]] = {}
    for r in runs:
        if r.tol == level:
            by_solver.setdefault((r.solver, r.start), []).append(r)
    best = ("", math.nan, math.nan)
    for (solver, start), steps in by_solver.items():
        if len(steps) == len(working) and all(r.success for r in steps):  # none was left to a limit of time
            time = float(np.median([r.time_min for r in steps]))
            if not time >= best[1]:
                best = (f"{solver}, {start}, to {level:g}", time, max(r.relative for r in steps))
    return best
