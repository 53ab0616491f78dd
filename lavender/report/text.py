"""Format numbers and short texts of a report."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from lavender.report.records import Records, Skip

TIME_UNITS = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"))
NONE = "–"  # Shown in place of a missing number.


def format_residual(x: float) -> str:
    """Return two digits: 3.4e-7; inf and nan as words."""
    if not math.isfinite(x):
        return str(x)
    if x == 0.0:
        return "0"
    mantissa, _, exponent = f"{x:.1e}".partition("e")
    return f"{mantissa}e{int(exponent)}"


def format_size(x: float) -> str:
    """Return two digits, without an exponent for usual sizes: 24, 0.31, 3.4e-7."""
    return f"{x:.2g}" if 0.05 <= x < 99.5 else format_residual(x)


def format_sizes(values: Sequence[float]) -> list[str]:
    """Return two digits of each number: without exponents if no number needs one, else all with exponents."""
    known = [x for x in values if math.isfinite(x) and x != 0.0]
    write = format_size if all("e" not in format_size(x) for x in known) else format_residual
    return [write(x) if math.isfinite(x) and x != 0.0 else "0" if x == 0.0 else NONE for x in values]


def format_times_in_one_unit(values: Sequence[float]) -> tuple[str, list[str]]:
    """Return one unit for some times [s], and each time in this unit with three digits."""
    known = [t for t in values if math.isfinite(t) and t > 0.0]
    middle = math.exp(sum(map(math.log, known)) / len(known)) if known else 1.0
    scale, unit = next((u for u in TIME_UNITS if middle >= 0.9995 * u[0]), TIME_UNITS[-1])
    return unit, [format_significant_digits(t / scale) if math.isfinite(t) else NONE for t in values]


def format_significant_digits(x: float, digits: int = 3) -> str:
    """Return a number with `digits` significant digits and without an exponent: 0.0652, 16.0, 1020."""
    if x == 0.0:
        return "0"
    rounded = float(f"{x:.{digits - 1}e}")
    return f"{rounded:.{max(0, digits - 1 - math.floor(math.log10(abs(rounded))))}f}"


def format_ratio(x: float) -> str:
    """Return a ratio in words: "2.0 times", "850 times"; from a million on, as a power of ten: "1e8 times"."""
    if not math.isfinite(x):
        return NONE
    if x >= 1e6:
        return f"1e{math.log10(x):.0f} times"
    return f"{format_significant_digits(x, 2) if x < 99.5 else f'{x:.0f}'} times"


def format_count(n: int, noun: str, plural: str = "") -> str:
    """Return a number with its noun: 1 contact, 2 contacts."""
    return f"{n} {noun if n == 1 else plural or noun + 's'}"


def list_diagnostics(records: Records) -> list[tuple[str, str]]:
    """Return (case, possible mistake in its data) for all cases.

    Equal diagnostics of a sequence are one entry, with its first step and the number of further steps.
    """
    seen: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for name, info in records.cases.items():
        for diagnostic in info.diagnostics:
            kind = diagnostic.partition(":")[0]
            seen.setdefault((info.sequence or name, kind), []).append((name, diagnostic))
    found = []
    for (name, diagnostic), *more in seen.values():
        found.append((f"{name} and {format_count(len(more), 'more step')}" if more else name, diagnostic))
    return found


def _group_by_reason(skips: Iterable[Skip]) -> dict[str, list[Skip]]:
    """Group skips by their reason without the name of the case."""
    same: dict[str, list[Skip]] = {}
    for skip in skips:
        reason = skip.reason.removeprefix("did not load: ").removeprefix(f"{skip.case}: ")
        same.setdefault(reason, []).append(skip)
    return same


def list_skip_reasons(skips: Iterable[Skip]) -> list[str]:
    """Return each different reason of some skips; if it holds for several cases, with their number."""
    same = _group_by_reason(skips)
    cases = {reason: len({skip.case for skip in some}) for reason, some in same.items()}
    return [same[r][0].reason if n == 1 else f"{r} ({n} cases)" for r, n in cases.items()]


def list_cases_not_loaded(records: Records) -> list[tuple[str, str]]:
    """Return (cases that did not load, reason), grouped by reason, and the number of steps of each sequence."""
    cases = [
        (f"{some[0].case} and {format_count(len(some) - 1, 'more case')}", reason)
        if len(some) > 1
        else (some[0].case, some[0].reason)
        for reason, some in _group_by_reason(records.left_out.get("", ())).items()
    ]
    for name, some in records.left_out.items():
        if name:
            cases.append((f"{format_count(len(some), 'step')} of {name}", some[0].reason))
    return cases


def format_left_out_count(lost: int) -> str:
    """Return a remark in parentheses that `lost` cases are left out of a number; empty if none is left out."""
    return f" ({lost} left out)" if lost else ""


def format_percent(part: int, whole: int, digits: int = 0) -> str:
    """Return a rounded percentage with at least `digits` decimals.

    More decimals are used if necessary, so that only part = whole gives 100 % and only part = 0 gives 0 %.
    """
    while 0 < part < whole and round(100.0 * part / whole, digits) in (0.0, 100.0):
        digits += 1
    return f"{100.0 * part / whole:.{digits}f} %"
