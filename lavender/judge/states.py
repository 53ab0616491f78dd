"""State of each block at an answer (open, sticks, slides, at a bound or free), and its distance to another state.

Both are computed from impulse and slack: y = lambda - w / d determines the case of a row, as in the judge's map
(`lavender_ext/derivative/natural.pxd`), and the margin is the distance of y [N s] from another case. They belong to
this impulse: a solution may have a block in another state if the impulse is not accurate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_int
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.problem import Problem
from lavender_ext.derivative.linear import CASES, Linear, Linears

# Names of states by the case numbers of the kernels.
NAMES = ("open", "closed", "sticks", "slides", "free", "at a bound", "at a bound")
assert tuple(CASES.values()) == tuple(range(len(NAMES)))


@dataclass(frozen=True)
class State:
    """State of one block; `str()` is a short sentence."""

    # {"open", "closed", "sticks", "slides", "free", "at a bound"}: "closed" is a contact without friction that bears an
    # impulse. "slides" means that at least one friction component slides, "at a bound" that at least one row is at a
    # bound.
    name: str
    rows: tuple[str, ...]  # State of each row; the normal of a contact is open or closed.
    # [N s (N m s on angular rows)] Distance of this impulse to the nearest other state; inf if there is none.
    margin: float

    def __str__(self) -> str:
        if self.margin == np.inf:
            return f"{self.name}, no other state"
        return f"{self.name}, {self.margin:.3g} N s from another state"


class States(Sequence[State]):
    """States of all k blocks of an answer: a sequence of `State`, and arrays.

    Parameters
    ----------
    problem : Problem
    linear : Linear
        Result of `judge_and_linearise_impulse(problem, impulse)`.

    Attributes
    ----------
    case : (m,) int8
        Case number of each row (`lavender_ext.derivative.linear.CASES`).
    margin : (k,), N s
        `State.margin` of each block.
    """

    def __init__(self, problem: Problem, linear: Linear) -> None:
        self._problem = problem
        self.case: Any = linear.case
        first = problem.cones.ptr[:-1]
        if len(first):
            self.margin: FloatArray = np.minimum.reduceat(linear.margin, first)
            # A contact slides if any component slides; a joint is at a bound if any of its rows is.
            self._code = np.maximum.reduceat(self.case, first)
        else:
            self.margin = np.zeros(0)
            self._code = np.zeros(0, np.int8)

    @property
    def names(self) -> tuple[str, ...]:
        """Name of the state of each block (k,)."""
        return tuple(NAMES[code] for code in self._code)

    def __len__(self) -> int:
        return len(self._code)

    def __getitem__(self, i: Any) -> Any:
        if isinstance(i, slice):
            return [self[j] for j in range(*i.indices(len(self)))]
        i = check_int("block", i + len(self) if isinstance(i, int) and i < 0 else i)
        if i >= len(self):
            raise IndexError(
                f"block {i} does not exist; there are {len(self)} blocks, numbered from 0"
            )
        ptr = self._problem.cones.ptr
        rows = tuple(NAMES[case] for case in self.case[ptr[i] : ptr[i + 1]])
        return State(NAMES[self._code[i]], rows, float(self.margin[i]))

    def __repr__(self) -> str:
        names = self.names
        return (
            ", ".join(f"{names.count(name)} {name}" for name in dict.fromkeys(names)) or "no blocks"
        )


def judge_and_linearise_impulse(problem: Problem, impulse: FloatArray, max_rows: int = 0) -> Linear:
    """Judge and linearise an impulse (m,) [N s]; ellipses are treated as disks. `max_rows`: see `Linears`."""
    data = problem.disk.metric
    if data.reference_energy < 0.0:
        get_zero_impulse_reference(problem.disk)
    return Linears([data], [problem.on_disk(impulse)], max_rows).item(0)


def compute_states(problem: Problem, impulse: FloatArray, linear: Linear | None = None) -> States:
    """Return the states at an impulse (m,) [N s]; `linear`: the linearisation at that impulse, if known."""
    return States(
        problem, judge_and_linearise_impulse(problem, impulse) if linear is None else linear
    )
