"""Compute the contents of a report, which the page, the terminal and the files show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pandas as pd

from lavender.problem.derived import cached_property
from lavender.report import tables
from lavender.report.contents import Contents
from lavender.report.recommendation import Statement, recommend
from lavender.report.records import escape_unprintable, format_tolerance
from lavender.report.table import Table

MAX_ROWS = 500  # Largest number of rows of a table on a page and in the summary; files have all rows.


#: Title, meaning of the numbers, and function of each table, in their order.
SECTIONS: dict[str, tuple[str, str, Callable[[Contents], pd.DataFrame]]] = {
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
    "times": (
        "By law", "Number of cases that each solver solves, and their mean time.", tables.tabulate_times
    ),
    "budgets": (
        "By iterations", "Residual after a fixed number of iterations, over the cases.", tables.tabulate_budgets
    ),
    "claims": ("Claims and verdicts", (
        "A claim is correct if the judge confirms it. The judge computes the residual from the problem's data."
    ), tables.tabulate_claims),
    "failures": (
        "Failures", "Runs that missed their tolerance, that died, or that made a false claim.", tables.tabulate_failures
    ),
    "engines": ("Inside the engine", (
        "The engine's own answers, judged like all others. Its time excludes the copy of the problem and the judge."
    ), tables.tabulate_engines),
    "sequences": (
        "Sequences", "All steps, cold and with the impulses of the step before (carried).", tables.tabulate_sequences
    ),
    "cases": ("Cases", "", tables.tabulate_cases),
    "runs": ("Every case", "Time to each tolerance and smallest residual.", tables.tabulate_runs),
}  # fmt: skip


@dataclass(frozen=True)
class Section:
    """A table under its heading, with the meaning of its numbers; `file` is its name as a file and on the page."""

    file: str
    title: str
    note: str
    frame: pd.DataFrame

    @property
    def table(self) -> Table:
        """The first `MAX_ROWS` rows, with numbers as texts."""
        return Table.from_frame(self.frame.head(MAX_ROWS))


class Report(Contents):
    """Contents of a report (`Contents`) with its tables and sentences."""

    @cached_property
    def statements(self) -> tuple[Statement, ...]:
        """The sentences of the recommendation."""
        return recommend(self)

    @cached_property
    def overview(self) -> Section:
        """The table of the first screen: the fastest solver by structure, or each solver if there is one structure."""
        target, name = f"to {format_tolerance(self.tolerance)}", "times"
        if not len(self.frame):
            return Section("overview", "", "", self.frame.iloc[:, :0])
        wanted = ["solver", "cases", f"solved {target}", f"time {target} [s]"]
        if self.has_passes_only:
            name, wanted = "sequences", ["target", "steps, cold", "time, cold [s]", "residual, cold [-]"]
        elif len(self.structures) > 1 and not self.is_campaign:
            name, wanted = "structures", ["structure", target, f"time {target} [s]"]
        frame = self.sections[name].frame
        frame = frame[[c for c in wanted if c in frame]].rename(columns={f"time {target} [s]": "time [s]"})
        return Section("overview", "", "", frame)

    @cached_property
    def sections(self) -> dict[str, Section]:
        """The tables by name, in their order; tables without rows are left out."""
        if not len(self.newest):
            return self._skipped
        wanted = ("times", "budgets", "claims", "failures") if self.is_campaign else tuple(SECTIONS)
        wanted = ("sequences", "budgets", "claims", "failures") if self.has_passes_only else wanted
        made = [
            Section(name, title, note, make(self))
            for name, (title, note, make) in SECTIONS.items()
            if name in wanted and len(self.frame)
        ]
        if self.earlier is not None:
            made.append(self._compare_with_earlier_run())
        note = "The zero impulse solves these cases. They are left out of all rankings."
        made.append(Section("idle", "Solved by the zero impulse", note, tables.tabulate_idle(self)))
        return {**{s.file: s for s in made if len(s.frame)}, **self._skipped}

    @property
    def _skipped(self) -> dict[str, Section]:
        """The table of pairs that did not run, and of cases that did not load."""
        section = Section("skipped", "Not run", "", tables.tabulate_skips(self.records.skips))
        return {"skipped": section} if len(section.frame) else {}

    def _compare_with_earlier_run(self) -> Section:
        """Return the table of changes since the earlier run; its note has the number of compared times."""
        assert self.earlier is not None
        changes = tables.tabulate_changes(self)
        compared = int(changes["compared"].iloc[0])
        changes = changes.drop(columns="compared")
        note = f"{compared} times compared, on cases with the same numbers in both (no steps of sequences)"
        if changes.empty:
            changes = pd.DataFrame(
                {"change": ["nothing beyond noise" if compared else "nothing was compared"]}
            )
        return Section("changes", f"Against {escape_unprintable(self.earlier.source)}", note, changes)
