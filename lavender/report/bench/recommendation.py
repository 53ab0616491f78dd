"""Rank solvers for each structure and sequence: by time to each tolerance, and by residual within each time budget.

To a tolerance, solvers rank by the number of cases that they solve to it, then by the shifted geometric mean of their
times. Only runs to a tolerance count. Within a time budget, or with a fixed number of sweeps, solvers rank by the
number of cases served, then by the 90th percentile of the residual. A case is served if at most half of the start's
residual remains. A solver is recommended only if it serves nine cases of ten. A case without a result within the
budget counts with residual 1, the residual of the zero impulse. A solver with a false claim on one of the cases ranks
behind all solvers without a false claim.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any

from lavender.report.bench.record import Record
from lavender.report.bench.statistics import (
    MEAN_TIME_SHIFT,
    RESIDUAL_NOISE_FACTOR,
    TIME_NOISE_FACTOR,
    collect_times_to_tolerance,
    compute_geometric_mean,
    compute_quantile,
    get_modes_to_tolerance,
    get_penalty_time_of_miss,
    get_tolerances,
    group_cases_by_family,
    group_passes_by_sequence,
)
from lavender.report.bench.store import Records

SERVED_RESIDUAL = 0.5  # A case is served if at most this fraction of the start's residual remains.
# Within a time budget, solvers rank by this quantile of the residuals over the cases; a mean hides misses.
SERVED_QUANTILE = 0.9
PREFERRED_SOLVER = "auto"  # Listed first among equally good solvers, as its users need not choose a method.
# The report has a sentence on a time budget if it is below this fraction of the time to the tolerance.
SHORT_TIME_RATIO = 0.5


@dataclass(frozen=True)
class Choice:
    """Results of one solver in a family of cases, or over the steps of a sequence."""

    solver: str
    solved: int
    cases: int
    # Value by which solvers rank: shifted geometric mean of times [s], or 90th percentile of relative residuals [-].
    score: float
    # 95th percentile over the cases of the times [s] or residuals [-] in `score`; inf if over 5 % of the cases were
    # missed.
    p95: float = math.nan
    worst: float = math.nan
    hardest: str = ""  # Name of the case with the value `worst`.
    how: str = ""  # Description of the call: its budget, and for a sequence, whether impulses are carried.
    iterations: int = 0  # Iterations of a fixed budget; 0 for runs to a tolerance.
    overrun: float = math.nan  # 95th percentile of the call's time divided by its time limit.

    def solves_share(self, share: float) -> bool:
        """Return whether the solver solves at least this share (0 to 1) of the cases, and at least one case."""
        return self.solved >= max(1, share * self.cases)

    @classmethod
    def from_case_values(
        cls, solver: str, values: Mapping[str, float], solved: int, score: float, **more: Any
    ) -> Choice:
        """Create a choice from the value of each case: a time [s], or the remaining relative residual [-]."""
        each = list(values.values())
        return cls(
            solver=solver,
            solved=solved,
            score=score,
            p95=compute_quantile(each, 0.95),
            worst=max(each),
            hardest=max(values, key=lambda c: values[c]),
            **{"cases": len(each), **more},
        )


@dataclass(frozen=True)
class Advice:
    """Ranking of solvers in a family for one tolerance or time budget."""

    family: str
    target: float  # Tolerance [-] or time [s].
    ranking: tuple[Choice, ...]
    # The first this many solvers of `ranking` are equal within noise; their order is fixed.
    equal: int = 1
    min_share: float = 0.0  # A solver must serve at least this fraction of the cases to be recommended.

    @property
    def best(self) -> Choice | None:
        """The recommended solver; None if no solver reached the tolerance, or none serves enough cases in the time."""
        return self.ranking[0] if self.ranking and self.ranking[0].solves_share(self.min_share) else None

    @property
    def tied_solvers(self) -> tuple[str, ...]:
        """Names of the solvers that are as good as the best, within noise."""
        return tuple(c.solver for c in self.ranking[1 : self.equal]) if self.best else ()


RankedChoice = tuple[tuple[float, ...], Choice]  # A smaller key ranks first, whatever the score.


def rank_choices(family: str, target: float, choices: Iterable[RankedChoice], noise: float) -> Advice:
    """Rank solvers by key, then by score.

    Solvers with the best key and a score of up to `noise` times the best score count as equal. They are sorted by name
    after `PREFERRED_SOLVER`, so that a rerun gives the same order.
    """
    order = sorted(choices, key=lambda entry: (entry[0], entry[1].score, entry[1].solver))
    if not order:
        return Advice(family, target, ())
    key, best = order[0]
    equal = [c for k, c in order if k == key and c.score <= noise * best.score]
    equal.sort(key=lambda c: (c.solver != PREFERRED_SOLVER, c.solver))
    rest = [c for _, c in order if all(c is not e for e in equal)]
    return Advice(family, target, (*equal, *rest), len(equal))


@dataclass(frozen=True)
class FamilyAdvice:
    """All rankings of a structure over its cases, or of a sequence over its steps."""

    name: str
    cases: tuple[str, ...]
    sequence: bool
    left_out: int  # Number of steps of the sequence that did not load and are not ranked.
    by_tolerance: Mapping[float, Advice]
    by_time: Mapping[float, Advice]
    by_sweeps: Mapping[float, Advice]

    @property
    def n_cases(self) -> int:
        """Number of cases."""
        return len(self.cases)


def recommend_from_single_runs(records: Records, times: Sequence[float] = ()) -> list[FamilyAdvice]:
    """Rank solvers by runs that were timed one after the other: structures first, then sequences.

    `times` [s] are the time budgets; `choose_time_budgets` gives them if there are none.
    """
    times = tuple(times) or choose_time_budgets(records)
    groups, by_sweeps, lost = _group_runs(records), _group_sweep_budgets(records), records.left_out
    return [
        FamilyAdvice(
            name=name,
            cases=tuple(cases),
            sequence=is_sequence,
            left_out=len(lost.get(name, ())) if is_sequence else 0,
            by_tolerance={
                x: rank_to_tolerance(records, name, cases, x, groups) for x in get_tolerances(records)
            },
            by_time={t: rank_within_time(records, name, cases, t, groups) for t in times},
            by_sweeps={
                float(n): replace(rank_within_time(records, name, cases, math.inf, some), target=float(n))
                for n, some in by_sweeps.items()
            },
        )
        for is_sequence, families_of in (
            (False, group_cases_by_family(records)),
            (True, list_steps_of_sequences(records)),
        )
        for name, cases in families_of.items()
    ]


@dataclass(frozen=True)
class _RunGroup:
    """A solver with all of its runs on single cases, or with the runs of one call over the steps of sequences."""

    solver: str
    how: str = ""  # Description of the call; empty for single cases.
    iterations: int = 0
    tol: float = 0.0  # Tolerance of the call; 0 for single cases.
    mode: str = ""  # Mode of the call; empty for single cases.
    runs: dict[str, list[Record]] = field(default_factory=dict)  # Runs of each case.

    def describe_budget(self, runs: Sequence[Record]) -> dict[str, Any]:
        """Return the fields `how` and `iterations` of a choice, from the median number of sweeps in its runs."""
        if self.how or self.iterations:
            return {"how": self.how, "iterations": self.iterations}
        sweeps = [r.work["sweeps"] for r in runs if "sweeps" in r.work]
        middle = round(median(sweeps)) if runs and len(sweeps) == len(runs) else 0
        return {"how": f"{middle} sweeps" if middle else "", "iterations": middle}


RunGroups = Mapping[tuple[str, str, str], _RunGroup]  # The key is (solver, call, start).


def _group_runs(records: Records) -> RunGroups:
    """Group cold runs on single cases by solver, and runs over sequences by budget or tolerance and start, too."""
    groups: dict[tuple[str, str, str], _RunGroup] = {}
    for r in records:
        if r.order != "given" or r.interleave_group or (r.step < 0 and r.start != "cold"):
            continue
        if r.step < 0:
            group = groups.setdefault((r.solver, "", ""), _RunGroup(r.solver))
        else:
            tol, budget = (r.tol, 0) if r.mode == "tol" else (0.0, r.max_iter)
            new = _RunGroup(r.solver, f"{r.target}, {r.start}", budget, tol, r.mode)
            group = groups.setdefault((r.solver, r.target, r.start), new)
        group.runs.setdefault(r.case, []).extend([r] if r.is_usable else [])
    return groups


def _group_sweep_budgets(records: Records) -> dict[int, RunGroups]:
    """Group the runs of each budget that is counted in sweeps."""
    groups: dict[int, dict[tuple[str, str, str], _RunGroup]] = defaultdict(dict)
    for r in records:
        compared = (
            r.order == "given" and not r.interleave_group and r.start in ("cold", "carried") and r.is_usable
        )
        if compared and r.mode == "budget" and counts_sweeps(r):
            start = "" if r.step < 0 else r.start
            new = _RunGroup(r.solver, start, r.max_iter, mode="budget")
            groups[r.max_iter].setdefault((r.solver, "", start), new).runs[r.case] = [r]
    return {n: groups[n] for n in sorted(groups)}


def list_steps_of_sequences(records: Records) -> dict[str, list[str]]:
    """Return the names of all steps of each sequence that ran, also of steps without a run."""
    ran = {r.case for r in records if r.step >= 0}
    steps_of: dict[str, list[str]] = {}
    for name, info in records.cases.items():
        if info.sequence:
            steps_of.setdefault(info.sequence, []).append(name)
    return {name: steps for name, steps in steps_of.items() if not ran.isdisjoint(steps)}


def rank_to_tolerance(
    records: Records, family: str, cases: Sequence[str], tolerance: float, groups: RunGroups | None = None
) -> Advice:
    """Rank the solvers that bring these cases, or steps, to a tolerance.

    Only runs to a tolerance count. For steps of sequences, calls with this or a tighter tolerance count, and the steps
    of several sequences are ranked together. `groups` is `_group_runs(records)` if it was computed before.
    """
    limit, liars = get_penalty_time_of_miss(records), _list_false_claims(records, cases)
    modes = get_modes_to_tolerance(records)
    choices: list[RankedChoice] = []
    for group in _select_groups(cases, _group_runs(records) if groups is None else groups):
        if group.tol > tolerance or group.mode not in ("", *modes):
            continue
        runs = {
            c: _select_fastest((r for r in group.runs.get(c, ()) if r.mode in modes), tolerance)
            for c in cases
        }
        solved = [r for r in runs.values() if r is not None]
        times = {c: math.inf if r is None else r.time_min for c, r in runs.items()}
        score = compute_geometric_mean(
            [t if math.isfinite(t) else limit for t in times.values()], MEAN_TIME_SHIFT
        )
        choice = Choice.from_case_values(
            group.solver, times, len(solved), score, **group.describe_budget(solved)
        )
        choices.append(((group.solver in liars, -len(solved)), choice))
    return rank_choices(family, tolerance, _keep_best_of_each_solver(choices), TIME_NOISE_FACTOR)


def rank_within_time(
    records: Records, family: str, cases: Sequence[str], limit: float, groups: RunGroups | None = None
) -> Advice:
    """Rank solvers by the residual that they leave on these cases, or steps, within a time [s].

    Whether a run counts is a matter of chance if its time equals the limit within noise. A solver that would rank
    first with a limit that is larger by the noise is therefore listed as equally good as the best.
    """
    selected = _select_groups(cases, _group_runs(records) if groups is None else groups)
    liars = _list_false_claims(records, cases)

    def rank_group(group: _RunGroup, time: float) -> RankedChoice:
        runs = {c: _select_most_accurate(group.runs.get(c, ()), time) for c in cases}
        residuals = {c: 1.0 if r is None else min(max(r.relative, 1e-17), 1.0) for c, r in runs.items()}
        served = sum(x <= SERVED_RESIDUAL for x in residuals.values())
        budget = group.describe_budget([r for r in runs.values() if r is not None])
        score = compute_quantile(list(residuals.values()), SERVED_QUANTILE)
        return (group.solver in liars, -served), Choice.from_case_values(
            group.solver, residuals, served, score, **budget
        )

    choices = _keep_best_of_each_solver(rank_group(group, limit) for group in selected)
    advice = rank_choices(family, limit, choices, RESIDUAL_NOISE_FACTOR)
    # Recommend no solver that serves fewer cases than this quantile: its score is then a residual near 1.
    advice = replace(advice, min_share=SERVED_QUANTILE)
    if advice.best is None or math.isinf(limit):
        return advice
    late_choices = _keep_best_of_each_solver(
        rank_group(group, TIME_NOISE_FACTOR * limit) for group in selected
    )
    late = {c.solver: (key, c.score) for key, c in late_choices}
    first = min(key for key, _ in choices)
    best = min(c.score for c in advice.ranking[: advice.equal])
    rest = advice.ranking[advice.equal :]
    near = [
        c for c in rest if late[c.solver][0] <= first and late[c.solver][1] <= RESIDUAL_NOISE_FACTOR * best
    ]
    others = [c for c in rest if all(c is not n for n in near)]
    ranking = (*advice.ranking[: advice.equal], *near, *others)
    return replace(advice, ranking=ranking, equal=advice.equal + len(near))


def _list_false_claims(records: Records, cases: Sequence[str]) -> set[str]:
    """Return the solvers with a false claim on any of these cases."""
    names = set(cases)
    return {r.solver for r in records if r.status_conflict and r.case in names}


def _select_groups(cases: Sequence[str], groups: RunGroups) -> list[_RunGroup]:
    """Select the groups that ran on any of these cases."""
    names = set(cases)
    return [group for _, group in sorted(groups.items()) if not names.isdisjoint(group.runs)]


def _select_fastest(runs: Iterable[Record], tolerance: float) -> Record | None:
    return min((r for r in runs if r.relative <= tolerance), key=lambda r: r.time_min, default=None)


def _select_most_accurate(runs: Iterable[Record], limit: float) -> Record | None:
    return min((r for r in runs if r.time_min <= limit), key=lambda r: r.relative, default=None)


def choose_time_budgets(records: Records) -> tuple[float, ...]:
    """Return three decades of time [s] about the median of the fastest times to the middle tolerance."""
    tolerances, modes = get_tolerances(records), get_modes_to_tolerance(records)
    tolerance = tolerances[len(tolerances) // 2]
    fastest = [min(by.values()) for by in collect_times_to_tolerance(records, tolerance).values() if by]
    for passes in group_passes_by_sequence(records).values():
        reached = [
            median(w.times[start])
            for w in passes
            for start, residuals in w.residuals.items()
            if w.mode in modes and len(residuals) == w.steps and max(residuals) <= tolerance
        ]
        fastest.append(min(reached, default=math.inf))
    fastest = [t for t in fastest if 0.0 < t < math.inf]
    middle = math.ceil(math.log10(median(fastest))) if fastest else -3
    return tuple(10.0**k for k in (middle - 1, middle, middle + 1))


def counts_sweeps(r: Record) -> bool:
    """Return whether the iterations of a budget are sweeps, so that the budget bounds the time of a solve."""
    return 0 < r.work.get("sweeps", 0) <= r.max_iter


def _keep_best_of_each_solver(choices: Iterable[RankedChoice]) -> list[RankedChoice]:
    """Keep the best entry of each solver."""
    first: dict[str, RankedChoice] = {}
    for entry in sorted(choices, key=lambda pair: (pair[0], pair[1].score)):
        first.setdefault(entry[1].solver, entry)
    return list(first.values())


@dataclass(frozen=True)
class Subject:
    """All single cases together, or all sequences: the subject of a report's first sentence."""

    names: tuple[str, ...]  # Names of cases or sequences.
    cases: tuple[str, ...]  # Names of cases, or of the steps of the sequences.
    timing_mode: str  # "call" or "steps"
    best: Advice  # Ranking to the middle tolerance.
    quick: tuple[Advice, ...]  # Ranking within each time.


def list_subjects(records: Records, times: Sequence[float] = ()) -> list[Subject]:
    """Return the subject of single cases and the subject of sequences; a subject without cases is left out."""
    tolerances = get_tolerances(records)
    tolerance = tolerances[len(tolerances) // 2]
    times = tuple(times) or choose_time_budgets(records)
    cases = tuple(dict.fromkeys(r.case for r in records if r.step < 0))
    sequences = list_steps_of_sequences(records)
    steps = tuple(step for some in sequences.values() for step in some)
    subjects = []
    for names, members, timing_mode in ((cases, cases, "call"), (tuple(sequences), steps, "steps")):
        if members:
            quick = tuple(rank_within_time(records, "all", members, t) for t in times)
            best = rank_to_tolerance(records, "all", members, tolerance)
            subjects.append(Subject(names, members, timing_mode, best, quick))
    return subjects
