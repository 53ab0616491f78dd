"""Tables over many cases: means and profiles by law, campaigns without times, sequences step by step."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median

from lavender.lab.bench.record import Record, asked_of
from lavender.lab.bench.store import Records
from lavender.lab.report.tables.cases import DIED, families, levels_of, pairs, reaches

#: s, of the geometric means, whoever takes part: what is quicker than that differs by Python's share of a call.
SHIFT = 1e-5


@dataclass(frozen=True)
class Profile:
    """Dolan-More performance profile of one level over the cases of one law."""

    law: str
    level: float
    cases: int
    curves: Mapping[str, tuple[tuple[float, float], ...]]  # solver -> (ratio, share) steps


def geometric_mean(values: Sequence[float], shift: float = 0.0) -> float:
    """exp(mean(log(x + shift))) - shift; nan for nothing."""
    if not values:
        return math.nan
    return math.exp(sum(math.log(v + shift) for v in values) / len(values)) - shift


def quantile(values: Sequence[float], q: float) -> float:
    """The smallest value that at least a share q of them does not exceed."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, math.ceil(q * len(ordered)) - 1)]


def times_to(records: Records, level: float) -> dict[str, dict[str, float]]:
    """Case -> solver -> time [s] to a level from a cold start, inf if missed; solvers that refused it are absent."""
    out: dict[str, dict[str, float]] = defaultdict(dict)
    for reach in reaches(records, [level]):
        if reach.start == "cold":
            out[reach.case][reach.solver] = reach.times[level]
    return out


def limit_of(records: Records) -> float:
    """What a missed level is charged [s]: the time limit."""
    return max((r.time_limit for r in records), default=1.0)


def geometric_means(records: Records) -> dict[str, dict[float, dict[str, tuple[float, int, int]]]]:
    """law -> level -> solver -> (shifted geometric mean [s], solved, cases); a miss costs the time limit.

    A solver stands in a law's table when it takes every case of it.
    """
    limit = limit_of(records)
    out: dict[str, dict[float, dict[str, tuple[float, int, int]]]] = {}
    for law, cases in _laws(records).items():
        out[law] = {}
        for level in levels_of(records):
            times = times_to(records, level)
            by: dict[str, tuple[float, int, int]] = {}
            for solver in _whole(times, cases):
                t = [times[c][solver] for c in cases]
                solved = sum(map(math.isfinite, t))
                by[solver] = (
                    geometric_mean([x if math.isfinite(x) else limit for x in t], SHIFT),
                    solved,
                    len(cases),
                )
            out[law][level] = dict(sorted(by.items(), key=lambda kv: kv[1][0]))
    return out


@dataclass(frozen=True)
class Backend:
    """A solver of another package to the middle level, on the cases that it brings there."""

    solver: str
    solved: int
    whole: float  # s, geometric mean of the whole way from a problem
    own: float  # s, of its own solve, on data that it was given before
    wins: int  # cases on which that is less than the fastest of ours takes


def backends(records: Records) -> list[Backend]:
    """Those of which both times are known; by their own interface first the fastest."""
    levels = levels_of(records)
    level = levels[len(levels) // 2]
    best: dict[tuple[str, str], Record] = {}
    for r in records:
        key = (r.solver, r.case)
        reached = r.usable and r.relative <= level and r.start == "cold" and not r.turns
        if reached and (key not in best or r.time_min < best[key].time_min):
            best[key] = r
    ours: dict[str, float] = {}
    for (_, case), r in best.items():
        if r.own_min is None:
            ours[case] = min(r.time_min, ours.get(case, math.inf))
    out = []
    for solver in sorted({r.solver for r in best.values() if r.own_min is not None}):
        mine = {c: r for (s, c), r in best.items() if s == solver and r.own_min is not None}
        owns = {c: r.own_min or 0.0 for c, r in mine.items()}
        whole = geometric_mean([r.time_min for r in mine.values()], SHIFT)
        wins = sum(t < ours.get(c, math.inf) for c, t in owns.items())
        out.append(Backend(solver, len(mine), whole, geometric_mean(list(owns.values()), SHIFT), wins))
    return sorted(out, key=lambda b: b.own)


def _laws(records: Records) -> dict[str, list[str]]:
    ran = {r.case for r in records if r.step < 0}
    out: dict[str, list[str]] = defaultdict(list)
    for name, info in records.cases.items():
        if name in ran:
            out[info.law].append(name)
    return dict(out)


def _whole(times: Mapping[str, Mapping[str, float]], cases: Sequence[str]) -> list[str]:
    everyone = sorted({s for c in cases for s in times.get(c, {})})
    return [s for s in everyone if all(s in times.get(c, {}) for c in cases)]


def profiles(records: Records) -> list[Profile]:
    """Share of cases that a solver brings to a level within `ratio` times the fastest; misses at infinity.

    Over the cases of one law, and within one run (`Records.latest`); a case that nobody brought to the
    level counts against everyone.
    """
    out = []
    for law, cases in _laws(records).items():
        for level in levels_of(records):
            times = times_to(records, level)
            curves: dict[str, tuple[tuple[float, float], ...]] = {}
            for solver in sorted({s for c in cases for s in times.get(c, {})}):
                ratios = []
                for c in cases:
                    t = times.get(c, {}).get(solver, math.inf)
                    if math.isfinite(t):
                        ratios.append(t / min(times[c].values()))
                steps = [(1.0, sum(r <= 1.0 for r in ratios) / len(cases))]
                steps += [
                    (r, sum(q <= r for q in ratios) / len(cases)) for r in sorted(set(ratios)) if r > 1.0
                ]
                curves[solver] = tuple(steps)
            out.append(Profile(law, level, len(cases), curves))
    return out


# -- campaigns ---------------------------------------------------------------------------------------------


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


# -- sequences ---------------------------------------------------------------------------------------------


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
