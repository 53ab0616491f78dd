"""Records as a table: a row for each variant, a column for each phenomenon, and where ours lose."""

from __future__ import annotations

import math
from collections.abc import Sequence

from lavender.lab.phenomena.engines import ENGINE_VARIANTS
from lavender.lab.phenomena.parts import Phenomenon, Record
from lavender.lab.phenomena.running import PHENOMENA


def _number(x: float, unit: str) -> str:
    if math.isinf(x):
        return "never"
    text = "0" if x < 1e-12 else f"{x:.1e}" if x < 1e-3 or x >= 1e4 else f"{x:.2g}"
    if not unit and 1e-3 <= x < 1.0:
        return f"{100 * x:.0f} %" if x >= 0.1 else f"{100 * x:.2g} %"
    return f"{text} {unit}".strip()


def _groups(records: Sequence[Record]) -> dict[tuple[str, str], list[Record]]:
    found: dict[tuple[str, str], list[Record]] = {}
    for r in records:
        found.setdefault((r.engine, r.phenomenon), []).append(r)
    return found


def _worst(some: Sequence[Record], phenomenon: Phenomenon) -> float:
    return max(r.value(phenomenon.quantities[0].name) for r in some)


def _cell(some: Sequence[Record], phenomenon: Phenomenon) -> str:
    ran = [r for r in some if not r.note]
    if not ran:
        return "–"
    passed = sum(r.passed for r in some)
    text = _number(_worst(ran, phenomenon), phenomenon.quantities[0].unit)
    text = f"{text}, {passed}/{len(some)}"
    return text if passed == len(some) else f"**{text}**"


def table(records: Sequence[Record]) -> str:
    """Markdown: worst value of the first quantity and cases that passed of those run; bold where one did not."""
    groups = _groups(records)
    names = [n for n in PHENOMENA if any(key[1] == n for key in groups)]
    lines = [f"| | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    for variant in ENGINE_VARIANTS:
        if any(key[0] == variant for key in groups):
            cells = [_cell(groups[variant, n], PHENOMENA[n]) if (variant, n) in groups else "" for n in names]
            lines.append(f"| {variant} | {' | '.join(cells)} |")
    return "\n".join(lines)


def notes(records: Sequence[Record]) -> list[str]:
    """Why cells are empty or cases have no values, one line for each variant and reason."""
    found: dict[tuple[str, str], list[str]] = {}
    for r in records:
        if r.note and r.phenomenon not in found.setdefault((r.engine, r.note), []):
            found[r.engine, r.note].append(r.phenomenon)
    return [f"{engine}: {', '.join(which)}: {note}" for (engine, note), which in found.items()]


def out_of_bound_cases(records: Sequence[Record]) -> list[str]:
    """Return a line for each of our steppers and phenomenon with cases out of their bounds."""
    found = []
    for (variant, name), some in _groups(records).items():
        bad = [r for r in some if not r.passed and not r.note]
        if ENGINE_VARIANTS[variant].module != "own" or not bad:
            continue
        phenomenon = PHENOMENA[name]
        out = [q for q in phenomenon.quantities if any(r.value(q.name) > q.bound for r in bad)]
        words = ", ".join(
            f"{q.name} {_number(max(r.value(q.name) for r in bad), q.unit)} (bound {_number(q.bound, q.unit)})"
            for q in out
        )
        cases = [r.case for r in bad]
        others = sorted(
            {r.engine for r in records if r.phenomenon == name and r.case in cases}
            - {r.engine for r in records if r.phenomenon == name and r.case in cases and not r.passed}
        )
        within = f"; within it: {', '.join(others)}" if others else "; no engine is within it"
        found.append(f"{name}, {variant}: {len(bad)} of {len(some)} cases out, {words}{within}")
    return found


def line(r: Record) -> str:
    """One record in one line."""
    phenomenon = PHENOMENA[r.phenomenon]
    head = f"{r.engine}: {r.phenomenon} ({', '.join(f'{k} {v:g}' for k, v in r.case.items())})"
    if r.note:
        return f"{head}: {r.note}"
    words = ", ".join(f"{q.name} {_number(r.value(q.name), q.unit)}" for q in phenomenon.quantities)
    return f"{head}: {words}{'' if r.passed else ' – out of bound'}"


def described(phenomena: Sequence[Phenomenon]) -> str:
    """What each phenomenon is: truth, bounds, parameters."""
    parts = []
    for p in phenomena:
        parts += [f"{p.name}: {p.title}", f"  why: {p.why}", f"  truth: {p.truth}"]
        parts += [f"  {q.name}: at most {_number(q.bound, q.unit)}; {q.text}" for q in p.quantities]
        parts += [
            f"  --set {k}={x.default:g}: {x.text}, {x.low:g} to {x.high:g}" for k, x in p.parameters.items()
        ]
    return "\n".join(parts)
