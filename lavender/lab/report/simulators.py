"""Tabulate times of lavender's Newton method and of a simulator's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from lavender.lab.bench.simulators import STRICT_RESIDUAL, TARGET_RESIDUAL, Step, WarmStep
from lavender.lab.bench.statistics import compute_geometric_mean
from lavender.lab.report.markdown import format_markdown
from lavender.lab.report.table import Table

S = TypeVar("S", bound=WarmStep)
OVER = "lavender's time over MuJoCo's, geometric means, above 1 MuJoCo is faster"
ROW_CLASSES = ((0, 10), (10, 50), (50, 300), (300, 10**9))  # Ranges of the number of rows.


def _group_by_class(steps: Sequence[S]) -> list[tuple[str, list[S]]]:
    classes = []
    for low, high in ROW_CLASSES:
        name = f"under {high}" if low == 0 else f"{low} and more" if high > 10**6 else f"{low}-{high}"
        classes.append((name, [s for s in steps if low <= s.rows < high]))
    return [(name, part) for name, part in classes if part]


def _format_sizes(x: Sequence[float]) -> tuple[str, str]:
    return f"{np.median(x):.1e}", f"{max(x):.1e}"


def _make_row_head(name: str, part: Sequence[WarmStep]) -> list[str]:
    """Return the first cells of a row: models, problems, the engine's time and the ratio of times."""
    ratio = compute_geometric_mean([s.ours / s.engine for s in part])
    models, engine = len({s.model for s in part}), compute_geometric_mean([s.engine for s in part])
    return [name, str(models), str(len(part)), f"{1e6 * engine:.1f}", f"{ratio:.2f}"]


def format_time_ratio_table(steps: Sequence[Step]) -> str:
    """Return geometric means of time ratios by the number of rows, and how many problems were solved, as Markdown."""
    heads = [
        "rows",
        "models",
        "problems",
        "MuJoCo [µs]",
        "one call",
        "prepared",
        "`solve_many`",
        "with import",
    ]
    rows = [
        [
            *_make_row_head(name, part),
            *(
                f"{compute_geometric_mean([getattr(s, field) / s.engine for s in part]):.2f}"
                for field in ("prepared", "many", "imported")
            ),
        ]
        for name, part in _group_by_class(steps)
    ]
    convex = [s for s in steps if s.strict <= STRICT_RESIDUAL]
    coulomb = [s for s in steps if s.coulomb is not None]
    solved = sum(s.coulomb <= STRICT_RESIDUAL for s in coulomb if s.coulomb is not None)
    unreached = sum(s.tolerance == 0.0 for s in steps)
    summary = (
        f"{len(convex)} of {len(steps)} solved to {STRICT_RESIDUAL:.0e} or the floor of float64 under MuJoCo's own "
        f"law, {solved} of {len(coulomb)} under Coulomb's (contacts of up to two tangents). {unreached} are not solved "
        f"to {TARGET_RESIDUAL:.0e} by MuJoCo with any tolerance; they count with its default tolerance."
    )
    start = f"Cold start, to a judged residual of {TARGET_RESIDUAL:.0e}. All but the first columns: {OVER}."
    return "\n".join([start, "", *format_markdown(Table(heads, rows)), "", summary])


def format_warm_time_ratio_table(steps: Sequence[WarmStep]) -> str:
    """Return the table of `format_time_ratio_table` for consecutive steps, with both solvers warm-started."""
    rows = [
        [
            *_make_row_head(name, part),
            *_format_sizes([s.engine_residual for s in part]),
            *_format_sizes([s.residual for s in part]),
        ]
        for name, part in _group_by_class(steps)
    ]
    residuals = ["MuJoCo's residual, median", "worst", "ours, median", "worst"]
    start = (
        "Warm, each side from its own last step, MuJoCo at the model's tolerance, lavender to "
        f"{TARGET_RESIDUAL:.0e}. `one call`: {OVER}."
    )
    heads = ["rows", "models", "steps", "MuJoCo [µs]", "one call", *residuals]
    return "\n".join([start, "", *format_markdown(Table(heads, rows))])
