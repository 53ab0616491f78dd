"""Numbers and recommendations as people read them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from lavender.bench.record import level_name
from lavender.bench.store import Records
from lavender.report.moved import advice_by_speed, moved, speed_levels, speed_name
from lavender.report.tables import Advice, Line, levels_of

__all__ = [
    "advice_rows",
    "count",
    "in_time",
    "moved_rows",
    "residual",
    "seconds",
    "share",
    "speed_rows",
    "suspicions",
    "sweeps_rows",
    "times",
    "to_level",
    "who",
]

Rows = tuple[list[str], list[list[str]]]  # heads of columns, and the cells of each row


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


def times(x: float) -> str:
    """A ratio as a word: 1.3 times, 850 times; beyond a million its power of ten, where digits say nothing."""
    if not math.isfinite(x):
        return "–"
    return f"{x:.2g} times" if x < 100.0 else f"{x:.0f} times" if x < 1e6 else f"10^{math.log10(x):.0f} times"


def count(n: int, what: str, plural: str = "") -> str:
    """1 contact, 2 contacts."""
    return f"{n} {what if n == 1 else plural or what + 's'}"


def suspicions(records: Records) -> list[tuple[str, str]]:
    """(case, what looks like a mistake in its data); of a sequence the first step, and how many more."""
    seen: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for name, info in records.cases.items():
        for told in info.suspicions:
            kind = told.partition(":")[0]
            seen.setdefault((info.sequence or name, kind), []).append((name, told))
    return [
        (f"{some[0][0]} and {count(len(some) - 1, 'more step')}" if len(some) > 1 else some[0][0], some[0][1])
        for some in seen.values()
    ]


def share(solved: int, cases: int) -> str:
    """(7/8); nothing where all are solved."""
    return "" if solved == cases else f" ({solved}/{cases})"


def to_level(advice: Advice) -> str:
    """Who gets to a level, in what time, on how many cases and with which budget, in one line."""
    best = advice.best
    if best is None:
        return "nobody"
    return (
        f"{best.solver} {seconds(best.score)}{share(best.solved, best.cases)}{_how(best.how)}{_ties(advice)}"
    )


def in_time(advice: Advice) -> str:
    """Who serves most cases within a time or a budget, and how close it comes, in one line."""
    best = advice.best
    if best is None:
        return "nobody"
    return f"{best.solver} to {residual(best.score)}{share(best.solved, best.cases)}{_how(best.how)}{_ties(advice)}"


def _how(how: str) -> str:
    return f", {how}" if how else ""


def _ties(advice: Advice, most: int = 2) -> str:
    names = advice.ties
    if not names:
        return ""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f" ≈ {', '.join(names[:most])}{more}"


def who(solver: str, start: str) -> str:
    """A solver, and from where it started if not cold: newton (warm)."""
    return solver if start == "cold" else f"{solver} ({start})"


def advice_rows(records: Records, lines: Sequence[Line], times: Sequence[float]) -> Rows:
    """Each structure and sequence: who gets to each level, and who serves most within each time [s]."""
    heads = [*(f"to {level_name(x)}" for x in levels_of(records)), *(f"in {seconds(t)}" for t in times)]
    rows = [
        [line.name, *map(to_level, line.by_level.values()), *map(in_time, line.by_time.values())]
        for line in lines
    ]
    return ["structure", *heads], rows


def sweeps_rows(lines: Sequence[Line]) -> Rows:
    """The same with each budget of sweeps; no rows where none was run."""
    budgets = sorted({n for line in lines for n in line.by_sweeps})
    heads = [count(int(n), "sweep") for n in budgets]
    rows = [[line.name, *(in_time(line.by_sweeps[n]) for n in budgets)] for line in lines if line.by_sweeps]
    return ["structure", *heads], rows


def speed_rows(records: Records) -> Rows:
    """Each structure: who gets to each motion error [m/s]."""
    by_family: dict[str, list[str]] = {}
    for advice in advice_by_speed(records):
        by_family.setdefault(advice.family, []).append(to_level(advice))
    heads = [f"to {speed_name(x)}" for x in speed_levels(records)]
    return ["structure", *heads], [[name, *row] for name, row in by_family.items()]


def moved_rows(records: Records) -> Rows:
    """Each case and solver: time to each motion error, the smallest, relative, and its bound."""
    levels = speed_levels(records)
    rows = []
    for m in moved(records, levels):
        known = [
            f"{residual(x)}{unit}" if math.isfinite(x) else "–"
            for x, unit in ((m.best, " m/s"), (m.relative, ""), (m.bound, " √J"))
        ]
        rows.append([m.case, who(m.solver, m.start), *(seconds(m.times[x]) for x in levels), *known])
    heads = [f"to {speed_name(x)}" for x in levels]
    return ["case", "solver", *heads, "best", "relative", "bound"], rows
