"""Timing for these benchmarks."""

from __future__ import annotations

import gc
from collections.abc import Callable
from time import perf_counter, process_time_ns
from typing import Any


def least(*calls: Callable[[], Any], seconds: float = 0.2) -> list[float]:
    """Return the smallest CPU time [s] of a call of each function, measured alternately in batches of about 1 ms.

    Parameters
    ----------
    seconds : float, s
        Total time; each function is called at least three times.
    """
    counts = []
    for call in calls:
        start = perf_counter()
        call()
        counts.append(max(1, min(10_000, int(1e-3 / max(perf_counter() - start, 1e-8)))))
    best = [float("inf")] * len(calls)
    begun = perf_counter()
    rounds = 0
    collects = gc.isenabled()
    gc.disable()
    try:
        while rounds < 3 or perf_counter() - begun < seconds:
            for i, call in enumerate(calls):
                start = process_time_ns()
                for _ in range(counts[i]):
                    call()
                best[i] = min(best[i], (process_time_ns() - start) / counts[i])
            rounds += 1
    finally:
        if collects:
            gc.enable()
    return [1e-9 * t for t in best]
