"""Compute the contents of a report, which the page, the terminal and the summary show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lavender.problem.derived import cached_property
from lavender.report.bench import machine, statistics
from lavender.report.bench.recommendation import FamilyAdvice, choose_time_budgets
from lavender.report.bench.resampling import recommend_solvers
from lavender.report.bench.store import Records
from lavender.report.engine import EngineAnswers
from lavender.report.verdict import Verdict, build_verdict


@dataclass(frozen=True, eq=False)
class Report:
    """Contents of a report: records, earlier records, and requested budgets.

    Parameters
    ----------
    all_records : Records
        Times are compared within the newest run alone.
    earlier : Records, optional
        An earlier run to compare with.
    time_budgets : s, optional
        Time budgets for which a solver is recommended. Default: the times of the plan, or
        `recommendation.choose_time_budgets`.
    sweep_budgets : int, optional
        Numbers of sweeps for which a solver is recommended. Default: the budgets of the plan.
    engines : sequence of EngineAnswers
        Answers of the engines that recorded the steps: `lavender.report.engine.read_engine_answers`.
    """

    all_records: Records
    earlier: Records | None = None
    time_budgets: Sequence[float] = ()
    sweep_budgets: Sequence[int] = ()
    engines: Sequence[EngineAnswers] = ()

    @cached_property
    def newest_run(self) -> Records:
        """Records of the newest run."""
        return self.all_records.select_latest_run()

    @cached_property
    def ranked_records(self) -> Records:
        """Records of the newest run without cases that the zero impulse solves."""
        return statistics.drop_cases_solved_at_zero(self.newest_run)

    @cached_property
    def earlier_run(self) -> Records | None:
        """Records of the newest run in `earlier`; None without earlier records."""
        return None if self.earlier is None else self.earlier.select_latest_run()

    @cached_property
    def is_campaign(self) -> bool:
        """Whether the runs have no times."""
        return statistics.is_campaign(self.ranked_records)

    @cached_property
    def stopped_warning(self) -> str:
        """A warning if the run ended before everything was measured; else empty."""
        if all(run.whole for run in self.newest_run.runs.values()):
            return ""
        return "Stopped before the end: the numbers contain only the completed measurements."

    @property
    def busy_warning(self) -> str:
        """A warning if other processes used the processors while times were taken, with advice; else empty."""
        advice = "The times are invalid; measure again with --no-reuse."
        return f"{self.high_load} {advice}" if self.high_load else ""

    @cached_property
    def high_load(self) -> str:
        """A sentence on the load if other processes used the processors while times were taken; else empty."""
        if self.is_campaign or not len(self.newest_run):
            return ""
        (run,) = self.newest_run.runs.values()
        loads = (run.load if r.load is None else r.load for r in self.newest_run)
        return machine.make_busy_warning(loads, run.cores)

    @cached_property
    def load_summary(self) -> str:
        """Sentences on the mean and largest load during the ranked runs, and on runs with more processes than cores.

        Empty without times or loads.
        """
        if self.is_campaign or not len(self.newest_run):
            return ""
        (run,) = self.newest_run.runs.values()
        return machine.summarise_loads((r.load for r in self.ranked_records), run.cores)

    @cached_property
    def load_warning(self) -> str:
        """A sentence on the runs during which more processes were runnable than the machine has cores; else empty."""
        if self.is_campaign or not len(self.newest_run):
            return ""
        (run,) = self.newest_run.runs.values()
        return machine.describe_loaded_runs((r.load for r in self.ranked_records), run.cores)

    @cached_property
    def tolerances(self) -> tuple[float, ...]:
        """Residual tolerances, largest first."""
        return statistics.get_tolerances(self.ranked_records)

    @cached_property
    def recommendation_times(self) -> tuple[float, ...]:
        """Time budgets [s] for which a solver is recommended."""
        return tuple(self.time_budgets) or choose_time_budgets(self.ranked_records)

    @cached_property
    def verdict(self) -> Verdict:
        """The sentences of the recommendation."""
        return build_verdict(
            self.ranked_records, tuple(self.time_budgets), tuple(self.sweep_budgets), self.engines
        )

    @cached_property
    def rankings(self) -> list[FamilyAdvice]:
        """Rankings by structure and sequence; empty for a campaign."""
        return [] if self.is_campaign else recommend_solvers(self.ranked_records, self.recommendation_times)
