"""Compute the points of the figures of a report, and draw figures with matplotlib, as SVG files and within a page.

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
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import require_packages
from lavender.io.stored import make_folder, write_text
from lavender.report.text import format_count, format_tolerance, make_file_name
from lavender.solvers import registry

Points: TypeAlias = Sequence[float] | FloatArray
Style: TypeAlias = dict[str, Any]  # Colour, dash and mark of a solver, as arguments of matplotlib.

if TYPE_CHECKING:
    from lavender.report.tables import Contents

MIN_RESIDUAL = 1e-17  # A residual of exactly zero is drawn here.
MAX_CURVES = 6  # Largest number of solvers in a figure, without plug-ins; more are hard to distinguish.
GRID_SIZE = 49  # Number of points on the horizontal axis at which the residuals of all cases are evaluated.
MAX_SEQUENCES = 4  # Largest number of sequences that have a figure.
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
FLAT_LINES_NOTE = (
    "A curve is flat after the last run of its solver, which ended at a tolerance (grey lines) or after a fixed "
    "number of iterations. A curve below an equal one is drawn wider."
)
EQUAL_RATIO = 1.1  # Points of two curves whose values differ by a smaller factor cover each other.
EQUAL_SHARE = 0.25  # A curve covers another if this fraction of their common points do.
COVERED_WIDTH = 2.2  # [points] A curve is drawn wider by this width for each later curve that covers it.


@dataclass(frozen=True)
class Curve:
    """A line of a figure. A residual of zero is drawn at `MIN_RESIDUAL`; nan and inf are gaps."""

    solver: str
    label: str
    x: Points
    y: Points
    thin: bool = False  # Drawn thin and dashed: a cold start, or a fit.
    steps: bool = False  # A step function.
    points: bool = False  # Points without a line.
    unmarked: bool = False  # No marks at the points of the line.
    low: Points = ()  # Edges of a band about the line, as `y`; empty without a band.
    high: Points = ()


@dataclass(frozen=True)
class Figure:
    """Titles, scales and curves of a diagram; `name` is its file name without suffix."""

    name: str
    title: str
    x_title: str
    y_title: str
    curves: Sequence[Curve]
    x_log: bool = True
    y_log: bool = True
    tolerances: Sequence[float] = ()  # Horizontal lines.
    note: str = ""  # A sentence that explains the curves.

    @property
    def description(self) -> str:
        """Alternative text: the title, the axes and the names of the curves."""
        names = ", ".join(dict.fromkeys(c.label for c in self.curves))
        return f"{self.title}. {self.y_title} against {self.x_title}. Curves: {names}."


def build_figures(report: Contents) -> list[Figure]:
    """Build the figures of a report that have a curve; none for a campaign, which has no times."""
    if report.is_campaign or not len(report.frame):
        return []
    figures = [build_overall_figure(report), build_cost_figure(report)]
    sequences = [name for name in report.frame["sequence"].unique() if name][:MAX_SEQUENCES]
    figures += [build_sequence_figure(report, name) for name in sequences]
    return [figure for figure in figures if figure.curves]


def select_drawn_solvers(report: Contents, cases: Iterable[str] | None = None) -> list[str]:
    """Select the solvers that figures of some cases show: the first `MAX_CURVES` of the ranking, and all plug-ins."""
    from lavender.report.tables import is_plug_in, rank_solvers

    ranking = [str(name) for name in rank_solvers(report, report.tolerance, cases).index]
    plug_ins = [name for name in ranking if is_plug_in(name)]
    return [*[name for name in ranking if name not in plug_ins][:MAX_CURVES], *plug_ins]


def build_overall_figure(report: Contents, name: str = "error-against-time", law: str = "") -> Figure:
    """Plot the residual that each solver has reached by a time: median over the cases, and a band of the quartiles.

    A case without a result by that time counts with residual 1, as the zero impulse. Cases are single problems from a
    cold start; if there are only sequences, each step is a case. With `law`, its cases and all solvers are drawn.
    """
    from lavender.report.tables import select_starts

    frame = report.frame[report.frame["law"] == law] if law else report.frame
    single = frame["step"] < 0
    frame = frame[single] if single.any() else frame
    runs = select_starts(frame)
    runs = runs[np.isfinite(runs["relative"]) & (runs["time"] > 0.0)]
    if not len(runs):
        return Figure(name, "", "", "", ())
    cases, curves = list(frame["case"].unique()), list[Curve]()
    grid = np.geomspace(runs["time"].min(), runs["time"].max(), GRID_SIZE)
    place = np.minimum(np.searchsorted(grid * (1.0 + 1e-9), runs["time"]), GRID_SIZE - 1)
    runs = runs.assign(
        place=place, number=runs["case"].map({case: i for i, case in enumerate(cases)}).astype(int)
    )
    for solver in sorted(runs["solver"].unique()) if law else select_drawn_solvers(report, cases):
        own, reached = runs[runs["solver"] == solver], np.ones((len(cases), GRID_SIZE))
        np.minimum.at(reached, (own["number"], own["place"]), own["relative"].clip(MIN_RESIDUAL))
        reached = np.minimum.accumulate(reached, axis=1)
        low, middle, high = np.quantile(reached, (0.25, 0.5, 0.75), axis=0, method="inverted_cdf")
        first = int(np.argmax(middle < 1.0))  # From here on, half of the cases have a result.
        if middle[first] >= 1.0:
            continue
        n = own["case"].nunique()
        label = str(solver) if n == len(cases) else f"{solver} ({n} of {len(cases)} cases)"
        band = {"low": low[first:], "high": high[first:]} if not curves and not law and len(cases) > 1 else {}
        line = Curve(
            str(solver), label, grid[first:], middle[first:], steps=len(cases) == 1, unmarked=True, **band
        )
        curves.append(line)
    over, note = "", FLAT_LINES_NOTE
    if len(cases) > 1:
        over = f", median over {format_count(len(cases), 'case' if single.any() else 'step')}"
        note = f"The band holds the middle half of the cases. A case without a result counts as 1. {note}"
    return Figure(name, f"Error against time{over}", "time of a call [s]", "relative residual [-]", curves,
                  tolerances=report.tolerances, note=note)  # fmt: skip


def build_cost_figure(report: Contents) -> Figure:
    """Plot the time to the middle tolerance against the number of rows, with the fitted power of each solver."""
    from lavender.report.tables import tabulate_costs

    times, curves = report.get_times(report.tolerance), list[Curve]()
    drawn = select_drawn_solvers(report)
    for fit in tabulate_costs(report).to_dict("records"):
        if (solver := fit["solver"]) in drawn:
            own = times.loc[solver].dropna()
            rows, exponent = report.cases.loc[own.index, "rows"].to_numpy(float), fit["exponent of rows"]
            ends = np.array([rows[rows > 0].min(), rows.max()])
            line = fit["fit at 1000 rows [s]"] * (ends / 1000.0) ** exponent
            curves.append(Curve(solver, f"{solver}, rows^{exponent:.2f}", ends, line, unmarked=True))
            curves.append(Curve(solver, "", rows, own.to_numpy(), points=True))
    title = f"Time to {format_tolerance(report.tolerance)} against the number of rows"
    note = "Each point is a case; a line is the power of the number of rows that fits a solver's points best."
    return Figure("cost-against-rows", title, "rows", "time of a call [s]", curves, note=note)


def build_sequence_figure(report: Contents, name: str) -> Figure:
    """Plot the time of all steps so far of a sequence to the middle tolerance, carried and cold (thin)."""
    runs = report.frame[(report.frame["sequence"] == name) & (report.frame["mode"] == "tol")]
    curves: list[Curve] = []
    for solver in select_drawn_solvers(report, runs["case"].unique()) if len(runs) else ():
        own = runs[(runs["solver"] == solver) & (runs["tol"] <= report.tolerance)]
        own = own[own["tol"] == own["tol"].max()].sort_values("step")
        for start in ("carried", "cold"):
            some = own[own["start"] == start]
            if len(some):
                cold = start == "cold" and bool((own["start"] == "carried").any())
                times, label = some["time"].cumsum().to_numpy(), f"{solver} (cold)" if cold else solver
                curves.append(Curve(solver, label, some["step"].to_numpy(), times, thin=cold, unmarked=True))
    title = f"{name}: time of all steps so far, to {format_tolerance(report.tolerance)}"
    note = "Solid: impulses carried from step to step. Dashed: cold."
    y_title = "time of all steps so far [s]"
    return Figure(f"sequence-{name}", title, "step", y_title, curves, x_log=False, note=note)


# -- drawing -----------------------------------------------------------------------------------------------


def number_styles(names: Sequence[str], colors: Sequence[str] = SOLVER_COLORS) -> dict[str, Style]:
    """Return a style for each name, in their order; names of different colours come first, then other dashes."""
    return {
        name: {"color": colors[i % len(colors)], "linestyle": DASHES[i // len(colors) % len(DASHES)],
               "marker": MARKERS[i % len(MARKERS)]}
        for i, name in enumerate(names)
    }  # fmt: skip


def assign_styles(solvers: Iterable[str]) -> dict[str, Style]:
    """Return a style for each solver.

    The style of a built-in solver is fixed by its place in `FIRST_SOLVERS`, followed by the other names in
    alphabetical order. Plug-ins get the colours of `PLUG_IN_COLORS` in alphabetical order.
    """
    names = set(solvers)
    own = {name for name, spec in registry.specs().items() if spec.builtin}
    styles = number_styles([*FIRST_SOLVERS, *sorted(own - set(FIRST_SOLVERS))])
    styles |= number_styles(sorted(names - own), PLUG_IN_COLORS)
    return {name: style for name, style in styles.items() if name in names}


def count_covering_curves(curves: Sequence[Curve], i: int) -> int:
    """Return the number of later curves that cover curve i, so that it would not be seen."""
    own, n = dict(zip(curves[i].x, curves[i].y, strict=True)), 0
    for other in () if curves[i].points else curves[i + 1 :]:
        pairs = [(own[x], y) for x, y in zip(other.x, other.y, strict=True) if x in own and not other.points]
        n += sum(a <= EQUAL_RATIO * b and b <= EQUAL_RATIO * a for a, b in pairs) > EQUAL_SHARE * len(pairs)
    return n


def plot_figure(figure: Figure, styles: Mapping[str, Style]) -> Any:
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
        wider = COVERED_WIDTH * count_covering_curves(figure.curves, i)
        _draw_curve(axes, figure, c, styles[c.solver], wider, f"{c.solver}--{i}")
    low, high = axes.get_ylim()
    for tolerance in figure.tolerances:
        if low <= tolerance <= high:
            axes.axhline(tolerance, color=GREY, linewidth=0.8, zorder=0)
    for axis, is_log in ((axes.xaxis, figure.x_log), (axes.yaxis, figure.y_log)):
        if is_log:
            axis.set_major_formatter(lambda x, _: f"{x:g}" if 0.1 <= x < 1e4 else format_tolerance(x))
    axes.minorticks_off()
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


def _draw_curve(axes: Any, figure: Figure, c: Curve, style: Style, wider: float, gid: str) -> None:
    """Draw one curve with its band."""
    x, y = np.array(c.x, float), np.array(c.y, float)
    y = np.where(y == 0.0, MIN_RESIDUAL, y)
    shown = (
        np.isfinite(x) & np.isfinite(y) & ((x > 0.0) | (not figure.x_log)) & ((y > 0.0) | (not figure.y_log))
    )
    has_marks = c.points or len(x) == 1 or not (c.unmarked or c.steps)
    style = style | ({} if has_marks else {"marker": ""})
    style |= {"linestyle": "none"} if c.points else {"linestyle": "--"} if c.thin else {}
    axes.plot(
        np.where(shown, x, math.nan), np.where(shown, y, math.nan), markersize=4.5, gid=gid, **style,
        linewidth=(1.0 if c.thin else 1.7) + wider, drawstyle="steps-post" if c.steps else "default",
        label=_shorten(c.label, MAX_NAME_LENGTH) if c.label else "_",
    )  # fmt: skip
    if len(c.low):
        axes.fill_between(c.x, c.low, c.high, color=style["color"], alpha=0.15, linewidth=0.0)


def _shorten(text: str, longest: int) -> str:
    """Cut a text, and begin it with a thin space if matplotlib would hide it (a label that begins with _)."""
    text = text if len(text) <= longest else text[: longest - 1] + "…"
    return "\u2009" + text if text.startswith("_") else text


def render_svg(figure: Figure, styles: Mapping[str, Style]) -> str:
    """Return a figure as the text of an SVG file, with texts as texts."""
    canvas, text = plot_figure(figure, styles), io.StringIO()
    from matplotlib import rc_context

    with rc_context({"svg.fonttype": "none", "svg.hashsalt": figure.name}):
        canvas.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()


def draw_figure(figure: Figure, styles: Mapping[str, Style], folder: Path | None = None) -> str:
    """Return a figure for a page, with its alternative text; with `folder`, also write it as NAME.svg."""
    svg = render_svg(figure, styles)
    if folder is not None:
        write_text(make_folder(folder) / f"{make_file_name(figure.name)}.svg", svg)
    alt, svg = escape(figure.description), svg[svg.index("<svg") :]
    note = f'<figcaption class="quiet">{escape(figure.note)}</figcaption>' if figure.note else ""
    return f'<figure class="chart"><div role="img" aria-label="{alt}">{svg}</div>{note}</figure>'
