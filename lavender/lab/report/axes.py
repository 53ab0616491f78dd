"""Axes of a figure, for every drawing of it: what is shown of the curves, ranges, ticks and their words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from lavender.lab.bench.record import level_name
from lavender.lab.report.curves import Curve, Figure

LEAST_DECADES = 1.0  # a logarithmic axis spans so much, at least
UNITS = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns"))


class Axis:
    """Values to shares of an axis' length."""

    def __init__(self, values: Sequence[float], log: bool, title: str) -> None:
        self.log, self.is_time = log, "[s]" in title
        found = [math.log10(v) if log else v for v in values]
        low, high = (min(found), max(found)) if found else (0.0, 1.0)
        least = LEAST_DECADES if log else 0.0
        if high - low < least:
            middle = 0.5 * (low + high)
            low, high = middle - 0.5 * least, middle + 0.5 * least
        room = 0.03 * (high - low) if high > low else 0.5
        self.low, self.high = low - room, high + room  # of the decimal logarithm, where it is logarithmic
        # Times in the unit of the middle, which title and ticks share.
        middle = 10.0 ** (0.5 * (low + high)) if log else 0.5 * (low + high)
        self.scale, unit = next((u for u in UNITS if middle >= u[0]), UNITS[-1]) if self.is_time else UNITS[0]
        self.title = title.replace("[s]", f"[{unit}]")

    def share(self, value: float) -> float:
        """0 at its beginning, 1 at its end."""
        x = math.log10(value) if self.log else value
        return (x - self.low) / (self.high - self.low)

    @property
    def limits(self) -> tuple[float, float]:
        """Values at its ends."""
        return (10.0**self.low, 10.0**self.high) if self.log else (self.low, self.high)

    def ticks(self) -> list[float]:
        """Decades, every second or third where there are many; else about five round numbers."""
        if self.log:
            decades = list(range(math.ceil(self.low), math.floor(self.high) + 1))
            ticks = [10.0**k for k in decades[:: max(1, -(-len(decades) // 7))]]
            if len(decades) < 2:
                ticks = [
                    m * 10.0**k
                    for k in range(math.floor(self.low), math.ceil(self.high) + 1)
                    for m in (1, 2, 5)
                    if self.low <= math.log10(m * 10.0**k) <= self.high
                ]
            return ticks
        step = 10.0 ** math.floor(math.log10((self.high - self.low) / 2.0))
        step *= next((m for m in (1.0, 2.0, 5.0, 10.0) if (self.high - self.low) / (m * step) <= 6.0), 10.0)
        first = math.ceil(self.low / step)
        return [step * k for k in range(first, first + 12) if step * k <= self.high]

    def text(self, tick: float) -> str:
        """What stands at a tick, in the unit of the title: 1e-3 of powers, 0.5."""
        tick /= self.scale
        if self.log:
            return f"{tick:.6g}" if (9e-4 if self.is_time else 0.09) < tick < 1e4 else level_name(tick)
        return f"{tick:.6g}"


@dataclass(frozen=True)
class Shown:
    """Curves with their points that the axes can show, nan where a line breaks; and the axes."""

    curves: list[tuple[Curve, list[float], list[float]]]
    across: Axis
    up: Axis


def shown(figure: Figure) -> Shown:
    """Lay out a figure; curves without a point that can be shown are left out."""
    curves = [(c, *_finite(c, figure)) for c in figure.curves]
    curves = [(c, x, y) for c, x, y in curves if any(not math.isnan(v) for v in y)]
    xs = [v for _, x, y in curves for v, w in zip(x, y, strict=True) if not math.isnan(w)]
    ys = [v for c, _, y in curves for v in (*y, *c.low, *c.high) if not math.isnan(v)]
    return Shown(curves, Axis(xs, figure.x_log, figure.x_title), Axis(ys, figure.y_log, figure.y_title))


def _finite(curve: Curve, figure: Figure) -> tuple[list[float], list[float]]:
    x, y = [], []
    for a, b in zip(curve.x, curve.y, strict=True):
        can = math.isfinite(a) and (a > 0.0 or not figure.x_log)
        x.append(a if can else math.nan)
        y.append(b if can and math.isfinite(b) and (b > 0.0 or not figure.y_log) else math.nan)
    return x, y
