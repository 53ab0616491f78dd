"""What differs between two runs beyond noise."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from statistics import median

from lavender.lab.bench.store import Records
from lavender.lab.report.tables.advice import NOISE
from lavender.lab.report.tables.cases import reaches
from lavender.lab.report.tables.groups import levels_of, pairs


@dataclass(frozen=True)
class Change:
    """One case and solver in an old and a new run."""

    case: str
    solver: str
    start: str
    level: float
    old: float  # s, inf where the level was missed
    new: float
    noise: float  # what counts as noise: a factor above 1

    @property
    def kind(self) -> str:
        """reached | lost | faster | slower | same."""
        if math.isfinite(self.new) != math.isfinite(self.old):
            return "reached" if math.isfinite(self.new) else "lost"
        if not math.isfinite(self.new) or self.old / self.noise <= self.new <= self.old * self.noise:
            return "same"
        return "faster" if self.new < self.old else "slower"


def changes(old: Records, new: Records) -> list[Change]:
    """Time to each level in two runs, on the cases whose numbers are the same in both.

    Noise is at least `NOISE`, and at least twice the ratio between minimum and median of either run. Earlier times are
    in what the machine is worth now: multiplied by the drift of the case, where both runs know it.
    """
    levels = levels_of(new)
    same = {name for name, info in new.cases.items() if name in old.cases and old.cases[name].sha == info.sha}
    before = {(r.case, r.solver, r.start): r for r in reaches(old, levels)}
    jitter: dict[tuple[str, str, str], float] = defaultdict(lambda: 1.0)
    for records in (old, new):
        for key, group in pairs(records).items():
            for r in group:
                if r.usable and r.time_min > 0.0:
                    jitter[key] = max(jitter[key], r.time_median / r.time_min)
    out = []
    for row in reaches(new, levels):
        key = (row.case, row.solver, row.start)
        if row.case not in same or key not in before:
            continue
        worth = drift(old, new, row.case)
        noise = max(NOISE, 1.0 + 2.0 * (jitter[key] - 1.0))
        out += [Change(*key, x, worth * before[key].times[x], row.times[x], noise) for x in levels]
    return out


def drift(old: Records, new: Records, case: str = "") -> float:
    """Time of the loop of fixed work now over then, medians beside the runs of a case, or of all; 1 where not known."""
    found = []
    for records in (old, new):
        some = [r.pace for r in records if r.pace and (not case or r.case == case)]
        found.append(median(some) if some else math.nan)
    return found[1] / found[0] if all(map(math.isfinite, found)) else 1.0
