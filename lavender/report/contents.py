"""Hold the runs that a report shows, as frames, and the tolerances, times and cases to which it refers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from lavender.problem.derived import cached_property
from lavender.report import machine
from lavender.report.engine import EngineAnswers
from lavender.report.ranking import choose_time_budgets, get_times, group_cases_by_structure
from lavender.report.records import Records

# Columns with equal values in all runs of a pass over a sequence.
PASS_COLUMNS = ["solver", "mode", "tol", "max_iter", "start"]


@dataclass(frozen=True, eq=False)
class Contents:
    """Runs of a report: records, earlier records, and requested budgets, with the frames of the runs that count.

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
        """The newest run; if it was stopped, the part in which all cases have the same measurements."""
        return self._select_finished_part()[0]

    @cached_property
    def unfinished(self) -> list[str]:
        """Solvers of a stopped run that were not measured to the end on the shown cases."""
        return self._select_finished_part()[1]

    @property
    def has_passes_only(self) -> bool:
        """Whether a run was stopped in the first solver of its first sequence, so that solvers cannot be compared."""
        return bool(len(self.newest) and self.newest["solver"].iloc[0] in self.unfinished)

    def _select_finished_part(self) -> tuple[pd.DataFrame, list[str]]:
        """Return `newest` and `unfinished`.

        A stopped run has the cases on which every solver was measured. If it was stopped in its first sequence, it has
        the solvers before the one that was measured then, or, without any, the passes before the last.
        """
        frame = self.records.latest_frame
        if not (self.is_stopped and len(frame)):
            return frame, []
        run, last = list(self.records.runs.values())[-1], frame.iloc[-1]
        solvers = run.plan.get("solvers", ())
        is_running = (frame["sequence"] == (last["sequence"] or None)) & (frame["solver"] == last["solver"])
        finished = frame[~is_running]
        done: dict[str, set[str]] = {}
        for case, solver in finished[["case", "solver"]].drop_duplicates().itertuples(index=False):
            done.setdefault(case, set()).add(solver)
        for skip in self.records.skips:
            if skip.run == run.run:
                info = self.records.cases.get(skip.case)
                members = [n for n, i in self.records.cases.items() if i.sequence == skip.case]
                for name in members if info is None else [skip.case]:
                    done.setdefault(name, set()).add(skip.solver)
        whole = finished[finished["case"].isin([name for name, some in done.items() if some >= set(solvers)])]
        if len(whole) or not last["sequence"]:
            return whole, []
        passes = frame[(frame[PASS_COLUMNS] != last[PASS_COLUMNS]).any(axis=1)]
        some = done.get(str(last["case"]), set())
        return finished if len(finished) else passes, [name for name in solvers if name not in some]

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
    def time_budgets(self) -> tuple[float, ...]:
        """Time budgets [s] for which a solver is recommended."""
        return tuple(self.times) or choose_time_budgets(get_times(self.frame, self.tolerance))

    @cached_property
    def structures(self) -> dict[str, list[str]]:
        """Cases by structure, and steps by sequence."""
        return group_cases_by_structure(self.frame)

    @cached_property
    def busy_warning(self) -> str:
        """A sentence if other processes used the processors while times were taken; else empty."""
        if self.is_campaign or not len(self.frame):
            return ""
        loads = [None if x != x else float(x) for x in self.frame["load"]]
        busy = machine.make_busy_warning(loads, int(self.frame["cores"].iloc[0]))
        return f"{busy} The times are invalid; measure again with --no-reuse." if busy else ""
