"""Figures as SVG and PNG (matplotlib), and as data for the interactive page (plotly.js)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from lavender.bench.record import file_name, level_name
from lavender.report.curves import Curve, Figure
from lavender.report.style import Look

__all__ = ["matplotlib_figure", "plotly_data", "save"]


FULL = 12  # curves, above which the thin ones of a page show when their name is clicked
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


def matplotlib_figure(figure: Figure, look: dict[str, Look]) -> Any:
    """The figure drawn, without pyplot and its global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    canvas = Canvas(figsize=(7.6, 4.6))
    FigureCanvasAgg(canvas)
    # A fixed place for the axes: fitting it to the labels would take most of the time of a figure.
    axes = canvas.add_axes((0.1, 0.13, 0.63, 0.78))
    for c in figure.curves:
        k = look[c.solver]
        style: dict[str, Any] = {
            "color": k.color,
            "linestyle": k.line,
            "label": c.label,
            "linewidth": 0.8 if c.thin else 1.5,
        }
        if c.points:
            style["linestyle"] = "none"
        if c.steps:
            last = max(x for d in figure.curves for x in d.x) * 1.3
            axes.step([*c.x, last], [*c.y, c.y[-1]], where="post", **style)
        else:
            axes.plot(
                c.x,
                c.y,
                marker=k.marker if len(c.x) <= MANY else "",
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
    axes.set_xlabel(figure.x_title)
    axes.set_ylabel(figure.y_title)
    axes.set_title(figure.title, fontsize=10)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, handlelength=3)
    return canvas


def save(figure: Figure, look: dict[str, Look], folder: Path) -> None:
    """NAME.svg and NAME.png in `folder`."""
    canvas = matplotlib_figure(figure, look)
    path = folder / file_name(figure.name)
    canvas.savefig(path.with_name(path.name + ".svg"), metadata={"Date": None})
    canvas.savefig(path.with_name(path.name + ".png"), dpi=110, metadata={"Software": None})


def plotly_data(figure: Figure, look: dict[str, Look]) -> dict[str, Any]:
    """Traces and layout for plotly.js; colours of paper, grid and text are the page's, set there."""
    traces: list[dict[str, Any]] = []
    for c in figure.curves:
        k = look[c.solver]
        x, y = list(c.x), list(c.y)
        if c.steps:
            x.append(max(v for d in figure.curves for v in d.x) * 1.3)
            y.append(y[-1])
        traces.append({
            "x": x,
            "y": [v if math.isfinite(v) else None for v in y],
            "name": c.label,
            "text": [_html(t) for t in c.hover],
            "visible": "legendonly" if c.thin and len(figure.curves) > FULL else True,
            "hoverinfo": "text" if c.hover else "name",
            "mode": _mode(c, len(x)),
            "line": {
                "color": k.color,
                "dash": k.dash,
                "width": 1.0 if c.thin else 2.0,
                **({"shape": "hv"} if c.steps else {}),
            },
            "marker": {"symbol": k.mark + ("-open" if c.thin else ""), "size": 7, "color": k.color},
        })  # fmt: skip
    return {
        "traces": traces,
        "title": figure.title,
        "x": {"title": figure.x_title, "log": figure.x_log, "seconds": "[s]" in figure.x_title},
        "y": {"title": figure.y_title, "log": figure.y_log, "seconds": "[s]" in figure.y_title},
        "levels": list(figure.levels),
        "floor": figure.floor if math.isfinite(figure.floor) and figure.floor > 0.0 else None,
    }


def _mode(curve: Curve, points: int) -> str:
    if curve.points:
        return "markers"
    return "lines" if curve.steps or points > MANY else "lines+markers"


def _html(text: str) -> str:
    # plotly reads a little HTML in hover texts; names of files and rows are not meant as such.
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;").replace("\n", "<br>")
