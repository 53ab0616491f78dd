"""Minutes of the gallery as aligned text."""

from __future__ import annotations

from collections.abc import Iterable

from lavender.bench.endurance import Stay

__all__ = ["table"]


def table(found: Iterable[Stay]) -> str:
    """Aligned text, one line a run."""
    head = (
        f"{'scene':<16}{'solver':<21}{'1/dt':>5}{'s':>7}{'E start J':>11}{'E end J':>11}{'gain J':>10}"
        f"{'drift mm':>10}{'speed m/s':>11}{'depth mm':>10}{'failed':>8}{'µs a step':>11}"
    )
    lines = [head]
    for f in found:
        lost = f"   lost: {f.lost}" if f.lost else ""
        lines.append(
            f"{f.scene:<16}{f.solver:<21}{round(1 / f.dt):>5}{f.seconds:>7.0f}{f.start:>11.4g}{f.end:>11.4g}"
            f"{f.gain:>10.2g}{1e3 * f.drift:>10.3g}{f.speed:>11.2g}{1e3 * f.depth:>10.3g}{f.failed:>8}"
            f"{1e6 * f.cost:>11.0f}{lost}"
        )
    return "\n".join(lines)
