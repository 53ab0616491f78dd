"""What each block of a problem does at an answer: open, sticks, slides, at a bound or free, and how certain that is.

The cases are those of the judge's map (`lavender_ext/derivative/natural.pxd`): y = lambda - w / d decides. The distance
between the answer and an exact solution is bounded by `lavender.judge.error_bound`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, whole_number
from lavender.judge.error_bound import bound_errors
from lavender.judge.residuals import reference
from lavender.problem import Problem
from lavender.problem.derived import cached_property
from lavender_ext.derivative.linear import CASES, Linear, Linears

NAMES = ("open", "closed", "sticks", "slides", "free", "at a bound", "at a bound")  # by the kernels' numbers
assert tuple(CASES.values()) == tuple(range(len(NAMES)))


@dataclass(frozen=True)
class State:
    """What one block does; `str()` is a short sentence."""

    name: str  # open, closed (no friction), sticks, slides (some component does), free, at a bound (some row is)
    rows: tuple[str, ...]  # of each row; that of a contact's normal is open or closed
    margin: float  # N s (N m s on angular rows), distance to the nearest other state; inf without one
    # N s: an exact solution exists at which this block's impulse (by the norm of its rows) and its margin differ from
    # those of the answer by at most this; inf if no bound is known.
    tolerance: float

    @property
    def at_boundary(self) -> bool:
        """Whether the exact solution may have this block in another state: margin <= tolerance; True if unknown."""
        return self.margin <= self.tolerance and self.margin < np.inf

    @property
    def is_known(self) -> bool:
        """Whether there is a bound of the error: `tolerance` is finite."""
        return self.tolerance < np.inf

    def __str__(self) -> str:
        if self.margin == np.inf:
            return f"{self.name}, no other state"
        far = f"{self.name}, {self.margin:.3g} N s from another state"
        if not self.is_known:
            return f"{far}, error unknown"
        return f"at a boundary: {far}, known to {self.tolerance:.2g} N s" if self.at_boundary else far


class States(Sequence[State]):
    """States of all k blocks of an answer, and the same in arrays.

    Parameters
    ----------
    problem : Problem
    impulse : (m,) N s
    linear : Linear
        `linear_of` these two.

    Attributes
    ----------
    case : (m,) int8
        Case of each row by the kernels' numbers.
    margin : (k,) N s
        As of `State`.
    """

    def __init__(self, problem: Problem, impulse: FloatArray, linear: Linear) -> None:
        self._problem, self._impulse, self._linear = problem, impulse, linear
        self.case: Any = linear.case
        first = problem.cones.ptr[:-1]
        if len(first):
            self.margin: FloatArray = np.minimum.reduceat(linear.margin, first)
            # A contact slides where some component does, a joint is at a bound where some row is.
            self._code = np.maximum.reduceat(self.case, first)
        else:
            self.margin, self._code = np.zeros(0), np.zeros(0, np.int8)

    def __reduce__(self) -> tuple[Any, ...]:
        return states_of, (self._problem, self._impulse)

    @cached_property
    def tolerance(self) -> FloatArray:
        """(k,) N s: as of `State`, by `lavender.judge.error_bound` when it is first read."""
        first = self._problem.cones.ptr[:-1]
        if not len(first):
            return np.zeros(0)
        impulse_error, margin_error = bound_errors(self._problem, self._impulse, self._linear)
        with np.errstate(over="ignore"):
            error = np.sqrt(np.add.reduceat(impulse_error**2, first))
        return np.maximum(error, np.maximum.reduceat(margin_error, first))

    @property
    def names(self) -> tuple[str, ...]:
        """(k,) the name of each block's state."""
        return tuple(NAMES[code] for code in self._code)

    @property
    def boundary(self) -> tuple[int, ...]:
        """Blocks whose state is not certain: `State.at_boundary`. Those without a bound are among them."""
        return tuple(int(i) for i in np.flatnonzero((self.margin <= self.tolerance) & (self.margin < np.inf)))

    @property
    def unknown(self) -> tuple[int, ...]:
        """Blocks whose error has no known bound: they share a load, or the answer is far from a solution."""
        return tuple(int(i) for i in np.flatnonzero(self.tolerance == np.inf))

    @property
    def boundary_fraction(self) -> float | None:
        """Share of blocks at a boundary among those whose error has a bound; None if none has one, 0 without blocks."""
        known = self.tolerance < np.inf
        if not known.any():
            return None if len(known) else 0.0
        return float(np.mean((self.margin <= self.tolerance)[known]))

    def __len__(self) -> int:
        return len(self._code)

    def __getitem__(self, i: Any) -> Any:
        if isinstance(i, slice):
            return [self[j] for j in range(*i.indices(len(self)))]
        i = whole_number("block", i + len(self) if isinstance(i, int) and i < 0 else i)
        if i >= len(self):
            raise IndexError(f"block {i}; there are {len(self)}")
        ptr = self._problem.cones.ptr
        rows = tuple(NAMES[case] for case in self.case[ptr[i] : ptr[i + 1]])
        return State(NAMES[self._code[i]], rows, float(self.margin[i]), float(self.tolerance[i]))

    def __repr__(self) -> str:
        names = self.names
        return ", ".join(f"{names.count(name)} {name}" for name in dict.fromkeys(names)) or "no blocks"


def linear_of(problem: Problem, impulse: FloatArray, most: int = 0) -> Linear:
    """An impulse (m,) [N s], judged and linearised; of ellipses as their disks. With a factor as `Linears` has one."""
    data = problem.disk.metric
    if data.start_energy < 0.0:
        reference(problem.disk)
    return Linears([data], [problem.on_disk(impulse)], most).one(0)


def states_of(problem: Problem, impulse: FloatArray, linear: Linear | None = None) -> States:
    """Return the states at an impulse (m,) [N s]; `linear`: `linear_of` that, if it is known."""
    return States(problem, impulse, linear_of(problem, impulse) if linear is None else linear)
