"""Our Newton beside that of a simulator, as a table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lavender.bench.simulators import STRICT, TARGET, Step, WarmStep

__all__ = ["table", "warm_table"]

CLASSES = ((0, 10), (10, 50), (50, 300), (300, 10**9))  # rows


def _mean(x: Sequence[float]) -> float:
    return float(np.exp(np.mean(np.log(x)))) if len(x) else float("nan")


def _class(low: int, high: int) -> str:
    return f"under {high}" if low == 0 else f"{low} and more" if high > 10**6 else f"{low}-{high}"


def table(steps: Sequence[Step]) -> str:
    """Geometric means of ours / MuJoCo's by the number of rows, and what was solved, as Markdown."""
    lines = [
        (
            "| rows | models | problems | MuJoCo [µs] | one call | `solve_many` | kernel | prepare | judge | Python "
            "| worst one call |"
        ),
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for low, high in CLASSES:
        part = [s for s in steps if low <= s.rows < high]
        if not part:
            continue
        name = _class(low, high)
        worst = max(part, key=lambda s: s.ours / s.engine)
        lines.append(
            f"| {name} | {len({s.model for s in part})} | {len(part)} | {1e6 * _mean([s.engine for s in part]):.1f} "
            f"| {_mean([s.ours / s.engine for s in part]):.2f} | {_mean([s.many / s.engine for s in part]):.2f} "
            f"| {_mean([s.kernel / s.engine for s in part]):.2f} | {_mean([s.prepare / s.engine for s in part]):.2f} "
            f"| {_mean([s.judge / s.engine for s in part]):.2f} "
            f"| {_mean([max(s.ours - s.kernel - s.prepare - s.judge, 1e-9) / s.engine for s in part]):.2f} "
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
        "",
        "| next step, relative error | MuJoCo, median | worst | ours, median | worst |",
        "|---|---|---|---|---|",
    ]
    for word, engine, own in (
        ("momentum", [s.engine_momentum for s in steps], [s.momentum for s in steps]),
        ("kinetic energy", [s.engine_energy for s in steps], [s.energy for s in steps]),
    ):
        lines.append(
            f"| {word} | {np.median(engine):.1e} | {max(engine):.1e} | {np.median(own):.1e} | {max(own):.1e} |"
        )
    return "\n".join(lines)


def warm_table(steps: Sequence[WarmStep]) -> str:
    """The same over consecutive steps, both sides from what they knew of the last one."""
    lines = [
        "| rows | models | steps | MuJoCo [µs] | one call | MuJoCo's residual, median | worst | ours, median | worst |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for low, high in CLASSES:
        part = [s for s in steps if low <= s.rows < high]
        if not part:
            continue
        engine, own = [s.engine_residual for s in part], [s.residual for s in part]
        lines.append(
            f"| {_class(low, high)} | {len({s.model for s in part})} | {len(part)} "
            f"| {1e6 * _mean([s.engine for s in part]):.1f} | {_mean([s.ours / s.engine for s in part]):.2f} "
            f"| {np.median(engine):.1e} | {max(engine):.1e} | {np.median(own):.1e} | {max(own):.1e} |"
        )
    return "\n".join(lines)
