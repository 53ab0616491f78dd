"""Make the sentences, the page, the files and the terminal's text of a report."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from markupsafe import Markup

from lavender.base.errors import InputError
from lavender.base.lazy_import import pandas as pd
from lavender.problem.derived import cached_property
from lavender.report import figures, tables
from lavender.report.drawing import FigureFolder
from lavender.report.page import PAPER_COLUMNS, Page, check_columns, fold_table, make_table
from lavender.report.render import escape_markdown, format_markdown, print_table, write_files
from lavender.report.runner import Event
from lavender.report.sweeps import SweepStudy
from lavender.report.tables import ENGINE_NAME, Contents, is_plug_in, rank_solvers
from lavender.report.text import (
    NONE,
    escape_unprintable,
    format_count,
    format_power,
    format_residual,
    format_speed,
    format_time,
)
from lavender.report.text import format_tolerance as format_tol
from lavender.report.timing import format_call
from lavender.solvers import registry

if TYPE_CHECKING:
    from rich.console import Console

MAX_SOLVERS = 10  # Rows of the table of solvers; the matrix has all.
MAX_CASES = 40  # Above this number of problems, the matrix has a line for each structure.
MAX_MATRIX_ROWS = 100  # Lines of the folded matrix of all problems; matrix.csv has all.
MAX_WARNINGS = 3  # Warnings of one kind on the first screen.
RATIO_EDGES = (1.1, 2.0, 5.0, 20.0)  # Edges of the colours of the matrix.
MUCH_FASTER = 1.25  # A solver is faster than another on a problem from this ratio of times on.
AUTHOR, TITLE = (
    "The lavender developers",
    "lavender: solvers of rigid-body contact problems, judged in units",
)
LAW_TITLES = {
    "linear": "joints only (linear)",
    "lcp": "contacts without friction, boxes (LCP)",
    "coulomb": "Coulomb friction",
    "cone": "friction cone (relaxed)",
    "program": "quadratic programs",
}
HOW_TO_READ = (
    "Times are wall-clock times of one call of lv.solve (of a quadratic program lv.solve_qp) with the judge and "
    "Python, whose share below about 0.2 ms is as large as the solver's: the minimum of the repetitions. The residual "
    "is the judge's relative residual, 1 at the zero impulse and 0 at a solution; of a quadratic program it is the "
    "largest error of rows, columns and gap. A checked proof solves a problem without a solution. Means are geometric "
    "(shift 10 µs), of the solved problems; ratios are of those that both solve. Solvers tie if their means differ by "
    "less than twice the spread of their repetitions. Problems that the zero impulse solves are not ranked."
)


#: Tables of runs: name, title, function that makes it, and the meaning of its numbers.
RUN_SECTIONS: tuple[tuple[str, str, Callable[[Contents], pd.DataFrame], str], ...] = (
    ("solvers", "Solvers", tables.tabulate_solvers, "Ranked to the middle tolerance."),
    (
        "structures",
        "By structure and size",
        tables.tabulate_structures,
        (
            "The solver that solves the largest number of problems to each tolerance, "
            "then the fastest, with its mean time. "
            "In a time: the smallest residual at the 90th percentile. Solvers after ≈ tie."
        ),
    ),
    (
        "costs",
        "Time against rows",
        tables.tabulate_costs,
        "Time to the middle tolerance as a power of the number of rows.",
    ),
    (
        "sequences",
        "Sequences",
        tables.tabulate_sequences,
        "All steps, cold and with the impulses of the step before (carried).",
    ),
    (
        "sweeps",
        "Sweeps",
        tables.tabulate_sweeps,
        "Largest errors over the steps after the first, after a fixed number of sweeps.",
    ),
    ("runs", "Every time and residual", tables.tabulate_runs, ""),
)


class Section(NamedTuple):
    """A table of a report with its title and the meaning of its numbers."""

    title: str
    frame: pd.DataFrame
    note: str = ""


class Report(Contents):
    """Contents of a report (`Contents`) with its sentences and tables."""

    @cached_property
    def ranking(self) -> pd.DataFrame:
        """The ranking of solvers on `subject` to the middle tolerance, the engine's own included."""
        return rank_solvers(self, self.tolerance, self.subject)

    @cached_property
    def first(self) -> str:
        """The recommended solver; empty if none solves a case."""
        solvers = self.ranking[(self.ranking["solved"] > 0) & (self.ranking.index != ENGINE_NAME)]
        return str(solvers.index[0]) if len(solvers) else ""

    def _describe_cases(self, names: Sequence[str]) -> str:
        """Return words for cases: the only one's name, a number of problems, or of steps of a sequence."""
        sequences = [name for name in self.cases.loc[list(names), "sequence"].unique() if name]
        lost = sum(len(self.left_out.get(name, ())) for name in sequences or [""])
        left_out = f" ({lost} left out)" if lost else ""
        if sequences:
            of = sequences[0] if len(sequences) == 1 else f"{len(sequences)} sequences"
            return f"{format_count(len(names), 'step')} of {of}{left_out}"
        return (f"{len(names)} problems" if len(names) > 1 else str(names[0])) + left_out

    @cached_property
    def verdict(self) -> str:
        """The answer in one sentence."""
        if self.is_sweep_study:
            return self.sweeps.verdict
        if not len(self.frame):
            if len(self.newest):
                return "The zero impulse solves every problem: no solver is ranked."
            stopped = "Stopped: no problem was measured with every solver."
            return stopped if self.is_stopped and len(self.runs) else "Nothing was measured."
        named = self._describe_cases(self.subject)
        target = f"to {format_power(self.tolerance)}"
        stopped = "Stopped early. " if self.is_stopped else ""
        if not self.first:
            best = self.frame.loc[self.frame["relative"].astype(float).idxmin()]
            return (
                f"{stopped}No solver brings {named} {target}; the smallest residual is "
                f"{format_residual(best['relative'])}, by {best['solver']}."
            )
        row = self.ranking.loc[self.first]
        n = len(self.subject)
        some = f"all {named}" if row["solved"] == n else f"{row['solved']} of {named}"
        solved = named if n == 1 else some
        use = "Stopped early; so far, use" if self.is_stopped else "Use"
        if row["proven"] and n == 1:
            time = "" if self.is_campaign else f", in {format_time(row['mean'])}"
            return f"{use} {self.first}: it proves that {named} has no solution{time}."
        text = f"{use} {self.first}: it solves {solved}"
        if row["proven"]:
            they = "that it has no solution" if row["proven"] == 1 else "that they have no solution"
            text += f" ({row['proven']} by a proof {they})"
        if self.is_campaign:
            return f"{text} {target} (no times were measured)."
        time = format_time(row["mean"])
        if n == 1:
            return f"{text} {target} in {time}."
        these = "" if row["solved"] == n else "these "
        worst = f"{format_time(row['worst'])} at worst, on {row['hardest']}"
        return f"{text}, {these}in {time} on average ({worst})."

    @cached_property
    def sentences(self) -> list[str]:
        """Up to three sentences on other solvers and misses, and one on warm starts, the engine and sequences."""
        if self.is_sweep_study:
            return self.sweeps.sentences
        if not self.first:
            return []
        parts = [self._describe_rivals(), self._describe_single_wins(), self._describe_misses()]
        steps = [case for case in self.get_times(self.tolerance) if self.cases.at[case, "sequence"]]
        if steps:
            parts.append(self._describe_steps(steps))
        return [*filter(None, [*parts, self._describe_engine()])]

    def _describe_rivals(self) -> str:
        """Return the ratios of the next three solvers that solve as many cases, or that they tie."""
        row = self.ranking.loc[self.first]
        rivals = self.ranking[
            (self.ranking["solved"] == row["solved"])
            & (self.ranking["false"] <= row["false"])
            & ~self.ranking.index.isin([self.first, ENGINE_NAME])
        ]
        if self.is_campaign:
            return f"As many are solved by {_join(rivals.index)}." if len(rivals) else ""
        ties = rivals.index[rivals["tie"]]
        others = rivals[~rivals["tie"]].head(3)
        texts = [f"{name} takes {r:.1f}×" for name, r in others["ratio"].items() if r == r]
        texts = [*texts[:1], *(text.replace(" takes", "") for text in texts[1:])]
        tied = f"{_join(ties)} tie{'s' * (len(ties) == 1)} with it" if len(ties) else ""
        text = "; ".join(filter(None, (tied, f"{', '.join(texts)} that time" if texts else "")))
        return f"{text}." if text else ""

    def _describe_single_wins(self) -> str:
        """Return on how many problems which other solvers are faster, and the largest factor."""
        honest = self.ranking.index[
            (self.ranking["false"] == 0) & (self.ranking.index != ENGINE_NAME)
        ]
        times = (
            self.get_times(self.tolerance).loc[[*{*honest, self.first}], self.subject].sort_index()
        )
        own = times.loc[self.first]
        best = times.min()
        lost = own.index[own > MUCH_FASTER * best]
        if self.is_campaign or not len(lost) or len(self.subject) == 1:
            return ""
        wins = times[lost].idxmin().value_counts().head(3)
        ratio = own[lost] / best[lost]
        counts = ", ".join(f"{name} on {n}" for name, n in wins.items())
        factor = f"{ratio.max():.1f}" if ratio.max() < 99.5 else f"{ratio.max():.0f}"
        slower = f"{self.first} is then up to {factor}× slower ({ratio.idxmax()})"
        return f"On single problems others are faster: {counts}; {slower}."

    def _describe_misses(self) -> str:
        """Return the cases that solvers accept and do not solve."""
        missed = (self.ranking["tried"] - self.ranking["solved"]).sort_values(
            ascending=False, kind="stable"
        )
        tried = int(self.ranking["tried"].get(ENGINE_NAME, 0))
        own = int(missed.get(ENGINE_NAME, 0))  # Its answers are recorded, not timed.
        engine = f" {own} of {tried} answers of your engine miss the tolerance." if own else ""
        missed = missed[(missed > 0) & (missed.index != ENGINE_NAME)]
        limit = "" if self.is_campaign else f" in {format_time(self.time_limit)}"
        if not len(missed):
            several = len(self.ranking) > 1
            all_solve = f"Every solver solves each problem that it accepts{limit}."
            return f"{all_solve if several else ''}{engine}".strip()
        text = ", ".join(f"{n} by {name}" for name, n in missed.head(6).items())
        text += f" and {len(missed) - 6} more solvers" if len(missed) > 6 else ""
        if self.ranking.loc[self.first, "solved"] < len(self.subject):
            unsolved = self.get_times(self.tolerance)[self.subject].loc[self.first]
            text += f". {self.first} misses {_join(unsolved.index[unsolved.isna()])}"
        return f"Not solved{limit}: {text}.{engine}"

    def _describe_steps(self, steps: Sequence[str]) -> str:
        """Return how steps of sequences are solved, if they are not the first sentence, and their warm starts."""
        text = ""
        ranking = rank_solvers(self, self.tolerance, steps)
        first = self.first
        if set(steps) != set(self.subject):
            solvers = ranking[(ranking["solved"] > 0) & (ranking.index != ENGINE_NAME)]
            if not len(solvers):
                return f"No solver solves the {self._describe_cases(steps)}."
            first = str(solvers.index[0])
            row = solvers.iloc[0]
            text = f"For the {self._describe_cases(steps)} use {first}: it solves {row['solved']}"
            these = "" if row["solved"] == row["cases"] else "these "
            text += f", {these}in {format_time(row['mean'])} on average. "
        runs = self.ranked_runs[
            self.ranked_runs["case"].isin(steps) & (self.ranked_runs["solver"] == first)
        ]
        runs = runs[(runs["tol"] <= self.tolerance) & (runs["start"].astype(str) == "carried")]
        runs = runs[runs["tol"] == runs["tol"].max()]
        if not len(runs):
            return f"{text}Each step is solved cold."
        carrying = runs["carry_time"].mean()
        mapping = (
            f" (mapping takes {format_time(carrying)} a step, not included)"
            if carrying > 0.0
            else ""
        )
        return f"{text}Each step starts from the impulses of the step before{mapping}."

    def _describe_engine(self) -> str:
        """Return the errors of the engine's own answers; the tables have its times."""
        answers = tables.read_own_answers(self)
        if not len(answers):
            return ""
        worst = answers.loc[answers["velocity"].idxmax()]
        name = str(answers["solver"].mode()[0])
        above = int((answers["velocity"] > self.error_limit).sum())
        return (
            f"Your engine's own {name.replace('NEWTON', 'Newton')} leaves up to {format_speed(worst['velocity'])} "
            f"({worst['worst'] or worst['file']}), above {format_speed(self.error_limit)} in {above} of "
            f"{format_count(len(answers), 'answer')}."
        )

    @cached_property
    def code(self) -> tuple[str, ...]:
        """Lines of Python with which the recommended solver was timed."""
        if self.is_sweep_study or not self.first:
            return ()
        runs = self.ranked_runs
        runs = runs[runs["case"].isin(self.subject) & (runs["solver"] == self.first)]
        runs = self.select_answers(runs, self.tolerance)
        # A proof for a looser tolerance is an answer, too, but no call to this tolerance.
        within = runs[runs["tol"] <= self.tolerance]
        runs = within if len(within) else runs
        runs = runs[runs["tol"] == runs["tol"].max()]
        call = SimpleNamespace(**runs.loc[runs["iterations"].astype(int).idxmax()].to_dict())
        return format_call(call, bool((self.cases.loc[self.subject, "guess"] != "").any()))

    @cached_property
    def alarms(self) -> list[str]:
        """Sentences on contradicted claims and on solvers that died."""
        failures = tables.select_failures(self) if len(self.frame) else self.frame
        texts = ("solver", "case", "status", "message", "status_conflict")
        failures = failures.astype(dict.fromkeys(texts, str))
        false = failures[failures["status_conflict"] != ""]
        # Each solver that died is named once, plug-ins first. A backend that was killed at its time limit is not named.
        died = failures[failures["status"].str.startswith(tables.DEATHS)].drop_duplicates("solver")
        own = died["solver"].map(is_plug_in).astype(bool)
        died = died[own | (died["status"] != "KILLED")]
        died = died.sort_values("solver", key=lambda solvers: ~solvers.map(is_plug_in))
        crashed = [f"{r.solver} on {r.case}: {r.status}: {r.message}" for r in died.itertuples()]
        false_claims = [
            f"{r.solver} on {r.case}: {r.status_conflict.partition('; observed')[0]}"
            for r in false.itertuples()
        ]
        return [*_limit("crashed", crashed, MAX_WARNINGS), *_limit("false claim", false_claims)]

    @cached_property
    def warnings(self) -> list[str]:
        """Sentences on a busy machine, missing times, cases that are left out, and possible mistakes in data."""
        shows_times = self.busy and not self.is_campaign and not self.is_sweep_study
        left_out = [
            f"{r.case}: {r.reason}" for r in self.skips[self.skips["solver"] == ""].itertuples()
        ]
        # A sentence for each solver with impulses that add energy beyond the work of the targets.
        gains = self.frame[self.frame["energy_gain"] > 0.0]
        worst = gains.loc[gains.groupby("solver", observed=True)["energy_gain"].idxmax()]
        counts = gains["solver"].value_counts()
        energy_gains = [
            f"{r.solver} in {format_count(counts[r.solver], 'run')}, at most {r.energy_gain:.2g} J ({r.case})"
            for r in worst.sort_values("energy_gain", ascending=False).itertuples()
        ]
        own = tables.read_own_answers(self)
        own = own[own["energy_gain"] > 0.0]
        if len(own):  # The user's engine comes first, because only the first sentence is shown.
            most = own.loc[own["energy_gain"].idxmax()]
            count = format_count(len(own), "step")
            engine = (
                f"{ENGINE_NAME} in {count}, at most {most['energy_gain']:.2g} J ({most['case']})"
            )
            energy_gains.insert(0, engine)
        return [
            *(
                [f"{self.busy} The times are invalid; measure again with --no-reuse."]
                if shows_times
                else []
            ),
            *(
                ["Error and robustness without times: runs end by iterations."]
                if self.is_campaign
                else []
            ),
            *_limit("left out", left_out),
            *_limit("gains energy", energy_gains),
            *_limit("suspicious", [f"{case}: {reason}" for case, reason in list_diagnostics(self)]),
        ]

    @property
    def is_sweep_study(self) -> bool:
        """Whether the report has only fixed numbers of sweeps, on steps in sequence."""
        has_budgets_only = len(self.frame) and (self.frame["mode"] == "budget").all()
        return bool(has_budgets_only and len(tables.tabulate_sweeps(self)))

    @cached_property
    def sweeps(self) -> SweepStudy:
        """The sentences and blocks of a study of sweeps."""
        return SweepStudy(self)

    @cached_property
    def sections(self) -> dict[str, Section]:
        """The tables by name; tables without rows are left out."""
        sections: dict[str, Section] = {}
        if self.earlier is not None and len(self.newest):
            changes = tables.tabulate_changes(self)
            title = f"Against {escape_unprintable(str(self.earlier.attrs.get('source', 'earlier runs')))}"
            note = f"{changes.attrs['compared']} times compared, on problems with the same numbers in both."
            sections["changes"] = Section(title, changes, note)
        for name, title, tabulate, note in RUN_SECTIONS if len(self.frame) else ():
            if not (self.is_campaign and name in ("structures", "costs")):
                sections[name] = Section(title, tabulate(self), note)
        skips = self.skips.groupby("reason", sort=False).agg(
            solvers=("solver", lambda x: _join(dict.fromkeys(s for s in x if s), 99)),
            cases=("case", lambda x: _join(dict.fromkeys(x), 4)),
        )
        sections["skipped"] = Section(
            "Not run, and why", skips.reset_index()[["solvers", "cases", "reason"]]
        )
        diagnostics = pd.DataFrame(list_diagnostics(self), columns=["case", "possible mistake"])
        sections["diagnostics"] = Section("Possible mistakes in the data", diagnostics)
        return {name: section for name, section in sections.items() if len(section.frame)}

    # -- page ----------------------------------------------------------------------------------------------

    def make_page(self, folder: FigureFolder | None = None, with_figures: bool = True) -> Page:
        """Make the page; with `folder`, the figures are also written there."""
        n, solvers = len(self.frame["case"].unique()), len(self.frame["solver"].unique())
        limit = (
            "" if self.is_campaign or not n else f" · limit {format_time(self.time_limit)} a solve"
        )
        source = f"lavender report · {format_count(n, 'problem')} × {format_count(solvers, 'solver')}{limit}"
        blocks: list[Any] = []
        if self.is_sweep_study:
            source = self.sweeps.source
            blocks = self.sweeps.make_blocks(folder, with_figures)
        elif len(self.frame):
            blocks = self._make_blocks(folder, with_figures)
        title = "lavender report --sweeps" if self.is_sweep_study else "lavender report"
        sections = self.sections
        order = ("runs", "structures", "costs", "sequences", "sweeps", "diagnostics", "skipped")
        changes = [fold_table(*sections["changes"], is_open=True)] if "changes" in sections else []
        if "runs" in sections:  # The file has all columns.
            runs = sections["runs"].frame
            hidden = ("form", "floor [-]", "iterations", "worst row")
            few = [c for c in runs if c not in hidden and not c.endswith("median [s]")]
            sections = sections | {"runs": sections["runs"]._replace(frame=runs[few])}
        shown = [name for name in order if name in sections]
        folded = [fold_table(*sections[name], is_grouped=name == "runs") for name in shown]
        machine = fold_table("Machine, versions, settings", self.describe_run())
        notes = {"folded": [{"note": HOW_TO_READ}], "title": "How to read this page", "open": False}
        return Page(
            title,
            source,
            self.verdict,
            self.sentences,
            [line.strip() for line in self.code if "lv.solve" in line],
            alarms=self.alarms,
            warnings=self.warnings,
            blocks=[*blocks, *changes, *folded, machine, notes],
            footer=self._make_footer(),
            mark=self.sweeps.mark if self.is_sweep_study else "",
            is_bad=self.is_sweep_study and self.sweeps.is_bad,
        )

    def _make_blocks(self, folder: FigureFolder | None, with_figures: bool) -> list[Any]:
        """Make the table of solvers, the matrix and the figures."""
        names = figures.select_drawn_solvers(list(map(str, self.ranking.index)))
        times = self.get_times(self.tolerance)
        n = len(self.subject)
        drawn = dict[str, list[Any]]()
        if with_figures and not self.is_campaign and names:
            best = times[self.subject].min()
            slowest = str(best.idxmax()) if best.notna().any() else self.subject[0]
            drawn["error"] = [Markup(figures.draw_error_against_time(self, slowest, names, folder))]
            if n > 1:
                drawn["profile"] = [
                    Markup(figures.draw_profile(times[self.subject], names, folder))
                ]
            if n > 1 and len(self.tolerances) > 1:
                drawn["slope"] = [Markup(figures.draw_time_to_accuracy(self, names, folder))]
        beside = drawn.get("slope" if n > 1 else "error", [])
        blocks: list[Any] = [{"pair": [[self._make_league()], beside]}]
        if n > 1:
            blocks.append(self._make_matrix(self._group_cases()))
            if any(map(len, (drawn.get("profile", ()), drawn.get("error", ())))):
                blocks.append({"pair": [drawn.get("profile", []), drawn.get("error", [])]})
            if len(self.subject) > MAX_CASES and not self.is_campaign:
                single = (
                    self.cases.loc[self.subject].sort_values(["law", "rows"]).head(MAX_MATRIX_ROWS)
                )
                every = [
                    (LAW_TITLES.get(law, law), case, [case]) for case, law in single["law"].items()
                ]
                matrix = [self._make_matrix(every)]
                blocks.append({"folded": matrix, "title": "Every problem × solver", "open": False})
        return blocks

    def _make_league(self) -> dict[str, Any]:
        """Make the table of the first ten solvers, all plug-ins and the engine."""
        ranking = self.ranking
        rows = list[Any]()
        always = [name == ENGINE_NAME or is_plug_in(name) for name in ranking.index]
        shown = ranking[(np.arange(len(ranking)) < MAX_SOLVERS) | np.array(always, bool)]
        n = int(ranking["cases"].iloc[0]) if len(ranking) else 0
        means = shown["mean"].dropna().clip(lower=1e-9)
        low = np.log10(means.min()) - 0.03
        high = np.log10(means.max()) + 0.03
        best = self.first or ranking.index[0]
        has_false = bool((shown["false"] > 0).any())
        for name, row in shown.iterrows():
            css = "first" if name == self.first else ""
            missed = int(row["tried"] - row["solved"])
            refused = int(n - row["tried"])
            notes = [f"{missed} ✗"] if missed else []
            notes += [f"{refused} not accepted"] if refused else []
            notes += ["tie"] if row["tie"] and shown["tie"].sum() > 1 else []
            cells: list[Any] = [(str(name), css, ""), (f"{row['solved']}/{n}", css, "")]
            if not self.is_campaign:
                is_known = row["mean"] == row["mean"]
                place = 100.0 * (np.log10(max(row["mean"], 1e-9)) - low) / (high - low)
                dot = Markup(f'<span class="dot"><i style="left:{place:.1f}%"></i></span>')
                ratio = row["ratio"]
                cells += [
                    (format_time(row["mean"]) if is_known else NONE, css, ""),
                    (f"{ratio:.1f}" if ratio == ratio else NONE, css, ""),
                    (dot if is_known else "", "bar", ""),
                ]
            if has_false:
                cells.append(
                    (f"{row['false']} ✗" if row["false"] else "0", "bad" * bool(row["false"]), "")
                )
            rows.append([*cells, (", ".join(notes), "text q wide" + " bad" * bool(missed), "")])
        heads: list[Any] = ["solver", "solved"]
        heads += [] if self.is_campaign else [f"{'mean ' * (n > 1)}time", "× best", ("", "bar", "")]
        heads += ["false claims"] if has_false else []
        note = ""
        if n > 1 and not self.is_campaign:
            note = (
                "Geometric mean (shift 10 µs) of the solved problems, on a logarithmic scale. × best: of those that "
                f"{best} solves, too."
            )
            note += (
                f" The table below has all {len(ranking)} solvers."
                if len(ranking) > len(shown)
                else ""
            )
        named = f"all {n} problems" if n > 1 else "one problem"
        small = f"{named}, to residual {format_power(self.tolerance)}"
        heads.append(("", "wide", ""))
        return make_table(rows, heads, classes="full", title="Which solver", small=small, note=note)

    def _group_cases(self) -> list[tuple[str, str, list[str]]]:
        """Return (group, name, cases) of the lines of the matrix: problems or structures, then sequences."""
        single = [case for case in self.subject if not self.cases.at[case, "sequence"]]
        lines = []
        if len(single) <= MAX_CASES:
            facts = self.cases.loc[single]
            for law, some in facts.groupby("law", sort=False):
                order = some.sort_values("rows", kind="stable").index
                lines += [(LAW_TITLES.get(str(law), str(law)), case, [case]) for case in order]
        for name, cases in self.structures.items():
            is_sequence = bool(self.cases.at[cases[0], "sequence"])
            if is_sequence or len(single) > MAX_CASES:
                title = "sequences" if is_sequence else "structures"
                count = format_count(len(cases), "step" if is_sequence else "problem")
                label = f"{name.removeprefix('sequence ')}, {count}"
                lines.append((title, label, cases))
        return lines

    def _make_matrix(self, lines: Sequence[tuple[str, str, Sequence[str]]]) -> dict[str, Any]:
        """Make the matrix of problems × solvers: times as multiples of the fastest solver's."""
        times = self.get_times(self.tolerance)
        order = tables.order_solvers(self)
        best = times.min()
        accepted = self.accepted
        ratios = times.div(best.where(best > 0.0, 1.0), axis=1)
        best_runs = self.ranked_runs.sort_values("relative", key=lambda x: x.astype(float))
        best_runs = best_runs.drop_duplicates(["solver", "case"]).set_index(["solver", "case"])
        rows: list[Any] = []
        group = ""
        for title, label, cases in lines:
            if title != group:
                rows.append({"group": title, "span": len(order) + 2})
                group = title
            cases = list(cases)
            has_time = best[cases].notna().any() and not self.is_campaign
            fastest = format_time(best[cases].mean()) if has_time else "–"
            facts = self.cases.loc[cases[0]]
            about = f"{label}, {tables.format_size(facts)}, {facts['structure']}"
            cells: list[Any] = [(label, "", about), (fastest, "b", "")]
            for solver in order:
                is_accepted = accepted.loc[solver, cases]
                if not is_accepted.any():
                    cells.append(("·", "cn", ""))
                    continue
                missed = int((is_accepted & times.loc[solver, cases].isna()).sum())
                ratio = ratios.loc[solver, cases].median()
                if missed:
                    run = (
                        best_runs.loc[(solver, cases[0])]
                        if (solver, cases[0]) in best_runs.index
                        else None
                    )
                    why = f"{solver}: {missed} of {len(cases)} not solved"
                    why += f", else {ratio:.1f}× the fastest" if ratio == ratio else ""
                    if len(cases) == 1 and run is not None:
                        why = f"{solver}: {run['status']}, residual {format_residual(float(run['relative']))}"
                        why = why.removesuffix(", residual inf")
                    cells.append(("✗" if len(cases) == 1 else f"{missed} ✗", "cx", why))
                else:
                    text = (
                        "1" if ratio < 1.05 else f"{ratio:.1f}" if ratio < 9.95 else f"{ratio:.0f}"
                    )
                    text = "✓" if self.is_campaign else text if ratio < 999.5 else ">999"
                    mean = "" if self.is_campaign else format_time(times.loc[solver, cases].mean())
                    color = f"c{np.searchsorted(RATIO_EDGES, ratio)}"
                    cells.append((text, color, f"{solver} {mean}".strip()))
            rows.append(cells)
        solved = times.notna().sum(axis=1)
        foot = ["solved", ("", "b", ""), *(str(solved[name]) for name in order)]
        limit = "" if self.is_campaign else f" in {format_time(self.time_limit)}"
        key = [
            ("1", "c0"),
            ("to 2", "c1"),
            ("to 5", "c2"),
            ("to 20", "c3"),
            ("slower", "c4"),
            ("✗", "cx"),
            (f"not solved{limit}; · not accepted", ""),
            ("Columns: best first.", "wide"),
        ]
        names = ((Markup("<span>{}</span>").format(name), "", "") for name in order)
        heads = ["", ("fastest", "b", ""), *names]
        return make_table(
            rows,
            heads,
            foot=foot,
            key=key,
            classes="matrix ratios",
            title="Time on each problem, as a multiple of the fastest solver",
            small=f"to residual {format_power(self.tolerance)}",
        )

    def describe_run(self) -> pd.DataFrame:
        """Return the machine, versions and plan of the newest run."""
        run = self.machine
        facts = {}
        if run:
            lists = {
                "versions": {
                    "lavender": run["lavender"],
                    "Python": run["python"],
                    **run["versions"],
                },
                "build": run["build"]
                | ({"load": run["load"]} if run["load"] == run["load"] else {}),
                "plan": run["plan"],
            }
            counts = (
                format_count(self.frame["case"].nunique(), "case"),
                format_count(len(self.newest), "run"),
            )
            facts = {
                "run": f"{run['run']}, started {run['started']}; {', '.join(counts)}",
                "machine": f"{run['cpu']}, {run['cores']} cores; {run['platform']}",
                "threads": f"{run['threads']} for BLAS and OpenMP while timing; runs are serial",
            }
            texts = {
                name: "; ".join(f"{key} {x}" for key, x in some.items())
                for name, some in lists.items()
            }
            facts |= {name: text for name, text in texts.items() if text}
        return pd.DataFrame(facts.items(), columns=["fact", "value"], dtype=object)

    def _make_footer(self) -> list[Any]:
        """Return the files for a paper, and the versions, machine and date."""
        run = self.machine
        links = [f'<a href="tables/{name}.csv">{name}.csv</a>' for name in self.sections]
        files = Markup(
            'For a paper: <a href="tables/solvers.tex">solvers.tex</a>, '
            '<a href="tables/lavender.bib">lavender.bib</a>, '
            f"figures/ ({', '.join(self.figure_kinds)}); "
            f'data: <a href="records.csv">records.csv</a> (every run), {", ".join(links)}.'
        )
        if not run:
            return [files]
        versions = ", ".join(f"{name} {x}" for name, x in run["versions"].items())
        started = run["started"][:16].replace("T", " ")
        software = f"lavender {run['lavender']} ({run['build'].get('commit', 'wheel')}), {versions}"
        computer = f"Python {run['python']}; {run['cpu']}, {run['cores']} cores, 1 thread"
        return [files, f"{software}, {computer}; run {run['run']}, {started} UTC."]


def write(
    source: pd.DataFrame | Report,
    folder: str | Path,
    *,
    figures: bool = True,
    watch: Callable[[Event], None] = lambda event: None,
) -> Path:
    """Write `index.html`, `records.csv`, `summary.md`, `figures/*` and the files of `tables`: .csv, .tex and .bib.

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
    folder = Path(folder)
    files = dict[str, Any]({"records.csv": report.runs})
    files |= {f"tables/{name}.csv": section.frame for name, section in report.sections.items()}
    if "solvers" in report.sections and len(report.ranked_runs):
        files["tables/matrix.csv"] = lambda: tables.tabulate_matrix(report)
        files["tables/solvers.tex"] = lambda: make_latex_table(report)
        files["tables/lavender.bib"] = make_bibliography(report)
    files["summary.md"] = lambda: summarise(report)
    drawn = FigureFolder(folder / "figures", report.figure_kinds)
    files["index.html"] = lambda: report.make_page(drawn, figures).render()
    order = {name: i for i, name in enumerate(files)}
    write_files(
        folder, files, lambda name: watch(Event(order[name], len(files), name, "", phase="writing"))
    )
    return folder / "index.html"


def make_bibliography(report: Report) -> str:
    """Return entries of BibTeX: the lavender that made the report, and each solver that was compared, with its URL."""
    software = {
        "author": f"{{{AUTHOR}}}",
        "title": f"{{{TITLE}}}",
        "version": report.machine["lavender"],
        "year": report.machine["started"][:4],
    }
    entries = [("software", "lavender", software)]
    for name in report.ranking.index:
        spec = registry.specs().get(str(name))
        if spec is None:
            continue  # The user's engine, or a plug-in that is not installed here.
        title = _escape_latex(f"{spec.name}: {spec.summary}")
        fields = {"title": f"{{{title}}}", "note": _escape_latex(spec.reference)}
        if spec.external:
            package = spec.install.split()[0]
            near = re.search(r"\((\S+)\)", spec.install)
            version = report.machine.get("versions", {}).get(package, "")
            url = f"https://{near[1]}" if near else f"https://pypi.org/project/{package}/"
            fields |= {"url": url, "version": version}
        elif spec.builtin:
            fields |= {"howpublished": f"lavender {report.machine['lavender']}, \\cite{{lavender}}"}
        entries.append(("misc", spec.name, fields))
    texts = []
    for kind, key, fields in entries:
        lines = [f"  {word} = {{{text}}}" for word, text in fields.items() if text]
        texts.append(f"@{kind}{{{key},\n" + ",\n".join(lines) + "\n}\n")
    return "\n".join(texts)


def make_latex_table(report: Report) -> str:
    """Return the table of solvers for a paper with the columns of the report; needs the package booktabs."""
    table = tables.tabulate_solvers(report)
    times = {
        format_tol(x): f"to {format_tol(x)} [s]"
        for x in report.tolerances
        if not report.is_campaign
    }
    known: dict[str, Any] = {
        "solved": table["solved"].astype(str) + "/" + table["cases"].astype(str),
        "accepted": table["accepted"],
        "false": table["false claims"],
        **{word: _format_paper_times(table, word, head) for word, head in times.items()},
    }
    if times:
        known |= {"ratio": table["× best"], "slowest": 1e3 * table["slowest [s]"]}
    columns = [
        x if x in PAPER_COLUMNS else format_tol(float(x))
        for x in report.columns or ("solved", *times)
    ]
    check_columns(columns, list(known))
    heads = {"false": "false claims", "ratio": r"$\times$ best", "slowest": "slowest [ms]"} | {
        word: f"$10^{{{round(np.log10(float(word)))}}}$" for word in times
    }
    paper = pd.DataFrame({heads.get(name, name): list(known[name]) for name in columns})
    paper.index = pd.Index(table["solver"].map(_escape_latex))
    paper.index.name = None
    paper = paper.where(~paper.isin([np.inf, -np.inf]))
    numbers = [heads.get(name, name) for name in columns if name in ("ratio", "slowest")]
    caption = f"Problems solved to a residual of {format_tol(report.tolerance)}"
    if set(columns) & set(times):
        caption += (
            ", and shifted geometric mean (10 µs) of the time [ms] to each residual over the solved problems, with "
            "their number if some are not solved or not accepted; bold: the smallest of the solvers that solve most"
        )
    caption += (
        f". {format_count(int(table['cases'].max()), 'problem')}, limit {report.time_limit:g} s each. "
        f"lavender {_escape_latex(str(report.machine.get('lavender', '')))}, "
        f"{_escape_latex(str(report.machine.get('cpu', '')))}, one thread."
    )
    style = paper.style.format(precision=3, na_rep="--", subset=numbers)
    style = style.highlight_min(subset=numbers, props="textbf:--rwrap;") if numbers else style
    return style.to_latex(
        hrules=True,
        column_format="l" + "r" * len(columns),
        label="tab:solvers",
        position="t",
        caption=caption,
    )


def _format_paper_times(table: pd.DataFrame, word: str, head: str) -> list[str]:
    """Return the mean times [ms] of a table's column `head`, with the number of solved problems if some are not."""
    solved = table.get(f"solved to {word}", table["solved"])
    best = table.loc[solved == solved.max(), head].min()
    texts = []
    for time, count, n in zip(table[head], solved, table["cases"], strict=True):
        some = f" ({count}/{n})" if 0 < count < n else ""
        text = f"{1e3 * time:.3f}" if count else "--"
        is_best = count == solved.max() > 0 and time == best
        texts.append((rf"\textbf{{{text}}}" if is_best else text) + some)
    return texts


def _escape_latex(text: str) -> str:
    """Escape the characters that LaTeX reads as commands."""
    return (
        re.sub(r"([&%$#_{}])", r"\\\1", text.replace("\\", "/")).replace("~", "-").replace("^", "-")
    )


def summarise(report: Report) -> str:
    """Return the sentences and the table of solvers in Markdown, to paste into a pull request."""
    lines = ["## lavender report", ""]
    if run := report.machine:
        machine = f"{run['cpu']}, {run['threads']} thread; lavender {run['lavender']}, Python {run['python']}"
        lines += [escape_markdown(f"{machine}; run {run['run']}, {run['started']}"), ""]
    for text in (report.verdict, *report.alarms, *report.sentences, *report.warnings):
        lines += [escape_markdown(text), ""]
    lines += ["```python", *report.code, "```", ""] if report.code else []
    for name in ("changes", "solvers"):
        if name in report.sections:
            lines += [*format_markdown(report.sections[name].frame), ""]
    return "\n".join(lines)


def print_report(report: Report, console: Console, complete: bool = False) -> None:
    """Print the sentences, the first solvers or the sweeps, and warnings; `complete` prints every table."""
    head = report.verdict, report.sentences, report.code
    Page("", "", *head, alarms=report.alarms, warnings=report.warnings).print_head(console)
    short = ["changes", "sweeps" if report.is_sweep_study else "solvers"]
    for name, section in report.sections.items():
        if not complete and name not in short:
            continue
        note = f": {section.note}" if section.note else ""
        frame = section.frame
        optional = tuple[str, ...]()
        if complete or name == "changes":
            console.print(f"\n{section.title}{note}", style="bold", highlight=False, markup=False)
        else:
            console.print()
        if not complete and name == "sweeps":
            starts = ("carried", "cold")
            errors = [
                f"{kind} error, {start} [m/s]"
                for kind in ("velocity", "motion")
                for start in starts
            ]
            wanted = ["sequence"] * (frame["sequence"].nunique() > 1) + [
                "solver",
                "sweeps",
                *errors,
            ]
            frame = frame[[head for head in wanted if head in frame]]
        elif not complete:
            frame = frame.head(MAX_SOLVERS)
            optional = ("tie", "× best", "accepted", "false claims", "slowest [s]")
        print_table(console, frame, optional)


def _join(names: Any, most: int = 3) -> str:
    """Join up to `most` names, and the number of the others."""
    names = list(map(str, names))
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def _limit(kind: str, texts: Sequence[str], most: int = 1) -> Iterator[str]:
    """Yield the first texts of a kind of warnings, with their number if there are more."""
    for i, text in enumerate(texts[:most], 1):
        place = f" ({i} of {len(texts)})" if most > 1 else f", the first of {len(texts)}"
        yield f"{kind}{place * (len(texts) > 1)}: {text}"


def list_diagnostics(report: Report) -> list[tuple[str, str]]:
    """Return (case, possible mistake in its data) for all cases.

    Equal diagnostics of a sequence are one entry, with its first step and its number of steps.
    """
    table = report.cases[["case", "sequence", "diagnostics"]].explode("diagnostics").dropna()
    table["diagnostics"] = table["diagnostics"].map(lambda text: escape_unprintable(str(text)))
    place = table["sequence"].where(table["sequence"] != "", table["case"])
    found = []
    kind = table["diagnostics"].map(lambda text: text.partition(":")[0])
    steps = report.cases["sequence"].value_counts()
    for (name, _), same in table.groupby([place, kind], sort=False):
        n = same["case"].nunique()
        more = f", {n} of {format_count(steps[name], 'step')}" if n > 1 else ""
        found.append((f"{same['case'].iloc[0]}{more}", str(same["diagnostics"].iloc[0])))
    return found
