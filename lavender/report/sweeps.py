"""Answer how many sweeps a step needs: the verdict, the figures and the table of `lavender report --sweeps`."""

from __future__ import annotations

from typing import Any

import numpy as np
from markupsafe import Markup, escape

from lavender.base.lazy_import import pandas as pd
from lavender.report import drawing
from lavender.report.page import make_table
from lavender.report.tables import Contents, list_plain_sweeps, read_own_answers
from lavender.report.text import (
    format_count,
    format_percent,
    format_speed,
    format_time,
    split_row_unit,
)

EQUAL_RATIO = 1.1  # Solvers are one line if their errors differ by less at every number of sweeps.
MAX_SWEEP_COLUMNS = (
    400  # Columns of the strip of steps; a column of more steps has their largest error.
)
# Errors below this fraction of the limit lie in the strip at the bottom of the figure.
SWEEPS_SHOWN_RATIO = 1e-4


class SweepStudy:
    """Errors of fixed numbers of sweeps on the steps of sequences, without the first step of each."""

    def __init__(self, report: Contents) -> None:
        self.report = report
        self.limit = report.error_limit
        runs = report.frame
        runs = runs[(runs["mode"] == "budget") & (runs["step"] > 0)]
        self.runs = runs.astype(dict.fromkeys(("solver", "start", "case", "sequence"), str))
        errors = self.runs.groupby(["start", "solver", "max_iter"])["velocity"].max().unstack()
        complete = self.runs.groupby(["start", "solver", "max_iter"])["case"].nunique().unstack()
        self.n_steps = self.runs["case"].nunique()
        errors = errors.where(complete == self.n_steps)
        self.start = "carried" if "carried" in errors.index else "cold"
        self.errors = errors.loc[self.start].dropna(how="all")
        self.cold = errors.loc["cold"] if "cold" in errors.index else self.errors.iloc[:0]
        self.budgets = list(map(int, self.errors.columns))
        plain = list_plain_sweeps()
        order = sorted(
            self.errors.index, key=lambda s: (plain.index(s) if s in plain else len(plain), s)
        )
        self.groups: list[list[str]] = []  # Solvers with equal errors are one group.
        for solver in order:
            same = next((g for g in self.groups if self._are_equal(g[0], solver)), None)
            if same is None:
                self.groups.append([solver])
            else:
                same.append(solver)
        enough = [g for g in self.groups if self._find_smallest(g[0])]
        preferred = [g for g in enough if g[0] in plain] or enough or self.groups
        best = min(preferred, key=lambda g: self._find_smallest(g[0]) or 0)
        self.groups.remove(best)
        self.groups.insert(0, best)
        self.first = best[0]
        self.answers = read_own_answers(report)
        self.answers = self.answers[self.answers["step"] > 0]

    def _are_equal(self, one: str, two: str) -> bool:
        """Return whether two solvers have equal errors for each number of sweeps."""
        a, b = (self.errors.loc[name].clip(lower=1e-12) for name in (one, two))
        with np.errstate(divide="ignore"):  # A solver may have diverged: its error is infinite.
            is_near = np.abs(np.log(a / b)).fillna(0.0) < np.log(EQUAL_RATIO)
        return bool((a.isna() == b.isna()).all() and is_near.all())

    def _find_smallest(self, solver: str, errors: pd.DataFrame | None = None) -> int | None:
        """Return the smallest number of sweeps from which on all errors are within the limit; None without one."""
        errors = self.errors if errors is None else errors
        if solver not in errors.index:
            return None
        own = errors.loc[solver].dropna()
        above = np.flatnonzero(own > self.limit)
        within = own.index[int(above[-1]) + 1 if len(above) else 0 :]
        return int(within[0]) if len(within) else None

    @property
    def source(self) -> str:
        """Command, sequences and their size."""
        names = list(dict.fromkeys(self.runs["sequence"]))
        return f"lavender report --sweeps · {', '.join(names[:3])} · {format_count(self.n_steps, 'recorded step')}"

    @property
    def _count_sentence(self) -> str:
        """How many of the recorded steps count, and why the others do not; empty if all count."""
        report = self.report
        steps = report.cases[report.cases["sequence"].isin(self.runs["sequence"].unique())]
        n_first = int((steps["step"] == 0).sum())
        n_zero = report.newest[
            report.newest["nothing_to_do"].astype(bool) & (report.newest["step"] > 0)
        ]["case"].nunique()
        parts = []
        if n_first:
            one = "the first has no step before it"
            parts.append(one if n_first == 1 else f"the first {n_first} have no step before them")
        if n_zero:
            parts.append(f"the zero impulse solves {n_zero}")
        if not parts:
            return ""
        engine = len(self.answers)
        own = f", and your engine's answers to {engine}" if engine not in (0, self.n_steps) else ""
        return (
            f"Of {format_count(len(steps), 'recorded step')}, {' and '.join(parts)}: solvers are compared on "
            f"{self.n_steps}{own}."
        )

    @property
    def verdict(self) -> str:
        """How many sweeps are enough, or that no measured number is."""
        best = self._find_smallest(self.first)
        errors = self.errors.loc[self.first]
        limit = format_speed(self.limit)
        if best is None:
            last = errors.last_valid_index()
            if last is None:
                return "No number of sweeps was measured on every step."
            return (
                f"{last} sweeps of {self.first} are not enough: they leave "
                f"{format_speed(errors[last], limit=self.limit)}; the limit is {limit}."
            )
        text = f"{best} sweeps of {self.first} keep every velocity error below {limit}"
        fewer = [b for b in self.budgets if b < best and errors[b] == errors[b]]
        left = format_speed(errors[fewer[-1]], limit=self.limit) if fewer else ""
        return f"{text}; {fewer[-1]} leave {left}." if fewer else f"{text}."

    @property
    def is_bad(self) -> bool:
        """Whether the engine's own answers exceed the limit; without them, whether no number of sweeps is enough."""
        if len(self.answers):
            return bool(self.answers["velocity"].max() > self.limit)
        return self._find_smallest(self.first) is None

    @property
    def mark(self) -> str:
        """Result of the comparison of the engine's own answers with the limit; empty without them."""
        return ("✗ too few now" if self.is_bad else "✓ enough now") if len(self.answers) else ""

    @property
    def sentences(self) -> list[str]:
        """Sentences on the engine's own answers, the other solvers and cold starts."""
        lines = []
        if len(self.answers):
            error = self.answers["velocity"]
            n = len(self.answers)
            above = int((error > self.limit).sum())
            worst = self.answers.loc[error.idxmax()]
            count = self.answers["iterations"].dropna()
            own = f"{count.max():.0f} iterations leave" if len(count) else "answers leave"
            name, unit = split_row_unit(str(worst["worst"]))
            row = f" ({name})" if name else ""
            share = f"{format_percent(above, n) if above else 'none'} of {format_count(n, 'step')} above the limit"
            size = format_speed(error.max(), unit)
            lines.append(
                f"Your engine's own {own} {size}, {share}; the worst is {worst['file']}{row}."
            )
        if counted := self._count_sentence:
            lines.append(counted)
        needs = [(g[0], self._find_smallest(g[0])) for g in self.groups[1:]]
        texts = [
            f"{name} needs {n}" if n else f"{name} more than {self.budgets[-1]}"
            for name, n in needs
        ]
        best = self._find_smallest(self.first)
        cold = self._find_smallest(self.first, self.cold)
        if self.start == "carried":
            few = f"{self.budgets[-1]} of {self.first} are not enough"
            other = f"{self.first} needs {cold}" if cold else few
            same = (
                "From cold starts the number is the same"
                if cold == best
                else f"From cold starts {other}"
            )
            return [*lines, " ".join(f"{text}." for text in ("; ".join(texts), same) if text)]
        return [*lines, f"{'; '.join(texts)}."] if texts else lines

    def make_blocks(self, folder: drawing.FigureFolder | None, with_figures: bool) -> list[Any]:
        """Make the figures and the table of sweeps × solvers."""
        table = self._make_sweeps_table()
        if not with_figures:
            return [table]
        return [
            {
                "pair": [
                    [Markup(self._draw_errors(folder))],
                    [Markup(self._draw_steps(folder)), table],
                ]
            }
        ]

    def _draw_errors(self, folder: drawing.FigureFolder | None) -> str:
        """Draw the largest error against the number of sweeps, with the engine's own answers as a star."""
        low = SWEEPS_SHOWN_RATIO * self.limit
        colors = [
            drawing.BLUE,
            *drawing.SERIES[2:],
            drawing.INK,
            *[drawing.QUIET] * len(self.groups),
        ]

        def fill(axes: Any) -> str:
            axes.set_xscale("log", base=2)
            axes.set_xlim(0.85 * self.budgets[0], 1.08 * self.budgets[-1])
            high = max(float(x.max(axis=None)) for x in (self.errors, self.cold) if len(x))
            labels = drawing.mark_errors(axes, low, high, self.limit)

            def place(errors: pd.Series[float]) -> Any:
                return errors.where(errors.isna() | (errors >= low), low / 2.0)

            for i, group in enumerate(self.groups):
                own = self.errors.loc[group[0]]
                dash = {
                    "lw": 1.4 if i else 2.4,
                    "ls": "-" if i < 5 else "--",
                    "ms": 4.5,
                    "clip_on": False,
                }
                axes.plot(
                    self.budgets, place(own), color=colors[i], marker=drawing.MARKERS[i % 6], **dash
                )
                if (last := own.last_valid_index()) is not None:
                    y = float(place(own)[last])
                    weight = "normal" if i else "bold"
                    labels.append(drawing.Label(y, group[0], colors[i], weight))
            if self.start == "carried" and self.first in self.cold.index:
                cold = place(self.cold.loc[self.first])
                axes.plot(self.budgets, cold, color=drawing.BLUE, lw=0.9, ls=(0, (3, 2)))
            best = self._find_smallest(self.first)
            if best is not None:
                drop = [low / 4.0, place(self.errors.loc[self.first])[best]]
                axes.plot([best, best], drop, color=drawing.BLUE, lw=0.8, ls=":")
            iterations = self.answers["iterations"].dropna()
            if len(iterations):
                x = float(iterations.max())
                y = max(float(self.answers["velocity"].max()), low / 2.0)
                x = min(max(x, self.budgets[0]), self.budgets[-1])
                star = {
                    "ms": 13,
                    "color": drawing.INK,
                    "mec": drawing.PAPER,
                    "mew": 0.8,
                    "zorder": 9,
                }
                axes.plot([x], [y], "*", clip_on=False, **star)
                axes.annotate(
                    f"your engine\n{iterations.max():.0f} iterations: {format_speed(y)}",
                    (x, y),
                    xytext=(12, 16),
                    textcoords="offset points",
                    fontsize=8.6,
                    fontweight="bold",
                    va="bottom",
                    ha="left" if x < self.budgets[len(self.budgets) // 2] else "right",
                    arrowprops={"arrowstyle": "-", "lw": 0.6, "color": drawing.QUIET, "shrinkB": 5},
                )
            axes.set_xticks(self.budgets, list(map(str, self.budgets)))
            axes.minorticks_off()
            axes.grid(True)
            axes.set_xlabel("sweeps in each step")
            axes.set_ylabel("largest velocity error of all steps [m/s]")
            drawing.label_ends(axes, labels)
            return "Largest velocity error against sweeps. " + "; ".join(
                f"{g[0]}: "
                + ", ".join(
                    f"{b} sweeps {format_speed(e)}" for b, e in self.errors.loc[g[0]].items()
                )
                for g in self.groups
            )

        notes = (
            ["Warm starts; dashed: cold starts of the first solver."]
            if self.start == "carried"
            else []
        )
        several = [g for g in self.groups if len(g) > 1]
        notes += [f"{' and '.join(g[1:])} equal{'s' * (len(g) == 2)} {g[0]}." for g in several]
        names = [f"limit {format_speed(self.limit)}", *(g[0] for g in self.groups)]
        margins = drawing.fit_margins(names, left_margin=0.135)
        note = " ".join([*notes, "(tables/sweeps.csv)"])
        return drawing.draw_figure("sweeps", fill, (4.9, 3.5), margins, note=note, folder=folder)

    def _draw_steps(self, folder: drawing.FigureFolder | None) -> str:
        """Draw the error of each step after each number of sweeps of the first solver, the engine's answers first."""
        runs = self.runs[(self.runs["solver"] == self.first) & (self.runs["start"] == self.start)]
        table = runs.pivot_table(
            index="max_iter", columns="case", values="velocity", sort=False
        ).sort_index()
        cases = list(table.columns)
        if len(self.answers):
            own = self.answers.set_index("case")["velocity"].reindex(cases)
            table = pd.concat([own.to_frame("your engine").T, table])
        parts = np.array_split(np.arange(len(cases)), min(len(cases), MAX_SWEEP_COLUMNS))
        errors = np.stack(
            [np.nanmax(table.to_numpy(float)[:, part], axis=1) for part in parts], axis=1
        )
        steps = self.report.cases.loc[cases, "step"].to_numpy(int)
        n = len(table)
        height = 0.27 * n + 0.75

        def fill(axes: Any) -> str:
            drawing.draw_error_strip(
                axes, errors, 1e-6, self.limit, (-0.5, len(cases) - 0.5, n - 0.5, -0.5)
            )
            for i in range(1, n):
                axes.axhline(
                    i - 0.5, color=drawing.PAPER, lw=5 if len(self.answers) and i == 1 else 2
                )
            axes.set_yticks(range(n), list(map(str, table.index)))
            shown = np.unique(np.linspace(0, len(cases) - 1, 6).astype(int))
            axes.set_xticks(shown, list(map(str, steps[shown])))
            axes.set_xlabel("recorded step")
            axes.set_ylabel("sweeps")
            counts = (table > self.limit).sum(axis=1)
            return f"Steps above the limit: {', '.join(f'{name}: {n} of {len(cases)}' for name, n in counts.items())}"

        margins = {"left": 0.21, "right": 0.76, "top": 0.97, "bottom": 0.55 / height}
        note = f"Which steps need them: error of each step with {self.first}" + (
            "; first line: your engine's answers (records.csv)."
            if len(self.answers)
            else " (records.csv)."
        )
        return drawing.draw_figure(
            "sweeps-by-step", fill, (4.9, height), margins, note=note, folder=folder
        )

    def _make_sweeps_table(self) -> dict[str, Any]:
        """Make the table of the largest errors: sweeps × solvers, motion error and, if valid, the time last."""
        own = self.runs[
            (self.runs["solver"] == self.first) & (self.runs["start"] == self.start)
        ].groupby("max_iter")
        motion, times = own["motion_error"].max(), own["time"].median()
        has_motion = motion.notna().any()
        is_idle = not self.report.busy
        rows = []

        def write(error: float) -> str:
            return (
                "–"
                if error != error
                else format_speed(error)
                if error > 1e-7
                else "≤ 0.1\u00a0µm/s"
            )

        for budget in self.budgets:
            errors = [float(self.errors.loc[g[0], budget]) for g in self.groups]
            cells: list[Any] = [(write(e), "c1" if e <= self.limit else "c4", "") for e in errors]
            cells += [(write(float(motion[budget])), "", "")] if has_motion else []
            cells += [(format_time(times[budget]), "q wide", "")] if is_idle else []
            rows.append([str(budget), *cells])
        # Long names break at underscores only.
        heads: list[Any] = [
            "sweeps",
            *(escape(g[0]).replace("_", Markup("_<wbr>")) for g in self.groups),
        ]
        heads += ["motion¹"] if has_motion else []
        heads += [("time²", "wide", "")] if is_idle else []
        notes = f"¹ largest error of a body's velocity with {self.first}. " if has_motion else ""
        notes += f"² median of a call with {self.first}, with judge and Python." if is_idle else ""
        small = f"{'warm starts; ' * (self.start == 'carried')}dark: within the limit of {format_speed(self.limit)}"
        return make_table(
            rows,
            heads,
            title="Largest velocity error after each number of sweeps",
            small=small,
            note=notes.strip(),
            classes="matrix sweeps",
        )
