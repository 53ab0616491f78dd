"""Figures as SVG and PNG files (matplotlib)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from lavender.bench.record import file_name, level_name
from lavender.io.stored import write_figure
from lavender.report.curves import Figure
from lavender.report.style import Look

__all__ = ["matplotlib_figure", "power_on_axis", "save", "seconds_on_axis"]


MANY = 60  # points of a curve, above which marks would cover it


def seconds_on_axis(t: float, _position: object = None) -> str:
    """1 ms, 20 µs: a tick of an axis of times."""
    scale, unit = next(
        ((s, u) for s, u in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")) if t >= 0.999 * s), (1e-9, "ns")
    )
    return f"{t / scale:.3g} {unit}"


def power_on_axis(x: float, _position: object = None) -> str:
    """1e-3, or 10: a tick of a logarithmic axis."""
    return f"{x:.3g}" if 0.09 < x < 1e4 else level_name(x)


def matplotlib_figure(figure: Figure, look: dict[str, Look], size: tuple[float, float] = (7.6, 4.6)) -> Any:
    """The figure drawn, `size` in inches, without pyplot and its global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    canvas = Canvas(figsize=size)
    FigureCanvasAgg(canvas)
    # A fixed place for the axes: fitting it to the labels would take most of the time of a figure.
    axes = canvas.add_axes((0.76 / size[0], 0.6 / size[1], 1.0 - 2.81 / size[0], 1.0 - 1.01 / size[1]))
    banded = any(c.low for c in figure.curves)  # over all cases: points are no runs
    for c in figure.curves:
        k = look[c.solver]
        style: dict[str, Any] = {
            "color": k.color,
            "linestyle": k.line,
            "label": _plain(c.label),
            "linewidth": 0.8 if c.thin else 1.5,
        }
        if c.points:
            style["linestyle"] = "none"
        if c.low:
            axes.fill_between(c.x, c.low, c.high, color=k.color, alpha=0.15, linewidth=0.0)
        if c.steps:
            last = max(x for d in figure.curves for x in d.x) * 1.3
            axes.step([*c.x, last], [*c.y, c.y[-1]], where="post", **style)
        else:
            axes.plot(
                c.x,
                c.y,
                marker="" if len(c.x) > MANY or banded else k.marker,
                markersize=4,
                markerfacecolor="none" if c.thin else k.color,
                **style,
            )
    if figure.x_log:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(seconds_on_axis if "[s]" in figure.x_title else power_on_axis)
        lowest, highest = axes.get_xlim()
        if highest < 20.0 * lowest:  # not a decade to see: name the steps between
            axes.xaxis.set_minor_formatter(seconds_on_axis if "[s]" in figure.x_title else power_on_axis)
            axes.tick_params(axis="x", which="minor", labelsize=6, labelrotation=45)
        else:
            axes.xaxis.set_minor_formatter("")
    if figure.y_log:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(seconds_on_axis if "[s]" in figure.y_title else power_on_axis)
        axes.yaxis.set_minor_formatter("")
    for level in figure.levels:
        axes.axhline(level, color="0.8", linewidth=0.6, zorder=0)
    if math.isfinite(figure.floor) and figure.floor > 0.0:
        axes.axhline(
            figure.floor,
            color="0.35",
            linewidth=1.0,
            linestyle=(0, (1, 1)),
            label="floor of float64",
            zorder=0,
        )
    axes.set_xlabel(_plain(figure.x_title))
    axes.set_ylabel(_plain(figure.y_title))
    axes.set_title(_plain(figure.title), fontsize=10)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, handlelength=3)
    return canvas


LONGEST_TITLE = 80  # characters


def _plain(text: str) -> str:
    # matplotlib reads formulas between dollars, and hides labels that begin with an underscore.
    short = text if len(text) <= LONGEST_TITLE else text[: LONGEST_TITLE - 1] + "…"
    return ("\u2009" + short if short.startswith("_") else short).replace("$", r"\$")


def save(figure: Figure, look: dict[str, Look], folder: Path) -> None:
    """NAME.svg and NAME.png in `folder`."""
    canvas = matplotlib_figure(figure, look)
    path = folder / file_name(figure.name)
    write_figure(canvas, path.with_name(path.name + ".svg"), metadata={"Date": None})
    write_figure(canvas, path.with_name(path.name + ".png"), dpi=110, metadata={"Software": None})
