"""What a contestant reached, the errors that all are asked for, and ours among the contestants."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from time import process_time

from lavender import registry
from lavender._arrays import FloatArray
from lavender.bench.peers.adapters import Call, Contestant
from lavender.problem import Problem
from lavender.residuals import reference
from lavender.solve import prepare

__all__ = ["SCIPY", "SCRATCH", "TARGETS", "Result", "ours"]

TARGETS = (1e-3, 1e-6, 1e-9)
SCRATCH = ", from scratch"  # what names of ours end with that pay for forming A too
SCIPY = "scipy "  # what names of SciPy's factorisations begin with


@dataclass
class Result:
    """What one contestant reached on one problem."""

    problem: str
    rows: int
    law: str
    solver: str
    peer: bool
    runs: list[tuple[float, float]] = field(default_factory=list)  # s, relative residual, of every setting
    note: str = ""

    def time(self, target: float) -> float:
        """Least time [s] of a run with at most this relative residual; inf without one."""
        return min((t for t, r in self.runs if r <= target), default=math.inf)


def ours() -> list[Contestant]:
    """Every solver of ours, on a problem whose A is known and from scratch."""
    names = [name for name, spec in registry.specs().items() if not spec.external and spec.missing() is None]
    return [_ours(name, scratch) for name in names for scratch in (False, True)]


def _ours(name: str, scratch: bool) -> Contestant:
    """`prepare` and `solve` of a problem of which A and d are known, or of one of which nothing is yet."""

    def runs(problem: Problem, limit: float) -> Iterator[Call]:
        def once(tol: float) -> tuple[float, FloatArray]:
            given = replace(problem, copy=False) if scratch else problem
            start = process_time()
            prepared = prepare(given, name)
            seconds = process_time() - start
            reference(given)  # the judge's
            first = given.start()
            start = process_time()
            impulse = prepared.solve(impulse=first, tol=tol, max_iter=2**31 - 1, time_limit=limit).impulse
            return seconds + process_time() - start, impulse

        if not scratch:
            reference(problem)
            if problem.csr_data.d.size and "rows" in registry.get(name).operators:
                _ = problem.data
        for tol in TARGETS:
            yield functools.partial(once, tol)

    return Contestant(name + SCRATCH * scratch, False, runs, registry.get(name).refuses)
