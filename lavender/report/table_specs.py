"""Build every table of a report. The page, the terminal and the summary show the same tables.

`list_sections` defines the order of the tables in the terminal and the summary. The page shows the same tables between
its figures.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from lavender.base.deadline import format_seconds
from lavender.judge.residuals import UNCONVERGED
from lavender.judge.solution import CONFIRMED, CONTRADICTED, NOT_PROVEN
from lavender.report.bench import recommendation, resampling, statistics
from lavender.report.bench.recommendation import Advice, Choice, FamilyAdvice
from lavender.report.bench.record import Record, Skip, escape_unprintable, format_tolerance, make_file_name
from lavender.report.bench.store import Records
from lavender.report.engine import INSIDE, is_ranked_before, list_cases_of, rank_engine
from lavender.report.findings import Report
from lavender.report.table import WORDS, Cell, Table
from lavender.report.text import (
    NONE,
    format_count,
    format_left_out_count,
    format_percent,
    format_ratio,
    format_residual,
    format_run_name,
    format_solved_share,
)
from lavender.solvers.registry import specs

Rows = list[Sequence[str | Cell]]
GOOD = ("CONVERGED", "ROUNDOFF_LIMIT")
CLAIM_MARKS = {CONFIRMED: "", NOT_PROVEN: NOT_PROVEN, CONTRADICTED: "✗ contradicted"}
SHOWN_TIES = 2
DIFFICULTY = (
    "sweeps of pgs to a thousandth of the error of the zero impulse; condition of A scaled to a unit diagonal; "
    "solvers with bit-identical results and no iteration, whose times are times of one shortcut"
)
# Marks of times: of recommended calls, which were repeated alternately, and of single runs.
INTERLEAVED, ALONE = (
    "interleaved",
    "alone",
)
ENGINES_OWN = "engine's own"  # Head of the column for the solver of the engine that recorded the cases.
NOT_COMPARED = "no case has the same numbers in both (steps of sequences are not compared)"


@dataclass(frozen=True)
class Section:
    """A table under its heading.

    Parameters
    ----------
    title, note : heading, and the meaning of the numbers
    table : the table
    grouped : whether rows of one case or structure form groups
    empty : text in place of an empty table; without it, a section without rows is left out
    """

    title: str
    note: str
    table: Table
    grouped: bool = False
    empty: str = ""


def list_sections(report: Report) -> list[Section]:
    """List the tables of a report with their headings, from the recommendations to changes since an earlier report.

    An empty table is left out, unless its section has a text for this case.
    """
    records, tolerances = report.ranked_records, report.tolerances
    if report.is_campaign:
        shares = tabulate_solved_shares(statistics.compute_robustness(records), tolerances)
        note = "no times; share of cases brought to a tolerance, residual at each budget"
        sections = [Section("Campaign", note, shares, grouped=True)]
    else:
        timed = (
            f"{INTERLEAVED} to {format_tolerance(tolerances[len(tolerances) // 2])}, else {ALONE}"
            if has_interleaved_calls(report)
            else ALONE
        )
        by_structure = (
            f"to a tolerance: mean time, {timed} (cold, if not carried), share of cases solved, budget; "
            "in a time or with sweeps: share of cases served, nine of ten at least, residual at the 90th percentile; "
            "≈ as good within noise"
        )
        by_sweeps = "share of cases served, residual at the 90th percentile"
        inside = (
            "judged like all solvers; its time excludes the copy of the problem and the judge; ranked as in the "
            "first sentence"
        )
        every = "floor: rounding to float64 allows no better"
        carried = (
            "time of all steps, of a part if a limit ended the run; median residual by budget; carried from step to "
            "step, or cold if the solver takes no start"
        )
        cases = tabulate_times_to_tolerances(
            statistics.summarize_runs_by_case(records, tolerances), tolerances
        ).without_columns("form")
        sections = [
            Section("By structure", by_structure, tabulate_recommended_solvers(report)),
            Section("By sweeps", by_sweeps, tabulate_best_solver_by_sweeps(report.rankings)),
            Section("Inside the engine", inside, tabulate_engines(report)),
            Section("Cases", every, cases, grouped=True),
            Section(
                "Difficulty", DIFFICULTY, tabulate_difficulties(statistics.compute_difficulties(records))
            ),
            *(
                Section(f"Sequence {escape_unprintable(name)}", carried, tabulate_sequence(passes))
                for name, passes in statistics.group_passes_by_sequence(records).items()
            ),
        ]
    if report.earlier_run is not None:
        changed = tabulate_changed_times(report.earlier_run, records)
        title = f"Against {escape_unprintable(report.earlier_run.source)}"
        empty = (
            "nothing beyond noise" if statistics.compare_times(report.earlier_run, records) else NOT_COMPARED
        )
        sections.append(Section(title, "times to a tolerance", changed, empty=empty))
    return [s for s in sections if s.table.rows or s.empty]


def build_short_table(report: Report) -> Table:
    """Build the table of a short report, for the middle tolerance.

    A row is a structure with its best solver or, if there is one structure, a solver. For a campaign, the table has
    the share of cases that each solver solves.
    """
    middle = len(report.tolerances) // 2
    if report.is_campaign:
        table = tabulate_solved_shares(
            statistics.compute_robustness(report.ranked_records), report.tolerances[middle : middle + 1]
        )
        return table.without_columns(*(head for head in table.heads if "iterations" in head), "hardest")
    if len(report.rankings) == 1:
        return _tabulate_solvers(report, report.tolerances[middle])
    table = tabulate_recommended_solvers(report)
    column = 1 + middle
    rows: Rows = [[str(row[0]), replace(row[column], after="")] for row in table.rows]  # type: ignore[type-var]
    head = f"{table.heads[column]}, timed {INTERLEAVED if has_interleaved_calls(report) else ALONE}"
    heads = ["structure", head]
    if ENGINES_OWN in table.heads:
        heads.append(ENGINES_OWN)
        rows = [[*row, whole[-1]] for row, whole in zip(rows, table.rows, strict=True)]
    return Table(heads, rows, words=WORDS | set(heads))


def has_interleaved_calls(report: Report) -> bool:
    """Return whether calls of the recommendation were timed alternately."""
    return any(r.interleave_group for r in report.ranked_records)


def _tabulate_solvers(report: Report, tolerance: float) -> Table:
    """Tabulate solvers by time to a tolerance, for records of one structure; recommended solvers come first."""
    raced = {
        choice.solver: (final.as_record, choice) for final, choice in report.verdict.ranking if choice.solved
    }
    alone = [
        c for c in report.rankings[0].by_tolerance[tolerance].ranking if c.solved and c.solver not in raced
    ]
    rows: Rows = [
        [
            c.solver,
            Cell.time(c.score, after=format_solved_share(c.solved, c.cases)),
            f"{line.target}, {line.start}",
            INTERLEAVED if line.interleave_group else ALONE,
        ]
        for line, c in raced.values()
    ]
    rows += [
        [c.solver, Cell.time(c.score, after=format_solved_share(c.solved, c.cases)), c.how, ALONE]
        for c in alone
    ]
    engine = rank_engine(report.engines, report.ranked_records, report.rankings[0].cases, tolerance)
    if engine is not None and engine.solved:
        ranked = [*(choice for _, choice in raced.values()), *alone]
        before = sum(not is_ranked_before(engine, choice) for choice in ranked)
        time = Cell.time(engine.score, after=format_solved_share(engine.solved, engine.cases))
        rows.insert(before, [f"engine's {engine.solver}", time, "own, warm", "inside the engine"])
    return Table(["solver", f"to {format_tolerance(tolerance)}", "target", "timed"], rows)


# -- recommendations ---------------------------------------------------------------------------------------


def format_advice(advice: Advice, in_time: bool) -> Cell:
    """Return a cell with the best solver of a ranking, its time or residual, number of solved cases, and budget."""
    best, ties = advice.best, advice.tied_solvers
    if best is None:
        most = advice.ranking[0] if advice.ranking else None
        return Cell("none", after=f" ({most.solved}/{most.cases} at most)" if most and most.solved else "")
    write = format_residual if in_time else format_seconds
    after = f", {best.how}" if best.how else ""
    if ties:
        others = f" and {len(ties) - SHOWN_TIES} more" if len(ties) > SHOWN_TIES else ""
        after += f" ≈ {', '.join(ties[:SHOWN_TIES])}{others}"
    more, title = "", ", ".join(ties)
    if best.cases > 1 and not math.isnan(best.worst):
        p95 = f"p95 {write(best.p95)}, " if best.cases >= 20 and not in_time else ""
        more, title = (
            f"{p95}worst {write(best.worst)}",
            f"worst: {best.hardest}" + (f"; ≈ {title}" if ties else ""),
        )
    mark = "warn" if best.solved < best.cases else ""
    text = ("to " if in_time else "") + write(best.score) + format_solved_share(best.solved, best.cases)
    return Cell(text, best.solver, after, more, title, mark=mark)


def tabulate_recommended_solvers(
    report: Report,
    links: Mapping[str, str] | None = None,
    rankings: Sequence[FamilyAdvice] | None = None,
) -> Table:
    """Tabulate the best solver to each tolerance and within each time [s], for each structure and sequence.

    `links` maps the name of a structure or sequence to the id of the part of the page to which its cell links.
    `rankings` replaces the rankings of the report.
    """
    rankings = report.rankings if rankings is None else rankings
    heads = [
        *(f"to {format_tolerance(x)}" for x in report.tolerances),
        *(f"in {format_seconds(t)}" for t in report.recommendation_times),
    ]
    tolerance = report.tolerances[len(report.tolerances) // 2]
    engines = [rank_engine(report.engines, report.ranked_records, line.cases, tolerance) for line in rankings]
    rows: Rows = [
        [
            Cell(
                line.name,
                after=format_left_out_count(line.left_out),
                more=format_count(line.n_cases, "step" if line.sequence else "case"),
                link=(links or {}).get(line.name, ""),
            ),
            *(format_advice(a, False) for a in line.by_tolerance.values()),
            *(format_advice(a, True) for a in line.by_time.values()),
            _format_engine(engine, tolerance),
        ]
        for line, engine in zip(rankings, engines, strict=True)
    ]
    table = Table(["structure", *heads, ENGINES_OWN], rows, folds=True)
    return table if any(engines) else table.without_columns(ENGINES_OWN)


def _format_engine(engine: Choice | None, tolerance: float) -> Cell:
    """Return the cell of the engine's own solver, with its time to the tolerance of the recommendation."""
    if engine is None or not engine.solved:
        return Cell(NONE if engine is None else f"nothing to {format_tolerance(tolerance)}")
    text = format_seconds(engine.score) + format_solved_share(engine.solved, engine.cases)
    return Cell(text, engine.solver, f", to {format_tolerance(tolerance)}", title=INSIDE)


def tabulate_best_solver_by_sweeps(lines: Sequence[FamilyAdvice]) -> Table:
    """Tabulate the best solver with each budget of sweeps; the table is empty if no budget was run."""
    budgets = sorted({n for line in lines for n in line.by_sweeps})
    heads = [format_count(int(n), "sweep") for n in budgets]
    rows: Rows = [
        [
            Cell(line.name, after=format_left_out_count(line.left_out)),
            *(format_advice(x, True) for x in line.by_sweeps.values()),
        ]
        for line in lines
        if line.by_sweeps
    ]
    return Table(["structure", *heads], rows, folds=True)


# -- cases -------------------------------------------------------------------------------------------------


def tabulate_cases(
    records: Records, fastest: Mapping[str, statistics.Reach | None], tolerance: float, stored: bool
) -> Table:
    """Tabulate each case with its size, the fastest solver to the tolerance, and the residual of its stored answer."""
    rows: Rows = []
    for name, best in fastest.items():
        info = records.cases[name]
        time = math.inf if best is None else best.times[tolerance]
        answer = format_residual(info.stored) if math.isfinite(info.stored) else NONE
        rows.append(
            [
                Cell(name, link=f"case-{make_file_name(name)}"), info.law, str(info.rows), str(info.contacts),
                ", ".join(info.structure), "none" if best is None else best.solver, Cell.time(time),
                Cell(answer, value=info.stored),
            ]
        )  # fmt: skip
    head = f"fastest to {format_tolerance(tolerance)}"
    heads = ["case", "law", "rows", "contacts", "structure", head, "time", "stored answer"]
    table = Table(heads, rows, words=WORDS | {head})
    return table if stored else table.without_columns("stored answer")


def tabulate_times_to_tolerances(reaches: Sequence[statistics.Reach], tolerances: Sequence[float]) -> Table:
    """Tabulate time to each tolerance, smallest residual, status and claim of each case and solver."""
    rows: Rows = [
        [
            r.case,
            format_run_name(r.solver, r.start),
            *(Cell.time(r.times[x]) for x in tolerances),
            Cell(format_residual(r.best), after=" floor" if r.at_floor else ""),
            Cell(r.status, mark="good" if r.status in GOOD else "warn"),
            Cell(CLAIM_MARKS[r.claim_check], more=r.status_conflict),
            r.form,
        ]
        for r in reaches
    ]
    marks = ["bad" if r.status_conflict else "" for r in reaches]
    heads = [
        "case",
        "solver",
        *(f"to {format_tolerance(x)}" for x in tolerances),
        "best",
        "status",
        "claim",
        "form",
    ]
    return Table(heads, rows, marks)


def tabulate_difficulties(difficulties: Sequence[statistics.Difficulty]) -> Table:
    """Tabulate the measures of difficulty of each case."""
    rows: Rows = [
        [
            d.case,
            str(d.rows),
            NONE if d.sweeps is None else str(d.sweeps),
            NONE if d.condition is None else format_residual(d.condition),
            ", ".join(d.same),
        ]
        for d in difficulties
    ]
    heads = ["case", "rows", "sweeps", "condition", "same answer"]
    table = Table(heads, rows)
    return table if any(row[4] for row in rows) else table.without_columns("same answer")


def list_cases_solved_at_zero(records: Records) -> list[tuple[str, int, str, float, float]]:
    """List the cases that the zero impulse solves.

    An entry has name, number of rows, the solver with the largest velocity error, and its velocity [m/s] and energy
    [sqrt J].
    """
    worst: dict[str, tuple[str, float, float]] = {}
    for r in sorted(records, key=lambda r: -r.velocity):
        worst.setdefault(r.case, (r.solver, r.velocity, r.energy))
    idle = ((name, info.rows) for name, info in records.cases.items() if info.nothing_to_do)
    return [(name, rows, *worst.get(name, ("", 0.0, 0.0))) for name, rows in idle]


def tabulate_cases_solved_at_zero(records: Records) -> Table:
    """Tabulate cases that the zero impulse solves, with the worst answer to each, in units."""
    rows: Rows = [
        [case, str(n), solver or NONE, format_residual(velocity), format_residual(energy)]
        for case, n, solver, velocity, energy in list_cases_solved_at_zero(records)
    ]
    return Table(["case", "rows", "solver", "velocity [m/s]", "energy [√J]"], rows)


def tabulate_failures(failures: Sequence[Record], campaign: bool) -> Table:
    """Tabulate runs that missed their tolerance or made a false claim. Cases of a campaign are not linked."""
    rows: Rows = [
        [
            Cell(f.case, link="" if campaign else f"case-{make_file_name(f.case)}"),
            format_run_name(f.solver, f.start), f.target,
            f.status, format_residual(f.relative), format_residual(f.roundoff_floor), f.worst_name,
            (f"✗ {f.status_conflict}. " if f.status_conflict else "") + f.message,
        ]
        for f in failures
    ]  # fmt: skip
    marks = ["bad" if f.status_conflict else "" for f in failures]
    return Table(
        ["case", "solver", "target", "status", "residual", "floor", "worst row", "message"],
        rows,
        marks,
    )


def tabulate_skipped_runs(skips: Sequence[Skip]) -> Table:
    """Tabulate pairs of case and solver that were not run, or were stopped during their runs."""
    return Table(["case", "solver", "reason"], [[s.case, s.solver, s.reason] for s in skips])


def tabulate_changed_times(old: Records, new: Records) -> Table:
    """Tabulate times to a tolerance that differ from an earlier run beyond noise."""
    changes = [c for c in statistics.compare_times(old, new) if c.kind != "same"]
    rows: Rows = []
    for c in changes:
        factor = f" {c.new / c.old:.3g} times" if c.kind in ("faster", "slower") else ""
        times_of = (format_tolerance(c.tolerance), Cell.time(c.old), Cell.time(c.new))
        rows.append([c.case, format_run_name(c.solver, c.start), *times_of, c.kind + factor])
    marks = ["bad" if c.kind in ("lost", "slower") else "good" for c in changes]
    return Table(["case", "solver", "tolerance", "before", "now", "change"], rows, marks)


# -- over many cases ---------------------------------------------------------------------------------------


def tabulate_solved_shares(rows: Sequence[statistics.Robustness], tolerances: Sequence[float]) -> Table:
    """Tabulate the share of cases solved to each tolerance, false claims, and residual by budget."""
    budgets = sorted({n for row in rows for n in row.budgets})
    cells = [
        {
            "structure": r.family,
            "solver": r.solver,
            "cases": str(r.cases),
            **{f"to {format_tolerance(x)}": format_percent(r.reached[x], r.cases, 1) for x in tolerances},
            "false claims": str(r.wrong),
            "died": str(r.died),
            **{
                f"{n} iterations: median, 95 %": ", ".join(map(format_residual, r.budgets[n]))
                if n in r.budgets
                else NONE
                for n in budgets
            },
            "hardest": r.hardest,
        }
        for r in rows
    ]
    return Table.from_rows(cells, ["bad" if r.wrong or r.died else "" for r in rows])


def tabulate_claims(records: Records) -> Table:
    """Tabulate how many claims of each solver are correct."""
    claims = statistics.count_claims(records)
    rows: Rows = [
        [
            c.solver, str(c.runs), format_percent(c.claims - c.wrong, c.claims) if c.claims else NONE, str(c.claims),
            f"✗ {c.wrong}" if c.wrong else "0", f"{c.reached} of {c.attempted}", str(c.crashed),
        ]
        for c in claims
    ]  # fmt: skip
    marks = ["bad" if c.wrong or c.crashed else "" for c in claims]
    return Table(
        ["solver", "runs", "correct rate", "claims", "wrong", "tolerances reached", "died"], rows, marks
    )


def explain_run_counts(records: Records) -> str:
    """Return sentences on why solvers have different numbers of runs and of claims."""
    tolerances = list(map(format_tolerance, statistics.get_tolerances(records)))
    known, solvers = specs(), sorted({r.solver for r in records})
    swept = {r.solver for r in records if r.mode == "budget"}
    exact = [s for s in solvers if s in known and known[s].exact]
    unlimited = [
        s for s in solvers if s not in swept and (s in exact or not (s in known and known[s].resumable))
    ]
    limited = sorted({r.solver for r in records if r.mode == "time"})
    sentences = [f"Runs are to {', '.join(tolerances)}"]
    if swept:
        sentences[0] += (
            ", and with a fixed budget or sweep order, which claim nothing unless they end at a solution"
        )
    sentences.append("After a missed tolerance no tighter one is run")
    if any(skip.solver for skip in records.skips):
        sentences.append("A solver has no runs on problems that it does not accept")
    if exact and len(tolerances) > 1:
        sentences.append(f"Exact solvers are run to {tolerances[-1]} alone: {', '.join(exact)}")
    if unlimited and swept:
        sentences.append(
            f"Solvers that cannot stop after any iteration have no budgets: {', '.join(unlimited)}"
        )
    if limited:
        sentences.append(
            f"Candidates of a recommendation also have runs with a time limit: {', '.join(limited)}"
        )
    repeated = sum(statistics.repeats_earlier_run(r) for r in records)
    if repeated:
        sentences.append(f"{format_count(repeated, 'run')} that time a call again are not counted")
    return ". ".join(sentences) + "."


def tabulate_mean_times(by_tolerance: Mapping[float, Mapping[str, tuple[float, int, int]]]) -> Table:
    """Tabulate the geometric mean time to each tolerance for one law, and the number of cases that reach it."""
    tolerances = list(by_tolerance)
    rows: Rows = [
        [
            solver,
            *(
                Cell.time(t, after=f" ({n}/{of})")
                for t, n, of in (by_tolerance[x][solver] for x in tolerances)
            ),
        ]
        for solver in by_tolerance[tolerances[0]]
    ]
    return Table(["solver", *(f"to {format_tolerance(x)}" for x in tolerances)], rows)


def tabulate_backends(records: Records) -> Table:
    """Tabulate the times of third-party solvers: whole call, part in their own interface, remaining part, and wins."""
    rows: Rows = [
        [
            b.solver,
            str(b.solved),
            *map(Cell.time, (b.total_time, b.backend_time, b.total_time - b.backend_time)),
            str(b.wins),
        ]
        for b in statistics.compare_backend_times(records)
    ]
    heads = [
        "solver",
        "cases",
        "call",
        "own interface",
        "rest",
        "cases faster",
    ]
    return Table(heads, rows)


def tabulate_residuals_by_order(spreads: Sequence[statistics.Spread]) -> Table:
    """Tabulate the worst over the best residual in several orders of the blocks, by case and solver."""
    rows: Rows = [
        [
            s.case, s.solver, str(s.budget), format_ratio(s.worst_to_best_ratio),
            ", ".join(f"{order} {format_residual(x)}" for order, x in s.by_order.items()),
        ]
        for s in spreads
    ]  # fmt: skip
    return Table(["case", "solver", "budget", "spread", "residual by order"], rows)


def tabulate_sequence_passes(passes: Sequence[statistics.Pass]) -> Table:
    """Tabulate residual and time of each solver over sequences, with carried impulses and cold."""
    starts = ("carried", "cold")
    rows: Rows = []
    for w in passes:
        rows.append(
            [
                Cell(w.sequence, after=format_left_out_count(w.left_out)), w.solver, w.target, str(w.steps),
                f"{w.carried_gain:.3g}" if math.isfinite(w.carried_gain) and w.mode == "budget" else NONE,
                *(format_residual(w.get_median_residual(s)) if s in w.residuals else NONE for s in starts),
                *(
                    Cell.time(w.total_times[s], after=format_solved_share(len(w.times[s]), w.steps))
                    if s in w.total_times
                    else NONE
                    for s in starts
                ),
                *(str(w.iterations.get(s, NONE)) for s in starts),
            ]
        )  # fmt: skip
    heads = [f"{what}, {start}" for what in ("median", "time", "iterations") for start in starts]
    return Table(["sequence", "solver", "target", "steps", "gain", *heads], rows)


def tabulate_sequence(passes: Sequence[statistics.Pass]) -> Table:
    """Tabulate the solvers on a sequence: time of all steps to each tolerance, median residual by budget.

    The steps start from carried impulses, or cold if the solver takes no start. Solvers are ordered by the number of
    steps solved to the middle tolerance, then by time.
    """
    tolerances = sorted({w.tol for w in passes if w.mode == "tol"}, reverse=True)
    budgets = sorted({w.max_iter for w in passes if w.mode == "budget"})
    by_target = {(w.solver, w.mode, w.tol if w.mode == "tol" else w.max_iter): w for w in passes}
    middle = tolerances[len(tolerances) // 2] if tolerances else math.nan

    def get_sort_key(solver: str) -> tuple[float, float, str]:
        w = by_target.get((solver, "tol", middle))
        return (
            (0, math.inf, solver) if w is None else (-len(w.times[w.start]), w.total_times[w.start], solver)
        )

    rows: Rows = []
    for solver in sorted({w.solver for w in passes}, key=get_sort_key):
        timed = [by_target.get((solver, "tol", x)) for x in tolerances]
        limited = [by_target.get((solver, "budget", n)) for n in budgets]
        rows.append(
            [
                solver,
                *(
                    NONE
                    if w is None
                    else Cell.time(
                        w.total_times[w.start], after=format_solved_share(len(w.times[w.start]), w.steps)
                    )
                    for w in timed
                ),
                *(NONE if w is None else format_residual(w.get_median_residual(w.start)) for w in limited),
            ]
        )
    heads = [f"to {format_tolerance(x)}" for x in tolerances]
    return Table(["solver", *heads, *(f"{n} iterations" for n in budgets)], rows)


def tabulate_engines(report: Report) -> Table:
    """Tabulate engines' own answers, and lavender's recommended solver on the same cases, at the middle tolerance."""
    records, tolerance = report.ranked_records, report.tolerances[len(report.tolerances) // 2]
    rows = []
    for c in report.engines:
        cases = list_cases_of(c, records)
        engine = rank_engine([c], records, cases, tolerance)
        first = _recommend_here(records, cases, tolerance)
        far = c.unconverged and c.where
        rows.append(
            {
                "recorded": c.folder,
                "steps": f"{c.steps}{format_left_out_count(c.left_out)}",
                "rows": f"{c.rows:g}",
                "engine's own": f"{c.solver} (inside the engine)",
                f"to {format_tolerance(tolerance)}": _format_time(engine),
                "residual, median": format_residual(c.relative),
                "worst": format_residual(c.worst),
                "above floor": str(c.above_floor),
                UNCONVERGED: str(c.unconverged),
                "furthest off": f"{c.velocity:.2g} m/s, {c.where}" if far else NONE,
                "first here": NONE if first is None else first.solver,
                f"to {format_tolerance(tolerance)}, here": _format_time(first),
            }
        )
    return Table.from_rows(rows)


def _recommend_here(records: Records, cases: Sequence[str], tolerance: float) -> Choice | None:
    """Return the recommended solver for the cases of a folder, ranked as in the report's first sentence."""
    if not cases:
        return None
    timing_mode = "steps" if records.cases[cases[0]].sequence else "call"
    alone = recommendation.rank_to_tolerance(records, "", cases, tolerance)
    best = resampling.recommend_for_cases(
        records, alone, resampling.select_calls_with_most_cases(records, timing_mode), cases
    ).best
    return best if best is not None and best.solved else None


def _format_time(choice: Choice | None) -> str:
    if choice is None or not choice.solved:
        return NONE
    return format_seconds(choice.score) + format_solved_share(choice.solved, choice.cases)
