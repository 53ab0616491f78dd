"""Figures as SVG and PNG files (matplotlib), in one look: a solver keeps its colour, dash and mark in a whole report.

Colours are Okabe and Ito's (distinct under the common colour-vision deficiencies), the darker ones
readable on white and on near-black; dashes and marks tell apart what shares a colour, also in grey print.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lavender.io.stored import make_folder, write_figure
from lavender.lab.bench.record import file_name
from lavender.lab.report.axes import shown
from lavender.lab.report.curves import Figure

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C6D31", "#7F7F7F")
LINES = ("-", "--", ":", "-.")  # dashes and marks of matplotlib
MARKERS = ("o", "s", "^", "D", "X", "*", "v")
COLUMNS = 3  # of a legend over the axes
MANY = 60  # points of a curve, above which marks would cover it


@dataclass(frozen=True)
class Look:
    """Colour, dash and mark of a saved figure, as matplotlib names them."""

    color: str
    line: str
    marker: str


# These come first, so that what is compared most often never shares a colour.
FIRST = ("auto", "direct", "newton", "anderson", "nncg", "osqp", "pgs", "sequential_impulses")


def looks(solvers: Iterable[str]) -> dict[str, Look]:
    """A look for each solver: by its place in `FIRST`, then among the sorted names."""
    out = {}
    names = set(solvers)
    rest = sorted(names - set(FIRST))
    place = {name: i for i, name in enumerate((*FIRST, *rest))}
    for name in sorted(names):
        i = place[name]
        out[name] = Look(
            COLORS[i % len(COLORS)], LINES[i // len(COLORS) % len(LINES)], MARKERS[i % len(MARKERS)]
        )
    return out


def matplotlib_figure(
    figure: Figure, look: Mapping[str, Look], size: tuple[float, float] = (7.6, 4.6)
) -> Any:
    """The figure drawn, `size` in inches, without pyplot and its global state.

    The legend stands to the right; of a figure without a title in its place, over the axes.
    """
    canvas = _canvas(size)
    names = len(figure.curves) + (figure.floor > 0.0)
    rows = -(-names // COLUMNS) + bool(figure.left_out)
    right, top = (2.05, 0.41) if figure.title else (0.15, 0.17 * rows + 0.1)
    # A fixed place for the axes: fitting it to the labels would take most of the time of a figure.
    wide, high = 1.0 - (0.76 + right) / size[0], 1.0 - (0.6 + top) / size[1]
    axes = canvas.add_axes((0.76 / size[0], 0.6 / size[1], wide, high))
    _draw(axes, figure, look)
    where: dict[str, Any] = {"loc": "center left", "bbox_to_anchor": (1.01, 0.5)}
    if not figure.title:
        where = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": COLUMNS, "borderpad": 0.2}
    if figure.left_out:
        drawn = len({c.solver for c in figure.curves})
        where |= {"title": f"{drawn} of {drawn + len(figure.left_out)} solvers", "title_fontsize": 7}
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=7, frameon=False, handlelength=3, **where)
    return canvas


def matplotlib_panels(figures: Sequence[Figure], look: Mapping[str, Look]) -> Any:
    """Figures of the same quantities, three in a row, with a legend once.

    In an SVG a curve has the id SOLVER--PANEL, and the legend `legend`.
    """
    rows = -(-len(figures) // 3)
    canvas = _canvas((10.0, 3.1 * rows), layout="constrained")
    places = list(canvas.subplots(rows, 3, squeeze=False).flat)
    for axes in places:
        axes.set_axis_off()
    shown: dict[str, Any] = {}
    for i, (axes, figure) in enumerate(zip(places, figures, strict=False)):
        axes.set_axis_on()
        _draw(axes, figure, look)
        axes.tick_params(labelsize=7)
        axes.xaxis.label.set_size(7)
        axes.yaxis.label.set_size(7)
        for line in axes.get_lines():
            line.set_gid(f"{line.get_label()}--{i}")
        shown |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    legend = canvas.legend(shown.values(), shown.keys(), fontsize=6, frameon=False, loc="outside right upper")
    legend.set_gid("legend")
    return canvas


def _canvas(size: tuple[float, float], **more: Any) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    canvas = Canvas(figsize=size, **more)
    FigureCanvasAgg(canvas)
    return canvas


def _draw(axes: Any, figure: Figure, look: Mapping[str, Look]) -> None:
    laid = shown(figure)
    banded = any(c.low for c in figure.curves)  # over all cases: points are no runs
    for c, x, y in laid.curves:
        k = look[c.solver]
        style: dict[str, Any] = {
            "color": k.color,
            "linestyle": "none" if c.points else k.line,
            "label": _plain(c.label),
            "linewidth": 0.8 if c.thin else 1.5,
        }
        if c.low:
            axes.fill_between(c.x, c.low, c.high, color=k.color, alpha=0.15, linewidth=0.0)
        if c.steps:
            axes.step([*x, laid.across.limits[1]], [*y, y[-1]], where="post", **style)
        else:
            axes.plot(
                x,
                y,
                marker="" if len(x) > MANY or banded else k.marker,
                markersize=4,
                markerfacecolor="none" if c.thin else k.color,
                **style,
            )
    axes.set_xscale("log" if figure.x_log else "linear")
    axes.set_yscale("log" if figure.y_log else "linear")
    for axis, drawn in ((laid.across, axes.xaxis), (laid.up, axes.yaxis)):
        ticks = axis.ticks()
        drawn.set_label_text(_plain(axis.title))
        drawn.set_ticks(ticks, labels=[axis.text(tick) for tick in ticks])
    axes.minorticks_off()
    axes.set(xlim=laid.across.limits, ylim=laid.up.limits)
    for level in figure.levels:
        axes.axhline(level, color="0.8", linewidth=0.6, zorder=0)
    if math.isfinite(figure.floor) and figure.floor > 0.0 and 0.0 <= laid.up.share(figure.floor) <= 1.0:
        axes.axhline(
            figure.floor,
            color="0.35",
            linewidth=1.0,
            linestyle=(0, (1, 1)),
            label="floor of float64",
            zorder=0,
        )
    axes.set_title(_plain(figure.heading), fontsize=10)


LONGEST_TITLE = 80  # characters


def _plain(text: str) -> str:
    # matplotlib reads formulas between dollars, and hides labels that begin with an underscore.
    short = text if len(text) <= LONGEST_TITLE else text[: LONGEST_TITLE - 1] + "…"
    return ("\u2009" + short if short.startswith("_") else short).replace("$", r"\$")


def save(figures: Iterable[Figure], folder: Path, solvers: Iterable[str] = ()) -> None:
    """Each as NAME.svg and NAME.png in `folder`; `solvers` that some of them do not show take part in the colours."""
    drawn = list(figures)
    look = looks({*solvers, *(c.solver for figure in drawn for c in figure.curves)})
    for figure in drawn:
        canvas = matplotlib_figure(figure, look)
        path = make_folder(folder) / file_name(figure.name)
        write_figure(canvas, path.with_name(path.name + ".svg"), metadata={"Date": None})
        write_figure(canvas, path.with_name(path.name + ".png"), dpi=110, metadata={"Software": None})
