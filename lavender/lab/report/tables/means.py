"""Tables over the cases of one law: shifted geometric means and performance profiles."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from lavender.lab.bench.record import Record
from lavender.lab.bench.store import Records
from lavender.lab.report.tables.cases import reaches
from lavender.lab.report.tables.groups import levels_of

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
