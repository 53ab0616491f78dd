"""Tables of campaigns: shares of cases and residuals, without times."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from statistics import median

from lavender.lab.bench.store import Records
from lavender.lab.report.tables.advice import quantile
from lavender.lab.report.tables.groups import DIED, families, levels_of, pairs


@dataclass(frozen=True)
class Robustness:
    """One solver over the many cases of a campaign, by family of structure."""

    family: str
    solver: str
    cases: int
    reached: Mapping[float, int]  # level -> cases that the judge confirms
    wrong: int  # claims that do not hold
    died: int
    budgets: Mapping[int, tuple[float, float]]  # iterations -> median and 95th percentile of the residual
    hardest: str  # case with the largest residual of its best run


def robustness(records: Records) -> list[Robustness]:
    """By structure and solver: on how many cases each level is reached, false claims, residual by budget."""
    levels = levels_of(records)
    groups = {k[:2]: g for k, g in pairs(records).items() if k[2] == "cold"}
    solvers = sorted({solver for _, solver in groups})
    out = []
    for family, cases in families(records).items():
        for solver in solvers:
            mine = {c: groups[c, solver] for c in cases if (c, solver) in groups}
            if not mine:
                continue
            best = {c: min(r.relative for r in g) for c, g in mine.items()}
            by_budget: dict[int, list[float]] = defaultdict(list)
            for group in mine.values():
                for r in group:
                    if r.mode == "budget":
                        by_budget[r.max_iter].append(r.relative)
            runs = [r for g in mine.values() for r in g]
            out.append(
                Robustness(
                    family=family,
                    solver=solver,
                    cases=len(mine),
                    reached={x: sum(v <= x for v in best.values()) for x in levels},
                    wrong=sum(bool(r.contradicted) for r in runs),
                    died=sum(r.status.startswith(DIED) for r in runs),
                    budgets={n: (median(v), quantile(v, 0.95)) for n, v in sorted(by_budget.items())},
                    hardest=max(best, key=lambda c: best[c]),
                )
            )
    return out
