"""Draw figures for pages: inline SVG in the colours of the page, and PDF, SVG and PNG for papers.

Colours of series are hues of Okabe and Ito, darkened to a contrast of at least 5 on white; the style sheet of a page
replaces them, and the colours of text, grid and paper, by its theme. Figures are 4.7 to 4.9 inches wide, so that their
texts have at least 9 pixels on a phone. Lines have labels at their ends in place of a legend.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import require_packages
from lavender.io.stored import make_folder, write_bytes
from lavender.report.text import format_power, format_speed, make_file_name

INK, QUIET, GRID, PAPER = "#010101", "#6f6f6f", "#d8d8d8", "#fefefe"
BLUE, ORANGE, GREEN, PINK, OLIVE = SERIES = ("#0072b2", "#b34d00", "#007a58", "#a8487f", "#7a5f1e")
#: Colour of a figure -> variable of the style sheet.
THEME = {
    INK: "var(--ink)",
    QUIET: "var(--quiet)",
    GRID: "var(--line)",
    PAPER: "var(--paper)",
    **{color: f"var(--s{i})" for i, color in enumerate(SERIES)},
}
STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "lavender",
    "pdf.fonttype": 42,
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.labelsize": 9,
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "text.color": INK,
    "axes.labelcolor": QUIET,
    "axes.edgecolor": QUIET,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "xtick.minor.size": 0,
    "ytick.minor.size": 0,
    "grid.color": GRID,
    "grid.linewidth": 0.5,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
}
FILE_KINDS = ("pdf", "svg", "png")
MARKERS = "osD^vP"
MAX_LABEL_LENGTH = 28  # [characters] Longer labels are cut.
ERROR_COLORS = (
    (0.5, 0.5, 0.5, 0.09),
    (0.12, 0.47, 0.75, 0.28),
    (0.12, 0.47, 0.75, 0.58),
    (0.12, 0.47, 0.75, 1.0),
    (0.91, 0.47, 0.16, 1.0),
    (0.66, 0.22, 0.0, 1.0),
)


class FigureFolder(NamedTuple):
    """A folder of figures, and the formats in which they are written there, of `FILE_KINDS`."""

    path: Path
    kinds: Sequence[str] = FILE_KINDS


class Label(NamedTuple):
    """A text at the end of a line."""

    y: float
    text: str
    color: str
    weight: str = "normal"


def fit_margins(
    texts: Sequence[str], offset: float = 0.03, left_margin: float = 0.13
) -> dict[str, float]:
    """Return margins of a figure of `WIDTH` with the longest of some labels at the right of its axes."""
    longest = min(max(map(len, texts), default=0), MAX_LABEL_LENGTH)
    # Bold letters widen short labels relatively more.
    width = max(0.0165 * longest, 0.025 + 0.0155 * longest)
    return {"left": left_margin, "right": 1.0 - offset - width, "top": 0.95, "bottom": 0.15}


def style_line(i: int) -> dict[str, Any]:
    """Return colour, width, dash and mark of the line of place i: the first is thick, from the seventh on dashed."""
    color = (*SERIES, INK)[i] if i < 6 else QUIET
    return {
        "color": color,
        "linewidth": 1.4 if i else 2.4,
        "linestyle": "-" if i < 6 else "--",
        "marker": MARKERS[i % 6],
        "markersize": 4.5,
        "zorder": 3 if i else 5,
    }


def draw_figure(
    name: str,
    fill: Callable[..., str],
    size: tuple[float, float],
    margins: Mapping[str, float],
    *,
    note: str = "",
    folder: Path | FigureFolder | None = None,
    **subplots: Any,
) -> str:
    """Return a figure as HTML with an inline SVG; with `folder`, also write it there.

    Parameters
    ----------
    name : name of the files and prefix of ids
    fill : function that draws into the axes and returns a description with the numbers of the figure
    size : (2,) inches
    margins : arguments of `Figure.subplots_adjust`
    note : caption
    folder : Path or FigureFolder, optional
    **subplots : arguments of `Figure.subplots`
    """
    require_packages("a figure", "matplotlib")
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure(figsize=size)
        FigureCanvasAgg(figure)
        axes = figure.subplots(**subplots)
        figure.subplots_adjust(**margins)
        description = fill(*np.ravel(axes))
        files = {}
        target = FigureFolder(folder) if isinstance(folder, Path) else folder
        for kind in dict.fromkeys(["svg", *(target.kinds if target else ())]):
            stream = io.BytesIO()
            color = "white" if kind == "png" else "none"
            metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)
            figure.savefig(stream, format=kind, dpi=220, metadata=metadata, facecolor=color)
            files[kind] = stream.getvalue()
    if target is not None:
        for kind in target.kinds:
            write_bytes(make_folder(target.path) / f"{make_file_name(name)}.{kind}", files[kind])
    caption = f"<figcaption>{escape(note)}</figcaption>" if note else ""
    svg = _adapt_svg(files["svg"].decode(), make_file_name(name), description)
    return f"<figure>{svg}{caption}</figure>"


def _adapt_svg(svg: str, name: str, description: str) -> str:
    """Make an SVG part of a page: its theme and fonts, two decimals, no metadata, and ids that no other figure has."""
    unused = r"<metadata>.*?</metadata>|<!--.*?-->|\n\s*(?=<)| transform=\"rotate\(-0 [^\"]*\"|<g/>"
    svg = re.sub(unused, "", svg[svg.index("<svg") :], flags=re.DOTALL)
    for color, variable in THEME.items():
        svg = svg.replace(color, variable)
    ids = {
        old: f"{name}-{i}"
        for i, old in enumerate(dict.fromkeys(re.findall(r'(?<= id=")[^"]+', svg)))
    }
    used = set(re.findall(r'(?:url\(#|href="#)([^)"]+)', svg))

    def adapt_tag(match: re.Match[str]) -> str:
        """Round the numbers of a tag, replace its ids, shorten its style, and leave the font to the figure."""
        tag = re.sub(r"(\d\.\d\d)\d+", r"\1", match[0])
        tag = re.sub(r"font: ([\d.]+)px '?DejaVu Sans'?[^;\"]*", r"font-size: \1px", tag)
        tag = re.sub(r"font-family: [^;\"]*;? ?", "", tag)
        tag = re.sub(r'(?<= style=")[^"]*', lambda m: re.sub(r"([:;,]) ", r"\1", m[0]), tag)
        tag = re.sub(r' id="([^"]+)"', lambda m: f' id="{ids[m[1]]}"' if m[1] in used else "", tag)
        return re.sub(r'(url\(#|href="#)([^)"]+)', lambda m: m[1] + ids.get(m[2], m[2]), tag)

    svg = re.sub(r"<[^>]+>", adapt_tag, svg)
    font = "font-family:system-ui,'DejaVu Sans',sans-serif"
    return svg.replace(
        "<svg ", f'<svg role="img" style="{font}" aria-label="{escape(description)}" ', 1
    )


def spread_labels(values: Sequence[float], gap: float, low: float, high: float) -> FloatArray:
    """Return positions in the order of `values` that differ by at least `gap` and lie in [low, high] if they fit."""
    order = np.argsort(values, kind="stable")
    y = np.clip(np.array(values, float)[order], low, high)
    for _ in range(200):
        close = np.flatnonzero(np.diff(y) < gap - 1e-9)
        if not len(close):
            break
        for i in close:  # Move both labels of a pair by the same distance.
            middle = 0.5 * (y[i] + y[i + 1])
            y[i] = middle - 0.5 * gap
            y[i + 1] = middle + 0.5 * gap
    y += max(low - y[0], 0.0) if len(y) else 0.0
    for k in reversed(range(len(y))):
        y[k] = min(y[k], high if k == len(y) - 1 else y[k + 1] - gap)
    positions = np.empty(len(y))
    positions[order] = y
    return positions


def label_ends(axes: Any, labels: Sequence[Label], gap: float = 0.066) -> None:
    """Write labels to the right of the axes at the heights of their lines, without overlaps, with leader lines."""
    place = axes.transAxes
    back = axes.transAxes.inverted()
    x = axes.get_xlim()[1]
    heights = [back.transform(axes.transData.transform((x, label.y)))[1] for label in labels]
    for label, y, moved in zip(
        labels, heights, spread_labels(heights, gap, 0.0, 1.02), strict=True
    ):
        color = label.color
        axes.plot([1.012, 1.035], [y, moved], transform=place, color=color, lw=0.6, clip_on=False)
        write_label(axes, 1.045, moved, label.text, color=color, weight=label.weight)


def write_label(axes: Any, x: float, y: float, text: str, **more: Any) -> None:
    """Write a text at a place of the axes, cut to `MAX_LABEL_LENGTH`; none of it is read as a formula."""
    text = text if len(text) <= MAX_LABEL_LENGTH else text[: MAX_LABEL_LENGTH - 1] + "…"
    style = {"va": "center", "fontsize": 8.8, "clip_on": False} | more
    axes.text(x, y, text, transform=axes.transAxes, parse_math=False, **style)


def mark_errors(axes: Any, low: float, high: float, limit: float, unit: str = "m/s") -> list[Label]:
    """Prepare an axis of errors up to `high`: powers of ten, the limit as a dashed line, and a strip below `low`.

    Values below `low` belong into the middle of the strip, at low / 2. The result has the labels of limit and strip.
    """
    top = 10.0 ** np.ceil(np.log10(max(high, 1.5 * limit)))
    first, last = (round(float(np.log10(x))) for x in (low, top))
    axes.set_yscale("log")
    axes.set_ylim(low / 4.0, top)
    axes.set_yticks(10.0 ** np.arange(first, last + 1, 1 if last - first < 9 else 2))
    axes.minorticks_off()
    axes.yaxis.set_major_formatter(lambda y, _: format_power(y))
    axes.grid(True, axis="y")
    axes.axhspan(low / 4.0, low, color=GRID, lw=0.0, alpha=0.5, zorder=0)
    axes.axhline(limit, color=ORANGE, lw=1.3, ls=(0, (5, 2)))
    return [
        Label(limit, f"limit {format_speed(limit, unit)}", ORANGE),
        Label(low / 2.0, f"below {format_power(low)}", QUIET),
    ]


def draw_error_strip(
    axes: Any, errors: FloatArray, close: float, limit: float, extent: Sequence[float]
) -> None:
    """Draw errors (lines, steps) [m/s] as colours, blue up to the limit and orange above it; NaN is empty."""
    levels = [(close, ERROR_COLORS[0])] if close < limit else []
    others = zip((limit / 100.0, limit / 10.0, limit, 10.0 * limit), ERROR_COLORS[1:], strict=False)
    levels += [(edge, color) for edge, color in others if edge > close or edge >= limit]
    edges = [edge for edge, _ in levels]
    palette = [*(color for _, color in levels), ERROR_COLORS[-1]]
    colors = np.array(palette)[np.searchsorted(edges, np.nan_to_num(errors))]
    colors[np.isnan(errors)] = 0.0
    axes.imshow(colors, aspect="auto", interpolation="none", extent=extent)
    axes.spines[["left", "bottom"]].set_visible(False)
    names = [f"≤ {format_speed(x)}" for x in edges] + ["more"]
    for i, (color, name) in enumerate(zip(palette, names, strict=True)):
        y = 0.96 - 0.135 * i
        style = {"ms": 7, "mfc": color, "mec": QUIET, "mew": 0.4}
        axes.plot([1.03], [y], "s", transform=axes.transAxes, clip_on=False, **style)
        write_label(axes, 1.06, y, name, fontsize=8.2, color=QUIET)
