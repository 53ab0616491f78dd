"""The machine's limits, and the clock that kernels are timed by beside them."""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from time import perf_counter, process_time_ns
from typing import Any

import numpy as np

from benchmarks.kernels import microbenchmarks

__all__ = ["FOOTPRINTS", "Limit", "least", "measure_limits", "stream_time"]


@dataclass(frozen=True)
class Limit:
    """One limit of this machine."""

    name: str
    kib: float  # footprint, KiB; 0 where there is none
    value: float
    unit: str  # "GB/s" or "ns"


def least(
    *calls: Callable[[], Any], seconds: float = 0.2, clock: Callable[[], int] = process_time_ns
) -> list[float]:
    """Least time [s] of one call of each, in turns, in batches of about a millisecond.

    Parameters
    ----------
    seconds : float, s
        Time for all; each is called at least three times.
    """
    counts = []
    for call in calls:
        start = perf_counter()
        call()
        counts.append(max(1, min(10_000, int(1e-3 / max(perf_counter() - start, 1e-8)))))
    best = [float("inf")] * len(calls)
    begun, rounds = perf_counter(), 0
    collects = gc.isenabled()
    gc.disable()
    try:
        while rounds < 3 or perf_counter() - begun < seconds:
            for i, call in enumerate(calls):
                start = clock()
                for _ in range(counts[i]):
                    call()
                best[i] = min(best[i], (clock() - start) / counts[i])
            rounds += 1
    finally:
        if collects:
            gc.enable()
    return [1e-9 * t for t in best]


# KiB: in the first-level cache, the second, the third, beyond all.
FOOTPRINTS = (24, 512, 8_192, 262_144)


@cache
def measure_limits(seconds: float = 0.1) -> tuple[Limit, ...]:
    """Reading and writing speed, time of a dependent load, time of a dependent product and sum."""
    found = []
    for kib in FOOTPRINTS:
        n = kib * 128
        x = np.arange(n, dtype=np.uint64)
        found.append(
            Limit(
                "read",
                kib,
                8.0 * n / least(partial(microbenchmarks.read, x, 1), seconds=seconds)[0] * 1e-9,
                "GB/s",
            )
        )
        a, b, c = np.zeros(n // 3), np.ones(n // 3), np.ones(n // 3)
        time = least(partial(microbenchmarks.triad, a, b, c, 1), seconds=seconds)[0]
        found.append(Limit("triad", kib, 24.0 * len(a) / time * 1e-9, "GB/s"))
        ring = np.random.default_rng(kib).permutation(kib * 16).astype(np.int32)  # one entry a cache line
        step = np.zeros(kib * 256, np.int32)
        step[16 * ring] = 16 * np.roll(ring, -1)
        time = least(partial(microbenchmarks.chase, step, 20_000), seconds=seconds)[0]
        found.append(Limit("chase", kib, time / 20_000 * 1e9, "ns"))
    time = least(partial(microbenchmarks.chain, 0.5, 1.0, 20_000), seconds=seconds)[0]
    return (*found, Limit("chain", 0, time / 20_000 * 1e9, "ns"))


def stream_time(size: float) -> float:
    """Time [s] of moving `size` bytes at the speed (read or triad) of the memory that they fit in."""
    speed: dict[float, float] = {}
    for x in measure_limits():
        if x.unit == "GB/s":
            speed[x.kib] = max(x.value, speed.get(x.kib, 0.0))
    kib = next((k for k in FOOTPRINTS if size <= 1024 * k), FOOTPRINTS[-1])
    return size / speed[kib] * 1e-9
