"""Format numbers and short texts of tables, pages and sentences."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence
from unicodedata import category

TIME_UNITS = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"))
NONE = "–"  # Shown in place of a missing number.
MAX_FILE_NAME_LENGTH = 120  # [characters] File systems accept 255 bytes, including a suffix.
#: Categories of characters that no text of a report contains: controls, formats, lone surrogates, line ends.
UNPRINTABLE = ("Cc", "Cf", "Cs", "Zl", "Zp")


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
    return [
        write(x) if math.isfinite(x) and x != 0.0 else "0" if x == 0.0 else NONE for x in values
    ]


def format_times_in_one_unit(values: Sequence[float]) -> tuple[str, list[str]]:
    """Return one unit for some times [s], and each time in this unit with three digits."""
    known = [t for t in values if math.isfinite(t) and t > 0.0]
    middle = math.exp(sum(map(math.log, known)) / len(known)) if known else 1.0
    scale, unit = next((u for u in TIME_UNITS if middle >= 0.9995 * u[0]), TIME_UNITS[-1])
    texts = []
    for t in values:
        rounded = float(f"{t / scale:.2e}")  # Written without an exponent: 0.0652, 16.0, 1020.
        decimals = (
            max(0, 2 - math.floor(math.log10(abs(rounded)))) if math.isfinite(t) and rounded else 0
        )
        texts.append(f"{rounded:.{decimals}f}" if math.isfinite(t) else NONE)
    return unit, texts


def format_tolerance(tolerance: float) -> str:
    """Format a tolerance without leading zeros in its exponent: 1e-3, not 1e-03; 0 as 0."""
    if tolerance == 0.0:
        return "0"
    mantissa, _, exponent = f"{tolerance:.3e}".partition("e")
    mantissa = mantissa.rstrip("0").rstrip(".")
    return f"{mantissa}e{int(exponent)}"


def format_time(t: float) -> str:
    """Return a time [s] with two or three digits in s, ms or µs, which no line break divides: 8.1 ms, 611 µs."""
    scale, unit = next((u for u in TIME_UNITS if t >= 0.9995 * u[0]), TIME_UNITS[-1])
    x = t / scale
    return f"{x:.2g}\u00a0{unit}" if x < 9.95 else f"{x:.0f}\u00a0{unit}"


def format_speed(v: float, unit: str = "m/s", limit: float = math.nan) -> str:
    """Return a velocity error with two digits and a prefix of its unit: 0.23 mm/s; below 0.1 µm/s as a power of ten.

    Beside another `limit` of the same text, the result has the digits that tell them apart: 1.004 mm/s. Both units of
    "m/s or rad/s" get the prefix.
    """
    if not math.isfinite(v):
        return NONE
    for scale, prefix in ((1.0, ""), (1e-3, "m"), (1e-6, "µ")):
        if abs(v) >= 0.0995 * scale:
            x = v / scale
            y = limit / scale
            digits = 2
            while x != y and digits < 15 and f"{x:.{digits}g}" == f"{y:.{digits}g}":
                digits += 1
            text = f"{x:.0f}" if abs(x) >= 9.95 and digits == 2 else f"{x:.{digits}g}"
            units = " or ".join(f"{prefix}{one}" for one in unit.split(" or "))
            return f"{text}\u00a0{units}"
    return f"{v:.0e}\u00a0{unit}".replace("e-0", "e-").replace("0e+00", "0")


def split_row_unit(row: str) -> tuple[str, str]:
    """Return the name of a row without its unit, and the unit of its velocity: rad/s if the name ends so, else m/s."""
    name = row.removesuffix(" [rad/s]")
    return name, "m/s" if name == row else "rad/s"


def format_power(x: float) -> str:
    """Return a positive number of an axis, rounded to a power of ten: 0.1, 1, 10, else 10 with an exponent."""
    n = round(math.log10(x))
    if -2 < n < 3:
        return f"{10.0**n:g}"
    return "10" + str(n).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def format_count(n: int, noun: str, plural: str = "") -> str:
    """Return a number with its noun: 1 contact, 2 contacts."""
    return f"{n} {noun if n == 1 else plural or noun + 's'}"


def format_number(n: int) -> str:
    """Return a whole number with narrow spaces between groups of three digits: 4 800."""
    return f"{n:,}".replace(",", "\u202f")


def format_percent(part: int, whole: int, digits: int = 0) -> str:
    """Return a rounded percentage with at least `digits` decimals.

    More decimals are used if necessary, so that only part = whole gives 100 % and only part = 0 gives 0 %.
    """
    while 0 < part < whole and round(100.0 * part / whole, digits) in (0.0, 100.0):
        digits += 1
    return f"{100.0 * part / whole:.{digits}f} %"


def escape_unprintable(text: str, lines: bool = False) -> str:
    """Replace characters that a terminal, file or page cannot show by their codes; with `lines` not line ends."""
    if text.isprintable():
        return text
    kept = "\n\t" if lines else ""
    return "".join(
        ascii(c)[1:-1] if category(c) in UNPRINTABLE and c not in kept else c for c in text
    )


def make_file_name(name: str) -> str:
    """Convert a name to one that every file system and URL fragment accepts; a hash keeps long names distinct."""
    short = re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("_.") or "figure"
    if len(short) <= MAX_FILE_NAME_LENGTH:
        return short
    digest = hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:12]
    return f"{short[: MAX_FILE_NAME_LENGTH - 13]}-{digest}"
