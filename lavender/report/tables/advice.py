"""Which solver: for each structure and sequence, at each level and within each time."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from lavender.bench.record import Record
from lavender.bench.store import Records
from lavender.report.tables.groups import families, levels_of, pairs
from lavender.report.tables.means import SHIFT, geometric_mean, limit_of, times_to
from lavender.report.tables.sequences import Pass, by_sequence

__all__ = [
    "Advice",
    "Choice",
    "Line",
    "advice",
    "advice_by_level",
    "advice_by_sequence",
    "advice_by_sweeps",
    "advice_by_time",
    "counts_sweeps",
    "over_steps",
    "quantile",
    "time_budgets",
    "to_level",
    "within",
]


#: Factors within which two scores are the same: what a busy machine does to the minimum of a few repeats, and what
#: one run more or less within a time does to a mean residual.
NOISE, RESIDUAL_NOISE = 1.25, 2.0
HALF = 0.5  # of the start's residual: a case is served where at most that is left
QUANTILE = 0.9  # of the residuals in a time or with sweeps, over the cases: misses cannot be averaged away
Groups = Mapping[tuple[str, str], Sequence[Record]]  # usable runs by (case, solver)
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

    @property
    def best(self) -> Choice | None:
        """The recommended one; None when nobody got there."""
        return self.ranking[0] if self.ranking and self.ranking[0].solved else None

    @property
    def ties(self) -> tuple[str, ...]:
        """Names of those that are as good as the best, within noise."""
        return tuple(c.solver for c in self.ranking[1 : self.equal]) if self.best else ()


def ranked(
    family: str, target: float, places: Iterable[tuple[tuple[float, ...], Choice]], noise: float
) -> Advice:
    """Order of merit: by key, then by score; who is within noise of the best, by name, so that a rerun agrees.

    Parameters
    ----------
    family, target : of the advice
    places : (key, choice); a smaller key is better whatever the score
    noise : factor within which scores are equal
    """
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
    size: int
    sequence: bool
    by_level: Mapping[float, Advice]
    by_time: Mapping[float, Advice]
    by_sweeps: Mapping[float, Advice]


def advice(records: Records, times: Sequence[float] = ()) -> list[Line]:
    """Every recommendation: structures, then sequences; at each level, within each time [s], with each budget."""
    times = tuple(times) or time_budgets(records)
    steps = {name: passes[0].steps for name, passes in by_sequence(records).items()}
    sizes = {name: len(cases) for name, cases in families(records).items()}
    steps_level, steps_time = advice_by_sequence(records, times)
    found: dict[str, list[dict[float, Advice]]] = defaultdict(lambda: [{}, {}, {}])
    by_level, by_time = (
        [*advice_by_level(records), *steps_level],
        [*advice_by_time(records, times), *steps_time],
    )
    for i, some in enumerate((by_level, by_time, advice_by_sweeps(records))):
        for a in some:
            found[a.family][i][a.target] = a
    return [Line(name, size, of is steps, *found[name]) for of in (sizes, steps) for name, size in of.items()]


def advice_by_level(records: Records) -> list[Advice]:
    """For each structure and level: first who solves most cases, then who is fastest (shifted geometric mean).

    A solver whose claim was wrong on a case of the family at any level comes after all that were not.
    """
    groups = _cold(records)
    return [
        to_level(records, family, cases, level, groups)
        for family, cases in families(records).items()
        for level in levels_of(records)
    ]


def to_level(
    records: Records, family: str, cases: Sequence[str], level: float, groups: Groups | None = None
) -> Advice:
    """Who brings these cases to a level; see `advice_by_level`. `groups` spares another pass over the records."""
    limit, groups = limit_of(records), groups or _cold(records)
    liars = {(r.case, r.solver) for r in records if r.contradicted}
    places: list[tuple[tuple[float, ...], Choice]] = []
    for solver in sorted({s for c, s in groups if c in cases}):
        runs = {c: _quickest(groups.get((c, solver), ()), level) for c in cases}
        solved = [r for r in runs.values() if r is not None]
        times = {c: math.inf if r is None else r.time_min for c, r in runs.items()}
        charged = [min(t, limit) if math.isinf(t) else t for t in times.values()]
        choice = Choice.of(solver, times, len(solved), geometric_mean(charged, SHIFT), **_budget(solved))
        lies = any((c, solver) in liars for c in cases)
        places.append(((lies, -len(solved)), choice))
    return ranked(family, level, places, NOISE)


def _quickest(runs: Iterable[Record], level: float) -> Record | None:
    return min((r for r in runs if r.relative <= level), key=lambda r: r.time_min, default=None)


def _cold(records: Records) -> dict[tuple[str, str], list[Record]]:
    # Usable runs from a cold start by (case, solver); a pair that has none is there, with none.
    return {
        (c, s): [r for r in g if r.usable] for (c, s, start), g in pairs(records).items() if start == "cold"
    }


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


def advice_by_time(records: Records, times: Sequence[float] = ()) -> list[Advice]:
    """For each structure and time budget: who serves most cases in that time, then the residual at the 90th percentile.

    A case is served where at most half of the start's residual is left. A solver with nothing to show in the time
    scores 1 on that case: doing nothing. `times` [s]; `time_budgets` if none are given.
    """
    times, groups = tuple(times) or time_budgets(records), _cold(records)
    return [
        within(records, family, cases, limit, groups)
        for family, cases in families(records).items()
        for limit in times
    ]


def within(
    records: Records, family: str, cases: Sequence[str], limit: float, groups: Groups | None = None
) -> Advice:
    """Who comes closest on these cases within a time [s]; see `advice_by_time`.

    A run that takes the time within noise may be in it or not the next time: who would be the best with it is
    as good as the best.
    """
    groups = groups or _cold(records)
    liars = {(r.case, r.solver) for r in records if r.contradicted}
    places: list[tuple[tuple[float, ...], Choice]] = []
    hopes: dict[str, tuple[tuple[float, ...], float]] = {}
    for solver in sorted({s for c, s in groups if c in cases}):
        lies = any((c, solver) in liars for c in cases)
        got = {c: _closest(groups.get((c, solver), ()), limit) for c in cases}
        hoped = _residuals({c: _closest(groups.get((c, solver), ()), NOISE * limit) for c in cases})
        hopes[solver] = ((lies, -_served(hoped)), quantile(list(hoped.values()), QUANTILE))
        done = [r for r in got.values() if r is not None]
        choice = _by_residual(solver, _residuals(got), **_budget(done))
        places.append(((lies, -choice.solved), choice))
    found = ranked(family, limit, places, RESIDUAL_NOISE)
    if found.best is None:
        return found
    best = min(c.score for c in found.ranking[: found.equal])
    first = min(key for key, _ in places)
    near = [
        c
        for c in found.ranking[found.equal :]
        if hopes[c.solver][0] <= first and hopes[c.solver][1] <= RESIDUAL_NOISE * best
    ]
    rest = [c for c in found.ranking[found.equal :] if all(c is not n for n in near)]
    return Advice(family, limit, (*found.ranking[: found.equal], *near, *rest), found.equal + len(near))


def _residuals(runs: Mapping[str, Record | None]) -> dict[str, float]:
    return {c: 1.0 if r is None else _score(r.relative) for c, r in runs.items()}


def _served(residuals: Mapping[str, float]) -> int:
    return sum(r <= HALF for r in residuals.values())


def _by_residual(solver: str, residuals: Mapping[str, float], **more: Any) -> Choice:
    """A standing by what is left on each case."""
    score = quantile(list(residuals.values()), QUANTILE)
    return Choice.of(solver, residuals, _served(residuals), score, **more)


def _budget(runs: Sequence[Record]) -> dict[str, Any]:
    """The median of the sweeps of these runs, where all of them count sweeps."""
    sweeps = [r.work["sweeps"] for r in runs if "sweeps" in r.work]
    middle = round(median(sweeps)) if runs and len(sweeps) == len(runs) else 0
    return {"how": f"{middle} sweeps" if middle else "", "iterations": middle}


def _steps(values: Sequence[float]) -> dict[str, float]:
    return {f"step {i}": x for i, x in enumerate(values)}


def counts_sweeps(r: Record) -> bool:
    """A budget whose iterations are sweeps, so that it bounds what a solve takes."""
    return 0 < r.work.get("sweeps", 0) <= r.max_iter


def advice_by_sweeps(records: Records) -> list[Advice]:
    """For each structure and sequence and each budget: who serves most cases with so many sweeps, ranked as in a time.

    Solvers whose iterations are sweeps: the others' cost nobody can compare by number.
    """
    liars = {(r.case, r.solver) for r in records if r.contradicted}
    runs: dict[tuple[str, int, str], dict[str, Record]] = {}
    for r in records:
        plain = r.order == "given" and not r.turns and r.start in ("cold", "carried") and r.usable
        if plain and r.mode == "budget" and counts_sweeps(r):
            runs.setdefault((r.solver, r.max_iter, "" if r.step < 0 else r.start), {})[r.case] = r
    steps: dict[str, list[str]] = {}
    for name, info in records.cases.items():
        if info.sequence:
            steps.setdefault(info.sequence, []).append(name)
    out = []
    for family, cases in [*families(records).items(), *steps.items()]:
        for n in sorted({n for _, n, _ in runs}):
            places: list[tuple[tuple[float, ...], Choice]] = []
            for (solver, budget, start), by_case in runs.items():
                if budget != n or not any(c in by_case for c in cases):
                    continue
                residuals = _residuals({c: by_case.get(c) for c in cases})
                choice = _by_residual(solver, residuals, how=start, iterations=n)
                places.append(((any((c, solver) in liars for c in cases), -choice.solved), choice))
            out.append(ranked(family, float(n), _best_of_each(places), RESIDUAL_NOISE))
    return out


def _closest(runs: Iterable[Record], limit: float) -> Record | None:
    return min((r for r in runs if r.time_min <= limit), key=lambda r: r.relative, default=None)


def _score(residual: float) -> float:
    # What counts in a geometric mean: nothing is better than exact, or worse than doing nothing.
    return min(max(residual, 1e-17), 1.0) if residual == residual else 1.0


def advice_by_sequence(records: Records, times: Sequence[float] = ()) -> tuple[list[Advice], list[Advice]]:
    """For each sequence, by level and by time of a step: which solver and budget, carried or cold; see `over_steps`."""
    times = tuple(times) or time_budgets(records)
    found = [
        over_steps(name, passes, levels_of(records), times) for name, passes in by_sequence(records).items()
    ]
    return [a for some, _ in found for a in some], [a for _, some in found for a in some]


def over_steps(
    name: str, passes: Sequence[Pass], levels: Sequence[float], times: Sequence[float]
) -> tuple[list[Advice], list[Advice]]:
    """Who brings the steps of these passes to each level, and who comes closest in each time [s] of a step.

    To a level, by those that were asked for it or have a budget: who brings most steps there, then the geometric mean
    of their times. In a time: who serves most steps, then the residual at the 90th percentile; a step that was not
    solved or took longer counts 1. A false claim on any step comes last. Steps of several sequences count together.
    """
    whole = sum({w.sequence: w.steps for w in passes}.values())
    ways: dict[tuple[str, str, str], list[Pass]] = defaultdict(list)
    for w in passes:
        for start in w.residuals:
            ways[w.solver, w.asked, start].append(w)
    by_level: list[Advice] = []
    by_time: list[Advice] = []
    for target, timed in [*((x, False) for x in levels), *((t, True) for t in times)]:
        places: list[tuple[tuple[float, ...], Choice]] = []
        for (solver, asked, start), some in ways.items():
            taken = [t for w in some for t in w.times[start]]
            left = [r for w in some for r in w.residuals[start]]
            first, wrong = some[0], any(w.wrong[start] for w in some)
            budget = {
                "how": f"{asked}, {start}",
                "iterations": first.max_iter if first.mode == "budget" else 0,
            }
            if timed:
                got = [_score(r) if t <= target else 1.0 for t, r in zip(taken, left, strict=True)]
                got += [1.0] * (whole - len(got))
                choice = _by_residual(solver, _steps(got), **budget)
            elif first.mode == "tol" and first.tol > target:
                continue
            else:
                solved = sum(r <= target for r in left)
                score = geometric_mean(taken, SHIFT)
                choice = Choice.of(solver, _steps(taken), solved, score, cases=whole, **budget)
            places.append(((wrong, -choice.solved), choice))
        found = ranked(name, target, _best_of_each(places), RESIDUAL_NOISE if timed else NOISE)
        (by_time if timed else by_level).append(found)
    return by_level, by_time


def _best_of_each(
    places: Iterable[tuple[tuple[float, ...], Choice]],
) -> list[tuple[tuple[float, ...], Choice]]:
    # The best way of each solver.
    first: dict[str, tuple[tuple[float, ...], Choice]] = {}
    for place in sorted(places, key=lambda pair: (pair[0], pair[1].score)):
        first.setdefault(place[1].solver, place)
    return list(first.values())


def quantile(values: Sequence[float], q: float) -> float:
    """The smallest value that at least a share q of them does not exceed."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, math.ceil(q * len(ordered)) - 1)]
