"""What each block of a problem does at an answer: open, sticks, slides, at a bound or free, and how far the next is.

The cases are those of the judge's map (`lavender_ext/derivative/natural.pxd`): y = lambda - w / d decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, whole_number
from lavender.judge.residuals import Residual, reference
from lavender.problem import Problem
from lavender_ext.derivative.linear import CASES, Linear, Linears

NAMES = ("open", "closed", "sticks", "slides", "free", "at a bound", "at a bound")  # by the kernels' numbers
assert tuple(CASES.values()) == tuple(range(len(NAMES)))


@dataclass(frozen=True)
class State:
    """What one block does; `str()` says it."""

    name: str  # open, closed (no friction), sticks, slides (some part does), free, at a bound (some row is)
    rows: tuple[str, ...]  # of each row; that of a contact's normal is open or closed
    margin: float  # N s (N m s on angular rows), to the nearest other state; inf without one
    within: float  # N s, error of the answer here: the judge's, and what rounding may hide

    @property
    def border(self) -> bool:
        """Nearer to another state than the answer's error: which of them it is in, nothing tells."""
        return self.margin <= self.within

    def __str__(self) -> str:
        if self.border:
            return f"on a border: {self.name}, {self.margin:.2g} N s from another state, known within {self.within:.2g}"
        return f"{self.name}, {self.margin:.3g} N s from another state"


class States(Sequence[State]):
    """States of all k blocks of an answer; arrays for who wants all at once.

    Parameters
    ----------
    problem : Problem
    linear : Linear
        As `linear_of` makes it.
    within : (m,) N s
        Error of each row's impulse.
    """

    def __init__(self, problem: Problem, linear: Linear, within: FloatArray) -> None:
        cones = problem.cones
        self.case: Any = linear.case  # (m,) int8, case of each row by the kernels' numbers
        self._ptr = cones.ptr
        first = cones.ptr[:-1]
        if len(first):
            self.margin: FloatArray = np.minimum.reduceat(linear.margin, first)  # (k,) N s
            self.within: FloatArray = np.maximum.reduceat(within, first)  # (k,) N s
            # A contact slides where some part does, a joint is at a bound where some row is.
            self._code = np.maximum.reduceat(self.case, first)
        else:
            self.margin, self.within, self._code = np.zeros(0), np.zeros(0), np.zeros(0, np.int8)

    @property
    def names(self) -> tuple[str, ...]:
        """(k,) the name of each block's state."""
        return tuple(NAMES[code] for code in self._code)

    @property
    def borders(self) -> tuple[int, ...]:
        """Blocks on a border: nearer to another state than the answer's error."""
        return tuple(int(i) for i in np.flatnonzero(self.margin <= self.within))

    def __len__(self) -> int:
        return len(self._code)

    def __getitem__(self, i: Any) -> Any:
        if isinstance(i, slice):
            return [self[j] for j in range(*i.indices(len(self)))]
        i = whole_number("block", i + len(self) if isinstance(i, int) and i < 0 else i)
        if i >= len(self):
            raise IndexError(f"block {i}; there are {len(self)}")
        rows = tuple(NAMES[case] for case in self.case[self._ptr[i] : self._ptr[i + 1]])
        return State(NAMES[self._code[i]], rows, float(self.margin[i]), float(self.within[i]))

    def __repr__(self) -> str:
        names = self.names
        return ", ".join(f"{names.count(name)} {name}" for name in dict.fromkeys(names)) or "no blocks"


def linear_of(problem: Problem, impulse: FloatArray, most: int = 0) -> Linear:
    """An impulse (m,) [N s], judged and linearised; of ellipses as their disks. With a factor as `Linears` has one."""
    data = problem.disk.metric
    if data.start_energy < 0.0:
        reference(problem.disk)
    return Linears([data], [problem.on_disk(impulse)], most).one(0)


def states_of(problem: Problem, impulse: FloatArray, found: Residual) -> States:
    """States at an impulse (m,) [N s] that the judge has seen."""
    metric = problem.disk.metric
    with np.errstate(all="ignore"):
        # sum F^2 / d <= (floor E0)^2 and F sqrt(nu / d) <= floor V0, F what rounding changes in w
        hidden = found.floor * np.minimum(
            found.energy_start / np.sqrt(metric.d), found.velocity_start / metric.weight
        )
        within = np.abs(found.error) + np.nan_to_num(hidden)
    return States(problem, linear_of(problem, impulse), within)
