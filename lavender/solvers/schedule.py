"""The schedule of `auto`: always the method with the least expected remainder, for as long as that is.

Of k methods each has a remainder r_i, first its expected cost e_i. The one with the least r_i has a turn of r_i; where
that is not the end,

    r_i = s_i, what it has spent so far, or what it promises, if that is more, up to BELIEVED s_i               (1)

Where j would end after c_j, and every method goes on where it stood,

    all turns together <= (2k - 1) max(e_j, BELIEVED c_j)                                                      (2)

since r_j <= max(e_j, BELIEVED s_j) all the time, the last turn of any other began with r_i <= r_j and was no longer,
and by (1) it had spent no more than r_i before. Without promises BELIEVED is 1 in (2). A method that begins anew in
each turn has r_i = twice its last run in place of s_i, which is no less than all it has spent; its turns may be
BELIEVED r_i long, so that it is rarely cut short, and in (2) it counts for 1 + BELIEVED where others count for 2.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Any, Protocol

__all__ = ["BELIEVED", "Method", "first", "race", "remainder"]

# Times what a method has spent, that its promise of a remainder may be, and times its remainder, that a turn of one may
# be which cannot go on where it stood. Arbitrary: half or twice as much moves regret by less than 0.01, of either.
BELIEVED = 8.0


class Method(Protocol):
    """What the schedule knows of a method."""

    rest: float  # expected remainder [ns]
    counted: bool  # `rest` was counted closely; else it is a bound from below

    def count(self) -> None:
        """Count `rest` closely."""

    def run(self, work: float, others: float) -> bool:
        """A turn of so much work [ns]; whether it may have another, with a new `rest`.

        It may end sooner, where what is left of the turn promises less than the least remainder of the others.
        """


def race(methods: list[Method], done: Callable[[], bool]) -> None:
    """Turns until `done()` or nobody is left; of equal remainders the first in the list comes first."""
    left = list(methods)
    while left and not done():
        chosen = first(left)
        others = min((method.rest for method in left if method is not chosen), default=inf)
        if chosen.rest == inf or not chosen.run(chosen.rest, others):
            left.remove(chosen)


def first(methods: list[Any]) -> Any:
    """Who has the next turn; bounds from below are counted closely where they are the least."""
    while True:
        chosen = min(methods, key=lambda method: method.rest)
        if chosen.counted:
            return chosen
        chosen.count()


def remainder(spent: float, promised: float) -> float:
    """(1) of a method that goes on where it stood."""
    return max(spent, min(promised, BELIEVED * spent))
