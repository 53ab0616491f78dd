"""One look for every figure: a solver keeps its colour, dash and mark wherever it appears in one report.

Colours are Okabe and Ito's (distinct under the common colour-vision deficiencies), the darker ones
readable on white and on near-black; dashes and marks tell apart what shares a colour, also in grey print.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C6D31", "#7F7F7F")
LINES = ("-", "--", ":", "-.")  # dashes and marks of matplotlib
MARKERS = ("o", "s", "^", "D", "X", "*", "v")


@dataclass(frozen=True)
class Look:
    """Colour, dash and mark of a saved figure, as matplotlib names them."""

    color: str
    line: str
    marker: str


# These come first, so that what is compared most often never shares a colour.
FIRST = ("auto", "direct", "newton", "anderson", "nncg", "osqp", "pgs", "sequential_impulses")


def looks(solvers: Iterable[str]) -> dict[str, Look]:
    """A look for each solver: by its place in `FIRST`, then among the sorted names."""
    out = {}
    names = set(solvers)
    rest = sorted(names - set(FIRST))
    place = {name: i for i, name in enumerate((*FIRST, *rest))}
    for name in sorted(names):
        i = place[name]
        out[name] = Look(
            COLORS[i % len(COLORS)], LINES[i // len(COLORS) % len(LINES)], MARKERS[i % len(MARKERS)]
        )
    return out
