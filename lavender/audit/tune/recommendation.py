"""Choose settings from measurements: the Pareto front of time and error, lines to copy, and the page."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lavender.audit.page import SHOWN_RATIO, ResultPage, StepSizes
from lavender.audit.provenance import format_provenance
from lavender.audit.settings import MERGE_NOTE, MujocoSetting
from lavender.audit.tune.mujoco_settings import Measured
from lavender.base.lazy_import import markupsafe
from lavender.base.lazy_import import pandas as pd
from lavender.report import drawing
from lavender.report.page import DEFAULT_ERROR_LIMIT, Page, fold_table, tabulate_frame
from lavender.report.text import NONE, format_count, format_speed

# Times that differ by at most this fraction count as equal: noise is a few per cent.
TIME_NOISE_FRACTION = 0.05
# Marks of the logarithmic axis of relative times.
TIME_TICKS = (
    0.1,
    0.2,
    0.3,
    0.5,
    0.7,
    0.8,
    0.9,
    1.0,
    1.1,
    1.2,
    1.5,
    2.0,
    3.0,
    5.0,
    10.0,
    20.0,
    50.0,
    100.0,
)
CHOICES_NOTE = (
    "Chosen on the worlds with even numbers, tested on the others. On other states the errors can be larger. "
    + MERGE_NOTE
)


@dataclass(eq=False)
class Tuning:
    """Result of `tune`; the first of `measured` and of `held` is the model's own setting."""

    model: str  # Name of the model or scene, or its file.
    horizon: int  # Number of steps of a stretch.
    measured: list[Measured]  # Results on the worlds with even numbers.
    # Results of the model's own setting and of the chosen settings on the worlds with odd numbers, which are held back;
    # empty if Ctrl-C ended the measurement before.
    held: list[Measured]
    threshold: float  # Errors [m/s] and distances [m] up to this number count as accurate enough.
    stopped: bool = False  # Whether Ctrl-C stopped the measurement.
    sizes: StepSizes | None = None  # Of the steps of all worlds with the model's own setting.
    busy: str = (
        ""  # A warning if other processes used the processors during the timing; else empty.
    )
    # Sentences about the differences from a simulation of the model as it is: no sleep, a smaller spread.
    notes: tuple[str, ...] = ()
    left_out: str = ""  # Sentence on settings that were not timed; else empty.
    n_held_worlds: int = 0
    # [m/s] The fastest setting whose error does not exceed this number in any step is also recommended.
    error_limit: float | None = None
    # Largest error [m/s] on the worlds held back, of the settings that were judged there.
    held_errors: dict[MujocoSetting, float] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)  # Result of `describe_provenance`.

    @property
    def present_result(self) -> Measured:
        """Result of the model's own setting."""
        return self.measured[0]

    @property
    def _same_problem(self) -> list[Measured]:
        """Timed settings that do not change the problem."""
        return [
            m
            for m in self.measured
            if not m.setting.changes_problem and np.isfinite(m.mean_step_time)
        ]

    def _is_accurate_enough(self, m: Measured) -> bool:
        """Return whether a setting's errors and motion do not exceed the present setting's, or the threshold.

        The errors are the median and the maximum, so that a better worst step cannot hide that usual steps are worse.
        """
        now, threshold = self.present_result, self.threshold
        numbers = [(x.error.max(), np.median(x.error), x.worst_motion) for x in (m, now)]
        return all(x <= max(own, threshold) for x, own in zip(*numbers, strict=True))

    @property
    def faster(self) -> Measured | None:
        """Fastest setting that is accurate enough and faster than the present setting; None if there is none.

        Of settings that take the same time within noise, the one with the smallest error above the threshold is
        returned, and of these the one with the largest iteration limit: a limit that no step reaches takes no time.
        """
        now, threshold = self.present_result, self.threshold
        limit = (1.0 - TIME_NOISE_FRACTION) * now.mean_step_time
        good = [
            m
            for m in self._same_problem
            if m.mean_step_time < limit and self._is_accurate_enough(m)
        ]
        good = [m for m in good if m.worst_error <= max(now.worst_error, threshold)]

        def rank(m: Measured) -> tuple[float, float, float]:
            return max(float(m.error.max()), threshold), -m.setting.iterations, m.mean_step_time

        return min(self._list_ties(good), key=rank, default=None)

    @staticmethod
    def _list_ties(settings: list[Measured]) -> list[Measured]:
        """List the settings whose time equals that of the fastest within noise."""
        fastest = min((m.mean_step_time for m in settings), default=0.0)
        return [m for m in settings if (1.0 - TIME_NOISE_FRACTION) * m.mean_step_time <= fastest]

    @property
    def closer(self) -> Measured | None:
        """Most accurate setting that is as fast as the present one.

        None if no such setting is more accurate, or if the error of the present or of the faster setting is within
        the threshold.
        """
        now = self.present_result
        if self.faster is not None and self.faster.worst_error <= self.threshold:
            return None
        limit = (1.0 + TIME_NOISE_FRACTION) * now.mean_step_time
        good = [
            m
            for m in self._same_problem
            if m.mean_step_time <= limit and self._is_accurate_enough(m)
        ]
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
    def limit_choice(self) -> Measured:
        """`within_limit`, or the setting with the smallest error on all worlds on which it was judged."""
        return self.within_limit or min(self._same_problem, key=self._compute_largest_error)

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

    def _has_gain_held_back(self, m: Measured) -> bool:
        """Return whether a setting is faster or more accurate on the worlds held back, or was not measured there.

        Errors up to the threshold count as equal.
        """
        held = next((h for h in self.held if h.setting == m.setting), None)
        if held is None:
            return True
        now = self.held[0]
        is_faster = held.mean_step_time < (1.0 - TIME_NOISE_FRACTION) * now.mean_step_time
        errors = [max(float(x.error.max()), self.threshold) for x in (held, now)]
        return is_faster or errors[0] < errors[1]

    def _format_held_back(self, m: Measured) -> tuple[str, str] | None:
        """Return the relative time and the worst error on the worlds held back; None if they were not measured."""
        held = next((h for h in self.held if h.setting == m.setting), None)
        if held is None:
            return None
        ratio = held.mean_step_time / self.held[0].mean_step_time
        return f"{ratio:.2f}", format_speed(float(held.error.max()), held.unit)

    def _tabulate_settings(self, settings: Iterable[Measured]) -> pd.DataFrame:
        """Build the table of some settings."""
        now = self.present_result.mean_step_time
        rows = [
            (
                m.setting.short_name,
                f"{m.mean_step_time / now:.2f}",
                m.worst_error,
                float(m.error.max()),
                m.worst_motion,
            )
            for m in settings
        ]
        heads = [
            "setting",
            "relative time",
            f"error 99 % [{self.present_result.unit}]",
            f"largest error [{self.present_result.unit}]",
            "motion [m]",
        ]
        return pd.DataFrame(rows, columns=heads)

    @property
    def shown_limit(self) -> float:
        """Velocity error with which the page compares [m/s, rad/s]: `error_limit`, or else the default of all pages."""
        return DEFAULT_ERROR_LIMIT if self.error_limit is None else self.error_limit

    @property
    def advised(self) -> Measured | None:
        """The setting of the first sentence; None if the present one is best or too few steps have contact.

        It is the one within `error_limit` if that is given; else the more accurate one in the same time if the present
        errors exceed the limit of the page, else the faster one.
        """
        now = self.present_result
        if self.reason_without_line:
            return None
        if self.error_limit is not None:
            return None if self.limit_choice is now else self.limit_choice
        both = (self.closer, self.faster)
        first, second = both if now.error.max() > self.shown_limit else both[::-1]
        known = [m for m in (first, second) if m is not None]
        return next((m for m in known if self._has_gain_held_back(m)), None)

    @property
    def headline(self) -> list[str]:
        """The headline: the setting, its gain, the present errors, the results on worlds held back."""
        now = self.present_result
        m = self.advised
        n = len(self._same_problem)
        worst = format_speed(self._compute_largest_error(now), now.unit, self.shown_limit)
        quantile = format_speed(now.worst_error, now.unit)
        own = (
            f"Now 1 % of the steps have errors above {quantile}, the worst {worst}; the limit is "
            f"{format_speed(self.shown_limit, now.unit)}."
        )
        if self.reason_without_line:
            return [self.reason_without_line, own]
        if m is None:
            keep = "Keep the model's own setting"
            lost = self.closer or self.faster
            if self.error_limit is None and lost is not None:
                time, error = self._format_held_back(lost) or (NONE, NONE)
                gain = f"{time} of the time, worst error {error}"
                return [
                    f"{keep}: {lost.setting.short_name} has no gain on the worlds held back ({gain}).",
                    own,
                ]
            return [f"{keep}: none of {n} settings is better in the same time.", own]
        ratio = m.mean_step_time / now.mean_step_time
        is_same = abs(ratio - 1.0) <= TIME_NOISE_FRACTION
        time = "the same time per step" if is_same else f"{ratio:.2f} of the time per step"
        new, old = (format_speed(self._compute_largest_error(x), x.unit) for x in (m, now))
        worst = (
            f"a worst error of {new} instead of {old}"
            if new != old
            else f"the same worst error of {new}"
        )
        first = f"Set {m.setting.short_name}: {time}, and {worst}."
        if self.error_limit is not None and self.within_limit is None:
            first = f"None of {n} settings is within the limit. {first}"
        held = self._format_held_back(m)
        if held is None:
            return [first, own]
        return [
            first,
            own,
            (
                f"On {format_count(self.n_held_worlds, 'world')} held back from the choice: "
                f"{held[0]} of the time, worst "
                f"error {held[1]} in {format_count(len(self.held[0].error), 'step')}."
            ),
        ]

    @property
    def choices(self) -> pd.DataFrame:
        """The present setting and the advised ones: option, relative time and errors, also on worlds held back."""
        now = self.present_result
        named = [
            ("now", now),
            ("as fast, more accurate", self.closer),
            ("as accurate, faster", self.faster),
        ]
        if self.error_limit is not None:
            goal = f"fastest within {format_speed(self.error_limit)}"
            named.append((goal if self.within_limit else "most accurate", self.limit_choice))
        named += [("MuJoCo's defaults", m) for m in self._same_problem if m.setting.is_default]
        rows = []
        for name, m in named:
            if m is None:
                continue
            texts = self._format_held_back(m) or (NONE, NONE)
            time = f"{m.mean_step_time / now.mean_step_time:.2f}"
            worst = format_speed(self._compute_largest_error(m), m.unit)
            quantile = format_speed(m.worst_error, m.unit)
            rows.append((name, m.setting.short_name, time, quantile, worst, *texts))
        heads = ["choice", "option", "time", "1 %", "worst", "time, held back", "worst, held back"]
        return pd.DataFrame(rows, columns=heads)

    def draw_settings(self, folder: Path) -> str:
        """Draw the error of each setting over its time relative to the present one."""
        now, limit = self.present_result, self.shown_limit
        low = SHOWN_RATIO * limit
        solvers = list(dict.fromkeys(m.solver for m in self._same_problem))
        colors = [
            color for color in drawing.SERIES if color != drawing.ORANGE
        ]  # The limit is orange.
        styles = {solver: (colors[i % 4], "osDv"[i % 4]) for i, solver in enumerate(solvers)}

        def place(m: Measured) -> tuple[float, float]:
            """Return the relative time and the shown error of a setting."""
            return m.mean_step_time / now.mean_step_time, max(m.worst_error, low / 2.0)

        def fill(axes: Any) -> str:
            points = np.array(list(map(place, self._same_problem)))
            labels = drawing.mark_errors(axes, low, float(points[:, 1].max()), limit)
            low_x = float(points[:, 0].min())
            high_x = max(float(points[:, 0].max()), 1.05)
            axes.set_xscale("log")
            axes.set_xlim(low_x / 1.05, high_x * 1.05)
            ticks = [x for x in TIME_TICKS if low_x / 1.05 <= x <= high_x * 1.05]
            axes.set_xticks(ticks, [f"{x:g}" for x in ticks])
            axes.minorticks_off()
            axes.axvline(1.0, color=drawing.QUIET, lw=0.7, ls=":")
            for solver, (color, mark) in styles.items():
                own = np.array([place(m) for m in self._same_problem if m.solver == solver])
                axes.plot(*own.T, mark, color=color, ms=4.5, alpha=0.75, mew=0)
            front = np.array(list(map(place, self.pareto_front)))
            # From each setting of the front to the right, nothing slower is needed for its error.
            front = np.vstack([front, [high_x * 1.05, front[-1, 1]]])
            axes.step(*front.T, where="post", color=drawing.INK, lw=1.6, zorder=2)
            x, y = place(now)
            axes.plot([x], [y], "*", ms=14, color=drawing.INK, mec=drawing.PAPER, mew=0.8, zorder=9)
            more = {"textcoords": "offset points", "fontweight": "bold", "fontsize": 8.8}
            is_left = x < np.sqrt(np.prod(axes.get_xlim()))
            side, dx = ("left", 8) if is_left else ("right", -8)
            axes.annotate("your option", (x, y), xytext=(dx, 8), ha=side, **more)
            if self.advised is not None:
                x, y = place(self.advised)
                arrow = {"arrowstyle": "-", "lw": 0.6, "color": drawing.QUIET}
                axes.plot([x], [y], "o", ms=10, mfc="none", mec=drawing.INK, mew=1.4, zorder=9)
                axes.annotate("set this", (x, y), xytext=(14, 26), arrowprops=arrow, **more)
            axes.set_xlabel("time of a step, your option = 1")
            axes.set_ylabel(f"error that 1 % of the steps exceed [{now.unit}]")
            drawing.label_ends(axes, labels)
            for i, (solver, (color, mark)) in enumerate(styles.items()):
                y = 0.97 - 0.07 * i
                style = {"transform": axes.transAxes, "clip_on": False}
                axes.plot([1.06], [y], mark, color=color, ms=5, **style)
                drawing.write_label(axes, 1.1, y, solver, color=color)
            fastest = self.pareto_front[0].mean_step_time / now.mean_step_time
            numbers = f"{len(points)} settings, fastest {fastest:.2f} of the time"
            return f"Error against time of {numbers}. {self.headline[0]}"

        note = "Each mark is a setting of <option> for the same problem; line: fastest for its error (numbers.json)."
        margins = {"left": 0.13, "right": 0.75, "top": 0.96, "bottom": 0.14}
        return drawing.draw_figure("settings", fill, (4.9, 3.5), margins, note=note, folder=folder)

    def make_page(self, folder: Path | None) -> Page:
        """Make the page; without a folder for figures, only its head."""
        first, *sentences = self.headline
        m = self.advised
        worst = float(self.present_result.error.max())
        warnings = [*filter(None, self.notes)]
        if self.busy and not self.reason_without_line:
            warnings.append(f"{self.busy} Errors are not affected.")
        blocks: list[Any] = []
        if folder is not None:
            drawn = (
                [] if self.reason_without_line else [markupsafe.Markup(self.draw_settings(folder))]
            )
            note = "" if self.reason_without_line else CHOICES_NOTE
            choices = tabulate_frame(self.choices, title="Choices", note=note)
            blocks.append({"pair": [drawn, [choices]]})
            every = sorted(self.measured, key=lambda m: m.mean_step_time)
            other = [m for m in self.measured if m.setting.changes_problem]
            motion = f"Motion: distance after {self.horizon} steps from a converged run."
            parts = [("Every setting", self._tabulate_settings(every), motion)]
            if other:
                note = "Settings that change the problem: the error is that of its own problem."
                parts.append(("Other problems", self._tabulate_settings(other), note))
            if self.sizes is not None:
                own = "With the model's own setting."
                parts.append(("Rows and contacts of a step", self.sizes.table, own))
            blocks += [fold_table(*part) for part in parts]
        n_settings = format_count(len(self._same_problem), "setting")
        source = f"lavender tune · {Path(self.model).name} · {n_settings}"
        is_bad = worst > self.shown_limit
        footer = [
            *filter(None, [self.left_out]),
            "Files: numbers.json, figures/ as PDF, SVG and PNG.",
        ]
        code = [m.setting.option_line] if m is not None and m.setting.option_line else []
        mark = "✗ above the limit now" if is_bad else "✓ within the limit now"
        if self.reason_without_line:
            mark = "✗ too little contact"
            is_bad = True
        return Page(
            "lavender tune",
            source,
            first,
            sentences,
            code,
            mark=mark,
            is_bad=is_bad,
            warnings=warnings,
            blocks=blocks,
            footer=footer,
        )

    @property
    def page(self) -> ResultPage:
        """Page with the result in sentences, figures and tables, as `lavender tune` writes it."""
        numbers = {
            "model": self.model,
            "head": self.headline,
            "why_no_line": self.reason_without_line,
            "busy": self.busy,
            "error_limit": self.error_limit,
            "is_limit_met": None if self.error_limit is None else self.within_limit is not None,
            **({} if self.sizes is None else self.sizes.as_dict),
            "stopped": self.stopped,
            "measured": list(map(_to_dict, self.measured)),
            "held": list(map(_to_dict, self.held)),
            "provenance": self.provenance,
        }
        last = format_provenance(self.provenance) if self.provenance else ""
        return ResultPage(self.make_page, numbers, [self.choices], self.stopped, last)


def _to_dict(m: Measured) -> dict[str, Any]:
    """Convert a result to a dict for JSON."""
    return {
        "options": dict(m.setting.options),
        "default": m.setting.is_default,
        "seconds": m.mean_step_time,
        "error": m.worst_error,
        "worst": float(m.error.max()),
        "motion": m.worst_motion,
    }
