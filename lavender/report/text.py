"""Numbers as people read them."""

from __future__ import annotations

import math

__all__ = ["residual", "seconds"]


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
