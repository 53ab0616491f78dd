"""The clock of these benchmarks."""

from __future__ import annotations

from collections.abc import Callable
from time import process_time


def cpu(call: Callable[[], object], repeats: int) -> float:
    """Least CPU time of a call [s]."""
    times = []
    for _ in range(repeats):
        start = process_time()
        call()
        times.append(process_time() - start)
    return min(times)
