"""Draw the figures of a report: time to an accuracy, performance profile, error against time, and sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lavender.base.lazy_import import pandas as pd
from lavender.report import drawing
from lavender.report.tables import ENGINE_NAME, Contents, format_size, is_plug_in, rank_solvers
from lavender.report.text import (
    format_count,
    format_power,
    format_residual,
    format_speed,
    format_time,
)

MAX_LINES = (
    6  # Largest number of solvers in a figure, without `ALWAYS_DRAWN`, plug-ins and the engine.
)
# Most engines sweep as pgs does, and osqp is the most used solver of other packages.
ALWAYS_DRAWN = ("pgs", "osqp")
FIGURE_SIZE = (4.9, 3.3)  # [inches]


def select_drawn_solvers(ranking: Sequence[str]) -> list[str]:
    """Select the solvers that figures show, in the order of the ranking."""
    first = [name for name in ranking if name != ENGINE_NAME][:MAX_LINES]
    return [n for n in ranking if n in first or n in (*ALWAYS_DRAWN, ENGINE_NAME) or is_plug_in(n)]


def draw_time_to_accuracy(
    report: Contents, names: Sequence[str], folder: drawing.FigureFolder | None
) -> str:
    """Draw the mean time of each solver to each tolerance, with values at the ends of the lines."""
    tolerances = report.tolerances
    rankings = {t: rank_solvers(report, t, report.subject).reindex(names) for t in tolerances}
    times = {name: [float(rankings[t].at[name, "mean"]) for t in tolerances] for name in names}
    n = len(report.subject)
    solved = {
        name: [int(np.nan_to_num(rankings[t].at[name, "solved"])) for t in tolerances]
        for name in names
    }

    def describe_last(name: str) -> str:
        """Return the mean time to the tightest tolerance that a solver reaches, and how many problems it solves."""
        last = max((i for i, count in enumerate(solved[name]) if count), default=-1)
        some = f", {solved[name][last]}/{n}" if last >= 0 and solved[name][last] < n else ""
        return f"{name} {format_time(times[name][last])}{some}" if last >= 0 else f"{name}: none"

    def fill(axes: Any) -> str:
        every = np.concatenate(list(times.values()))
        axes.set_yscale("log")
        axes.set_xlim(-0.12, len(tolerances) - 1)
        known = every[np.isfinite(every)]
        axes.set_ylim(max(known.min(), 1e-9) / 1.3, known.max() * 1.25)
        labels = []
        for i, (name, own) in enumerate(times.items()):
            style = drawing.style_line(i)
            axes.plot(range(len(own)), own, clip_on=False, **style)
            part = [k for k, count in enumerate(solved[name]) if 0 < count < n]
            if part:
                hollow = style | {"linestyle": "", "markerfacecolor": drawing.PAPER, "zorder": 8}
                axes.plot(part, [own[k] for k in part], clip_on=False, **hollow)
            weight = "normal" if i else "bold"
            ends = [t for t in own if np.isfinite(t)]
            y = ends[-1] if ends else float(known.max())
            labels.append(drawing.Label(y, describe_last(name), style["color"], weight))
        axes.set_xticks(range(len(tolerances)), list(map(format_power, tolerances)))
        axes.set_xlabel("residual to reach (1: no impulse)")
        axes.yaxis.set_major_formatter(lambda t, _: format_time(t))
        axes.yaxis.set_minor_formatter(lambda t, _: format_time(t) if f"{t:e}"[0] in "25" else "")
        axes.grid(True, axis="y")
        drawing.label_ends(axes, labels)
        texts = []
        for name, own in times.items():
            parts = [
                f"{format_time(t)} to {format_power(x)}" + (f" on {count}" if count < n else "")
                for t, x, count in zip(own, tolerances, solved[name], strict=True)
                if count
            ]
            texts.append(f"{name}: {', '.join(parts)}")
        return f"Mean time. {'; '.join(texts)}"

    is_partial = any(0 < count < n for counts in solved.values() for count in counts)
    hollow = "; hollow: not all, their number is at the end" if is_partial else ""
    note = f"Mean time of the solved of {format_count(n, 'problem')}{hollow} (tables/solvers.csv)."
    margins = drawing.fit_margins([describe_last(name) for name in times])
    return drawing.draw_figure(
        "time-to-accuracy", fill, FIGURE_SIZE, margins, note=note, folder=folder
    )


def draw_profile(
    times: pd.DataFrame,
    names: Sequence[str],
    folder: drawing.FigureFolder | None,
    name: str = "profile",
    **style: Any,
) -> str:
    """Draw the share of the cases that each solver solves within a factor of the fastest (Dolan, Moré 2002)."""
    ratios = times.div(times.where(times > 0.0).min(), axis=1).loc[list(names)]
    n = max(times.shape[1], 1)

    def fill(axes: Any) -> str:
        known = ratios.to_numpy()[np.isfinite(ratios.to_numpy())]
        high = 10.0 ** max(1.0, np.ceil(np.log10(np.quantile(known, 0.97)))) if len(known) else 10.0
        axes.set_xscale("log")
        axes.set_xlim(1.0, high)
        axes.set_ylim(0.0, 1.02)
        labels = []
        for i, (solver, own) in enumerate(ratios.iterrows()):
            r = np.sort(own.dropna().to_numpy())
            r = np.maximum(r[r <= high], 1.0)
            x = np.r_[1.0, r, high]
            y = np.searchsorted(r, x * (1.0 + 1e-9), side="right") / n
            line = drawing.style_line(i) | {"marker": ""} | style
            axes.step(x, y, where="post", gid=f"{solver}--{i}", **line)
            labels.append(
                drawing.Label(y[-1], str(solver), line["color"], "normal" if i else "bold")
            )
        axes.set_xlabel("at most this many times slower than the fastest")
        axes.xaxis.set_major_formatter(lambda x, _: f"{x:g}×")
        axes.minorticks_off()
        axes.set_yticks([0.0, 0.25, 0.5, 0.75, 1.0])
        axes.yaxis.set_major_formatter(lambda y, _: f"{100.0 * y:.0f} %")
        axes.tick_params(axis="y", pad=7)
        axes.grid(True)
        drawing.label_ends(axes, labels[::-1])
        return "Performance profile. Solved within twice the fastest time: " + ", ".join(
            f"{solver} {100.0 * (own <= 2.0).sum() / n:.0f} %" for solver, own in ratios.iterrows()
        )

    note = (
        "Share of the problems solved within a factor of the fastest solver (performance profile). Left end: how often "
        "a solver is the fastest; right end: how many it solves (tables/matrix.csv)."
    )
    return drawing.draw_figure(
        name, fill, FIGURE_SIZE, drawing.fit_margins(names), note=note, folder=folder
    )


def draw_error_against_time(
    report: Contents, case: str, names: Sequence[str], folder: drawing.FigureFolder | None
) -> str:
    """Draw the error that each solver reached on one case by a time; an engine's own answer is a star.

    It is the velocity error in m/s, or the error of a quadratic program, whose limit is the tolerance to reach.
    """
    is_program = report.cases.at[case, "law"] == "program"
    column, show = ("relative", format_residual) if is_program else ("velocity", format_speed)
    frame = report.frame[report.frame["case"] == case]
    kept = report.ranked_runs[report.ranked_runs["case"] == case]
    starts = dict(zip(kept["solver"].astype(str), kept["start"].astype(str), strict=True))
    lines = {}
    for name in names:
        own = (
            kept
            if name == ENGINE_NAME
            else frame[frame["start"].astype(str) == starts.get(name, "")]
        )
        own = own[(own["solver"] == name) & np.isfinite(own[column]) & (own["time"] > 0.0)]
        own = own.sort_values("time")
        own = own.assign(best=own[column].astype(float).cummin()).drop_duplicates("best")
        if len(own):
            lines[name] = own[["time", "best"]].to_numpy(float)
    if not lines:
        return ""
    low, limit = (1e-12, report.tolerance) if is_program else (1e-9, report.error_limit)

    def fill(axes: Any) -> str:
        points = np.concatenate(list(lines.values()))
        axes.set_xscale("log")
        axes.set_xlim(points[:, 0].min() / 1.3, points[:, 0].max() * 1.3)
        drawing.mark_errors(axes, low, float(points[:, 1].max()), limit)
        small = {"fontsize": 8.2, "color": drawing.QUIET}
        drawing.write_label(axes, 1.02, 0.035, f"below {format_power(low)}", **small)
        place = axes.transAxes.inverted().transform(axes.transData.transform((1.0, 1.35 * limit)))[
            1
        ]
        text = f"to reach: {format_power(limit)}" if is_program else f"limit {format_speed(limit)}"
        drawing.write_label(
            axes, 0.015, place, text, color=drawing.ORANGE, va="bottom", fontsize=8.2
        )
        for i, (name, own) in enumerate(lines.items()):
            style = drawing.style_line(i)
            if name == ENGINE_NAME:
                style |= {"marker": "*", "markersize": 12, "color": drawing.INK}
            axes.plot(own[:, 0], np.where(own[:, 1] < low, low / 2.0, own[:, 1]), **style)
        axes.xaxis.set_major_formatter(lambda t, _: format_time(t))
        axes.minorticks_off()
        axes.set_xlabel("time of a call")
        axes.set_ylabel("error of the program" if is_program else "largest velocity error [m/s]")
        axes.grid(True, axis="x")
        drawing.write_label(axes, 1.04, 1.0, "time of the last run", **small)
        order = sorted(lines, key=lambda name: lines[name][-1, 0])
        for k, name in enumerate(order):
            style = drawing.style_line(list(lines).index(name))
            y = 0.93 - 0.07 * k
            mark = "*" if name == ENGINE_NAME else style["marker"]
            place = {"transform": axes.transAxes, "clip_on": False}
            axes.plot([1.06], [y], mark, ms=4.5, color=style["color"], **place)
            weight = "bold" if name == next(iter(lines)) else "normal"
            text = f"{name} {format_time(lines[name][-1, 0])}"
            drawing.write_label(axes, 1.1, y, text, color=style["color"], weight=weight)
        return f"Error against time on {case}. " + ", ".join(
            f"{name} reaches {show(own[-1, 1])} in {format_time(own[-1, 0])}"
            for name, own in lines.items()
        )

    slowest = "The slowest problem, " if len(report.subject) > 1 else ""
    error = "" if is_program else "; its error is that of the worst row"
    note = f"{slowest}{case} ({format_size(report.cases.loc[case])}). A mark is a run{error} (records.csv)."
    texts = [
        "time of the last run",
        *(f"{name} {format_time(own[-1, 0])}" for name, own in lines.items()),
    ]
    margins = drawing.fit_margins(texts, 0.07, left_margin=0.14)
    return drawing.draw_figure(
        "error-against-time", fill, FIGURE_SIZE, margins, note=note, folder=folder
    )
