"""How far each rate of `auto` can move before it chooses another solver.

A choice is what `auto` would do first on a problem at a level, sweeps or a finite solver, and which finite solver
it takes for the cheapest. Nothing is solved: choices are comparisons of costs, counted by the
rates of `lavender/solvers/_rates.py`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from lavender.problem import Problem
from lavender.solvers import _rates as rates
from lavender.solvers.auto import begins

__all__ = ["RATES", "Moved", "moved"]

RATES = (
    "SWEEP", "SWEEP_ROW", "SWEEP_START", "LOOK", "ROWS_OF_A", "START", "STEP", "ROW", "NEWTON_ROW", "DENSE",
    "DENSE_ENTRY", "BAND", "BLOCK", "PANEL", "SPARSE", "SPARSE_ROWS", "FILLED", "FILLED_ENTRY", "FILLED_WORK",
    "PIVOT", "PIVOT_ENTRY", "GENERAL_START", "GENERAL_ROW", "GENERAL", "ADMM_START", "ADMM_ROW", "ADMM_ENTRY",
    "ADMM_COUNT", "ADMM_FACTORS", "ADMM_FILL", "DIRECT", "NEWTON", "GENERAL_COUNT", "UNSYMMETRIC", "ASYMMETRIC",
    "SINGULAR", "SWEEPS", "SWEEPS_REDUNDANT", "FORMED_START", "FORMED", "RUBBED", "FORMED_ROWS",
)  # fmt: skip
FACTORS = (1.1, 1.25, 1.5, 2.0, 3.0, 5.0)


@dataclass(frozen=True)
class Moved:
    """One rate over all problems and levels."""

    rate: str
    shares: dict[float, float]  # factor, up or down: share of the choices that change with it

    def least(self, share: float = 0.05) -> float:
        """The least factor, up or down, with which more than `share` of the choices change; inf where none does."""
        return min((factor for factor, found in self.shares.items() if found > share), default=float("inf"))


def moved(problems: Iterable[Problem], levels: Sequence[float]) -> list[Moved]:
    """Each rate alone, up and down by each of `FACTORS`; the ones that move choices most, first."""
    cases = [(problem, level) for problem in problems if problem.m for level in levels]
    before = [begins(problem, level) for problem, level in cases]
    found = []
    for rate in RATES:
        shares = {}
        for factor in FACTORS:
            changed = [False] * len(cases)
            for by in (factor, 1.0 / factor):
                with _scaled(rate, by):
                    for i, (problem, level) in enumerate(cases):
                        changed[i] = changed[i] or begins(problem, level) != before[i]
            shares[factor] = sum(changed) / max(1, len(cases))
        found.append(Moved(rate, shares))
    return sorted(found, key=lambda m: (-max(m.shares.values()), m.rate))


@contextmanager
def _scaled(rate: str, factor: float) -> Iterator[None]:
    given: Any = getattr(rates, rate)
    if isinstance(given, dict):
        setattr(rates, rate, {key: factor * value for key, value in given.items()})
    else:
        setattr(rates, rate, factor * given)
    try:
        yield
    finally:
        setattr(rates, rate, given)
