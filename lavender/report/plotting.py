"""Draw figures with matplotlib: as SVG and PNG files, and as SVG within a page.

In files a solver of lavender has the same colour, dash and mark in all reports. The colours are from Okabe and Ito
(distinct under the common colour-vision deficiencies); dashes and marks distinguish solvers that share a colour, also
in grey print. Plug-ins have colours of their own.

Within a page the colours are from its style sheet, so that they follow the theme and the selected solvers. The drawing
has classes in place of matplotlib's styles, whole coordinates, and the ranges of its axes, from which the page's
script computes the values of points.
"""

from __future__ import annotations

import io
import math
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from lavender.base.errors import require_packages
from lavender.io.stored import make_folder, write_figure
from lavender.report.bench.record import format_tolerance, make_file_name
from lavender.report.figures import Curve, Figure, is_plug_in
from lavender.report.text import TIME_UNITS
from lavender.solvers import registry

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C6D31", "#7F7F7F")
# Plug-ins; no solver of lavender has one of these colours.
PLUG_IN_COLORS = (
    "#000000",
    "#6A0DAD",
    "#8B0000",
)
DASHES = ("-", "--", ":", "-.")  # Line styles of matplotlib.
MARKERS = ("o", "s", "^", "D", "X", "*", "v")
LEGEND_COLUMNS = 3  # Number of columns of a legend above the axes.
# On a page, a line with more points is drawn without dots; points without a line always have dots.
MAX_PAGE_DOTS = 40
MAX_MARKED_POINTS = 60  # A curve with more points has no marks: they would cover it.
MAX_TITLE_LENGTH = 80  # [characters] Longer titles are cut.
MAX_NAME_LENGTH = 24  # [characters] Longer names of solvers at the ends of curves are cut.
MIN_DECADES = 1.0  # [decades] A logarithmic axis has at least this length.
AXIS_MARGIN = 0.03  # This fraction of the data's range is added at each end of an axis.
AXIS_TIME_UNITS = (*TIME_UNITS, (1e-9, "ns"))


# -- axes ----------------------------------------------------------------------------------------------------


def choose_limits(values: Sequence[float], log: bool) -> tuple[float, float]:
    """Return the ends of an axis that shows these values: with a margin, and at least `MIN_DECADES` if logarithmic."""
    values = [math.log10(v) if log else v for v in values] or [0.0, 1.0]
    low, high = min(values), max(values)
    if log and high - low < MIN_DECADES:
        low, high = 0.5 * (low + high - MIN_DECADES), 0.5 * (low + high + MIN_DECADES)
    margin = AXIS_MARGIN * (high - low) if high > low else 0.5
    low, high = low - margin, high + margin
    return (10.0**low, 10.0**high) if log else (low, high)


def choose_ticks(limits: tuple[float, float], log: bool) -> list[float]:
    """Return ticks of an axis: up to seven powers of ten, or round numbers if it is linear or below two decades."""
    from matplotlib.ticker import LogLocator, MaxNLocator

    locator: Any = MaxNLocator(6, steps=(1, 2, 5, 10))
    if log:
        decades = math.floor(math.log10(limits[1])) - math.ceil(math.log10(limits[0])) + 1
        locator = LogLocator(subs=(1.0,) if decades > 1 else (1.0, 2.0, 5.0), numticks=7)
    return [float(t) for t in locator.tick_values(*limits) if limits[0] <= t <= limits[1]]


def label_axis(
    title: str, limits: tuple[float, float], ticks: Sequence[float], log: bool
) -> tuple[str, list[str]]:
    """Return the title of an axis and the text of each tick; a time [s] gets the unit of the middle of the axis.

    All ticks have one format: if one tick of a logarithmic axis needs a power of ten, all ticks except 1 are powers.
    """
    middle = math.sqrt(limits[0] * limits[1]) if log else 0.5 * (limits[0] + limits[1])
    is_time = "[s]" in title
    scale, unit = (
        next((u for u in AXIS_TIME_UNITS if middle >= u[0]), AXIS_TIME_UNITS[-1])
        if is_time
        else AXIS_TIME_UNITS[0]
    )
    smallest = (
        9e-4 if is_time else 0.09
    )  # An axis with a smaller number, or one from 1e4 on, has powers of ten.
    values = [tick / scale for tick in ticks]
    is_plain = not log or all(smallest < value < 1e4 for value in values)
    texts = [f"{value:.6g}" if is_plain or value == 1.0 else format_tolerance(value) for value in values]
    return title.replace("[s]", f"[{unit}]"), texts


def _mask_undrawable_points(curve: Curve, figure: Figure) -> list[tuple[float, float]]:
    """Return the points of a curve; points that the axes cannot show become nan, so that the line has a gap there.

    These are points that are not finite, or not positive on a logarithmic axis.
    """
    points = []
    for x, y in zip(curve.x, curve.y, strict=True):
        is_shown = all(
            math.isfinite(v) and (v > 0.0 or not log) for v, log in ((x, figure.x_log), (y, figure.y_log))
        )
        points.append((x, y) if is_shown else (math.nan, math.nan))
    return points


def _draw_figure(axes: Any, figure: Figure) -> list[tuple[Curve, list[tuple[float, float]], Any, Any]]:
    """Draw curves, tolerances, floor and axes of a figure without colours.

    Return (curve, points, line, band) for each curve that has a point; the band is None if the curve has no band.
    """
    curves = [(c, points) for c in figure.curves for points in [_mask_undrawable_points(c, figure)]]
    curves = [(c, points) for c, points in curves if any(not math.isnan(y) for _, y in points)]
    drawn = [p for _, points in curves for p in points if not math.isnan(p[1])]
    bands = [v for c, _ in curves for v in (*c.low, *c.high) if math.isfinite(v)]
    x_limits = choose_limits([x for x, _ in drawn], figure.x_log)
    y_limits = choose_limits([*(y for _, y in drawn), *bands], figure.y_log)
    axes.set_xscale("log" if figure.x_log else "linear")
    axes.set_yscale("log" if figure.y_log else "linear")
    for axis, limits, log, title in (
        (axes.xaxis, x_limits, figure.x_log, figure.x_title),
        (axes.yaxis, y_limits, figure.y_log, figure.y_title),
    ):
        ticks = choose_ticks(limits, log)
        text, labels = label_axis(title, limits, ticks, log)
        axis.set_label_text(text, parse_math=False)
        axis.set_ticks(ticks, labels=labels)
    axes.minorticks_off()
    artists = []
    for c, points in curves:
        x, y = map(list, zip(*points, strict=True))
        if c.steps:  # Extend the last step to the end of the axis.
            x, y = [*x, x_limits[1]], [*y, y[-1]]
        (line,) = axes.plot(
            x, y, label=_shorten_label(c.label), drawstyle="steps-post" if c.steps else "default"
        )
        band = axes.fill_between(c.x, c.low, c.high) if c.low else None
        artists.append((c, points, line, band))
    axes.set(xlim=x_limits, ylim=y_limits)
    tolerances = [tolerance for tolerance in figure.tolerances if y_limits[0] <= tolerance <= y_limits[1]]
    has_floor = figure.roundoff_floor > 0.0 and y_limits[0] <= figure.roundoff_floor <= y_limits[1]
    for tolerance in tolerances:
        axes.axhline(tolerance, color="0.8", linewidth=0.6, zorder=0, gid="@ l")
    if has_floor:
        style: dict[str, Any] = {"color": "0.35", "linewidth": 1.0, "linestyle": (0, (1, 1))}
        axes.axhline(figure.roundoff_floor, label="floor of float64", zorder=0, gid="@ f", **style)
    return artists


def _shorten_label(text: str, most: int = MAX_TITLE_LENGTH) -> str:
    """Cut a text, and begin it with a thin space if matplotlib would hide it (a label that begins with _)."""
    text = text if len(text) <= most else text[: most - 1] + "…"
    return "\u2009" + text if text.startswith("_") else text


def _create_canvas(size: tuple[float, float], **more: Any) -> Any:
    """Create an empty drawing, `size` in inches, without pyplot and its global state."""
    require_packages("a figure", "matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    canvas = Canvas(figsize=size, **more)
    FigureCanvasAgg(canvas)
    return canvas


# -- files ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CurveStyle:
    """Colour, dash and mark of a solver, as matplotlib names them."""

    color: str
    dash: str
    marker: str


# Solvers that get the first styles, so that solvers that are often compared have different colours. The last two share
# the colour of a solver with which they are rarely drawn.
FIRST_SOLVERS = (
    *("auto", "direct", "newton", "anderson", "nncg", "osqp", "pgs", "sequential_impulses"),
    *("jacobi", "admm"),
)


def assign_styles(solvers: Iterable[str]) -> dict[str, CurveStyle]:
    """Return a style for each solver.

    The style of a built-in solver is fixed by its place in `FIRST_SOLVERS`, followed by the other names in
    alphabetical order. Plug-ins get the colours of `PLUG_IN_COLORS` in alphabetical order.
    """
    names = set(solvers)
    own = {name for name in registry.specs() if not is_plug_in(name)}
    groups = (
        (COLORS, (*FIRST_SOLVERS, *sorted(own - set(FIRST_SOLVERS)))),
        (PLUG_IN_COLORS, sorted(names - own)),
    )
    return {
        name: CurveStyle(
            colors[i % len(colors)], DASHES[i // len(colors) % len(DASHES)], MARKERS[i % len(MARKERS)]
        )
        for colors, order in groups
        for i, name in enumerate(order)
        if name in names
    }


def number_styles(names: Sequence[str]) -> dict[str, CurveStyle]:
    """Return a style for each curve of a figure without solvers, in their order; eight names have different colours."""
    return {
        name: CurveStyle(
            COLORS[i % len(COLORS)], DASHES[i // len(COLORS) % len(DASHES)], MARKERS[i % len(MARKERS)]
        )
        for i, name in enumerate(names)
    }


def plot_figure(
    figure: Figure, styles: Mapping[str, CurveStyle], size: tuple[float, float] = (7.6, 4.6)
) -> Any:
    """Draw a figure for a file, `size` in inches.

    The legend is to the right of the axes; without a title it takes the title's place above the axes.
    """
    canvas = _create_canvas(size)
    entries = len(figure.curves) + (figure.roundoff_floor > 0.0)
    rows = -(-entries // LEGEND_COLUMNS) + bool(figure.left_out)
    right, top = (2.05, 0.41) if figure.title else (0.15, 0.17 * rows + 0.1)
    # The axes have a fixed position: fitting it to the labels would take longer than drawing the figure.
    width, height = 1.0 - (0.76 + right) / size[0], 1.0 - (0.6 + top) / size[1]
    axes = canvas.add_axes((0.76 / size[0], 0.6 / size[1], width, height))
    _draw_styled(axes, figure, styles)
    place: dict[str, Any] = {"loc": "center left", "bbox_to_anchor": (1.01, 0.5)}
    if not figure.title:
        place = {
            "loc": "lower center",
            "bbox_to_anchor": (0.5, 1.0),
            "ncols": LEGEND_COLUMNS,
            "borderpad": 0.2,
        }
    if figure.left_out:
        drawn = len({c.solver for c in figure.curves})
        place |= {"title": f"{drawn} of {drawn + len(figure.left_out)} solvers", "title_fontsize": 7}
    if axes.get_legend_handles_labels()[0]:
        _escape_dollars_in_legend(axes.legend(fontsize=7, frameon=False, handlelength=3, **place))
    return canvas


def plot_panels(figures: Sequence[Figure], styles: Mapping[str, CurveStyle]) -> Any:
    """Draw figures of the same quantities, three in a row, with one legend.

    In an SVG a curve has the id SOLVER--PANEL, and the legend `legend`.
    """
    rows = -(-len(figures) // 3)
    canvas = _create_canvas((10.0, 3.1 * rows), layout="constrained")
    places = list(canvas.subplots(rows, 3, squeeze=False).flat)
    for axes in places:
        axes.set_axis_off()
    entries: dict[str, Any] = {}
    for i, (axes, figure) in enumerate(zip(places, figures, strict=False)):
        axes.set_axis_on()
        _draw_styled(axes, figure, styles)
        axes.tick_params(labelsize=7)
        axes.xaxis.label.set_size(7)
        axes.yaxis.label.set_size(7)
        for line in axes.get_lines():
            line.set_gid(f"{line.get_label()}--{i}")
        entries |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    legend = canvas.legend(
        entries.values(), entries.keys(), fontsize=6, frameon=False, loc="outside right upper"
    )
    _escape_dollars_in_legend(legend).set_gid("legend")
    return canvas


def _draw_styled(axes: Any, figure: Figure, styles: Mapping[str, CurveStyle]) -> None:
    """Draw a figure with the colours, dashes and marks of its solvers, and with its title."""
    # Figures with bands summarise cases, so points are not single runs.
    has_bands = any(c.low for c in figure.curves)
    for c, points, line, band in _draw_figure(axes, figure):
        style = styles[c.solver]
        line.set(
            color=style.color, linestyle="none" if c.points else style.dash, linewidth=0.8 if c.thin else 1.5
        )
        if not (c.steps or c.unmarked or has_bands or len(points) > MAX_MARKED_POINTS):
            face = "none" if c.thin or c.points else style.color
            line.set(
                marker=style.marker, markersize=8 if c.points and len(c.x) == 1 else 4, markerfacecolor=face
            )
        if band is not None:
            band.set(color=style.color, alpha=0.15, linewidth=0.0)
    axes.set_title(_shorten_label(figure.heading), fontsize=10, parse_math=False)


def _escape_dollars_in_legend(legend: Any) -> Any:
    """Show dollars in the names of a legend; matplotlib would read a formula between them."""
    for text in legend.get_texts():
        text.set_parse_math(False)
    return legend


def save_figures(
    figures: Iterable[Figure], folder: Path, styles: Mapping[str, CurveStyle], leaders: Sequence[str] = ()
) -> None:
    """Write each figure as NAME.svg and NAME.png. If `leaders` are given, only they have bands."""
    for figure in figures:
        curves = (
            c if not leaders or c.solver in leaders else replace(c, low=(), high=()) for c in figure.curves
        )
        canvas = plot_figure(replace(figure, curves=tuple(curves)), styles)
        path = make_folder(folder) / make_file_name(figure.name)
        write_figure(canvas, path.with_name(path.name + ".svg"), metadata={"Date": None})
        write_figure(canvas, path.with_name(path.name + ".png"), dpi=110, metadata={"Software": None})


# -- within a page ---------------------------------------------------------------------------------------------

WIDTH, HEIGHT = 1000, 640  # [units] Size of a drawing in a page, about two units per pixel of a phone.
PAGE_WIDTH = 1900  # [units] Width of a drawing that is as wide as the page on a screen.
LEFT, TOP, BOTTOM = 118, 62, 92  # [units] Margins for the labels of the axes.
MIN_RIGHT = 60  # [units] Smallest right margin: half of the last number of the horizontal axis.
NAME_INDENT = 24  # [units] Distance of the names of curves from the axes.
NAME_CHARACTER_WIDTH = 13.5  # [units] Mean width of a character of a name, on a phone.
# A drawing with more curves shows only the names of leaders, and of the curve near the pointer.
MAX_SHOWN_NAMES = 8
FONT_SIZE = 22  # [units] The page's style sheet has the same size.
TITLE_CHARACTER_WIDTH = 15  # [units] Mean width of a character of a title with the largest font, on a phone.
TITLE_LINE_HEIGHT = 32  # [units] Height of one line of a title.
TITLE_MARGIN = 8  # [units] Distance between the figure's title and the title of the vertical axis.
MIN_NAME_DISTANCE = 30  # [units] Smallest distance between two names of leaders.
SVG = "{http://www.w3.org/2000/svg}"


def plot_for_page(
    figure: Figure,
    number: Mapping[str, int],
    leaders: Sequence[str] = (),
    title: str | None = None,
    width: int = WIDTH,
) -> str:
    """Draw a figure as SVG text for a page. A title that is too long for one line has several.

    Parameters
    ----------
    figure : Figure
    number : solver -> number
        Class of a solver's curves on the page: s0, s1, ...
    leaders : sequence of solvers
        The page shows their names at the ends of their curves, at a distance from each other.
    title : str, optional
        Replaces the figure's heading, which may repeat a heading of the page.
    width : int
        Width of the drawing in its own units.
    """
    canvas = _create_canvas((width / 72.0, HEIGHT / 72.0), dpi=72)  # One unit is one pixel.
    labels = [_shorten_label(c.label, MAX_NAME_LENGTH) for c in figure.curves if _has_name(c)]
    margin = round(NAME_INDENT + NAME_CHARACTER_WIDTH * max(map(len, labels), default=0))
    right, bottom = width - max(margin, MIN_RIGHT), HEIGHT - BOTTOM
    axes = canvas.add_axes(
        (LEFT / width, BOTTOM / HEIGHT, (right - LEFT) / width, (bottom - TOP) / HEIGHT), frame_on=False
    )
    axes.grid(True)
    axes.tick_params(length=0, pad=10, labelsize=FONT_SIZE)
    artists = _draw_figure(axes, figure)
    _mark_elements_for_svg(axes, figure)
    to_units = axes.transData.transform
    places = {
        i: [(x, HEIGHT - y) for x, y in to_units([p for p in points if not math.isnan(p[1])])]
        for i, (_, points, _, _) in enumerate(artists)
    }
    curves = [c for c, *_ in artists]
    shows_all_names = sum(map(_has_name, curves)) <= MAX_SHOWN_NAMES
    shown_names = [c.solver for c in curves] if shows_all_names else leaders
    names = _place_curve_names(curves, places, shown_names, right)
    for i, (_, _, line, band) in enumerate(artists):
        line.set(gid=f"@{i} line", zorder=4 + i)
        if band is not None:
            band.set(gid=f"@{i} b", zorder=4 + i)
        if i in names:
            x, y = names[i]
            axes.text(
                x / width, 1.0 - y / HEIGHT, "x", transform=canvas.transFigure, gid=f"@{i} name", zorder=4 + i
            )
    heading = figure.heading if title is None else title
    lines = textwrap.wrap(heading, (width - LEFT) // TITLE_CHARACTER_WIDTH) or [""]
    above = TITLE_MARGIN + TITLE_LINE_HEIGHT * (len(lines) - 1)
    text = "".join(
        f'<text class="t" x="{LEFT}" y="{24 + TITLE_LINE_HEIGHT * i - above}">{escape(line)}</text>'
        for i, line in enumerate(lines)
    )
    is_time = "".join(str(int("[s]" in text)) for text in (figure.x_title, figure.y_title))
    head = (
        f'<svg class="chart" viewBox="0 {-above} {width} {HEIGHT + above}" role="img"'
        f' aria-label="{escape(figure.title)}"'
        f' data-x="{_describe_axis(axes.get_xlim(), figure.x_log, LEFT, right)}"'
        f' data-y="{_describe_axis(axes.get_ylim(), figure.y_log, bottom, TOP)}" data-t="{is_time}">'
        f"{text}"
    )
    return "".join([head, *_rewrite_svg(canvas, curves, number, shows_all_names), "</svg>"])


def _has_name(curve: Curve) -> bool:
    """Return whether a page shows the name of a curve; a thin curve belongs to another one that has the name."""
    return curve.points or not curve.thin


def _mark_elements_for_svg(axes: Any, figure: Figure) -> None:
    """Mark grid, ticks, titles of axes and floor for `_rewrite_svg`; the title of the vertical axis is above it."""
    for tick in (*axes.xaxis.get_major_ticks(), *axes.yaxis.get_major_ticks()):
        tick.gridline.set_gid("@ g")
        tick.label1.set_gid("@ a")
    axes.xaxis.label.set(gid="@ a", size=FONT_SIZE)
    axes.xaxis.labelpad = 18
    place = {"transform": axes.transAxes, "size": FONT_SIZE, "gid": "@ a"}
    axes.text(0.0, 1.0 + 8.0 / (HEIGHT - TOP - BOTTOM), axes.get_ylabel(), parse_math=False, **place)
    axes.set_ylabel("")
    low, high = axes.get_ylim()
    if low <= figure.roundoff_floor <= high:
        place["transform"] = axes.get_yaxis_transform()
        axes.text(0.99, figure.roundoff_floor, "floor", ha="right", va="bottom", **place)


def _describe_axis(limits: tuple[float, float], log: bool, first: int, last: int) -> str:
    """Return the numbers that convert a coordinate to a value: scale, its ends, and their coordinates."""
    low, high = map(math.log10, limits) if log else limits
    return f"{int(log)} {low:.4f} {high:.4f} {first} {last}"


def _place_curve_names(
    curves: Sequence[Curve],
    places: Mapping[int, Sequence[tuple[float, float]]],
    shown: Sequence[str],
    edge: float,
) -> dict[int, tuple[float, float]]:
    """Return the positions of the names of curves, to the right of the axes, where they cover no point.

    A name is at the height of the end of its curve, with a distance between the names of the solvers in `shown`. If a
    curve is drawn as points without a line, the names are a list from the top.

    Parameters
    ----------
    curves : curves
    places : number of a curve -> its points [units]
    shown : solvers whose names are shown without a pointer
    edge : right end of the axes [units]
    """
    left = edge + NAME_INDENT / 2
    if any(c.points for c in curves):
        return {i: (left, TOP + FONT_SIZE + MIN_NAME_DISTANCE * i) for i in range(len(curves))}
    ends = {i: (left, places[i][-1][1] + 8.0) for i, c in enumerate(curves) if _has_name(c)}
    leading = sorted((i for i in ends if curves[i].solver in shown), key=lambda i: ends[i][1])
    for above, i in pairwise(leading):
        ends[i] = (ends[i][0], max(ends[i][1], ends[above][1] + MIN_NAME_DISTANCE))
    lowest = HEIGHT - BOTTOM - 2.0  # Lowest position of a name, above the numbers of the horizontal axis.
    for i in reversed(leading):
        ends[i] = (ends[i][0], min(ends[i][1], lowest))
        lowest = ends[i][1] - MIN_NAME_DISTANCE
    return ends


def _rewrite_svg(
    canvas: Any, curves: Sequence[Curve], number: Mapping[str, int], shows_all_names: bool
) -> Iterable[str]:
    """Yield the marked paths and texts of matplotlib's SVG, with classes in place of styles.

    The id of an artist is "@CURVE PART", or "@ PART" if it belongs to the axes. Parts of one curve become a group with
    its name and the budgets or tolerances of its points. All other elements (background, empty ticks, definitions,
    metadata) are left out.
    """
    from matplotlib import rc_context

    stream = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "lavender", "path.simplify": False}):
        canvas.savefig(stream, format="svg", metadata={"Date": None})
    marked: dict[str, list[tuple[str, ElementTree.Element]]] = {}
    for group in ElementTree.fromstring(stream.getvalue()).iter(f"{SVG}g"):
        owner, _, kind = group.get("id", "").partition(" ")
        if owner.startswith("@"):
            marked.setdefault(owner, []).append((kind, group))
    parts = marked.pop("@", [])
    for kind in ("g", "l", "f"):
        if data := "".join(_format_path(group) for own, group in parts if own == kind):
            yield f'<path class="{kind}" d="{data}"/>'
    for _, group in parts:
        yield from _rewrite_texts(group, ' class="a"')
    for owner, parts in marked.items():
        c = curves[int(owner[1:])]
        # Write "16" for "16 iterations": the page's script appends the word.
        notes = "|".join(note.removesuffix(" iterations") for note in c.notes)
        attribute = f' data-n="{escape(notes)}"' if notes else ""
        kinds = f"c s{number.get(c.solver, 0)}{' w' if c.thin else ''}{' k' if shows_all_names else ''}"
        yield f'<g class="{kinds}" data-l="{escape(c.label)}"{attribute}>'
        for kind, group in parts:
            data = _format_path(group)
            if kind == "b":
                yield f'<path class="b" d="{data}Z"/>'
            elif kind == "line":
                if not c.points:
                    yield f'<path d="{data}"/>'
                if c.points or not (c.unmarked or c.steps or c.low or len(c.x) > MAX_PAGE_DOTS):
                    dots = re.sub(r"[ML](\S+ \d+)", r"M\1h0", data)
                    single = " o" if c.points and len(c.x) == 1 else ""
                    yield f'<path class="d{single}" d="{dots}"/>'
            yield from _rewrite_texts(group, "", _shorten_label(c.label, MAX_NAME_LENGTH))
        yield "</g>"


def _format_path(group: ElementTree.Element) -> str:
    """Return the data of the paths of a group, in whole units."""
    commands = (re.findall(r"([ML]) (\S+) (\S+)", path.get("d", "")) for path in group.iter(f"{SVG}path"))
    return "".join(f"{name}{round(float(x))} {round(float(y))}" for some in commands for name, x, y in some)


def _rewrite_texts(group: ElementTree.Element, attributes: str, replacement: str = "") -> Iterable[str]:
    """Yield the texts of a group in whole units; `replacement` replaces each text."""
    for text in group.iter(f"{SVG}text"):
        style = text.get("style", "")
        anchor = "".join(f' text-anchor="{a}"' for a in ("middle", "end") if f"text-anchor: {a}" in style)
        x, y = (round(float(text.get(name, "0"))) for name in "xy")
        yield f'<text{attributes} x="{x}" y="{y}"{anchor}>{escape(replacement or text.text or "")}</text>'
