"""Compute the sentences and tables of a report, print them on a terminal, and write them to a folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pandas as pd

from lavender.base.deadline import format_seconds
from lavender.base.errors import InputError
from lavender.io.stored import SUFFIXES
from lavender.problem.derived import cached_property
from lavender.report import tables
from lavender.report.figures import build_figures
from lavender.report.render import Section, Statement, format_markdown, print_table, render_page, write_files
from lavender.report.runner import Event
from lavender.report.tables import INSIDE, PLAIN_SWEEPS, STRUCTURE_ORDER, Contents, is_plug_in, rank_solvers
from lavender.report.text import escape_markdown, escape_unprintable, format_count, format_residual
from lavender.report.text import format_tolerance as format_tol
from lavender.report.timing import format_call
from lavender.suite import FAMILIES

if TYPE_CHECKING:
    from rich.console import Console

LONG_TABLES = ("cases", "failures", "runs", "skipped")  # Tables that are not written as LaTeX and Markdown.
GROUPED_TABLES = ("runs", "sequences", "times")  # Tables that show equal first cells once on a terminal.
# Largest number of lines of a short report, and how many of these the command adds: a blank line, the page, reused runs
# and cases that did not load.
MAX_LINES, COMMAND_LINES = 25, 5
# Largest number of warnings about cases that did not load, and of notes about crashed solvers.
MAX_LEFT_OUT = 3
MAX_NOTES = 20  # Largest number of notes of one kind in a complete report.
MAX_NAMED = 2  # A sentence names up to this many ties, misses or plug-ins.
MAX_SWEEP_ERROR = 1e-3  # [m/s] A number of sweeps is recommended if no velocity error is larger.
PLURALS = {"mesh": "meshes"}
LIMITATIONS = """\
Times are wall-clock times of one call of lv.solve, with the judge and Python, whose share below about 0.2 ms is as \
large as the solver's. A simulation that reuses a factorisation between steps needs the set-up less often. BLAS and \
OpenMP have one thread; threads that a backend starts in other ways are not limited.
Means of times count the solved cases only: compare them only between solvers of the same cases.
The residual is zero exactly at a solution; the distance of an impulse from the solution also depends on the \
conditioning."""

#: Title, meaning of the numbers, and function of each table, in their order.
SECTIONS: dict[str, tuple[str, str, Callable[[tables.Contents], pd.DataFrame]]] = {
    "structures": ("By structure", (
        "The solver that solves the largest number of cases to each tolerance, then the fastest, with the mean time of "
        "the cases that it solves. Solvers after ≈ tie with it within the noise of the repetitions."
    ), tables.tabulate_fastest),
    "in-time": ("In a time", (
        "The solver with the smallest residual at the 90th percentile of the cases; none if no solver halves the "
        "residual of nine cases of ten."
    ), tables.tabulate_in_time),
    "costs": ("Cost and rows", (
        "Time to the middle tolerance as a power of the number of rows, fitted to the cases that a solver solves; "
        "scatter: typical factor between a case and the fit."
    ), tables.tabulate_costs),
    "times": ("By law", "Number of cases that each solver solves, and their mean time.", tables.tabulate_times),
    "budgets": ("By iterations", "Residual after fixed numbers of iterations.", tables.tabulate_budgets),
    "claims": ("Claims and verdicts", (
        "A claim is correct if the judge confirms it. The judge computes the residual from the problem's data."
    ), tables.tabulate_claims),
    "failures": (
        "Failures", "Runs that missed their tolerance, that died, or that made a false claim.", tables.tabulate_failures
    ),
    "sweeps": ("Sweeps", (
        "Largest errors over the steps after the first, after a fixed number of sweeps, from zero impulses (cold) and "
        "from the impulses of the step before (carried). The velocity error is that of the worst row, the motion error "
        "the largest difference of a body's velocity from that of a solution, over about 20 steps."
    ), tables.tabulate_sweeps),
    "engines": ("Inside the engine", (
        "The engine's own answers, judged like all others. Its time excludes the copy of the problem and the judge."
    ), tables.tabulate_engines),
    "sequences": (
        "Sequences", "All steps, cold and with the impulses of the step before (carried).", tables.tabulate_sequences
    ),
    "cases": ("Cases", "", tables.tabulate_cases),
    "runs": ("Every case", "Time to each tolerance and smallest residual.", tables.tabulate_runs),
}  # fmt: skip
CAMPAIGN_SECTIONS = ("times", "budgets", "claims", "failures")  # Tables of a campaign, which has no times.


class Report(tables.Contents):
    """Contents of a report (`Contents`) with its sentences and tables."""

    @cached_property
    def statements(self) -> tuple[Statement, ...]:
        """The sentences of the recommendation."""
        return recommend(self)

    @cached_property
    def warnings(self) -> list[str]:
        """Sentences on a busy machine, on missing times and on cases that are left out."""
        texts = [self.busy_warning] if self.busy_warning else []
        texts += ["Error and robustness without times: runs end by iterations."] if self.is_campaign else []
        left_out = list_cases_not_loaded(self)
        texts += [f"Left out of all numbers: {cases}: {reason}" for cases, reason in left_out[:MAX_LEFT_OUT]]
        more = len(left_out) - MAX_LEFT_OUT
        return [*texts, f"{more} more are left out: see the table Not run."] if more > 0 else texts

    @cached_property
    def overview(self) -> pd.DataFrame:
        """The table of the first screen: the fastest solver by structure, or each solver if there is one structure."""
        target = f"to {format_tol(self.tolerance)}"
        if not len(self.frame):
            return self.frame.iloc[:, :0]
        if "sweeps" in self.sections and (self.frame["mode"] == "budget").all():
            starts = ("carried", "cold")
            errors = [f"{kind} error, {start} [m/s]" for kind in ("velocity", "motion") for start in starts]
            name, wanted = "sweeps", ["sequence", "solver", "sweeps", *errors]
        elif len(self.structures) > 1 and not self.is_campaign:
            name, wanted = "structures", ["structure", target, f"time {target} [s]"]
        else:
            name, wanted = "times", ["law", "solver", "cases", f"solved {target}", f"time {target} [s]"]
        table = self.sections[name].frames[0].rename(columns={f"time {target} [s]": "time [s]"})
        single = [c for c in ("law", "sequence") if c in table and table[c].nunique() == 1]
        return table[[c for c in (*wanted, "time [s]") if c in table and c not in single]]

    @cached_property
    def sections(self) -> dict[str, Section]:
        """The tables by name, in their order; tables without rows are left out."""
        names = CAMPAIGN_SECTIONS if self.is_campaign else tuple(SECTIONS)
        made = []
        for name, (title, note, make) in SECTIONS.items():
            if name in names and len(self.frame):
                made.append(Section(title, [make(self)], note, name=name))
        if len(self.newest):
            made += [self._compare_with_earlier_run()] if self.earlier is not None else []
            note = "The zero impulse solves these cases. They are left out of all rankings."
            made.append(
                Section("Solved by the zero impulse", [tables.tabulate_idle(self)], note, name="idle")
            )
        diagnostics = pd.DataFrame(list_diagnostics(self), columns=["case", "possible mistake"])
        made.append(Section("Diagnostics about the data", [diagnostics], name="diagnostics"))
        made.append(Section("Not run", [self.skips[["case", "solver", "reason"]]], name="skipped"))
        return {section.name: section for section in made if len(section.frames[0])}

    def _compare_with_earlier_run(self) -> Section:
        """Return the table of changes since the earlier run; its note has the number of compared times."""
        assert self.earlier is not None
        changes = tables.tabulate_changes(self)
        compared = int(changes.pop("compared").iloc[0])
        note = f"{compared} times compared, on cases with the same numbers in both (no steps of sequences)"
        if changes.empty:
            changes = pd.DataFrame(
                {"change": ["nothing beyond noise" if compared else "nothing was compared"]}
            )
        title = f"Against {escape_unprintable(str(self.earlier.attrs.get('source', 'earlier runs')))}"
        return Section(title, [changes], note, name="changes")

    def describe_run(self) -> pd.DataFrame:
        """Return the machine, versions and plan of the newest run."""
        run, facts = self.machine, {}
        if run:
            lists = {"versions": {"lavender": run["lavender"], "Python": run["python"], **run["versions"]},
                     "build": run["build"] | {"load": run["load"]}, "plan": run["plan"]}  # fmt: skip
            counts = format_count(self.frame["case"].nunique(), "case"), format_count(len(self.newest), "run")
            facts = {
                "run": f"{run['run']}, started {run['started']}; {', '.join(counts)}",
                "machine": f"{run['cpu']}, {run['cores']} cores; {run['platform']}",
                "threads": f"{run['threads']} for BLAS and OpenMP while timing; runs are serial",
                **{name: "; ".join(f"{key} {x}" for key, x in some.items()) for name, some in lists.items()},
            }
        return pd.DataFrame(facts.items(), columns=["fact", "value"], dtype=object)


def render_report(report: Report, figures: bool = True, folder: Path | None = None) -> str:
    """Return the page of a report as HTML; with `folder`, each figure is also written there as an SVG file."""
    drawn = build_figures(report) if figures else []
    files = "The folder of this page has every run in records.csv, the tables in tables/ and the figures in figures/."
    sections = [
        Section("Figures", figures=drawn[1:], name="figures"),
        *report.sections.values(),
        Section("Machine, versions, options", [report.describe_run()], files, name="machine"),
        Section("Limitations", note=LIMITATIONS, name="limits"),
    ]
    if len(report.frame) and "failures" not in report.sections:
        note = "Every run reached its target or the round-off floor, and every claim holds."
        sections.insert(1, Section("No failures", note=note, name="failures"))
    return render_page(
        "lavender report", report.statements, sections[len(drawn) < 2 :], warnings=report.warnings,
        first_figure=drawn[0] if drawn else None, folded=True, folder=folder,
    )  # fmt: skip


def write(
    source: pd.DataFrame | Report, folder: str | Path, *, figures: bool = True,
    watch: Callable[[Event], None] = lambda event: None,
) -> Path:  # fmt: skip
    """Write `records.csv`, `tables/*.csv`, `tables/*.tex`, `figures/*.svg`, `summary.md` and `index.html`.

    Parameters
    ----------
    source : DataFrame or Report
        Lines of `lavender.report.run` or `read`, or a report of them with earlier lines and budgets. Times are
        compared within the newest run alone; `records.csv` holds all runs.
    folder : path
    figures : bool
        False leaves out the figures, which take the largest part of the time.
    watch : callable (Event), optional
        Called before each file.

    Returns
    -------
    Path
        Path of index.html.

    Raises
    ------
    InputError
        `source` is neither a DataFrame nor a report, or the folder cannot be written.
    """
    report = Report(source) if isinstance(source, pd.DataFrame) else source
    if not isinstance(report, Report):
        raise InputError(
            f"source is a {type(source).__name__}; the DataFrame of lavender.report.run or a Report is needed"
        )
    folder, files = Path(folder), dict[str, Any]({"records.csv": report.runs})
    for name, section in report.sections.items():
        for kind in ("csv",) if name in LONG_TABLES else ("csv", "tex"):
            files[f"tables/{name}.{kind}"] = section.frames[0]
    files["summary.md"] = lambda: summarise(report)
    files["index.html"] = lambda: render_report(report, figures, folder / "figures")
    order = {name: i for i, name in enumerate(files)}
    write_files(folder, files, lambda name: watch(Event(order[name], len(files), name, "", phase="writing")))
    return folder / "index.html"


def summarise(report: Report) -> str:
    """Return recommendations and tables in Markdown, to paste into a pull request."""
    lines = ["## lavender report", ""]
    if run := report.machine:
        machine = f"{run['cpu']}, {run['threads']} thread; lavender {run['lavender']}, Python {run['python']}"
        lines += [escape_markdown(f"{machine}; run {run['run']}, {run['started']}"), ""]
    for statement in report.statements:
        lines += [escape_markdown(statement.text), ""]
        lines += ["```python", *statement.code, "```", ""] if statement.code else []
    for text in report.warnings:
        lines += [f"**{escape_markdown(text)}**", ""]
    for name, section in report.sections.items():
        if name not in LONG_TABLES:
            lines += [f"**{escape_markdown(section.title)}** {escape_markdown(section.note)}".rstrip(), ""]
            lines += [*format_markdown(section.frames[0]), ""]
    return "\n".join(lines)


# -- on a terminal -----------------------------------------------------------------------------------------


def print_report(report: Report, console: Console, complete: bool = False) -> None:
    """Print the recommendation, a table to the middle tolerance, and notes.

    A short report has up to `MAX_LINES` lines, none wider than the terminal. `complete` prints every sentence, table
    and warning.
    """
    from rich.text import Text

    lines: list[Text] = []
    for i, statement in enumerate(report.statements):
        lines.append(Text(statement.text, style="" if i else "bold"))
        is_cut = len(statement.code) > 1 and not complete
        code = [statement.call_line, "# all lines: --tables"] if is_cut else statement.code
        lines += [Text(f"    {line}") for line in code]
    lines += [Text(report.busy_warning, style="yellow")] if report.busy_warning else []
    for text in lines:
        console.print(text, highlight=False)
    notes = [Text(text, style=style) for text, style in _list_notes(report, MAX_NOTES if complete else 1)]
    if complete:
        for name, section in report.sections.items():
            note = f": {section.note}" if section.note else ""
            console.print(Text.assemble("\n", (section.title, "bold"), note))
            print_table(console, section.frames[0], grouped=name in GROUPED_TABLES)
    elif n := len(report.overview):
        above = sum(len(text.wrap(console, console.width)) for text in lines)
        height = MAX_LINES - COMMAND_LINES - len(notes) - above
        shown = n if n <= height - 2 else max(1, height - 3)
        console.print()
        print_table(console, report.overview.head(shown), cut=True)
        if shown < n:
            console.print(f"{n - shown} more: --tables", highlight=False, style="dim")
    for text in notes:
        console.print(
            text, highlight=False, no_wrap=not complete, overflow="fold" if complete else "ellipsis"
        )


def _list_notes(report: Report, longest: int) -> Iterator[tuple[str, str]]:
    """Yield (note, style): at most `longest` notes of each kind; if there are more, a note has their number."""
    failures = tables.select_failures(report) if len(report.frame) else report.frame
    failures = failures.astype(dict.fromkeys(("solver", "case", "status", "message", "status_conflict"), str))
    false = failures[failures["status_conflict"] != ""]
    # Each solver that died is named once, plug-ins first. A backend that was killed at its time limit is not named.
    died = failures[failures["status"].str.startswith(tables.DEATHS)].drop_duplicates("solver")
    died = died.assign(own=died["solver"].map(is_plug_in).astype(bool)).sort_values("own", ascending=False)
    died = died[died["own"] | (died["status"] != "KILLED")]
    kinds = {
        "crashed": ("red", [f"{r.solver} on {r.case}: {r.status}: {r.message}" for r in died.itertuples()]),
        "false claim": ("red", [f"{r.case}, {r.solver}: {r.status_conflict}" for r in false.itertuples()]),
        "suspicious": ("yellow", [f"{case}: {reason}" for case, reason in list_diagnostics(report)]),
        "left out": ("yellow", [f"{cases}: {reason}" for cases, reason in list_cases_not_loaded(report)]),
    }
    for kind, (style, texts) in kinds.items():
        shown = max(longest, MAX_LEFT_OUT) if kind == "crashed" else longest
        for i, text in enumerate(texts[:shown], 1):
            place = f" ({i} of {len(texts)})" if shown > 1 else f", the first of {len(texts)}"
            yield f"{kind}{place if len(texts) > 1 else ''}: {text}", style
    reasons = report.skips.loc[report.skips["solver"] != "", "reason"]
    skipped = [reason.partition(":")[0] for reason in reasons]
    replacements = Counter(pair for pair in skipped if " → " in pair)
    for pair, n in replacements.items():
        cases = format_count(n, "case")
        yield f"{pair} on {cases} with bounds: the same method; the first accepts only free rows", ""
    if refused := len(skipped) - replacements.total():
        pairs = format_count(refused, "pair")
        yield f"{pairs} of case and solver not run, or not to the end: the page has the reasons", "dim"
    if "changes" in report.sections:
        section = report.sections["changes"]
        counts = sorted(Counter(section.frames[0]["change"]).items())
        text = ", ".join(f"{n} {kind}" if "target" in section.frames[0] else kind for kind, n in counts)
        yield f"{section.title}: {text} ({section.note})", ""
    if "idle" in report.sections:
        frame = report.sections["idle"].frames[0]
        case, _, solver, velocity, _ = frame.iloc[-1]
        cases, speed = format_count(len(frame), "case"), format_residual(velocity)
        yield f"{cases} solved by the zero impulse; largest error {speed} m/s, by {solver} on {case}", "dim"


def list_diagnostics(report: Report) -> list[tuple[str, str]]:
    """Return (case, possible mistake in its data) for all cases.

    Equal diagnostics of a sequence are one entry, with its first step and the number of further steps.
    """
    table = report.cases[["case", "sequence", "diagnostics"]].explode("diagnostics").dropna()
    table["diagnostics"] = table["diagnostics"].map(lambda text: escape_unprintable(str(text)))
    place = table["sequence"].where(table["sequence"] != "", table["case"])
    found, kind = [], table["diagnostics"].map(lambda text: text.partition(":")[0])
    for _, same in table.groupby([place, kind], sort=False):
        more = f" and {format_count(len(same) - 1, 'more step')}" if len(same) > 1 else ""
        found.append((f"{same['case'].iloc[0]}{more}", str(same["diagnostics"].iloc[0])))
    return found


def _group_by_reason(skips: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Group skips by their reason without the name of the case."""
    pairs = zip(skips["case"], skips["reason"], strict=True)
    reasons = [text.removeprefix("did not load: ").removeprefix(f"{case}: ") for case, text in pairs]
    return {str(reason): same for reason, same in skips.groupby(reasons, sort=False)}


def list_skip_reasons(skips: pd.DataFrame) -> list[str]:
    """Return each different reason of some skips; if it holds for several cases, with their number."""
    groups = [
        (r, same["case"].nunique(), same["reason"].iloc[0]) for r, same in _group_by_reason(skips).items()
    ]
    return [first if n == 1 else f"{reason} ({n} cases)" for reason, n, first in groups]


def list_cases_not_loaded(report: Report) -> list[tuple[str, str]]:
    """Return (cases that did not load, reason), grouped by reason, and the number of steps of each sequence."""
    cases = []
    for name, some in report.left_out.items():
        for reason, same in ({some["reason"].iloc[0]: some} if name else _group_by_reason(some)).items():
            first, more = same.iloc[0], len(same) - 1
            if name:
                cases.append((f"{format_count(len(same), 'step')} of {name}", reason))
            elif more:
                cases.append((f"{first['case']} and {format_count(more, 'more case')}", reason))
            else:
                cases.append((first["case"], first["reason"]))
    return cases


# -- recommendation ----------------------------------------------------------------------------------------


def recommend(report: Contents) -> tuple[Statement, ...]:
    """Recommend a solver for all single cases together, then for the steps of all sequences.

    A campaign, which has no times, has no recommendation.
    """
    if report.is_campaign:
        return ()
    if not len(report.frame):
        stopped = report.is_stopped and len(report.runs)
        return (Statement("Stopped: no problem was measured with every solver."),) if stopped else ()
    single, sweeps = report.frame["step"] < 0, _recommend_sweeps(report)
    if sweeps and (report.frame["mode"] == "budget").all():
        return sweeps
    parts = [some for some in (report.frame[single], report.frame[~single]) if len(some)]
    return (*(_recommend_for(report, some) for some in parts), *sweeps)


def _recommend_sweeps(report: Contents) -> tuple[Statement, ...]:
    """State for each sequence the smallest number of sweeps that keeps every velocity error below the limit."""
    table, statements = tables.tabulate_sweeps(report), []
    limit = f"{1e3 * MAX_SWEEP_ERROR:g} mm/s"
    for name, own in table.groupby("sequence", sort=False) if len(table) else ():
        columns = [c for start in ("carried", "cold") if (c := f"velocity error, {start} [m/s]") in own]
        smallest = {}
        for column in columns:
            good = own[(own[column] <= MAX_SWEEP_ERROR) & (own["steps"] == own["steps"].max())]
            plain = good[good["solver"].isin(PLAIN_SWEEPS)]
            smallest[column] = (plain if len(plain) else good).nsmallest(1, "sweeps").to_dict("records")
        if "carried" in columns[0] and smallest[columns[0]]:
            best, *cold = (x for column in columns for x in smallest[column])
            cold = [f"cold: {x['sweeps']} of {x['solver']}" for x in cold] or ["cold: not reached"]
            text = (
                f"{name}: {format_count(best['sweeps'], 'sweep')} of {best['solver']} with warm starts keep every "
                f"velocity error below {limit} ({format_residual(best[columns[0]])} m/s; {cold[0]})"
            )
            plain = own[own["solver"].isin(PLAIN_SWEEPS)]
            if len(plain) and best["solver"] not in PLAIN_SWEEPS:
                least = plain.loc[plain[columns[0]].idxmin()]
                error = format_residual(least[columns[0]])
                text += f"; without acceleration {least['sweeps']} of {least['solver']} leave {error} m/s"
        else:
            best = own.loc[own[columns[0]].idxmin()].to_dict()
            text = (
                f"{name}: no measured number of sweeps keeps every velocity error below {limit}; the smallest is "
                f"{format_residual(best[columns[0]])} m/s, after {best['sweeps']} sweeps of {best['solver']}"
            )
        statements.append(Statement(f"{text}{_describe_own_sweeps(report, str(name))}."))
    return tuple(statements)


def _describe_own_sweeps(report: Contents, sequence: str) -> str:
    """Return the largest velocity error of the engine's own answers to a sequence, if it was recorded."""
    steps = report.cases[report.cases["sequence"] == sequence]
    sources = steps.loc[steps["step"] > 0, "source"]  # The first step does not count in the table either.
    answers = report.engines.reindex([str(Path(s)) for s in sources]).dropna(subset="velocity")
    if not len(answers):
        return ""
    counts = answers["iterations"].dropna()
    own = f" {counts.max():.0f} iterations" if len(counts) else " answers"
    error = format_residual(answers["velocity"].max())
    return f"; the engine's own{own} ({tables.get_engine_name(answers)}): {error} m/s"


def _recommend_for(report: Contents, frame: pd.DataFrame) -> Statement:
    """Recommend the first solver of the ranking on some cases, and name misses, ties, plug-ins and the engine."""
    cases = list(frame["case"].unique())
    ranking = rank_solvers(report, report.tolerance, cases)
    named = _describe_cases(report, cases)
    reached = f"down to {format_tol(report.tolerance)} of the error of the zero impulse"
    engine = tables.rank_engine(report, report.cases.loc[cases], report.tolerance)
    if not len(ranking) or not ranking["solved"].iloc[0]:
        stopped = "Stopped: no" if report.is_stopped else "No"
        return Statement(_add_engine(f"{stopped} solver brings {named} {reached}.", engine, None))
    solver, first, runs = str(ranking.index[0]), ranking.iloc[0], report.ranked_runs
    runs = runs[runs["case"].isin(cases)]
    own = runs[(runs["solver"] == solver) & (runs[["tol", "relative"]].max(axis=1) <= report.tolerance)]
    missed, unreached = _list_unsolved_cases(report, runs, cases, solver)
    time = _describe_solved(first, named)
    if first["worst"] > 3.0 * first["mean"]:
        time += f" ({format_seconds(first['worst'])} at worst, {first['hardest']})"
    loosest = own[own["tol"] == own["tol"].max()]
    use = f"Stopped: {solver}" if report.is_stopped else f"Use {solver}: it"
    sentences = [f"{use} {time}, {_describe_start(frame, loosest)}, {reached}."]
    if missed:
        sentences.append(f"Missed: {_shorten_list(missed)}.")
    if unreached:
        steps = format_count(unreached, "step")
        sentences.append(f"Not reached within the time of a pass (--sequence-time-limit): {steps}.")
    if report.unfinished:
        sentences.append(f"Not measured to the end: {_shorten_list(report.unfinished)}.")
    ties = [
        f"{name} ({format_seconds(t)})" for name, t in ranking.loc[ranking["tie"], "mean"].iloc[1:].items()
    ]
    if ties:
        sentences.append(f"As fast within the noise of the repetitions: {_shorten_list(ties)}.")
    plug_ins = [
        f"{name}: place {row['place']} of {len(ranking)}, {_describe_solved(row, format_count(row['cases'], 'case'))}"
        for name, row in ranking.iterrows()
        if is_plug_in(str(name)) and name != solver
    ]
    if plug_ins:
        sentences.append(f"Plug-in {_shorten_list(plug_ins, '; ')}.")
    call = SimpleNamespace(**loosest.loc[loosest["iterations"].idxmax()].to_dict())
    guessed = bool((report.cases.loc[cases, "guess"] != "").any())
    return Statement(_add_engine(" ".join(sentences), engine, first), format_call(call, guessed))


def _describe_solved(result: Any, named: str) -> str:
    """Return the number of missed cases of a ranked result, then the mean time of the solved ones."""
    misses, solved = int(result["cases"] - result["solved"]), int(result["solved"])
    time = format_seconds(result["mean"]) + (" on average" if solved > 1 else "")
    if not misses:
        return f"solves {named} in {time}"
    if not solved:
        return f"misses all of {named}" if misses > 1 else f"misses {named}"
    return f"misses {misses} of {named} and solves the other{'s' if solved > 1 else ''} in {time}"


def _describe_start(frame: pd.DataFrame, runs: pd.DataFrame) -> str:
    """Describe the start of runs; of carried impulses, count the runs that differ from the cold ones."""
    if not (runs["start"] == "carried").any():
        return "cold"
    names = ["case", "solver", "tol", "iterations", "solution_hash"]
    cold = set(frame.loc[frame["start"] == "cold", names].itertuples(index=False, name=None))
    n = sum(run not in cold for run in runs[names].itertuples(index=False, name=None))
    carrying = format_seconds(runs["carry_time"].mean()) if runs["carry_time"].notna().any() else ""
    apart = f"mapping them takes {carrying} a step, not included; " if carrying else ""
    return f"with the impulses of the previous recorded step as start ({apart}it changed {n} of {len(runs)} solves)"


def _list_unsolved_cases(
    report: Contents, runs: pd.DataFrame, cases: Sequence[str], solver: str
) -> tuple[list[str], int]:
    """Return the cases that a solver misses, each with its smallest residual, and the number of steps not reached.

    A step is not reached if the pass to the tolerance ended before it, and no pass to a larger tolerance missed it.
    """
    own = runs[runs["solver"] == solver]
    is_run = (own["tol"] <= report.tolerance) | (own["relative"] > own["tol"])
    left = own[is_run].groupby("case", observed=True)["relative"].min().reindex(list(cases))
    left = left[~(left <= report.tolerance)]
    is_lost = left.isna() & report.cases.loc[left.index, "sequence"].isin(
        set(own["sequence"].astype(str)) - {""}
    )
    missed = left[~is_lost].items()
    texts = [
        f"{case} ({'not accepted' if x != x else f'residual {format_residual(x)}'})" for case, x in missed
    ]
    return texts, int(is_lost.sum())


def _shorten_list(texts: Sequence[str], separator: str = ", ") -> str:
    """Join up to `MAX_NAMED` texts, and the number of the others."""
    more = len(texts) - MAX_NAMED
    return separator.join(texts[:MAX_NAMED]) + (f" and {more} more" if more > 0 else "")


def _describe_cases(report: Contents, names: Sequence[str]) -> str:
    """Return words for cases: steps of sequences, built-in problems, or the structure that all of them have."""
    infos, n = report.cases.loc[list(names)], len(names)
    sequences = [name for name in infos["sequence"].unique() if name]
    lost = sum(len(report.left_out.get(name, ())) for name in sequences or [""])
    left_out = f" ({lost} left out)" if lost else ""
    if sequences:
        of = sequences[0] if len(sequences) == 1 else f"your {format_count(len(sequences), 'sequence')}"
        return f"the {format_count(n, 'step')} of {of}{left_out}"
    if report.is_stopped:
        return f"the {format_count(n, 'problem')} measured so far{left_out}"
    is_file = infos["source"].astype(str).str.endswith(SUFFIXES)
    if not is_file.any() and all(name.partition("(")[0] in FAMILIES for name in names):
        return (f"the {n} built-in problems" if n > 1 else names[0]) + left_out
    common = set.intersection(*(set(words.split(", ")) for words in infos["structure"]))
    shape = next((s for s in STRUCTURE_ORDER[1:5] if s in common), "problem")
    return (f"your {format_count(n, shape, PLURALS.get(shape, ''))}" if n > 1 else f"your {shape}") + left_out


def _add_engine(text: str, engine: Any, first: Any) -> str:
    """Add the engine's own solver to the sentence: at its beginning if it ranks first, else at its end."""
    if engine is None:
        return text
    own = f"the engine's own {engine['solver']}"
    solves = f"{_describe_solved(engine, format_count(engine['cases'], 'case'))}, {INSIDE}"
    if engine["solved"] and first is not None and tables.is_tie(first, engine):
        return f"{text} As fast within the noise of the repetitions is {own}: it {solves}."
    if engine["solved"] and (
        first is None or (-engine["solved"], engine["mean"]) < (-first["solved"], first["mean"])
    ):
        return f"First is {own}: it {solves}. {text}"
    return f"{text} T{own[1:]} {solves}."
