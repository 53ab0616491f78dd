"""Lines that were timed interleaved with each other: which wins, and in how many resamplings.

A resampling draws the cases and the repetitions of the whole with replacement (a sequence's steps in blocks of
consecutive ones, since neighbours are alike). In each the lines are ranked as the tables rank; who is within noise of
the best wins. Noise is of what a score differs by between repetitions of the whole, not between repeats in one loop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.lab.bench.record import Record
from lavender.lab.bench.store import Records
from lavender.lab.bench.timed_call import format_call
from lavender.lab.report import choices
from lavender.lab.report.choices import FIRST, HALF, QUANTILE, Advice, Choice, counts_sweeps
from lavender.lab.report.tables import SHIFT, levels_of, limit_of

SAMPLES = 500
AT_ONCE = 1_000_000  # numbers of a few samples
SURE = 0.8  # share of resamplings below which a second name is told
SOMETIMES = 0.2  # share from which another is as good a choice
NOISE = 1.05  # at least: what nobody notices
BLOCKS = 10  # that the steps of a sequence are cut into
QUIET = 0.25  # quantile of the repetitions that is a line's time: what else the machine does only ever adds
TICK = 1e-12  # s, less than any clock tells
LATE = 0.95  # of the repeats, that have to be in time


@dataclass(frozen=True)
class Final:
    """One line on all of its cases."""

    runs: Mapping[str, Record]  # by case
    guessed: bool  # some of these bring a guess

    @property
    def line(self) -> Record:
        """A record that says what the line is."""
        return next(iter(self.runs.values()))

    @property
    def code(self) -> tuple[str, ...]:
        """To copy."""
        return format_call(self.line, self.guessed)

    @property
    def time(self) -> float:
        """Geometric mean over the cases of the lower quartile of the repetitions [s], with the shift of the tables."""
        each = [float(np.quantile(r.times or (r.time_min,), QUIET)) for r in self.runs.values()]
        return float(np.exp(np.mean(np.log(np.array(each) + SHIFT))) - SHIFT)


@dataclass(frozen=True)
class Race:
    """Who is to be recommended, and how sure that is."""

    ranking: tuple[tuple[Final, Choice], ...]  # the recommended one first
    shares: tuple[float, ...]  # of the resamplings that each wins, in this order
    loss: float  # score of the recommended over the best's where it does not win, median; 1 where it always wins

    @property
    def named(self) -> tuple[str, ...]:
        """The recommended solver, and those that are as good a choice; a second where it is not sure."""
        solvers = [choice.solver for _, choice in self.ranking]
        others = [s for s, share in zip(solvers[1:], self.shares[1:], strict=True) if share >= SOMETIMES]
        if not others and self.shares[0] < SURE and len(solvers) > 1:
            others = [solvers[1 + int(np.argmax(self.shares[1:]))]]
        return tuple(dict.fromkeys([solvers[0], *others]))


def lines(records: Records, way: str, rounds: bool = True) -> list[Final]:
    """Every line of that way ("call", "steps", "batch") that was run on as many cases as any.

    Of those that were timed in turns; not `rounds`: of what was measured one after the other, which records of old have
    alone.
    """
    groups: dict[tuple[object, ...], dict[str, Record]] = {}
    for r in records:
        mine = r.way == way or (not r.way and not rounds and (r.step >= 0) is (way == "steps"))
        plain = r.order == "given" and r.start != "warm" and (r.mode != "budget" or counts_sweeps(r))
        if mine and plain and bool(r.turns) is rounds and r.case in records.cases:
            key = (r.solver, r.mode, r.tol, r.max_iter, r.time_limit, r.start)
            groups.setdefault(key, {})[r.case] = r
    most = max((len(runs) for runs in groups.values()), default=0)
    found = [
        Final(runs, any(records.cases[c].guess for c in runs))
        for runs in groups.values()
        if len(runs) == most
    ]
    if way != "batch":
        return found
    # A batch of some of the cases says nothing beside a call on all of them.
    whole = {(f.line.solver, *sorted(f.runs)) for one in ("call", "steps") for f in lines(records, one)}
    return [f for f in found if (f.line.solver, *sorted(f.runs)) in whole]


STARTS = {"cold": "cold", "carried": "warm from the step before"}


def _best_of_each(some: Sequence[Final], level: float) -> list[Final]:
    """One line of each solver: cold or carried, whichever brings more cases to the level, then the quicker."""
    best: dict[str, Final] = {}
    for final in sorted(some, key=lambda f: (sum(not r.relative <= level for r in f.runs.values()), f.time)):
        best.setdefault(final.line.solver, final)
    return list(best.values())


def to_level(records: Records, some: Sequence[Final], level: float, cases: int = 0) -> Race | None:
    """Lines that ask for a residual: first who brings most cases there, then the geometric mean of times.

    `cases` there are, where lines were timed on fewer.
    """
    some = _best_of_each([f for f in some if f.line.mode == "tol" and f.line.tol <= level], level)
    if not some:
        return None
    limit, names = limit_of(records), _names(some)
    missed = np.array([[c not in f.runs or not f.runs[c].relative <= level for c in names] for f in some])
    times = _repeats(some, names, lambda r: r.times or (r.time_min,))
    charged = np.where(missed[:, :, None] | ~np.isfinite(times), limit, times)

    def score(values: FloatArray) -> FloatArray:
        found = np.exp(np.log(np.quantile(values, QUIET, axis=-1) + SHIFT).mean(axis=-1)) - SHIFT
        return np.asarray(np.maximum(found, TICK))

    def choice(i: int, value: float) -> Choice:
        each = np.where(missed[i], math.inf, np.quantile(times[i], QUIET, axis=1))
        found = dict(zip(names, each.tolist(), strict=True))
        solved = int((~missed[i]).sum())
        return Choice.of(some[i].line.solver, found, solved, value, cases=max(cases, len(found)))

    return _race(records, some, names, charged, missed, score, choice)


def advice(records: Records, times: Sequence[float] = ()) -> list[choices.Line]:
    """Every recommendation: as `choices.advice_alone`, and to the middle level by the lines that took turns, if any."""
    levels = levels_of(records)
    level = levels[len(levels) // 2]
    in_turns = {way: lines(records, way) for way in ("call", "steps")}
    found = []
    for line in choices.advice_alone(records, times):
        some = in_turns["steps" if line.sequence else "call"]
        first = recommend(records, line.by_level[level], some, line.cases)
        found.append(replace(line, by_level={**line.by_level, level: first}))
    return found


def recommend(records: Records, alone: Advice, some: Sequence[Final], cases: Sequence[str]) -> Advice:
    """Rank solvers to a level on some cases by the rule and the times of the report's first sentence.

    Solvers whose lines took turns (`some`) come first, then the others of `alone`. Returns `alone` if no line took
    turns on these cases, or if the lines that did solve fewer of them.
    """
    parts = [replace(f, runs={c: f.runs[c] for c in cases if c in f.runs}) for f in some]
    race = to_level(records, [f for f in parts if f.runs], alone.target, len(cases))
    best = alone.ranking[0].solved if alone.ranking else 0
    if race is None or race.ranking[0][1].solved < max(1, best):
        return alone
    hows = {c.solver: c.how for c in alone.ranking}
    raced = [
        replace(c, how=f"{f.line.asked}, {f.line.start}" if f.line.step >= 0 else hows.get(c.solver, ""))
        for f, c in race.ranking
    ]
    raced.sort(key=lambda c: race.named.index(c.solver) if c.solver in race.named else len(raced))
    known = {c.solver for c in raced}
    rest = [c for c in alone.ranking if c.solver not in known]
    return replace(alone, ranking=(*raced, *rest), equal=len(race.named))


def in_time(records: Records, some: Sequence[Final], limit: float, cases: int = 0) -> Race | None:
    """Lines within a time [s]: first the share of cases served, then the residual at the 90th percentile.

    Served: in 95 of 100 repetitions the line took no more than the time and left at most half of the start's residual.
    """
    some = [
        f for f in some if f.line.mode == "budget" or (f.line.mode == "time" and f.line.time_limit < limit)
    ]
    if not some:
        return None
    names = _names(some)
    times = _repeats(some, names, lambda r: r.times or (r.time_min,))
    left = np.minimum(_repeats(some, names, lambda r: r.reached or (r.relative,)), 1.0)
    got = np.where(times <= limit, np.nan_to_num(left, nan=1.0), 1.0)
    served = np.quantile(got, LATE, axis=2, method="lower") <= HALF

    def score(values: FloatArray) -> FloatArray:
        each = np.quantile(values, LATE, axis=-1, method="lower")
        return np.asarray(np.maximum(np.quantile(each, QUANTILE, axis=-1, method="inverted_cdf"), 1e-17))

    def choice(i: int, value: float) -> Choice:
        line, each = some[i].line, np.quantile(got[i], LATE, axis=1, method="lower")
        return Choice.of(
            line.solver,
            dict(zip(names, each.tolist(), strict=True)),
            int(served[i].sum()),
            value,
            cases=max(cases, len(each)),
            how=f"{line.max_iter} sweeps" if line.mode == "budget" else "",
            iterations=line.max_iter,
            overrun=float(np.nanquantile(times[i], LATE, method="lower")) / limit,
        )

    return _race(records, some, names, got, ~served, score, choice)


def serves_in(final: Final) -> float:
    """Time [s] in which a line of exactly so many sweeps serves nine cases of ten, as `in_time`; inf if in none."""
    if final.line.mode != "budget":
        return math.inf
    times = _repeats([final], list(final.runs), lambda r: r.times or (r.time_min,))[0]
    left = np.array([r.relative for r in final.runs.values()])
    late = np.quantile(times, LATE, axis=-1, method="lower")
    return float(np.quantile(np.where(left <= HALF, late, math.inf), QUANTILE, method="inverted_cdf"))


def _names(some: Sequence[Final]) -> list[str]:
    """The cases of all lines; what a line was not run on, for it was refused, it misses."""
    return list(dict.fromkeys(name for f in some for name in f.runs))


def _repeats(
    some: Sequence[Final], names: Sequence[str], what: Callable[[Record], Sequence[float]]
) -> FloatArray:
    """(lines, cases, repetitions), nan where not run; what was repeated less often again from its start."""
    most = max(len(what(r)) for f in some for r in f.runs.values())
    return np.array(
        [[np.resize(what(f.runs[c]) if c in f.runs else np.nan, most) for c in names] for f in some], float
    )


def _blocks(records: Records, names: Sequence[str]) -> list[list[int]]:
    # What is drawn together: a case alone, the consecutive steps of a part of a sequence.
    found: dict[tuple[str, int], list[int]] = {}
    steps: dict[str, int] = {}
    for name in names:
        steps[records.cases[name].sequence] = steps.get(records.cases[name].sequence, 0) + 1
    for i, name in enumerate(names):
        info = records.cases[name]
        size = max(1, steps[info.sequence] // BLOCKS)
        found.setdefault((info.sequence, info.step // size) if info.sequence else (name, -1), []).append(i)
    return list(found.values())


def _drawn(
    blocks: Sequence[Sequence[int]], repeats: int, most: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Up to `most` samples of equally many cases: (samples, cases) and (samples, repetitions), by number."""
    draw = np.random.default_rng(0)
    by_count: dict[int, list[tuple[list[int], np.ndarray]]] = {}
    for _ in range(SAMPLES):
        cases = [i for b in draw.integers(0, len(blocks), len(blocks)) for i in blocks[b]]
        by_count.setdefault(len(cases), []).append((cases, draw.integers(0, repeats, repeats)))
    for alike in by_count.values():
        for at in range(0, len(alike), most):
            cases_of, again = zip(*alike[at : at + most], strict=True)
            yield np.array(cases_of), np.array(again)


def _race(
    records: Records,
    some: Sequence[Final],
    names: Sequence[str],
    values: FloatArray,
    missed: np.ndarray,
    score: Callable[[FloatArray], FloatArray],
    choice: Callable[[int, float], Choice],
) -> Race:
    n, _, repeats = values.shape
    blocks = _blocks(records, names)
    single = np.array([score(values[:, :, k : k + 1]) for k in range(repeats)])  # (repetitions, lines)
    # Two standard errors of the difference of two scores; that of a quartile is 1.36 times a mean's.
    deviation = float(np.median(np.log(single).std(axis=0)))
    noise = max(NOISE, math.exp(2.0 * math.sqrt(2.0) * 1.36 * deviation / math.sqrt(repeats)))
    whole = score(values)
    wins, losses = np.zeros(n), [[] for _ in range(n)]  # type: ignore[var-annotated]
    lying = np.array([any(r.status_conflict for r in f.runs.values()) for f in some])
    for cases, again in _drawn(blocks, repeats, max(1, AT_ONCE // values.size)):
        found = score(values[:, cases[:, :, None], again[:, None, :]])  # (lines, samples)
        # A false claim comes last, then whoever misses more cases.
        behind = missed[:, cases].sum(axis=2) + 1e6 * lying[:, None]
        first = behind == behind.min(axis=0)
        best = np.where(first, found, math.inf).min(axis=0)
        won = first & (found <= noise * best)
        wins += won.sum(axis=1)
        for lost, by, ours in zip(losses, found / best, won, strict=True):
            lost.extend(by[~ours])
    shares = wins / SAMPLES
    # Of those that win about as often as anybody, the one that needs no choice, else by name: a rerun agrees.
    order = sorted(
        range(n),
        key=lambda i: (
            shares[i] < SURE * shares.max(),
            -shares[i] if shares[i] < SURE * shares.max() else 0.0,
            some[i].line.solver != FIRST,
            some[i].line.solver,
            whole[i],
        ),
    )
    head = order[0]
    return Race(
        ranking=tuple((some[i], choice(i, float(whole[i]))) for i in order),
        shares=tuple(float(shares[i]) for i in order),
        loss=float(np.median(losses[head])) if losses[head] else 1.0,
    )
