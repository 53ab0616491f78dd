"""Records -> plain tables (lists of small frozen rows). Nothing is solved, timed or drawn here.

Time to a level: the smallest time of any run whose judged residual is at or below it, whatever was asked
for: runs are matched by the accuracy they reached, never by the one they were asked for.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median

from lavender.bench.record import Record, level_name
from lavender.bench.store import Records

__all__ = [
    "Advice",
    "Change",
    "Choice",
    "Claims",
    "Failure",
    "Line",
    "Profile",
    "Reach",
    "Robustness",
    "Spread",
    "Walk",
    "advice",
    "advice_by_level",
    "advice_by_sequence",
    "advice_by_time",
    "budgets",
    "by_sequence",
    "changes",
    "claims",
    "failures",
    "families",
    "geometric_means",
    "is_campaign",
    "levels_of",
    "limit_of",
    "pairs",
    "profiles",
    "reaches",
    "robustness",
    "shift_of",
    "spreads",
    "time_budgets",
    "walks",
]

DIED = ("ERROR", "KILLED", "CRASHED")


@dataclass(frozen=True)
class Reach:
    """How far and how fast one solver came on one case."""

    case: str
    solver: str
    start: str
    times: Mapping[float, float]  # s to each level, inf where it was not reached
    best: float  # smallest relative residual of any run
    best_time: float  # s, of that run
    floor: float  # of that run
    status: str  # of the run to the tightest level asked for
    contradicted: str
    message: str
    worst_name: str
    form: str

    @property
    def at_floor(self) -> bool:
        """No better residual can be asked of float64."""
        return self.best <= 2.0 * self.floor


@dataclass(frozen=True)
class Failure:
    """A run that missed what it was asked for, or whose claim does not hold."""

    case: str
    solver: str
    asked: str
    start: str
    status: str
    relative: float
    floor: float
    worst_name: str
    contradicted: str
    message: str


@dataclass(frozen=True)
class Claims:
    """What a solver said of itself, against the judge."""

    solver: str
    runs: int
    claims: int  # says CONVERGED, FLOOR or INFEASIBLE
    wrong: int
    reached: int  # runs to a level that the judge confirms
    asked: int
    crashed: int  # ERROR, KILLED, CRASHED

    @property
    def rate(self) -> float:
        """Share of claims that the judge confirms; nan without claims."""
        return 1.0 - self.wrong / self.claims if self.claims else math.nan


@dataclass(frozen=True)
class Choice:
    """One solver's standing in a family of cases, or over the steps of a sequence."""

    solver: str
    solved: int
    cases: int
    score: float  # what ranks: shifted geometric mean of times [s], or geometric mean of residuals
    typical: float  # s, median time on the cases it solved; nan for a time budget
    how: str = ""  # the budget that does it, and for a sequence whether impulses are carried


@dataclass(frozen=True)
class Advice:
    """Solvers of a family in order of merit for one accuracy level or time budget."""

    family: str
    target: float  # level [-] or time [s]
    ranking: tuple[Choice, ...]

    @property
    def best(self) -> Choice | None:
        """The recommended one; None when nobody got there."""
        return self.ranking[0] if self.ranking and self.ranking[0].solved else None


@dataclass(frozen=True)
class Line:
    """A line of the table of recommendations: a structure and its cases, or a sequence and its steps."""

    name: str
    size: int
    sequence: bool
    by_level: Mapping[float, Advice]
    by_time: Mapping[float, Advice]


@dataclass(frozen=True)
class Profile:
    """Dolan-More performance profile of one level over the cases of one law."""

    law: str
    level: float
    cases: int
    curves: Mapping[str, tuple[tuple[float, float], ...]]  # solver -> (ratio, share) steps


@dataclass(frozen=True)
class Walk:
    """One solver over one sequence at one budget or level: cold, and with its impulses carried along."""

    sequence: str
    solver: str
    mode: str
    tol: float
    max_iter: int
    steps: int  # of the sequence; a pass that was stopped has fewer
    times: Mapping[str, tuple[float, ...]]  # start -> s of each step
    iterations: Mapping[str, int]
    residuals: Mapping[str, tuple[float, ...]]  # start -> of each step
    wrong: Mapping[str, int]  # start -> steps with a claim that does not hold

    @property
    def asked(self) -> str:
        """The budget or the level."""
        return f"{self.max_iter} iterations" if self.mode == "budget" else f"to {level_name(self.tol)}"

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


@dataclass(frozen=True)
class Spread:
    """Residual at one budget over sweep orders."""

    case: str
    solver: str
    budget: int
    by_order: Mapping[str, float]
    floor: float = 0.0  # below it residuals are rounding

    @property
    def factor(self) -> float:
        """Worst over best order, neither counted as better than the floor."""
        values = [max(v, self.floor) for v in self.by_order.values() if max(v, self.floor) > 0.0]
        return max(values) / min(values) if values else 1.0


# -- groups ---------------------------------------------------------------------------------------


def levels_of(records: Records) -> tuple[float, ...]:
    """Levels of the newest run's plan, loosest first; else the tolerances that were asked for."""
    for run in reversed(list(records.runs.values())):
        if run.plan.get("levels"):
            return tuple(sorted(map(float, run.plan["levels"]), reverse=True))
    return tuple(sorted({r.tol for r in records if r.mode == "tol"}, reverse=True)) or (1e-3, 1e-6, 1e-9)


def pairs(records: Iterable[Record]) -> dict[tuple[str, str, str], list[Record]]:
    """Runs in the given order of blocks, by (case, solver, start)."""
    groups: dict[tuple[str, str, str], list[Record]] = defaultdict(list)
    for r in records:
        if r.order == "given" and r.step < 0:
            groups[r.case, r.solver, r.start].append(r)
    return dict(groups)


def families(records: Records) -> dict[str, list[str]]:
    """Structure -> cases, biggest first. A case is in every family whose word describes it."""
    found: dict[str, list[str]] = defaultdict(list)
    ran = {r.case for r in records if r.step < 0}
    for name, info in records.cases.items():
        if name in ran:
            for word in info.structure:
                found[word].append(name)
    shapes = ("separate", "chain", "mesh", "stack", "pile", "dense")
    order = (*shapes, "redundant", "friction", "large mass ratio", "asymmetric")
    return {
        w: found[w] for w in sorted(found, key=lambda w: (order.index(w) if w in order else len(order), w))
    }


# -- per case -------------------------------------------------------------------------------------


def reaches(records: Records, levels: Sequence[float] | None = None) -> list[Reach]:
    """One row for each case, solver and start, in the order of the records."""
    levels = levels_of(records) if levels is None else tuple(levels)
    out = []
    for (case, solver, start), group in pairs(records).items():
        good = [r for r in group if r.usable]
        best = min(good, key=lambda r: (r.relative, r.time_min), default=None)
        asked = [r for r in group if r.mode == "tol"] or group
        last = asked[-1]
        out.append(
            Reach(
                case,
                solver,
                start,
                {
                    level: min((r.time_min for r in good if r.relative <= level), default=math.inf)
                    for level in levels
                },
                best.relative if best else math.inf,
                best.time_min if best else math.nan,
                best.floor if best else math.nan,
                last.status,
                next((r.contradicted for r in group if r.contradicted), ""),
                last.message,
                last.worst_name,
                last.form,
            )
        )
    return out


def failures(records: Records) -> list[Failure]:
    """Runs to a level that the judge does not confirm (nor the floor excuses), crashes, and false claims."""
    out = []
    for r in records:
        missed = r.mode == "tol" and not r.success and not r.relative <= 2.0 * r.floor
        proven = r.status == "INFEASIBLE" and not r.contradicted
        lost = not math.isfinite(r.relative) or r.status.startswith(DIED)
        if (missed and not proven) or lost or r.contradicted:
            asked = (
                f"relative residual {level_name(r.tol)}" if r.mode == "tol" else f"{r.max_iter} iterations"
            )
            if r.order != "given":
                asked += f", order {r.order}"
            out.append(
                Failure(
                    r.case,
                    r.solver,
                    asked,
                    r.start,
                    r.status,
                    r.relative,
                    r.floor,
                    r.worst_name,
                    r.contradicted,
                    r.message,
                )
            )
    return out


def claims(records: Records) -> list[Claims]:
    """By solver: how often its claim holds."""
    out = []
    for solver in sorted({r.solver for r in records}):
        mine = [r for r in records if r.solver == solver]
        asked = [r for r in mine if r.mode == "tol"]
        out.append(
            Claims(
                solver,
                len(mine),
                sum(r.claims for r in mine),
                sum(r.claims and bool(r.contradicted) for r in mine),
                sum(r.success for r in asked),
                len(asked),
                sum(r.status.startswith(DIED) for r in mine),
            )
        )
    return out


def spreads(records: Records) -> list[Spread]:
    """Where one budget was run in several sweep orders, the residual of each."""
    groups: dict[tuple[str, str, int], dict[str, Record]] = defaultdict(dict)
    for r in records:
        if r.mode == "budget" and r.start == "cold" and r.step < 0:
            name = f"{r.order} {r.seed}" if r.order == "random" else r.order
            groups[r.case, r.solver, r.max_iter][name] = r
    return [
        Spread(*key, {name: r.relative for name, r in by.items()}, max(r.floor for r in by.values()))
        for key, by in groups.items()
        if len(by) > 1
    ]


def budgets(records: Records) -> dict[tuple[str, str, str], list[tuple[int, float]]]:
    """(case, solver, start) -> (iterations, residual) of the exact budgets, given order."""
    groups: dict[tuple[str, str, str], list[tuple[int, float]]] = defaultdict(list)
    for r in records:
        if r.mode == "budget" and r.order == "given" and r.step < 0 and r.status == "MAX_ITERATIONS":
            groups[r.case, r.solver, r.start].append((r.iterations, r.relative))
    return {key: sorted(points) for key, points in groups.items()}


# -- over cases -----------------------------------------------------------------------------------


def geometric_mean(values: Sequence[float], shift: float = 0.0) -> float:
    """exp(mean(log(x + shift))) - shift; nan for nothing."""
    if not values:
        return math.nan
    return math.exp(sum(math.log(v + shift) for v in values) / len(values)) - shift


def _times(records: Records, level: float) -> dict[str, dict[str, float]]:
    # case -> solver -> time to the level from a cold start, inf where missed; refused solvers are absent.
    out: dict[str, dict[str, float]] = defaultdict(dict)
    for reach in reaches(records, [level]):
        if reach.start == "cold":
            out[reach.case][reach.solver] = reach.times[level]
    return out


def shift_of(records: Records) -> float:
    """Shift of the geometric means [s]: the median over cases of the fastest time to the loosest level."""
    level = levels_of(records)[0]
    fastest = [min(by.values()) for by in _times(records, level).values() if by]
    fastest = [t for t in fastest if math.isfinite(t)]
    return float(f"{median(fastest):.1g}") if fastest else 1e-3


def limit_of(records: Records) -> float:
    """What a missed level is charged [s]: the time limit."""
    return max((r.time_limit for r in records), default=1.0)


def geometric_means(records: Records) -> dict[str, dict[float, dict[str, tuple[float, int, int]]]]:
    """law -> level -> solver -> (shifted geometric mean [s], solved, cases); a miss costs the time limit.

    A solver stands in a law's table when it takes every case of it.
    """
    shift, limit = shift_of(records), limit_of(records)
    out: dict[str, dict[float, dict[str, tuple[float, int, int]]]] = {}
    for law, cases in _laws(records).items():
        out[law] = {}
        for level in levels_of(records):
            times = _times(records, level)
            by: dict[str, tuple[float, int, int]] = {}
            for solver in _whole(times, cases):
                t = [times[c][solver] for c in cases]
                solved = sum(map(math.isfinite, t))
                by[solver] = (
                    geometric_mean([x if math.isfinite(x) else limit for x in t], shift),
                    solved,
                    len(cases),
                )
            out[law][level] = dict(sorted(by.items(), key=lambda kv: kv[1][0]))
    return out


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
            times = _times(records, level)
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


def advice(records: Records, times: Sequence[float] = ()) -> list[Line]:
    """Every recommendation: structures, then sequences; at each level and within each time [s]."""
    times = tuple(times) or time_budgets(records)
    steps = {name: walks[0].steps for name, walks in by_sequence(records).items()}
    sizes = {name: len(cases) for name, cases in families(records).items()}
    lines = []
    by_sequence_level, by_sequence_time = advice_by_sequence(records, times)
    for sizes_of, sequence, by_level, by_time in (
        (sizes, False, advice_by_level(records), advice_by_time(records, times)),
        (steps, True, by_sequence_level, by_sequence_time),
    ):
        for name, size in sizes_of.items():
            found = ({a.target: a for a in some if a.family == name} for some in (by_level, by_time))
            lines.append(Line(name, size, sequence, *found))
    return lines


def advice_by_level(records: Records) -> list[Advice]:
    """For each structure and level: first who solves most cases, then who is fastest (shifted geometric mean).

    A solver whose claim was wrong on a case of the family at any level comes after all that were not.
    """
    shift, limit = shift_of(records), limit_of(records)
    liars = {(r.case, r.solver) for r in records if r.contradicted}
    groups = _cold(records)
    out = []
    for family, cases in families(records).items():
        solvers = sorted({s for c, s in groups if c in cases})
        for level in levels_of(records):
            choices = []
            for solver in solvers:
                runs = [
                    min(
                        (r for r in groups.get((c, solver), ()) if r.relative <= level),
                        key=lambda r: r.time_min,
                        default=None,
                    )
                    for c in cases
                ]
                solved = [r for r in runs if r is not None]
                t = [r.time_min for r in solved]
                score = geometric_mean(t + [limit] * (len(cases) - len(t)), shift)
                sweeps = [r.work["sweeps"] for r in solved if "sweeps" in r.work]
                how = f"{median(sweeps):.0f} sweeps" if solved and len(sweeps) == len(solved) else ""
                choices.append(Choice(solver, len(t), len(cases), score, median(t) if t else math.nan, how))
            choices.sort(key=lambda k: (any((c, k.solver) in liars for c in cases), -k.solved, k.score))
            out.append(Advice(family, level, tuple(choices)))
    return out


def _cold(records: Records) -> dict[tuple[str, str], list[Record]]:
    # Usable runs from a cold start by (case, solver); a pair that has none is there, with none.
    return {
        (c, s): [r for r in g if r.usable] for (c, s, start), g in pairs(records).items() if start == "cold"
    }


def time_budgets(records: Records) -> tuple[float, ...]:
    """Three decades of time [s] about the median of the fastest times to the middle level."""
    levels = levels_of(records)
    level = levels[len(levels) // 2]
    fastest = [min(by.values()) for by in _times(records, level).values() if by]
    for walks in by_sequence(records).values():
        reached = [
            median(w.times[start])
            for w in walks
            for start, residuals in w.residuals.items()
            if len(residuals) == w.steps and max(residuals) <= level
        ]
        fastest.append(min(reached, default=math.inf))
    fastest = [t for t in fastest if 0.0 < t < math.inf]
    middle = math.ceil(math.log10(median(fastest))) if fastest else -3
    return tuple(10.0**k for k in (middle - 1, middle, middle + 1))


def advice_by_time(records: Records, times: Sequence[float] = ()) -> list[Advice]:
    """For each structure and time budget: the smallest geometric mean of residuals reached in that time.

    A solver with nothing to show in the time scores 1 on that case: doing nothing. "Solved" counts the
    cases on which it brought anything back. `times` [s]; `time_budgets` if none are given.
    """
    out = []
    groups = _cold(records)
    for family, cases in families(records).items():
        solvers = sorted({s for c, s in groups if c in cases})
        for limit in tuple(times) or time_budgets(records):
            choices = []
            for solver in solvers:
                got = [
                    min(
                        (r.relative for r in groups.get((c, solver), ()) if r.time_min <= limit), default=None
                    )
                    for c in cases
                ]
                score = geometric_mean([1.0 if g is None else _score(g) for g in got])
                choices.append(Choice(solver, sum(g is not None for g in got), len(cases), score, math.nan))
            choices.sort(key=lambda k: (k.score, -k.solved))
            out.append(Advice(family, limit, tuple(choices)))
    return out


def _score(residual: float) -> float:
    # What counts in a geometric mean: nothing is better than exact, or worse than doing nothing.
    return min(max(residual, 1e-17), 1.0) if residual == residual else 1.0


def advice_by_sequence(records: Records, times: Sequence[float] = ()) -> tuple[list[Advice], list[Advice]]:
    """For each sequence, by level and by time of a step: which solver, which budget, carried or cold.

    To a level: who brings most steps there, then who takes least time over all steps. In a time (the median
    step keeps to it): the smallest geometric mean of the residuals; a step that was not solved counts 1. A
    false claim on any step comes last.
    """
    times = tuple(times) or time_budgets(records)
    by_level, by_time = [], []
    for name, walks in by_sequence(records).items():
        runs = [(w, start, f"{w.asked}, {start}") for w in walks for start in w.residuals]
        for level in levels_of(records):
            ranked: list[tuple[tuple[float, ...], Choice]] = []
            for w, start, how in runs:
                solved = sum(r <= level for r in w.residuals[start])
                choice = Choice(w.solver, solved, w.steps, w.time[start], median(w.times[start]), how)
                ranked.append(((bool(w.wrong[start]), -solved, choice.score), choice))
            by_level.append(Advice(name, level, _best_of_each(ranked)))
        for limit in times:
            ranked = []
            for w, start, how in runs:
                if median(w.times[start]) <= limit:
                    done = [_score(r) for r in w.residuals[start]]
                    score = geometric_mean(done + [1.0] * (w.steps - len(done)))
                    choice = Choice(w.solver, len(done), w.steps, score, math.nan, how)
                    ranked.append(((bool(w.wrong[start]), score, w.time[start]), choice))
            by_time.append(Advice(name, limit, _best_of_each(ranked)))
    return by_level, by_time


def _best_of_each(ranked: Iterable[tuple[tuple[float, ...], Choice]]) -> tuple[Choice, ...]:
    # The best way of each solver, best solver first.
    first: dict[str, Choice] = {}
    for _, choice in sorted(ranked, key=lambda pair: pair[0]):
        first.setdefault(choice.solver, choice)
    return tuple(first.values())


def walks(records: Records) -> list[Walk]:
    """Sequences: total time and iterations, residual of each step, carried against cold."""
    groups: dict[tuple[str, str, str, float, int], dict[str, list[Record]]] = defaultdict(
        lambda: defaultdict(list)
    )
    for r in records:
        if r.step >= 0 and r.case in records.cases:
            name = records.cases[r.case].sequence
            groups[name, r.solver, r.mode, r.tol, r.max_iter][r.start].append(r)
    steps = Counter(info.sequence for info in records.cases.values())
    out = []
    for key, by_start in groups.items():
        for group in by_start.values():
            group.sort(key=lambda r: r.step)
        out.append(
            Walk(
                *key,
                steps[key[0]],
                {s: tuple(_step_time(r) for r in g) for s, g in by_start.items()},
                {s: sum(r.iterations for r in g) for s, g in by_start.items()},
                {s: tuple(r.relative for r in g) for s, g in by_start.items()},
                {s: sum(bool(r.contradicted) for r in g) for s, g in by_start.items()},
            )
        )
    return out


def _step_time(r: Record) -> float:
    # A step that brought nothing back took its limit.
    return r.time_min if math.isfinite(r.time_min) else r.time_limit


def by_sequence(records: Records) -> dict[str, list[Walk]]:
    """Walks of each sequence."""
    out: dict[str, list[Walk]] = defaultdict(list)
    for walk in walks(records):
        out[walk.sequence].append(walk)
    return dict(out)


NOISE = 1.25  # a factor of time below which nothing is said: what a busy machine does to a minimum of repeats


def changes(old: Records, new: Records) -> list[Change]:
    """Time to each level in two runs, on the cases whose numbers are the same in both.

    Noise is at least `NOISE`, and at least twice the spread between minimum and median of either run.
    """
    levels = levels_of(new)
    same = {name for name, info in new.cases.items() if name in old.cases and old.cases[name].sha == info.sha}
    before = {(r.case, r.solver, r.start): r for r in reaches(old, levels)}
    spread: dict[tuple[str, str, str], float] = defaultdict(lambda: 1.0)
    for records in (old, new):
        for key, group in pairs(records).items():
            for r in group:
                if r.usable and r.time_min > 0.0:
                    spread[key] = max(spread[key], r.time_median / r.time_min)
    out = []
    for row in reaches(new, levels):
        key = (row.case, row.solver, row.start)
        if row.case not in same or key not in before:
            continue
        noise = max(NOISE, 1.0 + 2.0 * (spread[key] - 1.0))
        out += [Change(*key, x, before[key].times[x], row.times[x], noise) for x in levels]
    return out


def is_campaign(records: Records) -> bool:
    """Times were left out on purpose."""
    return any(run.plan.get("campaign") for run in records.runs.values())


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
                    family,
                    solver,
                    len(mine),
                    {x: sum(v <= x for v in best.values()) for x in levels},
                    sum(bool(r.contradicted) for r in runs),
                    sum(r.status.startswith(DIED) for r in runs),
                    {n: (median(v), _quantile(v, 0.95)) for n, v in sorted(by_budget.items())},
                    max(best, key=lambda c: best[c]),
                )
            )
    return out


def _quantile(values: Sequence[float], q: float) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, math.ceil(q * len(ordered)) - 1)]
