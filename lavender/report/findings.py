"""Compute the contents of a report, which the page, the terminal and the files show."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pandas as pd

from lavender.problem.derived import cached_property
from lavender.report import machine, tables
from lavender.report.engine import EngineAnswers
from lavender.report.records import Records, escape_unprintable, format_tolerance
from lavender.report.table import Table

if TYPE_CHECKING:
    from lavender.report.recommendation import Statement

MAX_ROWS = 500  # Largest number of rows of a table on a page and in the summary; files have all rows.


#: Title, meaning of the numbers, and function of each table, in their order.
SECTIONS: dict[str, tuple[str, str, Callable[[Report], pd.DataFrame]]] = {
    "structures": ("By structure", (
        "The solver that solves the largest number of cases to each tolerance, then the fastest, with its mean time. "
        "Solvers after ≈ tie with it within the noise of the repetitions. A miss counts with the time limit."
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
        "By law", "Mean time of each solver to each tolerance, and number of solved cases.", tables.tabulate_times
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


@dataclass(frozen=True, eq=False)
class Report:
    """Contents of a report: records, earlier records, and requested budgets.

    Parameters
    ----------
    records : Records
        Times are compared within the newest run alone.
    earlier : Records, optional
        An earlier run to compare with.
    times : s, optional
        Time budgets for which a solver is recommended; default: three decades about the fastest times.
    engines : sequence of EngineAnswers
        Answers of the engines that recorded the steps: `lavender.report.engine.read_engine_answers`.
    """

    records: Records
    earlier: Records | None = None
    times: Sequence[float] = ()
    engines: Sequence[EngineAnswers] = ()

    @cached_property
    def is_stopped(self) -> bool:
        """Whether the newest run ended before everything was measured."""
        return bool(self.records.runs) and not list(self.records.runs.values())[-1].whole

    @cached_property
    def is_campaign(self) -> bool:
        """Whether the newest run has no times."""
        return bool(self.records.runs) and bool(list(self.records.runs.values())[-1].plan.get("campaign"))

    @cached_property
    def newest(self) -> pd.DataFrame:
        """The newest run; if it was stopped, of the cases on which every solver was measured."""
        frame = self.records.latest_frame
        if not self.is_stopped:
            return frame
        run = list(self.records.runs.values())[-1]
        wanted = set(run.plan.get("solvers", ()))
        done: dict[str, set[str]] = {}
        for case, solver in frame[["case", "solver"]].drop_duplicates().itertuples(index=False):
            done.setdefault(case, set()).add(solver)
        for skip in self.records.skips:
            if skip.run == run.run:
                info = self.records.cases.get(skip.case)
                members = [n for n, i in self.records.cases.items() if i.sequence == skip.case]
                for name in members if info is None else [skip.case]:
                    done.setdefault(name, set()).add(skip.solver)
        return frame[frame["case"].isin([name for name, solvers in done.items() if solvers >= wanted])]

    @cached_property
    def frame(self) -> pd.DataFrame:
        """The newest run without cases that the zero impulse solves: no ranking counts them."""
        return self.newest[~self.newest["nothing_to_do"].astype(bool)]

    @cached_property
    def earlier_frame(self) -> pd.DataFrame:
        """The newest of the earlier runs."""
        assert self.earlier is not None
        return self.earlier.latest_frame

    @cached_property
    def tolerances(self) -> tuple[float, ...]:
        """Residual tolerances, largest first."""
        for run in reversed(list(self.records.runs.values())):
            if run.plan.get("tolerances"):
                return tuple(sorted(map(float, run.plan["tolerances"]), reverse=True))
        to_tolerance = self.records.frame.query("mode == 'tol'")["tol"] if len(self.records) else ()
        return tuple(sorted(set(to_tolerance), reverse=True)) or (1e-3, 1e-6, 1e-9)

    @property
    def tolerance(self) -> float:
        """The middle tolerance, to which a solver is recommended."""
        return self.tolerances[len(self.tolerances) // 2]

    @cached_property
    def limit(self) -> float:
        """Time [s] that a missed tolerance counts with: the time limit."""
        return float(self.frame["time_limit"].max()) if len(self.frame) else 1.0

    @cached_property
    def time_budgets(self) -> tuple[float, ...]:
        """Time budgets [s] for which a solver is recommended."""
        return tuple(self.times) or tables.choose_time_budgets(tables.get_times(self.frame, self.tolerance))

    @cached_property
    def structures(self) -> dict[str, list[str]]:
        """Cases by structure, and steps by sequence."""
        return tables.group_cases_by_structure(self.frame)

    @cached_property
    def busy_warning(self) -> str:
        """A sentence if other processes used the processors while times were taken; else empty."""
        if self.is_campaign or not len(self.frame):
            return ""
        loads = [None if x != x else float(x) for x in self.frame["load"]]
        busy = machine.make_busy_warning(loads, int(self.frame["cores"].iloc[0]))
        return f"{busy} The times are invalid; measure again with --no-reuse." if busy else ""

    @cached_property
    def statements(self) -> tuple[Statement, ...]:
        """The sentences of the recommendation."""
        from lavender.report.recommendation import recommend

        return recommend(self)

    @cached_property
    def overview(self) -> Section:
        """The table of the first screen: the fastest solver by structure, or each solver if there is one structure."""
        target, name = f"to {format_tolerance(self.tolerance)}", "times"
        if not len(self.frame):
            return Section("overview", "", "", self.frame.iloc[:, :0])
        wanted = ["solver", "cases", f"solved {target}", f"time {target} [s]"]
        if len(self.structures) > 1 and not self.is_campaign:
            name, wanted = "structures", ["structure", target, f"time {target} [s]"]
        frame = self.sections[name].frame
        frame = frame[[c for c in wanted if c in frame]].rename(columns={f"time {target} [s]": "time [s]"})
        return Section("overview", "", "", frame)

    @cached_property
    def sections(self) -> dict[str, Section]:
        """The tables by name, in their order; tables without rows are left out."""
        if not len(self.newest):
            return self._skipped
        wanted = ("times", "budgets", "claims", "failures") if self.is_campaign else SECTIONS
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
