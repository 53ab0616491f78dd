"""State of each block at an answer (open, sticks, slides, at a bound or free), and whether this state is certain.

y = lambda - w / d determines the case of a row, as in the judge's map (`lavender_ext/derivative/natural.pxd`). The
distance between the answer and an exact solution is bounded by `lavender.judge.error_bound`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_int
from lavender.judge.error_bound import bound_errors
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.problem import Problem
from lavender.problem.derived import cached_property
from lavender_ext.derivative.linear import CASES, Linear, Linears

NAMES = (
    "open",
    "closed",
    "sticks",
    "slides",
    "free",
    "at a bound",
    "at a bound",
)  # Names of states by the case numbers of the kernels.
assert tuple(CASES.values()) == tuple(range(len(NAMES)))


@dataclass(frozen=True)
class State:
    """State of one block; `str()` is a short sentence.

    Parameters
    ----------
    name : {"open", "closed", "sticks", "slides", "free", "at a bound"}
        "closed" is a contact without friction that bears an impulse. "slides" means that at least one friction
        component slides, "at a bound" that at least one row is at a bound.
    rows : tuple of str
        State of each row; the normal of a contact is open or closed.
    margin : float, N s (N m s on angular rows)
        Distance to the nearest other state; inf if there is none.
    tolerance : float, N s
        Error bound: an exact solution exists at which the block's impulse (by the norm of its rows) and margin differ
        from the answer's by up to this; inf if no bound is known.
    """

    name: str
    rows: tuple[str, ...]
    margin: float
    tolerance: float

    @property
    def at_boundary(self) -> bool:
        """Whether the exact solution may have this block in another state: margin <= tolerance; True if unknown."""
        return self.margin <= self.tolerance and self.margin < np.inf

    @property
    def is_known(self) -> bool:
        """Whether the error has a bound: `tolerance` is finite."""
        return self.tolerance < np.inf

    def __str__(self) -> str:
        if self.margin == np.inf:
            return f"{self.name}, no other state"
        far = f"{self.name}, {self.margin:.3g} N s from another state"
        if not self.is_known:
            return f"{far}, error unknown"
        return f"at a boundary: {far}, known to {self.tolerance:.2g} N s" if self.at_boundary else far


class States(Sequence[State]):
    """States of all k blocks of an answer: a sequence of `State`, and arrays.

    Parameters
    ----------
    problem : Problem
    impulse : (m,), N s
    linear : Linear
        Result of `judge_and_linearise_impulse(problem, impulse)`.

    Attributes
    ----------
    case : (m,) int8
        Case number of each row (`lavender_ext.derivative.linear.CASES`).
    margin : (k,), N s
        `State.margin` of each block.
    """

    def __init__(self, problem: Problem, impulse: FloatArray, linear: Linear) -> None:
        self._problem, self._impulse, self._linear = problem, impulse, linear
        self.case: Any = linear.case
        first = problem.cones.ptr[:-1]
        if len(first):
            self.margin: FloatArray = np.minimum.reduceat(linear.margin, first)
            # A contact slides if any component slides; a joint is at a bound if any of its rows is.
            self._code = np.maximum.reduceat(self.case, first)
        else:
            self.margin, self._code = np.zeros(0), np.zeros(0, np.int8)

    def __reduce__(self) -> tuple[Any, ...]:
        return compute_states, (self._problem, self._impulse)

    @cached_property
    def tolerance(self) -> FloatArray:
        """`State.tolerance` of each block (k,) [N s], computed at first access."""
        first = self._problem.cones.ptr[:-1]
        if not len(first):
            return np.zeros(0)
        impulse_error, margin_error = bound_errors(self._problem, self._impulse, self._linear)
        with np.errstate(over="ignore"):
            error = np.sqrt(np.add.reduceat(impulse_error**2, first))
        return np.maximum(error, np.maximum.reduceat(margin_error, first))

    @property
    def names(self) -> tuple[str, ...]:
        """Name of the state of each block (k,)."""
        return tuple(NAMES[code] for code in self._code)

    @property
    def boundary(self) -> tuple[int, ...]:
        """Indices of blocks with uncertain states (`State.at_boundary`), including blocks without an error bound."""
        return tuple(int(i) for i in np.flatnonzero((self.margin <= self.tolerance) & (self.margin < np.inf)))

    @property
    def unknown(self) -> tuple[int, ...]:
        """Indices of blocks without an error bound: they share a load, or the answer is far from a solution."""
        return tuple(int(i) for i in np.flatnonzero(self.tolerance == np.inf))

    @property
    def boundary_fraction(self) -> float | None:
        """Fraction, of the blocks with an error bound, whose margin to the next state is within that bound.

        None if no block has a bound; 0 if there are no blocks.
        """
        known = self.tolerance < np.inf
        if not known.any():
            return None if len(known) else 0.0
        return float(np.mean((self.margin <= self.tolerance)[known]))

    def __len__(self) -> int:
        return len(self._code)

    def __getitem__(self, i: Any) -> Any:
        if isinstance(i, slice):
            return [self[j] for j in range(*i.indices(len(self)))]
        i = check_int("block", i + len(self) if isinstance(i, int) and i < 0 else i)
        if i >= len(self):
            raise IndexError(f"block {i} does not exist; there are {len(self)} blocks, numbered from 0")
        ptr = self._problem.cones.ptr
        rows = tuple(NAMES[case] for case in self.case[ptr[i] : ptr[i + 1]])
        return State(NAMES[self._code[i]], rows, float(self.margin[i]), float(self.tolerance[i]))

    def __repr__(self) -> str:
        names = self.names
        return ", ".join(f"{names.count(name)} {name}" for name in dict.fromkeys(names)) or "no blocks"


def judge_and_linearise_impulse(problem: Problem, impulse: FloatArray, max_rows: int = 0) -> Linear:
    """Judge and linearise an impulse (m,) [N s]; ellipses are treated as disks. `max_rows`: see `Linears`."""
    data = problem.disk.metric
    if data.reference_energy < 0.0:
        get_zero_impulse_reference(problem.disk)
    return Linears([data], [problem.on_disk(impulse)], max_rows).item(0)


def compute_states(problem: Problem, impulse: FloatArray, linear: Linear | None = None) -> States:
    """Return the states at an impulse (m,) [N s]; `linear`: the linearisation at that impulse, if known."""
    return States(
        problem, impulse, judge_and_linearise_impulse(problem, impulse) if linear is None else linear
    )
