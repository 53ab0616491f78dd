"""Our Newton beside that of a simulator, as a table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lavender.bench.simulators import STRICT, TARGET, Step

__all__ = ["table"]

CLASSES = ((0, 10), (10, 50), (50, 300), (300, 10**9))  # rows


def _mean(x: Sequence[float]) -> float:
    return float(np.exp(np.mean(np.log(x)))) if len(x) else float("nan")


def table(steps: Sequence[Step]) -> str:
    """Geometric means of ours / MuJoCo's by the number of rows, and what was solved, as Markdown."""
    lines = [
        "| rows | models | problems | MuJoCo [µs] | one call | `solve_many` | kernel alone | worst one call |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for low, high in CLASSES:
        part = [s for s in steps if low <= s.rows < high]
        if not part:
            continue
        name = f"under {high}" if low == 0 else f"{low} and more" if high > 10**6 else f"{low}-{high}"
        worst = max(part, key=lambda s: s.ours / s.engine)
        lines.append(
            f"| {name} | {len({s.model for s in part})} | {len(part)} | {1e6 * _mean([s.engine for s in part]):.1f} "
            f"| {_mean([s.ours / s.engine for s in part]):.2f} | {_mean([s.many / s.engine for s in part]):.2f} "
            f"| {_mean([s.kernel / s.engine for s in part]):.2f} "
            f"| {worst.ours / worst.engine:.1f} ({worst.model}, {worst.rows} rows) |"
        )
    convex = [s for s in steps if s.strict <= STRICT]
    coulomb = [s for s in steps if s.coulomb is not None]
    solved = sum(s.coulomb <= STRICT for s in coulomb if s.coulomb is not None)
    never = sum(s.tolerance == 0.0 for s in steps)
    lines += [
        "",
        (
            f"{len(convex)} of {len(steps)} solved to {STRICT:.0e} or the floor of float64 under MuJoCo's own law, "
            f"{solved} of {len(coulomb)} under Coulomb's (contacts of up to two tangents); {never} that MuJoCo brings "
            f"to {TARGET:.0e} at no tolerance count with its default."
        ),
    ]
    return "\n".join(lines)
