"""What a report says of records, worked out once: its page, the terminal, the summary and a paper show it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from lavender.lab.bench.store import Records
from lavender.lab.report import choices, tables
from lavender.lab.report.engine import Contestant
from lavender.lab.report.finals import advice
from lavender.lab.report.moved import by_speed, speed_levels, working
from lavender.lab.report.text import count
from lavender.lab.report.verdict import Verdict, verdict
from lavender.problem.derived import cached_property


@dataclass(frozen=True, eq=False)
class Report:
    """Records, and what is asked of them.

    Parameters
    ----------
    given : Records
        Times are compared within the newest run alone.
    old : Records, optional
        An earlier run to compare with.
    asked : s, optional
        Time budgets of the recommendation; those of the plan, or `choices.time_budgets`, if none are given.
    sweeps : int, optional
        Budgets of sweeps with which a solver is to be named; those of the plan if none are given.
    engines : sequence of Contestant
        Answers of the engines that recorded the steps: `lavender.lab.report.engine.contestants`.
    """

    given: Records
    old: Records | None = None
    asked: Sequence[float] = ()
    sweeps: Sequence[int] = ()
    engines: Sequence[Contestant] = ()

    @cached_property
    def every(self) -> Records:
        """The newest run."""
        return self.given.latest()

    @cached_property
    def records(self) -> Records:
        """The newest run without cases where doing nothing is right."""
        return working(self.every)

    @cached_property
    def before(self) -> Records | None:
        """The newest run of the earlier records."""
        return None if self.old is None else self.old.latest()

    @cached_property
    def is_campaign(self) -> bool:
        """Times were left out on purpose."""
        return tables.is_campaign(self.records)

    @cached_property
    def stopped(self) -> str:
        """What is to be said of a run that ended before all was measured; empty where nothing is."""
        if all(run.whole for run in self.every.runs.values()):
            return ""
        return "Stopped before the end: what was not measured is in no number here."

    @cached_property
    def busy(self) -> str:
        """What is to be said of times that were taken while others used the processors too; empty where nothing is."""
        if self.is_campaign or not len(self.every):
            return ""
        (run,) = self.every.runs.values()
        loads = [load for r in self.every if (load := run.load if r.load is None else r.load) is not None]
        # A half more: on one core this process makes a load of 1, and the system's own a little.
        if not loads or fmean(loads) <= run.cores + 0.5:
            return ""
        return (
            f"The machine was busy: load {fmean(loads):.1f} on {count(run.cores, 'core')} while this was timed. These "
            "times are void; measure again with --fresh."
        )

    @cached_property
    def levels(self) -> tuple[float, ...]:
        """Residuals to reach, loosest first."""
        return tables.levels_of(self.records)

    @cached_property
    def speeds(self) -> tuple[float, ...]:
        """Motion errors to reach [m/s]; empty without motion errors."""
        return speed_levels(self.records)

    @cached_property
    def by_speed(self) -> Records:
        """The same records by motion error in place of the residual; none without motion errors."""
        return by_speed(self.records)

    @cached_property
    def times(self) -> tuple[float, ...]:
        """Times [s] in which a solver is recommended."""
        return tuple(self.asked) or choices.time_budgets(self.records)

    @cached_property
    def verdict(self) -> Verdict:
        """What the whole comes to."""
        return verdict(self.records, tuple(self.asked), tuple(self.sweeps), self.engines)

    @cached_property
    def lines(self) -> list[choices.Line]:
        """Recommendations by structure and sequence; none of a campaign."""
        return [] if self.is_campaign else advice(self.records, self.times)
