"""Tables of phenomena records, with a row per engine variant and a column per phenomenon; list of failed cases."""

from __future__ import annotations

import math
from collections.abc import Sequence

from lavender.lab.phenomena.engines import ENGINE_VARIANTS
from lavender.lab.phenomena.parts import Phenomenon, Record
from lavender.lab.phenomena.running import PHENOMENA


def _format_number(x: float, unit: str) -> str:
    """Format a number with its unit, or as a percentage if it has none."""
    if math.isinf(x):
        return "never"
    text = "0" if x < 1e-12 else f"{x:.1e}" if x < 1e-3 or x >= 1e4 else f"{x:.2g}"
    if not unit and 1e-3 <= x < 1.0:
        return f"{100 * x:.0f} %" if x >= 0.1 else f"{100 * x:.2g} %"
    return f"{text} {unit}".strip()


def _group_records(records: Sequence[Record]) -> dict[tuple[str, str], list[Record]]:
    """Group records by (engine, phenomenon)."""
    lines: dict[tuple[str, str], list[Record]] = {}
    for r in records:
        lines.setdefault((r.engine, r.phenomenon), []).append(r)
    return lines


def _get_worst_value(group: Sequence[Record], phenomenon: Phenomenon) -> float:
    """Return the largest value of the phenomenon's first quantity."""
    return max(r.get_value(phenomenon.quantities[0].name) for r in group)


def _format_cell(group: Sequence[Record], phenomenon: Phenomenon) -> str:
    """Format a cell of the table: worst value and number of cases that passed; bold unless all cases passed."""
    measured = [r for r in group if not r.note]
    if not measured:
        return "–"
    passed = sum(r.passed for r in group)
    text = _format_number(_get_worst_value(measured, phenomenon), phenomenon.quantities[0].unit)
    text = f"{text}, {passed}/{len(group)}"
    return text if passed == len(group) else f"**{text}**"


def format_markdown_table(records: Sequence[Record]) -> str:
    """Build a Markdown table; its cells have the worst value of the first quantity and the number of passed cases.

    A cell is bold if a case failed.
    """
    groups = _group_records(records)
    names = [n for n in PHENOMENA if any(key[1] == n for key in groups)]
    lines = [f"| | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    for variant in ENGINE_VARIANTS:
        if any(key[0] == variant for key in groups):
            cells = [
                _format_cell(groups[variant, n], PHENOMENA[n]) if (variant, n) in groups else ""
                for n in names
            ]
            lines.append(f"| {variant} | {' | '.join(cells)} |")
    return "\n".join(lines)


def list_notes(records: Sequence[Record]) -> list[str]:
    """Return one line per engine variant and reason why cells are empty or cases have no values."""
    lines: dict[tuple[str, str], list[str]] = {}
    for r in records:
        if r.note and r.phenomenon not in lines.setdefault((r.engine, r.note), []):
            lines[r.engine, r.note].append(r.phenomenon)
    return [f"{engine}: {', '.join(which)}: {note}" for (engine, note), which in lines.items()]


def list_out_of_bound_cases(records: Sequence[Record]) -> list[str]:
    """Return one line per lavender stepper and phenomenon with cases out of bound."""
    lines = []
    for (variant, name), group in _group_records(records).items():
        bad = [r for r in group if not r.passed and not r.note]
        if ENGINE_VARIANTS[variant].module != "own" or not bad:
            continue
        phenomenon = PHENOMENA[name]
        exceeded = [q for q in phenomenon.quantities if any(r.get_value(q.name) > q.bound for r in bad)]
        worst = {q.name: max(r.get_value(q.name) for r in bad) for q in exceeded}
        measurements = ", ".join(
            f"{q.name} {_format_number(worst[q.name], q.unit)} (bound {_format_number(q.bound, q.unit)})"
            for q in exceeded
        )
        cases = [r.case for r in bad]
        others = sorted(
            {r.engine for r in records if r.phenomenon == name and r.case in cases}
            - {r.engine for r in records if r.phenomenon == name and r.case in cases and not r.passed}
        )
        within = f"; within it: {', '.join(others)}" if others else "; no engine is within it"
        lines.append(f"{name}, {variant}: {len(bad)} of {len(group)} cases out, {measurements}{within}")
    return lines


def format_record(r: Record) -> str:
    """Format one record as one line."""
    phenomenon = PHENOMENA[r.phenomenon]
    head = f"{r.engine}: {r.phenomenon} ({', '.join(f'{k} {v:g}' for k, v in r.case.items())})"
    if r.note:
        return f"{head}: {r.note}"
    measurements = ", ".join(
        f"{q.name} {_format_number(r.get_value(q.name), q.unit)}" for q in phenomenon.quantities
    )
    return f"{head}: {measurements}{'' if r.passed else ' – out of bound'}"


def describe_phenomena(phenomena: Sequence[Phenomenon]) -> str:
    """Describe each phenomenon: exact motion, bounds, parameters."""
    parts = []
    for p in phenomena:
        parts += [f"{p.name}: {p.title}", f"  why: {p.why}", f"  exact motion: {p.truth}"]
        parts += [f"  {q.name}: at most {_format_number(q.bound, q.unit)}; {q.text}" for q in p.quantities]
        parts += [
            f"  --set {k}={x.default:g}: {x.text}, {x.low:g} to {x.high:g}" for k, x in p.parameters.items()
        ]
    return "\n".join(parts)
