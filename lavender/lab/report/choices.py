"""Which solver: for each structure and sequence, at each level and within each time."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any

from lavender.lab.bench.record import Record
from lavender.lab.bench.store import Records
from lavender.lab.report.tables import (
    NOISE,
    RESIDUAL_NOISE,
    SHIFT,
    by_sequence,
    families,
    geometric_mean,
    levels_of,
    limit_of,
    quantile,
    times_to,
)

HALF = 0.5  # of the start's residual: a case is served where at most that is left
QUANTILE = 0.9  # of the residuals in a time or with sweeps, over the cases: misses cannot be averaged away
FIRST = "auto"  # among equals: the only name that needs no choice


@dataclass(frozen=True)
class Choice:
    """One solver's standing in a family of cases, or over the steps of a sequence."""

    solver: str
    solved: int
    cases: int
    # What ranks, and what is shown: shifted geometric mean of times [s], or the 90th percentile of residuals [-]
    score: float
    p95: float = math.nan  # 95th percentile over the cases, of what `score` is of; inf: not reached
    worst: float = math.nan
    hardest: str = ""  # the case of `worst`
    how: str = ""  # the budget that does it, and for a sequence whether impulses are carried
    iterations: int = 0  # of that budget, 0 where there is none
    overrun: float = math.nan  # 95th percentile of the line's time over what it was to take

    def is_for(self, share: float) -> bool:
        """It solves a case, and at least this share of them."""
        return self.solved >= max(1, share * self.cases)

    @classmethod
    def of(cls, solver: str, values: Mapping[str, float], solved: int, score: float, **more: Any) -> Choice:
        """From what ranks it on each case, a time [s] or what is left of the residual [-]."""
        each = list(values.values())
        return cls(
            solver=solver,
            solved=solved,
            score=score,
            p95=quantile(each, 0.95),
            worst=max(each),
            hardest=max(values, key=lambda c: values[c]),
            **{"cases": len(each), **more},
        )


@dataclass(frozen=True)
class Advice:
    """Solvers of a family in order of merit for one accuracy level or time budget."""

    family: str
    target: float  # level [-] or time [s]
    ranking: tuple[Choice, ...]
    equal: int = 1  # how many at the head are the best within noise; they stand in a fixed order
    least: float = 0.0  # share of the cases below which nobody is recommended

    @property
    def best(self) -> Choice | None:
        """The recommended one; None if no solver reached the level, or none serves enough of the cases in a time."""
        return self.ranking[0] if self.ranking and self.ranking[0].is_for(self.least) else None

    @property
    def ties(self) -> tuple[str, ...]:
        """Names of those that are as good as the best, within noise."""
        return tuple(c.solver for c in self.ranking[1 : self.equal]) if self.best else ()


Place = tuple[tuple[float, ...], Choice]  # a smaller key is better whatever the score


def ranked(family: str, target: float, places: Iterable[Place], noise: float) -> Advice:
    """Ranking by key, then by score; solvers within a factor `noise` of the best by name, so that a rerun agrees."""
    order = sorted(places, key=lambda place: (place[0], place[1].score, place[1].solver))
    if not order:
        return Advice(family, target, ())
    key, best = order[0]
    equal = [c for k, c in order if k == key and c.score <= noise * best.score]
    equal.sort(key=lambda c: (c.solver != FIRST, c.solver))
    rest = [c for _, c in order if all(c is not e for e in equal)]
    return Advice(family, target, (*equal, *rest), len(equal))


@dataclass(frozen=True)
class Line:
    """A line of the table of recommendations: a structure and its cases, or a sequence and its steps."""

    name: str
    cases: tuple[str, ...]
    sequence: bool
    left_out: int  # steps that did not load
    by_level: Mapping[float, Advice]
    by_time: Mapping[float, Advice]
    by_sweeps: Mapping[float, Advice]

    @property
    def size(self) -> int:
        """Number of cases."""
        return len(self.cases)


def advice_alone(records: Records, times: Sequence[float] = ()) -> list[Line]:
    """Every recommendation by runs that were timed alone: structures, then sequences.

    To a level: first who brings most cases there, then who is fastest (shifted geometric mean). In a time, and with a
    budget of those whose iterations are sweeps: who serves most cases, then the residual at the 90th percentile; nobody
    where nobody serves nine of ten. A case is served where at most half of the start's residual is left; who has
    nothing to show in the time scores 1 on it: doing nothing. A solver whose claim was wrong on a case comes after all
    that were not. `times` [s]; `time_budgets` if none are given.
    """
    times = tuple(times) or time_budgets(records)
    ways, swept, lost = _ways(records), _swept(records), records.left_out
    return [
        Line(
            name=name,
            cases=tuple(cases),
            sequence=is_sequence,
            left_out=len(lost.get(name, ())) if is_sequence else 0,
            by_level={x: to_level(records, name, cases, x, ways) for x in levels_of(records)},
            by_time={t: within(records, name, cases, t, ways) for t in times},
            by_sweeps={
                float(n): replace(within(records, name, cases, math.inf, some), target=float(n))
                for n, some in swept.items()
            },
        )
        for is_sequence, groups in ((False, families(records)), (True, steps_of(records)))
        for name, cases in groups.items()
    ]


def _swept(records: Records) -> dict[int, Ways]:
    """By budget, the solvers whose iterations are sweeps."""
    ways: dict[int, dict[tuple[str, str, str], _Way]] = defaultdict(dict)
    for r in records:
        plain = r.order == "given" and not r.turns and r.start in ("cold", "carried") and r.usable
        if plain and r.mode == "budget" and counts_sweeps(r):
            start = "" if r.step < 0 else r.start
            way = ways[r.max_iter].setdefault((r.solver, "", start), _Way(r.solver, start, r.max_iter))
            way.runs[r.case] = [r]
    return {n: ways[n] for n in sorted(ways)}


@dataclass(frozen=True)
class _Way:
    """A solver with all of its runs on single cases, or with those of one line over the steps of sequences."""

    solver: str
    how: str = ""  # the line; of single cases the sweeps of the runs that count, where they count sweeps
    iterations: int = 0
    tol: float = 0.0  # that a line asks for
    runs: dict[str, list[Record]] = field(default_factory=dict)  # by case

    def budget(self, runs: Sequence[Record]) -> dict[str, Any]:
        """What a choice says of it, with these of its runs."""
        if self.how or self.iterations:
            return {"how": self.how, "iterations": self.iterations}
        sweeps = [r.work["sweeps"] for r in runs if "sweeps" in r.work]
        middle = round(median(sweeps)) if runs and len(sweeps) == len(runs) else 0
        return {"how": f"{middle} sweeps" if middle else "", "iterations": middle}


Ways = Mapping[tuple[str, str, str], _Way]


def _ways(records: Records) -> Ways:
    """From a cold start on single cases; over sequences each budget and level, cold and carried."""
    found: dict[tuple[str, str, str], _Way] = {}
    for r in records:
        if r.order != "given" or r.turns or (r.step < 0 and r.start != "cold"):
            continue
        if r.step < 0:
            way = found.setdefault((r.solver, "", ""), _Way(r.solver))
        else:
            tol, budget = (r.tol, 0) if r.mode == "tol" else (0.0, r.max_iter)
            line = _Way(r.solver, f"{r.asked}, {r.start}", budget, tol)
            way = found.setdefault((r.solver, r.asked, r.start), line)
        way.runs.setdefault(r.case, []).extend([r] if r.usable else [])
    return found


def steps_of(records: Records) -> dict[str, list[str]]:
    """The steps of each sequence, those that nobody was asked for, too."""
    ran = {r.case for r in records if r.step >= 0}
    found: dict[str, list[str]] = {}
    for name, info in records.cases.items():
        if info.sequence:
            found.setdefault(info.sequence, []).append(name)
    return {name: steps for name, steps in found.items() if not ran.isdisjoint(steps)}


def to_level(
    records: Records, family: str, cases: Sequence[str], level: float, ways: Ways | None = None
) -> Advice:
    """Who brings these cases, or steps, to a level; see `advice_alone`. `ways` spares a pass over the records.

    Steps of several sequences count together, by the lines that were asked for the level or have a budget.
    """
    limit, liars = limit_of(records), _liars(records, cases)
    places: list[Place] = []
    for way in _taking(cases, _ways(records) if ways is None else ways):
        if way.tol > level:
            continue
        runs = {c: _quickest(way.runs.get(c, ()), level) for c in cases}
        solved = [r for r in runs.values() if r is not None]
        times = {c: math.inf if r is None else r.time_min for c, r in runs.items()}
        score = geometric_mean([t if math.isfinite(t) else limit for t in times.values()], SHIFT)
        choice = Choice.of(way.solver, times, len(solved), score, **way.budget(solved))
        places.append(((way.solver in liars, -len(solved)), choice))
    return ranked(family, level, _best_of_each(places), NOISE)


def within(
    records: Records, family: str, cases: Sequence[str], limit: float, ways: Ways | None = None
) -> Advice:
    """Who comes closest on these cases, or steps, within a time [s]; see `advice_alone`.

    A run that takes the time within noise may be in it or not the next time: who would be the best with it is
    as good as the best.
    """
    taking, liars = _taking(cases, _ways(records) if ways is None else ways), _liars(records, cases)

    def standing(way: _Way, most: float) -> Place:
        runs = {c: _closest(way.runs.get(c, ()), most) for c in cases}
        left = {c: 1.0 if r is None else min(max(r.relative, 1e-17), 1.0) for c, r in runs.items()}
        served = sum(x <= HALF for x in left.values())
        budget = way.budget([r for r in runs.values() if r is not None])
        choice = Choice.of(way.solver, left, served, quantile(list(left.values()), QUANTILE), **budget)
        return (way.solver in liars, -served), choice

    places = _best_of_each(standing(way, limit) for way in taking)
    found = ranked(family, limit, places, RESIDUAL_NOISE)
    # who serves fewer leaves 1.0 at the 90th percentile: noise decides who
    found = replace(found, least=QUANTILE)
    if found.best is None or math.isinf(limit):
        return found
    late = {c.solver: (key, c.score) for key, c in _best_of_each(standing(w, NOISE * limit) for w in taking)}
    first = min(key for key, _ in places)
    best = min(c.score for c in found.ranking[: found.equal])
    rest = found.ranking[found.equal :]
    near = [c for c in rest if late[c.solver][0] <= first and late[c.solver][1] <= RESIDUAL_NOISE * best]
    others = [c for c in rest if all(c is not n for n in near)]
    ranking = (*found.ranking[: found.equal], *near, *others)
    return replace(found, ranking=ranking, equal=found.equal + len(near))


def _liars(records: Records, cases: Sequence[str]) -> set[str]:
    """Solvers with a false claim on any of these."""
    held = set(cases)
    return {r.solver for r in records if r.status_conflict and r.case in held}


def _taking(cases: Sequence[str], ways: Ways) -> list[_Way]:
    held = set(cases)
    return [way for _, way in sorted(ways.items()) if not held.isdisjoint(way.runs)]


def _quickest(runs: Iterable[Record], level: float) -> Record | None:
    return min((r for r in runs if r.relative <= level), key=lambda r: r.time_min, default=None)


def _closest(runs: Iterable[Record], limit: float) -> Record | None:
    return min((r for r in runs if r.time_min <= limit), key=lambda r: r.relative, default=None)


def time_budgets(records: Records) -> tuple[float, ...]:
    """Three decades of time [s] about the median of the fastest times to the middle level."""
    levels = levels_of(records)
    level = levels[len(levels) // 2]
    fastest = [min(by.values()) for by in times_to(records, level).values() if by]
    for passes in by_sequence(records).values():
        reached = [
            median(w.times[start])
            for w in passes
            for start, residuals in w.residuals.items()
            if len(residuals) == w.steps and max(residuals) <= level
        ]
        fastest.append(min(reached, default=math.inf))
    fastest = [t for t in fastest if 0.0 < t < math.inf]
    middle = math.ceil(math.log10(median(fastest))) if fastest else -3
    return tuple(10.0**k for k in (middle - 1, middle, middle + 1))


def counts_sweeps(r: Record) -> bool:
    """A budget whose iterations are sweeps, so that it bounds what a solve takes."""
    return 0 < r.work.get("sweeps", 0) <= r.max_iter


def _best_of_each(places: Iterable[Place]) -> list[Place]:
    # The best way of each solver.
    first: dict[str, Place] = {}
    for place in sorted(places, key=lambda pair: (pair[0], pair[1].score)):
        first.setdefault(place[1].solver, place)
    return list(first.values())
