"""The schedule of `auto`: repeatedly, the method with the least expected remaining cost gets a turn of that length.

Each of k methods has an expected remaining cost r_i, at first its expected cost e_i. The method with the least r_i runs
for a turn of length r_i. If it has not converged, then

    r_i = max(s_i, min(p_i, BELIEVED s_i))     s_i: spent so far, p_i: remaining cost that it predicts          (1)

If method j would converge after c_j, and every method continues where it stopped,

    all turns together <= (2k - 1) max(e_j, BELIEVED c_j)                                                      (2)

because r_j <= max(e_j, BELIEVED s_j) at all times, the last turn of any other method began with r_i <= r_j and was no
longer, and by (1) it had spent at most r_i before. Without predictions BELIEVED is 1 in (2). A method that has little
to show before its end may have longer turns, up to BELIEVED r_i, so that it is rarely interrupted; in (2) it counts
for 1 + BELIEVED where others count for 2.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Any, Protocol

__all__ = ["BELIEVED", "Method", "first", "race", "remainder"]

# The largest prediction, relative to what a method has spent; and the longest turn of a method that factors, relative
# to its remaining cost. Arbitrary: half or twice as much changes regret by at most 0.01, for either.
BELIEVED = 8.0


class Method(Protocol):
    """What the schedule knows of a method."""

    rest: float  # expected remaining cost [ns]
    counted: bool  # `rest` is the counted cost; otherwise it is a lower bound

    def count(self) -> None:
        """Replace the lower bound `rest` by the counted cost."""

    def run(self, work: float, others: float) -> bool:
        """Run a turn of so much work [ns]; return whether it may have another, with a new `rest`.

        It may end sooner, where what is left of the turn promises less than the least remainder of the others.
        """


def race(methods: list[Method], done: Callable[[], bool]) -> None:
    """Run turns until `done()` or no method is left; of equal remaining costs, the first in the list is chosen."""
    left = list(methods)
    while left and not done():
        chosen = first(left)
        others = min((method.rest for method in left if method is not chosen), default=inf)
        if chosen.rest == inf or not chosen.run(chosen.rest, others):
            left.remove(chosen)


def first(methods: list[Any]) -> Any:
    """The method of the next turn; a lower bound that is the least is first replaced by the counted cost."""
    while True:
        chosen = min(methods, key=lambda method: method.rest)
        if chosen.counted:
            return chosen
        chosen.count()


def remainder(spent: float, promised: float) -> float:
    """(1)."""
    return max(spent, min(promised, BELIEVED * spent))
