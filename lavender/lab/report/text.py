"""Numbers as people read them."""

from __future__ import annotations

import math
from collections.abc import Iterable

from lavender.lab.bench.record import Skip
from lavender.lab.bench.store import Records

NONE = "–"  # where there is no number


def residual(x: float) -> str:
    """Two digits: 3.4e-7; inf and nan as words."""
    if not math.isfinite(x):
        return str(x)
    if x == 0.0:
        return "0"
    mantissa, _, exponent = f"{x:.1e}".partition("e")
    return f"{mantissa}e{int(exponent)}"


def size(x: float) -> str:
    """Two digits of what may be large: 24, 0.31, 3.4e-7."""
    return f"{x:.2g}" if 0.05 <= x < 99.5 else residual(x)


def times(x: float) -> str:
    """A ratio as a word: 1.3 times, 850 times; beyond a million its power of ten, where digits say nothing."""
    if not math.isfinite(x):
        return NONE
    return f"{x:.2g} times" if x < 99.5 else f"{x:.0f} times" if x < 1e6 else f"10^{math.log10(x):.0f} times"


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


def _cause_of(skip: Skip) -> str:
    """The reason of a skip without the name of its case, which others may share."""
    return skip.reason.removeprefix("did not load: ").removeprefix(f"{skip.case}: ")


def reasons(skips: Iterable[Skip]) -> list[str]:
    """Return each reason of some skips once, with the number of cases that it holds for if these are several."""
    same: dict[str, list[Skip]] = {}
    for skip in skips:
        same.setdefault(_cause_of(skip), []).append(skip)
    cases = {cause: len({skip.case for skip in some}) for cause, some in same.items()}
    return [
        some[0].reason if cases[cause] == 1 else f"{cause} ({cases[cause]} cases)"
        for cause, some in same.items()
    ]


def left_out(records: Records) -> list[tuple[str, str]]:
    """(what did not load, why): cases, those of one reason together, and how many steps of each sequence."""
    same: dict[str, list[Skip]] = {}
    for skip in records.left_out.get("", ()):
        same.setdefault(_cause_of(skip), []).append(skip)
    single = [
        (some[0].case, some[0].reason)
        if len(some) == 1
        else (f"{some[0].case} and {count(len(some) - 1, 'more case')}", cause)
        for cause, some in same.items()
    ]
    steps = {f"{count(len(some), 'step')} of {name}": some for name, some in records.left_out.items() if name}
    return [*single, *((told, some[0].reason) for told, some in steps.items())]


def without(lost: int) -> str:
    """What stands beside a number that rests on what is left."""
    return f" ({lost} left out)" if lost else ""


def percent(part: int, whole: int, digits: int = 0) -> str:
    """Return part of a whole, rounded down, with at least so many digits: 100 % is all of it, and 0 % is nothing."""
    while 0 < 100 * 10**digits * part < whole:
        digits += 1
    tenths = 100 * 10**digits * part // whole
    return f"{tenths / 10**digits:.{digits}f} %"


def share(solved: int, cases: int) -> str:
    """(7/8); nothing where all are solved."""
    return "" if solved == cases else f" ({solved}/{cases})"


def who(solver: str, start: str) -> str:
    """A solver, and from where it started if not cold: newton (warm)."""
    return solver if start == "cold" else f"{solver} ({start})"
