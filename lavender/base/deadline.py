"""The deadline of a solve, and the times of reports.

A time limit covers the time from the call of `solve` to its return, without imports. `Deadline` is an absolute time on
the monotonic clock. Long loops, in Python and in kernels, read the clock between pieces of work; without a limit
nothing reads it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from threading import local

from lavender_ext.core.deadline import Deadline as Deadline
from lavender_ext.core.deadline import read_clock as read_clock

# [s] Time between two checks for Ctrl-C. Users notice about 50 ms.
CHUNK_TIME = 0.01
# [s] The same under a time limit, and for the clock.
LIMITED_CHUNK_TIME = 1e-3


NEVER = Deadline()


class TooLate(ArithmeticError):
    """The deadline passed before a matrix was formed."""


class _Forming(local):
    deadline: Deadline | None = None


FORMING = _Forming()  # The deadline that forming A reads, of each thread.
#: In place of `limit_forming` where a solve has no limit: it runs no code of this file.
UNLIMITED: AbstractContextManager[None] = nullcontext()


@contextmanager
def limit_forming(deadline: Deadline | None) -> Iterator[None]:
    """Let this thread's forming of A raise TooLate after the deadline; None or no limit: it ends."""
    before = FORMING.deadline
    FORMING.deadline = deadline
    try:
        yield
    finally:
        FORMING.deadline = before


@contextmanager
def stop_clock(deadline: Deadline) -> Iterator[list[float]]:
    """Leave the time of the block, of imports and processes, out of the limit; yield a list that receives it [s]."""
    spent = [0.0]
    begun = read_clock()
    try:
        yield spent
    finally:
        spent[0] = read_clock() - begun
        deadline.extend(spent[0])


def format_seconds(t: float) -> str:
    """Format a time [s] with three digits and a unit: 12.3 µs, 4.56 ms, 7.89 s."""
    if not math.isfinite(t):
        return "–"
    unit, scale = ("s", 1.0) if t >= 0.9995 else ("ms", 1e-3) if t >= 0.9995e-3 else ("µs", 1e-6)
    x = t / scale
    return f"{x:.{max(0, 2 - math.floor(math.log10(max(x, 1.0))))}f} {unit}"
