"""Figures as SVG within the page: drawn here, so that they are there without a script, in print and on a phone.

A curve is one path in whole units of a canvas twice as fine as it is shown. It carries the number of its solver,
by which the page colours it, and what its points were asked for; the page's script reads values back from the
places of points and the axes that the drawing carries, so nothing is said twice.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from itertools import pairwise

from lavender.lab.report.axes import Axis, shown
from lavender.lab.report.curves import Curve, Figure

WIDTH, HEIGHT = 1000, 640  # units, twice the pixels of a phone's width
LEFT, RIGHT, TOP, BOTTOM = 118, 256, 62, 92  # margins: labels of the axis; names at the ends of curves
GAP = 30  # units between two names, at least


class _Scale:
    """Values to units of the canvas."""

    def __init__(self, axis: Axis, first: float, last: float) -> None:
        self.axis, self.first, self.last = axis, first, last

    def __call__(self, value: float) -> int:
        return round(self.first + (self.last - self.first) * self.axis.share(value))

    def data(self) -> str:
        """What a script needs to read a value off a place."""
        return f"{int(self.axis.log)} {self.axis.low:.4f} {self.axis.high:.4f} {self.first} {self.last}"


def svg(
    figure: Figure, number: Mapping[str, int], leaders: Sequence[str] = (), title: str | None = None
) -> str:
    """One drawing. A solver's `number` among those of the page is its class.

    `leaders` are in colour, and their names must not cover each other; `title` stands in place of the figure's own,
    which may repeat a heading of the page.
    """
    laid = shown(figure)
    across, up = _Scale(laid.across, LEFT, WIDTH - RIGHT), _Scale(laid.up, HEIGHT - BOTTOM, TOP)
    said = f"{int(laid.across.is_time)}{int(laid.up.is_time)}"
    parts = [
        f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(figure.title)}"',
        f' data-x="{across.data()}" data-y="{up.data()}" data-t="{said}">',
        f'<text class="t" x="{LEFT}" y="24">{escape(_short(figure.heading if title is None else title))}</text>',
    ]
    parts += _grid(figure, across, up)
    names = _names(laid.curves, across, up, leaders)
    for c, x, y in laid.curves:
        parts.append(_curve(c, x, y, across, up, number.get(c.solver, 0), names))
    return "".join([*parts, "</svg>"])


def _short(text: str, most: int = 76) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"


def _grid(figure: Figure, across: _Scale, up: _Scale) -> list[str]:
    bottom, right = HEIGHT - BOTTOM, WIDTH - RIGHT
    lines, words = [], []
    for scale, is_x in ((across, True), (up, False)):
        for value in scale.axis.ticks():
            place, said = scale(value), scale.axis.text(value)
            if is_x:
                lines.append(f"M{place} {TOP}V{bottom}")
                words.append(
                    f'<text class="a" x="{place}" y="{bottom + 30}" text-anchor="middle">{said}</text>'
                )
            else:
                lines.append(f"M{LEFT} {place}H{right}")
                words.append(
                    f'<text class="a" x="{LEFT - 10}" y="{place + 8}" text-anchor="end">{said}</text>'
                )
    out = [f'<path class="g" d="{"".join(lines)}"/>', *words]
    middle = (LEFT + right) // 2
    out.append(
        f'<text class="a" x="{middle}" y="{HEIGHT - 20}" text-anchor="middle">{escape(across.axis.title)}</text>'
    )
    out.append(f'<text class="a" x="{LEFT}" y="{TOP - 8}">{escape(up.axis.title)}</text>')
    marks = [(level, "l", "") for level in figure.levels]
    if math.isfinite(figure.floor) and figure.floor > 0.0:
        marks.append((figure.floor, "f", "floor"))
    for value, kind, said in marks:
        if value > 0.0 and TOP <= up(value) <= bottom:
            out.append(f'<path class="{kind}" d="M{LEFT} {up(value)}H{right}"/>')
            if said:
                out.append(
                    f'<text class="a" x="{right - 6}" y="{up(value) - 6}" text-anchor="end">{said}</text>'
                )
    return out


def _names(
    curves: Sequence[tuple[Curve, list[float], list[float]]],
    across: _Scale,
    up: _Scale,
    leaders: Sequence[str],
) -> dict[str, tuple[int, int]]:
    """Where the name of each curve stands: at its end, those of the leaders apart from each other."""
    ends = {}
    for c, x, y in curves:
        if not c.thin:
            places = [(across(a), up(b)) for a, b in zip(x, y, strict=True) if not math.isnan(b)]
            last = places[-1][1]
            # Beside whatever of the curve is as high as its end.
            right = WIDTH - RIGHT if c.steps else max(a for a, b in places if abs(b - last) < GAP)
            ends[c.label] = (right + 12, last + 8)
    leading = [c.label for c, _, _ in curves if c.solver in leaders and c.label in ends]
    leading.sort(key=lambda label: ends[label][1])
    for above, label in pairwise(leading):
        ends[label] = (ends[label][0], max(ends[label][1], ends[above][1] + GAP))
    lowest = HEIGHT - BOTTOM + 4  # above the numbers of the axis
    for label in reversed(leading):
        ends[label] = (ends[label][0], min(ends[label][1], lowest))
        lowest = ends[label][1] - GAP
    return ends


def _curve(
    c: Curve,
    x: Sequence[float],
    y: Sequence[float],
    across: _Scale,
    up: _Scale,
    n: int,
    names: Mapping[str, tuple[int, int]],
) -> str:
    line: list[str] = []
    dots: list[str] = []
    before: tuple[int, int] | None = None
    for a, b in zip(x, y, strict=True):
        if math.isnan(b):
            before = None
            continue
        here = across(a), up(b)
        if before is None:
            line.append(f"M{here[0]} {here[1]}")
        elif c.steps:
            line.append(f"H{here[0]}V{here[1]}")
        else:
            line.append(f"L{here[0]} {here[1]}")
        dots.append(f"M{here[0]} {here[1]}h0")
        before = here
    if c.steps and before is not None:
        line.append(f"H{WIDTH - RIGHT}")
    kind = f"c s{n}" + (" w" if c.thin else "")
    # "16" for 16 iterations: the page's script says the word.
    said = "|".join(note.removesuffix(" iterations") for note in c.notes)
    asked = f' data-n="{escape(said)}"' if c.notes else ""
    body = "" if c.points else f'<path d="{"".join(line)}"/>'
    if c.low:
        edge = [f"{across(a)} {up(b)}" for a, b in zip(c.x, c.high, strict=True)]
        edge += [f"{across(a)} {up(b)}" for a, b in reversed([*zip(c.x, c.low, strict=True)])]
        body = f'<path class="b" d="M{"L".join(edge)}Z"/>{body}'
    if not c.steps and not c.low:
        body += f'<path class="d" d="{"".join(dots)}"/>'
    if c.label in names and not c.thin:
        place = names[c.label]
        body += f'<text x="{place[0]}" y="{place[1]}">{escape(_short(c.label, 24))}</text>'
    return f'<g class="{kind}" data-l="{escape(c.label)}"{asked}>{body}</g>'
