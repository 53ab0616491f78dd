"""The page of comparisons: a waterfall of each quantity, what differs, what to try, and tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lavender.base.lazy_import import markupsafe
from lavender.base.lazy_import import pandas as pd
from lavender.causes.comparison import Comparison
from lavender.causes.difference import Quantity
from lavender.causes.facts import list_parts_of, name_engine
from lavender.causes.text import WORDS, list_cautions, write_proposal
from lavender.report.page import Page, tabulate_frame
from lavender.report.text import format_count

MIN_DRAWN_PART = 0.005  # [-] Smaller parts of the difference are drawn together.
ROW_HEIGHT, EDGE_HEIGHT = 0.3, 0.75  # [inches] Of a bar, and of title, axis and its label.
DRAWN_QUANTITIES = 3
LABEL_SPACE = 0.16  # [-] Of the axis beside the bars.


@dataclass(frozen=True, eq=False)
class StateComparison:
    """The comparison at one of several states."""

    state: int
    comparison: Comparison


@dataclass(frozen=True, eq=False)
class Comparisons:
    """Comparisons of the same engines at several states."""

    states: tuple[StateComparison, ...]
    title: str  # Command and inputs.
    notes: tuple[str, ...] = ()
    provenance: dict[str, Any] = field(default_factory=dict)

    @property
    def largest(self) -> StateComparison:
        """The comparison with the largest difference."""
        return max(
            self.states, key=lambda x: float(np.abs(x.comparison.difference).max(initial=0.0))
        )

    @property
    def table(self) -> pd.DataFrame:
        """Largest difference of each state with its causes."""
        rows = []
        for entry in self.states:
            comparison = entry.comparison
            total = comparison.difference
            i = int(np.argmax(np.abs(total)))
            causes = comparison.list_causes(np.eye(len(total))[i])
            rows.append({
                "state": entry.state, "velocity": comparison.b.names[i], "difference": float(total[i]),
                "unit": "rad/s" if comparison.b.angular[i] else "m/s",
                "cause": ", ".join(WORDS.get(c, c) for c in causes) or "equal to rounding",
            })  # fmt: skip
        return pd.DataFrame(rows)

    @property
    def numbers(self) -> dict[str, Any]:
        """Everything as JSON: for each state all velocities with all parts."""
        return {
            "states": [{"state": x.state, **list_numbers(x.comparison)} for x in self.states],
            "provenance": self.provenance,
        }

    def make_page(self, folder: Path | None) -> Page:
        """Make the page, with figures in a folder."""
        comparison = self.largest.comparison
        quantities = comparison.list_quantities()
        cautions = list_cautions(comparison)
        facts = comparison.facts
        proposals = (
            [write_proposal(p, comparison) for p in comparison.proposals] if quantities else []
        )
        blocks: list[Any] = []
        if folder is not None and quantities:
            blocks += [
                markupsafe.Markup(draw_waterfall(comparison, q, f"waterfall-{i}", folder))
                for i, q in enumerate(quantities[:DRAWN_QUANTITIES])
            ]
        if folder is not None:
            if facts:
                rows = [{"ingredient": list_parts_of(f), "what differs": f.text} for f in facts]
                pair = f"{name_engine(comparison.a, comparison.b)} and {name_engine(comparison.b, comparison.a)}"
                blocks.append(tabulate_frame(pd.DataFrame(rows), title=f"What differs: {pair}"))
            if len(self.states) > 1:
                blocks.append(tabulate_frame(self.table, title="Every state"))
            for kind in ("joint", "contact"):
                frame = tabulate_parts(comparison, kind)
                if len(frame):
                    title = f"Parts by {kind}, in the state with the largest difference"
                    blocks.append(
                        {"folded": [tabulate_frame(frame)], "title": title, "open": False}
                    )
        count = format_count(len(self.states), "state")
        return Page(
            "lavender compare", f"{self.title} · {count}", make_verdict(comparison),
            [*proposals, *self.notes], warnings=cautions, blocks=blocks,
            footer=["Files: numbers.json, figures/ (PDF, SVG, PNG)."],
        )  # fmt: skip


def make_verdict(comparison: Comparison) -> str:
    """Return the largest difference and its causes in one sentence."""
    quantities = comparison.list_quantities(joints=1, contacts=0)
    if not quantities:
        return "The velocities after the step are equal to rounding."
    q = quantities[0]
    total = float(q.row @ comparison.difference)
    causes = [WORDS.get(c, c) for c in comparison.list_causes(q.row)]
    a, b = comparison.a, comparison.b
    first, second = name_engine(a, b), name_engine(b, a)
    than = f"by the {a.engine} laws" if comparison.is_ideal else f"in {first}"
    named = " and ".join(causes) or "no single cause"
    return (
        f"{q.name} is {abs(total):.2g} {q.unit} {'higher' if total > 0 else 'lower'} in {second} than "
        f"{than} after one step: {named}."
    )


def draw_waterfall(comparison: Comparison, quantity: Quantity, name: str, folder: Path) -> str:
    """Draw the parts from the velocity of the first engine to the one of the second, with their intervals."""
    from lavender.report.drawing import BLUE, INK, ORANGE, QUIET, draw_figure

    a, b = comparison.a, comparison.b
    row = quantity.row
    start, end = float(row @ a.velocity_after), float(row @ b.velocity_after)
    size = abs(end - start)
    parts = [
        (WORDS.get(part.name, part.name).partition(":")[0], mean, low, high)
        for part, mean, low, high in comparison.rank(row)
        if max(abs(low), abs(high)) > max(MIN_DRAWN_PART * size, comparison.rounding)
    ]
    names = ["rigid laws" if comparison.is_ideal else name_engine(a, b)]
    names += [p[0] for p in parts] + [name_engine(b, a)]

    def fill(axes: Any) -> str:
        at = start
        axes.barh(0, start, color=QUIET, height=0.6)
        texts = [f"{start:.3g}"]
        ends = [max(start, 0.0)]
        for k, (_, mean, low, high) in enumerate(parts, 1):
            axes.barh(k, mean, left=at, color=BLUE if mean > 0 else ORANGE, height=0.6)
            if high - low > 0.02 * abs(mean):
                axes.plot([at + low, at + high], [k, k], color=INK, lw=1.1, marker="|", ms=6)
            axes.plot([at + mean] * 2, [k - 0.3, k + 1.3], color=QUIET, lw=0.6)
            ends.append(max(at, at + mean, at + high))
            texts.append(f"{mean:+.2g}")
            at += mean
        axes.barh(len(parts) + 1, end, color=QUIET, height=0.6)
        ends.append(max(end, 0.0))
        texts.append(f"{end:.3g}")
        for k, (x, text) in enumerate(zip(ends, texts, strict=True)):
            axes.annotate(text, (x, k), xytext=(4, 0), textcoords="offset points", va="center")
        axes.set_yticks(range(len(names)), [n[:22] for n in names])
        axes.invert_yaxis()
        axes.axvline(0.0, color=INK, lw=0.7)
        left, right = axes.get_xlim()
        left, right = min(0.0, left), max(0.0, right)
        # The numbers stand to the right of the bars.
        axes.set_xlim(
            left - LABEL_SPACE * (right - left) * (left < 0.0), right + LABEL_SPACE * (right - left)
        )
        axes.set_xlabel(f"{quantity.name} after one step [{quantity.unit}]", parse_math=False)
        return "; ".join(f"{n} {t}" for n, t in zip(names, texts, strict=True))

    height = EDGE_HEIGHT + ROW_HEIGHT * len(names)
    margins = {"left": 0.33, "right": 0.96, "top": 1.0 - 0.08 / height, "bottom": 0.55 / height}
    note = "Bars are means over all orders of exchange, and lines contain every order."
    return draw_figure(name, fill, (4.9, height), margins, note=note, folder=folder)


def tabulate_parts(comparison: Comparison, kind: str) -> pd.DataFrame:
    """Return all parts of the velocities of joints or contacts whose difference is not rounding."""
    many = len(comparison.difference) + 3 * len(comparison.b.blocks)
    counts = {"joints": many, "contacts": 0} if kind == "joint" else {"joints": 0, "contacts": many}
    rows = []
    for q in comparison.list_quantities(**counts):
        parts = {
            WORDS.get(n, n).partition(":")[0]: float(p.mean @ q.row)
            for n, p in comparison.parts.items()
        }
        total = float(q.row @ comparison.difference)
        rows.append({"velocity": q.name, "unit": q.unit, "difference": total, **parts})
    frame = pd.DataFrame(rows)
    silent = [
        c for c in frame.columns[3:] if not (frame[c].abs() > comparison.rounding).any()
    ]  # fmt: skip
    return frame.drop(columns=silent)


def list_numbers(comparison: Comparison) -> dict[str, Any]:
    """Return all velocities of a comparison with all parts, for JSON."""

    def describe(parts: Sequence[Any]) -> dict[str, Any]:
        return {
            p.name: {
                "mean": p.mean.tolist(), "smallest": p.changes.min(axis=0).tolist(),
                "largest": p.changes.max(axis=0).tolist(), "alone_in_a": p.alone_in_a.tolist(),
                "alone_in_b": p.alone_in_b.tolist(), "parts": describe(p.parts),
            }
            for p in parts
        }  # fmt: skip

    a, b = comparison.a, comparison.b
    return {
        "a": a.engine, "b": b.engine, "dt": a.dt, "names": list(a.names),
        "units": ["rad/s" if x else "m/s" for x in a.angular],
        "velocity_a": a.velocity_after.tolist(), "velocity_b": b.velocity_after.tolist(),
        "parts": describe(list(comparison.parts.values())),
        "facts": [{"part": f.part, "text": f.text} for f in comparison.facts],
        "proposals": [{"text": p.text, "left": p.left, "before": p.before} for p in comparison.proposals],
        "cautions": list_cautions(comparison),
    }  # fmt: skip
