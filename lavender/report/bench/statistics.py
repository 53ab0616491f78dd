"""Compute statistics of records, of each case and over many cases, as lists of small frozen rows.

The time to a tolerance is the shortest time of the runs to any tolerance with a judged residual of up to this
tolerance: they are compared by the residual that they reached, not by the tolerance that they were given. Runs with a
fixed budget do not count, since a reader cannot choose the budget in advance (`get_modes_to_tolerance`).
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median

from lavender.base.arrays import check_choice
from lavender.judge.residuals import at_floor
from lavender.judge.solution import CLAIM_CHECKS, CONFIRMED, MATRIX_PASS_COUNTERS, OTHER_WORK_COUNTERS
from lavender.report.bench.record import Record, describe_target
from lavender.report.bench.store import Records

# Order in which tables list structures.
STRUCTURE_ORDER = (
    "separate",
    "chain",
    "mesh",
    "stack",
    "pile",
    "dense",
)
DEATH_STATUSES = ("ERROR", "KILLED", "CRASHED")
EASY_RESIDUAL = 1e-3  # Relative residual to which sweeps are counted as a measure of difficulty.
# Times within this factor count as equal: a busy machine changes the minimum of repeats by this much.
TIME_NOISE_FACTOR = 1.25
# Residuals within this factor count as equal: one run more or less within a time budget changes as much.
RESIDUAL_NOISE_FACTOR = 2.0
# [s] Shift of geometric means of times. In shorter calls, the overhead of Python dominates.
MEAN_TIME_SHIFT = 1e-5


def get_tolerances(records: Records) -> tuple[float, ...]:
    """Return the tolerances of the newest run's plan, loosest first; without a plan the tolerances of the runs."""
    for run in reversed(list(records.runs.values())):
        if run.plan.get("tolerances"):
            return tuple(sorted(map(float, run.plan["tolerances"]), reverse=True))
    return tuple(sorted({r.tol for r in records if r.mode == "tol"}, reverse=True)) or (1e-3, 1e-6, 1e-9)


def get_modes_to_tolerance(records: Iterable[Record]) -> frozenset[str]:
    """Return the modes of the runs that count to a tolerance: "tol", or "budget" if no run is to a tolerance."""
    return frozenset({"tol"} if any(r.mode == "tol" for r in records) else {"budget"})


def group_runs_by_pair(records: Iterable[Record]) -> dict[tuple[str, str, str], list[Record]]:
    """Group the runs with the sweep order "given" by (case, solver, start)."""
    groups: dict[tuple[str, str, str], list[Record]] = defaultdict(list)
    for r in records:
        if r.order == "given" and r.step < 0 and not r.interleave_group:
            groups[r.case, r.solver, r.start].append(r)
    return dict(groups)


def group_cases_by_family(records: Records) -> dict[str, list[str]]:
    """Group cases by structure. A case is in the family of every word that describes it.

    If the cases of a word have several friction laws, each law is a family: "pile, coulomb". Words that describe the
    same set of cases form one family: "stack / friction".
    """
    cases_by_word: dict[str, dict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
    ran = {r.case for r in records if r.step < 0}
    for name, info in records.cases.items():
        if name in ran:
            for word in info.structure:
                cases_by_word[word][info.law].append(name)
    order = (*STRUCTURE_ORDER, "redundant", "friction", "large mass ratio", "asymmetric")
    names: dict[tuple[str, ...], list[str]] = {}
    for word in sorted(cases_by_word, key=lambda w: (order.index(w) if w in order else len(order), w)):
        laws = cases_by_word[word]
        for law in sorted(laws, key=lambda x: (-len(laws[x]), x)):
            names.setdefault(tuple(laws[law]), []).append(word if len(laws) == 1 else f"{word}, {law}")
    return {" / ".join(words): list(cases) for cases, words in names.items()}


def is_campaign(records: Records) -> bool:
    """Return whether the runs are of a campaign, which has no times."""
    return any(run.plan.get("campaign") for run in records.runs.values())


def drop_cases_solved_at_zero(records: Records) -> Records:
    """Return the records without cases that the zero impulse solves: no ranking counts them."""
    idle = {name for name, info in records.cases.items() if info.nothing_to_do}
    if not idle:
        return records
    remaining = (r for r in records if r.case not in idle)
    return records.with_records(remaining, lambda entry: getattr(entry, "case", None) not in idle)


# -- single cases ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reach:
    """Times and smallest residual of one solver on one case.

    Parameters
    ----------
    case, solver, start : str
    times : mapping of float to float, s
        Time to each tolerance, of the runs to a tolerance; inf if it was not reached.
    best, roundoff_floor : float
        Smallest relative residual of all runs, and its round-off floor.
    status : str
        Status of the run to the tightest tolerance.
    claim_check : str
        Worst `claim_check` of all runs.
    status_conflict, form : str
    """

    case: str
    solver: str
    start: str
    times: Mapping[float, float]
    best: float
    roundoff_floor: float
    status: str
    claim_check: str
    status_conflict: str
    form: str

    @property
    def at_floor(self) -> bool:
        """Whether the best residual is at the round-off floor of float64."""
        return at_floor(self.best, self.roundoff_floor)


@dataclass(frozen=True)
class Difficulty:
    """Measures of the difficulty of a case.

    Parameters
    ----------
    case : str
    rows : int
    sweeps : int or None
        Sweeps of `pgs` to EASY_RESIDUAL; None if it did not reach it or did not run.
    condition : float or None
        See `CaseInfo.condition`.
    same : tuple of str
        Solvers that returned bit-identical answers without an iteration. They took the same shortcut, so their
        times measure the shortcut and not the solvers.
    """

    case: str
    rows: int
    sweeps: int | None
    condition: float | None
    same: tuple[str, ...]


@dataclass(frozen=True)
class Claims:
    """Claims of a solver, compared with the judge.

    Parameters
    ----------
    solver : str
    runs : int
    claims, wrong : int
        Number of runs with the status CONVERGED, ROUNDOFF_LIMIT or INFEASIBLE, and number of these statuses that the
        judge contradicts.
    attempted, reached : int
        Number of runs to a tolerance, and number of these runs that reached it by the judged residual.
    crashed : int
        Runs with the status ERROR, KILLED or CRASHED.
    """

    solver: str
    runs: int
    claims: int
    wrong: int
    reached: int
    attempted: int
    crashed: int


@dataclass(frozen=True)
class Spread:
    """Residual at one budget over sweep orders."""

    case: str
    solver: str
    budget: int
    by_order: Mapping[str, float]
    roundoff_floor: float = 0.0  # Residuals below it are rounding errors.

    @property
    def worst_to_best_ratio(self) -> float:
        """Ratio of the largest to the smallest residual of an order; residuals below the floor count as the floor."""
        values = [
            max(v, self.roundoff_floor) for v in self.by_order.values() if max(v, self.roundoff_floor) > 0.0
        ]
        return max(values) / min(values) if values else 1.0


def summarize_runs_by_case(records: Records, tolerances: Sequence[float] | None = None) -> list[Reach]:
    """Return one row for each case, solver and start, in the order of the records."""
    tolerances = get_tolerances(records) if tolerances is None else tuple(tolerances)
    modes, out = get_modes_to_tolerance(records), []
    for (case, solver, start), group in group_runs_by_pair(records).items():
        good = [r for r in group if r.is_usable]
        best = min(good, key=lambda r: (r.relative, r.time_min), default=None)
        to_tolerance = [r for r in group if r.mode == "tol"] or group
        last = to_tolerance[-1]
        out.append(
            Reach(
                case=case,
                solver=solver,
                start=start,
                times={
                    tolerance: min(
                        (r.time_min for r in good if r.mode in modes and r.relative <= tolerance),
                        default=math.inf,
                    )
                    for tolerance in tolerances
                },
                best=best.relative if best else math.inf,
                roundoff_floor=best.roundoff_floor if best else math.nan,
                status=last.status,
                claim_check=max((r.claim_check for r in group), key=CLAIM_CHECKS.index),
                status_conflict=next((r.status_conflict for r in group if r.status_conflict), ""),
                form=last.form,
            )
        )
    return out


def repeats_earlier_run(r: Record) -> bool:
    """Return whether a run times a call again that was measured before: an interleaved call without a time limit."""
    return bool(r.interleave_group) and r.mode != "time"


def list_failures(records: Records) -> list[Record]:
    """Return runs that missed their tolerance above the round-off floor, crashes, and false claims."""
    out = []
    for r in records:
        if repeats_earlier_run(r):
            continue
        missed = r.mode == "tol" and not r.success and not at_floor(r.relative, r.roundoff_floor)
        proven = r.status == "INFEASIBLE" and r.claim_check == CONFIRMED
        lost = not math.isfinite(r.relative) or r.status.startswith(DEATH_STATUSES)
        if (missed and not proven) or lost or r.status_conflict:
            out.append(r)
    return out


def compute_difficulties(records: Records) -> list[Difficulty]:
    """Return the difficulty of each case, from runs with a cold start."""
    out = []
    for name, info in records.cases.items():
        runs = [r for r in records if r.case == name and r.start == "cold"]
        swept = [
            r.iterations
            for r in runs
            if r.solver == "pgs" and r.mode == "tol" and r.relative <= EASY_RESIDUAL
        ]
        idle = [r for r in runs if r.solution_hash and r.iterations == 0 and r.claims]
        groups = defaultdict(set)
        for r in idle:
            groups[r.solution_hash].add(r.solver)
        same = max(groups.values(), key=len, default=set())
        out.append(
            Difficulty(
                case=name,
                rows=info.rows,
                sweeps=min(swept, default=None),
                condition=info.condition,
                same=tuple(sorted(same)) if len(same) > 1 and not info.nothing_to_do else (),
            )
        )
    return out


def count_claims(records: Records) -> list[Claims]:
    """Count the correct and wrong claims of each solver."""
    out = []
    for solver in sorted({r.solver for r in records}):
        runs = [r for r in records if r.solver == solver and not repeats_earlier_run(r)]
        to_tolerance = [r for r in runs if r.mode == "tol"]
        out.append(
            Claims(
                solver=solver,
                runs=len(runs),
                claims=sum(r.claims for r in runs),
                wrong=sum(r.claims and bool(r.status_conflict) for r in runs),
                reached=sum(r.success for r in to_tolerance),
                attempted=len(to_tolerance),
                crashed=sum(r.status.startswith(DEATH_STATUSES) for r in runs),
            )
        )
    return out


def compute_order_spreads(records: Records) -> list[Spread]:
    """Return the residual of each sweep order for budgets that were run in several orders."""
    groups: dict[tuple[str, str, int], dict[str, Record]] = defaultdict(dict)
    for r in records:
        if r.mode == "budget" and r.start == "cold" and r.step < 0 and not r.interleave_group:
            name = f"{r.order} {r.seed}" if r.order == "random" else r.order
            groups[r.case, r.solver, r.max_iter][name] = r
    return [
        Spread(*key, {name: r.relative for name, r in by.items()}, max(r.roundoff_floor for r in by.values()))
        for key, by in groups.items()
        if len(by) > 1
    ]


def group_runs_by_budget(records: Records) -> dict[tuple[str, str, str], list[tuple[int, float]]]:
    """Return (iterations, residual) of runs with a fixed budget and the order "given", by (case, solver, start)."""
    groups: dict[tuple[str, str, str], list[tuple[int, float]]] = defaultdict(list)
    for r in records:
        if r.mode != "budget" or r.interleave_group:
            continue
        if r.order == "given" and r.step < 0 and r.status == "MAX_ITERATIONS":
            groups[r.case, r.solver, r.start].append((r.iterations, r.relative))
    return {key: sorted(points) for key, points in groups.items()}


# -- two runs ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Change:
    """One case and solver in an old and a new run.

    `old` and `new` [s] are the times to the tolerance, inf if it was missed. Times within the factor `noise` > 1 are
    equal.
    """

    case: str
    solver: str
    start: str
    tolerance: float
    old: float
    new: float
    noise: float

    @property
    def kind(self) -> str:
        """Kind of the change: "reached", "lost", "faster", "slower" or "same"."""
        if math.isfinite(self.new) != math.isfinite(self.old):
            return "reached" if math.isfinite(self.new) else "lost"
        if not math.isfinite(self.new) or self.old / self.noise <= self.new <= self.old * self.noise:
            return "same"
        return "faster" if self.new < self.old else "slower"


def compare_times(old: Records, new: Records) -> list[Change]:
    """Compare times to each tolerance of two runs, on cases with the same numbers in both.

    `Change.noise` is the larger of `TIME_NOISE_FACTOR` and 1 + 2 (r - 1), with r the largest ratio of median to
    minimum time in either run. Earlier times are multiplied by the machine's drift on the case
    (`compute_machine_drift`).
    """
    tolerances = get_tolerances(new)
    same = {name for name, info in new.cases.items() if name in old.cases and old.cases[name].sha == info.sha}
    before = {(r.case, r.solver, r.start): r for r in summarize_runs_by_case(old, tolerances)}
    jitter: dict[tuple[str, str, str], float] = defaultdict(lambda: 1.0)
    for records in (old, new):
        for key, group in group_runs_by_pair(records).items():
            for r in group:
                if r.is_usable and r.time_min > 0.0:
                    jitter[key] = max(jitter[key], r.time_median / r.time_min)
    out = []
    for row in summarize_runs_by_case(new, tolerances):
        key = (row.case, row.solver, row.start)
        if row.case not in same or key not in before:
            continue
        worth = compute_machine_drift(old, new, row.case)
        noise = max(TIME_NOISE_FACTOR, 1.0 + 2.0 * (jitter[key] - 1.0))
        out += [Change(*key, x, worth * before[key].times[x], row.times[x], noise) for x in tolerances]
    return out


def compute_machine_drift(old: Records, new: Records, case: str = "") -> float:
    """Return the time of the calibration loop in the new run divided by its time in the old run.

    Each time is a median over the runs of `case`, or over all runs if `case` is empty. The ratio is 1 if a run did not
    measure the loop.
    """
    medians = []
    for records in (old, new):
        some = [r.calibration_time for r in records if r.calibration_time and (not case or r.case == case)]
        medians.append(median(some) if some else math.nan)
    return medians[1] / medians[0] if all(map(math.isfinite, medians)) else 1.0


@dataclass(frozen=True)
class Profile:
    """Dolan-More performance profile of one tolerance over the cases of one law, by time or by work."""

    law: str
    tolerance: float
    cases: int
    curves: Mapping[str, tuple[tuple[float, float], ...]]  # Solver -> steps (ratio, fraction of cases).
    measure: str = "time"


def compute_geometric_mean(values: Sequence[float], shift: float = 0.0) -> float:
    """Return exp(mean(log(x + shift))) - shift; nan without values."""
    if not values:
        return math.nan
    return math.exp(sum(math.log(v + shift) for v in values) / len(values)) - shift


def compute_quantile(values: Sequence[float], q: float) -> float:
    """Return the smallest value that at least a share q of the values does not exceed."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, math.ceil(q * len(ordered)) - 1)]


def collect_times_to_tolerance(records: Records, tolerance: float) -> dict[str, dict[str, float]]:
    """Return {case: {solver: time [s] to the tolerance from a cold start}}.

    A missed tolerance has the time inf. A solver that refuses a case has no entry.
    """
    out: dict[str, dict[str, float]] = defaultdict(dict)
    for reach in summarize_runs_by_case(records, [tolerance]):
        if reach.start == "cold":
            out[reach.case][reach.solver] = reach.times[tolerance]
    return out


def count_sweeps_and_products(record: Record) -> float:
    """Return the passes over A of a run (sweeps and products); nan if it did other work, or counted none."""
    if any(record.work.get(name, 0) for name in OTHER_WORK_COUNTERS):
        return math.nan
    passes = [n for name, n in record.work.items() if name in MATRIX_PASS_COUNTERS]
    return float(sum(passes)) if passes else math.nan


def find_solvers_with_other_work(records: Iterable[Record]) -> set[str]:
    """Return the solvers with work that is not sweeps or products with A (`count_sweeps_and_products`) in some run."""
    return {r.solver for r in records if r.is_usable and math.isnan(count_sweeps_and_products(r))}


def count_sweeps_and_products_to_tolerance(records: Records, tolerance: float) -> dict[str, dict[str, float]]:
    """Return {case: {solver: number of passes over A to the tolerance from a cold start}}; inf for a missed tolerance.

    As for times, only runs to a tolerance count. Solvers that do other work (`find_solvers_with_other_work`) are left
    out. A number below one counts as one pass.
    """
    modes = get_modes_to_tolerance(records)
    groups = {k[:2]: group for k, group in group_runs_by_pair(records).items() if k[2] == "cold"}
    excluded = find_solvers_with_other_work(r for group in groups.values() for r in group)
    groups = {k: [r for r in group if r.is_usable and r.mode in modes] for k, group in groups.items()}
    out: dict[str, dict[str, float]] = defaultdict(dict)
    for (case, solver), group in groups.items():
        if solver not in excluded:
            reached = [max(1.0, count_sweeps_and_products(r)) for r in group if r.relative <= tolerance]
            out[case][solver] = min(reached, default=math.inf)
    return out


def get_penalty_time_of_miss(records: Records) -> float:
    """Return the time [s] that a missed tolerance counts with: the time limit."""
    return max((r.time_limit for r in records), default=1.0)


def compute_mean_times_by_law(records: Records) -> dict[str, dict[float, dict[str, tuple[float, int, int]]]]:
    """Return {law: {tolerance: {solver: (shifted geometric mean of times [s], solved cases, all cases)}}}.

    A missed tolerance counts with the time limit. Only solvers that accept every case of a law are included.
    """
    limit = get_penalty_time_of_miss(records)
    out: dict[str, dict[float, dict[str, tuple[float, int, int]]]] = {}
    for law, cases in _group_cases_by_law(records).items():
        out[law] = {}
        for tolerance in get_tolerances(records):
            times = collect_times_to_tolerance(records, tolerance)
            by: dict[str, tuple[float, int, int]] = {}
            for solver in _select_solvers_with_all_times(times, cases):
                t = [times[c][solver] for c in cases]
                solved = sum(map(math.isfinite, t))
                by[solver] = (
                    compute_geometric_mean([x if math.isfinite(x) else limit for x in t], MEAN_TIME_SHIFT),
                    solved,
                    len(cases),
                )
            out[law][tolerance] = dict(sorted(by.items(), key=lambda kv: kv[1][0]))
    return out


@dataclass(frozen=True)
class Backend:
    """Times of a third-party solver to the middle tolerance, on the cases that it solves.

    Parameters
    ----------
    solver : str
    solved : int
    total_time : float, s
        Geometric mean of the time of the complete call.
    backend_time : float, s
        Geometric mean of the time in the solver's own interface, on converted data.
    wins : int
        Cases on which `backend_time` is shorter than the complete call of lavender's fastest solver.
    """

    solver: str
    solved: int
    total_time: float
    backend_time: float
    wins: int


def compare_backend_times(records: Records) -> list[Backend]:
    """Return solvers with both times, sorted by the time of their own interface."""
    tolerances, modes = get_tolerances(records), get_modes_to_tolerance(records)
    tolerance = tolerances[len(tolerances) // 2]
    best: dict[tuple[str, str], Record] = {}
    for r in records:
        key = (r.solver, r.case)
        counts = r.mode in modes and r.start == "cold" and not r.interleave_group
        reached = counts and r.is_usable and r.relative <= tolerance
        if reached and (key not in best or r.time_min < best[key].time_min):
            best[key] = r
    ours: dict[str, float] = {}
    for (_, case), r in best.items():
        if r.backend_time_min is None:
            ours[case] = min(r.time_min, ours.get(case, math.inf))
    out = []
    for solver in sorted({r.solver for r in best.values() if r.backend_time_min is not None}):
        mine = {c: r for (s, c), r in best.items() if s == solver and r.backend_time_min is not None}
        backend_times = {c: r.backend_time_min or 0.0 for c, r in mine.items()}
        total_time = compute_geometric_mean([r.time_min for r in mine.values()], MEAN_TIME_SHIFT)
        wins = sum(t < ours.get(c, math.inf) for c, t in backend_times.items())
        out.append(
            Backend(
                solver,
                len(mine),
                total_time,
                compute_geometric_mean(list(backend_times.values()), MEAN_TIME_SHIFT),
                wins,
            )
        )
    return sorted(out, key=lambda b: b.backend_time)


def _group_cases_by_law(records: Records) -> dict[str, list[str]]:
    """Group the cases that ran by law."""
    ran = {r.case for r in records if r.step < 0}
    out: dict[str, list[str]] = defaultdict(list)
    for name, info in records.cases.items():
        if name in ran:
            out[info.law].append(name)
    return dict(out)


def _select_solvers_with_all_times(
    times: Mapping[str, Mapping[str, float]], cases: Sequence[str]
) -> list[str]:
    """Return the solvers that have a time on every case."""
    everyone = sorted({s for c in cases for s in times.get(c, {})})
    return [s for s in everyone if all(s in times.get(c, {}) for c in cases)]


def compute_profiles(records: Records, measure: str = "time") -> list[Profile]:
    """Compute Dolan-More performance profiles, one for each law and tolerance.

    A profile gives the share of cases that a solver solves within a multiple of the best solver's time or work. A case
    that a solver misses counts with an infinite multiple. The cases of a profile have one law and belong to one run
    (`Records.select_latest_run`); a case that no solver solves counts as missed by all solvers.

    Parameters
    ----------
    records : Records
    measure : {"time", "work"}
        "work": passes over A, of the solvers that do no other work (`count_sweeps_and_products_to_tolerance`).
    """
    check_choice("measure", measure, ("time", "work"))
    out = []
    for law, cases in _group_cases_by_law(records).items():
        for tolerance in get_tolerances(records):
            times = (
                collect_times_to_tolerance if measure == "time" else count_sweeps_and_products_to_tolerance
            )(records, tolerance)
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
            out.append(Profile(law, tolerance, len(cases), curves, measure))
    return out


# -- campaigns ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Robustness:
    """Results of one solver over the cases of a campaign with one structure."""

    family: str
    solver: str
    cases: int
    reached: Mapping[float, int]  # Tolerance -> number of cases that the solver solved to this tolerance.
    wrong: int  # Number of contradicted claims.
    died: int
    budgets: Mapping[int, tuple[float, float]]  # Iterations -> median and 95th percentile of the residual.
    hardest: str  # Case with the largest residual of its best run.


def compute_robustness(records: Records) -> list[Robustness]:
    """Count solved cases, false claims and crashes by structure and solver, with residuals by budget."""
    tolerances, modes = get_tolerances(records), get_modes_to_tolerance(records)
    groups = {k[:2]: g for k, g in group_runs_by_pair(records).items() if k[2] == "cold"}
    solvers = sorted({solver for _, solver in groups})
    out = []
    for family, cases in group_cases_by_family(records).items():
        for solver in solvers:
            groups_of_case = {c: groups[c, solver] for c in cases if (c, solver) in groups}
            if not groups_of_case:
                continue
            best = {c: min(r.relative for r in g) for c, g in groups_of_case.items()}
            to_tolerance = [
                min((r.relative for r in g if r.mode in modes), default=math.inf)
                for g in groups_of_case.values()
            ]
            by_budget: dict[int, list[float]] = defaultdict(list)
            for group in groups_of_case.values():
                for r in group:
                    if r.mode == "budget":
                        by_budget[r.max_iter].append(r.relative)
            runs = [r for g in groups_of_case.values() for r in g]
            out.append(
                Robustness(
                    family=family,
                    solver=solver,
                    cases=len(groups_of_case),
                    reached={x: sum(v <= x for v in to_tolerance) for x in tolerances},
                    wrong=sum(bool(r.status_conflict) for r in runs),
                    died=sum(r.status.startswith(DEATH_STATUSES) for r in runs),
                    budgets={n: (median(v), compute_quantile(v, 0.95)) for n, v in sorted(by_budget.items())},
                    hardest=max(best, key=lambda c: best[c]),
                )
            )
    return out


# -- sequences ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pass:
    """Results of one solver over one sequence at one budget or tolerance, cold and with carried impulses."""

    sequence: str
    solver: str
    mode: str
    tol: float
    max_iter: int
    steps: int  # Number of steps of the sequence; a pass that was stopped has fewer times.
    left_out: int  # Number of steps of the sequence that did not load.
    times: Mapping[str, tuple[float, ...]]  # Start -> time [s] of each step.
    iterations: Mapping[str, int]
    residuals: Mapping[str, tuple[float, ...]]  # Start -> relative residual of each step.
    numbers: Mapping[str, tuple[int, ...]]  # Start -> number of each step in its recording.

    @property
    def target(self) -> str:
        """Budget or tolerance."""
        return describe_target(self.mode, self.tol, self.max_iter)

    @property
    def start(self) -> str:
        """The start that a simulation uses: "carried" if the solver takes a start, else "cold"."""
        return "carried" if "carried" in self.times else "cold"

    @property
    def total_times(self) -> dict[str, float]:
        """Time of all steps [s] by start."""
        return {start: sum(times) for start, times in self.times.items()}

    def get_median_residual(self, start: str) -> float:
        """Median residual over the steps."""
        return median(self.residuals[start]) if self.residuals.get(start) else math.nan

    @property
    def carried_gain(self) -> float:
        """Median over the steps of cold over carried residual; nan without both."""
        cold, carried = self.residuals.get("cold"), self.residuals.get("carried")
        if not cold or not carried:
            return math.nan
        # A pass that was stopped has fewer steps than the other: compare the steps that both solved.
        pairs = [(c, w) for c, w in zip(cold, carried, strict=False) if w > 0.0 and math.isfinite(c)]
        return median(c / w for c, w in pairs) if pairs else math.nan


def group_runs_by_pass(records: Records) -> list[Pass]:
    """Group the runs over sequences: times, iterations and residuals of each step, carried and cold."""
    groups: dict[tuple[str, str, str, float, int], dict[str, list[Record]]] = defaultdict(
        lambda: defaultdict(list)
    )
    for r in records:
        if r.step >= 0 and not r.interleave_group and r.case in records.cases:
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
                times={s: tuple(_get_step_time(r) for r in g) for s, g in by_start.items()},
                iterations={s: sum(r.iterations for r in g) for s, g in by_start.items()},
                residuals={s: tuple(r.relative for r in g) for s, g in by_start.items()},
                numbers={s: tuple(r.step for r in g) for s, g in by_start.items()},
            )
        )
    return out


def _get_step_time(r: Record) -> float:
    """Return the time [s] of a step, or its time limit if it has no result."""
    return r.time_min if math.isfinite(r.time_min) else r.time_limit


def group_passes_by_sequence(records: Records) -> dict[str, list[Pass]]:
    """Group passes by sequence."""
    out: dict[str, list[Pass]] = defaultdict(list)
    for one in group_runs_by_pass(records):
        out[one.sequence].append(one)
    return dict(out)
