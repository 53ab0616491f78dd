"""Rank calls that were timed alternately, and measure the certainty of the ranking by resampling.

A resampling draws the cases and the repetitions with replacement. Steps of a sequence are drawn in blocks of
consecutive steps, since neighbours are alike. In each resampling the calls are ranked by the rule of
`recommendation`; every call with a score within noise of the best score wins the resampling. Noise is the difference
of a score between repetitions of the whole measurement, not between repetitions in one loop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.report.bench.recommendation import (
    PREFERRED_SOLVER,
    SERVED_QUANTILE,
    SERVED_RESIDUAL,
    Advice,
    Choice,
    FamilyAdvice,
    counts_sweeps,
    recommend_from_single_runs,
)
from lavender.report.bench.record import Record
from lavender.report.bench.statistics import MEAN_TIME_SHIFT, get_penalty_time_of_miss, get_tolerances
from lavender.report.bench.store import Records
from lavender.report.bench.timed_call import format_call

SAMPLES = 500  # Number of resamplings for each ranking.
# Resamplings are computed in groups, with arrays of at most this many entries.
MAX_ARRAY_ENTRIES = 1_000_000
CERTAIN_SHARE = 0.8  # A second solver is named if the first wins a smaller share of the resamplings.
# A solver that wins this share of the resamplings is as good a choice as the first.
EQUAL_SHARE = 0.2
MIN_TIME_NOISE = 1.05  # Times within this factor always count as equal: users do not notice it.
SEQUENCE_BLOCKS = 10  # The steps of a sequence are cut into this many blocks, which are drawn as a whole.
# The time of a call is this quantile of the times of its repetitions, since other processes can only lengthen them.
TIME_QUANTILE = 0.25
MIN_TIME = 1e-12  # [s] Smaller times are replaced by this, so that their logarithm exists.
IN_TIME_SHARE = 0.95  # Share of the repetitions that must end in time.


@dataclass(frozen=True)
class TimedCall:
    """One call of `lv.solve` or `lv.solve_many` on all of its cases.

    Parameters
    ----------
    runs : records by case
    guessed : whether some cases have a guess
    """

    runs: Mapping[str, Record]
    guessed: bool

    @property
    def as_record(self) -> Record:
        """A record that has the arguments of the call."""
        return next(iter(self.runs.values()))

    @property
    def code_lines(self) -> tuple[str, ...]:
        """The call as lines of Python."""
        return format_call(self.as_record, self.guessed)

    @property
    def mean_time(self) -> float:
        """Geometric mean over the cases of the lower quartile of the repetitions [s], shifted by `MEAN_TIME_SHIFT`."""
        each = [float(np.quantile(r.times or (r.time_min,), TIME_QUANTILE)) for r in self.runs.values()]
        return float(np.exp(np.mean(np.log(np.array(each) + MEAN_TIME_SHIFT))) - MEAN_TIME_SHIFT)


@dataclass(frozen=True)
class ResampledRanking:
    """A ranking of calls, and how often each wins a resampling.

    Parameters
    ----------
    ranking : calls with their results, the recommended call first
    shares : share of the resamplings that each call wins, in this order
    loss : median ratio of the recommended call's score to the best score in the resamplings that it does not win;
        1 if it wins all
    """

    ranking: tuple[tuple[TimedCall, Choice], ...]
    shares: tuple[float, ...]
    loss: float

    @property
    def named_calls(self) -> tuple[str, ...]:
        """Names of the recommended solver and of solvers that win at least `EQUAL_SHARE` of the resamplings.

        If no other solver does and the first wins less than `CERTAIN_SHARE`, the solver with the next largest share is
        named, too.
        """
        solvers = [choice.solver for _, choice in self.ranking]
        others = [s for s, share in zip(solvers[1:], self.shares[1:], strict=True) if share >= EQUAL_SHARE]
        if not others and self.shares[0] < CERTAIN_SHARE and len(solvers) > 1:
            others = [solvers[1 + int(np.argmax(self.shares[1:]))]]
        return tuple(dict.fromkeys([solvers[0], *others]))


def select_calls_with_most_cases(
    records: Records, timing_mode: str, interleaved: bool = True
) -> list[TimedCall]:
    """Select the calls of a timing mode ("call", "steps", "batch") that ran on the largest number of cases.

    With `interleaved`, calls that were timed alternately are selected; without it, runs that were measured one after
    the other. Records of earlier versions contain only the second kind.
    """
    groups: dict[tuple[object, ...], dict[str, Record]] = {}
    for r in records:
        same_mode = r.timing_mode == timing_mode or (
            not r.timing_mode and not interleaved and (r.step >= 0) is (timing_mode == "steps")
        )
        compared = r.order == "given" and r.start != "warm" and (r.mode != "budget" or counts_sweeps(r))
        if same_mode and compared and bool(r.interleave_group) is interleaved and r.case in records.cases:
            key = (r.solver, r.mode, r.tol, r.max_iter, r.time_limit, r.start)
            groups.setdefault(key, {})[r.case] = r
    max_cases = max((len(runs) for runs in groups.values()), default=0)
    calls = [
        TimedCall(runs, any(records.cases[c].guess for c in runs))
        for runs in groups.values()
        if len(runs) == max_cases
    ]
    if timing_mode != "batch":
        return calls
    # A batch of some cases cannot be compared with single calls on all cases: keep batches of equal sets of cases
    # only.
    complete = {
        (f.as_record.solver, *sorted(f.runs))
        for one in ("call", "steps")
        for f in select_calls_with_most_cases(records, one)
    }
    return [f for f in calls if (f.as_record.solver, *sorted(f.runs)) in complete]


STARTS = {"cold": "cold", "carried": "warm from the previous step"}


def _keep_best_of_each_solver(calls: Sequence[TimedCall], tolerance: float) -> list[TimedCall]:
    """Keep the call of each solver that misses the tolerance on the fewest cases; among equal calls, the fastest."""
    best: dict[str, TimedCall] = {}
    for call in sorted(
        calls, key=lambda f: (sum(not r.relative <= tolerance for r in f.runs.values()), f.mean_time)
    ):
        best.setdefault(call.as_record.solver, call)
    return list(best.values())


def rank_calls_to_tolerance(
    records: Records, calls: Sequence[TimedCall], tolerance: float, cases: int = 0
) -> ResampledRanking | None:
    """Rank calls by the number of cases that they bring to the tolerance, then by the geometric mean of times.

    `cases` is the number of all cases, if the calls were timed on fewer. Return None if no call has this or a tighter
    tolerance.
    """
    calls = _keep_best_of_each_solver(
        [f for f in calls if f.as_record.mode == "tol" and f.as_record.tol <= tolerance], tolerance
    )
    if not calls:
        return None
    limit, names = get_penalty_time_of_miss(records), _list_cases(calls)
    missed = np.array(
        [[c not in f.runs or not f.runs[c].relative <= tolerance for c in names] for f in calls]
    )
    times = _stack_repetitions(calls, names, lambda r: r.times or (r.time_min,))
    charged = np.where(missed[:, :, None] | ~np.isfinite(times), limit, times)

    def score(values: FloatArray) -> FloatArray:
        means = (
            np.exp(np.log(np.quantile(values, TIME_QUANTILE, axis=-1) + MEAN_TIME_SHIFT).mean(axis=-1))
            - MEAN_TIME_SHIFT
        )
        return np.asarray(np.maximum(means, MIN_TIME))

    def choose(i: int, value: float) -> Choice:
        each = np.where(missed[i], math.inf, np.quantile(times[i], TIME_QUANTILE, axis=1))
        by_case = dict(zip(names, each.tolist(), strict=True))
        solved = int((~missed[i]).sum())
        return Choice.from_case_values(
            calls[i].as_record.solver, by_case, solved, value, cases=max(cases, len(by_case))
        )

    return _rank_by_resampling(records, calls, names, charged, missed, score, choose)


def recommend_solvers(records: Records, times: Sequence[float] = ()) -> list[FamilyAdvice]:
    """Rank solvers for each structure and sequence; to the middle tolerance by interleaved calls, if there are any.

    Parameters
    ----------
    records : Records
    times : s, optional
        Time budgets; three decades about the fastest times if none are given.
    """
    tolerances = get_tolerances(records)
    tolerance = tolerances[len(tolerances) // 2]
    interleaved = {
        timing_mode: select_calls_with_most_cases(records, timing_mode) for timing_mode in ("call", "steps")
    }
    advice = []
    for family in recommend_from_single_runs(records, times):
        calls = interleaved["steps" if family.sequence else "call"]
        first = recommend_for_cases(records, family.by_tolerance[tolerance], calls, family.cases)
        advice.append(replace(family, by_tolerance={**family.by_tolerance, tolerance: first}))
    return advice


def recommend_for_cases(
    records: Records, alone: Advice, calls: Sequence[TimedCall], cases: Sequence[str]
) -> Advice:
    """Rank solvers on `cases`: solvers of calls that were timed alternately come first, then the others of `alone`.

    `calls` are ranked by `rank_calls_to_tolerance`, as in the first sentence of a report. `alone` is the ranking by
    runs that were measured one after the other. `alone` is returned unchanged if none of `calls` was timed on these
    cases, or if the best call solves fewer of them than the best solver of `alone`.
    """
    parts = [replace(f, runs={c: f.runs[c] for c in cases if c in f.runs}) for f in calls]
    resampled = rank_calls_to_tolerance(records, [f for f in parts if f.runs], alone.target, len(cases))
    best = alone.ranking[0].solved if alone.ranking else 0
    if resampled is None or resampled.ranking[0][1].solved < max(1, best):
        return alone
    hows = {c.solver: c.how for c in alone.ranking}
    interleaved = [
        replace(
            c,
            how=f"{f.as_record.target}, {f.as_record.start}"
            if f.as_record.step >= 0
            else hows.get(c.solver, ""),
        )
        for f, c in resampled.ranking
    ]
    named = resampled.named_calls
    interleaved.sort(key=lambda c: named.index(c.solver) if c.solver in named else len(interleaved))
    known = {c.solver for c in interleaved}
    rest = [c for c in alone.ranking if c.solver not in known]
    return replace(alone, ranking=(*interleaved, *rest), equal=len(named))


def rank_calls_in_time(
    records: Records, calls: Sequence[TimedCall], limit: float, cases: int = 0
) -> ResampledRanking | None:
    """Rank calls within a time budget `limit` [s]: by the cases served, then by the 90th percentile of the residual.

    A case is served if, in 95 of 100 repetitions, the call took at most the time budget and left at most half of the
    start's residual. Return None if no call has a fixed number of iterations or a time limit below `limit`.
    """
    calls = [
        f
        for f in calls
        if f.as_record.mode == "budget" or (f.as_record.mode == "time" and f.as_record.time_limit < limit)
    ]
    if not calls:
        return None
    names = _list_cases(calls)
    times = _stack_repetitions(calls, names, lambda r: r.times or (r.time_min,))
    residuals = np.minimum(
        _stack_repetitions(calls, names, lambda r: r.residual_per_repeat or (r.relative,)), 1.0
    )
    in_time = np.where(times <= limit, np.nan_to_num(residuals, nan=1.0), 1.0)
    served = np.quantile(in_time, IN_TIME_SHARE, axis=2, method="lower") <= SERVED_RESIDUAL

    def score(values: FloatArray) -> FloatArray:
        each = np.quantile(values, IN_TIME_SHARE, axis=-1, method="lower")
        upper = np.quantile(each, SERVED_QUANTILE, axis=-1, method="inverted_cdf")
        return np.asarray(np.maximum(upper, 1e-17))

    def choose(i: int, value: float) -> Choice:
        """Create the choice of call i with the score `value`."""
        line, each = calls[i].as_record, np.quantile(in_time[i], IN_TIME_SHARE, axis=1, method="lower")
        return Choice.from_case_values(
            line.solver,
            dict(zip(names, each.tolist(), strict=True)),
            int(served[i].sum()),
            value,
            cases=max(cases, len(each)),
            how=f"{line.max_iter} sweeps" if line.mode == "budget" else "",
            iterations=line.max_iter,
            overrun=float(np.nanquantile(times[i], IN_TIME_SHARE, method="lower")) / limit,
        )

    return _rank_by_resampling(records, calls, names, in_time, ~served, score, choose)


def compute_serving_time(call: TimedCall) -> float:
    """Return the time [s] in which a call with a budget serves nine cases of ten (`rank_calls_in_time`); else inf."""
    if call.as_record.mode != "budget":
        return math.inf
    times = _stack_repetitions([call], list(call.runs), lambda r: r.times or (r.time_min,))[0]
    residuals = np.array([r.relative for r in call.runs.values()])
    slow = np.quantile(times, IN_TIME_SHARE, axis=-1, method="lower")
    served = np.where(residuals <= SERVED_RESIDUAL, slow, math.inf)
    return float(np.quantile(served, SERVED_QUANTILE, method="inverted_cdf"))


def _list_cases(calls: Sequence[TimedCall]) -> list[str]:
    """Return the cases of all calls; a call misses a case on which it did not run."""
    return list(dict.fromkeys(name for f in calls for name in f.runs))


def _stack_repetitions(
    calls: Sequence[TimedCall], names: Sequence[str], values_of: Callable[[Record], Sequence[float]]
) -> FloatArray:
    """Return an array (calls, cases, repetitions) of `values_of` each record.

    Entries of cases that did not run are nan. If a call has fewer repetitions than another, its values are repeated.
    """
    max_repeats = max(len(values_of(r)) for f in calls for r in f.runs.values())
    return np.array(
        [
            [np.resize(values_of(f.runs[c]) if c in f.runs else np.nan, max_repeats) for c in names]
            for f in calls
        ],
        float,
    )


def _group_blocks(records: Records, names: Sequence[str]) -> list[list[int]]:
    """Group the numbers of cases that are drawn together: a single case, or consecutive steps of a sequence."""
    blocks: dict[tuple[str, int], list[int]] = {}
    steps: dict[str, int] = {}
    for name in names:
        steps[records.cases[name].sequence] = steps.get(records.cases[name].sequence, 0) + 1
    for i, name in enumerate(names):
        info = records.cases[name]
        size = max(1, steps[info.sequence] // SEQUENCE_BLOCKS)
        blocks.setdefault((info.sequence, info.step // size) if info.sequence else (name, -1), []).append(i)
    return list(blocks.values())


def _draw_samples(
    blocks: Sequence[Sequence[int]], repeats: int, max_samples: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield up to `max_samples` samples of equally many cases: indices (samples, cases), (samples, repetitions)."""
    draw = np.random.default_rng(0)
    by_count: dict[int, list[tuple[list[int], np.ndarray]]] = {}
    for _ in range(SAMPLES):
        cases = [i for b in draw.integers(0, len(blocks), len(blocks)) for i in blocks[b]]
        by_count.setdefault(len(cases), []).append((cases, draw.integers(0, repeats, repeats)))
    for samples in by_count.values():
        for start in range(0, len(samples), max_samples):
            case_indices, repetitions = zip(*samples[start : start + max_samples], strict=True)
            yield np.array(case_indices), np.array(repetitions)


def _rank_by_resampling(
    records: Records,
    calls: Sequence[TimedCall],
    names: Sequence[str],
    values: FloatArray,
    missed: np.ndarray,
    score: Callable[[FloatArray], FloatArray],
    choose: Callable[[int, float], Choice],
) -> ResampledRanking:
    """Rank calls by the share of resamplings that they win; `values` are by call, case and repetition."""
    n, _, repeats = values.shape
    blocks = _group_blocks(records, names)
    single = np.array([score(values[:, :, k : k + 1]) for k in range(repeats)])  # Shape (repetitions, calls).
    # Two standard errors of the difference of two scores; the error of a quartile is 1.36 times the error of a mean.
    deviation = float(np.median(np.log(single).std(axis=0)))
    noise = max(MIN_TIME_NOISE, math.exp(2.0 * math.sqrt(2.0) * 1.36 * deviation / math.sqrt(repeats)))
    scores = score(values)
    wins, losses = np.zeros(n), [[] for _ in range(n)]  # type: ignore[var-annotated]
    false_claims = np.array([any(r.status_conflict for r in f.runs.values()) for f in calls])
    for cases, repetitions in _draw_samples(blocks, repeats, max(1, MAX_ARRAY_ENTRIES // values.size)):
        sampled = score(values[:, cases[:, :, None], repetitions[:, None, :]])  # Shape (calls, samples).
        # Calls with a false claim rank last; the others rank by the number of missed cases, then by score.
        behind = missed[:, cases].sum(axis=2) + 1e6 * false_claims[:, None]
        first = behind == behind.min(axis=0)
        best = np.where(first, sampled, math.inf).min(axis=0)
        won = first & (sampled <= noise * best)
        wins += won.sum(axis=1)
        for lost, ratios, own in zip(losses, sampled / best, won, strict=True):
            lost.extend(ratios[~own])
    shares = wins / SAMPLES
    # Calls that win about as often as the best are sorted by name after the preferred solver, so that reruns agree.
    order = sorted(
        range(n),
        key=lambda i: (
            shares[i] < CERTAIN_SHARE * shares.max(),
            -shares[i] if shares[i] < CERTAIN_SHARE * shares.max() else 0.0,
            calls[i].as_record.solver != PREFERRED_SOLVER,
            calls[i].as_record.solver,
            scores[i],
        ),
    )
    head = order[0]
    return ResampledRanking(
        ranking=tuple((calls[i], choose(i, float(scores[i]))) for i in order),
        shares=tuple(float(shares[i]) for i in order),
        loss=float(np.median(losses[head])) if losses[head] else 1.0,
    )
