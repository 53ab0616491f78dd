"""How much slower `auto` is than the best of our own solvers, on problems that nobody chose.

    regret = (t_auto + SHIFT) / (t_best + SHIFT)

t is set-up and solve on a fresh problem, cold, one thread, the median of `repeats`. The best solver is chosen on
other runs than it is timed on, and the two are timed in turn, so that neither the noise of the choice nor a drift of
the machine's speed counts as regret.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.output import markdown
from lavender import registry
from lavender.bench.running.runner import is_foreign
from lavender.bench.running.timing import Task, measure
from lavender.problem import Problem

__all__ = ["SHIFT", "Regret", "Summary", "regrets", "summary", "table"]

SHIFT = 50e-6  # s: below it the difference of two solvers is Python's share
LEVELS = (1e-3, 1e-6, 1e-9)
AUTO = "auto"
SHORTEST = 0.02  # s, that a candidate is given at least; more only where nobody gets there
UNLIMITED = 10_000_000  # iterations of a run to a tolerance: the time limit ends it first


@dataclass(frozen=True)
class Regret:
    """One problem at one level."""

    case: str
    rows: int
    law: str
    reason: str  # what the case says of itself
    level: float
    best: str  # fastest of our own solvers that reached the level; "" where none did
    best_time: float  # s, median; inf where none did
    auto_time: float  # s, median
    auto_solved: bool
    auto_ran: str  # what `auto` says it did

    @property
    def shifted(self) -> float:
        """(t_auto + SHIFT) / (t_best + SHIFT); inf where `auto` failed and another did not, 1 where all failed."""
        return self._ratio(SHIFT)

    @property
    def plain(self) -> float:
        """t_auto / t_best, as `shifted`."""
        return self._ratio(0.0)

    def _ratio(self, shift: float) -> float:
        if not self.best:
            return 1.0
        return (self.auto_time + shift) / (self.best_time + shift) if self.auto_solved else math.inf


@dataclass(frozen=True)
class Summary:
    """Of many regrets."""

    count: int  # problems and levels that somebody solved
    unsolved: int  # that `auto` did not solve and another did
    nobody: int  # that no solver of ours solved within the time limit
    mean: float  # geometric, of `shifted`, over those that `auto` solved
    p95: float
    worst: float
    plain_mean: float  # the same without the shift
    plain_p95: float
    plain_worst: float


def own_solvers() -> list[str]:
    """Every solver of ours but `auto`: installed, compiled here or written here, delegating to nobody."""
    return [
        name
        for name, spec in sorted(registry.specs().items())
        if not spec.delegates and not is_foreign(spec) and spec.missing() is None
    ]


def regrets(
    cases: Iterable[tuple[str, str, Problem]],
    *,
    solvers: Sequence[str] | None = None,
    levels: Sequence[float] = LEVELS,
    time_limit: float = 2.0,
    repeats: int = 5,
    watch: Callable[[Regret], Any] | None = None,
) -> Iterator[Regret]:
    """Measure `auto` against the best of `solvers` on each case and level.

    Parameters
    ----------
    cases : iterable of (name, reason, problem)
    solvers : names; every one of ours if None
    levels : relative residuals
    time_limit : s, of one solve
    repeats : timed runs of each of the two; two more of the candidates choose the best
    watch : callable (Regret), optional
    """
    names = list(solvers) if solvers is not None else own_solvers()
    for name in names:
        registry.get(name)
    for case, reason, problem in cases:
        takes = [n for n in names if registry.get(n).refuses(problem) is None]
        for level in sorted(map(float, levels), reverse=True):
            found = _one(case, reason, problem, takes, level, time_limit, repeats)
            if watch is not None:
                watch(found)
            yield found
            if not found.best and not found.auto_solved:
                break  # nor will a tighter level be reached in that time


def _one(
    case: str, reason: str, problem: Problem, names: list[str], level: float, limit: float, repeats: int
) -> Regret:
    def run(solver: str, most: float) -> tuple[float, bool, str]:
        spec = registry.get(solver)
        task = Task(
            run="", case=case, sha="", solver=solver, mode="tol", tol=level,
            max_iter=UNLIMITED if spec.resumable else 0, time_limit=most,
        )  # fmt: skip
        record, _ = measure(problem, task)
        solved = record.relative <= level or (
            record.status in ("FLOOR", "INFEASIBLE") and not record.contradicted
        )
        return record.time_min, solved, f"{record.status}: {record.message or record.form} {record.work}"

    def better_of_two(solver: str, most: float) -> float:
        # The first run may be the one that faults pages in; the time of what did not get there is no time.
        first, solved, _ = run(solver, most)
        if not solved:
            return math.inf
        again, solved, _ = run(solver, most)
        return min(first, again) if solved else math.inf

    best = ""
    most, seen = min(limit, SHORTEST), dict.fromkeys(names, math.inf)
    while names:
        for name in names:
            seen[name] = better_of_two(name, min(most, max(SHORTEST, 5.0 * min(seen.values()))))
        best = min(seen, key=lambda name: seen[name])
        if math.isfinite(seen[best]) or most >= limit:
            break
        most = min(limit, 8.0 * most)  # nobody got there: with more time, perhaps
    if not math.isfinite(seen.get(best, math.inf)):
        best = ""
    mine: list[tuple[float, bool, str]] = []
    theirs: list[float] = []
    for _ in range(repeats):
        mine.append(run(AUTO, limit))
        if best:
            theirs.append(run(best, limit)[0])
        if mine[-1][0] > 0.5 * limit:  # medians matter where times are small
            break
    return Regret(
        case=case,
        rows=problem.m,
        law=problem.law,
        reason=reason,
        level=level,
        best=best,
        best_time=statistics.median(theirs) if theirs else math.inf,
        auto_time=statistics.median(t for t, _, _ in mine),
        auto_solved=all(solved for _, solved, _ in mine),
        auto_ran=mine[-1][2],
    )


def summary(found: Iterable[Regret]) -> Summary:
    """Geometric mean, 95th percentile and worst of those that `auto` solved; the rest are counted."""
    found = list(found)
    asked = [r for r in found if r.best]
    solved = [r for r in asked if r.auto_solved]

    def of(values: list[float]) -> tuple[float, float, float]:
        if not values:
            return math.nan, math.nan, math.nan
        values = sorted(values)
        at = min(len(values) - 1, math.ceil(0.95 * len(values)) - 1)
        return math.exp(statistics.fmean(map(math.log, values))), values[at], values[-1]

    shifted, plain = of([r.shifted for r in solved]), of([r.plain for r in solved])
    return Summary(
        count=len(asked),
        unsolved=len(asked) - len(solved),
        nobody=sum(not r.best and not r.auto_solved for r in found),
        mean=shifted[0],
        p95=shifted[1],
        worst=shifted[2],
        plain_mean=plain[0],
        plain_p95=plain[1],
        plain_worst=plain[2],
    )


def table(found: Sequence[Regret], rows: int = 12) -> str:
    """The summary and the `rows` worst of `found`, markdown."""
    s = summary(found)
    counts = (
        f"{s.count} problems and levels that one of our solvers reached, {s.unsolved} of them not by auto; "
        f"{s.nobody} that nobody reached"
    )
    kinds = {
        f"(t + {1e6 * SHIFT:.0f} us) / (best + same)": (s.mean, s.p95, s.worst),
        "t / best": (s.plain_mean, s.plain_p95, s.plain_worst),
    }
    head = ("regret", "geometric mean", "95th percentile", "worst")
    lines = [
        counts,
        "",
        markdown(head, [(kind, *(f"{x:.2f}" for x in of)) for kind, of in kinds.items()]),
        "",
    ]
    for r in sorted(found, key=lambda r: -r.shifted)[:rows]:
        if r.best:
            word = f"{r.shifted:7.2f}" if r.auto_solved else " failed"
            times = f"auto {1e3 * r.auto_time:.3f} ms, {r.best} {1e3 * r.best_time:.3f} ms"
            lines += [
                f"{word}  {r.case}, {r.rows} rows, {r.law}, to {r.level:.0e}: {times}",
                f"         {r.reason}",
                f"         {r.auto_ran[:160]}",
            ]
    return "\n".join(lines)
