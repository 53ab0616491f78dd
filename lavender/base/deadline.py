"""The deadline of a solve: the only clock that solvers read, between their steps.

A time limit covers the time from the call of `solve` to its return. A step that cannot be interrupted starts only if
its estimated time fits into the remaining time. Time for the final pass of the judge, which follows every solve, is
reserved.
"""

from __future__ import annotations

import math
from time import perf_counter

# [s] Time between two readings of the clock, and largest delay of a reaction to Ctrl-C. Users notice about 50 ms.
CHUNK_TIME = 0.01


class TooLate(Exception):
    """A step would end after the deadline."""


class Stopwatch:
    """Measures the time since its creation."""

    def __init__(self) -> None:
        self._start = perf_counter()

    @property
    def elapsed_seconds(self) -> float:
        """Seconds since the creation of this object."""
        return perf_counter() - self._start


class Deadline:
    """A time after which a solve must end.

    Parameters
    ----------
    limit : float or None, s
        Time from `start` to the deadline; None for no deadline.
    start : float, optional, s
        Reading of `time.perf_counter`. Default: now.
    """

    __slots__ = ("_end",)

    def __init__(self, limit: float | None = None, start: float | None = None) -> None:
        self._end = math.inf
        if limit is not None:
            self._end = (perf_counter() if start is None else start) + limit

    @property
    def is_set(self) -> bool:
        """Whether there is a time limit."""
        return self._end < math.inf

    def reserve_seconds(self, seconds: float) -> None:
        """Move the deadline `seconds` earlier, to reserve time for work that follows the solve."""
        self._end -= seconds

    def has_passed(self, step: float = 0.0) -> bool:
        """Return whether a step of `step` seconds that starts now would end after the deadline."""
        return self._end < math.inf and perf_counter() + step >= self._end

    def fits(self, cost: float) -> bool:
        """Return whether a step of this estimated cost [ns] that starts now ends before the deadline."""
        return not self.has_passed(1e-9 * cost)

    def get_remaining_nanoseconds(self) -> float:
        """Return the remaining time [ns], the unit of estimated costs; inf without a limit."""
        return 1e9 * (self._end - perf_counter())

    def get_remaining_seconds(self, minimum: float = 0.0) -> float | None:
        """Return the remaining time [s], at least `minimum`; None without a limit."""
        return None if self._end == math.inf else max(self._end - perf_counter(), minimum)


NEVER = Deadline()


def format_seconds(t: float) -> str:
    """Format a time [s] with three digits and a unit: 12.3 µs, 4.56 ms, 7.89 s."""
    if not math.isfinite(t):
        return "–"
    unit, scale = ("s", 1.0) if t >= 0.9995 else ("ms", 1e-3) if t >= 0.9995e-3 else ("µs", 1e-6)
    x = t / scale
    return f"{x:.{max(0, 2 - math.floor(math.log10(max(x, 1.0))))}f} {unit}"
