"""Numbers and recommendations as people read them."""

from __future__ import annotations

import math

from lavender.report.tables import Advice

__all__ = ["in_time", "residual", "seconds", "to_level"]


def seconds(t: float, missing: str = "–") -> str:
    """Three digits and a unit: 12.3 µs, 4.56 ms, 7.89 s."""
    if not math.isfinite(t):
        return missing
    for scale, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")):
        if t >= 0.9995 * scale or unit == "µs":
            x = t / scale
            digits = max(0, 2 - math.floor(math.log10(x))) if x >= 1.0 else 2
            return f"{x:.{digits}f} {unit}"
    return missing


def residual(x: float) -> str:
    """Two digits: 3.4e-7; inf and nan as words."""
    if not math.isfinite(x):
        return str(x)
    if x == 0.0:
        return "0"
    mantissa, _, exponent = f"{x:.1e}".partition("e")
    return f"{mantissa}e{int(exponent)}"


def to_level(advice: Advice) -> str:
    """Who gets to a level, in what time, on how many cases and with which budget, in one line."""
    best = advice.best
    if best is None:
        return "nobody"
    return f"{best.solver} {seconds(best.typical)} ({best.solved}/{best.cases})" + _how(best.how)


def in_time(advice: Advice) -> str:
    """Who comes closest within a time, and how close, in one line."""
    best = advice.best
    return "nobody" if best is None else f"{best.solver} to {residual(best.score)}" + _how(best.how)


def _how(how: str) -> str:
    return f", {how}" if how else ""
