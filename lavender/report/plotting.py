"""Draw figures with matplotlib, as SVG files and within a page.

A solver of lavender has the same colour and dash in all reports. The colours are from Okabe and Ito (distinct under
the common colour-vision deficiencies); dashes distinguish solvers that share a colour, also in grey print. Plug-ins
have colours of their own. The style sheet of a page replaces black and grey by the colours of its theme.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from lavender.base.errors import require_packages
from lavender.io.stored import make_folder, write_text
from lavender.report.figures import Curve, Figure
from lavender.report.records import format_tolerance, make_file_name
from lavender.solvers import registry

SOLVER_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#A0803A", "#7F7F7F")
PLUG_IN_COLORS = ("#000000", "#B000B0", "#C03040")  # No solver of lavender has one of these colours.
DASHES = ("-", "--", ":", "-.")  # Line styles of matplotlib.
MARKERS = ("o", "s", "^", "D", "X", "*", "v")
GREY = "#b0b0b0"  # Grid and tolerances.
# [inches] Size of a figure without its legend; legible on a phone and on half of a screen.
WIDTH, HEIGHT = 5.6, 3.9
LEFT, RIGHT, TOP, BOTTOM = 0.75, 0.12, 0.3, 0.5  # [inches] Margins of the axes.
LEGEND_ROW_HEIGHT = 0.21  # [inches]
LEGEND_COLUMNS = 2
MAX_NAME_LENGTH = 34  # [characters] Longer names in a legend are cut.
MAX_TITLE_LENGTH = 62  # [characters] Longer titles are cut.
# Solvers that get the first styles, so that solvers that are often compared have different colours.
FIRST_SOLVERS = (
    *("auto", "direct", "newton", "anderson", "nncg", "osqp", "pgs", "sequential_impulses"),
    *("jacobi", "admm"),
)


@dataclass(frozen=True)
class CurveStyle:
    """Colour, dash and mark of a solver, as matplotlib names them."""

    color: str
    dash: str
    marker: str


def number_styles(names: Sequence[str], colors: Sequence[str] = SOLVER_COLORS) -> dict[str, CurveStyle]:
    """Return a style for each name, in their order; names of different colours come first, then other dashes."""
    return {
        name: CurveStyle(
            colors[i % len(colors)], DASHES[i // len(colors) % len(DASHES)], MARKERS[i % len(MARKERS)]
        )
        for i, name in enumerate(names)
    }


def assign_styles(solvers: Iterable[str]) -> dict[str, CurveStyle]:
    """Return a style for each solver.

    The style of a built-in solver is fixed by its place in `FIRST_SOLVERS`, followed by the other names in
    alphabetical order. Plug-ins get the colours of `PLUG_IN_COLORS` in alphabetical order.
    """
    names = set(solvers)
    own = {name for name, spec in registry.specs().items() if spec.builtin}
    styles = number_styles([*FIRST_SOLVERS, *sorted(own - set(FIRST_SOLVERS))])
    styles |= number_styles(sorted(names - own), PLUG_IN_COLORS)
    return {name: style for name, style in styles.items() if name in names}


def plot_figure(figure: Figure, styles: Mapping[str, CurveStyle]) -> Any:
    """Draw a figure with its legend below the axes.

    Points that the axes cannot show are gaps: not finite, or not positive on a logarithmic axis. Lines have the id
    SOLVER--NUMBER in an SVG.
    """
    require_packages("a figure", "matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    below = LEGEND_ROW_HEIGHT * -(-sum(bool(c.label) for c in figure.curves) // LEGEND_COLUMNS)
    height = HEIGHT + below
    canvas = Canvas(figsize=(WIDTH, height))
    FigureCanvasAgg(canvas)
    canvas.patch.set_visible(False)
    # The axes have a fixed position: fitting it to the labels would take longer than drawing the figure.
    axes = canvas.add_axes(
        (LEFT / WIDTH, (BOTTOM + below) / height, 1.0 - (LEFT + RIGHT) / WIDTH, (HEIGHT - TOP - BOTTOM) / height),
        facecolor="none", xscale="log" if figure.x_log else "linear", yscale="log" if figure.y_log else "linear",
    )  # fmt: skip
    for i, c in enumerate(figure.curves):
        _draw_curve(axes, figure, c, styles[c.solver], f"{c.solver}--{i}")
    low, high = axes.get_ylim()
    for tolerance in figure.tolerances:
        if low <= tolerance <= high:
            axes.axhline(tolerance, color=GREY, linewidth=0.8, zorder=0)
    for axis, is_log in ((axes.xaxis, figure.x_log), (axes.yaxis, figure.y_log)):
        if is_log:
            axis.set_major_formatter(lambda x, _: f"{x:g}" if 0.1 <= x < 1e4 else format_tolerance(x))
            axis.set_minor_formatter(lambda x, _: "")
    axes.grid(True, color=GREY, linewidth=0.4, alpha=0.4)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(_shorten(figure.title, MAX_TITLE_LENGTH), fontsize=10, loc="left", parse_math=False)
    axes.set_xlabel(figure.x_title, parse_math=False)
    axes.set_ylabel(figure.y_title, parse_math=False)
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        legend = canvas.legend(
            handles, labels, loc="lower left", bbox_to_anchor=(0.1, 0.0), ncols=LEGEND_COLUMNS, fontsize=9,
            frameon=False, borderpad=0.0, labelspacing=0.35,
        )  # fmt: skip
        for text in legend.get_texts():
            text.set_parse_math(False)  # A name with two dollars is not a formula.
    return canvas


def _draw_curve(axes: Any, figure: Figure, c: Curve, style: CurveStyle, gid: str) -> None:
    """Draw one curve with its band."""
    logs, points = (figure.x_log, figure.y_log), []
    for point in zip(c.x, c.y, strict=True):
        shown = all(math.isfinite(v) and (v > 0.0 or not log) for v, log in zip(point, logs, strict=True))
        points.append(point if shown else (math.nan, math.nan))
    x, y = zip(*points, strict=True) if points else ((), ())
    has_marks = c.points or len(x) == 1 or not (c.unmarked or c.steps)
    (line,) = axes.plot(
        x, y, label=_shorten(c.label, MAX_NAME_LENGTH) if c.label else "_", color=style.color,
        linestyle="none" if c.points else "--" if c.thin else style.dash, linewidth=1.0 if c.thin else 1.7,
        marker=style.marker if has_marks else "", markersize=4.5, drawstyle="steps-post" if c.steps else "default",
    )  # fmt: skip
    line.set_gid(gid)
    if c.low:
        axes.fill_between(c.x, c.low, c.high, color=style.color, alpha=0.15, linewidth=0.0)


def _shorten(text: str, longest: int) -> str:
    """Cut a text, and begin it with a thin space if matplotlib would hide it (a label that begins with _)."""
    text = text if len(text) <= longest else text[: longest - 1] + "…"
    return "\u2009" + text if text.startswith("_") else text


def render_svg(figure: Figure, styles: Mapping[str, CurveStyle]) -> str:
    """Return a figure as the text of an SVG file, with texts as texts."""
    canvas, text = plot_figure(figure, styles), io.StringIO()
    from matplotlib import rc_context

    with rc_context({"svg.fonttype": "none", "svg.hashsalt": figure.name}):
        canvas.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()


def embed_svg(figure: Figure, svg: str) -> str:
    """Return a figure of a page: the SVG as matplotlib wrote it, with its alternative text."""
    alt = escape(figure.description)
    note = f'<figcaption class="quiet">{escape(figure.note)}</figcaption>' if figure.note else ""
    return f'<figure class="chart"><div role="img" aria-label="{alt}">{svg[svg.index("<svg") :]}</div>{note}</figure>'


def draw_figures(
    figures: Sequence[Figure], styles: Mapping[str, CurveStyle], folder: Path | None = None
) -> list[str]:
    """Return the figures for a page; with `folder`, also write each as NAME.svg."""
    drawn = []
    for figure in figures:
        svg = render_svg(figure, styles)
        if folder is not None:
            write_text(make_folder(folder) / f"{make_file_name(figure.name)}.svg", svg)
        drawn.append(embed_svg(figure, svg))
    return drawn
