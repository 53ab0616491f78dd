"""A contestant, what it reached, and the errors that all are asked for."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from lavender._arrays import FloatArray
from lavender.problem import Problem

__all__ = ["SCIPY", "SCRATCH", "TARGETS", "Call", "Contestant", "Result", "Runs"]

TARGETS = (1e-3, 1e-6, 1e-9)
SCRATCH = ", from scratch"  # what names of ours end with that pay for forming A too
SCIPY = "scipy "  # what names of SciPy's factorisations begin with

Call = Callable[[], tuple[float, FloatArray]]  # one run: s of CPU, impulse (m,) [N s]
Runs = Callable[[Problem, float], Iterator[Call]]  # problem, limit [s] -> a call for each setting


@dataclass(frozen=True)
class Contestant:
    """A solver with its form."""

    name: str
    peer: bool
    runs: Runs = field(repr=False)
    refuses: Callable[[Problem], str | None] = field(default=lambda _: None, repr=False)


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
