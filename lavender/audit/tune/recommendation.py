"""Choose settings from measurements: the Pareto front of time and error, lines to copy, and the page."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lavender.audit.page import ResultPage, Section, StepSizes, describe_exceedance
from lavender.audit.provenance import format_provenance
from lavender.audit.settings import MERGE_NOTE, MujocoSetting
from lavender.audit.tune.measured import Measured
from lavender.base.deadline import format_seconds
from lavender.problem.derived import cached_property
from lavender.report.text import format_ratio, format_size

if TYPE_CHECKING:
    import pandas as pd

# Times that differ by at most this fraction count as equal: noise is a few per cent.
TIME_NOISE_FRACTION = 0.05


@dataclass(frozen=True, eq=False)
class Tuning:
    """Result of `tune`; the first of `measured` and of `held` is the model's own setting.

    Parameters
    ----------
    model : str
        Name of the model or scene, or its file.
    horizon : int
        Number of steps of a stretch.
    measured : list of Measured
        Results on the worlds with even numbers.
    held : list of Measured
        Results of the model's own setting and of the chosen settings on the worlds with odd numbers, which are held
        back; empty if Ctrl-C ended the measurement before.
    threshold : float, m/s, m
        Errors [m/s] and distances [m] up to this number count as accurate enough.
    stopped : bool
        The measurement was stopped by Ctrl-C.
    sizes : StepSizes, optional
        Rows and contacts of the steps of all worlds with the model's own setting.
    busy : str
        A warning if other processes used the processors during the timing; else empty.
    notes : tuple of str
        Sentences about the differences from a simulation of the model as it is: no sleep, a smaller spread.
    n_held_worlds : int
        Number of worlds held back.
    error_limit : float, m/s, optional
        The fastest setting whose error does not exceed this number in any step is also recommended.
    held_errors : dict
        Largest error [m/s] on the worlds held back, of the settings that were judged there.
    provenance : dict
        Result of `describe_provenance`.
    """

    model: str
    horizon: int
    measured: list[Measured]
    held: list[Measured]
    threshold: float
    stopped: bool = False
    sizes: StepSizes | None = None
    busy: str = ""
    notes: tuple[str, ...] = ()
    n_held_worlds: int = 0
    error_limit: float | None = None
    held_errors: Mapping[MujocoSetting, float] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)

    @property
    def present_result(self) -> Measured:
        """Result of the model's own setting."""
        return self.measured[0]

    @property
    def _same_problem(self) -> list[Measured]:
        """Timed settings that do not change the problem."""
        return [m for m in self.measured if not m.setting.changes_problem and np.isfinite(m.mean_step_time)]

    def _is_accurate_enough(self, m: Measured) -> bool:
        """Return whether a setting's errors and motion do not exceed the present setting's, or the threshold.

        The errors are the median and the maximum, so that a better worst step cannot hide that usual steps are worse.
        """
        now, threshold = self.present_result, self.threshold
        pairs = (
            (m.error.max(), now.error.max()),
            (float(np.median(m.error)), float(np.median(now.error))),
            (m.worst_motion, now.worst_motion),
        )
        return all(x <= max(own, threshold) for x, own in pairs)

    @cached_property
    def faster(self) -> Measured | None:
        """Fastest setting that is accurate enough and faster than the present setting; None if there is none.

        Of settings that take the same time within noise, the one with the smallest error above the threshold is
        returned, and of these the one with the largest iteration limit: a limit that no step reaches takes no time.
        """
        now, threshold = self.present_result, self.threshold
        limit = (1.0 - TIME_NOISE_FRACTION) * now.mean_step_time
        good = [m for m in self._same_problem if m.mean_step_time < limit and self._is_accurate_enough(m)]
        good = [m for m in good if m.worst_error <= max(now.worst_error, threshold)]

        def rank(m: Measured) -> tuple[float, float, float]:
            return max(float(m.error.max()), threshold), -m.setting.iterations, m.mean_step_time

        return min(self._list_ties(good), key=rank, default=None)

    @staticmethod
    def _list_ties(settings: list[Measured]) -> list[Measured]:
        """List the settings whose time equals that of the fastest within noise."""
        fastest = min((m.mean_step_time for m in settings), default=0.0)
        return [m for m in settings if (1.0 - TIME_NOISE_FRACTION) * m.mean_step_time <= fastest]

    @cached_property
    def closer(self) -> Measured | None:
        """Most accurate setting that is as fast as the present one.

        None if no such setting is more accurate, or if the error of the present or of the faster setting is within
        the threshold.
        """
        now = self.present_result
        if self.faster is not None and self.faster.worst_error <= self.threshold:
            return None
        limit = (1.0 + TIME_NOISE_FRACTION) * now.mean_step_time
        good = [m for m in self._same_problem if m.mean_step_time <= limit and self._is_accurate_enough(m)]
        best = min(good, key=lambda m: m.worst_error)
        return best if best.worst_error < now.worst_error > self.threshold else None

    def _compute_largest_error(self, m: Measured) -> float:
        """Return the largest error [m/s] of a setting on all worlds on which it was judged."""
        return max(float(m.error.max()), self.held_errors.get(m.setting, 0.0))

    @property
    def within_limit(self) -> Measured | None:
        """Fastest setting with no error above `error_limit`, also on the worlds held back if it was judged there.

        Of settings that take the same time within noise, the present one is returned, else the most accurate. The
        result is None if all settings exceed the limit, or without a limit.
        """
        if self.error_limit is None:
            return None
        now = self.present_result
        good = [m for m in self._same_problem if self._compute_largest_error(m) <= self.error_limit]
        ties = self._list_ties(good)
        best = min(ties, key=self._compute_largest_error, default=None)
        return now if any(m is now for m in ties) else best

    @property
    def most_accurate(self) -> Measured:
        """MujocoSetting with the smallest maximum error on all worlds on which it was judged."""
        return min(self._same_problem, key=self._compute_largest_error)

    @property
    def limit_choice(self) -> Measured:
        """`within_limit`, or `most_accurate` if that is None."""
        return self.within_limit or self.most_accurate

    @property
    def pareto_front(self) -> list[Measured]:
        """Settings that no other setting beats in both time and error, fastest first."""
        front: list[Measured] = []
        for m in sorted(self._same_problem, key=lambda m: (m.mean_step_time, m.worst_error)):
            if not front or m.worst_error < front[-1].worst_error:
                front.append(m)
        return front

    @property
    def reason_without_line(self) -> str:
        """Reason why no setting is recommended: too few steps with contact; empty if enough steps have contact."""
        if self.sizes is None or self.sizes.has_enough_contact:
            return ""
        if not self.sizes.can_touch:
            return f"No setting is recommended: {self.sizes.contact_phrase}; without contact settings have no effect."
        return (
            f"No setting is recommended: {self.sizes.contact_phrase}. A setting that is fast and accurate without "
            "contact may be neither with it. Start from states with contact (--states FILE), or take more --steps."
        )

    @property
    def reason_provisional(self) -> str:
        """Reason why the lines are provisional; empty if the measurement is complete and its times are valid."""
        if self.stopped:
            return "the measurement was interrupted"
        return "the machine was busy" if self.busy else ""

    @property
    def _provisional_prefix(self) -> str:
        """Beginning of a provisional line; empty if the measurement is complete and its times are valid."""
        return f"PROVISIONAL, {self.reason_provisional}: " if self.reason_provisional else ""

    @property
    def lines(self) -> list[str]:
        """Lines to copy, and their results on the worlds held back; none if too few steps have contact."""
        if self.reason_without_line:
            return []
        none = f"none of {len(self._same_problem)} settings"
        small = min(m.worst_error for m in (self.present_result, self.faster) if m is not None)
        within = f"not needed, {format_size(small)} m/s is within {self.threshold:g}"
        closer = within if small <= self.threshold else none
        lines = self._format_limit_choice()
        for description, m, reason, gains, max_ratio in (
            ("as accurate as now, faster", self.faster, none, "mean_step_time", 1.0 - TIME_NOISE_FRACTION),
            ("as fast as now, more accurate", self.closer, closer, "worst_error", 1.0),
        ):
            if m is None:
                provisional = self._provisional_prefix if reason is none else ""
                lines.append(f"{provisional}{description}: {reason}")
                continue
            held = self._find_held_back(m)
            if held is not None and getattr(held, gains) >= max_ratio * getattr(self.held[0], gains):
                description += ": not on the worlds held back"
            lines += self._format_choice(m, description, _format_comparison(m, self.present_result))
        return lines

    def _find_held_back(self, m: Measured) -> Measured | None:
        """Return the result of a setting on the worlds held back; None if it was not measured there."""
        return next((h for h in self.held if h.setting == m.setting), None)

    def _format_limit_choice(self) -> list[str]:
        """Return the lines on `error_limit`; none without a limit."""
        if self.error_limit is None:
            return []
        goal, m = f"error at most {self.error_limit:g} m/s", self.limit_choice
        lines = []
        if self.within_limit is None:
            count = f"none of {len(self._same_problem)} settings"
            lines = [f"{self._provisional_prefix}{goal}: {count}; the most accurate is"]
        description = f"{goal}, fastest" if self.within_limit else "most accurate"
        return lines + self._format_choice(m, description, _format_with_largest_error(m, self.present_result))

    def _format_choice(self, m: Measured, description: str, comparison: str) -> list[str]:
        """Return the line to copy with a description, and the results on both halves of the worlds."""
        if m.setting.is_default:
            description += ", MuJoCo's defaults"
        description = f"{self._provisional_prefix}{description}"
        held = self._find_held_back(m)
        line = m.setting.option_line
        return [
            f"{line}  <!-- {description} -->" if line else f"{description}: {m.setting.name}",
            f"    chosen on: {comparison}",
            f"    held back: {'not measured' if held is None else _format_with_largest_error(held, self.held[0])}",
        ]

    @property
    def _lines_note(self) -> str:
        """Explanation below the lines: how they were chosen and tested, and the element that they belong to."""
        if self.reason_without_line:
            return "None, for the reason above."
        sentences = ["Chosen on the worlds with even numbers, tested on the others."]
        if self.faster or self.closer or self.error_limit is not None:
            sentences.append("The errors were measured on these states. On other states they can be larger.")
            if self.error_limit is not None:
                sentences.append("The line for the error limit was chosen on all worlds.")
            if self.reason_provisional:
                sentences.append(f"They are provisional, because {self.reason_provisional}: measure again.")
            if len(self.held) > 1 and self.n_held_worlds:
                sentences.append(describe_exceedance(self.n_held_worlds))
            sentences.append(MERGE_NOTE)
        return " ".join(filter(None, sentences))

    def _describe_gain(self) -> str:
        """Return a sentence on the gain of the more accurate setting on the worlds held back; empty without one."""
        tested = None if self.closer is None else self._find_held_back(self.closer)
        if tested is None:
            return ""
        error, before = tested.worst_error, self.held[0].worst_error
        if error >= before:
            return "No setting is as fast and more accurate on the worlds held back."
        gain = f"{format_ratio(before / error)} less" if error else "exactly 0"
        return f"In the same time the error can be {gain} on worlds that were held back from the choice."

    def _tabulate_settings(self, settings: Iterable[Measured]) -> pd.DataFrame:
        """Build the table of some settings."""
        import pandas as pd

        now = self.present_result.mean_step_time
        rows = [
            (m.setting.short_name, f"{m.mean_step_time / now:.2f}", m.worst_error, float(m.error.max()), m.worst_motion)
            for m in settings
        ]  # fmt: skip
        heads = ["setting", "relative time", "error 99 % [m/s]", "largest error [m/s]", "motion [m]"]
        return pd.DataFrame(rows, columns=heads)

    @property
    def terminal_settings(self) -> list[Measured]:
        """Settings in the table of the terminal: the present one first, the others by time.

        The others are MuJoCo's defaults, and of the Pareto front the fastest, the last one in the present time,
        and the last one, which have the smallest errors.
        """
        now, front = self.present_result, self.pareto_front
        quick = [m for m in front if m.mean_step_time <= (1.0 + TIME_NOISE_FRACTION) * now.mean_step_time]
        defaults = [m for m in self._same_problem if m.setting.is_default]
        shown = dict.fromkeys([*quick[:1], *quick[-1:], front[-1], *defaults])
        shown.pop(now, None)
        return [now, *sorted(shown, key=lambda m: m.mean_step_time)]

    def draw_settings(self, folder: Path) -> str:
        """Draw the error over the time of a step."""
        from lavender.report.drawing import BLUE, draw_figure, mark_errors

        def fill(axes: Any) -> str:
            points = np.array([(m.mean_step_time, max(m.worst_error, 0.5e-9)) for m in self._same_problem])
            mark_errors(axes, 1e-9, float(points[:, 1].max()), self.error_limit or 1e-3)
            axes.plot(*points.T, "o", color=BLUE)
            axes.set_xlabel("time of a step [s]")
            return f"{len(points)} settings"

        return draw_figure("time-and-error", fill, (4.9, 3.3), {"left": 0.13, "right": 0.75}, folder=folder)

    @property
    def headline(self) -> list[str]:
        """Time and error of the present setting, the gain, and the reason if no line is recommended."""
        now = self.present_result
        own = (
            f"{self.model}: a step takes {format_seconds(now.mean_step_time)}, and 1 % of the steps have errors above "
            f"{format_size(now.worst_error)} m/s."
        )
        return [own, *filter(None, (self._describe_gain(), self.reason_without_line))]

    @property
    def page(self) -> ResultPage:
        """Page with the result in sentences, figures and tables, as `lavender tune` writes it."""
        now = self.present_result
        other = [m for m in self.measured if m.setting.changes_problem]
        shown = [now, *(m for m in self.pareto_front if m is not now)]
        every = sorted(self.measured, key=lambda m: m.mean_step_time)
        figures = [] if self.reason_without_line else [self.draw_settings]
        title = "Provisional lines" if self.reason_provisional else "Lines to copy"
        short = self._tabulate_settings(self.terminal_settings).iloc[:, :4]
        numbers = {
            "model": self.model, "lines": self.lines, "why_no_line": self.reason_without_line, "busy": self.busy,
            "error_limit": self.error_limit,
            "is_limit_met": None if self.error_limit is None else self.within_limit is not None,
            **({} if self.sizes is None else self.sizes.as_dict), "stopped": self.stopped,
            "measured": list(map(_to_dict, self.measured)), "held": list(map(_to_dict, self.held)),
        }  # fmt: skip
        sizes = [] if self.sizes is None else [self.sizes.table]
        return ResultPage(
            title="lavender tune", headline=self.headline, sections=[
                Section(title, code=self.lines, note=self._lines_note),
                Section("Rows and contacts", sizes, short=2,
                        note="Rows and contacts of the steps with the model's own setting."),
                Section("Fastest settings by error", [self._tabulate_settings(shown)], figures=figures,
                        note=f"Motion: distance after {self.horizon} steps from a converged run.", short_frame=short),
                Section("Other problems", [self._tabulate_settings(other)], short=2,
                        note="Settings that change the problem: the error is that of its own problem."),
                Section("Every setting", [self._tabulate_settings(every)],
                        note="Settings with which a world diverges are left out."),
            ],
            numbers=numbers | {"provenance": self.provenance}, notes=list(filter(None, (*self.notes, self.busy))),
            is_stopped=self.stopped, provenance=format_provenance(self.provenance) if self.provenance else "",
        )  # fmt: skip


def _format_comparison(m: Measured, now: Measured) -> str:
    """Compare time and error of a setting with the present ones."""
    return (
        f"{m.mean_step_time / now.mean_step_time:.2f} of the time, error {format_size(m.worst_error)} m/s "
        f"instead of {format_size(now.worst_error)}"
    )


def _format_with_largest_error(m: Measured, now: Measured) -> str:
    """Compare time and error of a setting with the present ones, and add the largest error."""
    worst = f"at most {format_size(float(m.error.max()))} in {len(m.error)} steps"
    return f"{_format_comparison(m, now)} ({worst})"


def _to_dict(m: Measured) -> dict[str, Any]:
    """Convert a result to a dict for JSON."""
    return {"options": dict(m.setting.options), "default": m.setting.is_default, "seconds": m.mean_step_time,
            "error": m.worst_error, "worst": float(m.error.max()), "motion": m.worst_motion}  # fmt: skip
