"""The deadline of a solve: the only clock of solvers, read between their steps.

It is the caller's: it runs from the call of `solve` to its return. What cannot be stopped is begun only if its counted
time fits in what is left, and the time of what always follows, the judge's last pass, is kept free.
"""

from __future__ import annotations

import math
from time import perf_counter

CHUNK_TIME = 0.01  # s between two readings of the clock; five times that is still unnoticeable after Ctrl-C


class TooLate(Exception):
    """A step would end after the deadline."""


class Stopwatch:
    """Measures a step: seconds since this object was made."""

    __slots__ = ("_start",)

    def __init__(self) -> None:
        self._start = perf_counter()

    @property
    def seconds(self) -> float:
        """Seconds since it was made."""
        return perf_counter() - self._start


class Deadline:
    """A moment `limit` [s] from now, or never."""

    __slots__ = ("_at",)

    def __init__(self, limit: float | None = None, begun: float | None = None) -> None:
        """`begun`: reading of this clock that the limit counts from; default: now."""
        self._at = math.inf
        if limit is not None:
            self._at = (perf_counter() if begun is None else begun) + limit

    @property
    def is_set(self) -> bool:
        """Whether there is a limit."""
        return self._at < math.inf

    def keep(self, seconds: float) -> None:
        """End so much earlier: kept for what always follows."""
        self._at -= seconds

    def passed(self, step: float = 0.0) -> bool:
        """Whether a step of so many seconds, begun now, would end after the deadline."""
        return self._at < math.inf and perf_counter() + step >= self._at

    def nanoseconds(self) -> float:
        """What is left, in the unit of counted costs; inf without a limit."""
        return 1e9 * (self._at - perf_counter())

    def left(self, least: float = 0.0) -> float | None:
        """Seconds until then, at least `least`; None without a limit."""
        return None if self._at == math.inf else max(self._at - perf_counter(), least)


NEVER = Deadline()


def seconds(t: float) -> str:
    """Three digits and a unit: 12.3 µs, 4.56 ms, 7.89 s."""
    if not math.isfinite(t):
        return "–"
    for scale, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")):
        if t >= 0.9995 * scale or unit == "µs":
            x = t / scale
            digits = max(0, 2 - math.floor(math.log10(x))) if x >= 1.0 else 2
            return f"{x:.{digits}f} {unit}"
    return "–"
