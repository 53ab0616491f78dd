"""Tables of sequences: each solver step by step, its impulses carried along or not."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from statistics import median

from lavender.lab.bench.record import Record, asked_of
from lavender.lab.bench.store import Records


@dataclass(frozen=True)
class Pass:
    """One solver over one sequence at one budget or level: cold, and with its impulses carried along."""

    sequence: str
    solver: str
    mode: str
    tol: float
    max_iter: int
    steps: int  # of the sequence; a pass that was stopped has fewer
    left_out: int  # steps of the sequence that did not load
    times: Mapping[str, tuple[float, ...]]  # start -> s of each step
    iterations: Mapping[str, int]
    residuals: Mapping[str, tuple[float, ...]]  # start -> of each step
    wrong: Mapping[str, int]  # start -> steps with a claim that does not hold

    @property
    def asked(self) -> str:
        """The budget or the level."""
        return asked_of(self.mode, self.tol, self.max_iter)

    @property
    def time(self) -> dict[str, float]:
        """start -> s, all steps."""
        return {start: sum(times) for start, times in self.times.items()}

    def middle(self, start: str) -> float:
        """Median residual over the steps."""
        return median(self.residuals[start]) if self.residuals.get(start) else math.nan

    @property
    def gain(self) -> float:
        """Median over the steps of cold over carried residual; nan without both."""
        cold, carried = self.residuals.get("cold"), self.residuals.get("carried")
        if not cold or not carried:
            return math.nan
        # A pass that was stopped has fewer steps.
        pairs = [(c, w) for c, w in zip(cold, carried, strict=False) if w > 0.0 and math.isfinite(c)]
        return median(c / w for c, w in pairs) if pairs else math.nan


def passes(records: Records) -> list[Pass]:
    """Sequences: total time and iterations, residual of each step, carried against cold."""
    groups: dict[tuple[str, str, str, float, int], dict[str, list[Record]]] = defaultdict(
        lambda: defaultdict(list)
    )
    for r in records:
        if r.step >= 0 and not r.turns and r.case in records.cases:
            name = records.cases[r.case].sequence
            groups[name, r.solver, r.mode, r.tol, r.max_iter][r.start].append(r)
    steps = Counter(info.sequence for info in records.cases.values())
    out, lost = [], records.left_out
    for key, by_start in groups.items():
        for group in by_start.values():
            group.sort(key=lambda r: r.step)
        out.append(
            Pass(
                *key,
                steps=steps[key[0]],
                left_out=len(lost.get(key[0], ())),
                times={s: tuple(_step_time(r) for r in g) for s, g in by_start.items()},
                iterations={s: sum(r.iterations for r in g) for s, g in by_start.items()},
                residuals={s: tuple(r.relative for r in g) for s, g in by_start.items()},
                wrong={s: sum(bool(r.contradicted) for r in g) for s, g in by_start.items()},
            )
        )
    return out


def _step_time(r: Record) -> float:
    # A step that brought nothing back took its limit.
    return r.time_min if math.isfinite(r.time_min) else r.time_limit


def by_sequence(records: Records) -> dict[str, list[Pass]]:
    """Passes over each sequence."""
    out: dict[str, list[Pass]] = defaultdict(list)
    for one in passes(records):
        out[one.sequence].append(one)
    return dict(out)
